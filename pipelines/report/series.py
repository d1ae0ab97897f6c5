"""Columns of the camera table thinned for drawing: at most MAX_POINTS rows, each a true row of camera.csv.

No average is drawn. Per bucket of rows the smallest and the largest value of every curve are kept, and both sides of
every change of shot, status or emptiness, so that extremes and gaps look as they would with all rows.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.records import CameraTable

MAX_POINTS = 20_000  # rows in the page: 1 MB of JSON, and more than any screen is wide
CURVES = ("f_px", "zoom_ratio", "pan_deg", "tilt_deg", "roll_deg", "residual_px")
BESIDE = ("f_std_px", "zoom_ratio_std", "overlap", "pts_s")  # shown with a row, not thinned by
DIGITS = 7  # significant digits in the page: 1e-3 px of a focal length


def drawn_rows(table: CameraTable, max_points: int = MAX_POINTS) -> NDArray[np.int64]:
    """Rows to draw, ascending, at most max_points of them (all when they fit)."""
    n = len(table)
    if n <= max_points:
        return np.arange(n)
    values = np.stack([getattr(table, name) for name in CURVES])
    edges = changes(table, values)
    # A table that changes all the time would use up the points on its edges alone: these then are thinned evenly.
    if len(edges) > max_points // 2:
        edges = edges[np.linspace(0, len(edges) - 1, max_points // 2).astype(np.int64)]
    n_buckets = max(1, (max_points - len(edges)) // (2 * len(CURVES)))
    bounds = np.linspace(0, n, n_buckets + 1).astype(np.int64)
    # +-inf in place of an empty cell: reduceat then ignores it; a bucket of empty cells keeps its first row.
    keep = [edges]
    for column in values:
        for fill, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            filled = np.where(np.isfinite(column), column, fill)
            keep.append(np.array([a + pick(filled[a:b]) for a, b in pairwise(bounds) if b > a]))
    return np.unique(np.concatenate(keep)).astype(np.int64)


def changes(table: CameraTable, values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Both rows at every change of shot, status or of which curves are empty; first and last row too."""
    n = len(table)
    _, status = np.unique(np.array(table.status), return_inverse=True)
    state = np.vstack([table.shot, status, np.isfinite(values)])
    after = 1 + np.flatnonzero((state[:, 1:] != state[:, :-1]).any(axis=0))
    return np.unique(np.concatenate([[0], after - 1, after, [n - 1]])).astype(np.int64)


def runs(table: CameraTable) -> list[list[int]]:
    """The status strip, exact: [first row, n rows, status word's place in the words, reason's place, shot] per run."""
    n = len(table)
    if n == 0:
        return []
    _, status = np.unique(np.array(table.status), return_inverse=True)
    _, reason = np.unique(np.array(table.reason), return_inverse=True)
    words, reasons = sorted(set(table.status)), sorted(set(table.reason))
    state = np.vstack([table.shot, status, reason])
    first = np.concatenate([[0], 1 + np.flatnonzero((state[:, 1:] != state[:, :-1]).any(axis=0))])
    length = np.diff(np.concatenate([first, [n]]))
    word_at = {word: i for i, word in enumerate(words)}
    reason_at = {word: i for i, word in enumerate(reasons)}
    return [
        [int(i), int(m), word_at[table.status[i]], reason_at[table.reason[i]], int(table.shot[i])]
        for i, m in zip(first, length, strict=True)
    ]


def column_json(values: NDArray[np.float64]) -> list[float | None]:
    """Floats of DIGITS significant digits, None for an empty cell."""
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values.tolist()]


def series_json(table: CameraTable, max_points: int = MAX_POINTS) -> dict[str, Any]:
    """Everything that the page's charts read: drawn rows by column, and the exact strip of runs."""
    rows = drawn_rows(table, max_points)
    timecodes = [table.timecode[i] for i in rows]
    return {
        "n_rows": len(table),
        "row": rows.tolist(),
        "frame": table.frame[rows].tolist(),
        "shot": table.shot[rows].tolist(),
        "columns": {name: column_json(getattr(table, name)[rows]) for name in (*CURVES, *BESIDE)},
        "timecode": timecodes if any(timecodes) else [],
        "runs": runs(table),
        "statuses": sorted(set(table.status)),
        "reasons": sorted(set(table.reason)),
    }
