"""A person detector or segmenter that the user brings as an ONNX file, run by onnxruntime (the extra [people]).

No model comes with the program and none is fetched. What an output means is told by its shape and name; the forms are
those that the common open models are exported in:

- (1, C, h, w): classes of pixels (one channel: a logit or a probability of a person).
- (1, 4 + C, n), n the larger: boxes as centre and size in px of the network's picture, then a score for each class.
- (1, n, 5 + C): the same with a score for the box before those of the classes; with places still in cells of strides
  8, 16 and 32 and logarithms of sizes, as YOLOX leaves them, these are worked out.
- logits (1, n, C) and boxes (1, n, 4): centre and size as shares of the picture (DETR and what follows it).
- boxes (n, 4), labels (n,), scores (n,), by these names: corners in px of the network's picture (torchvision, SSD).
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.config import PeopleOptions
from pipelines.decode import Frame
from pipelines.errors import ConfigError, MissingToolError

DEFAULT_SIDE_PX = 640  # of a network that takes any size
STRIDES = (8, 16, 32)
PADDING_GREY = 114  # what detectors are trained to see beside a picture
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}

Array = NDArray[Any]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """People in the network's picture: boxes (n, 4), corners in px; or plane (h, w) bool over it, True = person."""

    boxes: NDArray[np.float64] | None = None
    plane: Mask | None = None


class PersonModel:
    """The user's model as a PeopleSource. What it finds in a frame is kept until that is forgotten: it is asked for in
    two passes, and running it costs more than all else."""

    def __init__(self, options: PeopleOptions, threads: int) -> None:
        """Raises ConfigError: unreadable, or not a network from one picture; MissingToolError: no onnxruntime."""
        try:
            import onnxruntime
        except ImportError:
            raise MissingToolError(
                "people.model", "needs onnxruntime", "pip install 'broadcast-mosaic[people]'"
            ) from None
        assert options.model is not None
        self._options = options
        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads = threads
        settings.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(
                options.model, settings, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its own exception types have no common base
            cause = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(
                options.model, f"cannot be loaded ({cause})", "give an ONNX file of a detector"
            ) from None
        inputs = self._session.get_inputs()
        pictures = [i for i in inputs if len(i.shape) == 4]
        self._others = [i for i in inputs if len(i.shape) != 4]
        if len(pictures) != 1 or pictures[0].type not in DTYPES or pictures[0].shape[1] not in (3, "3"):
            raise ConfigError(
                options.model, "does not take one picture of shape (1, 3, height, width)",
                "export it for single pictures with the channels first",
            )  # fmt: skip
        self._input = pictures[0]
        self._lock = threading.Lock()
        self._known: dict[int, tuple[Found, float]] = {}

    def people(self, frame: Frame, size_px: tuple[int, int]) -> Mask:
        """See PeopleSource."""
        with self._lock:
            if frame.index not in self._known:
                self._known[frame.index] = self._look(frame.picture())
            found, scale = self._known[frame.index]
        return mask_of(found, scale, size_px)

    def forget(self, frame: int) -> None:
        """See PeopleSource."""
        with self._lock:
            self._known = {k: known for k, known in self._known.items() if k > frame}

    def _look(self, picture: NDArray[np.uint8]) -> tuple[Found, float]:
        """What is found in a picture (h, w, 3) RGB, and the network's px for one of the picture's."""
        height, width = (n if isinstance(n, int) and n > 0 else 0 for n in self._input.shape[2:])
        if not height or not width:
            width = width or DEFAULT_SIDE_PX
            height = height or -(-round(width * picture.shape[0] / picture.shape[1]) // 32) * 32
        scale = min(width / picture.shape[1], height / picture.shape[0])
        size = (
            max(1, min(width, round(picture.shape[1] * scale))),
            max(1, min(height, round(picture.shape[0] * scale))),
        )
        boxed = np.full((height, width, 3), PADDING_GREY, np.uint8)
        boxed[: size[1], : size[0]] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        feed: dict[str, Array] = {self._input.name: self._tensor(boxed)}
        for other in self._others:  # the size that boxes are wanted in: width, height
            feed[other.name] = np.array([[width, height]], np.int64)
        values = self._session.run(None, feed)
        outputs = {o.name: np.asarray(v) for o, v in zip(self._session.get_outputs(), values, strict=True)}
        try:
            found = read_outputs(outputs, (width, height), self._options)
        except ValueError as error:
            raise ConfigError(
                self._options.model, str(error), "docs/footage.md lists the forms of outputs that are read"
            ) from None
        return found, scale

    def _tensor(self, picture: NDArray[np.uint8]) -> Array:
        """(1, 3, h, w) as the network was trained: see people.input."""
        dtype = DTYPES[self._input.type]
        values: Array = picture.astype(np.float32)
        if self._options.input == "bgr255":
            values = values[..., ::-1]
        elif dtype != np.uint8:
            values = values / np.float32(255)
        if self._options.input == "imagenet":
            values = (values - np.array(IMAGENET_MEAN, np.float32)) / np.array(IMAGENET_STD, np.float32)
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None].astype(dtype))


def mask_of(found: Found, scale: float, size_px: tuple[int, int]) -> Mask:
    """(h, w) bool over a picture of size_px, True = person. scale: the network's px for one of the picture's."""
    width, height = size_px
    covered = np.zeros((height, width), np.uint8)
    if found.plane is not None:
        M = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2]])
        plane = found.plane.astype(np.uint8)
        covered = np.asarray(
            cv2.warpAffine(plane, M, size_px, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP), np.uint8
        )
    if found.boxes is not None:
        # Whole pixels that they touch by more than rounding.
        first = np.floor(found.boxes[:, :2] / scale + 1e-3).astype(int).clip(0)
        last = np.ceil(found.boxes[:, 2:] / scale - 1e-3).astype(int).clip(0)
        for (x0, y0), (x1, y1) in zip(first, last, strict=True):
            covered[y0:y1, x0:x1] = 1
    return covered > 0


def read_outputs(outputs: Mapping[str, Array], size_px: tuple[int, int], options: PeopleOptions) -> Found:
    """People in a network's outputs, by the forms in the module's first lines; size_px: of the network's picture.

    Raises ValueError, saying what there is, for another form or a class that there is not."""
    shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in outputs.items())
    planes = [v for v in outputs.values() if v.ndim == 4 and v.shape[0] == 1]
    if len(outputs) == 1 and planes:
        return Found(plane=_plane(planes[0][0].astype(np.float32), size_px, options))
    named = {key: v for key in ("boxes", "labels", "scores") for n, v in outputs.items() if key in n.lower()}
    if len(named) == 3:
        boxes, labels, scores = (
            named[key].reshape(-1, *((4,) if key == "boxes" else ())) for key in ("boxes", "labels", "scores")
        )
        chosen = (labels.astype(np.int64) == options.person_class) & (scores >= options.least_score)
        return Found(boxes=boxes[chosen].astype(np.float64))
    triples = [v[0].astype(np.float64) for v in outputs.values() if v.ndim == 3 and v.shape[0] == 1]
    if len(triples) == 2 and sum(v.shape[1] == 4 for v in triples) == 1:
        boxes, logits = sorted(triples, key=lambda v: v.shape[1] != 4)
        scores = 1 / (1 + np.exp(-logits[:, _class_of(logits.shape[1], options)]))
        centred = boxes * np.tile(size_px, 2)
        return Found(boxes=_corners(centred[scores >= options.least_score]))
    if len(triples) == 1 and min(triples[0].shape) > 4:
        return Found(boxes=_one_table(triples[0], size_px, options))
    raise ValueError(f"has outputs of no form that is known ({shapes})")


def _plane(logits: NDArray[np.float32], size_px: tuple[int, int], options: PeopleOptions) -> Mask:
    """(h, w) of the network's picture from scores of pixels (C, h, w)."""
    if len(logits) == 1:
        # A probability stays within 0 and 1, a logit does not.
        middle = options.least_score
        if logits.min() < 0 or logits.max() > 1:
            middle = float(np.log(options.least_score / (1 - options.least_score)))
        person = logits[0] >= middle
    else:
        person = logits.argmax(axis=0) == _class_of(len(logits), options)
    return np.asarray(cv2.resize(person.astype(np.uint8), size_px, interpolation=cv2.INTER_NEAREST) > 0)


def _one_table(
    table: NDArray[np.float64], size_px: tuple[int, int], options: PeopleOptions
) -> NDArray[np.float64]:
    """Corners (n, 4) of boxes in one table, (4 + C, n) or (n, 5 + C)."""
    if table.shape[0] < table.shape[1]:
        places, classes = table[:4].T, table[4:].T
        scores = classes[:, _class_of(classes.shape[1], options)]
    else:
        places, classes = table[:, :4], table[:, 5:]
        scores = table[:, 4] * classes[:, _class_of(classes.shape[1], options)]
        grid, stride = _cells(size_px)
        # Sizes of decoded boxes are px; their logarithms in cells stay small.
        if len(grid) == len(places) and np.abs(places[:, 2:]).max() < np.log(max(size_px)):
            places = np.column_stack([(places[:, :2] + grid) * stride, np.exp(places[:, 2:]) * stride])
    return _corners(places[scores >= options.least_score])


def _cells(size_px: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows (n, 2) of all cells of all strides, and their strides (n, 1), in YOLOX's order."""
    grids, strides = [], []
    for stride in STRIDES:
        x, y = np.meshgrid(np.arange(size_px[0] // stride), np.arange(size_px[1] // stride))
        grids.append(np.stack([x, y], axis=-1).reshape(-1, 2))
        strides.append(np.full((x.size, 1), stride))
    return np.concatenate(grids).astype(np.float64), np.concatenate(strides).astype(np.float64)


def _corners(centred: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners (n, 4) from centre and size (n, 4)."""
    half = centred[:, 2:] / 2
    return np.concatenate([centred[:, :2] - half, centred[:, :2] + half], axis=1)


def _class_of(n_classes: int, options: PeopleOptions) -> int:
    if options.person_class >= n_classes:
        raise ValueError(f"has {n_classes} classes, and no class {options.person_class}")
    return options.person_class
