"""How an operator moves the camera: pan, tilt, zoom as smooth functions of time, and the lens that goes with the zoom.

A path is a function of a real-valued frame number, so that motion blur can look inside the exposure. Knows no image.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.synth.camera import SynthCamera

PATH_KINDS = ("pan_zoom", "pan_only", "pure_zoom", "locked_off", "whip", "track")


@dataclass(frozen=True, slots=True, kw_only=True)
class LensSpec:
    """Radial distortion k1_half(f) = c0 + c1 log(f / W); principal-point offset from the picture's centre in px at
    W = 1280 (scaled with W); pupil_m: entrance pupil in front of the pan axis; aspect: fx / fy (anamorphic files)."""

    c0: float = 0.0
    c1: float = 0.0
    pp_offset_px_1280: tuple[float, float] = (0.0, 0.0)
    pupil_m: float = 0.0
    aspect: float = 1.0

    def k1_half(self, f_px: float, width: int) -> float:
        return self.c0 + self.c1 * float(np.log(f_px / width))


# real-footage.md 2, fitted to a broadcast box lens: .05 at f = 1.08 W (wide), .03 at f = 3.26 W (tele).
BROADCAST_LENS = LensSpec(c0=0.0514, c1=-0.0181)


@dataclass(frozen=True, slots=True, kw_only=True)
class PathSpec:
    """The move. Degrees on purpose: this is what a person asks for on the command line.

    pan_deg: full range, from -pan/2 to +pan/2 about pan0_deg. zoom: ratio of longest to widest focal length.
    f0_per_width: widest focal length over W. jitter_px: rms of the operator's tremor, px at the widest focal, W = 1280.
    track, for kind "track": a row a frame of (f / W, pan, tilt, roll in degrees), a real operator's path; nothing is
    added to it.
    """

    kind: str = "pan_zoom"
    pan_deg: float = 20.0
    pan0_deg: float = 0.0
    tilt_deg: float = 1.5
    tilt0_deg: float = -10.5
    roll_deg: float = 0.3
    zoom: float = 1.6
    zoom_style: str = "in_out"
    f0_per_width: float = 1.354  # 2600 px at 1920
    there_and_back: bool = False
    jitter_px: float = 0.25
    whip_frames: int = 14
    track: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in PATH_KINDS:
            raise ValueError(f"path kind {self.kind!r} is none of {PATH_KINDS}")
        if self.zoom_style not in ("in_out", "in"):
            raise ValueError(f"zoom_style {self.zoom_style!r} is none of ('in_out', 'in')")
        if (self.kind == "track") != bool(self.track):
            raise ValueError(
                f"kind {self.kind!r} with {len(self.track)} rows of track: the one needs the other"
            )
        if self.zoom < 1:
            raise ValueError(f"zoom {self.zoom} < 1: give the ratio of longest to widest")


def ease(t: float | np.ndarray) -> np.ndarray:
    """Minimum-jerk step: 0 at t <= 0, 1 at t >= 1, first and second derivatives 0 at both ends."""
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPath:
    """A PathSpec on a clip of n_frames of width x height: `camera(t)` for any real t in frames."""

    spec: PathSpec
    lens: LensSpec
    width: int
    height: int
    n_frames: int
    seed: int
    _tremor: np.ndarray = field(init=False, repr=False)
    _signs: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 101])
        # tremor: four sines an axis, periods of 9 to 60 frames; rows: amplitude share, angular frequency, phase
        amplitude = rng.uniform(0.5, 1.0, (3, 4))
        amplitude *= np.sqrt(2) / np.linalg.norm(amplitude, axis=1, keepdims=True)
        omega = 2 * np.pi / rng.uniform(9, 60, (3, 4))
        object.__setattr__(self, "_tremor", np.stack([amplitude, omega, rng.uniform(0, 2 * np.pi, (3, 4))]))
        object.__setattr__(self, "_signs", rng.choice([-1.0, 1.0], 2))

    def camera(self, t: float) -> SynthCamera:
        """Camera at frame time t (frames, real)."""
        f_px, pan, tilt, roll = self._tracked(t) if self.spec.kind == "track" else self._performed(t)
        dx, dy = (d * self.width / 1280 for d in self.lens.pp_offset_px_1280)
        return SynthCamera(
            width=self.width,
            height=self.height,
            f_px=f_px,
            pan_rad=pan,
            tilt_rad=tilt,
            roll_rad=roll,
            cx_px=(self.width - 1) / 2 + dx,
            cy_px=(self.height - 1) / 2 + dy,
            k1_half=self.lens.k1_half(f_px, self.width),
            aspect=self.lens.aspect,
            pupil_m=self.lens.pupil_m,
        )

    def _tracked(self, t: float) -> tuple[float, float, float, float]:
        """f px, pan, tilt, roll rad of the given track, linear between its rows."""
        track = np.asarray(self.spec.track)
        row = [float(np.interp(t, np.arange(len(track)), track[:, k])) for k in range(4)]
        pan, tilt, roll = np.deg2rad(row[1:])
        return row[0] * self.width, float(pan), float(tilt), float(roll)

    def _performed(self, t: float) -> tuple[float, float, float, float]:
        """f px, pan, tilt, roll rad of the move that the spec describes."""
        s = self.spec
        u = t / max(self.n_frames - 1, 1)
        there = float(ease(u) if not s.there_and_back else ease(2 * u) - ease(2 * u - 1))
        if s.kind == "whip":
            there = float(ease((t - self.n_frames / 2) / s.whip_frames + 0.5))
        pan = self._signs[0] * np.deg2rad(s.pan_deg) * (there - 0.5)
        tilt = self._signs[1] * np.deg2rad(s.tilt_deg) * 0.5 * np.sin(2 * np.pi * u)
        bump = float(ease(u)) if s.zoom_style == "in" else float(ease(2 * u) - ease(2 * u - 1))
        log_zoom = np.log(s.zoom) * bump
        if s.kind in ("pure_zoom", "locked_off"):
            pan = tilt = 0.0
        if s.kind in ("pan_only", "locked_off"):
            log_zoom = 0.0
        f_px = s.f0_per_width * self.width * float(np.exp(log_zoom))
        tremor = np.zeros(3)
        if s.kind not in ("pure_zoom", "locked_off"):  # those claim that nothing turns
            amplitude, omega, phase = self._tremor
            tremor = (amplitude * np.sin(omega * t + phase)).sum(axis=1)
            tremor *= s.jitter_px / 1280 / s.f0_per_width * np.array([1.0, 1.0, 0.3])
        angles = np.deg2rad([s.pan0_deg, s.tilt0_deg, s.roll_deg]) + np.array([pan, tilt, 0.0]) + tremor
        return f_px, float(angles[0]), float(angles[1]), float(angles[2])

    def cameras(self) -> list[SynthCamera]:
        """One camera a frame."""
        return [self.camera(float(t)) for t in range(self.n_frames)]
