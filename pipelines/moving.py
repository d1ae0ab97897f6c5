"""Ring buffer of small pictures of the second pass: every kept frame is judged once its later neighbours are there.

What moves is decided by mosaic.motion; here are the cameras that say where the neighbours lie. Memory: the small
pictures of about REACH frames to each side, whatever the clip's length.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.framestore import FrameStore
from mosaic.motion import Neighbour, ScreenFixed, expand_map, still_plane
from mosaic.surface import Placement

EVERY = 6  # frames between pictures kept only to compare with
# Frames between a picture and its neighbours: in .5 s a runner has left his place, a stroller in 4 s.
APART = (12, 25, 50, 100)
REACH = 104
LOOK_EVERY = 10  # frames between looks for what is stuck to the screen
SMALL_WIDTH_PX = 480
STEP_PX = 16  # small px between exact points of a map
LEAST_OVERLAP = 0.1
HARDLY = np.uint8(2)  # of 255: trust in what stays on the screen


@dataclass(frozen=True, slots=True, eq=False)
class Small:
    """A reduced picture (h, w, 3) uint8; kept: the store has the frame."""

    frame: int
    rgb: NDArray[np.uint8]
    kept: bool


class MovingFinder:
    """Feed it the second pass's frames in order, then finish(): trust planes and the screen's mask go to the store.

    reduce() may run in another thread than push() and finish(), each in the order of the frames.
    placements: approximate ones, by frame number; frames without one are passed over. kept: frames that the store
    gets. stays: of a frame, (h, w), False = on the screen there for a while (a graphic, a player whom the camera
    follows): it is shown only where there is nothing else."""

    def __init__(
        self,
        placements: Mapping[int, Placement],
        kept: set[int],
        store: FrameStore,
        stays: Callable[[int], NDArray[np.bool_] | None],
    ) -> None:
        self._stays = stays
        self._placements, self._kept, self._store = placements, kept, store
        width, height = store.size_px
        self._shrink = max(1, round(width / SMALL_WIDTH_PX))
        self._size = (width // self._shrink, height // self._shrink)
        self._ring: deque[Small] = deque()
        self._waiting: deque[Small] = deque()
        self._last_compared = -(10**9)
        self._last_look = -(10**9)
        self._fixed = ScreenFixed(self._size)

    def reduce(self, frame: int, picture: Callable[[], NDArray[np.uint8]]) -> Small | None:
        """The next frame as push() wants it; its picture (h, w, 3) uint8 RGB is asked for only when it is needed."""
        kept = frame in self._kept
        due = frame - self._last_compared >= EVERY
        if frame not in self._placements or not (kept or due):
            return None
        if due:
            self._last_compared = frame
        return Small(frame, self._reduced(picture()), kept)

    def push(self, frame: int, small: Small | None) -> None:
        """The next frame. Judges those before it whose later neighbours are there now."""
        if small is not None:
            self._ring.append(small)
            if small.kept:
                self._waiting.append(small)
        while self._waiting and frame - self._waiting[0].frame >= REACH:
            self._decide(self._waiting.popleft())

    def finish(self) -> None:
        """Judge the frames that still wait, with the neighbours that there are, and what was stuck to the screen."""
        while self._waiting:
            self._decide(self._waiting.popleft())
        self._ring.clear()
        self._store.put_screen(self._fixed.mask())

    def _reduced(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        cut = rgb[: self._size[1] * self._shrink, : self._size[0] * self._shrink]
        return np.asarray(cv2.resize(cut, self._size, interpolation=cv2.INTER_AREA), np.uint8)

    def _decide(self, now: Small) -> None:
        while self._ring and now.frame - self._ring[0].frame > REACH:
            self._ring.popleft()
        neighbours = self._neighbours(now)
        still = still_plane(now.rgb, neighbours)
        scene = self._stays(now.frame)
        if scene is not None:
            middle = self._shrink // 2
            small = scene[middle :: self._shrink, middle :: self._shrink][: still.shape[0], : still.shape[1]]
            still = np.where(small, still, np.minimum(still, HARDLY))
        self._store.put_still(now.frame, still)
        if now.frame - self._last_look < LOOK_EVERY:
            return
        self._last_look = now.frame
        for side in (-1, 1):  # a pan one way never tells about the border where the scene comes in
            for neighbour in neighbours:
                if neighbour.frames * side > 0 and self._fixed.look(now.rgb, neighbour):
                    break

    def _neighbours(self, now: Small) -> list[Neighbour]:
        """The pictures nearest to the wanted distances on both sides, each once, that look at the same place."""
        nodes = self._nodes(now.frame)
        found: list[Neighbour] = []
        used = {now.frame}
        for apart in APART:
            for side in (-1, 1):
                goal = now.frame + side * apart
                near = [s for s in self._ring if s.frame not in used and abs(s.frame - goal) <= apart // 3]
                if not near:
                    continue
                other = min(near, key=lambda s: abs(s.frame - goal))
                used.add(other.frame)
                at_full = self._placements[other.frame].ray_to_pixel(nodes)
                at = (at_full - (self._shrink - 1) / 2) / self._shrink
                with np.errstate(invalid="ignore"):
                    inside = ((at >= 0) & (at <= np.array(self._size) - 1)).all(axis=-1)
                if inside.mean() >= LEAST_OVERLAP:
                    found.append(
                        Neighbour(
                            rgb=other.rgb,
                            frames=float(other.frame - now.frame),
                            at_px=expand_map(at, STEP_PX, self._size),
                        )
                    )
        return found

    def _nodes(self, frame: int) -> NDArray[np.float64]:
        """Rays at every STEP_PX-th small pixel of a frame, one beyond each end."""
        columns, rows = (STEP_PX * np.arange(-(-n // STEP_PX) + 1, dtype=np.float64) for n in self._size)
        small = np.stack(np.meshgrid(columns, rows), axis=-1)
        return self._placements[frame].pixel_to_ray(small * self._shrink + (self._shrink - 1) / 2)
