"""Where people are, as the user says: pictures of masks, or a detector that the user brings (person_model.py).

Both are optional. Registration leaves people out, and the panorama shows them only where it knows nothing else; without
either, what moves is found by itself (mosaic/moving.py, robust weights).
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.config import PeopleOptions
from pipelines.decode import Frame
from pipelines.errors import ConfigError
from pipelines.stills import is_pattern, list_images

WIDER = 0.004  # widths by which people are made larger: blurred outlines, and boxes that cut a hand off
# A detector that calls more than this of the first pictures people has been told the wrong class.
FIRST, TOO_MUCH = 10, 0.95

Mask = NDArray[np.bool_]


class PeopleSource(Protocol):
    """Says where people are in a picture."""

    def people(self, frame: Frame, size_px: tuple[int, int]) -> Mask:
        """(h, w) bool, True = people; the same answer for the same frame, from any thread."""
        ...

    def forget(self, frame: int) -> None:
        """Frames up to this one are not asked for again."""
        ...


class People:
    """The scene without people, frame by frame, and how much that takes away."""

    def __init__(self, source: PeopleSource, size_px: tuple[int, int], what: str) -> None:
        """what: the user's file or folder, for messages and run.json."""
        self._source, self._size_px, self._what = source, size_px, what
        self._lock = threading.Lock()
        self._shares: dict[int, float] = {}
        self._sum, self._count = 0.0, 0
        side = 2 * max(1, round(WIDER * size_px[0])) + 1
        self._wider = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))

    def scene(self, frame: Frame) -> Mask:
        """(h, w) bool, True = scene. Raises ConfigError: no such mask, or a detector that finds nothing else."""
        people = self._source.people(frame, self._size_px)
        covered = np.asarray(cv2.dilate(people.astype(np.uint8), self._wider) > 0)
        self._note(frame.index, float(covered.mean()))
        return np.asarray(~covered)

    def forget(self, frame: int) -> None:
        """Frames up to this one are done with."""
        self._source.forget(frame)
        with self._lock:
            self._shares = {k: share for k, share in self._shares.items() if k > frame}

    def facts(self) -> dict[str, Any]:
        """For run.json: whence, of how many pictures, and the mean share of a picture that is covered."""
        mean = round(self._sum / self._count, 4) if self._count else None
        return {"source": self._what, "n_frames": self._count, "mean_share": mean}

    def _note(self, index: int, share: float) -> None:
        with self._lock:
            if index in self._shares:
                return  # the second pass asks again
            self._shares[index] = share
            self._sum += share
            self._count += 1
            if self._count == FIRST and self._sum / FIRST > TOO_MUCH:
                raise ConfigError(
                    self._what,
                    f"covers {self._sum / FIRST:.0%} of the first {FIRST} pictures",
                    "white is people in masks; people.person_class is their number in a model",
                )


class MaskFiles:
    """Masks as pictures, one for each picture of the clip, in the order of the numbers in their names."""

    def __init__(self, path: str) -> None:
        """path: a folder, or a pattern as of image sequences. Raises ConfigError: nothing there."""
        self._path = path
        where = Path(path)
        self._files = list_images(where) if where.is_dir() or is_pattern(where) else []
        if not self._files:
            cause = "no images in it" if where.is_dir() else "no such folder, and no file matches the pattern"
            raise ConfigError(path, cause, "give the folder of the masks, or a pattern: 'masks/%06d.png'")

    def people(self, frame: Frame, size_px: tuple[int, int]) -> Mask:
        """See PeopleSource: where the frame's picture is brighter than the middle. Raises ConfigError."""
        if frame.index >= len(self._files):
            cause = f"has {len(self._files)} masks, and none for picture {frame.index} (counted from 0)"
            raise ConfigError(self._path, cause, "give one for each picture of the clip (camera.csv's frame)")
        path = self._files[frame.index]
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise ConfigError(path, "cannot be read as a picture", "give a PNG, white = people")
        width, height = size_px
        if abs(picture.shape[1] * height - picture.shape[0] * width) > max(size_px):
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            raise ConfigError(path, f"is {size}, the clip {width}x{height}", "give masks of the clip's shape")
        return np.asarray(cv2.resize(picture, size_px, interpolation=cv2.INTER_NEAREST) > 127)

    def forget(self, frame: int) -> None:
        """Nothing is kept: files are read again."""


def open_people(options: PeopleOptions, size_px: tuple[int, int], threads: int) -> People | None:
    """What the settings ask for; None: nothing. Raises ConfigError, MissingToolError (no onnxruntime)."""
    if options.masks is not None:
        return People(MaskFiles(options.masks), size_px, options.masks)
    if options.model is not None:
        from pipelines.person_model import PersonModel

        return People(PersonModel(options, threads), size_px, options.model)
    return None
