"""Times of pictures: repair of damaged time stamps, and SMPTE time code. No decoding."""

from __future__ import annotations

import math
import re
import statistics
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from pipelines.picture import Picture

NOMINAL_FRAME_S = 0.04  # a clip that says nothing of its rate: 25 frames/s, until 8 intervals have been seen
GAP_FRAMES = 1.75  # an interval this many times the usual one is a gap; 24 to 30 conversions stay at 1.25


class PtsRepair:
    """Makes the times of a stream of pictures strictly increasing, changing as few of them as it can.

    Kinds of damage, each seen in files: no time stamp; a single spike ahead of the rest; repeated or slightly backward
    stamps; a clock that starts anew, after which everything is moved on. One picture is held back to tell them apart.
    """

    def __init__(self, fps: float) -> None:
        self._intervals: deque[float] = deque(maxlen=31)
        self._nominal_s = 1.0 / fps if math.isfinite(fps) and 0.1 <= fps <= 1000 else NOMINAL_FRAME_S
        self.n_repaired = 0
        self.n_gaps = 0
        self._longest: tuple[float, int] = (0.0, 0)

    def interval_s(self) -> float:
        """The usual time between two pictures, s."""
        return statistics.median(self._intervals) if len(self._intervals) >= 8 else self._nominal_s

    def apply(self, pictures: Iterable[Picture]) -> Iterator[Picture]:
        """The same pictures, one held back, with finite and strictly increasing pts_s."""
        held: Picture | None = None
        last: float | None = None
        shift = 0.0
        for following in pictures:
            if held is not None:
                last, shift, fixed = self._place(held, following.pts_s, last, shift)
                yield fixed
            held = following
        if held is not None:
            yield self._place(held, math.nan, last, shift)[2]

    def _place(
        self, picture: Picture, following_s: float, last: float | None, shift: float
    ) -> tuple[float, float, Picture]:
        dt = self.interval_s()
        raw = picture.pts_s
        time = raw + shift
        following = following_s + shift
        if last is None:
            time = time if math.isfinite(time) else 0.0
        elif not math.isfinite(time):
            time = (last + following) / 2 if last < following < last + 3 * dt else last + dt
        elif last < following < time and following - last < 3 * dt:
            time = (last + following) / 2  # a spike: the next picture is back where it belongs
        elif time <= last and last - time < 1.5 * dt:
            time = last + dt / 4  # repeated or swapped: no shift, the next one is right again
        elif time <= last:
            time = last + dt  # the clock started anew
            shift = time - raw
        if last is not None:
            self._intervals.append(time - last)
            if time - last > GAP_FRAMES * dt:
                self.n_gaps += 1
                self._longest = max(self._longest, (time - last, picture.source_frame))
        changed = not math.isclose(time, raw + shift, rel_tol=0, abs_tol=1e-9) or (
            shift != 0 and time - raw == shift
        )
        if changed or not math.isfinite(raw):
            self.n_repaired += 1
        return time, shift, replace(picture, pts_s=time, frame_start_s=time)

    def warnings(self) -> list[str]:
        """What was found, in sentences."""
        found = []
        if self.n_repaired:
            found.append(f"{self.n_repaired} time stamps were missing or ran backwards and were repaired")
        if self.n_gaps:
            length, frame = self._longest
            found.append(
                f"{self.n_gaps} gaps in the time stamps, the longest {length:.3f} s before frame {frame}"
            )
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Timecode:
    """A SMPTE time code: frames since midnight at a whole nominal rate, drop-frame or not."""

    count: int
    rate: int  # nominal frames/s: 30 for 29.97
    fps: float  # real frames/s
    drop: bool = False

    @classmethod
    def parse(cls, text: str, fps: float) -> Timecode | None:
        """From 'hh:mm:ss:ff' (';' or '.' before ff: drop-frame); None when it is none or the rate is unknown."""
        match = re.fullmatch(r"\s*(\d\d):(\d\d):(\d\d)([:;.])(\d\d\d?)\s*", text)
        if match is None or not math.isfinite(fps) or not 1 <= fps <= 1000:
            return None
        h, m, s, f = (int(match[i]) for i in (1, 2, 3, 5))
        rate = round(fps)
        # Drop-frame exists for 29.97 and its multiples only; elsewhere the sign is a habit of the writer.
        drop = match[4] != ":" and rate % 30 == 0
        if m > 59 or s > 59 or f >= rate:
            return None
        minutes = 60 * h + m
        count = (60 * minutes + s) * rate + f
        if drop:
            count -= (rate // 15) * (minutes - minutes // 10)
        return cls(count=count, rate=rate, fps=fps, drop=drop)

    @classmethod
    def from_mpeg(cls, bits: int, fps: float) -> Timecode | None:
        """From the 25 bits of an MPEG-2 group of pictures: drop, hours, minutes, marker, seconds, frames."""
        h, m, s, f = bits >> 19 & 31, bits >> 13 & 63, bits >> 6 & 63, bits & 63
        return cls.parse(f"{h:02d}:{m:02d}:{s:02d}{';' if bits >> 24 & 1 else ':'}{f:02d}", fps)

    def after(self, seconds: float) -> Timecode:
        """The time code of the frame that starts this much later; it wraps at midnight."""
        per_day = 24 * 3600 * self.rate - (24 * 54 * (self.rate // 15) if self.drop else 0)
        return replace(self, count=(self.count + round(seconds * self.fps)) % per_day)

    def __str__(self) -> str:
        count = self.count
        if self.drop:
            # Two numbers (four at 60) are left out at each minute but the tenth.
            dropped = self.rate // 15
            tens, rest = divmod(count, 600 * self.rate - 9 * dropped)
            count += 9 * dropped * tens
            if rest >= 60 * self.rate:
                count += dropped * (1 + (rest - 60 * self.rate) // (60 * self.rate - dropped))
        seconds, f = divmod(count, self.rate)
        sign = ";" if self.drop else ":"
        return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{sign}{f:02d}"
