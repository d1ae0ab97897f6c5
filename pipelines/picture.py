"""The record that passes between the steps of decoding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import av


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """A decoded picture with its time. source_frame: count of decoded frames before it; field: 0, 1 or None.

    pts_s: s, NaN where the stream gives none. frame_start_s: the time of the whole frame that a field belongs to.
    """

    video: av.VideoFrame
    source_frame: int
    pts_s: float
    frame_start_s: float
    field: int | None = None
