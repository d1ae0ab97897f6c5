"""The registration graph of a shot as a drawing: keyframes on a line of time, an arc for every pair that was aligned.

From OUT/shot-NNN/pairs.npz. Solid arcs carry a measurement, dashed ones a weak one, dotted ones were refused; a stretch
without arcs is where a shot hangs together only by its neighbours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

MAX_ARCS = 500  # drawn; more are a grey area, and 60 bytes each
WIDTH, HEIGHT, MARGIN = 1000, 130, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphDrawing:
    """An inline SVG of any width, what it shows in words, and the frames at its two ends."""

    svg: Markup
    words: str
    frames: tuple[int, int]


def registration_graph(path: Path, keyframes: Sequence[int]) -> GraphDrawing | None:
    """The pairs between keyframes; None where there is no file, no keyframe or no such pair."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            src, dst, status = stored["src"], stored["dst"], stored["status"]
    except (OSError, KeyError, ValueError):
        return None
    keys = np.unique(np.asarray(list(keyframes), np.int64))
    between = np.isin(src, keys) & np.isin(dst, keys)
    if len(keys) < 2 or not between.any():
        return None
    src, dst, status = src[between], dst[between], status[between]
    counts = Counter(str(s) for s in status)
    every = np.unique(np.linspace(0, len(src) - 1, min(len(src), MAX_ARCS)).round().astype(int))
    first, last = int(keys[0]), int(keys[-1])
    scale = (WIDTH - 2 * MARGIN) / max(last - first, 1)
    longest = int(np.abs(dst - src).max())
    base = HEIGHT - 7

    def x(frame: int) -> float:
        return round(MARGIN + (frame - first) * scale, 1)

    arcs = []
    for i in every.tolist():
        a, b = sorted((int(src[i]), int(dst[i])))
        # Height by the root of the span: neighbours stay visible beside a pair across the whole shot.
        top = round(base - (base - 6) * 4 / 3 * ((b - a) / longest) ** 0.5, 1)
        arcs.append(
            f'<path class="g-{_class(str(status[i]))}" d="M{x(a)} {base}C{x(a)} {top} {x(b)} {top} {x(b)} {base}"/>'
        )
    ticks = [f'<line x1="{x(k)}" y1="{base}" x2="{x(k)}" y2="{base + 5}"/>' for k in keys.tolist()]
    drawn = "" if len(every) == len(src) else f"; {len(every)} of them drawn"
    words = (
        f"{len(src)} pairs between {len(keys)} keyframes: "
        + ", ".join(f"{n} {word}" for word, n in sorted(counts.items(), key=lambda item: -item[1]))
        + drawn
    )
    svg = (
        f'<svg class="graph" viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none" role="img" aria-label="{words}">'
        f'<line class="g-axis" x1="{MARGIN}" y1="{base}" x2="{WIDTH - MARGIN}" y2="{base}"/>'
        f"{''.join(arcs)}{''.join(ticks)}</svg>"
    )
    return GraphDrawing(svg=Markup(svg), words=words, frames=(first, last))


def _class(status: str) -> str:
    return status if status in ("ok", "weak") else "failed"
