"""Runs that several end-to-end tests look at, each made once a session."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.pipelines.end_to_end import Finished, pan_spec, run, small_spec
from tests.synth.clip import write_clip
from tests.synth.paths import PathSpec

FLASH, CUT, N_CUT, REPEATS = 12, 30, 60, 5


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the clips of the session lie."""
    return tmp_path_factory.mktemp("clips")


@pytest.fixture(scope="session")
def pan_clip(clips: Path) -> Path:
    """Fifty frames: pan and zoom."""
    write_clip(clips / "pan.mp4", pan_spec())
    return clips / "pan.mp4"


@pytest.fixture(scope="session")
def pan_run(pan_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The pan through `run --json`, with one setting that is not the default and that changes every number."""
    out = tmp_path_factory.mktemp("pan") / "out"
    return run(pan_clip, out, "--json", "--registration.n_fine", "3000")


@pytest.fixture(scope="session")
def cut_clip(clips: Path) -> Path:
    """Two venues: a flash in frame 12 of the first, a cut at 30, every fifth frame of the second shot repeated."""
    first = pan_spec(seed=8, n_frames=CUT, pan_deg=12, flash_frame=FLASH)
    path = PathSpec(pan_deg=14, zoom=1.2, zoom_style="in")
    second = small_spec(11, N_CUT - CUT, path, duplicate_every=REPEATS)
    write_clip(clips / "cut.mp4", [first, second])
    return clips / "cut.mp4"


@pytest.fixture(scope="session")
def cut_run(cut_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The two venues through `run`, unbroken."""
    return run(cut_clip, tmp_path_factory.mktemp("cut") / "out")
