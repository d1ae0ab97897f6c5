"""Answers of a run as Markdown tables and a plot."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.registration.peers import ALL, VIDEO
from benchmarks.registration.scenes import PHOTOGRAPHS

FAILED_PX = 2.0
Row = dict[str, Any]


def _errors(rows: list[Row], method: str) -> np.ndarray:
    """Corner errors (n,) of a method, px; inf where it gave nothing."""
    found = [r["answers"][method] for r in rows if method in r["answers"]]
    return np.array([np.inf if a["error_px"] is None else a["error_px"] for a in found])


def _shown(value: float) -> str:
    return "-" if np.isnan(value) else "lost" if not np.isfinite(value) or value > 99 else f"{value:.3g}"


def _median(rows: list[Row], method: str) -> float:
    errors = _errors(rows, method)
    return float(np.median(errors)) if len(errors) else float("nan")


def _high(errors: np.ndarray) -> float:
    """The 95th percentile as one of the values: nothing is interpolated towards a lost pair."""
    return float(np.quantile(errors, 0.95, method="higher"))


def _undetected(rows: list[Row], method: str) -> int:
    """Answers that the method accepts and that are wrong."""
    answers = [r["answers"][method] for r in rows if method in r["answers"]]
    return sum(1 for a in answers if a["accepted"] and (a["error_px"] is None or a["error_px"] > FAILED_PX))


def cells_table(rows: list[Row]) -> list[str]:
    """A line per cell: ours in full, the peers' medians on the pairs that they took part in."""
    methods = [m for m in ALL if any(m in r["answers"] for r in rows)]
    others = [m for m in methods if m not in ("mosaic", VIDEO)]
    lines = [
        "| picture | condition | gap | pairs | mosaic median | 95 % | failed | undetected | "
        + " | ".join(others)
        + " |",
        "|" + "---|" * (8 + len(others)),
    ]
    for (size, condition, gap), cell in grouped(rows).items():
        errors = _errors(cell, "mosaic")
        lines.append(
            f"| {size} | {condition} | {gap} | {len(cell)} | {_shown(float(np.median(errors)))} "
            f"| {_shown(_high(errors))} "
            f"| {int((errors > FAILED_PX).sum())} | {_undetected(cell, 'mosaic')} | "
            + " | ".join(_shown(_median(cell, m)) for m in others)
            + " |"
        )
    return lines


def grouped(rows: list[Row]) -> dict[tuple[str, str, int], list[Row]]:
    """Rows by (size, condition, gap), photographs apart, in the order of first appearance."""
    cells: dict[tuple[str, str, int], list[Row]] = defaultdict(list)
    for row in rows:
        picture = row["size"] + (" photograph" if row["kind"] in PHOTOGRAPHS else "")
        cells[picture, row["condition"], row["gap"]].append(row)
    return cells


def against_peers(rows: list[Row]) -> list[str]:
    """Per peer: cells where ours has the lower median on common pairs, and the worst ratio."""
    lines = ["| peer | cells | ours is lower | worst ours / peer | where |", "|---|---|---|---|---|"]
    for peer in ALL:
        if peer in ("mosaic", VIDEO):
            continue
        ratios = {}
        for key, cell in grouped(rows).items():
            common = [r for r in cell if peer in r["answers"]]
            if common:
                mine, theirs = _median(common, "mosaic"), _median(common, peer)
                ratios[key] = (
                    np.inf
                    if np.isinf(mine) and np.isfinite(theirs)
                    else 0.0
                    if np.isinf(theirs)
                    else mine / theirs
                )
        if ratios:
            worst = max(ratios, key=lambda k: ratios[k])
            lower = sum(1 for v in ratios.values() if v <= 1.0)
            lines.append(
                f"| {peer} | {len(ratios)} | {lower} ({100 * lower / len(ratios):.0f} %) | {_shown(ratios[worst])} | "
                f"{worst[0]}, {worst[1]}, {worst[2]} |"
            )
    return lines


def verdict_table(rows: list[Row]) -> list[str]:
    """Per method over all its pairs: failures, undetected ones, times."""
    lines = [
        "| method | pairs | median px | 95 % px | failed % | undetected % "
        "| CPU ms 1080p | wall ms 1080p | CPU ms 720p |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for method in ALL:
        mine = [r for r in rows if method in r["answers"]]
        if not mine:
            continue
        errors = _errors(mine, method)
        times = {
            (size, what): [r["answers"][method][what] for r in mine if r["size"] == size]
            for size in ("1080p", "720p")
            for what in ("cpu_ms", "wall_ms")
        }
        cells = [
            f"{np.median(t):.3g}" if t else "-"
            for t in (times["1080p", "cpu_ms"], times["1080p", "wall_ms"], times["720p", "cpu_ms"])
        ]
        lines.append(
            f"| {method} | {len(mine)} | {_shown(float(np.median(errors)))} | {_shown(_high(errors))} "
            f"| {100 * np.mean(errors > FAILED_PX):.1f} | {100 * _undetected(mine, method) / len(mine):.2f} | "
            + " | ".join(cells) + " |"
        )  # fmt: skip
    return lines


def plot(rows: list[Row], path: Path) -> None:
    """Median corner error over the gap, a panel per condition, log scale from .001 to 10 px, as SVG."""
    shown = {
        "mosaic": "#0b6e4f",
        "KLT + MAGSAC, refitted": "#c44536",
        "DIS + MAGSAC": "#7a6f9b",
        "SIFT + MAGSAC": "#3d5a80",
        "ECC multi-scale": "#b08900",
    }
    conditions = list(dict.fromkeys(r["condition"] for r in rows))
    gaps = sorted({r["gap"] for r in rows})
    columns, width, height = 4, 220, 170
    n_rows = -(-len(conditions) // columns)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {columns * width} {n_rows * height + 30}" '
        'font-family="sans-serif" font-size="10"><rect width="100%" height="100%" fill="white"/>'
    ]

    def y_of(error: float) -> float:
        return 120 - 105 * (np.log10(np.clip(error, 1e-3, 10.0)) + 3) / 4

    for k, condition in enumerate(conditions):
        parts.append(f'<g transform="translate({k % columns * width + 34},{k // columns * height + 22})">')
        parts.append(f'<text x="0" y="-6" font-weight="bold">{condition}</text>')
        for decade in (-3, -2, -1, 0, 1):
            y = y_of(10.0**decade)
            parts.append(
                f'<path d="M0 {y:.1f}H170" stroke="#ddd"/>'
                f'<text x="-4" y="{y + 3:.1f}" text-anchor="end">{10.0**decade:g}</text>'
            )
        for i, gap in enumerate(gaps):
            parts.append(
                f'<text x="{10 + i * 150 / max(len(gaps) - 1, 1):.1f}" y="134" text-anchor="middle">{gap}</text>'
            )
        cell = [r for r in rows if r["condition"] == condition]
        for method, colour in shown.items():
            points = []
            for i, gap in enumerate(gaps):
                value = _median([r for r in cell if r["gap"] == gap], method)
                if not np.isnan(value):
                    points.append((10 + i * 150 / max(len(gaps) - 1, 1), y_of(value)))
            if points:
                line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
                parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
                parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="{colour}"/>' for x, y in points]
        parts.append("</g>")
    x = 34
    for method, colour in shown.items():
        parts.append(
            f'<text x="{x}" y="{n_rows * height + 18}" fill="{colour}" font-weight="bold">{method}</text>'
        )
        x += 40 + 6 * len(method)
    path.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def write_tables(source: Path, out: Path | None, picture: Path | None) -> None:
    """All tables of a run's file to `out` or the terminal, the plot to `picture`."""
    lines = source.read_text(encoding="utf-8").splitlines()
    rows = list({row["key"]: row for row in map(json.loads, lines)}.values())
    order = list(dict.fromkeys(r["condition"] for r in rows))
    rows = sorted(
        rows,
        key=lambda r: (r["size"] != "1080p", r["kind"] in PHOTOGRAPHS, order.index(r["condition"]), r["gap"]),
    )
    text = "\n".join([*verdict_table(rows), "", *against_peers(rows), "", *cells_table(rows), ""])
    if out is None:
        print(text)
    else:
        out.write_text(text, encoding="utf-8")
    if picture is not None:
        plot(rows, picture)
