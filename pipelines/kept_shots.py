"""What is kept of solved shots until the clip's end, for merging: on disk, so that memory does not grow with them.

Kept are the records of a shot, its keyframes, and the frames that its panorama was made of. Nothing is decided here.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.records import Priors
from mosaic.estimator import RegisterOptions
from mosaic.framestore import FrameStore
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit
from pipelines.config import RegistrationOptions
from pipelines.keyframe_graph import KeyframeImages
from pipelines.keyframes import Keyframe
from pipelines.shot import CalibratedShot
from pipelines.table import FrameFacts
from pipelines.tracking import Observation, ShotTracker

# A 1080p shot keeps up to a hundred frames of 6 MB and a picture of 2 MB per keyframe; two hundred such shots fit.
SCRATCH_BYTES = 100_000_000_000
OPEN_FILES = 400  # two a shot; systems allow 1024 and upwards


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptShot:
    """A solved shot without its pictures. mask: usable pixels as known at its end. facts: a row a frame."""

    index: int
    solved: CalibratedShot
    facts: tuple[FrameFacts, ...]
    observations: tuple[Observation, ...]
    keyframes: dict[int, Keyframe]
    first_fits: tuple[PairFit, ...]
    size_px: tuple[int, int]
    priors: Priors
    registration: RegistrationOptions
    register: RegisterOptions
    mask: NDArray[np.bool_] | None
    n_levels: int

    def tracker(self) -> ShotTracker:
        """The shot's tracker as far as its results go; nothing may be stepped with it."""
        return ShotTracker(
            self.size_px, self.registration, self.priors, None, self.register, dict(self.keyframes),
            list(self.first_fits), list(self.observations),
        )  # fmt: skip


class ShotShelf:
    """Kept shots by number. `put` takes over the open files of a shot; `close` removes them all."""

    def __init__(self, folder: Path, max_bytes: int = SCRATCH_BYTES) -> None:
        self._folder, self._left = folder, max_bytes
        self._images: dict[int, KeyframeImages] = {}
        self._stores: dict[int, FrameStore] = {}
        self.left_out: list[int] = []  # shots that there was no room for

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the kept shots, ascending."""
        return tuple(sorted(self._images))

    def put(
        self,
        index: int,
        tracker: ShotTracker,
        solved: CalibratedShot,
        facts: Sequence[FrameFacts],
        images: KeyframeImages,
        mask: NDArray[np.bool_] | None,
        n_levels: int,
    ) -> None:
        """Keep a shot; images and solved.store are closed here if there is no room."""
        store = solved.store
        n_bytes = len(tracker.keyframes) * tracker.size_px[0] * tracker.size_px[1]
        n_bytes += 0 if store is None else store.bytes_on_disk
        if n_bytes > self._left or 2 * len(self._images) >= OPEN_FILES:
            self.left_out.append(index)
            images.close()
            if store is not None:
                store.close()
            return
        self._left -= n_bytes
        shot = KeptShot(
            index=index,
            solved=replace(
                solved,
                panorama=None,
                store=None,
                trail=None if solved.trail is None else solved.trail.without_image(),
            ),
            facts=tuple(facts),
            observations=tuple(replace(o, estimate=None) for o in tracker.observations),
            keyframes={k: Keyframe(k, key.template, key.small) for k, key in tracker.keyframes.items()},
            first_fits=tuple(tracker.fits),
            size_px=tracker.size_px,
            priors=tracker.priors,
            registration=tracker.options,
            register=tracker.register_options,
            mask=mask,
            n_levels=n_levels,
        )
        with self._path(index).open("wb") as stream:
            pickle.dump(shot, stream, protocol=pickle.HIGHEST_PROTOCOL)
        self._images[index] = images
        if store is not None:
            rest(store)
            self._stores[index] = store

    def load(self, index: int) -> KeptShot:
        """A kept shot's records. Raises KeyError: not kept."""
        if index not in self._images:
            raise KeyError(index)
        with self._path(index).open("rb") as stream:
            shot = pickle.load(stream)  # written above, in this run's own scratch folder
        assert isinstance(shot, KeptShot)
        return shot

    def store(self, index: int) -> FrameStore | None:
        """The frames of a kept shot's panorama, or None where none was made."""
        return self._stores.get(index)

    def pyramid(self, shot: KeptShot, frame: int) -> Pyramid:
        """A keyframe of a kept shot, under the shot's own mask."""
        return self._images[shot.index].pyramid(frame, shot.n_levels, shot.mask)

    def close(self) -> None:
        """Remove all files. May be called twice."""
        for images in self._images.values():
            images.close()
        for store in self._stores.values():
            store.close()
        for index in self._images:
            self._path(index).unlink(missing_ok=True)
        self._images.clear()
        self._stores.clear()

    def _path(self, index: int) -> Path:
        return self._folder / f"kept-{index:03d}.pickle"


def rest(store: FrameStore) -> None:
    """Let go of what a store holds in memory: many of them wait at the same time. It is read again when asked for."""
    with store._lock:
        store._cache.clear()
        store._spare.clear()
        store._trust_kept = None
        store._cached_bytes = 0
