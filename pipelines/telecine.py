"""3:2 pull-down undone: film at 24 pictures/s that was spread over the fields of 60i is put together again.

Four pictures of film fill ten fields, so two frames of five mix two pictures, and one of five says nothing new.
FFmpeg's fieldmatch finds for every frame the field that belongs to it; what it leaves combed (a cut in the middle of a
frame) is interpolated; of every five frames the one that repeats is left out and the others share its time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction

import av
import av.filter
import numpy as np
from numpy.typing import NDArray

from pipelines.picture import Picture
from pipelines.pixels import gray_plane

CYCLE = 5
# The repeated picture differs from the one before by the coding only. If the least of five differences is more than
# this share of their median, the five show five moments (true video between film) and none is left out.
REPEAT_SHARE = 0.5
REST_GREY = (
    0.5  # mean grey levels below which a difference is noise: the scene rests, and the pattern goes on
)
STEADY = 1.5  # times the least difference up to which the place of the repeat stays what it was
STEP = 4  # every fourth row and column is enough to tell a repeat


def undo_telecine(pictures: Iterable[Picture], order: str) -> Iterator[Picture]:
    """The pictures of the film, evenly spaced in time where they came as four in five frames.

    order: 'tff' or 'bff'. Time stamps must be finite and increasing; source_frame is the frame that a picture is
    completed in. Frames whose cycle shows five moments pass, deinterlaced, at their own times."""
    return _without_repeats(_matched(pictures, order))


def _matched(pictures: Iterable[Picture], order: str) -> Iterator[Picture]:
    """As many pictures as came in, each with the fields that belong together."""
    graph: _FieldMatch | None = None
    for picture in pictures:
        graph = graph or _FieldMatch(picture.video, order)
        yield from graph.push(picture)
    if graph is not None:
        yield from graph.finish()


class _FieldMatch:
    """The filter graph. Frame numbers travel through it as time stamps."""

    def __init__(self, like: av.VideoFrame, order: str) -> None:
        self._waiting: dict[int, Picture] = {}
        self._last: Picture | None = None
        self._unit = Fraction(1, 1000)
        graph = av.filter.Graph()
        source = graph.add_buffer(
            width=like.width, height=like.height, format=like.format, time_base=self._unit
        )
        # fieldmatch judges 8 bits; with ppsrc it puts the fields of its second input together, at full depth.
        split = graph.add("split")
        match = graph.add("fieldmatch", f"order={order}:ppsrc=1")
        rest = graph.add("bwdif", f"mode=send_frame:parity={order}:deint=interlaced")
        sink = graph.add("buffersink")
        source.link_to(split)
        split.link_to(match, 0, 0)
        split.link_to(match, 1, 1)
        match.link_to(rest)
        rest.link_to(sink)
        graph.configure()
        self._graph = graph

    def push(self, picture: Picture) -> Iterator[Picture]:
        """Take the next picture; yields those that are done."""
        picture.video.pts = picture.source_frame
        picture.video.time_base = self._unit
        self._waiting[picture.source_frame] = picture
        self._last = picture
        self._graph.vpush(picture.video)
        yield from self._done()

    def finish(self) -> Iterator[Picture]:
        """What is left. The filter keeps its last picture for want of a next one: that is itself once more."""
        if self._last is not None:
            video = self._last.video
            again = video.reformat(format=video.format.name)
            again.pts, again.time_base = self._last.source_frame + 1, self._unit
            self._graph.vpush(again)
        self._graph.vpush(None)
        yield from self._done()

    def _done(self) -> Iterator[Picture]:
        while True:
            try:
                out = self._graph.vpull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            if (
                out.pts is None or out.time_base is None
            ):  # the filters always set them; the types do not say so
                continue
            number = round(out.pts * out.time_base / self._unit)
            if number in self._waiting:
                yield replace(self._waiting[number], video=out, field=None)
            for old in [n for n in self._waiting if n <= number]:
                del self._waiting[old]


def _without_repeats(pictures: Iterable[Picture]) -> Iterator[Picture]:
    """Of every five the repeated one left out."""
    cycle: list[Picture] = []
    changes: list[float] = []
    before: NDArray[np.float32] | None = None
    place: int | None = None
    spacing: deque[float] = deque([1001 / 30000], maxlen=1)
    for picture in pictures:
        if len(cycle) == CYCLE:
            spacing.append((picture.pts_s - cycle[0].pts_s) / CYCLE)
            place = _repeat(changes, place)
            yield from _spread(cycle, place, spacing[0])
            cycle, changes = [], []
        small = gray_plane(picture.video, 0)[::STEP, ::STEP].astype(np.float32)
        known = before is not None and before.shape == small.shape
        changes.append(float(np.abs(small - before).mean()) if known and before is not None else np.inf)
        cycle.append(picture)
        before = small
    if cycle:
        # A last cycle that is not whole has its repeat where the others had it.
        whole = len(cycle) == CYCLE
        known = place is not None and place < len(cycle) and changes[place] <= _limit(changes)
        yield from _spread(cycle, _repeat(changes, place) if whole else place if known else None, spacing[0])


def _limit(changes: list[float]) -> float:
    """Mean grey levels up to which a picture counts as the one before."""
    return max(REPEAT_SHARE * float(np.median(changes)), REST_GREY)


def _repeat(changes: list[float], place: int | None) -> int | None:
    """Which of a cycle's pictures repeats the one before it; None where each shows another moment. place: of the
    cycle before."""
    least = int(np.argmin(changes))
    if changes[least] > _limit(changes):
        return None
    if place is not None and changes[place] <= max(STEADY * changes[least], REST_GREY):
        return place
    return least


def _spread(cycle: list[Picture], repeat: int | None, frame_s: float) -> Iterator[Picture]:
    """The cycle without its repeat, over the cycle's time; as it is where nothing repeats."""
    if repeat is None:
        yield from cycle
        return
    kept = [p for i, p in enumerate(cycle) if i != repeat]
    for i, picture in enumerate(kept):
        yield replace(picture, pts_s=cycle[0].pts_s + i * frame_s * CYCLE / (CYCLE - 1))
