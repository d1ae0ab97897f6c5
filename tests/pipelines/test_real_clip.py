"""Real footage through the whole command; skipped where the clips are not beside the checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.pipelines.end_to_end import run

CLIPS = Path(__file__).parents[3] / "shared" / "data" / "clips"
SOCCER = CLIPS / "soccer_inter_pan_720p.mp4"
N_FRAMES = 120


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(not SOCCER.is_file(), reason="needs ../shared/data/clips beside the checkout")
def test_a_real_pan_is_registered_from_end_to_end(tmp_path: Path) -> None:
    done = run(SOCCER, tmp_path / "out", "--run.max_frames", str(N_FRAMES), "-q")
    assert (done.code, done.stderr) == (0, "")
    table = done.table
    assert len(table) == N_FRAMES
    registered = np.isin(table.status, ["ok", "weak", "relative"])
    assert registered.mean() >= 0.9
    assert np.isfinite(table.homography[registered]).all()
    claimed = np.isfinite(table.f_px)
    assert (table.f_std_px[claimed] > 0).all()
    # No broadcast lens is wider or longer than this; the picture is 1280 px wide.
    assert ((table.f_px[claimed] > 0.5 * 1280) & (table.f_px[claimed] < 12 * 1280)).all()
    assert (done.out / "shot-000" / "panorama.jpg").stat().st_size > 10_000
