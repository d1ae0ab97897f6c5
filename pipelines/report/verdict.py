"""A shot's calibration in the reader's words: what its error is made of, what carries it, what the lens does.

From the `calibration` of run.json, which has every number; a number that is not known has no row. No HTML, no files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pipelines.report.words import number, plural

Row = tuple[str, str, str]  # name, value, what it says

# Parts of the error bar (calib.gates), each a share of the focal length; the others of `sigma_parts` are in px.
PARTS = {
    "cluster": "noise, from pair to pair",
    "signal": "errors that all pairs share, such as lens model and parallax",
    "halves": "halves of the shot against each other",
    "constant_k": "another lens model",
    "pupil": "what may be left of the pupil's parallax",
}
FLAGS = {
    "inflated": "the misfit is above 1.5",
    "bad_edges": "some pairs of pictures contradict the others and were left out",
    "unlinked_frames": "some keyframes could not be linked to the others",
    "effective_pp": "the principal point lies far above or below the middle: it stands in for parallax",
    "distortion_extreme": "the lens distortion came out extreme",
    "subsets_disagree": "parts of the shot differ by more than the other errors explain",
    "aspect_assumed": "the shape of the pixels is the file's, not measured",
}
SHUTTER = {
    "no_motion": "not looked for: the camera turns too little",
    "not_significant": "none to be seen",
    "impossible": "none: what would fit is no time that a camera takes",
    "not_better": "none: taking one out did not make the pictures fit better",
}


def verdict_rows(
    calibration: Mapping[str, Any], f_range_px: tuple[float, float] | None, width_px: float | None
) -> list[Row]:
    """(name, value, note) of what `calibration` knows. f_range_px: shortest and longest focal length of the shot."""
    return [
        *_error(calibration),
        *_evidence(calibration),
        *_lens(calibration.get("lens") or {}, f_range_px, width_px),
        *_head(calibration),
        *_flags(calibration.get("flags") or ()),
    ]


def _error(calibration: Mapping[str, Any]) -> Iterator[Row]:
    total = _known(calibration.get("sigma_relative"))
    parts = calibration.get("sigma_parts") or {}
    shares = [(name, _known(parts.get(name))) for name in PARTS]
    made_of = sorted(((s, name) for name, s in shares if s is not None and s >= 5e-5), reverse=True)
    if total is None:
        return
    claimed = calibration.get("claims_focal", True)
    name = "error of the focal length" if claimed else "error that a focal length would have"
    if total > 1:
        yield name, "above 100 %", "nothing is known of it"
        return
    said = "; ".join(f"{PARTS[part]}: {number(100 * share, 2)} %" for share, part in made_of)
    yield name, f"{number(100 * total)} %", f"one sigma, made of {said}" if said else "one sigma"


def _evidence(calibration: Mapping[str, Any]) -> Iterator[Row]:
    shown, shared = (
        _known(calibration.get("s10_px")),
        _known((calibration.get("sigma_parts") or {}).get("systematic_px")),
    )
    if shown is not None:
        note = "by how much the clearest pair of pictures would change if the focal length were 10 % off"
        if shared is not None:
            note += f"; errors that all pairs share may be {number(shared, 2)} px, and must be smaller for a claim"
        yield "evidence", f"{number(shown)} px", note
    if (misfit := _known(calibration.get("chi2_dof"))) is not None:
        note = "against the expected noise: 1 is ideal, 2 to 4 usual on broadcast clips, above 6 refused"
        yield "misfit", number(misfit), note
    if (turn := _known(calibration.get("rotation_deg"))) is not None:
        yield "turn of the camera", f"{turn:.1f}°", "ten degrees and more make a focal length"
    if (rows := _known(calibration.get("support_rows"))) is not None:
        yield (
            "height of the evidence",
            f"{rows:.0f} of 5",
            "fifths of the picture's height that have structure",
        )
    pairs, usable = calibration.get("keyframe_pairs"), calibration.get("keyframe_pairs_usable")
    if calibration.get("keyframes") and pairs is not None:
        keyframes = plural(len(calibration["keyframes"]), "keyframe")
        used = f"{usable} of {plural(pairs, 'pair')}" if usable is not None else plural(pairs, "pair")
        yield "made from", f"{keyframes}, {used}", "of pictures that were aligned against each other"


def _lens(
    lens: Mapping[str, Any], f_range_px: tuple[float, float] | None, width_px: float | None
) -> Iterator[Row]:
    std = lens.get("std") or {}
    if pp := lens.get("pp_px"):
        errors = [_known(std.get(name)) for name in ("pp_x", "pp_y")]
        text = ", ".join(
            f"{value:.1f}" + (f" ± {number(error, 2)}" if error is not None else "")
            for value, error in zip(pp, errors, strict=True)
        )
        yield "principal point", f"{text} px", "errors statistical; it also takes up parallax, mostly in y"
    c0, c1 = (_known(lens.get(name)) for name in ("k1_half_c0", "k1_half_c1"))
    if c0 is not None and c1 is not None and f_range_px is not None and width_px:
        ends = [100 * (c0 + c1 * math.log(f / width_px)) for f in f_range_px]
        signed = [f"{value:+.1f}".replace("-", "−") for value in ends]
        text = signed[0] if signed[0] == signed[1] else f"{signed[0]} to {signed[1]}"
        note = "of half the width, at the middle of the left and right edge; + is pincushion, − barrel"
        if " to " in text:
            note += "; from the shortest to the longest focal length"
        yield "lens distortion", f"{text} %", note


def _head(calibration: Mapping[str, Any]) -> Iterator[Row]:
    level = calibration.get("level") or {}
    if level.get("sentence"):
        tilt, error = _known(level.get("tilt0_deg")), _known(level.get("tilt0_std_deg"))
        shown = bool(level.get("observable")) and tilt is not None and error is not None
        note = (
            f"the reference frame's tilt against it is {number(tilt or 0)} ± {number(error or 0, 2)}°"
            if shown
            else ""
        )
        yield "pan axis", str(level["sentence"]), note
    pupil = calibration.get("pupil") or {}
    if pupil.get("sentence"):
        change = _known(pupil.get("focal_change"))
        note = "how far the lens's pupil lies before the pan axis makes near things slide against far ones"
        if pupil.get("accepted") and change is not None:
            note = f"taking its parallax out changed the focal length by {number(100 * change, 2)} %"
        yield "pupil", str(pupil["sentence"]), note
    shutter = calibration.get("rolling_shutter") or {}
    share, moved = _known(shutter.get("share_of_frame")), _known(shutter.get("first_row_px"))
    if shutter.get("found") and share is not None and moved is not None:
        note = "of the time between pictures, to read the rows of one; the first row of the fastest moves by "
        note += f"{number(moved, 2)} px"
        yield "rolling shutter", f"{number(100 * share, 2)} %", note
    elif shutter:
        reason = str(shutter.get("reason", ""))
        yield "rolling shutter", SHUTTER.get(reason, reason.replace("_", " ")), ""


def _flags(flags: Sequence[str]) -> Iterator[Row]:
    if flags:
        yield "worth knowing", "; ".join(FLAGS.get(flag, flag.replace("_", " ")) for flag in flags), ""


def _known(value: Any) -> float | None:
    """A finite number, else None."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else None
