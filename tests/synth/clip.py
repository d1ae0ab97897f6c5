"""Clips with known cameras: specification -> frames -> H.264 file and truth CSV, streamed.

`python -m tests.synth.clip --out X.mp4 --seed 1 --pan 20 --zoom 1.6` writes X.mp4 and X-truth.csv. Truth angles
are in head axes: pan about the pan axis, levelled; an estimate in its reference camera's axes differs by a constant
rotation.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from tests.synth.camera import SynthCamera
from tests.synth.graphics import Overlay, logo, scoreboard, ticker
from tests.synth.paths import CameraPath, LensSpec, PathSpec, ease
from tests.synth.players import Squad, draw_players, make_squad
from tests.synth.render import Look, Renderer, finish
from tests.synth.sampling import rgb_to_yuv420
from tests.synth.world import WorldSpec, make_world

TRUTH_COLUMNS = (
    "frame", "pts_s", "f_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "aspect", "k1", "shot",
)  # fmt: skip
_BITRATE_1080P25 = 8e6
# x264's macroblock tree reads rows below the picture's last whole macroblock that nobody has written: the same frames
# come out differently from run to run (heights of 180 and 540; never seen where half a macroblock is left, as at 1080).
_MACROBLOCK_PX = 16
_ROW_STEP_PX = 0.7  # of motion between the pictures that a rolling shutter's rows are mixed from
_BLUR_STEP_PX = 1.5  # spacing of the sub-exposures of motion blur


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipSpec:
    """One shot. Everything random comes from `seed`; world_seed, when given, keeps the venue while the rest changes.

    player_share: wanted mean share of the picture's pixels (None: players of 1.8 m). led_scroll_m_s: speed of the
    hoardings' content; led_flip_s: seconds between switches (0: never). crowd_sway_m: how far people in the stands
    lean. exposure_drift: relative amplitude of a slow sine; exposure_ramp_stops: change over the shot. flicker:
    relative amplitude from frame to frame. shutter: exposure over frame time (0: no motion blur). readout: time from
    the first row to the last over frame time (rolling shutter; the truth is the middle row's camera). duplicate_every:
    every n-th frame repeats the one before (0: none).
    crf replaces bitrate_bit_s (None: 8 Mbit/s at 1080p25, in proportion).
    """

    seed: int = 1
    world_seed: int | None = None
    width: int = 1920
    height: int = 1080
    fps: Fraction = Fraction(25)
    n_frames: int = 150
    path: PathSpec = field(default_factory=PathSpec)
    lens: LensSpec = field(default_factory=LensSpec)
    texture: str = "full"
    board_height_m: float = 1.6
    camera_moved_m: tuple[float, float] = (0.0, 0.0)  # towards the pitch and up: another camera position
    max_px_per_rad: float = 5000.0
    n_players: int = 22
    player_share: float | None = 0.10
    standing_players: int = 0
    led_scroll_m_s: float = 0.0
    led_flip_s: float = 0.0
    crowd_sway_m: float = 0.0
    scoreboard: bool = True
    logo: bool = True
    ticker: bool = False
    noise_grey: float = 2.0
    exposure_drift: float = 0.03
    exposure_ramp_stops: float = 0.0
    flicker: float = 0.0
    flash_frame: int | None = None
    vignette: float = 0.0
    shutter: float = 0.0
    readout: float = 0.0
    duplicate_every: int = 0
    codec: str = "libx264"
    pix_fmt: str = "yuv420p"
    bitrate_bit_s: float | None = None
    crf: float | None = None
    x264_preset: str = "veryfast"

    def __post_init__(self) -> None:
        if self.width % 2 or self.height % 2:
            raise ValueError(f"size {self.width}x{self.height}: 4:2:0 needs even sizes")
        if self.shutter and self.readout:
            raise ValueError("shutter and readout together are not rendered")
        if self.n_frames < 1:
            raise ValueError(f"n_frames {self.n_frames} < 1")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SynthFrame:
    """image (h, w, 3) uint8 RGB as sent to the encoder; player_mask, overlay_mask (h, w) bool, True = covered."""

    index: int
    pts_s: float
    camera: SynthCamera
    image: np.ndarray
    player_mask: np.ndarray
    overlay_mask: np.ndarray


class SynthClip:
    """A spec with its world painted: frames on demand, in any order, always the same bytes."""

    def __init__(self, spec: ClipSpec) -> None:
        self.spec = spec
        self.path = CameraPath(
            spec=spec.path,
            lens=spec.lens,
            width=spec.width,
            height=spec.height,
            n_frames=spec.n_frames,
            seed=spec.seed,
        )
        self._shown = self.path.cameras()
        longest = max(c.f_px for c in self._shown)
        world_seed = spec.seed if spec.world_seed is None else spec.world_seed
        world_spec = WorldSpec(
            seed=world_seed,
            texture=spec.texture,
            px_per_rad=min(longest, spec.max_px_per_rad),
            board_height_m=spec.board_height_m,
            camera_moved_m=spec.camera_moved_m,
        )
        self.world = make_world(world_spec, self._shown)
        self.renderer = Renderer(world=self.world)
        self.squad = _make_squad(spec, self._shown, self.renderer)
        rng = np.random.default_rng([spec.seed, 55])
        self._phase = rng.uniform(0, 2 * np.pi, 2)
        self._overlays: list[Overlay] = []
        if spec.scoreboard:
            self._overlays.append(scoreboard(spec.width, spec.height))
        if spec.logo:
            self._overlays.append(logo(spec.width, spec.height))
        if spec.ticker:
            self._overlays.append(ticker(spec.width, spec.height))

    def source_index(self, index: int) -> int:
        """The frame whose picture frame `index` shows: itself, or the one before where the clip repeats one."""
        n = self.spec.duplicate_every
        return index - 1 if n and index % n == n - 1 else index

    def camera(self, index: int) -> SynthCamera:
        """True camera of the picture that frame `index` shows."""
        return self._shown[self.source_index(index)]

    @property
    def cameras(self) -> list[SynthCamera]:
        return [self.camera(k) for k in range(self.spec.n_frames)]

    def look(self, index: int) -> Look:
        """Exposure and sensor of a frame."""
        s = self.spec
        u = index / max(s.n_frames - 1, 1)
        gain = 1 + s.exposure_drift * np.sin(2 * np.pi * 1.3 * u + self._phase[0])
        gain *= 2.0 ** (s.exposure_ramp_stops * (float(ease(u)) - 0.5))
        gain *= 1 + s.flicker * np.sin(2.4 * index + self._phase[1])  # 50 Hz light at 25 fps beats like this
        offset = 0.0
        if s.flash_frame is not None and index == s.flash_frame:
            gain, offset = gain * 1.9, 60.0
        return Look(
            gain=float(gain),
            offset=offset,
            vignette=s.vignette,
            noise_grey=s.noise_grey,
            noise_seed=s.seed * 100003 + index,
        )

    def frame(self, index: int) -> SynthFrame:
        """Render frame `index` whole: scene, players, light, noise, graphics."""
        source = self.source_index(index)
        image, cover = self._expose_scene(source)
        finish(image, self.look(source))
        overlay_mask = np.zeros(cover.shape, bool)
        for overlay in self._overlays:
            overlay.draw(image, overlay_mask, source / float(self.spec.fps))
        return SynthFrame(
            index=index,
            pts_s=float(index / self.spec.fps),
            camera=self._shown[source],
            image=image,
            player_mask=cover > 0,
            overlay_mask=overlay_mask,
        )

    def frames(self) -> Iterator[SynthFrame]:
        """All frames in order, one at a time."""
        last: SynthFrame | None = None
        for index in range(self.spec.n_frames):
            if last is not None and self.source_index(index) == last.index:
                last = SynthFrame(
                    index=index, pts_s=float(index / self.spec.fps), camera=last.camera, image=last.image,
                    player_mask=last.player_mask, overlay_mask=last.overlay_mask,
                )  # fmt: skip
            else:
                last = self.frame(index)
            yield last

    def render_clean(self, index: int) -> np.ndarray:
        """Frame `index` without players, light, noise, graphics and with still hoardings."""
        return self.renderer.render_clean(self.camera(index))

    def _led_shift(self, t: float) -> float:
        seconds = t / float(self.spec.fps)
        shift = self.spec.led_scroll_m_s * seconds
        if self.spec.led_flip_s > 0:
            shift += 37.3 * int(seconds / self.spec.led_flip_s)
        return shift

    def _scene(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        camera = self.path.camera(t)
        seconds = t / float(self.spec.fps)
        return self.renderer.render(
            camera,
            squad=self.squad,
            time_s=seconds,
            led_shift_m=self._led_shift(t),
            sway_m=self.spec.crowd_sway_m,
        )

    def _expose_scene(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The scene, averaged over the time that the shutter is open."""
        half = self.spec.shutter / 2
        if self.spec.readout:
            return self._read_by_rows(index)
        if half == 0:
            return self._scene(float(index))
        n = int(np.clip(np.ceil(self._smear_px(index, half) / _BLUR_STEP_PX), 2, 24))
        total = np.zeros((self.spec.height, self.spec.width, 3), np.float32)
        covered = np.zeros((self.spec.height, self.spec.width), np.uint8)
        for t in index + self.spec.shutter * ((np.arange(n) + 0.5) / n - 0.5):
            image, cover = self._scene(float(t))
            total += image
            covered = np.maximum(covered, cover)
        return (total / n + 0.5).astype(np.uint8), covered

    def _smear_px(self, index: int, half: float) -> float:
        """How far a corner or the centre goes within `half` a span of frame times before and after a frame."""
        corners = np.array(
            [[0.0, 0.0], [self.spec.width, self.spec.height], [self.spec.width / 2, self.spec.height / 2]]
        )
        a, b = self.path.camera(index - half), self.path.camera(index + half)
        return float(np.nanmax(np.linalg.norm(b.ray_to_pixel(a.pixel_to_ray(corners)) - corners, axis=-1)))

    def _read_by_rows(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The scene, each row at its own time: mixed from whole pictures less than a pixel of motion apart."""
        height, share = self.spec.height, self.spec.readout
        n = int(np.clip(np.ceil(self._smear_px(index, share / 2) / _ROW_STEP_PX), 1, 24))
        at = ((np.arange(height) + 0.5) / height) * n  # row by row, in steps between pictures
        image = np.zeros((height, self.spec.width, 3), np.float32)
        covered = np.zeros((height, self.spec.width), np.uint8)
        for k in range(n + 1):
            weight = np.maximum(1 - np.abs(at - k), 0).astype(np.float32)
            rows = np.flatnonzero(weight)
            if not len(rows):
                continue
            part, cover = self._scene(index + share * (k / n - 0.5))
            image[rows] += weight[rows, None, None] * part[rows]
            covered[rows] = np.maximum(covered[rows], cover[rows])
        return (image + 0.5).astype(np.uint8), covered


def _quarter(camera: SynthCamera) -> SynthCamera:
    """The same view at a quarter of the size, to count player pixels cheaply."""
    return SynthCamera(
        width=camera.width // 4, height=camera.height // 4, f_px=camera.f_px / 4, pan_rad=camera.pan_rad,
        tilt_rad=camera.tilt_rad, roll_rad=camera.roll_rad, cx_px=(camera.cx_px + 0.5) / 4 - 0.5,
        cy_px=(camera.cy_px + 0.5) / 4 - 0.5, k1_half=camera.k1_half, aspect=camera.aspect, pupil_m=camera.pupil_m,
    )  # fmt: skip


def _make_squad(spec: ClipSpec, cameras: list[SynthCamera], renderer: Renderer) -> Squad | None:
    """Players, enlarged by bisection until their mean share of the pixels is what the spec asks for."""
    if spec.n_players == 0 or spec.player_share == 0:
        return None
    stadium = renderer.world.stadium
    duration_s = spec.n_frames / float(spec.fps)

    def squad(scale: float) -> Squad:
        return make_squad(
            seed=spec.seed, n=spec.n_players, cameras=cameras, stadium=stadium, scale=scale,
            standing=spec.standing_players, duration_s=duration_s,
        )  # fmt: skip

    if spec.player_share is None:
        return squad(1.0)
    picks = np.unique(np.linspace(0, len(cameras) - 1, 7).astype(int))

    def share(candidate: Squad) -> float:
        total = 0.0
        for k in picks:
            small = _quarter(cameras[k])
            image = np.zeros((small.height, small.width, 3), np.uint8)
            cover = np.zeros(image.shape[:2], np.uint8)
            draw_players(image, cover, candidate, small, stadium, k / float(spec.fps))
            total += float((cover > 127).mean())
        return total / len(picks)

    lo, hi = 0.3, 14.0
    for _ in range(10):
        middle = float(np.sqrt(lo * hi))
        lo, hi = (middle, hi) if share(squad(middle)) < spec.player_share else (lo, middle)
    return squad(float(np.sqrt(lo * hi)))


def truth_row(camera: SynthCamera, *, frame: int, pts_s: float, shot: int) -> dict[str, str]:
    """One line of the truth file, units of camera.csv; the k1 is OpenCV's."""
    values = (
        camera.f_px, np.rad2deg(camera.pan_rad), np.rad2deg(camera.tilt_rad), np.rad2deg(camera.roll_rad),
        camera.cx_px, camera.cy_px, camera.aspect, camera.k1_opencv,
    )  # fmt: skip
    cells = [str(frame), f"{pts_s:.6f}", *(f"{v:.10g}" for v in values), str(shot)]
    return dict(zip(TRUTH_COLUMNS, cells, strict=True))


def truth_path(video: Path) -> Path:
    """Where the truth of a clip lies: X.mp4 -> X-truth.csv."""
    return video.with_name(video.stem + "-truth.csv")


def read_truth(path: Path) -> dict[str, np.ndarray]:
    """Truth CSV -> column name: array; frame and shot as int64, the rest float64."""
    with open(path, newline="", encoding="ascii") as handle:
        rows = list(csv.DictReader(handle))
    return {
        name: np.array([float(r[name]) for r in rows]).astype(
            np.int64 if name in ("frame", "shot") else np.float64
        )
        for name in TRUTH_COLUMNS
    }


def write_clip(path: Path | str, specs: ClipSpec | Sequence[ClipSpec]) -> Path:
    """Render and encode one shot, or several with cuts between them, and write the truth beside it.

    Frames go to the encoder one by one. Returns the truth's path. All shots must agree in size, rate and codec.
    """
    path = Path(path)
    shots = [specs] if isinstance(specs, ClipSpec) else list(specs)
    first = shots[0]
    for other in shots[1:]:
        for name in ("width", "height", "fps", "codec", "pix_fmt"):
            if getattr(other, name) != getattr(first, name):
                raise ValueError(f"shots differ in {name}: {getattr(other, name)} and {getattr(first, name)}")
    partial = path.with_name("." + path.name)
    with (
        av.open(str(partial), "w", format=_container(path)) as container,
        open(truth_path(path), "w", newline="", encoding="ascii") as handle,
    ):
        stream = _open_stream(container, first)
        truth = csv.DictWriter(handle, TRUTH_COLUMNS, lineterminator="\n")
        truth.writeheader()
        index = 0
        for shot, spec in enumerate(shots):
            for frame in SynthClip(spec).frames():
                picture = _to_video_frame(frame.image, first.pix_fmt)
                picture.pts, picture.time_base = index, 1 / first.fps
                container.mux(stream.encode(picture))
                truth.writerow(
                    truth_row(frame.camera, frame=index, pts_s=float(index / first.fps), shot=shot)
                )
                index += 1
        container.mux(stream.encode(None))
    os.replace(partial, path)
    return truth_path(path)


def _container(path: Path) -> str | None:
    """Container format by name, for the temporary file's sake."""
    return {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".mxf": "mxf", ".ts": "mpegts"}.get(
        path.suffix.lower()
    )


def _open_stream(container: av.container.OutputContainer, spec: ClipSpec) -> av.VideoStream:
    """Encoder stream, tagged BT.709 limited range."""
    options = {"preset": spec.x264_preset} if spec.codec in ("libx264", "libx265") else {}
    if spec.codec == "libx264" and spec.height % _MACROBLOCK_PX not in (0, _MACROBLOCK_PX // 2):
        options["x264-params"] = "mbtree=0"
    if spec.crf is not None:
        options["crf"] = str(spec.crf)
    stream = container.add_stream(spec.codec, rate=spec.fps, options=options)
    if not isinstance(stream, av.VideoStream):
        raise ValueError(f"codec {spec.codec!r} is not a video codec")
    stream.width, stream.height, stream.pix_fmt = spec.width, spec.height, spec.pix_fmt
    stream.time_base = 1 / spec.fps
    if spec.crf is None:
        size = spec.width * spec.height * float(spec.fps) / (1920 * 1080 * 25)
        stream.bit_rate = int(spec.bitrate_bit_s or _BITRATE_1080P25 * size)
    context = stream.codec_context
    context.color_range, context.colorspace, context.color_primaries, context.color_trc = 1, 1, 1, 1
    # an anamorphic file: fx / fy = height / width of a pixel
    context.sample_aspect_ratio = 1 / Fraction(spec.lens.aspect).limit_denominator(1000)
    context.thread_count = 2
    return stream


def _to_video_frame(image: np.ndarray, pix_fmt: str) -> av.VideoFrame:
    """RGB (h, w, 3) uint8 -> tagged frame; 4:2:0 by our own BT.709 matrix, other formats from there by swscale."""
    h, w = image.shape[:2]
    planes = np.empty((h * 3 // 2, w), np.uint8)
    u = planes[h : h + h // 4].reshape(h // 2, w // 2) if h % 4 == 0 else np.empty((h // 2, w // 2), np.uint8)
    v = planes[h + h // 4 :].reshape(h // 2, w // 2) if h % 4 == 0 else np.empty((h // 2, w // 2), np.uint8)
    rgb_to_yuv420(image, planes[:h], u, v)
    if h % 4:
        planes.reshape(-1)[h * w :] = np.concatenate([u.reshape(-1), v.reshape(-1)])
    frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
    frame.colorspace, frame.color_range = 1, 1
    return frame if pix_fmt == "yuv420p" else frame.reformat(format=pix_fmt)


def main() -> None:
    """Command line: see `--help`."""
    from tests.synth.command import run

    run()


if __name__ == "__main__":
    main()
