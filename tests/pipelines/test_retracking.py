"""Which frames the second pass registers again: those whose first pair is not beyond doubt."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NoReturn, cast

import numpy as np
import pytest

from calib.records import Lens, Priors, Solution
from mosaic.coords import default_anchors
from mosaic.records import FlowGrid, PairFit, PairStatus
from pipelines.bridge import Rolling
from pipelines.config import RegistrationOptions
from pipelines.retracking import Retracker
from pipelines.tracking import ShotTracker

SIZE = (1920, 1080)
KEY, FRAME = 0, 5


class LookedAt(Exception):
    """The pixels were asked for."""


def _pixels() -> NoReturn:
    raise LookedAt


def _fit(**values: Any) -> PairFit:
    given: dict[str, Any] = {
        "src": KEY, "dst": FRAME, "H_dst_src": np.eye(3), "status": PairStatus.OK, "reason": "", "overlap": 0.9,
        "rms_grey": 2.0, "score": 0.2, "gain": 1.0, "offset": 0.0, "n_steps": 5, "route": "predicted",
        "flow": FlowGrid.empty(), "anchors_px": default_anchors(SIZE), "info": np.eye(8),
    }  # fmt: skip
    return PairFit(**(given | values))


def _retracker(fit: PairFit, rms_px: float = 0.2, rolling: Rolling | None = None) -> Retracker:
    n = 6
    approximate = Solution(
        frames=np.arange(n), log_f=np.full(n, np.log(3000.0)), R=np.tile(np.eye(3), (n, 1, 1)),
        lens=Lens(size_px=SIZE, pp_px=np.array([959.5, 539.5])), reference=KEY, sigma_log_f=np.zeros(n),
        sigma_log_zoom=np.zeros(n), cov_rot=np.zeros((n, 3, 3)), sigma_mean_log_f=0.01, sigma_mean_formal=0.01,
        lens_std={}, chi2_dof=1.0, s10_px=1.0, edge_chi2=np.zeros(0), edge_kappa=np.zeros(0),
        edge_ok=np.zeros(0, bool), rms_px=np.full(n, rms_px), converged=True, stop="step", n_steps=1, cost=0.0,
        priors=Priors(),
    )  # fmt: skip
    tracker = SimpleNamespace(size_px=SIZE, fits=[fit], keyframes={KEY: SimpleNamespace(template=None)})
    return Retracker(cast(ShotTracker, tracker), approximate, RegistrationOptions(), rolling=rolling)


def test_a_sure_pair_is_kept_and_its_pixels_are_not_looked_at():
    fit = _fit()
    assert _retracker(fit).register(FRAME, _pixels) == [fit]


@pytest.mark.parametrize(
    "values",
    [{"score": 0.4}, {"status": PairStatus.WEAK}, {"route": "eight parameters"}, {"route": "features"}],
)
def test_a_pair_in_doubt_or_found_without_the_camera_is_registered_again(
    values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Retracker, "_bound", lambda *_: None)
    with pytest.raises(LookedAt):
        _retracker(_fit(**values)).register(FRAME, _pixels)


def test_so_is_one_that_the_refined_cameras_do_not_explain(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Retracker, "_bound", lambda *_: None)
    with pytest.raises(LookedAt):
        _retracker(_fit(), rms_px=0.8).register(FRAME, _pixels)


def test_and_every_pair_of_a_rolling_shutter(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Retracker, "_bound", lambda *_: None)
    with pytest.raises(LookedAt):
        _retracker(_fit(), rolling=cast(Rolling, object())).register(FRAME, _pixels)
