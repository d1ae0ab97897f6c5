"""Registration of a real clip against itself: there and back, and over two steps against one. No truth is needed.

    python -m benchmarks.registration.consistency CLIP [--gaps 1 5 12] [--triples 8] [--top 0.45]

Triples of frames (a, b, c), equally far apart and spread over the clip: |H_a_b H_b_a x - x| and |H_c_a x - H_c_b H_b_a
x|, px, over a grid of the picture's part below `top` (the pitch) that all three frames show. Eight parameters and no
lens: what a lens does to a homography is in the second figure.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np

from mosaic.coords import transfer
from mosaic.pair import register


def read_frames(path: Path, wanted: set[int]) -> dict[int, np.ndarray]:
    """Y planes (h, w) uint8 of the wanted frames, counted as they decode."""
    found = {}
    with av.open(str(path)) as container:
        for index, frame in enumerate(container.decode(video=0)):
            if index in wanted:
                found[index] = frame.to_ndarray()[: frame.height, : frame.width].copy()
            if index >= max(wanted):
                break
    return found


def n_frames_of(path: Path) -> int:
    """Frames that decode; headers lie about it."""
    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


def distances(a: np.ndarray, b: np.ndarray, c: np.ndarray, top: float) -> tuple[np.ndarray, np.ndarray, int]:
    """(there and back, skip) px over the grid, and how many of the four registrations failed."""
    h, w = a.shape
    x, y = np.meshgrid(np.linspace(20, w - 21, 24), np.linspace(top * h, h - 21, 10))
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    fits = {
        name: register(*pictures)
        for name, pictures in {"ba": (a, b), "ab": (b, a), "cb": (b, c), "ca": (a, c)}.items()
    }
    failed = sum(not fit.usable for fit in fits.values())
    H = {name: fit.H_dst_src for name, fit in fits.items()}
    in_b = transfer(H["ba"], points)
    inside = np.isfinite(in_b).all(axis=1) & (in_b > 0).all(axis=1) & (in_b < [w, h]).all(axis=1)
    back = np.linalg.norm(transfer(H["ab"], in_b) - points, axis=1)[inside]
    direct, chained = transfer(H["ca"], points), transfer(H["cb"], in_b)
    seen = inside & np.isfinite(direct).all(axis=1) & (direct > 0).all(axis=1) & (direct < [w, h]).all(axis=1)
    return back, np.linalg.norm(direct - chained, axis=1)[seen], failed


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clip", type=Path)
    parser.add_argument("--gaps", type=int, nargs="+", default=[1, 5, 12])
    parser.add_argument("--triples", type=int, default=8)
    parser.add_argument("--top", type=float, default=0.45)
    arguments = parser.parse_args(argv)
    n = n_frames_of(arguments.clip)
    starts = np.linspace(0, n - 1 - 2 * max(arguments.gaps), arguments.triples).astype(int)
    frames = read_frames(
        arguments.clip, {int(s) + k * g for s in starts for g in arguments.gaps for k in range(3)}
    )
    print(
        "| clip | gap | triples | failed of four each | there and back: median, 95 % | skip: median, 95 % |"
    )
    print("|---|---|---|---|---|---|")
    for gap in arguments.gaps:
        there, skip, failed = [], [], 0
        for s in starts:
            back, over, bad = distances(*(frames[int(s) + k * gap] for k in range(3)), arguments.top)
            failed += bad
            if not bad:
                there.append(back)
                skip.append(over)
        cells = [
            f"{np.median(v):.3g}, {np.quantile(v, 0.95):.3g}" if len(v) else "-"
            for v in (np.concatenate(d) if d else np.zeros(0) for d in (there, skip))
        ]
        print(
            f"| {arguments.clip.stem} | {gap} | {len(starts)} | {failed} | {cells[0]} | {cells[1]} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
