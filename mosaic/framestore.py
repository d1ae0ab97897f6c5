"""Pictures of the chosen frames, kept in one scratch file on disk between the two passes over a clip.

Read with preadv into arrays of our own: a memory map would count every page touched as resident. What stays in
memory is a small cache and, per frame, a coarse picture for the photometry. It knows nothing of geometry.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.pyramid import block_minimum

COARSE = 16  # px of a frame per pixel of its coarse picture


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredFrame:
    """rgb (h, w, 3) uint8, or uint16 where all bits were asked for; trust (h, w) uint8 or None: 0 = not the scene,
    255 = scene at rest, None = 255 all over.

    Both are smaller by the whole factor `shrink` where a reduced copy was asked for: full px = shrink * px +
    (shrink - 1) / 2.
    """

    rgb: NDArray[Any]
    trust: NDArray[np.uint8] | None
    shrink: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trust:
    """What was made of a mask: where its trust plane lies in the file and its coarse picture, None = 255 all over."""

    mask: NDArray[np.bool_] | None
    offset: int | None
    coarse: NDArray[np.uint8] | None


def _equal(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> bool:
    return a is b if a is None or b is None else np.array_equal(a, b)


def eight_bits(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """A picture of 0..65535 in 0..255, rounded; one of uint8 as it is."""
    if picture.dtype == np.uint8:
        return picture
    return np.asarray((picture.astype(np.uint32) + 128) // 257, np.uint8)


class FrameStore:
    """Scratch store of frames of one size and depth, 8 or 16 bits. Safe to read from several threads; write from one.

    folder: where the scratch file is made (removed again by close()). cache_bytes bounds the frames held in memory.
    mask_margin_px: a mask is widened by this much, because a codec smears an overlay's edge over its neighbours.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        size_px: tuple[int, int],
        *,
        cache_bytes: int = 200_000_000,
        mask_margin_px: int = 3,
    ) -> None:
        self.size_px = (int(size_px[0]), int(size_px[1]))
        if min(self.size_px) < COARSE:
            raise ValueError(f"frames of {size_px} px are too small for a panorama, need {COARSE} each way")
        self.cache_bytes = int(cache_bytes)
        self.mask_margin_px = int(mask_margin_px)
        handle, name = tempfile.mkstemp(prefix="frames-", suffix=".raw", dir=folder)
        self._file, self._path = handle, Path(name)
        self._end = 0
        self._dtype: np.dtype[Any] | None = None  # of the pictures, as the first one has it
        self._offset: dict[int, int] = {}
        self._trust_of: dict[int, int] = {}  # frame -> offset of its trust plane
        self._trust_known: dict[bytes, int] = {}  # digest -> offset: a static overlay is stored once
        self._trust_kept: tuple[int, NDArray[np.uint8]] | None = None
        self._same: _Trust | None = None  # of the frame before: masks seldom change
        self._small: dict[int, tuple[int, int]] = {}  # frame -> offset and block side of its small picture
        self._coarse: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = {}
        self._cache: OrderedDict[tuple[int, int, bool], StoredFrame] = OrderedDict()
        self._cached_bytes = 0
        self._spare: list[NDArray[Any]] = []
        self._still: dict[int, NDArray[np.uint8]] = {}
        self._screen: NDArray[np.bool_] | None = None
        self._loading: dict[tuple[int, int, bool], threading.Event] = {}
        self._lock = threading.Lock()

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers stored, in ascending order."""
        return tuple(sorted(self._offset))

    @property
    def deep(self) -> bool:
        """Whether the pictures have more than 8 bits."""
        return self._dtype == np.uint16

    @property
    def bytes_on_disk(self) -> int:
        return self._end

    def __contains__(self, frame: int) -> bool:
        return frame in self._offset

    def put(
        self,
        frame: int,
        rgb: NDArray[Any],
        mask: NDArray[np.bool_] | None = None,
        trust: NDArray[np.uint8] | NDArray[np.floating] | None = None,
        small: NDArray[np.uint8] | None = None,
    ) -> None:
        """Store one frame.

        rgb (h, w, 3) uint8, or uint16 of 0..65535; all alike. mask (h, w) bool, True = usable scene. trust (h, w): how
        sure it is that a pixel shows the scene at rest, float 0..1 or uint8 0..255; low where something moves. small
        (h // s, w // s, 3) uint8: its mean over blocks of s x s px, if the caller has it (any s of 2 or more): smaller
        pictures are then made from this one. Raises ValueError on a wrong shape or dtype, or a frame that is already
        there.
        """
        width, height = self.size_px
        wanted = (self._dtype,) if self._dtype is not None else (np.dtype(np.uint8), np.dtype(np.uint16))
        if rgb.shape != (height, width, 3) or rgb.dtype not in wanted:
            raise ValueError(
                f"frame {frame} is {rgb.dtype} {rgb.shape}, need {wanted[0]} {(height, width, 3)}"
            )
        if frame in self._offset:
            raise ValueError(f"frame {frame} is stored already")
        coarse_size = (width // COARSE, height // COARSE)
        cut = np.s_[: coarse_size[1] * COARSE, : coarse_size[0] * COARSE]
        shrink = 1
        if small is not None:
            shrink = round(width / small.shape[1])
            if small.shape != (height // shrink, width // shrink, 3) or small.dtype != np.uint8 or shrink < 2:
                raise ValueError(f"small is {small.dtype} {small.shape}, of a frame {(height, width, 3)}")
        mean = self._mean_over_blocks(rgb if small is None else small, shrink, COARSE)
        if mean is None:
            mean = self._mean_over_blocks(rgb, 1, COARSE)
        assert mean is not None
        coarse = eight_bits(mean)
        if trust is not None or self._same is None or not _equal(self._same.mask, mask):
            plane = self._trust_plane(mask, trust)
            same = _Trust(mask=None if mask is None else mask.copy(), offset=None, coarse=None)
            if plane is not None:
                # A block with any masked pixel is not a measurement.
                same = replace(same, offset=self._put_trust(plane), coarse=block_minimum(plane[cut], COARSE))
            self._same = same if trust is None else None
        else:
            same = self._same
        if same.offset is not None:
            self._trust_of[frame] = same.offset
        coarse_trust = np.full(coarse_size[::-1], 255, np.uint8) if same.coarse is None else same.coarse
        self._coarse[frame] = (coarse, coarse_trust)
        self._dtype = rgb.dtype
        self._offset[frame] = self._append(np.ascontiguousarray(rgb))
        if small is not None:
            self._small[frame] = (self._append(np.ascontiguousarray(small)), shrink)

    def _mean_over_blocks(self, picture: NDArray[Any], shrink: int, wanted: int) -> NDArray[Any] | None:
        """A frame's mean over blocks of `wanted` px, from its picture of blocks of `shrink`; None: their edges do not
        meet."""
        size = (self.size_px[0] // wanted, self.size_px[1] // wanted)
        width, height = (n * wanted for n in size)
        if width % shrink or height % shrink or wanted < shrink:
            return None
        cut = picture[: height // shrink, : width // shrink]
        return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), picture.dtype)

    def put_still(self, frame: int, plane: NDArray[np.uint8]) -> None:
        """How sure it is that a frame's pixels are at rest, found later than its picture: (h, w) uint8 at any
        resolution over the frame, 255 = at rest, low = moves, 0 = not the scene. Kept in memory."""
        if plane.ndim != 2 or plane.dtype != np.uint8:
            raise ValueError(f"plane of frame {frame} is {plane.dtype} {plane.shape}, need uint8 (h, w)")
        self._still[frame] = plane

    def put_screen(self, mask: NDArray[np.bool_] | None) -> None:
        """What is stuck to the screen in all frames: (h, w) bool at any resolution, True = scene; None: nothing."""
        self._screen = mask

    def still(self, frame: int) -> NDArray[np.uint8]:
        """put_still's plane with 0 under the screen's graphics; 255 all over where nothing is known."""
        plane = self._still.get(frame)
        if self._screen is None:
            return np.full((1, 1), 255, np.uint8) if plane is None else plane
        if plane is None:
            return np.where(self._screen, np.uint8(255), np.uint8(0))
        size = (plane.shape[1], plane.shape[0])
        scene = self._screen
        if scene.shape != plane.shape:
            scene = cv2.resize(scene.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        return np.where(scene, plane, np.uint8(0))

    def _trust_plane(
        self, mask: NDArray[np.bool_] | None, trust: NDArray[np.uint8] | NDArray[np.floating] | None
    ) -> NDArray[np.uint8] | None:
        shape = self.size_px[::-1]
        plane: NDArray[np.uint8] | None = None
        if mask is not None:
            if mask.shape != shape or mask.dtype != np.bool_:
                raise ValueError(f"mask is {mask.dtype} {mask.shape}, need bool {shape}")
            side = 2 * self.mask_margin_px + 1
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
            # Outside the picture counts as usable, or every frame would lose its border.
            shrunk = cv2.erode(
                mask.astype(np.uint8) * 255, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=255
            )
            plane = np.asarray(shrunk, dtype=np.uint8)
        if trust is not None:
            if trust.shape != shape:
                raise ValueError(f"trust has shape {trust.shape}, need {shape}")
            if trust.dtype == np.uint8:
                level = trust.astype(np.uint8)
            else:
                level = np.rint(np.clip(np.nan_to_num(trust, nan=0.0), 0.0, 1.0) * 255).astype(np.uint8)
            plane = level if plane is None else np.minimum(plane, level)
        return plane

    def _put_trust(self, plane: NDArray[np.uint8]) -> int:
        digest = hashlib.blake2b(np.ascontiguousarray(plane).data, digest_size=16).digest()
        if digest not in self._trust_known:
            self._trust_known[digest] = self._append(np.ascontiguousarray(plane))
        return self._trust_known[digest]

    def _append(self, array: NDArray[Any]) -> int:
        offset, view = self._end, array.data.cast("B")
        while view:
            written = os.pwrite(self._file, view, self._end)
            self._end += written
            view = view[written:]
        return offset

    def _read(self, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any] | None = None) -> NDArray[Any]:
        array = self._buffer(shape, dtype or np.dtype(np.uint8))
        self._fill(array, offset)
        return array

    def _fill(self, array: NDArray[Any], offset: int) -> None:
        view = array.data.cast("B")
        while view:
            n_bytes = os.preadv(self._file, [view], offset)
            if n_bytes == 0:
                raise OSError(f"scratch file {self._path} ends at byte {offset}: it was cut while in use")
            offset += n_bytes
            view = view[n_bytes:]

    def get(self, frame: int, shrink: int = 1, *, deep: bool = False) -> StoredFrame:
        """The frame, or its mean over blocks of shrink x shrink px, in 8 bits; deep: as it was stored. Raises KeyError
        for a frame not stored."""
        key = (frame, shrink, deep and self.deep)
        while True:
            with self._lock:
                if key in self._cache:
                    self._cache.move_to_end(key)
                    return self._cache[key]
                other = self._loading.get(key)
                if other is None:
                    self._loading[key] = threading.Event()
                    break
            other.wait()  # another thread reads it just now
        try:
            stored = self._load(*key)
            with self._lock:
                self._remember(key, stored)
        finally:
            with self._lock:
                self._loading.pop(key).set()
        return stored

    def rows(self, frame: int, first: int, last: int, buffer: NDArray[Any]) -> NDArray[Any]:
        """Rows first to last - 1 of a frame's picture, (last - first, w, 3), as stored, in `buffer`, a flat one of that
        dtype and a frame's size or more. Past the cache: who needs a part of many frames would only fill it. Raises
        KeyError for a frame not stored."""
        stride = 3 * self.size_px[0]
        part = buffer[: (last - first) * stride]
        self._fill(part, self._offset[frame] + first * stride * part.itemsize)
        return part.reshape(last - first, self.size_px[0], 3)

    def trust(self, frame: int) -> NDArray[np.uint8] | None:
        """The frame's trust plane (h, w) uint8 at full size, None = 255 all over."""
        return self._read_trust(frame)

    def _load(self, frame: int, shrink: int, deep: bool) -> StoredFrame:
        width, height = self.size_px
        trust = self._read_trust(frame)
        if shrink == 1:
            whole = self._read(self._offset[frame], (height, width, 3), self._dtype)
            return StoredFrame(rgb=whole if deep else eight_bits(whole), trust=trust)
        if trust is not None:
            trust = block_minimum(trust[: height // shrink * shrink, : width // shrink * shrink], shrink)
        return StoredFrame(rgb=self._reduced(frame, shrink, deep), trust=trust, shrink=shrink)

    def _reduced(self, frame: int, shrink: int, deep: bool) -> NDArray[Any]:
        width, height = self.size_px
        if frame in self._small and not deep:
            offset, side = self._small[frame]
            small = self._read(offset, (height // side, width // side, 3))
            reduced = self._mean_over_blocks(small, side, shrink)
            if reduced is not None:
                return reduced
        whole = self._read(self._offset[frame], (height, width, 3), self._dtype)
        reduced = self._mean_over_blocks(whole, 1, shrink)
        assert reduced is not None
        with self._lock:
            if len(self._spare) < 2:
                self._spare.append(whole)
        return reduced if deep else eight_bits(reduced)

    def _read_trust(self, frame: int) -> NDArray[np.uint8] | None:
        offset = self._trust_of.get(frame)
        if offset is None:
            return None
        with self._lock:
            if self._trust_kept is not None and self._trust_kept[0] == offset:
                return self._trust_kept[1]
        plane = self._read(offset, self.size_px[::-1])
        with self._lock:
            self._trust_kept = (offset, plane)
        return plane

    def _remember(self, key: tuple[int, int, bool], stored: StoredFrame) -> None:
        if key in self._cache:
            return
        self._cache[key] = stored
        self._cached_bytes += stored.rgb.nbytes
        while self._cached_bytes > self.cache_bytes and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= dropped.rgb.nbytes
            # Two references each: the name here (or the attribute) and getrefcount's own. Nobody else reads it.
            if len(self._spare) < 2 and sys.getrefcount(dropped) == 2 and sys.getrefcount(dropped.rgb) == 2:
                self._spare.append(dropped.rgb)

    def _buffer(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """An array to read into, if possible one that the cache dropped: fresh pages cost more than the reading (4 ms
        against 1 ms a 1080p frame), and the heap keeps holes of those that come and go."""
        with self._lock:
            for i, spare in enumerate(self._spare):
                if spare.shape == shape and spare.dtype == dtype:
                    return self._spare.pop(i)
        return np.empty(shape, dtype)

    def coarse(self, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Mean colour (h/16, w/16, 3) and least trust (h/16, w/16) of blocks of 16 x 16 px, both uint8."""
        return self._coarse[frame]

    def close(self) -> None:
        """Remove the scratch file. May be called twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._path.unlink(missing_ok=True)
            self._cache.clear()
            self._spare.clear()
            self._cached_bytes = 0

    def __enter__(self) -> FrameStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
