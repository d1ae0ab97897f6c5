"""The torch / kornia kernel: the same functions as `kernel_numba`, as the readable reference and for other devices.

Takes and gives numpy arrays, so that the estimator is written once; the arithmetic is torch in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from kornia.filters import spatial_gradient
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from mosaic.photometric import NORMAL_QUANTILE, SCALE_QUANTILE, TUKEY, TUKEY_VARIANCE

FloatArray = NDArray[np.float64]


def _image(level: NDArray[np.generic]) -> torch.Tensor:
    return torch.from_numpy(np.asarray(level, np.float64))[None, None]


def _at_level(dst: torch.Tensor, sx: float, sy: float) -> tuple[torch.Tensor, torch.Tensor]:
    return (dst[:, 0] - 0.5 * (sx - 1.0)) / sx, (dst[:, 1] - 0.5 * (sy - 1.0)) / sy


def _bilinear(stack: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Channels (c, n) of stack (1, c, h, w) at level pixels; align_corners: pixel 0 is -1, pixel w - 1 is +1."""
    h, w = stack.shape[-2:]
    grid = torch.stack([2.0 * x / (w - 1) - 1.0, 2.0 * y / (h - 1) - 1.0], dim=-1)[None, None]
    return grid_sample(stack, grid, mode="bilinear", padding_mode="zeros", align_corners=True)[0, :, 0]


def _cubic(t: torch.Tensor) -> torch.Tensor:
    """Weights (n, 4) of the pixels at -1, 0, 1, 2 for values at t (n,): cubic convolution with a = -1/2 (Keys 1981)."""
    t2, t3 = t * t, t * t * t
    return 0.5 * torch.stack([2 * t2 - t3 - t, 3 * t3 - 5 * t2 + 2, 4 * t2 - 3 * t3 + t, t3 - t2], dim=-1)


def _bicubic(image: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Values (n,) of a picture (h, w) at level pixels at least one inside its border (torch's own has a = -3/4)."""
    ix, iy = x.floor().long(), y.floor().long()
    near = torch.arange(-1, 3)
    patches = image[iy[:, None, None] + near[:, None], ix[:, None, None] + near]
    return torch.einsum("nr,nrc,nc->n", _cubic(y - iy), patches, _cubic(x - ix))


def _usable(dst: torch.Tensor, mask: NDArray[np.uint8], sx: float, sy: float, use_mask: bool) -> torch.Tensor:
    if not use_mask:
        return torch.ones(len(dst), dtype=torch.bool)
    m = torch.from_numpy(mask > 0)
    finite = torch.nan_to_num(dst, nan=0.0)
    x = ((finite[:, 0] + 0.5) / sx).long().clamp(0, m.shape[1] - 1)
    y = ((finite[:, 1] + 0.5) / sy).long().clamp(0, m.shape[0] - 1)
    return m[y, x]


def _inside(x: torch.Tensor, y: torch.Tensor, level: NDArray[np.generic], margin: int) -> torch.Tensor:
    h, w = level.shape
    return (x >= margin) & (y >= margin) & (x < w - margin - 1) & (y < h - margin - 1)


def sample(
    level: NDArray[np.generic], sx: float, sy: float, dst: FloatArray, *masks: Any
) -> NDArray[np.float32]:
    """See kernel_numba.sample."""
    points = torch.from_numpy(dst)
    x, y = _at_level(points, sx, sy)
    good = _inside(x, y, level, 1) & _usable(points, *masks)
    values = _bilinear(_image(level), torch.nan_to_num(x), torch.nan_to_num(y))[0]
    return torch.where(good, values, torch.nan).numpy().astype(np.float32)


def linearise(
    level: NDArray[np.generic],
    sx: float,
    sy: float,
    dst: FloatArray,
    A: FloatArray,
    values: NDArray[np.float32],
    gradients: NDArray[np.float32],
    gain: float,
    offset: float,
    *masks: Any,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See kernel_numba.linearise: residuals (n,) and ESM gradients (n, 2)."""
    points = torch.from_numpy(dst)
    x, y = _at_level(points, sx, sy)
    derivative = torch.from_numpy(A)
    det = torch.linalg.det(derivative)
    good = _inside(x, y, level, 2) & _usable(points, *masks) & (det.abs() >= 1e-12)
    image = _image(level)
    stack = torch.cat([image, spatial_gradient(image, mode="diff", normalized=False)[:, 0] * 0.5], dim=1)
    _, gx, gy = _bilinear(stack, torch.nan_to_num(x), torch.nan_to_num(y))
    seen = _bicubic(image[0, 0], torch.where(good, x, 2.0), torch.where(good, y, 2.0))
    template = torch.from_numpy(gradients.astype(np.float64))
    safe = torch.where(good[:, None, None], derivative, torch.eye(2, dtype=torch.float64))
    carried = torch.linalg.solve(safe.transpose(1, 2), template[:, :, None])[:, :, 0]
    target = gain * torch.stack([gx / sx, gy / sy], dim=1)
    G = torch.where(good[:, None], 0.5 * (target + carried), 0.0)
    residual = torch.from_numpy(values.astype(np.float64)) - (gain * seen + offset)
    return torch.where(good, residual, torch.nan).numpy().astype(np.float32), G.numpy().astype(np.float32)


def robust_weights(residual: NDArray[np.float32], scale: float, tukey: bool) -> NDArray[np.float32]:
    """See kernel_numba.robust_weights."""
    r = torch.from_numpy(residual).abs()
    c = (TUKEY if tukey else 1.345) * float(scale)
    weight = (1.0 - (r / c) ** 2).clamp(min=0.0) ** 2 if tukey else torch.where(r <= c, 1.0, c / r)
    return torch.nan_to_num(weight, nan=0.0).numpy().astype(np.float32)


def accumulate(
    residual: NDArray[np.float32], G: NDArray[np.float32], J: NDArray[np.float32], weight: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray, float]:
    """See kernel_numba.accumulate: N (p, p), b (p,), cost."""
    w = torch.from_numpy(weight.astype(np.float64))
    r = torch.nan_to_num(torch.from_numpy(residual.astype(np.float64)))
    rows = torch.einsum(
        "nk,nkp->np", torch.from_numpy(G.astype(np.float64)), torch.from_numpy(J.astype(np.float64))
    )
    rows = torch.nan_to_num(rows)
    weighted = rows * w[:, None]
    return (rows.T @ weighted).numpy(), (weighted.T @ r).numpy(), float((w * r * r).sum())


def accumulate_cells(
    residual: NDArray[np.float32],
    G: NDArray[np.float32],
    weight: NDArray[np.float32],
    src: FloatArray,
    dst: FloatArray,
    cell: NDArray[np.int64],
    n_cells: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """See kernel_numba.accumulate_cells: A (c, 2, 2), b (c, 2), S (c, 5), counts (c, 2)."""
    finite = np.isfinite(residual)
    index = torch.from_numpy(cell[finite])
    g = torch.from_numpy(G[finite].astype(np.float64))
    w = torch.from_numpy(weight[finite].astype(np.float64))
    r = torch.from_numpy(residual[finite].astype(np.float64))
    texture = w * (g * g).sum(dim=1)
    places = torch.from_numpy(np.concatenate([src[finite], dst[finite]], axis=1))

    def summed(rows: torch.Tensor) -> FloatArray:
        return torch.zeros((n_cells, *rows.shape[1:]), dtype=torch.float64).index_add_(0, index, rows).numpy()

    A = summed(w[:, None, None] * g[:, :, None] * g[:, None, :])
    b = summed(w[:, None] * g * r[:, None])
    S = summed(torch.cat([texture[:, None], texture[:, None] * places], dim=1))
    counts = summed(torch.stack([torch.ones_like(w), (w > 0.3).double()], dim=1))
    return A, b, S, counts


def linearise_cells(
    level: NDArray[np.generic],
    sx: float,
    sy: float,
    dst: FloatArray,
    shift: FloatArray,
    cell: NDArray[np.int64],
    *rest: Any,
) -> tuple[NDArray[np.float32], NDArray[np.float32], FloatArray]:
    """See kernel_numba.linearise_cells: residuals (n,), ESM gradients (n, 2), points (n, 2)."""
    moved = dst + shift[cell]
    return *linearise(level, sx, sy, moved, *rest), moved


def robust_scale(residual: NDArray[np.float32]) -> tuple[float, int]:
    """See kernel_numba.robust_scale: scale, count."""
    r = torch.from_numpy(residual).abs()
    r = r[r.isfinite()]
    if len(r) == 0:
        return float("nan"), 0
    quantile = torch.kthvalue(r, int(SCALE_QUANTILE * len(r)) + 1).values
    return max(float(quantile) / NORMAL_QUANTILE, 0.5), len(r)


def inlier_scale(residual: NDArray[np.float32], scale: float) -> float:
    """See kernel_numba.inlier_scale."""
    r2 = torch.from_numpy(residual[np.isfinite(residual)]).double() ** 2
    for _ in range(8):
        w = (1.0 - r2 / (TUKEY * scale) ** 2).clamp(min=0.0) ** 2
        if not float(w.sum()) > 0.0:
            break
        smaller = max(float(((w * r2).sum() / w.sum() / TUKEY_VARIANCE).sqrt()), 0.5)
        done = smaller > 0.98 * scale
        scale = min(smaller, scale)
        if done:
            break
    return scale


def tukey_cost(residual: NDArray[np.float32], scale: float) -> float:
    """See kernel_numba.tukey_cost."""
    u = torch.nan_to_num(torch.from_numpy(residual).double() / (TUKEY * scale), nan=1.0).abs().clamp(max=1.0)
    return float((1.0 - (1.0 - u**2) ** 3).mean())


def shifted_residuals(
    level: NDArray[np.generic],
    sx: float,
    sy: float,
    dst: FloatArray,
    shifts: FloatArray,
    stride: int,
    values: NDArray[np.float32],
    gain: float,
    offset: float,
    *masks: Any,
) -> NDArray[np.float32]:
    """See kernel_numba.shifted_residuals: (m k,)."""
    seen = [sample(level, sx, sy, dst[::stride] + shift, *masks) for shift in shifts]
    return np.concatenate([values[::stride] - (gain * s + offset) for s in seen]).astype(np.float32)


def cell_steps(
    A: FloatArray, b: FloatArray, variance: float, max_std: float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """See kernel_numba.cell_steps: step (c, 2), eigenvectors (c, 2, 2), variances (c, 2), known (c, 2)."""
    values, vectors = torch.linalg.eigh(torch.from_numpy(A))
    values = values.clamp(min=1e-12)
    std2 = variance / values
    known = std2 < max_std**2
    along = torch.einsum("cji,cj->ci", vectors, torch.from_numpy(b))
    step = torch.einsum("cij,cj->ci", vectors, torch.where(known, along / values, 0.0))
    return step.numpy(), vectors.numpy(), std2.numpy(), known.numpy()


def cell_scores(
    residual: NDArray[np.float32],
    G: NDArray[np.float32],
    J: NDArray[np.float32],
    weight: NDArray[np.float32],
    cell: NDArray[np.int64],
    n_cells: int,
) -> FloatArray:
    """See kernel_numba.cell_scores: (c, p)."""
    used = weight > 0
    wr = torch.from_numpy((weight[used] * residual[used]).astype(np.float64))
    rows = torch.einsum(
        "nk,nkp->np",
        torch.from_numpy(G[used].astype(np.float64)),
        torch.from_numpy(J[used].astype(np.float64)),
    )
    total = torch.zeros((n_cells, rows.shape[1]), dtype=torch.float64)
    return total.index_add_(0, torch.from_numpy(cell[used]), wr[:, None] * rows).numpy()


def cell_moments(
    G: NDArray[np.float32],
    J: NDArray[np.float32],
    weight: NDArray[np.float32],
    cell: NDArray[np.int64],
    n_cells: int,
) -> FloatArray:
    """See kernel_numba.cell_moments: (c, p, 2)."""
    used = weight > 0
    g = torch.from_numpy(G[used].astype(np.float64))
    rows = torch.einsum("nk,nkp->np", g, torch.from_numpy(J[used].astype(np.float64)))
    each = torch.from_numpy(weight[used].astype(np.float64))[:, None, None] * rows[:, :, None] * g[:, None, :]
    total = torch.zeros((n_cells, rows.shape[1], 2), dtype=torch.float64)
    return total.index_add_(0, torch.from_numpy(cell[used]), each).numpy()
