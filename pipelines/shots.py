"""Where one view of the camera ends: a break in registration that no bridge over a few frames repairs.

A flash or a dropped frame is repaired by registering a later frame to the last good one; a cut is not. So no second
detector is needed, and none fires on a photographer's flash.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipelines.preparation import PreparedFrame
from pipelines.tracking import ShotTracker

# Frames after a break at which the costly rescue is tried; plain prediction is tried on every frame.
RESCUE_AFTER = (0, 1, 2, 4, 7, 10)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedShot:
    """A finished shot of pass one: its tracker, and why it ended ('cut' or 'end')."""

    tracker: ShotTracker
    end: str


@dataclass(slots=True, eq=False)
class _Break:
    """A break not yet decided: what has been seen since, and a tracker that treats it as a cut."""

    times: list[tuple[int, float]]
    tracker: ShotTracker


@dataclass(slots=True, eq=False)
class ShotSplitter:
    """Feeds frames to trackers and hands out shots as they are decided. `new_tracker` makes an empty tracker."""

    new_tracker: Callable[[], ShotTracker]
    bridge_frames: int
    _current: ShotTracker | None = None
    _break: _Break | None = None
    _done: list[TrackedShot] = field(default_factory=list)

    @property
    def last_motion_px(self) -> float:
        """Motion of the newest frame against its predecessor, px; NaN when unknown."""
        tracker = self._break.tracker if self._break else self._current
        return tracker.observations[-1].motion_px if tracker and tracker.observations else float("nan")

    def screen_mask(self, frame: int) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene, without graphics that stayed at this frame; None: nothing known."""
        tracker = self._break.tracker if self._break else self._current
        return None if tracker is None else tracker.screen_mask(frame)

    def push(self, look: PreparedFrame) -> Iterator[TrackedShot]:
        """Take the next frame; yields shots that it completes."""
        if self._current is None:
            self._current = self._started(look)
            return
        if self._break is None:
            if not self._current.step(look):
                self._break = _Break(times=[(look.frame, look.pts_s)], tracker=self._started(look))
            return
        waiting = self._break
        age = len(waiting.times)
        if self._current.step(look, rescue=age in RESCUE_AFTER):
            self._repair(waiting)
            return
        waiting.times.append((look.frame, look.pts_s))
        if not waiting.tracker.step(look, rescue=False):
            waiting.tracker = self._restarted(waiting, look)
        if age >= self.bridge_frames:
            yield TrackedShot(tracker=self._current, end="cut")
            self._current, self._break = waiting.tracker, None

    def finish(self) -> Iterator[TrackedShot]:
        """The clip has ended: hand out what is left."""
        if self._current is not None:
            yield TrackedShot(tracker=self._current, end="cut" if self._break else "end")
        if self._break is not None:
            yield TrackedShot(tracker=self._break.tracker, end="end")
        self._current, self._break = None, None

    def _started(self, look: PreparedFrame) -> ShotTracker:
        tracker = self.new_tracker()
        tracker.start(look)
        return tracker

    def _restarted(self, waiting: _Break, look: PreparedFrame) -> ShotTracker:
        """The break's own tracker lost its track as well. Its frames stay unaccounted for: they belong to no shot."""
        _drop(waiting.tracker)
        return self._started(look)

    def _repair(self, waiting: _Break) -> None:
        """The bridge held: the frames in between were a flash, a glitch or a graphic, not a cut."""
        assert self._current is not None
        repaired = self._current.observations.pop()
        for frame, pts_s in waiting.times:
            self._current.skip(frame, pts_s, "interpolated", "bridged")
        self._current.observations.append(repaired)
        _drop(waiting.tracker)
        self._break = None


def _drop(tracker: ShotTracker) -> None:
    """Close the file of a tracker that nobody will solve: a long graphic starts one every frame."""
    if tracker.images is not None:
        tracker.images.close()
