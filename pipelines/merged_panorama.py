"""One panorama of several shots of one camera: composed from the frames that each shot's own panorama was made of.

Not from the finished panoramas: the frames go through the joint cameras, so nothing is doubled where two calibrations
differed, exposures are levelled between all frames, and players leave where another shot shows the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mosaic.composite import Panorama
from mosaic.framestore import FrameStore, StoredFrame
from pipelines.bridge import CameraPlacement
from pipelines.config import Config
from pipelines.panorama import compose, plan_panorama


class JoinedStores:
    """The frame stores of several shots as one to read from: what `composite` asks of a FrameStore."""

    def __init__(self, stores: Sequence[FrameStore]) -> None:
        self.size_px = stores[0].size_px
        self._of: Mapping[int, FrameStore] = {frame: store for store in stores for frame in store.frames}

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers stored, in ascending order."""
        return tuple(sorted(self._of))

    def __contains__(self, frame: int) -> bool:
        return frame in self._of

    @property
    def deep(self) -> bool:
        """See FrameStore.deep: shots of one clip are alike."""
        return next(iter(self._of.values())).deep

    def get(self, frame: int, shrink: int = 1, *, deep: bool = False) -> StoredFrame:
        """See FrameStore.get."""
        return self._of[frame].get(frame, shrink, deep=deep)

    def rows(self, frame: int, first: int, last: int, buffer: NDArray[Any]) -> NDArray[Any]:
        """See FrameStore.rows."""
        return self._of[frame].rows(frame, first, last, buffer)

    def trust(self, frame: int) -> NDArray[np.uint8] | None:
        """See FrameStore.trust."""
        return self._of[frame].trust(frame)

    def still(self, frame: int) -> NDArray[np.uint8]:
        """See FrameStore.still."""
        return self._of[frame].still(frame)

    def coarse(self, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """See FrameStore.coarse."""
        return self._of[frame].coarse(frame)


CACHE_BYTES = 200_000_000  # of all stores together, as one store has by itself


def panorama_of(
    stores: Sequence[FrameStore],
    placements: Sequence[CameraPlacement],
    config: Config,
    scratch: Path,
    progress: Callable[[float], None],
) -> Panorama:
    """The panorama of the stored frames under these placements. Raises ValueError: no stored frame has one."""
    for one in stores:
        one.cache_bytes = CACHE_BYTES // len(stores)
    joined = JoinedStores(stores)
    # Planned anew among what is stored: a place that many shots show needs no more views than any other.
    store = cast(FrameStore, joined)  # it is only read
    plan = plan_panorama(placements, config, stored=store)
    return compose(plan, store, placements, config, scratch, progress)
