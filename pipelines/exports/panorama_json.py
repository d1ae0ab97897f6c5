"""panorama.json: where every pixel of the panorama looks, so that anybody can go from pixel to ray and back."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from mosaic.composite import Panorama
from mosaic.surface import Surface
from mosaic.vignetting import corner, log_falloff
from pipelines.exports.whole_file import whole_file

FORMULAS = {
    "equirectangular": "x = cx + s lon, y = cy - s lat",
    "cylindrical": "x = cx + s lon, y = cy - s tan(lat)",
    "planar": "x = cx + s X / Z, y = cy + s Y / Z",
    "pannini": "x = cx + s q sin(lon), y = cy - s q tan(lat), q = 2 / (1 + cos(lon))",
}
FALLOFF = "v(r) = exp(a r^2 + b r^4), r from the frame's middle in half widths; frames are divided by it"
RAY = "(X, Y, Z) = (cos lat sin lon, -sin lat, cos lat cos lon); x right, y down, z forward"


def panorama_facts(
    panorama: Panorama, *, world: str, parallax: dict[str, Any] | None = None
) -> dict[str, Any]:
    """JSON-ready: projection, size_px, scale_px_per_rad, centre_px, formula, world, parallax, frames, gains_rgb,
    falloff, cover.

    world: what the axes are ('reference camera' or 'levelled: y along the pan axis'). parallax: of the pupil, in these
    axes; None: rays are what every frame sees.
    """
    surface, seen = panorama.surface, panorama.alpha > 0
    counts = panorama.n_seen[seen]
    return {
        "format": "broadcast-mosaic panorama 1",
        "projection": surface.kind,
        "size_px": [surface.width, surface.height],
        "scale_px_per_rad": surface.scale_px,
        "centre_px": [surface.cx, surface.cy],
        "pixel_origin": "centre of the top-left pixel is (0, 0)",
        "formula": FORMULAS[surface.kind],
        "ray": RAY,
        "world": world,
        "parallax": parallax,
        "frames": [int(k) for k in panorama.frames],
        "gains_rgb": [[round(float(g), 6) for g in row] for row in panorama.gains],
        "falloff": falloff_facts(panorama),
        "cover": float(seen.mean()),
        "views_median": float(np.median(counts)) if counts.size else 0.0,
        "spread_grey_median": float(np.median(panorama.spread[seen])) if counts.size else 0.0,
    }


def falloff_facts(panorama: Panorama) -> dict[str, Any] | None:
    """The lens's falloff of light and what it leaves in a frame's corner; None where none was found."""
    if not panorama.falloff.any():
        return None
    size_px = panorama.placements[panorama.frames[0]].size_px
    a, b = (round(float(value), 6) for value in panorama.falloff)
    left = float(np.exp(log_falloff(panorama.falloff, corner(size_px))))
    return {"formula": FALLOFF, "a": a, "b": b, "corner": round(left, 4)}


def write_panorama_json(
    panorama: Panorama,
    path: str | os.PathLike[str],
    *,
    world: str = "reference camera",
    parallax: dict[str, Any] | None = None,
) -> None:
    """Write panorama.json whole or not at all. Raises OSError when the folder cannot be written."""
    with whole_file(path) as temporary:
        text = json.dumps(panorama_facts(panorama, world=world, parallax=parallax), indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def read_surface(path: str | os.PathLike[str]) -> Surface:
    """The Surface that a panorama.json states. Raises ValueError when it is not one of ours."""
    facts = json.loads(Path(path).read_text(encoding="utf-8"))
    if not str(facts.get("format", "")).startswith("broadcast-mosaic panorama"):
        raise ValueError(f"{path} is not a panorama.json of broadcast-mosaic")
    (cx, cy), (width, height) = facts["centre_px"], facts["size_px"]
    return Surface(
        kind=facts["projection"], scale_px=facts["scale_px_per_rad"], cx=cx, cy=cy, width=width, height=height
    )
