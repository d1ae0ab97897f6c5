"""Shots that no rotation of the camera explains: a person who fills the picture, and a crowd on its feet.

A close-up is a sprite with sharp texture that walks, turns and bends before grass out of focus, followed by the
camera; others may cross. A crowd is rows of people who jump, one after the other, in front of a camera that pans. The
truth is the place of the ground in the picture (`ground_px`): a track may follow it, or be refused; nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from tests.synth.clip import ClipSpec, _open_stream, _to_video_frame


@dataclass(frozen=True, slots=True, kw_only=True)
class CloseUpSpec:
    """kind: 'person' or 'crowd'. height_share: of the person's visible part over the picture's height. people: who
    cross the picture, the followed one included. blur_px: of the grass, at W = 640. follow: share of the person's way
    that the camera goes along with. wave_px: how high people of a crowd jump, at W = 640."""

    seed: int = 1
    kind: str = "person"
    width: int = 640
    height: int = 360
    n_frames: int = 90
    height_share: float = 0.9
    people: int = 1
    blur_px: float = 5.0
    follow: float = 0.8
    pan_px: float = 250.0  # of the camera over the shot, at W = 640
    wave_px: float = 14.0
    noise_grey: float = 1.5

    def __post_init__(self) -> None:
        if self.kind not in ("person", "crowd"):
            raise ValueError(f"kind {self.kind!r} is none of person, crowd")


def images(spec: CloseUpSpec) -> Iterator[np.ndarray]:
    """(h, w, 3) uint8 RGB of every frame; the same bytes for the same spec."""
    rng = np.random.default_rng([spec.seed, 91])
    noise = np.random.default_rng([spec.seed, 92])
    draw = _person_frames(spec, rng) if spec.kind == "person" else _crowd_frames(spec, rng)
    for picture in draw:
        grain = noise.normal(0, spec.noise_grey, picture.shape[:2])[..., None]
        yield np.clip(picture + grain + 0.5, 0, 255).astype(np.uint8)


def ground_px(spec: CloseUpSpec) -> np.ndarray:
    """(n, 2) px: where every frame looks on the ground (the stand, for a crowd): by so much the ground moves in it."""
    scale = spec.width / 640
    t = np.arange(spec.n_frames) / 25
    u = np.arange(spec.n_frames) / max(spec.n_frames - 1, 1)
    if spec.kind == "crowd":
        return np.stack([spec.pan_px * scale * u, np.zeros_like(u)], axis=-1)
    x = _way(spec, t, u) * spec.follow + 5 * scale * np.sin(4.3 * t + 1)
    return np.stack([x, 8 * scale * np.sin(1.3 * t)], axis=-1)


def _way(spec: CloseUpSpec, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Where the followed person is, px, at times t s, shares u of the shot."""
    scale, direction = spec.width / 640, 1.0 if spec.seed % 2 else -1.0
    return direction * spec.pan_px * scale * (u - 0.5) + 12 * scale * np.sin(1.7 * t)


def write_closeup(path: Path, spec: CloseUpSpec) -> None:
    """Render and encode it as the generator's clips are (H.264, 25 pictures a second)."""
    like = ClipSpec(width=spec.width, height=spec.height, crf=23.0)
    with av.open(str(path), "w") as container:
        stream = _open_stream(container, like)
        for index, image in enumerate(images(spec)):
            picture = _to_video_frame(image, like.pix_fmt)
            picture.pts, picture.time_base = index, 1 / Fraction(like.fps)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def _texture(rng: np.random.Generator, shape: tuple[int, int], cell_px: float) -> np.ndarray:
    """(h, w) float32, about 0 +- 1: noise whose detail is cell_px large."""
    plain = rng.normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(plain, (0, 0), max(cell_px / 2, 0.6))
    return np.asarray(smooth / smooth.std(), np.float32)


def _grass(rng: np.random.Generator, spec: CloseUpSpec, scale: float) -> np.ndarray:
    """(h, w, 3) float32 of grass out of focus, wide enough for the pan."""
    shape = (int(spec.height + 200 * scale), int(spec.width + 2 * (spec.pan_px + 200) * scale))
    fine, coarse = _texture(rng, shape, 3 * scale), _texture(rng, shape, 80 * scale)
    light = 120 + 8 * coarse + 30 * fine
    light = cv2.GaussianBlur(light, (0, 0), spec.blur_px * scale)
    return np.stack([light * 0.78, light * 1.08, light * 0.55], axis=-1)


def _sprite(rng: np.random.Generator, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A person from the hips up: (h, w, 3) float32 colours, (h, w) float32 cover 0..1."""
    width = int(0.8 * height)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = (x - width / 2) / height, y / height

    def body(cx: float, cy: float, rx: float, ry: float) -> np.ndarray:
        return ((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2

    head, trunk = body(0, 0.15, 0.085, 0.12), body(0, 0.75, 0.22, 0.48)
    arms = np.minimum(body(-0.24, 0.72, 0.075, 0.34), body(0.24, 0.72, 0.075, 0.34))
    shirt_colour = rng.uniform(30, 220, 3)
    camouflage = np.sign(_texture(rng, (height, width), 0.05 * height)) * 28
    detail = _texture(rng, (height, width), 0.012 * height) * 12
    colours = np.empty((height, width, 3), np.float32)
    colours[:] = shirt_colour + (camouflage + detail)[..., None]
    stripes = (np.abs(x) < 0.09) & (np.abs(y - 0.68) < 0.11) & (np.sin(x * 90) > 0)
    colours[stripes] = 240 - 0.6 * shirt_colour
    face = np.array([205, 160, 130], np.float32) * rng.uniform(0.5, 1.1)
    colours[head < 1] = face + detail[head < 1, None]
    colours[(head < 1) & (y < 0.11)] = 35 + detail[(head < 1) & (y < 0.11), None] * 2
    shade = 1 - 0.25 * np.clip(np.abs(x) / 0.25, 0, 1) ** 2
    edge = 0.012 * height
    cover = np.clip((1 - np.minimum(np.minimum(head, trunk), arms)) * edge, 0, 1)
    return colours * shade[..., None], cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 1.0)


def _bent(
    sprite: tuple[np.ndarray, np.ndarray], phase: np.ndarray, t: float, turn: float
) -> tuple[np.ndarray, np.ndarray]:
    """The sprite at time t, s: the trunk leans, the head nods, cloth wrinkles, and all turns about the upright."""
    h, w = sprite[1].shape
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    u, v = (x - w / 2) / h, y / h
    narrow = np.cos(turn)
    # A body is round: what turns away is squeezed, and the middle moves sideways against the rim.
    back = np.arcsin(np.clip(u / 0.32, -1, 1)) * 0.32
    du = u / max(narrow, 0.4) - u + 0.12 * np.sin(turn) * np.cos(back / 0.32 * 1.4)
    lean = 0.05 * np.sin(2.1 * t + phase[0]) * (1 - v)
    nod = 0.02 * np.sin(3.7 * t + phase[1]) * np.clip(0.35 - v, 0, 1) / 0.35
    cloth_x = 0.010 * np.sin(14 * v + 5 * t + phase[2]) + 0.006 * np.sin(31 * u + 7.3 * t + phase[3])
    cloth_y = 0.010 * np.sin(17 * u + 4.1 * t + phase[4]) + 0.02 * np.sin(6.3 * t + phase[5]) * np.abs(u) * 3
    at_x = x + h * (du + lean + nod + cloth_x).astype(np.float32)
    at_y = y + h * (cloth_y + 0.5 * nod).astype(np.float32)
    return (
        cv2.remap(sprite[0], at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        cv2.remap(sprite[1], at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT),
    )


def _person_frames(spec: CloseUpSpec, rng: np.random.Generator) -> Iterator[np.ndarray]:
    scale = spec.width / 640
    grass = _grass(rng, spec, scale)
    height = int(spec.height * spec.height_share)
    people = [(_sprite(rng, height), rng.uniform(0, 6.28, 8)) for _ in range(spec.people)]
    direction, looks = 1.0 if spec.seed % 2 else -1.0, ground_px(spec)
    seconds, shares = np.arange(spec.n_frames) / 25, np.arange(spec.n_frames) / max(spec.n_frames - 1, 1)
    ways = _way(spec, seconds, shares)
    for k in range(spec.n_frames):
        t, u, way = float(seconds[k]), float(shares[k]), float(ways[k])
        camera, tilt = (float(v) for v in looks[k])
        x0 = grass.shape[1] / 2 - spec.width / 2 + camera
        picture = cv2.getRectSubPix(
            grass, (spec.width, spec.height), (x0 + spec.width / 2, grass.shape[0] / 2 + tilt)
        ).copy()
        for i, (sprite, phase) in enumerate(people):
            turn = 0.7 * np.sin(1.1 * t + phase[6])
            colours, cover = _bent(sprite, phase, t, turn)
            # The first is followed; others walk through against him.
            x = way - camera if i == 0 else direction * (0.5 - u + 0.3 * i) * spec.width * 1.3
            bob = 6 * scale * np.sin(5.5 * t + phase[7])
            _paste(picture, colours, cover, spec.width / 2 + x, spec.height - height + bob - tilt)
        yield picture


def _paste(
    picture: np.ndarray, colours: np.ndarray, cover: np.ndarray, x_middle: float, y_top: float
) -> None:
    """Put the sprite into the picture (h, w, 3), in place, to a fraction of a pixel."""
    h, w = picture.shape[:2]
    shift = np.array([[1, 0, x_middle - cover.shape[1] / 2], [0, 1, y_top]], np.float64)
    share = cv2.warpAffine(cover, shift, (w, h))[..., None]
    picture *= 1 - share
    picture += share * cv2.warpAffine(colours, shift, (w, h), borderMode=cv2.BORDER_REPLICATE)


def _crowd_frames(spec: CloseUpSpec, rng: np.random.Generator) -> Iterator[np.ndarray]:
    scale = spec.width / 640
    seat = 34 * scale
    columns = int((spec.width + abs(spec.pan_px) * scale) / seat) + 6
    rows = int(spec.height / (0.8 * seat)) + 3
    h = int(1.9 * seat)
    people = [_sprite(rng, h) for _ in range(24)]
    who = rng.integers(0, len(people), (rows, columns))
    phase, pace = rng.uniform(0, 6.28, (rows, columns)), rng.uniform(4.0, 8.0, (rows, columns))
    off = rng.uniform(-0.25, 0.25, (rows, columns)) * seat
    looks = ground_px(spec)
    for k in range(spec.n_frames):
        t, camera = k / 25, float(looks[k, 0])
        picture = np.full((spec.height, spec.width, 3), 60.0, np.float32)
        for row in range(rows):
            for column in range(columns):
                x = (column - 2) * seat + off[row, column] - camera
                if not -h < x < spec.width + h:
                    continue
                # A wave along the stand, and each jumps and leans as he likes.
                up = max(0.0, np.sin(3.2 * t - 0.35 * column)) + 0.5 * max(
                    0.0, np.sin(pace[row, column] * t + phase[row, column])
                )
                x += 0.5 * spec.wave_px * scale * np.sin(0.6 * pace[row, column] * t + 2 * phase[row, column])
                y = (row - 1) * 0.8 * seat - spec.wave_px * scale * up
                colours, cover = people[who[row, column]]
                _paste_small(picture, colours, cover, x, y)
        yield picture


def _paste_small(
    picture: np.ndarray, colours: np.ndarray, cover: np.ndarray, x_middle: float, y_top: float
) -> None:
    """As _paste, for a sprite much smaller than the picture: only where it lies."""
    h, w = picture.shape[:2]
    left, top = int(np.floor(x_middle - cover.shape[1] / 2)), int(np.floor(y_top))
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + cover.shape[1] + 1, w), min(top + cover.shape[0] + 1, h)
    if x0 >= x1 or y0 >= y1:
        return
    part = picture[y0:y1, x0:x1]
    fine = np.array([[1, 0, x_middle - cover.shape[1] / 2 - x0], [0, 1, y_top - y0]], np.float64)
    size = (x1 - x0, y1 - y0)
    share = cv2.warpAffine(cover, fine, size)[..., None]
    part *= 1 - share
    part += share * cv2.warpAffine(colours, fine, size, borderMode=cv2.BORDER_REPLICATE)


def random_closeup(seed: int, *, width: int = 480, n_frames: int = 60) -> CloseUpSpec:
    """A person (three of four) or a crowd: how much of the ground shows, and how sharp it is, goes with the seed."""
    rng = np.random.default_rng([seed, 93])
    return CloseUpSpec(
        seed=seed,
        kind="crowd" if seed % 4 == 3 else "person",
        width=width,
        height=width * 9 // 16 // 2 * 2,
        n_frames=n_frames,
        height_share=float(rng.uniform(0.7, 1.5)),
        people=int(rng.integers(1, 4)),
        blur_px=float(rng.uniform(4, 12)),
        follow=float(rng.uniform(0.7, 1.0)),
        pan_px=float(rng.uniform(100, 400)),
        wave_px=float(rng.uniform(6, 30)),
        noise_grey=float(rng.uniform(1.0, 2.5)),
    )
