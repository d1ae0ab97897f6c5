"""Pairs of pictures with known homographies: stadiums and photographs of real grounds, one condition at a time.

A scene is a venue and a camera move from a seed; a condition is what lies between the scene and the pixels (players,
hoardings, light, noise, blur, codec). The camera model is exact: no lens, no parallax (see families.py for those).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import av
import cv2
import numpy as np

from benchmarks.photographs import PICTURES
from benchmarks.registration.photo_scenes import PhotoScene
from mosaic.coords import normalise_homography, transfer
from tests.synth.camera import SynthCamera
from tests.synth.clip import ClipSpec, SynthClip
from tests.synth.graphics import logo, scoreboard
from tests.synth.paths import PathSpec
from tests.synth.render import Look, finish
from tests.synth.sampling import rgb_to_yuv420

GAPS = (1, 5, 12, 30, 60)
SIZES = {"1080p": (1920, 1080), "720p": (1280, 720), "360p": (640, 360)}
KINDS = {"soccer": "full", "arena": "arena", "grass": "band"}
PHOTOGRAPHS = tuple(PICTURES)
FIRST = 45  # the frame that all pairs of a scene start from, in the middle of the move
N_FRAMES = 150
FPS = 25


class Scene(Protocol):
    """A venue and a camera's move.

    camera(index): of a frame; draw(index): its RGB (h, w, 3) uint8 before light and noise, and its players' cover
    (h, w) uint8, 0 where there is none."""

    seed: int
    size_px: tuple[int, int]

    def camera(self, index: int) -> SynthCamera: ...

    def draw(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """players: share of the picture. hoardings: scrolling, about 10 % of it. overlay: scoreboard and logo, masked.

    gain: of the second picture, or None. blur_px: length of the second picture's motion blur, the first has a third of
    it. codec: options of x264, or None for unencoded pictures.
    """

    players: float = 0.0
    hoardings: bool = False
    overlay: bool = False
    gain: float | None = None
    noise_grey: float = 2.0
    blur_px: float = 0.0
    codec: tuple[tuple[str, str], ...] | None = None


_8M = (("bitrate", "8e6"),)
CONDITIONS = {
    "clean": Condition(),
    "players 10 %": Condition(players=0.10),
    "players 25 %": Condition(players=0.25),
    "players 40 %": Condition(players=0.40),
    "hoardings": Condition(players=0.10, hoardings=True),
    "overlay": Condition(players=0.10, overlay=True),
    "gain .7": Condition(players=0.10, gain=0.7),
    "gain 1.4": Condition(players=0.10, gain=1.4),
    "noise 6": Condition(players=0.10, noise_grey=6.0),
    "blur 6 px": Condition(players=0.10, blur_px=6.0),
    "blur 12 px": Condition(players=0.10, blur_px=12.0),
    "CRF 23": Condition(players=0.10, codec=(("crf", "23"),)),
    "CRF 35": Condition(players=0.10, codec=(("crf", "35"),)),
    "8 Mbit/s": Condition(players=0.10, codec=_8M),
    "8 Mbit/s, players 25 %, hoardings": Condition(players=0.25, hoardings=True, codec=_8M),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """a, b: gray (h, w) uint8. mask_a, mask_b: usable pixels or None. still_a, still_b: without players too (truth).

    H_b_a: truth, px. key: names the pair for resuming.
    """

    key: str
    kind: str
    size: str
    condition: str
    gap: int
    seed: int
    a: np.ndarray
    b: np.ndarray
    mask_a: np.ndarray | None
    mask_b: np.ndarray | None
    still_a: np.ndarray
    still_b: np.ndarray
    H_b_a: np.ndarray


def true_homography(a: SynthCamera, b: SynthCamera) -> np.ndarray:
    """Homography (3, 3) between two views of a camera without lens and parallax."""
    return normalise_homography(b.K @ b.R_cam_world @ a.R_cam_world.T @ np.linalg.inv(a.K))


def corner_error_px(H: np.ndarray, truth: np.ndarray, size_px: tuple[int, int]) -> float:
    """Rms distance over the four corners of the first picture; inf where H loses one."""
    w, h = size_px
    corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1.0]])
    d = transfer(H, corners) - transfer(truth, corners)
    return float(np.sqrt(np.mean(np.sum(d**2, axis=1)))) if np.isfinite(d).all() else float("inf")


class StadiumScene:
    """A painted stadium of the generator, without what `Condition` adds to its pictures."""

    def __init__(self, kind: str, seed: int, size: str, players: float, hoardings: bool) -> None:
        self.seed, self.size_px = seed, SIZES[size]
        rng = np.random.default_rng([seed, 4004])
        path = PathSpec(
            pan_deg=float(rng.uniform(14, 24)),
            zoom=float(rng.uniform(1.2, 1.7)),
            zoom_style="in",
            jitter_px=0.1,
            f0_per_width=1.1 if kind == "arena" else 1.354,
            tilt0_deg=-11 if kind == "arena" else -10.5,
            pan0_deg=float(rng.uniform(-6, 6)),
        )
        self._clip = SynthClip(
            ClipSpec(
                seed=seed, width=self.size_px[0], height=self.size_px[1], path=path, texture=KINDS[kind],
                n_frames=N_FRAMES, player_share=players, n_players=10 if kind == "arena" else 22,
                board_height_m=5.0 if hoardings else 1.6, led_scroll_m_s=2.5 if hoardings else 0.0,
            )
        )  # fmt: skip

    def camera(self, index: int) -> SynthCamera:
        return self._clip.camera(index)

    def draw(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        time_s = index / FPS
        return self._clip.renderer.render(
            self._clip.camera(index), squad=self._clip.squad, time_s=time_s,
            led_shift_m=self._clip.spec.led_scroll_m_s * time_s,
        )  # fmt: skip


def scene_of(
    kind: str, seed: int, size: str, players: float, hoardings: bool, data: Path | None = None
) -> Scene:
    """The scene of a kind of KINDS or PHOTOGRAPHS; data: the folder that the photographs lie in.

    Raises ValueError for a photograph with hoardings (it has none of ours) or without a folder."""
    if kind in KINDS:
        return StadiumScene(kind, seed, size, players, hoardings)
    if hoardings or data is None:
        raise ValueError(f"{kind}: a photograph needs its folder and has no hoardings that scroll")
    return PhotoScene(data, PICTURES[kind], seed, SIZES[size], N_FRAMES, players)


def _motion_kernel(dx: float, dy: float, length_px: float) -> np.ndarray:
    """Point spread (k, k) of a motion of that length along (dx, dy), centred; identity below one pixel."""
    n = int(np.ceil(length_px)) // 2 * 2 + 3
    centre = n // 2
    out = np.zeros((n, n), np.float32)
    norm = max(np.hypot(dx, dy), 1e-9)
    for t in np.linspace(-0.5, 0.5, 64) * max(length_px - 1.0, 0.0):
        x, y = centre + t * dx / norm, centre + t * dy / norm
        ix, iy = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - ix, y - iy
        out[iy, ix] += (1 - fx) * (1 - fy)
        out[iy, ix + 1] += fx * (1 - fy)
        out[iy + 1, ix] += (1 - fx) * fy
        out[iy + 1, ix + 1] += fx * fy
    return out / out.sum()


def picture(
    scene: Scene, index: int, condition: Condition, second: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(RGB, pixels without players and graphics, usable pixels or None) of a frame."""
    image, cover = scene.draw(index)
    if condition.blur_px:
        dx, dy = transfer(true_homography(scene.camera(index - 1), scene.camera(index)), [[0.0, 0.0]])[0]
        length = condition.blur_px if second else condition.blur_px / 3
        kernel = _motion_kernel(dx, dy, length)
        image = cv2.filter2D(image, -1, kernel)
        cover = cv2.filter2D(cover, -1, kernel)
    gain = condition.gain if second and condition.gain is not None else 1.0
    finish(image, Look(gain=gain, noise_grey=condition.noise_grey, noise_seed=scene.seed * 100003 + index))
    still = cover == 0
    usable = None
    if condition.overlay:
        graphic = np.zeros(still.shape, bool)
        for overlay in (scoreboard(*still.shape[::-1]), logo(*still.shape[::-1])):
            overlay.draw(image, graphic, index / FPS)
        usable = cv2.dilate(graphic.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
        still = still & usable
    return image, still, usable


def encoded(
    scene: Scene, condition: Condition, wanted: list[int]
) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """Wanted frames as an encoder and decoder leave them: the Y plane. All from the first to the last are coded."""
    assert condition.codec is not None
    settings = dict(condition.codec)
    w, h = scene.size_px
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = w, h, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 25), Fraction(25)
    if "bitrate" in settings:
        encoder.bit_rate = int(float(settings.pop("bitrate")) * w * h / (1920 * 1080))
    encoder.options = {"preset": "veryfast", **settings}
    still: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
    packets = []
    first = min(wanted)
    for index in range(first, max(wanted) + 1):
        image, without, usable = picture(scene, index, condition, True)
        if index in wanted:
            still[index] = without, usable
        planes = np.empty((h * 3 // 2, w), np.uint8)
        chroma = np.empty((2, h // 2, w // 2), np.uint8)
        rgb_to_yuv420(image, planes[:h], chroma[0], chroma[1])
        planes[h:] = chroma.reshape(h // 2, w)
        frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
        frame.pts = index - first
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    decoder = av.CodecContext.create("h264", "r")
    decoder.extradata = encoder.extradata
    found = {}
    for packet in [*packets, None]:
        for frame in decoder.decode(packet):
            index = first + int(frame.pts)
            if index in still:
                found[index] = (frame.to_ndarray()[:h, :w].copy(), *still[index])
    return found


def pairs_of_scene(
    kind: str,
    seed: int,
    size: str,
    conditions: list[str],
    gaps: tuple[int, ...],
    done: set[str],
    data: Path | None = None,
) -> Iterator[Pair]:
    """All pairs of a scene that are not done, rendered condition by condition; data: where photographs are."""
    scenes: dict[tuple[float, bool], Scene] = {}
    for name in conditions:
        condition = CONDITIONS[name]
        if condition.hoardings and kind in PHOTOGRAPHS:
            continue
        keys = {gap: f"{kind}-{seed}-{size}-{name}-{gap}" for gap in gaps}
        todo = [gap for gap in gaps if keys[gap] not in done]
        if not todo:
            continue
        world = (condition.players, condition.hoardings)
        if world not in scenes:
            scenes.clear()  # a painted world takes 100 MB; conditions that share one follow each other
            scenes[world] = scene_of(kind, seed, size, *world, data)
        scene = scenes[world]
        wanted = [FIRST, *(FIRST + gap for gap in todo)]
        if condition.codec is not None:
            frames = encoded(scene, condition, wanted)
        else:
            frames = {}
            for index in wanted:
                image, still, usable = picture(scene, index, condition, index != FIRST)
                frames[index] = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), still, usable
        a, still_a, mask_a = frames[FIRST]
        for gap in todo:
            b, still_b, mask_b = frames[FIRST + gap]
            yield Pair(
                key=keys[gap], kind=kind, size=size, condition=name, gap=gap, seed=seed, a=a, b=b,
                mask_a=mask_a, mask_b=mask_b, still_a=still_a, still_b=still_b,
                H_b_a=true_homography(scene.camera(FIRST), scene.camera(FIRST + gap)),
            )  # fmt: skip
