"""Frames that contradict their own pairs, and frames that only doubtful pairs lead to."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from calib.records import Lens, Priors, Solution
from mosaic.records import PairFit, PairStatus
from pipelines.camera_track import repeated_from
from pipelines.links import contradicted_frames, without_doubtful
from pipelines.tracking import Observation

N = 60


def _solution(**values: Any) -> Solution:
    """A zoom in that starts at a third of the shot, residuals of .2 px; `values` replace fields."""
    frames = np.arange(N)
    zoom = 0.004 * np.maximum(frames - N // 3, 0)
    given: dict[str, Any] = {
        "frames": frames, "log_f": np.log(2000.0) + zoom, "R": np.tile(np.eye(3), (N, 1, 1)),
        "lens": Lens(size_px=(1280, 720), pp_px=np.array([639.5, 359.5])), "reference": 0,
        "sigma_log_f": np.zeros(N), "sigma_log_zoom": np.zeros(N), "cov_rot": np.zeros((N, 3, 3)),
        "sigma_mean_log_f": 0.01, "sigma_mean_formal": 0.01, "lens_std": {}, "chi2_dof": 1.0, "s10_px": 1.0,
        "edge_chi2": np.zeros(0), "edge_kappa": np.zeros(0), "edge_ok": np.zeros(0, bool), "rms_px": np.full(N, 0.2),
        "converged": True, "stop": "step", "n_steps": 1, "cost": 0.0, "priors": Priors(),
    }  # fmt: skip
    return Solution(**(given | values))


def _with(base: np.ndarray, places: slice | list[int], value: float) -> np.ndarray:
    out = base.copy()
    out[places] = value
    return out


def test_frames_that_fit_contradict_nothing():
    assert not contradicted_frames(_solution()).any()


def test_a_residual_far_beyond_the_usual_is_enough():
    found = contradicted_frames(_solution(rms_px=_with(np.full(N, 0.2), [30, 31], 1.2)))
    assert np.flatnonzero(found).tolist() == [30, 31]


def test_half_of_that_is_not_unless_the_zoom_jumps_with_it():
    rms = _with(np.full(N, 0.2), slice(18, 24), 0.8)  # where the zoom starts: a bend, no jump
    assert not contradicted_frames(_solution(rms_px=rms)).any()
    plain = _solution()
    pulled = plain.log_f - 0.03 * np.isin(plain.frames, [20, 21, 22])
    found = contradicted_frames(_solution(rms_px=rms, log_f=pulled))
    assert np.flatnonzero(found).tolist() == [20, 21, 22]
    assert not contradicted_frames(_solution(log_f=pulled)).any()  # nor the jump alone: cameras may do that


def test_the_reference_and_lost_frames_are_never_named():
    plain = _solution()
    rms = _with(np.full(N, 0.2), [0, 5], 9.0)
    found = contradicted_frames(
        _solution(rms_px=_with(rms, [5], np.nan), log_f=_with(plain.log_f, [5], np.nan))
    )
    assert not found.any()


def test_a_picture_that_stands_for_long_is_as_good_as_the_one_it_repeats():
    stands = range(20, 50)
    seen = cast(
        "list[Observation]",
        [SimpleNamespace(frame=k, status="ok", reason="duplicate" if k in stands else "") for k in range(N)],
    )
    repeats = repeated_from(seen)
    assert repeats == dict.fromkeys(stands, 19)

    def pairs(last: int) -> list[PairFit]:
        found = [(0, k) for k in range(1, last) if k not in stands]
        return cast(
            "list[PairFit]",
            [SimpleNamespace(src=a, dst=b, status=PairStatus.OK, route="predicted") for a, b in found],
        )

    assert without_doubtful(_solution(), pairs(N), repeats)[1] == set()
    # Without its own pairs, or where the picture that it repeats has none, a frame stays doubtful.
    assert without_doubtful(_solution(), pairs(N), {})[1] == set(range(26, 44))
    assert without_doubtful(_solution(), pairs(10), repeats)[1] == set(range(16, N))
