"""The shots of a clip: where the editor joined views (edits.py), and breaks in registration that no bridge repairs.

A flash or a dropped frame is repaired by registering a later frame to the last good one; a cut is not. An edit is
known some frames after its end: the old shot is then cut back to its last whole frame, and the new one begins again
from its first, by the frames kept for that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mosaic.records import PairFit, PairStatus
from pipelines.edits import LAG, EditFinder, EditFound
from pipelines.preparation import PreparedFrame
from pipelines.routes import RESCUED
from pipelines.tracking import ShotTracker

# Frames after a break at which the costly rescue is tried; plain prediction is tried on every frame.
RESCUE_AFTER = (0, 1, 2, 4, 7, 10)
LEAPS = (*RESCUED, "composed")  # such a pair may lead from one view to another of the same venue
# Share of an edit that a pair crosses and its score, from which there is none. Within a view such pairs score .17 to
# .31, across most of a wipe, a stinger or a dissolve .34 to .53.
MOST, MOST_SCORE = 2 / 3, 0.32
JUMP = 4.0  # times the motion before: such a rescued pair is a cut to another picture of the same camera
WAIT = 24  # frames after a break for the end of a fade or a graphic to show
KEPT = LAG + 6  # frames from which a new shot can begin again; 3.5 MB each at 1080p


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedShot:
    """A finished shot of pass one: its tracker, and why it ended: 'cut', 'fade', 'transition', 'end' of the clip,
    'length': divided because memory grows with a shot, or 'lost': registration broke off without an edit that would
    say why."""

    tracker: ShotTracker
    end: str


@dataclass(slots=True, eq=False)
class _Break:
    """A break not yet decided: what has been seen since, and a tracker that treats it as a cut."""

    times: list[tuple[int, float]]
    tracker: ShotTracker


@dataclass(slots=True, eq=False)
class ShotSplitter:
    """Feeds frames to trackers and hands out shots as they are decided. `new_tracker` makes an empty tracker.

    max_frames: of a shot; a longer one goes on as the next. graphics: frames of gradual edits, which belong to no shot,
    and what they are ('fade', 'transition').
    """

    new_tracker: Callable[[], ShotTracker]
    bridge_frames: int
    max_frames: int | None = None
    graphics: dict[int, str] = field(default_factory=dict)
    _edits: EditFinder | None = None
    _kept: deque[PreparedFrame] = field(default_factory=lambda: deque(maxlen=KEPT))
    _current: ShotTracker | None = None
    _break: _Break | None = None
    _ended: ShotTracker | None = None  # broken off, and waiting whether an edit says where

    @property
    def last_motion_px(self) -> float:
        """Motion of the newest frame against its predecessor, px; NaN when unknown."""
        tracker = self._newest
        return tracker.observations[-1].motion_px if tracker and tracker.observations else float("nan")

    def screen_mask(self, frame: int) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene, without graphics that stayed at this frame; None: nothing known."""
        tracker = self._newest
        return None if tracker is None else tracker.screen_mask(frame)

    def push(self, look: PreparedFrame) -> Iterator[TrackedShot]:
        """Take the next frame; yields shots that it completes."""
        self._kept.append(look)
        yield from self._divide(look.frame)
        yield from self._follow(look)
        assert self._newest is not None
        if self._edits is None:
            self._edits = EditFinder(self._newest.size_px)
        found = self._edits.push(look.frame, look.edit, _motion_of(self._newest, look.frame))
        assert self._current is not None
        if found is None:
            if self._ended is not None and look.frame - self._current.observations[0].frame >= WAIT:
                yield from self._let_go()
            return
        if self._ended is not None and found.last >= self._current.observations[0].frame:
            yield from self._let_go()
        old = self._ended or self._current
        if found.last < old.observations[0].frame or _spanned(old, found):
            return
        first = max(found.first, self._kept[0].frame)
        self.graphics |= dict.fromkeys(range(found.last + 1, first), found.kind)
        old.cut_back(found.last)
        yield TrackedShot(tracker=old, end=found.kind)
        for begun in (self._break.tracker if self._break else None, self._current if self._ended else None):
            if begun is not None:
                _drop(begun)
        self._current = self._break = self._ended = None
        self._edits.begin(first)
        for kept in [k for k in self._kept if k.frame >= first]:
            yield from self._follow(kept)

    def _divide(self, frame: int) -> Iterator[TrackedShot]:
        """A shot as long as shots may be ends before this frame, if nothing about it is undecided."""
        if self.max_frames is None or self._current is None or self._break or self._ended:
            return
        if len(self._current.observations) >= self.max_frames:
            yield TrackedShot(tracker=self._current, end="length")
            self._current = None
            if self._edits is not None:
                self._edits.begin(frame)

    def _let_go(self) -> Iterator[TrackedShot]:
        """No edit explains the break: the shot before it ended where registration was lost."""
        if self._ended is not None:
            yield TrackedShot(tracker=self._ended, end="lost")
            self._ended = None
            if self._edits is not None and self._current is not None:
                self._edits.begin(self._current.observations[0].frame)

    def _follow(self, look: PreparedFrame) -> Iterator[TrackedShot]:
        """Hand the frame to the tracker of the shot; decide on a break."""
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
        if age >= max(self.bridge_frames, LAG + 2):
            yield from self._let_go()
            self._ended, self._current, self._break = self._current, waiting.tracker, None

    def finish(self) -> Iterator[TrackedShot]:
        """The clip has ended: hand out what is left."""
        yield from self._let_go()
        if self._current is not None:
            yield TrackedShot(tracker=self._current, end="lost" if self._break else "end")
        if self._break is not None:
            yield TrackedShot(tracker=self._break.tracker, end="end")
        self._current, self._break = None, None

    @property
    def _newest(self) -> ShotTracker | None:
        return self._break.tracker if self._break else self._current

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


def _motion_of(tracker: ShotTracker, frame: int) -> NDArray[np.float64] | None:
    """(3, 3) px from the frame before; None where none was measured, or where the camera would have had to jump."""
    newest = tracker.observations[-1]
    if newest.frame != frame:
        return None
    for fit in reversed(tracker.fits):
        if fit.dst != frame:
            break
        if not fit.usable or (fit.src in tracker.keyframes and fit.src != tracker.observations[-2].frame):
            continue
        if fit.route in RESCUED and newest.motion_px > JUMP * max(tracker.observations[-2].motion_px, 1.0):
            return None
        return fit.H_dst_src
    return None


def _spanned(tracker: ShotTracker, found: EditFound) -> bool:
    """Whether one verified pair joins a picture before the edit to one after it, or crosses most of it: then both show
    the same view.

    Players who fill the picture and hoardings that change look like an edit to small pictures; what lies between them
    still registers."""

    def crossed(fit: PairFit) -> float:
        return (min(fit.dst, found.first) - max(fit.src, found.last)) / (found.first - found.last)

    return any(
        fit.status == PairStatus.OK
        and fit.route not in LEAPS
        and crossed(fit) >= (MOST if fit.score <= MOST_SCORE else 1.0)
        for fit in tracker.fits
    )


def _drop(tracker: ShotTracker) -> None:
    """Close the file of a tracker that nobody will solve: a long graphic starts one every frame."""
    if tracker.images is not None:
        tracker.images.close()
