"""What is fixed to the screen while the scene moves: scoreboards, logos, letterbox bars. A mask of the usable scene.

Running statistics of a reduced picture over frames between which the camera has moved: where it rests, everything
looks fixed. Edges that stay where they are while the scene passes seed a graphic; the pixels between them that hardly
change fill it (seeds alone find 70 % of a board, small deviation alone takes flat grass along).
Not found: graphics that appear for fewer than `min_samples` samples; those are the robust weights' business.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipelines.config import OverlayOptions
from pipelines.errors import ConfigError

# A small pixel is the width / SMALL_WIDTH wide, 2 to 4 px: what is lost of the scene lies along the rims of graphics, a
# small pixel deep, and the smaller the picture the larger is the share of its pixels that are rim.
SMALL_WIDTH, FINEST, COARSEST = 480, 2, 4
MEMORY = 60  # samples after which old ones fade, so that a board that goes away is let go
EARLY, SPARSE = 3, 5  # times min_samples of them come fast; then so many times rarer: they cost 4 ms at 1080p
MOVING_PX = 0.5  # motion per frame below which the camera rests; jitter must not add up to a pan
# Mean edge strength over its standard error. Samples so near to each other share some of their scene, so Student's t is
# too hopeful: a graphic needs strong seeds, and weak ones belong to it that lie near those.
STRONG_T, SEED_T = 10.0, 5.0
# Shares of the width, because graphics grow with the picture.
NEAR_STRONG = 1 / 80  # three times that when samples come rarely
JOIN = 1 / 32  # seeds this near belong to one graphic: the gap between two words
SEEDS_PX = 24  # length of the edges of each direction in a graphic
DARK_GREY = (
    24.0  # limited-range black is 16; coding noise adds some (formats: 99th percentile <= 24 gave exact bars)
)
BAR_EVERY = 12  # frames between two looks at the bars; they need no motion
MAX_SHARE = 0.4  # of the frame; above it the camera has not really moved, and nothing is said


class OverlayFinder:
    """Feed it every frame with the camera's motion since the one before; ask for the mask at any time."""

    def __init__(self, size_px: tuple[int, int], options: OverlayOptions | None = None) -> None:
        self.size_px = size_px
        self.options = options or OverlayOptions()
        w, h = size_px
        self._given = None if self.options.mask_file is None else read_mask(self.options.mask_file, size_px)
        self._scale = min(max(round(w / SMALL_WIDTH), FINEST), COARSEST)
        small = (h // self._scale, w // self._scale)
        self.n_samples = 0
        self._since_px = np.inf
        self._moments: NDArray[np.float32] = np.zeros(
            (3, 2, *small), np.float32
        )  # of grey, gx, gy: mean, variance
        self._n_updates = 0
        self._n_bar = 0
        self._dark_rows = np.zeros(h)
        self._dark_columns = np.zeros(w)
        self._found: tuple[int, int, NDArray[np.bool_] | None, dict[str, Any]] | None = None

    def update(self, gray: NDArray[Any], motion_px: float) -> None:
        """Take frame `gray` (h, w), 0..255, into account. motion_px: how far the picture moved since the last call.

        NaN motion (a frame that was not registered) and small jitter count as rest. Costs nothing on most frames.
        Raises ValueError when the size is not the one of the finder.
        """
        if not self.options.enabled or self._given is not None:
            return
        if gray.shape != (self.size_px[1], self.size_px[0]):
            raise ValueError(
                f"frame is {gray.shape[1]}x{gray.shape[0]}, finder is {self.size_px[0]}x{self.size_px[1]}"
            )
        if self._n_updates % BAR_EVERY == 0:
            self._look_at_bars(gray)
        self._n_updates += 1
        if np.isfinite(motion_px) and motion_px >= MOVING_PX:
            self._since_px += motion_px
        if self._since_px >= self.options.sample_motion * self.size_px[0] * (1 if self._is_early else SPARSE):
            self._since_px = 0.0
            self._sample(gray)

    @property
    def _is_early(self) -> bool:
        return self.n_samples < EARLY * self.options.min_samples

    def mask(self) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene; None: nothing found, or not enough seen to say."""
        return self._analyse()[0]

    def facts(self) -> dict[str, Any]:
        """For run.json: samples, bars in px, boxes of the graphics (x, y, w, h), masked share, why there are none."""
        return self._analyse()[1]

    def _sample(self, gray: NDArray[Any]) -> None:
        small = _shrink(gray, self._scale)
        gy, gx = np.gradient(small)
        self.n_samples += 1
        weight = np.float32(1.0 / min(self.n_samples, MEMORY))
        for moments, value in zip(self._moments, (small, gx, gy), strict=True):
            mean, variance = moments
            away = value - mean
            mean += weight * away
            variance *= 1 - weight
            variance += weight * (1 - weight) * away**2

    def _look_at_bars(self, gray: NDArray[Any]) -> None:
        step = max(1, self.size_px[0] // 480)
        # The 99th percentile: a few bright pixels of coding noise or a clock do not make a row part of the scene.
        rows = np.percentile(gray[:, ::step], 99, axis=1)
        columns = np.percentile(gray[::step], 99, axis=0)
        if np.percentile(rows, 75) <= 2 * DARK_GREY:
            return  # a black or very dark picture says nothing about bars
        self._n_bar += 1
        self._dark_rows += rows <= DARK_GREY
        self._dark_columns += columns <= DARK_GREY

    def _analyse(self) -> tuple[NDArray[np.bool_] | None, dict[str, Any]]:
        if self._found is None or self._found[:2] != (self.n_samples, self._n_bar):
            mask, facts = self._find()
            if mask is not None:
                mask.setflags(write=False)
            self._found = (self.n_samples, self._n_bar, mask, facts)
        return self._found[2], dict(self._found[3])

    def _find(self) -> tuple[NDArray[np.bool_] | None, dict[str, Any]]:
        w, h = self.size_px
        facts: dict[str, Any] = {
            "enabled": self.options.enabled,
            "samples": self.n_samples,
            "graphics": [],
            "bars": {},
        }
        if self._given is not None and self.options.enabled:
            covered = ~self._given
            facts |= {
                "graphics": _boxes(covered),
                "reason": "",
                "masked_share": float(covered.mean()),
            }
            facts["mask_file"] = self.options.mask_file
            return self._given.copy(), facts
        overlay = np.zeros((h, w), bool)
        top, bottom = _bars(self._dark_rows, self._n_bar)
        left, right = _bars(self._dark_columns, self._n_bar)
        if top or bottom or left or right:
            facts["bars"] = {"top": top, "bottom": bottom, "left": left, "right": right}
            # One px more: the codec rings across the edge of the bar.
            overlay[: top + (top > 0)] = True
            overlay[h - bottom - (bottom > 0) :] = True
            overlay[:, : left + (left > 0)] = True
            overlay[:, w - right - (right > 0) :] = True
        reason = ""
        if self.n_samples < self.options.min_samples:
            reason = "camera_moved_too_little"
        else:
            graphics, boxes = self._graphics()
            if graphics.mean() > MAX_SHARE:
                reason = "too_much_looks_fixed"
            else:
                overlay |= graphics
                facts["graphics"] = boxes
        facts["reason"] = reason
        facts["masked_share"] = float(overlay.mean())
        return (~overlay if overlay.any() else None), facts

    def _graphics(self) -> tuple[NDArray[np.bool_], list[dict[str, int]]]:
        """(h, w) bool True = graphic, and a box (full px) for each."""
        n = min(self.n_samples, MEMORY)
        std, std_x, std_y = np.sqrt(self._moments[:, 1])
        mean_x, mean_y = np.abs(self._moments[1:, 0])
        # Above one deviation always: after many samples a tiny but steady slope (vignetting) would pass the test.
        edge_x = np.where(mean_x > self.options.min_gradient_grey, mean_x / np.maximum(std_x, 1e-3), 0.0)
        edge_y = np.where(mean_y > self.options.min_gradient_grey, mean_y / np.maximum(std_y, 1e-3), 0.0)
        strong_x, strong_y = (edge > max(1.0, STRONG_T / np.sqrt(n)) for edge in (edge_x, edge_y))
        width = std.shape[1]
        reach = max(2, round(width * NEAR_STRONG)) * (1 if self._is_early else 3)
        join = max(4, round(width * JOIN))
        near = _grown(strong_x | strong_y, reach)
        seeds = near & (np.maximum(edge_x, edge_y) > max(1.0, SEED_T / np.sqrt(n)))
        fixed = std < self.options.max_std_grey
        groups, n_groups = ndimage.label(_grown(seeds, join))
        found = np.zeros_like(seeds)
        for group, box in zip(range(1, n_groups + 1), ndimage.find_objects(groups), strict=True):
            mine = groups[box] == group
            # The top edge of the hoardings stays in its row while the camera pans: a graphic has edges both ways.
            if min((strong_x[box] & mine).sum(), (strong_y[box] & mine).sum()) < SEEDS_PX // self._scale:
                continue
            own = seeds[box] & mine
            inside = own | (_between(own) & fixed[box])
            inside = _closed(inside, join // 2)
            inside |= _bridged(inside, 2 * join) & fixed[box]
            found[box] |= _fill_small_holes(inside, found.size // 50)
        return self._to_full(found)

    def _to_full(self, found: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], list[dict[str, int]]]:
        w, h = self.size_px
        full = np.zeros((h, w), bool)
        if not found.any():
            return full, []
        blocks = found.repeat(self._scale, axis=0).repeat(self._scale, axis=1)
        full[: blocks.shape[0], : blocks.shape[1]] = blocks
        # What the reduction left over at the right and at the bottom continues its neighbour.
        full[:, blocks.shape[1] :] = full[:, blocks.shape[1] - 1 : blocks.shape[1]]
        full[blocks.shape[0] :] = full[blocks.shape[0] - 1 : blocks.shape[0]]
        # Graphics lie at the rim: the rectangle that holds them is grown and labelled in a fraction of the time.
        rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
        room = int(np.ceil(self.options.dilate_px))
        y, x = max(0, rows[0] - room), max(0, columns[0] - room)
        part = (slice(y, rows[-1] + 1 + room), slice(x, columns[-1] + 1 + room))
        if self.options.dilate_px:
            full[part] = _grown(full[part], self.options.dilate_px)
        boxes = [box | {"x": box["x"] + int(x), "y": box["y"] + int(y)} for box in _boxes(full[part])]
        return full, boxes


def read_mask(path: str, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """(h, w) bool, True = scene: where a user's picture is brighter than the middle.

    Raises ConfigError: unreadable, another size, all of it covered.
    """
    try:
        if Path(path).exists() and not (Path(path).is_file() or Path(path).is_dir()):  # bytes without end
            raise ConfigError(path, "is a pipe or a device", "give a PNG of the clip's size, white = scene")
        coded = np.frombuffer(Path(path).read_bytes(), np.uint8)
    except OSError as error:
        raise ConfigError(path, f"cannot be read ({error.strerror})", "check the path") from None
    picture = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE) if len(coded) else None
    if picture is None:
        raise ConfigError(path, "cannot be read as a picture", "give a PNG of the clip's size, white = scene")
    if picture.shape != (size_px[1], size_px[0]):
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(
            path, f"is {size}, the clip {size_px[0]}x{size_px[1]}", "give a mask of the clip's size"
        )
    scene = np.asarray(picture > 127)
    if not scene.any():
        raise ConfigError(path, "covers the whole picture", "white is the scene, black what is covered")
    return scene


def both_masks(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """What both masks (True = scene, None = all of it) leave."""
    if a is None or b is None:
        return b if a is None else a
    return a & b


def _boxes(covered: NDArray[np.bool_]) -> list[dict[str, int]]:
    """x, y, w, h in px of each connected region."""
    boxes = []
    for rows, columns in ndimage.find_objects(ndimage.label(covered)[0]):
        x, y = int(columns.start), int(rows.start)
        boxes.append({"x": x, "y": y, "w": int(columns.stop) - x, "h": int(rows.stop) - y})
    return boxes


def _shrink(gray: NDArray[Any], scale: int) -> NDArray[np.float32]:
    """Means of scale x scale blocks; a remainder at the right and at the bottom is left out."""
    h, w = gray.shape[0] // scale, gray.shape[1] // scale
    # Whole columns first: adding four strided views is three times faster than one reshaped mean.
    rows = np.zeros((h, w * scale), np.float32)
    for i in range(scale):
        rows += gray[i : h * scale : scale, : w * scale]
    small = rows[:, 0::scale].copy()
    for i in range(1, scale):
        small += rows[:, i::scale]
    small /= np.float32(scale * scale)
    return small


def _bars(dark: NDArray[np.float64], n: int) -> tuple[int, int]:
    """Lengths of the runs from both ends that are dark in 90 % of the looks; 0 below two px or three looks."""
    if n < 3:
        return 0, 0
    bright = np.flatnonzero(dark < 0.9 * n)
    if len(bright) == 0 or len(bright) < len(dark) // 4:
        return 0, 0
    first, last = int(bright[0]), len(dark) - 1 - int(bright[-1])
    return (first if first >= 2 else 0), (last if last >= 2 else 0)


def _between(seeds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels with seeds on both sides in their row and in their column."""

    def both_sides(a: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
        before = np.maximum.accumulate(a, axis)
        after = np.flip(np.maximum.accumulate(np.flip(a, axis), axis), axis)
        return before & after

    return both_sides(seeds, 0) & both_sides(seeds, 1)


def _bridged(mask: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """The mask with gaps of up to `longest` px in its rows closed: a bar whose edges have the scene's grey there."""
    row = np.ones((1, longest + 1), bool)
    padded = np.pad(mask, ((0, 0), (longest, longest)))
    return np.asarray(ndimage.binary_closing(padded, row)[:, longest : mask.shape[1] + longest], np.bool_)


def _fill_small_holes(mask: NDArray[np.bool_], largest: int) -> NDArray[np.bool_]:
    """Fill enclosed holes of up to `largest` pixels: the changing digits of a clock. A ring stays one."""
    holes, n = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    if n == 0:
        return mask
    sizes = np.bincount(holes.ravel())
    small = sizes <= largest
    small[0] = False
    return mask | small[holes]


def _grown(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Everything within `radius` px of the mask; of an empty one nothing."""
    if not mask.any():
        return mask.copy()
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away <= radius, np.bool_)


def _closed(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """The mask with what a disc of `radius` px cannot enter from outside."""
    room = np.pad(mask, 2 * radius + 1)
    return np.asarray(~_grown(~_grown(room, radius), radius), np.bool_)[
        2 * radius + 1 : -2 * radius - 1, 2 * radius + 1 : -2 * radius - 1
    ]
