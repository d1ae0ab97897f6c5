"""How a shot's newest frame hangs on its keyframe: by a pair of the two, else by steps composed since the last one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mosaic.coords import normalise_homography, transfer
from mosaic.records import FlowGrid, PairFit, PairStatus

FloatArray = NDArray[np.float64]

STEP_VARIANCE_PX2 = 0.09  # a chained step is good to about .3 px where it was measured (real-footage.md 6.1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chain:
    """fit: current keyframe to the newest frame, None while that frame is the keyframe. n_composed: steps in it since a
    pair of the two held."""

    fit: PairFit | None = None
    n_composed: int = 0

    @property
    def H_frame_keyframe(self) -> FloatArray:
        """(3, 3) px of the keyframe to px of the newest frame."""
        return np.eye(3) if self.fit is None else self.fit.H_dst_src

    def H_since(self, before: Chain) -> FloatArray:
        """(3, 3) px of the frame that `before`, a chain to the same keyframe, ends at to px of the newest frame."""
        return normalise_homography(self.H_frame_keyframe @ np.linalg.inv(before.H_frame_keyframe))

    def followed(self, direct: PairFit | None, step: PairFit | None) -> Chain:
        """The chain to the next frame. direct: keyframe to it; step: newest frame to it; usable ones, None if none."""
        if direct is not None:
            return Chain(fit=direct)
        if step is None or self.fit is None:
            return self
        return Chain(fit=compose_fits(self.fit, step), n_composed=self.n_composed + 1)


def centre_motion(H_dst_src: FloatArray, size_px: tuple[int, int]) -> tuple[float, float]:
    """How far the picture's centre moves under H_dst_src, px (inf: out of sight), and the local scale there."""
    centre = np.array([(size_px[0] - 1) / 2.0, (size_px[1] - 1) / 2.0])
    d = size_px[0] / 8.0
    points = transfer(H_dst_src, centre + np.array([[0.0, 0.0], [d, 0.0], [0.0, d]]))
    if not np.all(np.isfinite(points)):
        return float("inf"), 1.0
    area = np.linalg.det(points[1:] - points[0])
    return float(np.linalg.norm(points[0] - centre)), float(np.sqrt(max(area, 1e-9)) / d)


def compose_fits(first: PairFit, second: PairFit) -> PairFit:
    """The pair a -> c from a -> b and b -> c: first's cells carried on by second's homography, with its error added."""
    H = normalise_homography(second.H_dst_src @ first.H_dst_src)
    flow = first.flow
    carried = transfer(second.H_dst_src, flow.dst_px)
    good = np.isfinite(carried).all(axis=1)
    values, vectors = np.linalg.eigh(flow.info[good])
    values = np.where(values > 1e-6, 1.0 / (1.0 / np.maximum(values, 1e-6) + STEP_VARIANCE_PX2), 0.0)
    return PairFit(
        src=first.src,
        dst=second.dst,
        H_dst_src=H,
        # No surer than the less sure of the two.
        status=second.status if first.status == PairStatus.OK else first.status,
        reason=second.reason if first.status == PairStatus.OK else first.reason,
        overlap=min(first.overlap, second.overlap),
        rms_grey=second.rms_grey,
        score=max(first.score, second.score),
        gain=first.gain * second.gain,
        offset=second.offset,
        n_steps=0,
        route="composed",
        flow=FlowGrid(
            src_px=flow.src_px[good],
            dst_px=carried[good],
            info=np.einsum("cij,cj,ckj->cik", vectors, values, vectors),
            weight=flow.weight[good],
            cell=flow.cell[good],
        ),
        anchors_px=first.anchors_px,
        info=first.info,
    )
