"""Graphics that have just appeared: what stays where it is on the screen while the scene moves, told pair by pair.

A lower third holds most of the strong edges where the scene is a pitch, and it fits the picture before exactly: a
robust fit takes it for the scene and the scene for players. Two measures against that: a pair that seems not to move
is fitted again without the pixels that stay, and believed if these fill more of the picture; and pixels that stay
while the camera moves vote for a mask, which is there after a few frames (a mask from the statistics of a shot needs
half a width of pan).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic import kernels
from mosaic.coords import transfer
from mosaic.pyramid import Pyramid
from mosaic.records import N_CELLS, PairFit
from mosaic.template import Template, TemplateLevel, mask_arguments

COLUMNS = 80  # cells of the mask over the width
LEAST_GREY, MOST_GREY = (
    4.0,
    6.0,
)  # residual that coding noise explains; the scale of a held pair is no noise any more
NOISE = 2.5  # times the pair's own residual scale: the same
CLEAR = 2.0  # times that: a difference
LEAST_SHARE = 0.25  # of the pixels must have moved before a pair without motion is doubted
LEAST_IN_CELL = 5  # pixels with which a cell of the 8x5 grid counts
WIDER = (
    1.3  # times as many cells as those that stay must the moving ones fill; without a prediction of motion
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScreenOptions:
    """memory: share of a vote left after a pair, and in a cell without pixels (masked already) masked_memory: so a mask
    is doubted again after some 70 frames. least_px: motion of the picture below which nothing is told.
    votes: needed in a cell. against: votes for one that goes with the scene outweigh this many. least_cells: of a
    graphic. max_share of the picture: more is no graphic. most_votes: that a cell keeps."""

    memory: float = 0.9
    masked_memory: float = 0.98
    most_votes: float = 10.0
    least_px: float = 1.5
    votes: float = 2.5
    against: float = 3.0
    least_cells: int = 6
    max_share: float = 0.4


def without_still(
    template: Template, target: Pyramid, fit: PairFit, *, kernel: kernels.KernelName = "numba"
) -> Template | None:
    """The template without the pixels that stay at their place in the target; None where too few move to ask.

    fit: of the pair; it gives gain, offset and noise.
    """
    levels: list[TemplateLevel | None] = []
    n, n_moving = 0, 0
    for index, level in enumerate(template.levels):
        if level is None:
            levels.append(None)
            continue
        stays, _ = _compare(level, target, index, level.src_px, fit, kernel)
        n, n_moving = n + len(stays), n_moving + int((~stays).sum())
        keep = ~stays
        levels.append(
            TemplateLevel(
                src_px=level.src_px[keep],
                values=level.values[keep],
                gradients=level.gradients[keep],
                cell=level.cell[keep],
            )
        )
    return replace(template, levels=tuple(levels)) if n_moving > LEAST_SHARE * n else None


def moves_more_widely(
    template: Template,
    target: Pyramid,
    still: PairFit,
    moving: PairFit,
    share: float = WIDER,
    *,
    kernel: kernels.KernelName = "numba",
) -> bool:
    """Whether the pixels that follow `moving` fill `share` times as many cells as those that stay (`still`: noise)."""
    index = next(i for i, level in enumerate(template.levels) if level is not None)
    level = template.levels[index]
    assert level is not None
    stays, _ = _compare(level, target, index, level.src_px, still, kernel)
    goes, _ = _compare(level, target, index, transfer(moving.H_dst_src, level.src_px), moving, kernel)
    # Grass agrees with both and says nothing.
    count = [np.bincount(level.cell[which], minlength=N_CELLS) for which in (stays & ~goes, goes & ~stays)]
    cells = [int((c >= LEAST_IN_CELL).sum()) for c in count]
    return cells[1] > share * cells[0]


def _compare(
    level: TemplateLevel,
    target: Pyramid,
    index: int,
    at_px: NDArray[np.float64],
    fit: PairFit,
    kernel: kernels.KernelName,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pixels (n,) of a template level agree with the target at at_px (n, 2), and which clearly do not."""
    seen = kernels.load(kernel).sample(
        target.levels[index], *target.scales[index], at_px, *mask_arguments(target)
    )
    noise = min(max(LEAST_GREY, NOISE * fit.rms_grey), MOST_GREY)
    with np.errstate(invalid="ignore"):
        away = np.abs(level.values - (fit.gain * seen + fit.offset))
        return away < noise, away > CLEAR * noise


class ScreenVotes:
    """A mask of what stays on the screen, from the pairs of neighbouring frames of a shot, in order."""

    def __init__(self, size_px: tuple[int, int], options: ScreenOptions | None = None) -> None:
        self.size_px = size_px
        self.options = options or ScreenOptions()
        self._cell_px = max(4, round(size_px[0] / COLUMNS))
        shape = (-(-size_px[1] // self._cell_px), -(-size_px[0] // self._cell_px))
        self._stay: NDArray[np.float32] = np.zeros(shape, np.float32)
        self._go: NDArray[np.float32] = np.zeros(shape, np.float32)

    def look(
        self, template: Template, target: Pyramid, fit: PairFit, *, kernel: kernels.KernelName = "numba"
    ) -> None:
        """Take the pair of a frame (its template) and the next one into account; without motion it says nothing."""
        index = next((i for i, level in enumerate(template.levels) if level is not None), None)
        level = None if index is None else template.levels[index]
        if not fit.usable or index is None or level is None or not len(level.src_px):
            return
        there = transfer(fit.H_dst_src, level.src_px)
        if not np.median(np.abs(there - level.src_px).max(axis=1)) >= self.options.least_px:
            return
        here_agrees, here_differs = _compare(level, target, index, level.src_px, fit, kernel)
        there_agrees, there_differs = _compare(level, target, index, there, fit, kernel)
        cell = np.minimum((level.src_px + 0.5) // self._cell_px, np.array(self._stay.shape[::-1]) - 1).astype(
            np.intp
        )
        looked = np.zeros(self._stay.shape, bool)
        looked[cell[:, 1], cell[:, 0]] = True
        memory = np.where(looked, np.float32(self.options.memory), np.float32(self.options.masked_memory))
        for votes, cast in (
            (self._stay, here_agrees & there_differs),
            (self._go, there_agrees & here_differs),
        ):
            votes *= memory
            np.add.at(votes, (cell[cast, 1], cell[cast, 0]), 1.0)
            np.minimum(votes, self.options.most_votes, out=votes)

    def mask(self) -> NDArray[np.bool_] | None:
        """(rows, columns) bool over cells of the picture, True = scene; None where nothing stays."""
        options = self.options
        seeds = (self._stay >= options.votes) & (self._stay > options.against * self._go)
        if not seeds.any():
            return None
        against = self._go > self._stay
        closed = cv2.morphologyEx(
            seeds.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8), borderValue=0
        )
        _, labels, stats, _ = cv2.connectedComponentsWithStats(
            (closed > 0).astype(np.uint8) & (~against).astype(np.uint8), connectivity=8
        )
        large = stats[:, cv2.CC_STAT_AREA] >= options.least_cells
        large[0] = False
        found = cv2.dilate(large[labels].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        if not found.any() or found.mean() > options.max_share:
            return None
        return ~found

    def full_size(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A mask of cells over the whole picture (h, w)."""
        # A sixth of np.kron's time (.4 ms at 1080p), and asked for on every frame while a graphic is up.
        whole = np.repeat(np.repeat(cells, self._cell_px, axis=0), self._cell_px, axis=1)
        return whole[: self.size_px[1], : self.size_px[0]]
