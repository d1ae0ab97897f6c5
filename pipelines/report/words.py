"""What a run found, in plain words: sentences and table cells from the records. No HTML, no files.

A number is said with its error and its unit, or not at all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.records import CameraTable, RunRecord, ShotRecord

# Status -> (sign, what it means). The signs differ in form, so that they can be told apart without colour.
STATUS_SIGNS = {
    "ok": ("●", "camera known"),
    "weak": ("◐", "camera known, with a large error"),
    "relative": ("◇", "motion and zoom ratio known, focal length not"),
    "interpolated": ("≈", "bridged between good neighbours"),
    "lost": ("✕", "nothing known"),
    "graphic": ("▦", "not a view of the scene"),
}
SHOT_SIGNS = {
    "ok": ("●", "focal length found"),
    "relative": ("◇", "zoom and motion only"),
    "failed": ("✕", "not usable"),
}

PRIOR = "a known focal length as a prior"
PAN = f"a pan of several degrees, or {PRIOR}"

# Reason code -> (what happened, what would help). A code that is not here is shown as it is.
REASONS = {
    "low_overlap": (
        "too little of the picture is seen in another one",
        "a slower pan, or a higher frame rate",
    ),
    "no_texture": (
        "too little structure to align on (flat grass, blur, darkness)",
        "a part with stands, lines or boards in view",
    ),
    "diverged": ("the alignment ran away", "less motion blur, or a clip with less compression"),
    "max_steps": (
        "the alignment did not settle in the steps allowed",
        "a clip with less blur and compression",
    ),
    "score": (
        "the aligned pictures agree hardly better than shifted ones",
        "fewer moving players, or a clip with less compression",
    ),
    "few_inliers": ("most of the picture moves against the background", "a wider view with fewer players"),
    "duplicate": ("the picture repeats the one before", ""),
    "tracking_lost": ("the thread to the earlier pictures broke", "a clip without interruption"),
    "not_linked": (
        "the picture could not be linked to the rest of the shot",
        "a slower pan or less motion blur",
    ),
    "doubtful_link": (
        "only doubtful alignments lead to this picture; they may have followed the players",
        "a stretch where more of the ground or the stand shows",
    ),
    "misfit": ("the picture contradicts a camera that only turns and zooms", ""),
    "between_shots": ("the picture belongs to no shot", ""),
    "fade": ("one shot fades into the next here", ""),
    "transition": ("a dissolve, wipe or full-screen graphic joins two shots here", ""),
    "bridged": ("the picture's own alignment failed; its camera lies between its neighbours'", ""),
    "focal_error_above_5_percent": ("the focal length is known, but only to worse than 5 %", PAN),
    "too_few_edges": (
        "fewer than two pictures could be linked",
        "a longer shot, or a view with more structure",
    ),
    "not_converged": ("the calibration reached no optimum", f"a longer or wider pan, or {PRIOR}"),
    "distortion_not_modelled": (
        "the lens distortion was held fixed without being known, which biases the focal length",
        "a distortion that may vary, or a known lens as a prior",
    ),
    "distortion_invalid": (
        "the lens distortion that fits folds the picture over itself",
        "a known lens as a prior",
    ),
    "band_only": (
        "structure was found in a narrow band of the picture only, which gives wrong focal lengths",
        f"a view with structure from top to bottom, or {PRIOR}",
    ),
    "not_observable": ("this motion does not show the focal length", PAN),
    "focal_unobservable": ("this motion does not show the focal length", PAN),
    "no_rotation": ("the camera stands still", f"a shot that pans, or {PRIOR}"),
    "zoom_only": ("the camera zooms but does not pan", f"a shot that also pans, or {PRIOR}"),
    "roll_only": ("the camera only rolls", f"a shot that pans, or {PRIOR}"),
    "perspective_signal_below_systematics": (
        "the pan is so small that lens errors could imitate any focal length",
        f"a wider pan, or {PRIOR}",
    ),
    "model_misfit": (
        "the pictures contradict a camera that only turns and zooms (it moves, or near things dominate)",
        "a camera on a tripod, far from the scene",
    ),
    "not_a_rotation": (
        "no camera that only turns and zooms explains the pictures (a player or crowd fills them, or the camera moves)",
        "a wider view, in which ground or stands show between those who move",
    ),
    "pp_at_border": ("the optical centre ran to its limit", "a wider pan with tilt, or the uncropped clip"),
    "pp_at_search_border": (
        "the optical centre ran to its limit",
        "a wider pan with tilt, or the uncropped clip",
    ),
    "distortion_extreme": ("the lens distortion came out extreme", "a known lens as a prior"),
    "focal_out_of_range": ("the focal length came out outside anything a camera has", PAN),
    "linear_invalid": ("no starting camera fits the motion", PAN),
    "ambiguous": ("two different cameras explain the pictures equally well", PAN),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShotFacts:
    """What the table says about one shot; None where nothing is known. f_range: ((f_px, std_px) low, high)."""

    n_frames: int
    f_range: tuple[tuple[float, float], tuple[float, float]] | None
    zoom_range: tuple[float, float] | None
    pan_range_deg: tuple[float, float] | None
    tilt_range_deg: tuple[float, float] | None
    residual_px: tuple[float, float] | None  # median, 95 %
    overlap: float | None  # median
    statuses: Mapping[str, int]
    reasons: Mapping[str, int]


def shot_facts(table: CameraTable, shot: int) -> ShotFacts:
    """Ranges and counts of one shot's rows."""
    rows = table.shot == shot
    index = np.flatnonzero(rows)
    claimed = index[np.isfinite(table.f_px[index])]
    f_range = None
    if len(claimed):
        ends = claimed[np.argmin(table.f_px[claimed])], claimed[np.argmax(table.f_px[claimed])]
        low, high = ((float(table.f_px[i]), float(table.f_std_px[i])) for i in ends)
        f_range = (low, high)
    residual = table.residual_px[rows]
    residual = residual[np.isfinite(residual)]
    overlap = table.overlap[rows]
    overlap = overlap[np.isfinite(overlap)]
    return ShotFacts(
        n_frames=len(index),
        f_range=f_range,
        zoom_range=finite_range(table.zoom_ratio[rows]),
        pan_range_deg=finite_range(table.pan_deg[rows]),
        tilt_range_deg=finite_range(table.tilt_deg[rows]),
        residual_px=(float(np.median(residual)), float(np.percentile(residual, 95)))
        if len(residual)
        else None,
        overlap=float(np.median(overlap)) if len(overlap) else None,
        statuses=ordered_counts([table.status[i] for i in index], tuple(STATUS_SIGNS)),
        reasons=ordered_counts([table.reason[i] for i in index if table.reason[i]]),
    )


def finite_range(values: NDArray[np.float64]) -> tuple[float, float] | None:
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else None


def ordered_counts(words: Sequence[str], order: Sequence[str] = ()) -> dict[str, int]:
    """Word -> how often: in `order` first, then by falling count and name."""
    counts = Counter(words)
    first = {word: counts.pop(word) for word in order if word in counts}
    return first | dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def number(value: float, digits: int = 3) -> str:
    """`value` with at most `digits` significant digits, never in powers of ten below a million."""
    if value == 0 or not np.isfinite(value):
        return "0" if value == 0 else "not known"
    places = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    text = f"{value:.{places}f}" if abs(value) < 1e6 and places < 8 else f"{value:.{digits - 1}e}"
    return text.replace("-", "−", 1) if value < 0 and "e" not in text else text


def with_error(value: float, std: float, unit: str = "px") -> str:
    """'2755 ± 52 px (1.9 %)'; the error is said to be unknown where it is."""
    if not np.isfinite(std):
        return f"{value:.0f} {unit} (error not known)"
    return f"{value:.0f} ± {number(std, 2)} {unit} ({number(100 * std / value, 2)} %)"


def plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}".replace(",", "\u202f")  # narrow, no line break


def focal_words(facts: ShotFacts) -> str:
    """The focal range with one-sigma errors; one value where the zoom did not move."""
    if facts.f_range is None:
        return ""
    (low, low_std), (high, high_std) = facts.f_range
    if high / low < 1.002:
        return with_error(low, low_std)
    return f"{with_error(low, low_std)} to {with_error(high, high_std)}"


def range_words(bounds: tuple[float, float] | None, unit: str, places: int = 1) -> str:
    if bounds is None:
        return ""
    low, high = (f"{value:+.{places}f}".replace("-", "−") for value in bounds)
    return f"{low} to {high}{unit}"


def zoom_words(facts: ShotFacts) -> str:
    """How far the zoom moved, longest over widest; known even where no focal length is."""
    if facts.zoom_range is None or facts.zoom_range[0] <= 0:
        return ""
    ratio = facts.zoom_range[1] / facts.zoom_range[0]
    return "no zoom" if ratio < 1.002 else f"×{ratio:.3f}"


def seen(run: RunRecord, table: CameraTable) -> str:
    """One sentence: how much picture went in and how much of it has a camera."""
    n = len(table)
    counts = Counter(table.status)
    # By the focal length, not by the status: a bridged frame of a relative shot has none either.
    n_camera = int(np.isfinite(table.f_px).sum())
    n_relative = sum(counts[word] for word in ("ok", "weak", "interpolated", "relative")) - n_camera
    share = f"{100 * n_camera / n:.1f} %" if n else "none"
    words = f"{plural(n, 'frame')} in {plural(len(run.shots), 'shot')}. "
    if not n:
        return words + "Nothing could be measured."
    words += f"{plural(n_camera, 'frame')} ({share}) {'has' if n_camera == 1 else 'have'} a calibrated camera"
    rest = [f"{plural(count, 'frame')} {text}" for count, text in (
        (n_relative, "with zoom and motion only"), (counts["lost"], "lost"),
        (counts["graphic"], "not views of the scene"),
    ) if count]  # fmt: skip
    return words + (f"; {', '.join(rest)}." if rest else ".")


def found(shot: ShotRecord, facts: ShotFacts) -> str:
    """What one shot gave, in a sentence or two."""
    parts = []
    if facts.f_range is not None:
        parts.append(f"focal length {focal_words(facts)}")
    if zoom := zoom_words(facts):
        parts.append("no zoom" if zoom == "no zoom" else f"zoom {zoom}")
    if facts.pan_range_deg is not None:
        parts.append(f"pan {range_words(facts.pan_range_deg, '°')}")
    if facts.tilt_range_deg is not None:
        parts.append(f"tilt {range_words(facts.tilt_range_deg, '°')}")
    if facts.residual_px is not None:
        parts.append(f"median residual {facts.residual_px[0]:.2f} px")
    words = (", ".join(parts) + ".") if parts else "Nothing measured."
    words = words[0].upper() + words[1:]
    if shot.merged_into is not None:
        words += f" Merged into shot {shot.merged_into}: one camera, angles and zoom in that shot's world."
    if shot.status != "ok":
        words += f" {why(shot)}"
    return words


def listed_files(files: Sequence[str]) -> list[tuple[str, str]]:
    """(name, note) for a list: files of a shot as they are; of a folder below, as of tiles, its name and how many."""
    names, inside = [], Counter[str]()
    for name in files:
        parts = name.split("/")
        if len(parts) <= 2:
            names.append((name, ""))
        else:
            inside["/".join(parts[:2]) + "/"] += 1
    return names + [(folder, plural(count, "file")) for folder, count in inside.items()]


def merging(facts: Mapping[str, Any]) -> list[str]:
    """What came of merging shots, a sentence a group and an attempt; nothing where it was not asked for."""
    told = [
        f"Shots {', '.join(str(i) for i in group['shots'])} are one camera: {group['folder']}, held together by "
        f"{plural(group['pairs_across'], 'pair')} of pictures."
        for group in facts.get("groups", ())
    ]
    for attempt in facts.get("attempts", ()):
        if attempt["merged"]:
            told.append(
                f"Shot {attempt['shot']} was merged into shot {attempt['into']}: "
                f"{plural(attempt['pairs_kept'], 'pair')} across, residual {number(attempt['residual_px'], 2)} px "
                f"({number(attempt['residual_own_px'], 2)} px within the shots)."
            )
        elif attempt["into"] < 0:
            told.append(f"Shot {attempt['shot']} was compared with no other. {attempt['sentence']}")
        else:
            told.append(
                f"Shot {attempt['shot']} was not merged into shot {attempt['into']}. {attempt['sentence']}"
            )
    return told


def why(shot: ShotRecord) -> str:
    """Why a shot is not ok: its own sentence, else what its reason code means."""
    text = shot.sentence or reason_words(shot.reason)[0] or "no reason stated"
    text = text[0].upper() + text[1:]
    return text if text.endswith((".", "!")) else text + "."


def reason_words(code: str) -> tuple[str, str]:
    """(what happened, what would help) of a reason code; the code itself, spaced, where no sentence is known."""
    return REASONS.get(code, (code.replace("_", " "), ""))


def troubles(shots: Sequence[ShotRecord], table: CameraTable) -> list[dict[str, str]]:
    """What failed or is doubtful, most frames first: one entry a reason code, with its cure."""
    rows = []
    for code, count in ordered_counts([reason for reason in table.reason if reason]).items():
        at = [i for i, reason in enumerate(table.reason) if reason == code]
        what, cure = reason_words(code)
        statuses = ", ".join(ordered_counts([table.status[i] for i in at], tuple(STATUS_SIGNS)))
        span = (
            f"frames {table.frame[at[0]]} to {table.frame[at[-1]]}"
            if count > 1
            else f"frame {table.frame[at[0]]}"
        )
        rows.append({"code": code, "what": what, "cure": cure, "count": plural(count, "frame"), "span": span,
                     "statuses": statuses})  # fmt: skip
    named = {row["code"] for row in rows}
    for shot in shots:
        if shot.status != "ok" and shot.reason and shot.reason not in named:
            what, cure = reason_words(shot.reason)
            rows.append({"code": shot.reason, "what": shot.sentence or what, "cure": cure,
                         "count": f"shot {shot.index}", "statuses": shot.status,
                         "span": f"frames {shot.first_frame} to {shot.last_frame}"})  # fmt: skip
            named.add(shot.reason)
    return rows
