"""Decode a shot again: frames registered to the refined keyframes, the plan's pictures kept, what moves found.

Frames are independent here, so registration runs in threads; pictures are stored in one more thread and judged in
another, in order. Results come back in the order of the frames: any number of threads gives the same bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache

import numpy as np
from numpy.typing import NDArray

from mosaic.framestore import FrameStore
from mosaic.moving import DISTRUSTED
from mosaic.pyramid import Pyramid, build_pyramid
from mosaic.records import PairFit
from pipelines.decode import Frame
from pipelines.moving import MovingFinder, Small
from pipelines.overlays import both_masks
from pipelines.people import People
from pipelines.retracking import Retracker

# Frames in work at once; each holds its gray, its pyramid and the decoder's picture (8 MB at 1080p).
AHEAD = 6


def second_pass(
    frames: Iterator[Frame],
    retracker: Retracker,
    moving: MovingFinder,
    store: FrameStore,
    *,
    planned: set[int],
    mask: NDArray[np.bool_] | None,
    stays: Callable[[int], NDArray[np.bool_] | None],
    people: People | None,
    n_levels: int,
    threads: int,
    progress: Callable[[str, int, int | None], None],
) -> list[PairFit]:
    """Fits of all frames of the retracker's shot to its keyframes. Pictures of `planned` frames go to the store.

    frames: reaches the shot's frames in order, may start before them. mask: usable pixels of all of them.
    stays: of a frame, (h, w), False = on the screen there for a while: left out of registration (see MovingFinder).
    people: where they are known, they are left out too, and distrusted in the pictures stored.
    """
    observations = retracker.tracker.observations
    first, last = observations[0].frame, observations[-1].frame
    wanted = {o.frame for o in observations if o.reason != "duplicate"}

    def register(frame: Frame) -> list[PairFit]:
        @cache  # most frames want none
        def pyramid() -> Pyramid:
            own = stays(frame.index)
            if people is not None:
                own = both_masks(own, people.scene(frame))
            return build_pyramid(frame.gray, n_levels=n_levels, mask=both_masks(mask, own))

        return retracker.register(frame.index, pyramid)

    deep: bool | None = None

    def keep(frame: Frame) -> Small | None:
        picture = cache(frame.picture)  # a conversion, and both may ask for it
        small = moving.reduce(frame.index, picture)
        if frame.index in planned:
            # Of a small clip the reduced picture is the picture itself, and the store makes its own smaller ones.
            reduced = small.rgb if small is not None and small.rgb.shape != picture().shape else None
            nonlocal deep
            if deep is None:
                # Its source has more than 8 bits, and the panorama keeps them; images of a folder need not be alike.
                deep = frame.gray.dtype != np.uint8
            trust = (
                None if people is None else np.where(people.scene(frame), 255, DISTRUSTED).astype(np.uint8)
            )
            store.put(frame.index, frame.deep_picture(True) if deep else picture(), mask, trust, reduced)
        return small

    def judge(index: int, kept: Future[Small | None]) -> None:
        moving.push(index, kept.result())

    fits: list[PairFit] = []
    under_way: deque[tuple[int, Future[list[PairFit]] | None, Future[None]]] = deque()

    def settle() -> None:
        index, registered, judged = under_way.popleft()
        if registered is not None:
            fits.extend(registered.result())
        judged.result()
        progress("second pass", index - first + 1, last - first + 1)

    with (
        ThreadPoolExecutor(threads) as registering,
        ThreadPoolExecutor(1) as keeping,
        ThreadPoolExecutor(1) as judging,
    ):
        for frame in frames:
            if frame.index < first:
                continue
            registered = registering.submit(register, frame) if frame.index in wanted else None
            kept = keeping.submit(keep, frame)
            under_way.append((frame.index, registered, judging.submit(judge, frame.index, kept)))
            if len(under_way) >= AHEAD:
                settle()
            if frame.index >= last:
                break
        while under_way:
            settle()
        judging.submit(moving.finish).result()
    return fits
