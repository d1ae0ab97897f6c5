"""Where the editor joined two views: cuts, dissolves, fades, wipes and animated graphics, from small pictures alone.

Two pictures are of one view when blocks of the one, carried over by the tracked motion, look like the other. At an edit
nothing is left in common between pictures that each agree with their own neighbours; a flash, a player who fills the
frame or a bad registration never has both. Frames of a gradual edit are found by the share of the way from the one view
to the other that each of them goes. Not found: a slide or push (it is a whip pan), a match cut, an edit between two
views that do not hold still for eight frames.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = (160, 90)  # px of the small pictures
BLOCKS = (10, 6)
ALIKE = 0.5  # correlation of a block from which it shows the same thing
LEAST_VARIANCE = 4.0  # grey^2 within a block, below it there is nothing to compare
SPANS = (
    1,
    2,
    3,
    6,
    12,
    24,
    36,
    52,
)  # frames over which nothing may be left in common; the longest edit found
QUICK_SPAN = 6  # much left over these: nothing to look for within them
SLOW_SPAN, SLOW_EVERY = 12, 4  # spans from here on are looked at in every fourth frame
LAG = 8  # frames after an edit that must hold together before it is believed
# Shares of blocks, measured on six generated programmes and four real clips: over an edit .04 to .2 (what is left are
# scoreboards), within a view .4 and more over eight frames, .3 over 36.
NOTHING_LEFT = 0.25
STANDING_LEFT = 0.3  # the same without the motion: a wrong registration may hide that the scene stands still
HOLDS = 0.3  # share left over LAG frames in a view that holds together
FADE_OWN = 0.25
BEGUN_CLEAR = 3.0  # progress over that outside, from which an edit that goes on is believed
ENDS = 0.5  # share left over LAG frames after an edit of which only the beginning was clear
BARELY_KNOWN = 0.3  # taken for a view of which fewer than four frames were seen
# Progress from the one view to the other within the edit, and what as many frames outside of it seem to go.
CUT_GONE, CUT_NOISE = 0.7, 0.15
CUT_LEFT, CUT_ALONE_GONE, CUT_ALONE_NOISE = 0.16, 0.85, 0.1  # a cut to a view that does not hold together
FLASH_LEFT = 0.3  # more in common across a cut: it was a flash
# Progress, its least ratio to that outside, and how well the worse and the better side hold together: any row will do.
GRADUAL = ((0.5, 2.0, 0.25, 0.25), (0.4, 0.5, 0.33, 0.5), (0.2, 0.5, 0.42, 0.5))
# Two pictures that mix lose contrast (.7 to .77 is left in dissolves, .73 to .97 in soft wipes); what runs over
# a picture does not, but moves it at once: 3.9 times what moves beside it. Players who fill the picture do neither
# (.84 to 1.01, and at most 2.1 times).
MIXED_CONTRAST, RUNS_OVER = 0.8, 2.5
LIKE_BEFORE = 0.7  # correlation of the blurred pictures: grass is grass, whatever the registration says
DARK = 0.3  # contrast in the middle of a fade over that of both ends
WINDOW = max(SPANS) + 30  # frames kept
WIDER = 0.12  # of its length: a gradual edit begins and ends softly
STEP_SHARE = 0.3  # of an edit's usual progress per frame: less is outside of it

FloatImage = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class EditFound:
    """The last frame of the one view and the first of the next; those in between show neither. kind: 'cut', else
    'fade' or 'transition'."""

    last: int
    first: int
    kind: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EditPicture:
    """What edits are found by: a picture of SIZE, its details of a middling size (both float32, grey), and how much
    contrast it and these have (grey)."""

    low: FloatImage
    band: FloatImage
    contrast: float
    fine_contrast: float


def edit_picture(gray: NDArray[np.generic]) -> EditPicture:
    """Of a gray picture (h, w), 0..255, any size. It knows nothing of other frames: any thread may make it."""
    small = np.asarray(
        cv2.resize(np.asarray(gray, np.float32), SIZE, interpolation=cv2.INTER_AREA), np.float32
    )
    band = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.5) - cv2.GaussianBlur(small, (0, 0), 8), np.float32)
    return EditPicture(
        low=small, band=band, contrast=float(small.std()),
        fine_contrast=float(np.sqrt(_blocks(band * band)).mean()),
    )  # fmt: skip


@dataclass(slots=True, eq=False)
class _Seen:
    frame: int
    picture: EditPicture
    to_now: NDArray[np.float64]  # motion since some frame before or among those kept, small px
    own: float = float("nan")  # share of blocks kept over LAG frames up to this one
    change: FloatImage | None = (
        None  # since the picture before, that motion does not explain; see EditFinder._change
    )


class EditFinder:
    """Push every frame with the motion from the one before; hands out an edit LAG frames after its end."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        sx, sy = size_px[0] / SIZE[0], size_px[1] / SIZE[1]
        self._up = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
        self._down = np.linalg.inv(self._up)
        self._seen: deque[_Seen] = deque(maxlen=WINDOW)
        self._start = 0  # frames from here belong to the present view
        self._begun: int | None = None  # last frame of the old view in an edit that has not ended yet
        self._begun_at = 0

    def push(self, frame: int, picture: EditPicture, H_step: NDArray[np.float64] | None) -> EditFound | None:
        """H_step: (3, 3) full px from the frame before; None: not registered."""
        H = np.eye(3)
        if H_step is not None and np.isfinite(H_step).all():
            H = self._down @ H_step @ self._up
        if self._seen:
            H = H @ self._seen[-1].to_now
            H /= np.cbrt(np.linalg.det(H)) if np.linalg.det(H) > 0 else 1.0
        self._seen.append(_Seen(frame=frame, picture=picture, to_now=H))
        n = len(self._seen)
        own = self._left(n - 1 - LAG, n - 1) if n > LAG else float("nan")
        self._seen[-1].own = own
        if n <= LAG + 1:
            return None
        return self._look(n - 1 - LAG, own) if own >= HOLDS else self._look_for_cut(n - 1 - LAG)

    def begin(self, frame: int) -> None:
        """The present view begins with this frame: what came before is finished."""
        self._start = frame
        self._begun = None
        # Motion is counted from here on: over the clip it would grow, and lose its digits, without end.
        if self._seen:
            base = next((s for s in self._seen if s.frame >= frame), self._seen[-1])
            away = np.linalg.inv(base.to_now)
            for seen in self._seen:
                seen.to_now = seen.to_now @ away

    def _look_for_cut(self, i: int) -> EditFound | None:
        """A cut to a view that does not hold together (a player who fills the frame): only if all changes at once."""
        j = i - 1
        if self._seen[j].frame < self._start or not self._left(j, i) <= CUT_LEFT:
            return None
        gone, noise = self._progress(j, i)
        if gone < CUT_ALONE_GONE or noise > CUT_ALONE_NOISE or self._is_flash(j, i):
            return None
        return EditFound(last=self._seen[j].frame, first=self._seen[i].frame, kind="cut")

    def _is_flash(self, last: int, first: int) -> bool:
        return self._left(max(0, last - 2), min(first + LAG, len(self._seen) - 1)) > FLASH_LEFT

    def _look(self, i: int, after: float) -> EditFound | None:
        """An edit that ends with the i-th kept frame as the first of the new view."""
        k = i - QUICK_SPAN
        quick = self._left(k, i) if k >= 0 and self._seen[k].frame >= self._start else 0.0
        for span in SPANS:
            j = i - span
            if j < 0 or self._seen[j].frame < self._start:
                break
            if span >= SLOW_SPAN and (self._seen[i].frame - self._start) % SLOW_EVERY:
                continue
            if span < QUICK_SPAN and quick > NOTHING_LEFT:
                continue
            left = quick if span == QUICK_SPAN else self._left(j, i)
            if left > NOTHING_LEFT:
                continue
            if self._left(j, i, moved=False) > STANDING_LEFT:
                continue
            back = max(0, j - LAG)
            while self._seen[back].frame < self._start:
                back += 1
            before = self._left(back, j) if j - back >= 3 else BARELY_KNOWN
            before = before if np.isfinite(before) else BARELY_KNOWN
            found = self._judge(j, i, before, after, overlapping=bool(np.isfinite(left)))
            if found is not None:
                return found
        return self._end_of_begun(i, after)

    def _end_of_begun(self, i: int, after: float) -> EditFound | None:
        """An edit whose beginning was clear ends where the picture first holds together again, with nothing left."""
        last = next((k for k, s in enumerate(self._seen) if s.frame == self._begun), None)
        if last is None or self._seen[last].frame < self._start:
            self._begun = None
            return None
        left = self._left(last, i)
        if left > ALIKE or self._seen[i].frame - self._begun_at > max(SPANS):
            self._begun = None  # the old view is back
        elif (
            after >= ENDS
            and not left > NOTHING_LEFT
            and i - last > LAG
            and self._left(last, i, moved=False) <= STANDING_LEFT
        ):
            return EditFound(last=self._seen[last].frame, first=self._seen[i].frame, kind="transition")
        return None

    def _judge(self, j: int, i: int, before: float, after: float, *, overlapping: bool) -> EditFound | None:
        """overlapping: False where by the tracked motion the two pictures hardly do. In a graphic that runs over the
        picture that motion is none, in a fast pan it is: then only clear progress counts."""
        dark = self._darkest(j, i)
        if dark is not None:
            last, first = self._fade(dark)
        else:
            last, first = (j, i) if i - j == 1 else self._extent(j, i)
        goes_on = first > len(self._seen) - 1 - LAG // 2  # a later look sees its end
        worse, better = min(before, after), max(before, after)
        if dark is None:
            gone, noise = self._progress(last, first)
            if first - last == 1:
                clear = gone >= CUT_GONE and noise <= CUT_NOISE
                clear &= not self._is_flash(last, first)
            else:
                clear = any(
                    gone >= max(g, times * noise) and worse >= w and better >= b
                    for g, times, w, b in (GRADUAL if overlapping else GRADUAL[:1])
                )
                clear &= gone >= RUNS_OVER * noise or self._contrast_left(last, first) < MIXED_CONTRAST
                clear &= not self._looks_like_before(last, first)
            sure = gone >= max(GRADUAL[0][0], BEGUN_CLEAR * noise) and worse >= GRADUAL[1][2]
            if clear and sure and goes_on and self._begun is None:
                self._begun, self._begun_at = self._seen[last].frame, self._seen[i].frame
            if not clear or goes_on:
                return None
            if first - last > 1:
                wider = max(1, round(WIDER * (first - last))) if first - last > QUICK_SPAN else 0
                if gone < GRADUAL[0][0]:
                    last, first, wider = min(last, j), max(first, i), 0
                last, first = max(last - wider, self._first_kept()), min(first + wider, len(self._seen) - 2)
        elif goes_on or not (worse >= FADE_OWN or better >= 2 * FADE_OWN):
            return None
        kind = "cut" if first - last == 1 else "fade" if dark is not None else "transition"
        return EditFound(last=self._seen[last].frame, first=self._seen[first].frame, kind=kind)

    def _between(self, j: int, i: int) -> NDArray[np.float64]:
        H: NDArray[np.float64] = self._seen[i].to_now @ np.linalg.inv(self._seen[j].to_now)
        return H

    def _left(self, j: int, i: int, *, moved: bool = True) -> float:
        """Share of blocks of the i-th picture that the j-th shows as well; NaN where they hardly overlap."""
        b = self._seen[i].picture.band
        a = self._seen[j].picture.band
        if moved:
            a = np.asarray(cv2.warpPerspective(a, self._between(j, i), SIZE, borderValue=-999.0), np.float32)
            inside = (a > -500.0).astype(np.float32)
            a, b = a * inside, b * inside
            area = _blocks(inside)
        else:
            area = np.ones(BLOCKS[::-1], np.float32)
        ab, aa, bb = _blocks(a * b), _blocks(a * a), _blocks(b * b)
        seen = area > 0.5
        told = seen & (np.maximum(aa, bb) > LEAST_VARIANCE * area)
        if seen.sum() < 0.35 * seen.size or told.sum() < 6:
            # Nothing to compare is nothing in common: black, or a plain graphic.
            return 0.0 if seen.sum() >= 0.35 * seen.size else float("nan")
        return float((ab[told] > ALIKE * np.sqrt(aa[told] * bb[told] + 1e-6)).mean())

    def _looks_like_before(self, j: int, i: int) -> bool:
        b = _blurred(self._seen[i].picture.low)
        for H in (self._between(j, i), np.eye(3)):
            a = cv2.warpPerspective(self._seen[j].picture.low, H, SIZE, borderValue=-999.0)
            inside = _blurred(np.where(a < -500.0, np.float32(-1e6), 0.0).astype(np.float32)) > -1.0
            if inside.sum() < 100:
                continue
            now, then = _blurred(np.maximum(a, 0.0))[inside], b[inside]
            # Black, or another even grey, is like nothing.
            if min(now.std(), then.std()) > 0 and np.corrcoef(now, then)[0, 1] > LIKE_BEFORE:
                return True
        return False

    def _darkest(self, j: int, i: int) -> int | None:
        """The picture around an edit that has least contrast, if that is a fade's; None: there is no fade."""
        begin, end = self._first_kept(), len(self._seen) - 1
        contrast = [s.picture.contrast for s in self._seen]
        k = min(range(max(begin, j - 6), min(end, i + 6) + 1), key=contrast.__getitem__)
        sides = max(contrast[begin : k + 1], default=0.0), max(contrast[k : end + 1], default=0.0)
        return k if contrast[k] < DARK * min(sides) else None

    def _contrast_left(self, last: int, first: int) -> float:
        """Least fine contrast within an edit (over three frames) against that of its ends; 1 where it is too short."""
        fine = [s.picture.fine_contrast for s in self._seen]
        begin, end = max(self._first_kept(), last - 4), min(first + 4, len(self._seen) - 1)
        old, new = np.median(fine[begin : last + 1]), np.median(fine[first : end + 1])
        if first - last < 4:
            return 1.0
        smooth = np.convolve(fine[last : first + 1], np.full(3, 1 / 3), "valid")
        way = np.linspace(0.0, 1.0, len(smooth))
        return float((smooth / np.maximum(old + way * (new - old), 1e-6)).min())

    def _fade(self, k: int) -> tuple[int, int]:
        """Last picture of full contrast before the k-th and first one after it."""
        begin, end = self._first_kept(), len(self._seen) - 1
        contrast = [s.picture.contrast for s in self._seen]
        last, first = k, k
        least = 0.005 * max(contrast)
        # Two steps at once: the darkest picture may come twice.
        while last > begin and max(contrast[max(begin, last - 2) : last]) > contrast[last] + least:
            last -= 1
        while first < end and max(contrast[first + 1 : first + 3]) > contrast[first] + least:
            first += 1
        return last, first

    def _first_kept(self) -> int:
        return next((k for k, s in enumerate(self._seen) if s.frame >= self._start), len(self._seen) - 1)

    def _steps(self, begin: int, end: int, way: FloatImage) -> NDArray[np.float64]:
        """Share of the way that each picture from begin + 1 to end goes, whatever motion explains left out."""
        size = float((way * way).sum()) + 1e-6
        steps = np.zeros(end - begin)
        for k in range(begin + 1, end + 1):
            steps[k - begin - 1] = float((self._change(k) * way).sum()) / size
        return steps

    def _change(self, k: int) -> FloatImage:
        """What the k-th picture has, blurred, that motion from the one before does not explain; computed once."""
        seen = self._seen[k]
        if seen.change is None:
            before = cv2.warpPerspective(
                self._seen[k - 1].picture.low, self._between(k - 1, k), SIZE, borderMode=cv2.BORDER_REPLICATE
            )
            seen.change = _blurred(seen.picture.low - before)
        return seen.change

    def _way(self, last: int, first: int) -> FloatImage:
        old, new = _blurred(self._seen[last].picture.low), _blurred(self._seen[first].picture.low)
        return np.asarray(new - new.mean() - (old - old.mean()), np.float32)

    def _progress(self, last: int, first: int) -> tuple[float, float]:
        """How much of the way from the old to the new view the edit goes (1: all of it), and how much as many frames
        outside of it seem to go."""
        begin, end = max(self._first_kept(), last - 15), min(len(self._seen) - 1, first + LAG)
        way = self._way(max(begin, last - 1), min(end, first + 1))
        steps = self._steps(begin, end, way)
        inside = steps[last - begin : first - begin]
        # By the quieter side: a player who fills the frame moves the picture as much as any edit does.
        sides = [np.abs(s).mean() for s in (steps[: last - begin], steps[first - begin :]) if len(s) >= 4]
        return float(inside.sum()), float(min(sides, default=float("inf"))) * (first - last)

    def _extent(self, j: int, i: int) -> tuple[int, int]:
        """The edit's last frame of the old and first of the new view, around the j-th and the i-th frame.

        Each frame's change that motion does not explain, projected on the change from the one view to the other, is the
        share of the way that it goes: about 1 / n in an edit of n frames, nothing outside."""
        begin, end = self._first_kept(), len(self._seen) - 1
        way = self._way(max(begin, j - 6), min(end, i + 6))
        steps = np.zeros(end + 1)
        steps[begin + 1 :] = self._steps(begin, end, way)
        smooth = np.convolve(steps, np.full(3, 1 / 3), "same")
        least = STEP_SHARE * max(float(np.mean(steps[j + 1 : i + 1])), 1e-3)
        last, first = j, i
        # No further than the span itself: a player who runs through the picture may go part of the way by chance.
        while last > max(begin, j - (i - j)) and smooth[last] > least:
            last -= 1
        while first < min(end, i + (i - j)) and smooth[first + 1] > least:
            first += 1
        while last + 1 < first and smooth[last + 1] <= least:
            last += 1
        while first - 1 > last and smooth[first] <= least:
            first -= 1
        return last, first


def _blocks(values: FloatImage) -> FloatImage:
    return np.asarray(cv2.resize(values, BLOCKS, interpolation=cv2.INTER_AREA))


def _blurred(picture: FloatImage) -> FloatImage:
    """A fifth of the size without what is finer than a player."""
    return np.asarray(
        cv2.resize(cv2.GaussianBlur(picture, (0, 0), 3.0), (32, 18), interpolation=cv2.INTER_AREA)
    )
