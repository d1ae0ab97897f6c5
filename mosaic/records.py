"""The frozen records that pass between this package's stages. No computation beyond checking shapes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

GRID_COLUMNS = 8
GRID_ROWS = 5
N_CELLS = GRID_COLUMNS * GRID_ROWS


class PairStatus(StrEnum):
    """How far a registration can be trusted. `weak`: aligned, but on little support or a doubtful score."""

    OK = "ok"
    WEAK = "weak"
    FAILED = "failed"
    SKIPPED = "skipped"


PAIR_REASONS = {
    "": "aligned and verified",
    "low_overlap": "too little of the one picture is seen in the other",
    "no_texture": "too few pixels carry a gradient",
    "diverged": "the alignment left the picture or became singular",
    "score": "the aligned pictures agree hardly better than shifted ones",
    "few_inliers": "most pixels disagree with the alignment",
    "duplicate": "the picture repeats the one before",
}


def freeze_arrays(record: object) -> None:
    """Every array of a frozen record read-only, since `frozen` does not freeze an array: a copy of what may be written

    to, but an array that nobody can write to (another record's) is shared."""
    for item in fields(record):  # type: ignore[arg-type]
        value = getattr(record, item.name)
        if isinstance(value, np.ndarray) and (value.flags.writeable or not value.flags.owndata):
            copied = np.array(value, copy=True)
            copied.setflags(write=False)
            object.__setattr__(record, item.name, copied)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlowGrid:
    """Where textured cells of the 8x5 grid over src were measured in dst; m <= 40 rows, raw pixels.

    src_px, dst_px: (m, 2) px, texture-weighted centroid of a cell and its place in dst (warp + residual flow).
    info: (m, 2, 2) px^-2, information of dst_px; a direction that the texture does not show has about 0.
    weight: (m,) share of the cell's pixels that agree, 0..1. cell: (m,) row * 8 + column.
    """

    src_px: FloatArray
    dst_px: FloatArray
    info: FloatArray
    weight: FloatArray
    cell: NDArray[np.int64]

    def __post_init__(self) -> None:
        m = len(self.cell)
        if self.src_px.shape != (m, 2) or self.dst_px.shape != (m, 2) or self.info.shape != (m, 2, 2):
            raise ValueError(
                f"{m} cells do not match {self.src_px.shape}, {self.dst_px.shape}, {self.info.shape}"
            )
        freeze_arrays(self)

    @classmethod
    def empty(cls) -> FlowGrid:
        """A grid without any measured cell."""
        return cls(
            src_px=np.zeros((0, 2)),
            dst_px=np.zeros((0, 2)),
            info=np.zeros((0, 2, 2)),
            weight=np.zeros(0),
            cell=np.zeros(0, np.int64),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairFit:
    """One registered pair: src (the template) to dst. Failure is a value with a reason, never an exception.

    H_dst_src: (3, 3), raw px of src to raw px of dst, det 1 (NaN when failed): the homography nearest to the
    measured flow. overlap: share of src's informative pixels that land in dst. rms_grey: robust residual, grey
    levels of 255. score: residual scale over that of shifted pictures (0 perfect, 1 no better than chance).
    anchors_px: (4, 2) in src, info: (8, 8) px^-2 of where they land in dst (x0 y0 x1 y1 ...).
    """

    src: int
    dst: int
    H_dst_src: FloatArray
    status: PairStatus
    reason: str
    overlap: float
    rms_grey: float
    score: float
    gain: float
    offset: float
    n_steps: int
    route: str
    flow: FlowGrid
    anchors_px: FloatArray
    info: FloatArray

    def __post_init__(self) -> None:
        if self.H_dst_src.shape != (3, 3) or self.anchors_px.shape != (4, 2) or self.info.shape != (8, 8):
            raise ValueError(
                f"PairFit shapes {self.H_dst_src.shape}, {self.anchors_px.shape}, {self.info.shape}; "
                "expected (3, 3), (4, 2), (8, 8)"
            )
        freeze_arrays(self)

    @property
    def usable(self) -> bool:
        """True when the pair may carry a measurement (ok or weak)."""
        return self.status in (PairStatus.OK, PairStatus.WEAK)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionGraph:
    """All pairs tried within a shot; failed ones too, since they are evidence. frames: (n,) frame numbers."""

    frames: NDArray[np.int64]
    fits: tuple[PairFit, ...]
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        freeze_arrays(self)
