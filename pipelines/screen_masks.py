"""Graphics of a shot that stay on the screen, frame by frame, as pairs of neighbours show them in the first pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mosaic.kernels import KernelName
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit
from mosaic.screen import ScreenVotes
from mosaic.template import Template

LATE_FRAMES = 12  # after a graphic's appearance within which the votes find it


class ScreenMasks:
    """What the votes said at each frame. It is looked at from a few frames later, where more is known."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        self._votes = ScreenVotes(size_px)
        self._cells: dict[int, NDArray[np.bool_]] = {}

    def look(self, template: Template, target: Pyramid, step: PairFit, kernel: KernelName) -> None:
        """Take the pair `step` of a frame (its template) and the next one (target) into account."""
        self._votes.look(template, target, step, kernel=kernel)
        cells = self._votes.mask()
        if cells is not None:
            self._cells[step.dst] = cells

    def at(self, frame: int) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene: without what stayed on the screen here or soon after; None: nothing did."""
        cells = [c for k in range(frame, frame + LATE_FRAMES) if (c := self._cells.get(k)) is not None]
        return self._votes.full_size(np.logical_and.reduce(cells)) if cells else None

    def cut_back(self, last: int) -> None:
        """Forget what was seen after frame `last`."""
        self._cells = {k: cells for k, cells in self._cells.items() if k <= last}
