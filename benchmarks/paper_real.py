"""The paper's three models and `calib.calibrate` on real pictures: homographies of a view to others, no lens model.

    python -m benchmarks.paper_real DATA [--clip clips/soccer_inter_pan_720p.mp4 --reference 380 --focal 2755]

DATA: a folder with the clip and with vgg/boat (pictures with homographies, no known focal). The clip's homographies are
`mosaic.register`'s between the reference frame and frames before and after it, as the paper's were between its
pictures; --focal: of the reference frame, from elsewhere (a fit of the pitch). Prints a Markdown table.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from calib import calibrate, fit_homography, paper
from mosaic import register
from mosaic.coords import transfer

Array = NDArray[np.float64]
STEPS = (-75, -50, -25, 25, 50, 75)  # frames from the reference
CELL_STD_PX = 0.15  # of a flow cell: between frames, and the crowd's own motion (real-footage.md 4)


def clip_homographies(clip: Path, reference: int) -> tuple[Array, Array, tuple[int, int]]:
    """H_k_reference (N, 3, 3), their covariances (N, 9, 9), size; pairs that cannot be registered are left out."""
    wanted = {reference, *(reference + step for step in STEPS)}
    pictures = {}
    with av.open(str(clip)) as source:
        for k, frame in enumerate(source.decode(video=0)):
            if k in wanted:
                pictures[k] = frame.to_ndarray(format="gray")
            if len(pictures) == len(wanted):
                break
    H, cov = [], []
    for k in sorted(wanted - {reference}):
        fit = register(pictures[reference], pictures[k])
        if not fit.usable:
            continue
        src, dst = fit.flow.src_px, fit.flow.dst_px
        # Cells that know both directions, and hold no player.
        known = np.linalg.eigvalsh(fit.flow.info)[:, 0] > 1
        known &= np.hypot(*(transfer(fit.H_dst_src, src) - dst).T) < 2
        found = fit_homography(src[known], dst[known], sigma_px=CELL_STD_PX)
        if not np.isfinite(found.H).all():
            continue
        H.append(found.H)
        cov.append(found.cov)
    height, width = pictures[reference].shape
    return np.array(H), np.array(cov), (width, height)


def boat(folder: Path) -> tuple[Array, tuple[int, int]]:
    """H_k_1 (5, 3, 3) of the boat, as published, and the size."""
    H = []
    for k in range(2, 7):
        storage = cv2.FileStorage(str(folder / f"H1to{k}p.xml"), cv2.FILE_STORAGE_READ)
        H.append(storage.getFirstTopLevelNode().mat())
        storage.release()
    first = cv2.imread(str(folder / "img1.png"))
    if first is None:
        raise FileNotFoundError(folder / "img1.png")
    height, width = first.shape[:2]
    return np.array(H), (width, height)


def rows(name: str, H: Array, cov: Array, size_px: tuple[int, int], focal: float | None) -> list[str]:
    """A row a method: focal and principal point of the reference view, what the method says."""
    found = [
        ("paper, model 1 (fixed pp, aspect 1)", paper.fixed_pp_known_aspect(H, size_px)),
        ("paper, model 2 (fixed pp)", paper.fixed_pp_unknown_aspect(H, size_px)),
        ("paper, model 3 (all vary)", paper.all_vary(H, size_px)),
    ]
    lines = []
    for method, p in found:
        lines.append(_row(name, method, p.alpha[0], p.beta[0], p.pp_px[0], None, p.status, focal))
    ours = calibrate(H, cov, size_px=size_px)
    says = "claimed" if ours.claims_focal else f"not claimed: {ours.reason}"
    lines.append(
        _row(name, "`calibrate`", ours.fx_px[0], ours.fy_px[0], ours.pp_px[0], ours.sigma_log_f, says, focal)
    )
    return lines


def _row(
    name: str, method: str, fx: float, fy: float, pp: Array, sigma: float | None, says: str, focal: float | None
) -> str:  # fmt: skip
    error = "-" if focal is None or not np.isfinite(fx) else f"{100 * (fx / focal - 1):+.0f} %"
    stated = "-" if sigma is None else f"{100 * sigma:.1f} %"
    return (
        f"| {name} | {method} | {fx:.0f}, {fy:.0f} | {pp[0]:.0f}, {pp[1]:.0f} | {error} | {stated} | {says} |"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--clip", default="clips/soccer_inter_pan_720p.mp4")
    parser.add_argument("--reference", type=int, default=380)
    parser.add_argument("--focal", type=float, default=2755.0)
    arguments = parser.parse_args()
    print(
        "| pictures | method | fx, fy px | principal point | error | stated | says |\n|---|---|---|---|---|---|---|"
    )
    H, cov, size_px = clip_homographies(arguments.data / arguments.clip, arguments.reference)
    name = f"{Path(arguments.clip).stem}, {len(H)} pairs with frame {arguments.reference}"
    print("\n".join(rows(name, H, cov, size_px, arguments.focal)))
    H, size_px = boat(arguments.data / "vgg" / "boat")
    # Published to about a pixel, without a covariance: that of points all over the picture, a pixel each.
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 6) for n in size_px)), -1).reshape(-1, 2)
    cov = np.array([fit_homography(grid, transfer(h, grid), sigma_px=1.0).cov for h in H])
    print("\n".join(rows("vgg boat (zoom and roll)", H, cov, size_px, None)))


if __name__ == "__main__":
    main()
