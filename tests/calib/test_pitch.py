"""The pitch camera and the ball's flight against made-up grounds: exact without noise, error bars right with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.ball_flight import campaign
from calib.flight import GRAVITY_M_S2, fit_flight
from calib.pitch import PitchCamera, TrackCamera, fit_pitch_camera
from calib.rotation import from_pan_tilt_roll

Array = NDArray[np.float64]

POSITION = np.array([3.0, -62.0, 14.0])
# Pitch axes (right, away, up) to world axes (right, down, forward), the head turned a little against the pitch.
R_WORLD_PITCH = from_pan_tilt_roll(0.03, -0.01, 0.005) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
GRID = np.array(
    [
        [x, y]
        for x in (-52.5, -36.0, -16.5, 0.0, 16.5, 36.0, 52.5)
        for y in (-20.16, -9.15, 0.0, 9.15, 20.16, 34.0)
    ]
)


@dataclass(frozen=True, kw_only=True)
class Ground:
    """n frames of a pan across the pitch, the true camera, and the track whose focal length is off by log_focal."""

    truth: TrackCamera
    track: TrackCamera
    camera: PitchCamera

    def clicks(
        self, rng: np.random.Generator, per_frame: int, std_px: float
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Rows, pixels and metres of points that are in the picture in five of the frames."""
        rows, pixels, points = [], [], []
        for row in np.linspace(0, len(self.truth) - 1, 5).astype(int):
            xy = self.camera.project(self.truth.taken(np.full(len(GRID), row)), lifted(GRID))
            inside = np.flatnonzero(((xy > 0) & (xy < [1919, 1079])).all(axis=1))
            for k in rng.permutation(inside)[:per_frame]:
                rows.append(row)
                pixels.append(xy[k] + rng.normal(0, std_px, 2) if std_px else xy[k])
                points.append(GRID[k])
        return np.array(rows), np.array(pixels), np.array(points)


def lifted(points: Array) -> Array:
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def ground(log_focal: float = 0.0, n: int = 50, pan: tuple[float, float] = (-0.35, 0.35)) -> Ground:
    f = np.linspace(2600, 3000, n)
    R = from_pan_tilt_roll(np.linspace(*pan, n), np.linspace(-0.2, -0.22, n), np.zeros(n))
    truth = TrackCamera(
        f_px=f, aspect=np.ones(n), k1=np.full(n, 0.1), pp_px=np.tile([965.0, 532.0], (n, 1)), R_cam_world=R,
        R_ref_world=R[n // 2],
    )  # fmt: skip
    camera = PitchCamera(
        position_m=POSITION, R_pitch_world=R_WORLD_PITCH.T, log_focal=0.0, cov=np.zeros((7, 7)),
        residual_px=np.zeros((0, 2)), chi2_dof=1.0,
    )  # fmt: skip
    return Ground(truth=truth, track=truth.corrected(log_focal), camera=camera)


def test_without_noise_the_camera_is_exact() -> None:
    g = ground()
    rows, xy, points = g.clicks(np.random.default_rng(1), 4, 0.0)
    found = fit_pitch_camera(g.track.taken(rows), xy, points)
    np.testing.assert_allclose(found.position_m, POSITION, atol=1e-6)
    np.testing.assert_allclose(found.R_pitch_world, R_WORLD_PITCH.T, atol=1e-8)
    assert abs(found.log_focal) < 1e-8 and np.abs(found.residual_px).max() < 1e-5
    at = np.array([[400.0, 700.0], [1500.0, 900.0]])
    on_pitch = found.on_plane(g.track.taken([3, 40]), at)
    np.testing.assert_allclose(found.project(g.track.taken([3, 40]), lifted(on_pitch)), at, atol=1e-6)
    assert np.isnan(found.on_plane(g.track.taken([3]), [[960.0, -600.0]])).all()  # above the horizon


def test_points_mend_the_focal_length_of_the_track() -> None:
    """A track 3 % too long, clicks of a pixel: the metres at its ends are then right to a few times their error."""
    g = ground(log_focal=-0.03)
    rows, xy, points = g.clicks(np.random.default_rng(2), 5, 1.0)
    found = fit_pitch_camera(g.track.taken(rows), xy, points, log_focal_std=0.03)
    assert abs(found.log_focal - 0.03) < 4 * np.sqrt(found.cov[6, 6]) < 0.012
    wanted = np.array([[-30.0, 0.0], [30.0, 10.0]])
    at = g.camera.project(g.truth.taken([5, 45]), lifted(wanted))
    metres = found.on_plane(g.track.taken([5, 45]), at)
    std = np.sqrt(np.diagonal(found.on_plane_cov(g.track.taken([5, 45]), at, 0.01), axis1=1, axis2=2))
    assert (np.abs(metres - wanted) < 4 * std).all() and std.max() < 0.5


@pytest.mark.slow
def test_error_bars_of_metres_hold() -> None:
    """Sixty sets of clicks: of 120 pairs of coordinates 60 to 76 % lie within one sigma, and chi2 is about 1."""
    rng = np.random.default_rng(3)
    inside, chi2 = [], []
    for _ in range(60):
        log_focal = rng.normal(0, 0.02)
        g = ground(log_focal=log_focal, n=11)
        rows, xy, points = g.clicks(rng, 3, 1.5)
        found = fit_pitch_camera(g.track.taken(rows), xy, points, click_std_px=1.5, log_focal_std=0.02)
        wanted = np.array([[-20.0, 5.0], [25.0, -10.0]])
        exact = g.camera.project(g.truth.taken([2, 9]), lifted(wanted))
        at = exact + rng.normal(0, 1.5, (2, 2))
        away = found.on_plane(g.track.taken([2, 9]), at) - wanted
        cov = found.on_plane_cov(g.track.taken([2, 9]), at, 1.5)
        inside.append(np.abs(away) < np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))
        chi2.append(found.chi2_dof)
    assert 0.60 <= np.mean(inside) <= 0.76
    assert 0.85 < np.mean(chi2) < 1.15


def test_with_a_known_position_two_points_are_enough() -> None:
    g = ground()
    rows, xy, points = g.clicks(np.random.default_rng(4), 1, 0.0)
    found = fit_pitch_camera(g.track.taken(rows[[0, 4]]), xy[[0, 4]], points[[0, 4]], position_m=POSITION)
    np.testing.assert_allclose(found.R_pitch_world, R_WORLD_PITCH.T, atol=1e-7)
    assert np.isfinite(found.cov).all()


def test_points_that_do_not_suffice_are_refused() -> None:
    g = ground()
    rows, xy, points = g.clicks(np.random.default_rng(5), 4, 0.0)
    for pick, said in ((slice(0, 3), "3 points, 4 are needed"), (slice(0, 0), "0 points")):
        with pytest.raises(ValueError, match=said):
            fit_pitch_camera(g.track.taken(rows[pick]), xy[pick], points[pick])
    line = np.stack([np.linspace(-10, 10, 6), np.zeros(6)], axis=1)
    middle = g.track.taken(np.full(6, 25))
    with pytest.raises(ValueError, match="do not fix"):
        fit_pitch_camera(middle, g.camera.project(middle, lifted(line)), line)
    with pytest.raises(ValueError, match=r"below the pitch|behind the camera"):
        fit_pitch_camera(g.track.taken(rows), xy, points * [1, -1])
    with pytest.raises(ValueError, match="do not go with"):
        fit_pitch_camera(g.track.taken(rows), xy[:-1], points)


# ---- flights


def kick(g: Ground, start: Array, velocity: Array) -> tuple[Array, Array]:
    """Times (n,) and positions (n, 3) of a ball, a picture a 25th of a second."""
    t = np.arange(len(g.truth)) / 25
    return t, start + velocity * t[:, None] + np.array([0, 0, -GRAVITY_M_S2 / 2]) * t[:, None] ** 2


def following(g: Ground, ball: Array) -> Ground:
    """The same ground with a camera that follows a ball."""
    away = (ball - POSITION) @ R_WORLD_PITCH.T
    pan, tilt = np.arctan2(away[:, 0], away[:, 2]), np.arctan2(-away[:, 1], np.hypot(away[:, 0], away[:, 2]))
    R = from_pan_tilt_roll(pan, tilt, np.zeros(len(ball)))
    truth = TrackCamera(
        f_px=g.truth.f_px, aspect=g.truth.aspect, k1=g.truth.k1, pp_px=g.truth.pp_px, R_cam_world=R,
        R_ref_world=R[len(R) // 2],
    )  # fmt: skip
    return Ground(truth=truth, track=truth, camera=g.camera)


SHARP = np.diag([1e-12] * 7)


def test_without_noise_a_flight_is_exact() -> None:
    start, velocity = np.array([-15.0, 2.0, 0.11]), np.array([14.0, 3.0, 9.0])
    t, ball = kick(ground(), start, velocity)
    g = following(ground(), ball)
    camera = PitchCamera(
        position_m=POSITION, R_pitch_world=R_WORLD_PITCH.T, log_focal=0.0, cov=SHARP, residual_px=np.zeros((0, 2)),
        chi2_dof=1.0,
    )  # fmt: skip
    xy = g.camera.project(g.truth, ball)
    flown = fit_flight(camera, g.track.taken(slice(0, 40)), t[:40] + 100.0, xy[:40])
    np.testing.assert_allclose(flown.position_m, start, atol=1e-4)
    np.testing.assert_allclose(flown.velocity_m_s, velocity, atol=1e-4)
    at, where, cov = flown.landing()
    assert at == pytest.approx(100.0 + 2 * 9.0 / GRAVITY_M_S2, abs=1e-4)
    np.testing.assert_allclose(where, start[:2] + velocity[:2] * 2 * 9.0 / GRAVITY_M_S2, atol=1e-3)
    assert np.isfinite(cov).all()
    np.testing.assert_allclose(flown.at(t[:40] + 100.0), ball[:40], atol=1e-3)


def test_a_ball_that_does_not_fly_high_enough_does_not_come_down_there() -> None:
    t, ball = kick(ground(), np.array([-15.0, 2.0, 0.11]), np.array([14.0, 3.0, 9.0]))
    g = following(ground(), ball)
    camera = g.camera.moved(np.zeros(7))
    sharp = PitchCamera(
        position_m=camera.position_m, R_pitch_world=camera.R_pitch_world, log_focal=0.0, cov=SHARP,
        residual_px=camera.residual_px, chi2_dof=1.0,
    )  # fmt: skip
    flown = fit_flight(sharp, g.track, t, g.camera.project(g.truth, ball))
    assert np.isnan(flown.landing(50.0)[0]) and np.isnan(flown.landing(50.0)[1]).all()
    for rows, said in ((slice(0, 3), "3 views"), (np.zeros(5, int), "at different times")):
        with pytest.raises(ValueError, match=said):
            fit_flight(sharp, g.track.taken(rows), t[rows], g.camera.project(g.truth, ball)[rows])


@pytest.mark.slow
def test_landing_points_are_right_within_their_error_bars() -> None:
    """Forty kicks that land about 50 m from the camera, a pixel of noise on ball and clicks, 1 % on the focal length.

    benchmarks/ball_flight.py has the larger campaign.
    """
    found = campaign(40, seed=5)
    error = np.linalg.norm(found.error_m, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.3
    assert 0.55 < np.mean(np.abs(found.error_m) < found.std_m) < 0.80
