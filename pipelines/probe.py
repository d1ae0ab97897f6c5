"""What a clip is, from its header and its first two pictures; its shots and fixed graphics from a cheap first pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.config import Config
from pipelines.decode import open_clip
from pipelines.progress import Progress, silent

# Code points of ITU-T H.273, as FFmpeg's tags have them.
UNTAGGED = 2
_COMMON = {
    1: "BT.709",
    UNTAGGED: "not tagged",
    5: "BT.601 (625 lines)",
    6: "BT.601 (525 lines)",
    7: "SMPTE 240M",
}
MATRICES = {**_COMMON, 0: "RGB", 9: "BT.2020", 10: "BT.2020 constant luminance"}
PRIMARIES = {**_COMMON, 9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}
TRANSFERS = {1: "BT.709", UNTAGGED: "not tagged", 4: "gamma 2.2", 5: "gamma 2.8", 6: "BT.601", 7: "SMPTE 240M",
             8: "linear", 13: "sRGB", 14: "BT.2020", 15: "BT.2020", 16: "PQ", 18: "HLG"}  # fmt: skip
RANGES = {1: "limited range", 2: "full range"}
SECONDS = 60.0  # of the clip that are looked at; about as long as that takes on two slow cores at 1080p
NOT_ASKED = "not_looked_for"
REASONS = {
    NOT_ASKED: "not looked for (--no-shots)",
    "switched_off": "switched off (overlays.enabled)",
    "camera_moved_too_little": "the camera moved too little to tell graphics from the scene",
    "too_much_looks_fixed": "so much looks fixed that the camera has hardly moved",
}


def probe(
    path: str | Path,
    config: Config | None = None,
    *,
    shots: bool = True,
    seconds: float | None = SECONDS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The facts of a clip, JSON-ready: ClipFacts.as_dict() with `shots` and `overlays`, whose keys are always there.

    shots, overlays: estimated (bool), reason ('' or a code of REASONS) and what was found. shots: list of first_frame,
    last_frame, n_frames, start_s, end_s, ended_by ('cut', 'fade', 'transition', 'lost' registration, 'end', or 'limit'
    of what was looked at), motion_px_per_frame (median, or None); n_frames, n_frames_in_no_shot, complete (the clip's
    end was reached), seconds. overlays: as OverlayFinder.facts. `shots` off: only header and two pictures are read.
    seconds: None looks at the whole clip.
    Raises InputError as `open_clip` does, and for a clip of one picture.
    """
    config = config or Config()
    with open_clip(path, config.decode) as clip:
        for _ in clip.frames(0, 2):
            pass
        if shots:
            from pipelines.first_look import look_at

            found = look_at(clip, config, seconds=seconds, progress=progress)
        else:
            found = _not_looked_for()
        return {**clip.facts.as_dict(), **found}


def _not_looked_for() -> dict[str, Any]:
    nothing = {"estimated": False, "reason": NOT_ASKED}
    return {
        "shots": {
            **nothing,
            "seconds": 0.0,
            "complete": False,
            "n_frames": 0,
            "n_frames_in_no_shot": 0,
            "list": [],
        },
        "overlays": {**nothing, "samples": 0, "graphics": [], "bars": {}, "masked_share": None},
    }


def probe_text(facts: Mapping[str, Any]) -> str:
    """The same for people, a line a fact."""
    w, h = facts["size_px"]
    aspect = facts["pixel_aspect"]
    divisor = math.gcd(w, h)
    shape = (
        f"{w // divisor}:{h // divisor}"
        if aspect == 1
        else f"pixels {aspect:.4g} wide, seen {w * aspect / h:.3f}:1"
    )
    fps = facts["fps"]
    rate = "not stated" if fps is None else f"{fps:.6g} frames/s"
    if fps is not None and facts["picture_fps"] != fps:
        rate += f", {facts['picture_fps']:.6g} pictures/s"
    lines = [
        ("file", f"{facts['path']} ({facts['size_bytes'] / 1e6:.1f} MB, {facts['container']})"),
        ("picture", f"{w}x{h} ({shape})" + (f", turned by {facts['rotation_deg']}°" if facts["rotation_deg"] else "")),
        ("codec", f"{facts['codec']}, {facts['pix_fmt']}, {facts['bit_depth']} bits"),
        ("rate", rate),
        ("length", _length(facts)),
        ("scan", f"interlaced; deinterlacing: {facts['deinterlace']}" if facts["interlaced"] else "progressive"),
        ("colour", colour_words(facts["colour"])),
        ("timecode", facts["timecode"] or "none"),
        *_shot_lines(facts["shots"]),
        ("overlays", _overlays(facts["overlays"])),
        *(("note", warning) for warning in facts["warnings"]),
    ]  # fmt: skip
    return "\n".join(f"{name:<9} {value}" for name, value in lines)


def colour_words(colour: Mapping[str, Any]) -> str:
    """'BT.709, limited range' of a clip's tags; each by itself where they differ, and what is assumed for none."""
    tags = {
        "matrix": MATRICES.get(colour["space"], f"code {colour['space']}"),
        "primaries": PRIMARIES.get(colour["primaries"], f"code {colour['primaries']}"),
        "transfer": TRANSFERS.get(colour["transfer"], f"code {colour['transfer']}"),
    }
    alike = len(set(tags.values())) == 1
    said = next(iter(tags.values())) if alike else ", ".join(f"{name} {word}" for name, word in tags.items())
    said += f", {RANGES.get(colour['range'], 'range not tagged')}"
    return said if colour["space"] != UNTAGGED else f"{said}; RGB as by {colour['rgb_matrix']}"


def _length(facts: Mapping[str, Any]) -> str:
    seconds, frames = facts["duration_s"], facts["n_frames_header"]
    parts = [
        f"{seconds:.2f} s" if seconds is not None else "",
        f"{frames} frames" if frames is not None else "",
    ]
    said = ", ".join(part for part in parts if part)
    return f"{said} by its header, which may be wrong" if said else "not stated"


def _shot_lines(shots: Mapping[str, Any]) -> list[tuple[str, str]]:
    if not shots["estimated"]:
        return [("shots", REASONS[shots["reason"]])]
    found = shots["list"]
    looked = "" if shots["complete"] else f" in the first {shots['seconds']:g} s"
    left = shots["n_frames_in_no_shot"]
    head = f"{len(found)}{looked}, by a quick look" + (f"; {left} pictures in none" if left else "")
    ends = {
        "cut": "then a cut",
        "fade": "then a fade",
        "transition": "then a dissolve, wipe or graphic",
        "lost": "then registration is lost",
        "end": "then the end",
        "limit": "and on",
    }
    lines = [("shots", head)]
    for number, shot in enumerate(found):
        motion = shot["motion_px_per_frame"]
        moves = "" if motion is None else f", moves {motion:.1f} px/frame"
        lines.append(
            (
                f"  {number}",
                f"{shot['start_s']:.2f} to {shot['end_s']:.2f} s, frames {shot['first_frame']} to "
                f"{shot['last_frame']}{moves}, {ends[shot['ended_by']]}",
            )
        )
    return lines


def _overlays(overlays: Mapping[str, Any]) -> str:
    parts = [f"{box['w']}x{box['h']} at {box['x']},{box['y']}" for box in overlays["graphics"]]
    bars = [f"{length} px {side}" for side, length in overlays["bars"].items() if length]
    if bars:
        parts.append(f"bars {', '.join(bars)}")
    if not overlays["estimated"]:
        parts.append(REASONS[overlays["reason"]])
    return "; ".join(parts) or "none found"
