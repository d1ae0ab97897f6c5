"""The read-out time against tracks whose every row was taken at its own moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import rotation
from calib.camera import infinite_homography
from calib.poses import solve_poses
from calib.records import HomographyEdge, HomographyGraph, Lens
from calib.refine import RefineOptions, refine
from calib.rolling_shutter import rolling_shutter, without_rolling_shutter
from tests.calib import tracks

SIZE = (1280, 720)
LENS = Lens(size_px=SIZE, pp_px=np.array([641.0, 357.0]), c0=0.04, c1=-0.015)
N, KEY_EVERY = 120, 8


def _log_f(t: np.ndarray | float, still: bool = False) -> np.ndarray:
    """In and out again by a fifth."""
    return np.log(1700 + (3 if still else 300) * np.sin(2 * np.pi * np.asarray(t) / N))


def _R(t: np.ndarray | float, still: bool) -> np.ndarray:
    """There and back, up to a degree a frame, with a little tilt; still: hardly at all."""
    size = 0.002 if still else 1.0
    pan = np.deg2rad(18 * size) * np.sin(2 * np.pi * np.asarray(t) / N)
    tilt = np.deg2rad(-8 + 2 * size * np.sin(4 * np.pi * np.asarray(t) / N))
    return rotation.from_pan_tilt_roll(pan, tilt, 0.0 * pan)


def _seen(a: int, b: int, points: np.ndarray, share: float, still: bool) -> np.ndarray:
    """Raw points (m, 2) of frame a in frame b, each row of either at its own moment."""

    def moment(frame: int, y: np.ndarray) -> np.ndarray:
        return frame + share * ((y + 0.5) / SIZE[1] - 0.5)

    t = moment(a, points[:, 1])
    ideal = LENS.undistort(points, _log_f(t, still))
    rays = (
        np.linalg.inv(LENS.K(_log_f(t, still)))
        @ np.concatenate([ideal, np.ones((len(ideal), 1))], 1)[..., None]
    )
    rays = np.swapaxes(_R(t, still), 1, 2) @ rays
    there = points
    for _ in range(8):
        t = moment(b, there[:, 1])
        w = (LENS.K(_log_f(t, still)) @ _R(t, still) @ rays)[..., 0]
        there = LENS.distort(w[:, :2] / w[:, 2:], _log_f(t, still))
    return there


def _solved(share: float, *, still: bool = False, noise_px: float = 0.1, seed: int = 0):
    """Graph and cameras as the main job makes them: keyframes among each other, then each frame to two of them."""
    rng = np.random.default_rng(seed)
    keys = list(range(0, N, KEY_EVERY))
    grid = tracks.grid(SIZE)

    def edge(a: int, b: int) -> HomographyEdge | None:
        there = _seen(a, b, grid, share, still)
        inside = ((there >= 0) & (there <= np.array(SIZE) - 1)).all(1)
        if inside.sum() < 12:
            return None
        H = infinite_homography(
            LENS.K(_log_f(b, still)), LENS.K(_log_f(a, still)), _R(b, still) @ _R(a, still).T
        )
        noise = noise_px * rng.standard_normal((int(inside.sum()), 2)) + tracks.smooth_field(
            rng, grid[inside], SIZE, 0.05
        )
        info = np.broadcast_to(np.eye(2) / 0.1**2, (int(inside.sum()), 2, 2))
        return HomographyEdge(a=a, b=b, H=H, grid_a=grid[inside], grid_b=there[inside] + noise, info=info)

    among = [edge(a, b) for i, a in enumerate(keys) for b in keys[i + 1 : i + 5]]
    held = refine(
        HomographyGraph(frames=np.array(keys), edges=tuple(e for e in among if e), size_px=SIZE),
        options=RefineOptions(reference=keys[len(keys) // 2]),
    )
    between = [edge(k, f) for f in range(N) if f not in keys for k in keys if 0 < abs(k - f) <= KEY_EVERY]
    graph = HomographyGraph(frames=np.arange(N), edges=tuple(e for e in between if e), size_px=SIZE)
    return graph, solve_poses(graph, held)


@pytest.mark.parametrize("share", [0.9, 0.4, 0.15])
def test_the_share_of_the_frame_time_is_found(share: float) -> None:
    found = rolling_shutter(*_solved(share))
    assert found.found and found.reason == "found"
    assert found.share == pytest.approx(share, abs=0.06)
    assert abs(found.share - share) < 3.5 * found.share_std + 0.05 * abs(share)
    assert found.px > 1


def test_rows_read_backwards_are_no_reading() -> None:
    found = rolling_shutter(*_solved(-0.6))
    assert found.share == pytest.approx(-0.6, abs=0.06)
    assert not found.found and found.reason == "impossible"


def test_taken_out_the_pairs_fit_the_cameras_of_the_middle_row() -> None:
    graph, solution = _solved(0.8)
    truth = np.array([_log_f(f) for f in range(N)])
    before = np.abs(solution.log_f - truth - np.mean(solution.log_f - truth)).max()
    mended = without_rolling_shutter(graph, solution, rolling_shutter(graph, solution).share)
    after = solve_poses(mended, solution)
    assert np.nanmedian(after.rms_px) < 0.9 * np.nanmedian(solution.rms_px)
    assert np.abs(after.log_f - truth - np.mean(after.log_f - truth)).max() <= before + 1e-4
    assert all(np.array_equal(a.grid_a, b.grid_a) for a, b in zip(graph.edges, mended.edges, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_a_global_shutter_has_none(seed: int) -> None:
    found = rolling_shutter(*_solved(0.0, seed=seed))
    assert not found.found and found.reason == "not_significant"
    assert abs(found.share) < 4 * found.share_std


def test_a_camera_that_hardly_moves_does_not_tell() -> None:
    found = rolling_shutter(*_solved(0.9, still=True))
    assert not found.found


def test_without_neighbours_in_time_nothing_is_said() -> None:
    graph, solution = _solved(0.9)
    lost = np.where(np.arange(N) % 2, np.nan, solution.log_f)
    found = rolling_shutter(graph, replace(solution, log_f=lost))
    assert found.reason == "no_motion" and np.isnan(found.share)
