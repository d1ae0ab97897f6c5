"""What a clip is, from its header and its first two pictures. Nothing is registered."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.config import DecodeOptions
from pipelines.decode import open_clip

NEEDS_REGISTRATION = "found by registering the frames to each other: `run` does it"


def probe(path: str | Path, options: DecodeOptions | None = None) -> dict[str, Any]:
    """The facts of a clip, JSON-ready; `shots` and `overlays` say that they are not estimated, and why.

    Raises InputError as `open_clip` does, and for a clip of one picture.
    """
    with open_clip(path, options) as clip:
        for _ in clip.frames(0, 2):
            pass
        facts = clip.facts.as_dict()
    not_known = {"estimated": False, "reason": NEEDS_REGISTRATION}
    return {**facts, "shots": not_known, "overlays": not_known}


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
    colour = facts["colour"]
    lines = [
        ("file", f"{facts['path']} ({facts['size_bytes'] / 1e6:.1f} MB, {facts['container']})"),
        ("picture", f"{w}x{h} ({shape})" + (f", turned by {facts['rotation_deg']}°" if facts["rotation_deg"] else "")),
        ("codec", f"{facts['codec']}, {facts['pix_fmt']}, {facts['bit_depth']} bits"),
        ("rate", rate),
        ("length", _length(facts)),
        ("scan", f"interlaced; deinterlacing: {facts['deinterlace']}" if facts["interlaced"] else "progressive"),
        ("colour", f"matrix {colour['space']}, range {colour['range']}, primaries {colour['primaries']}, transfer "
                   f"{colour['transfer']} (2 = not tagged); RGB by {colour['rgb_matrix']}"),
        ("timecode", facts["timecode"] or "none"),
        ("shots", f"not estimated: {facts['shots']['reason']}"),
        ("overlays", f"not estimated: {facts['overlays']['reason']}"),
        *(("note", warning) for warning in facts["warnings"]),
    ]  # fmt: skip
    return "\n".join(f"{name:<9} {value}" for name, value in lines)


def _length(facts: Mapping[str, Any]) -> str:
    seconds, frames = facts["duration_s"], facts["n_frames_header"]
    parts = [
        f"{seconds:.2f} s" if seconds is not None else "",
        f"{frames} frames" if frames is not None else "",
    ]
    said = ", ".join(part for part in parts if part)
    return f"{said} by its header, which may be wrong" if said else "not stated"
