"""Cuts, flashes and repeated pictures in one clip of two venues (conftest.py says where they are)."""

from __future__ import annotations

import numpy as np
import pytest

from tests.pipelines.conftest import CUT, FLASH, N_CUT, REPEATS
from tests.pipelines.end_to_end import Finished

pytestmark = pytest.mark.slow  # whole runs

REGISTERED = {"ok", "weak", "relative"}


def test_a_cut_is_found_to_the_frame(cut_run: Finished) -> None:
    assert (cut_run.code, cut_run.stderr) == (0, "")
    shots = cut_run.record["shots"]
    assert [s["index"] for s in shots] == [0, 1]
    assert shots[0]["first_frame"] == 0 and shots[1]["last_frame"] == N_CUT - 1
    assert abs(shots[0]["last_frame"] - (CUT - 1)) <= 1
    assert abs(shots[1]["first_frame"] - CUT) <= 1
    table = cut_run.table
    assert table.frame.tolist() == list(range(N_CUT))
    wrong = np.flatnonzero(table.shot != (np.arange(N_CUT) >= CUT))
    assert set(wrong.tolist()) <= {CUT - 1, CUT}
    for shot in shots:
        assert all(name.startswith(f"shot-{shot['index']:03d}/") for name in shot["files"])
        assert len(shot["files"]) == 5


def test_each_shot_has_its_own_reference_and_focal(cut_run: Finished) -> None:
    table, truth = cut_run.table, cut_run.truth
    for shot in cut_run.record["shots"]:
        reference = shot["reference_frame"]
        assert shot["first_frame"] <= reference <= shot["last_frame"]
        np.testing.assert_allclose(table.homography[reference], np.eye(3), atol=1e-12)
    known = np.isfinite(table.f_px)
    assert known.sum() >= 0.9 * N_CUT
    assert (np.abs(table.f_px - truth["f_px"])[known] <= 3 * table.f_std_px[known]).all()


def test_a_flash_cuts_no_shot(cut_run: Finished) -> None:
    table = cut_run.table
    around = slice(FLASH - 4, FLASH + 5)
    assert set(table.shot[around].tolist()) == {0}
    others = [s for i, s in enumerate(table.status[: CUT - 1]) if i != FLASH]
    assert set(others) <= REGISTERED
    # The flash itself is registered in spite of it, or bridged and said so.
    assert table.status[FLASH] in REGISTERED | {"interpolated"}
    truth = cut_run.truth["f_px"]
    assert abs(table.f_px[FLASH] / truth[FLASH] - 1) < 0.03


def test_a_repeated_picture_has_the_camera_of_its_source(cut_run: Finished) -> None:
    table = cut_run.table
    copies = np.array([CUT + k for k in range(N_CUT - CUT) if k % REPEATS == REPEATS - 1])
    assert set(table.shot[copies].tolist()) == {1}
    for name in ("f_px", "zoom_ratio", "pan_deg", "tilt_deg", "roll_deg", "homography"):
        values = getattr(table, name)
        assert np.isfinite(values[copies]).all(), name
        np.testing.assert_array_equal(values[copies], values[copies - 1], err_msg=name)
    assert (np.abs(np.diff(table.pan_deg[CUT : N_CUT - 1])) > 0).sum() >= 20  # and the others move on
