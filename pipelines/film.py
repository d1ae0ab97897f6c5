"""Small colour pictures of a shot for people, taken while its frames go by a second time, and kept beside its files.

A shot that is not decoded a second time has none; the report then has the tracker's gray ones.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.decode import Frame

PICTURES = 24  # of a shot: twice what a screen has room for; each costs a colour conversion
WIDTH_PX = 160  # 4 KB each
QUALITY = 75  # of the JPEG
# Hidden: scratch of the run, which --resume needs and which is no output.
NAME = ".film.npz"


def chosen(frames: Sequence[int]) -> set[int]:
    """At most PICTURES of a shot's frames, evenly over it, first and last included."""
    places = np.linspace(0, len(frames) - 1, min(len(frames), PICTURES)).round().astype(int)
    return {int(frames[i]) for i in places}


def filmed(frames: Iterator[Frame], wanted: Collection[int], film: dict[int, bytes]) -> Iterator[Frame]:
    """The same frames; a small picture of each wanted one goes into `film` as it passes, with square pixels."""
    for frame in frames:
        if frame.index in wanted and (jpeg := small_jpeg(frame.picture(), frame.pixel_aspect)):
            film[frame.index] = jpeg
        yield frame


def small_jpeg(picture: NDArray[np.uint8], pixel_aspect: float = 1.0) -> bytes:
    """A picture (h, w) or (h, w, 3) RGB, uint8, as a JPEG of WIDTH_PX with square pixels; b'' where OpenCV has none."""
    height = max(1, round(picture.shape[0] * WIDTH_PX / picture.shape[1] / pixel_aspect))
    small = cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    good, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return data.tobytes() if good else b""


def write_film(path: Path, film: Mapping[int, bytes]) -> None:
    """Keep the pictures in one file; nothing is written where there are none."""
    if film:
        lengths = [len(jpeg) for jpeg in film.values()]
        joined = np.frombuffer(b"".join(film.values()), np.uint8)
        np.savez(path, frames=np.array(list(film), np.int64), lengths=np.array(lengths), jpegs=joined)


def read_film(path: Path) -> dict[int, bytes]:
    """What `write_film` wrote; empty where there is no such file or it is damaged."""
    try:
        with np.load(path) as data:
            frames, lengths, joined = data["frames"], data["lengths"], data["jpegs"].tobytes()
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return {}
    ends = np.cumsum(lengths)
    return {
        int(f): joined[end - n : end]
        for f, n, end in zip(frames, lengths.tolist(), ends.tolist(), strict=True)
    }
