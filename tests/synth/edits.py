"""Edited programmes of known boundaries: shots of the generator joined by cuts, dissolves, fades, wipes, stingers.

An edit of n frames shows both shots (or black, or a graphic) in n frames; both cameras go on moving meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from tests.synth.clip import ClipSpec, SynthClip, _open_stream, _to_video_frame
from tests.synth.paths import PathSpec

# A slide ("push") is a whip pan to all that looks at it: generated, and no part of the benchmark.
KINDS = ("cut", "dissolve", "fade", "wipe", "iris", "slide", "stinger")
_SOFT = 0.02  # of the width: the edge of a wipe


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """How one shot follows another. n_frames: frames that are not of one shot alone; 0 for a cut only."""

    kind: str = "cut"
    n_frames: int = 0
    angle_deg: float = 0.0  # the direction in which a wipe or a stinger runs; 0: to the right

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"edit {self.kind!r} is none of {KINDS}")
        if (self.kind == "cut") != (self.n_frames == 0):
            raise ValueError(f"a {self.kind} of {self.n_frames} frames")


@dataclass(frozen=True, slots=True, kw_only=True)
class Boundary:
    """Frames first..last of the programme belong to no shot alone; a cut has none: last = first - 1, first the new."""

    kind: str
    first: int
    last: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """Shots and the edits between them (one fewer)."""

    shots: tuple[ClipSpec, ...]
    edits: tuple[Edit, ...]

    def __post_init__(self) -> None:
        if len(self.edits) != len(self.shots) - 1:
            raise ValueError(f"{len(self.shots)} shots and {len(self.edits)} edits")
        starts = self.starts
        for i, edit in enumerate(self.edits[1:], 1):
            if starts[i + 1] < starts[i] + self.edits[i - 1].n_frames:
                raise ValueError(f"shot {i} is shorter than its two edits ({edit})")

    @property
    def starts(self) -> tuple[int, ...]:
        """The frame in which each shot is first seen."""
        starts = [0]
        for spec, edit in zip(self.shots, self.edits, strict=False):
            starts.append(starts[-1] + spec.n_frames - edit.n_frames)
        return tuple(starts)

    @property
    def n_frames(self) -> int:
        return self.starts[-1] + self.shots[-1].n_frames

    @property
    def boundaries(self) -> tuple[Boundary, ...]:
        """Truth."""
        return tuple(
            Boundary(kind=edit.kind, first=start, last=start + edit.n_frames - 1)
            for start, edit in zip(self.starts[1:], self.edits, strict=True)
        )

    def images(self) -> Iterator[np.ndarray]:
        """(h, w, 3) uint8 RGB of every frame."""
        starts, clip = self.starts, SynthClip(self.shots[0])
        following: SynthClip | None = None
        shot = 0
        for k in range(self.n_frames):
            if shot + 1 < len(self.shots) and k >= starts[shot] + self.shots[shot].n_frames:
                clip, following = following or SynthClip(self.shots[shot + 1]), None
                shot += 1
            image = clip.frame(k - starts[shot]).image
            if shot + 1 < len(self.shots) and k >= starts[shot + 1]:
                following = following or SynthClip(self.shots[shot + 1])
                edit = self.edits[shot]
                u = (k - starts[shot + 1] + 1) / (edit.n_frames + 1)
                image = blend(edit, u, image, following.frame(k - starts[shot + 1]).image)
            yield image


def blend(edit: Edit, u: float, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The picture at share u (0..1) of an edit from picture a to picture b, (h, w, 3) uint8."""
    h, w = a.shape[:2]
    if edit.kind == "dissolve":
        return cv2.addWeighted(a, 1 - u, b, u, 0)
    if edit.kind == "fade":
        return cv2.convertScaleAbs(a, alpha=1 - 2 * u) if u < 0.5 else cv2.convertScaleAbs(b, alpha=2 * u - 1)
    if edit.kind == "slide":
        out, shift = a.copy(), round(u * w)
        out[:, : w - shift], out[:, w - shift :] = a[:, shift:], b[:, :shift]
        return out
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, w), np.linspace(-0.5, 0.5, h) * h / w)
    if edit.kind == "iris":
        along, reach = np.hypot(x, y), float(np.hypot(0.5, 0.5 * h / w))
        return _mix(a, b, np.clip((u * reach - along) / _SOFT + 0.5, 0, 1))
    angle = np.deg2rad(edit.angle_deg)
    along = np.cos(angle) * x + np.sin(angle) * y
    along = (along - along.min()) / float(np.ptp(along))
    if edit.kind == "wipe":
        return _mix(a, b, np.clip((u * (1 + _SOFT) - along) / _SOFT, 0, 1))
    # A stinger: a graphic sweeps in, covers the picture for a tenth of the time, sweeps out over the new shot.
    lead, trail = min(u / 0.45, 1.1), max((u - 0.55) / 0.45, -0.1)
    graphic = _graphic(h, w, u)
    out = _mix(a, graphic, np.clip((lead - along) / 0.005, 0, 1))
    return _mix(out, b, np.clip((trail - along) / 0.005, 0, 1))


def _mix(a: np.ndarray, b: np.ndarray, share_b: np.ndarray) -> np.ndarray:
    share = share_b[..., None].astype(np.float32)
    return (a * (1 - share) + b * share + 0.5).astype(np.uint8)


def _graphic(h: int, w: int, u: float) -> np.ndarray:
    """Stripes that run and letters that grow."""
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    stripe = ((x + y + u * 0.8 * w) // (w / 9)) % 2
    out = np.where(stripe[..., None] > 0, (20, 40, 120), (35, 70, 190)).astype(np.uint8)
    size = w / 400 * (0.7 + 0.6 * u)
    cv2.putText(
        out, "SPORT", (round(w * 0.2), round(h * 0.6)), cv2.FONT_HERSHEY_DUPLEX, size, (250, 250, 240),
        max(2, round(3 * size)), cv2.LINE_AA,
    )  # fmt: skip
    return out


def write_programme(path: Path, programme: Programme) -> tuple[Boundary, ...]:
    """Render and encode it; returns the true boundaries."""
    first = programme.shots[0]
    with av.open(str(path), "w") as container:
        stream = _open_stream(container, first)
        for index, image in enumerate(programme.images()):
            picture = _to_video_frame(image, first.pix_fmt)
            picture.pts, picture.time_base = index, 1 / Fraction(first.fps)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return programme.boundaries


def random_programme(
    seed: int, *, n_shots: int = 8, size_px: tuple[int, int] = (480, 270), kinds: Sequence[str] = KINDS
) -> Programme:
    """Shots of 14 to 110 frames of two venues, some with a flash, some still, some close; each kind of edit in turn."""
    rng = np.random.default_rng([seed, 77])
    order = [str(k) for k in rng.permutation([*kinds, "cut"])]
    edits = [_random_edit(order[i % len(order)], rng) for i in range(n_shots - 1)]
    shots = []
    for i in range(n_shots):
        around = sum(e.n_frames for e in edits[max(i - 1, 0) : i + 1])
        long = int(rng.integers(14, 30)) if rng.uniform() < 0.25 else int(rng.integers(35, 110))
        shots.append(_random_shot(seed, i, long + around, rng, size_px))
    return Programme(shots=tuple(shots), edits=tuple(edits))


def _random_edit(kind: str, rng: np.random.Generator) -> Edit:
    longest = {"cut": 0, "dissolve": 50, "fade": 30, "wipe": 30, "iris": 30, "slide": 24, "stinger": 45}[kind]
    if longest == 0:
        return Edit()
    least = {"dissolve": 6, "stinger": 18}.get(kind, 10)
    return Edit(
        kind=kind, n_frames=int(rng.integers(least, longest + 1)), angle_deg=float(rng.uniform(0, 360))
    )


def _random_shot(
    seed: int, i: int, n_frames: int, rng: np.random.Generator, size_px: tuple[int, int]
) -> ClipSpec:
    close = rng.uniform() < 0.2
    rate = rng.uniform(0.05, 0.45)  # degrees a frame, at the fastest about twice that
    kind = str(rng.choice(["pan_zoom", "pan_zoom", "pan_only", "locked_off"]))
    path = PathSpec(
        kind=kind,
        pan_deg=float(np.clip(rate * n_frames, 1, 35)) * (0.3 if close else 1.0),
        pan0_deg=float(rng.uniform(-20, 20)),
        zoom=float(rng.uniform(1.05, 1.5)),
        zoom_style="in",
        f0_per_width=float(rng.uniform(3.0, 5.0) if close else rng.uniform(1.1, 1.8)),
    )
    flash = int(rng.integers(6, n_frames - 6)) if rng.uniform() < 0.3 and n_frames > 40 else None
    spec = ClipSpec(
        seed=seed * 100 + i,
        world_seed=seed * 2 + int(rng.uniform() < 0.4),
        width=size_px[0],
        height=size_px[1],
        n_frames=n_frames,
        path=path,
        player_share=float(rng.uniform(0.15, 0.3) if close else rng.uniform(0.03, 0.15)),
        n_players=5 if close else 14,
        flash_frame=flash,
        max_px_per_rad=1800.0,
        crf=23.0,
        exposure_drift=0.02,
    )
    return replace(spec, scoreboard=bool(seed % 3), logo=bool(seed % 2))
