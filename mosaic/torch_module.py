"""Direct registration as a torch module: batches of pictures in, homographies in pixels out, gradients to the pictures.

The search (pyramids, robust steps, rescue, verification) is `mosaic.pair.register`, one pair after the other on the CPU
and without gradients. What follows it is torch on the pictures' own device and differentiable: see DirectHomography.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from kornia.color import rgb_to_grayscale
from kornia.filters import filter2d_separable, spatial_gradient
from torch import Tensor, nn
from torch.nn.functional import grid_sample, max_pool2d

from mosaic.gray import white_of
from mosaic.pair import PairOptions, register
from mosaic.records import PairFit

TUKEY = 4.685  # in robust deviations: 95 % efficiency on normal residuals, as in the estimator
MARGIN_PX = (
    3  # the picture's rim that is not read: blur, gradient and interpolation each reach one pixel further
)


@dataclass(frozen=True, slots=True)
class _Points:
    """The chosen pixels of one picture: xy (n, 2) px, values (n,), gradients (n, 2) grey per px; grey of 255."""

    xy: Tensor
    values: Tensor
    gradients: Tensor


class DirectHomography(nn.Module):
    """H_b_a (B, 3, 3), px of a to px of b, det 1, for batches of pictures; differentiable in both.

    Found by `mosaic.register` (`fits` gives its records), then `n_refine` robust Gauss-Newton steps (ESM) in torch, of
    which the last one carries gradients: `n_points` pixels of a against b, float64.

    Differentiable: H in the values of a and of b, by that last step: at its fixed point, the derivative of the solution
    as the implicit function theorem gives it.
    Not differentiable, constants of the step: the search itself, which pixels were chosen, the robust weights and
    their scale (with noise this costs the gradients some per cent), gain and offset, masks and status. What the two
    pictures do not share, and pixels without texture, get no gradient.
    No parameter is learnt. A pair that fails gives NaN, and NaN gradients if it is used: look at isfinite() first.
    """

    def __init__(
        self,
        *,
        options: PairOptions | None = None,
        n_refine: int = 2,
        n_points: int = 8000,
        white: float | None = None,
    ) -> None:
        """n_refine 0: the search's homographies, without gradients. white: as in `register`."""
        super().__init__()
        if n_refine < 0 or n_points < 100:
            raise ValueError(f"n_refine >= 0 and n_points >= 100 expected, got {n_refine}, {n_points}")
        self.options = options or PairOptions()
        self.n_refine = n_refine
        self.n_points = n_points
        self.white = white

    def extra_repr(self) -> str:
        return f"n_refine={self.n_refine}, n_points={self.n_points}, white={self.white}"

    @torch.no_grad()
    def fits(
        self, a: Tensor, b: Tensor, mask_a: Tensor | None = None, mask_b: Tensor | None = None
    ) -> tuple[PairFit, ...]:
        """The verified PairFit of every pair of the batch; arguments as in `forward`."""
        white = self._checked(a, b, mask_a, mask_b)
        # The steps here go on where the pyramid's pictures end, at its gain: that of smoother pictures, which lose
        # nothing between their pixels, makes the gradients 4 % too large.
        options = replace(self.options, finish=self.options.finish and self.n_refine == 0)
        return tuple(
            register(
                a[i],
                b[i],
                mask_a=None if mask_a is None else mask_a[i],
                mask_b=None if mask_b is None else mask_b[i],
                white=white,
                options=options,
            )
            for i in range(len(a))
        )

    def forward(
        self, a: Tensor, b: Tensor, mask_a: Tensor | None = None, mask_b: Tensor | None = None
    ) -> Tensor:
        """Homographies (B, 3, 3) float64 on the device of a.

        a (B, C, H, W), b (B, C, H', W'), C = 1 or 3 (RGB), uint8 or float. Masks (B, 1, H, W), > 0 = usable. Raises
        ValueError for other shapes.
        """
        white = self._checked(a, b, mask_a, mask_b)
        fits = self.fits(a, b, mask_a, mask_b)
        found = []
        for i, fit in enumerate(fits):
            H = torch.tensor(fit.H_dst_src, dtype=torch.float64, device=a.device)
            if fit.usable and self.n_refine:
                mask = None if mask_b is None else mask_b[i, 0] > 0
                source = self._points(self._gray(a[i], white), None if mask_a is None else mask_a[i, 0] > 0)
                target = self._gray(b[i], white)
                with torch.no_grad():
                    for _ in range(self.n_refine - 1):
                        H = _step(H, source, target, mask, fit.gain, fit.offset)
                H = _step(H, source, target, mask, fit.gain, fit.offset)
            found.append(H)
        return torch.stack(found) if found else a.new_zeros((0, 3, 3), dtype=torch.float64)

    def _checked(self, a: Tensor, b: Tensor, mask_a: Tensor | None, mask_b: Tensor | None) -> float:
        """White of the batch, for ValueErrors that show the shapes."""
        if a.ndim != 4 or b.ndim != 4 or a.shape[:2] != b.shape[:2] or a.shape[1] not in (1, 3):
            raise ValueError(
                f"(B, C, H, W) with C = 1 or 3 expected, got {tuple(a.shape)} and {tuple(b.shape)}"
            )
        for mask, picture in ((mask_a, a), (mask_b, b)):
            if mask is not None and mask.shape != (picture.shape[0], 1, *picture.shape[2:]):
                raise ValueError(f"mask {tuple(mask.shape)} does not match pictures {tuple(picture.shape)}")
        if self.white is not None:
            return self.white
        return white_of(a.detach().cpu().numpy(), b.detach().cpu().numpy()) if len(a) else 1.0

    def _gray(self, picture: Tensor, white: float) -> Tensor:
        """(C, H, W) to float64 gray (1, 1, H, W), white at 255, blurred like the search's pyramid."""
        gray = picture[None].double() * (255.0 / white)
        if picture.shape[0] == 3:
            gray = rgb_to_grayscale(gray)
        if not self.options.smooth:
            return gray
        binomial = gray.new_tensor([[0.25, 0.5, 0.25]])
        return filter2d_separable(gray, binomial, binomial, "reflect")

    def _points(self, gray: Tensor, mask: Tensor | None) -> _Points:
        """The strongest gradient of each bin of a regular grid, as template.build_template chooses them."""
        h, w = gray.shape[-2:]
        gradient = _gradient(gray)
        with torch.no_grad():
            strength = (gradient**2).sum(dim=1)
            inner = torch.zeros_like(strength)
            m = MARGIN_PX
            inner[:, m : h - m, m : w - m] = 1.0 if mask is None else mask[m : h - m, m : w - m].to(strength)
            size = max(2, round((w * h / self.n_points) ** 0.5))
            best, index = max_pool2d((strength * inner)[None], size, return_indices=True, ceil_mode=True)
            # Per px, where the selection's threshold is over two.
            index = index[best > (0.5 * self.options.selection.threshold_grey) ** 2]
        xy = torch.stack([index % w, index // w], dim=1).double()
        return _Points(xy=xy, values=gray.flatten()[index], gradients=gradient[0].flatten(1)[:, index].T)


def _gradient(gray: Tensor) -> Tensor:
    """Central differences (1, 2, H, W) of a gray picture (1, 1, H, W), per px."""
    return spatial_gradient(gray, mode="diff", normalized=False)[:, 0] * 0.5


def _step(
    H: Tensor, source: _Points, target: Tensor, mask: Tensor | None, gain: float, offset: float
) -> Tensor:
    """One robust ESM step from H (constant): H <- C (I + M(d)) C^-1 H with d from the normal equations, det 1."""
    H = H.detach()
    h, w = target.shape[-2:]
    p = source.xy @ H[:, :2].T + H[:, 2]
    dst = p[:, :2] / p[:, 2:]
    m = MARGIN_PX
    good = (p[:, 2] > 1e-12) & (dst >= m).all(dim=1) & (dst[:, 0] < w - m - 1) & (dst[:, 1] < h - m - 1)
    if mask is not None:
        at = torch.nan_to_num(dst).round().long()
        good &= mask[at[:, 1].clamp(0, h - 1), at[:, 0].clamp(0, w - 1)]
    dst, depth, values = dst[good], p[good, 2], source.values[good]
    seen = _bilinear(torch.cat([target, _gradient(target)], dim=1), dst)
    residual = values - (gain * seen[:, 0] + offset)
    # d dst / d src, and the template's gradient carried over by its inverse transpose.
    A = (H[None, :2, :2] - dst[:, :, None] * H[None, 2:, :2]) / depth[:, None, None]
    carried = torch.linalg.solve(A.transpose(1, 2), source.gradients[good])
    G = 0.5 * (gain * seen[:, 1:] + carried)
    chart, J = _increments(dst, (w, h))
    rows = torch.einsum("nk,nkp->np", G, J)
    with torch.no_grad():
        if len(residual) == 0:
            return torch.full_like(H, torch.nan)
        scale = residual.abs().median().clamp(min=0.5 * 0.6745) / 0.6745
        weight = (1.0 - (residual / (TUKEY * scale)) ** 2).clamp(min=0.0) ** 2
        # Newton on the ESM equations sum w G r = 0: their derivative takes the sampler's own slope, not the central
        # differences in G, which are too small on fine texture (measured: 8 % in the gradients to the pictures).
        N = (rows * weight[:, None]).T @ torch.einsum("nk,nkp->np", gain * _slope(target, dst), J)
    # The solver tells by an error what is a NaN here: too few points that agree.
    if int((weight > 0).sum()) < 8:
        return torch.full_like(H, torch.nan)
    d, info = torch.linalg.solve_ex(N, rows.T @ (weight * residual))
    if int(info) != 0:
        return torch.full_like(H, torch.nan)
    M = torch.eye(3, dtype=H.dtype, device=H.device) + torch.cat([d, d.new_zeros(1)]).reshape(3, 3)
    moved = chart @ M @ torch.linalg.inv(chart) @ H
    det = torch.linalg.det(moved)
    return moved / (det.sign() * det.abs() ** (1.0 / 3.0))


def _bilinear(stack: Tensor, xy: Tensor) -> Tensor:
    """(n, c) values of stack (1, c, h, w) at px (n, 2); align_corners: pixel 0 is -1, pixel w - 1 is +1."""
    h, w = stack.shape[-2:]
    grid = (2.0 * xy / xy.new_tensor([w - 1, h - 1]) - 1.0)[None, None]
    return grid_sample(stack, grid, mode="bilinear", padding_mode="zeros", align_corners=True)[0, :, 0].T


def _slope(picture: Tensor, xy: Tensor) -> Tensor:
    """d _bilinear / d xy (n, 2) of a picture (1, 1, h, w), constant."""
    at = xy.detach().requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(_bilinear(picture.detach(), at).sum(), at)
    return slope


def _increments(dst: Tensor, size_px: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The chart C (3, 3) of the increments and their Jacobian (n, 2, 8) at dst, as warp.HomographyFamily has them."""
    w, h = size_px
    s = w / 2.0
    chart = dst.new_tensor([[s, 0.0, (w - 1) / 2.0], [0.0, s, (h - 1) / 2.0], [0.0, 0.0, 1.0]])
    u = (dst - chart[:2, 2]) / s
    one, zero = torch.ones_like(u[:, :1]), torch.zeros_like(u)
    row = torch.cat([u, one], dim=1)
    top = torch.cat([row, zero, zero[:, :1], -u[:, :1] * u], dim=1)
    low = torch.cat([zero, zero[:, :1], row, -u[:, 1:] * u], dim=1)
    return chart, s * torch.stack([top, low], dim=1)
