"""Named clips for benchmarks: the campaigns that the issues ask for, each a function of a seed.

`preset(name, seed=...)` gives one spec, `campaign(name, seeds=...)` several. Within a family the seed draws pan, zoom,
direction, players and the venue, so that a campaign covers the stated ranges and not one corner of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from tests.synth.clip import ClipSpec
from tests.synth.paths import BROADCAST_LENS, PathSpec


def _ideal(seed: int) -> ClipSpec:
    """No distortion; pan 10..40 degrees, zoom x1..x3, players up to 25 %: the first campaign of the spine issue."""
    rng = np.random.default_rng([seed, 900])
    zoom = float(np.exp(rng.uniform(0, np.log(3))))
    path = PathSpec(
        pan_deg=float(rng.uniform(10, 40)),
        tilt_deg=float(rng.uniform(1, 3)),
        zoom=zoom,
        zoom_style=str(rng.choice(["in_out", "in"])),
        # long zooms start wide: nobody frames a match at 4 W
        f0_per_width=float(rng.uniform(1.1, 1.6)) if zoom < 2 else float(rng.uniform(0.95, 1.25)),
        there_and_back=bool(rng.uniform() < 0.4),
        roll_deg=float(rng.normal(0, 0.3)),
        pan0_deg=float(rng.uniform(-6, 6)),
    )
    return ClipSpec(seed=seed, path=path, n_frames=200, player_share=float(rng.uniform(0.02, 0.25)))


def _lens(seed: int) -> ClipSpec:
    """The lens of real broadcasts, k1_half .05 wide to .03 tele, and texture mostly in a band."""
    rng = np.random.default_rng([seed, 901])
    path = PathSpec(
        pan_deg=float(rng.uniform(25, 40)),
        tilt_deg=float(rng.uniform(1, 3)),
        zoom=float(rng.uniform(1.5, 3.0)),
        f0_per_width=float(rng.uniform(1.1, 1.4)),
        there_and_back=bool(rng.uniform() < 0.5),
    )
    return ClipSpec(
        seed=seed,
        path=path,
        lens=BROADCAST_LENS,
        texture="band",
        n_frames=200,
        player_share=float(rng.uniform(0.02, 0.12)),
    )


def _pure_zoom(seed: int) -> ClipSpec:
    """Nothing turns: the focal length cannot be known."""
    return ClipSpec(seed=seed, path=PathSpec(kind="pure_zoom", zoom=1.8), n_frames=100, player_share=0.05)


def _locked_off(seed: int) -> ClipSpec:
    """Nothing moves but the players."""
    return ClipSpec(seed=seed, path=PathSpec(kind="locked_off"), n_frames=75, player_share=0.05)


def _hard(seed: int) -> ClipSpec:
    """Scrolling hoardings over a tenth of the picture, 40 % players, a flash, repeated frames, pupil .6 m, lens."""
    return ClipSpec(
        seed=seed,
        path=PathSpec(pan_deg=25, zoom=1.7, tilt_deg=2.0),
        lens=dataclasses.replace(BROADCAST_LENS, pupil_m=0.6),
        n_frames=200,
        n_players=30,
        player_share=0.40,
        board_height_m=5.0,
        led_scroll_m_s=2.5,
        crowd_sway_m=0.12,
        flash_frame=90,
        duplicate_every=5,
        exposure_drift=0.05,
        flicker=0.02,
        vignette=0.15,
    )


def _reference(seed: int) -> ClipSpec:
    """The clip of performance.md: pan 20, zoom 1.6, f 2600 to 4160 px, .1 px tremor, 11 % players, 8 Mbit/s."""
    path = PathSpec(pan_deg=20, zoom=1.6, zoom_style="in", jitter_px=0.1)
    return ClipSpec(seed=seed, path=path, n_frames=150, player_share=0.11)


def _arena(seed: int) -> ClipSpec:
    """A basketball-like hall."""
    path = PathSpec(pan_deg=24, zoom=1.4, f0_per_width=1.1, tilt0_deg=-11)
    return ClipSpec(seed=seed, path=path, texture="arena", n_frames=150, player_share=0.12, n_players=10)


def _whip(seed: int) -> ClipSpec:
    """A pan of 30 degrees within 14 frames, blurred as it is."""
    path = PathSpec(kind="whip", pan_deg=30, zoom=1.2)
    return ClipSpec(seed=seed, path=path, n_frames=100, player_share=0.05, shutter=0.4)


def _panorama(seed: int) -> ClipSpec:
    """What the panorama issue asks for: one player stands, exposure ramp of a stop, flicker 3 %."""
    path = PathSpec(pan_deg=30, zoom=1.5, there_and_back=True)
    return ClipSpec(
        seed=seed,
        path=path,
        n_frames=250,
        player_share=0.10,
        standing_players=1,
        exposure_ramp_stops=1.0,
        flicker=0.03,
    )


def _sample(seed: int) -> ClipSpec:
    """The clip in assets/: 720p, mild lens, one pan with zoom in and out."""
    path = PathSpec(pan_deg=24, pan0_deg=-6, zoom=1.7, tilt_deg=2.0, f0_per_width=1.3)
    return ClipSpec(
        seed=seed,
        width=1280,
        height=720,
        path=path,
        lens=BROADCAST_LENS,
        n_frames=200,
        player_share=0.10,
        n_players=24,
        bitrate_bit_s=6.0e6,
        x264_preset="slow",
    )


PRESETS: dict[str, Callable[[int], ClipSpec]] = {
    "ideal": _ideal,
    "lens": _lens,
    "pure_zoom": _pure_zoom,
    "locked_off": _locked_off,
    "hard": _hard,
    "reference": _reference,
    "arena": _arena,
    "whip": _whip,
    "panorama": _panorama,
    "sample": _sample,
}


def preset(name: str, *, seed: int = 1) -> ClipSpec:
    """The named clip. Raises ValueError, naming what there is."""
    if name not in PRESETS:
        raise ValueError(f"preset {name!r} is none of {', '.join(PRESETS)}")
    return PRESETS[name](seed)


def campaign(name: str, seeds: Iterable[int] = range(1, 11), **changes: Any) -> list[ClipSpec]:
    """The named clip for each seed, with fields of ClipSpec replaced (size for a quick run, say)."""
    return [dataclasses.replace(preset(name, seed=seed), **changes) for seed in seeds]
