"""The command line of tests.synth.clip: options -> ClipSpec -> file."""

from __future__ import annotations

import argparse
import dataclasses
import time
from fractions import Fraction
from pathlib import Path

from tests.synth.clip import ClipSpec, write_clip
from tests.synth.paths import BROADCAST_LENS, PATH_KINDS, LensSpec, PathSpec
from tests.synth.world import TEXTURES


def parser() -> argparse.ArgumentParser:
    """Options; a default of None means: as the preset has it."""
    p = argparse.ArgumentParser(prog="python -m tests.synth.clip", description=__doc__)
    p.add_argument(
        "--out", type=Path, required=True, help="video file; truth goes beside it as NAME-truth.csv"
    )
    p.add_argument("--preset", default=None, help="a name of tests.synth.presets to start from")
    p.add_argument("--seed", type=int)
    p.add_argument("--size", help="1920x1080")
    p.add_argument("--fps", type=Fraction)
    p.add_argument("--frames", type=int, dest="n_frames")
    p.add_argument("--path", choices=PATH_KINDS, dest="kind")
    p.add_argument("--pan", type=float, dest="pan_deg", help="degrees, whole range")
    p.add_argument("--tilt", type=float, dest="tilt_deg")
    p.add_argument("--zoom", type=float, help="longest over widest focal length")
    p.add_argument("--f0", type=float, dest="f0_per_width", help="widest focal length over the width")
    p.add_argument("--there-and-back", action="store_true", default=None)
    p.add_argument("--jitter", type=float, dest="jitter_px")
    p.add_argument("--lens", choices=("none", "broadcast"), help="broadcast: k1_half .05 wide to .03 tele")
    p.add_argument("--pupil", type=float, help="entrance pupil in front of the pan axis, m")
    p.add_argument("--pp", type=float, nargs=2, help="principal-point offset, px at width 1280")
    p.add_argument("--texture", choices=TEXTURES)
    p.add_argument("--board-height", type=float, dest="board_height_m")
    p.add_argument("--players", type=float, dest="player_share", help="share of the picture, 0 .. .4")
    p.add_argument("--standing", type=int, dest="standing_players")
    p.add_argument("--led", type=float, dest="led_scroll_m_s")
    p.add_argument("--sway", type=float, dest="crowd_sway_m", help="people in the stands lean by so many m")
    p.add_argument("--noise", type=float, dest="noise_grey")
    p.add_argument("--drift", type=float, dest="exposure_drift")
    p.add_argument("--ramp", type=float, dest="exposure_ramp_stops")
    p.add_argument("--flicker", type=float)
    p.add_argument("--flash", type=int, dest="flash_frame")
    p.add_argument("--vignette", type=float)
    p.add_argument("--shutter", type=float)
    p.add_argument(
        "--readout", type=float, help="rolling shutter: time from first to last row over frame time"
    )
    p.add_argument("--duplicate-every", type=int)
    p.add_argument("--bitrate", type=float, dest="bitrate_bit_s")
    p.add_argument("--crf", type=float)
    p.add_argument("--codec")
    return p


def spec_from(arguments: argparse.Namespace) -> ClipSpec:
    """The ClipSpec that the options ask for."""
    given = {k: v for k, v in vars(arguments).items() if v is not None and k not in ("out", "preset")}
    spec = ClipSpec()
    if arguments.preset:
        from tests.synth.presets import preset

        spec = preset(arguments.preset, seed=arguments.seed or 1)
    if "size" in given:
        width, height = given.pop("size").lower().split("x")
        given.update(width=int(width), height=int(height))
    lens = spec.lens
    if "lens" in given:
        lens = {"none": LensSpec(), "broadcast": BROADCAST_LENS}[given.pop("lens")]
    if "pupil" in given:
        lens = dataclasses.replace(lens, pupil_m=given.pop("pupil"))
    if "pp" in given:
        lens = dataclasses.replace(lens, pp_offset_px_1280=tuple(given.pop("pp")))
    names = {f.name for f in dataclasses.fields(PathSpec)}
    path = dataclasses.replace(spec.path, **{k: given.pop(k) for k in list(given) if k in names})
    return dataclasses.replace(spec, path=path, lens=lens, **given)


def run(argv: list[str] | None = None) -> None:
    """Parse, render, encode, say how long it took."""
    arguments = parser().parse_args(argv)
    spec = spec_from(arguments)
    start = time.perf_counter()
    truth = write_clip(arguments.out, spec)
    print(f"{arguments.out}, {truth}: {spec.n_frames} frames in {time.perf_counter() - start:.1f} s")
