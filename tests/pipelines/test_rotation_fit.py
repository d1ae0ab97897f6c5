"""What is refused because no turning, zooming camera explains it, and what is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.closeups import WRONG_PX, outcome
from calib import rotation
from calib.records import Lens, Priors, Solution
from mosaic.records import FlowGrid, PairFit, PairStatus
from pipelines.archive import read_run
from pipelines.bridge import CameraPlacement, CameraPose
from pipelines.report.words import REASONS
from pipelines.rotation_fit import REASON, RotationFit, largest_piece, step_errors_px
from tests.pipelines.end_to_end import Finished, run
from tests.synth.closeups import CloseUpSpec, write_closeup

SIZE = (1280, 720)
LENS = Lens(size_px=SIZE, pp_px=np.array([639.5, 359.5]))
PAN_RAD = 0.004  # a frame
N = 30


def fit_of(**values: Any) -> RotationFit:
    given: dict[str, Any] = {
        "residual_px": 0.3, "chi2_dof": 1.0, "width_px": 1280, "step_error_px": 0.5, "steps": 50,
        "steps_contradicted": 0,
    }  # fmt: skip
    return RotationFit(**(given | values))


def track(pan_rad: np.ndarray) -> Solution:
    n = len(pan_rad)
    R = np.array([rotation.exp(np.array([0.0, p, 0.0])) for p in pan_rad])
    return Solution(
        frames=np.arange(n), log_f=np.full(n, np.log(2000.0)), R=R, lens=LENS, reference=0, sigma_log_f=np.zeros(n),
        sigma_log_zoom=np.zeros(n), cov_rot=np.zeros((n, 3, 3)), sigma_mean_log_f=0.01, sigma_mean_formal=0.01,
        lens_std={}, chi2_dof=1.0, s10_px=1.0, edge_chi2=np.zeros(0), edge_kappa=np.zeros(0),
        edge_ok=np.zeros(0, bool), rms_px=np.full(n, 0.2), converged=True, stop="step", n_steps=1, cost=0.0,
        priors=Priors(),
    )  # fmt: skip


def step(solution: Solution, a: int) -> PairFit:
    """The pair a -> a + 1 as a perfect measurement of these cameras."""
    K = LENS.K(np.log(2000.0))
    H = K @ solution.R[a + 1] @ solution.R[a].T @ np.linalg.inv(K)
    return PairFit(
        src=a, dst=a + 1, H_dst_src=H / np.cbrt(np.linalg.det(H)), status=PairStatus.OK, reason="", overlap=1.0,
        rms_grey=1.0, score=0.1, gain=1.0, offset=0.0, n_steps=1, route="", flow=FlowGrid.empty(),
        anchors_px=np.zeros((4, 2)), info=np.zeros((8, 8)),
    )  # fmt: skip


def placements(solution: Solution) -> list[CameraPlacement]:
    return [
        CameraPlacement(frame=int(f), size_px=SIZE, lens=LENS, pose=CameraPose(log_f=float(g), R=R))
        for f, g, R in zip(solution.frames, solution.log_f, solution.R, strict=True)
    ]


def test_only_a_large_misfit_refuses() -> None:
    assert not fit_of().refused
    assert not fit_of(residual_px=3.0).refused  # a crowd on its feet: large, but as large as its own noise
    assert not fit_of(
        chi2_dof=20.0
    ).refused  # exact measurements of a lens with more terms: no reason to lose the shot
    assert fit_of(residual_px=3.0, chi2_dof=8.0).refused
    assert not fit_of(residual_px=3.0, chi2_dof=4.5).refused
    assert fit_of(
        residual_px=3.0, chi2_dof=4.5, step_error_px=2.0
    ).refused  # and the cameras do not repeat the steps
    assert not fit_of(residual_px=np.nan, chi2_dof=np.nan, step_error_px=np.nan, steps=0).refused


def test_cameras_that_contradict_the_steps_refuse() -> None:
    true = track(PAN_RAD * np.arange(N))
    measured = [step(true, a) for a in range(N - 1)]
    assert step_errors_px(true, measured).max() < 1e-6
    scattered = track(PAN_RAD * np.arange(N) + 0.3 * (np.arange(N) % 2))
    errors = step_errors_px(scattered, measured)
    assert (errors > 0.05 * SIZE[0]).all()
    assert fit_of(steps=len(errors), steps_contradicted=len(errors)).refused
    one_off = track(PAN_RAD * np.arange(N) + 0.3 * (np.arange(N) == 10))
    wrong = int((step_errors_px(one_off, measured) > 0.05 * SIZE[0]).sum())
    assert wrong == 2  # to it and from it
    assert not fit_of(steps=len(errors), steps_contradicted=wrong).refused
    lost = replace(true, log_f=np.where(np.arange(N) == 10, np.nan, true.log_f))
    assert len(step_errors_px(lost, measured)) == N - 3


def test_pictures_that_overlap_nothing_are_left_out_of_the_panorama() -> None:
    pan = PAN_RAD * np.arange(N)
    pan[[7, 8]] += 1.5
    assert largest_piece(placements(track(pan))) == set(range(N)) - {7, 8}
    assert largest_piece(placements(track(np.zeros(1)))) == {0}
    assert largest_piece([]) == set()


def test_a_wide_and_a_long_picture_of_the_same_place_hang_together() -> None:
    wide, long = placements(track(np.array([0.0, 0.25])))
    assert largest_piece([wide, long]) == {0, 1}  # .4 of a width apart
    longer = replace(long, pose=CameraPose(log_f=long.pose.log_f + np.log(4.0), R=long.pose.R))
    assert largest_piece([wide, longer]) == {0, 1}
    assert (
        len(largest_piece([replace(wide, pose=CameraPose(log_f=longer.pose.log_f, R=wide.pose.R)), longer]))
        == 1
    )


@pytest.fixture(scope="module")
def closeup(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A person who fills the picture before a blur, and whom the camera follows."""
    folder = tmp_path_factory.mktemp("closeup")
    spec = CloseUpSpec(seed=3, height_share=1.4, follow=1.0, blur_px=8, width=480, height=270, n_frames=40)
    write_closeup(folder / "clip.mp4", spec)
    return run(folder / "clip.mp4", folder / "out", "-q")


@pytest.mark.slow
def test_a_close_up_is_refused_with_its_reason(closeup: Finished) -> None:
    assert closeup.code == 1
    [shot] = closeup.record["shots"]
    assert (shot["status"], shot["reason"], shot["focal"], shot["panorama"]) == ("failed", REASON, None, None)
    assert shot["sentence"] and any("no panorama" in w for w in shot["warnings"])
    assert REASON in REASONS and f"shot 0 failed: {shot['sentence']}" in closeup.stderr
    assert not shot["calibration"]["claims_focal"] and not shot["calibration"]["level"]["observable"]
    table = closeup.table
    assert set(table.status) == {"lost"} and set(table.reason) == {REASON}
    for values in (table.f_px, table.zoom_ratio, table.pan_deg, table.homography, table.k1):
        assert np.isnan(values).all()
    assert not list(closeup.out.glob("shot-*/panorama*"))
    report = (closeup.out / "report.html").read_text(encoding="utf-8")
    assert "people fill them" in report


@pytest.mark.slow
def test_a_close_up_whose_ground_shows_is_tracked_by_the_ground(tmp_path: Path) -> None:
    spec = CloseUpSpec(seed=1, width=480, height=270, n_frames=40)
    write_closeup(tmp_path / "clip.mp4", spec)
    done = run(tmp_path / "clip.mp4", tmp_path / "out", "-q", "--panorama.enabled=off")
    [shot] = read_run(tmp_path / "out").shots
    what, median, _ = outcome(spec, shot, done.table)
    assert (what, shot.status) == ("ground", "relative")
    assert median < WRONG_PX / 5
