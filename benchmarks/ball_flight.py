"""Balls kicked on a made-up ground: how far the landing point is off, and whether its error bars hold.

    python -m benchmarks.ball_flight --n 400

Each kick has its own camera (40 to 60 m from where the ball lands: 50 in the middle), flight (1.2 to 2.2 s), direction,
ball (1 px of noise in each coordinate, 25 pictures a second), eight to twenty clicks of pitch points in four frames
(1 px), and a focal length that is wrong by 1 % (one sigma, the same in the whole track). No picture is made.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.flight import GRAVITY_M_S2, fit_flight
from calib.pitch import PitchCamera, TrackCamera, fit_pitch_camera
from calib.rotation import from_pan_tilt_roll

Array = NDArray[np.float64]

SIZE = (1920, 1080)
GRID = np.array(
    [
        [x, y]
        for x in (-52.5, -36.0, -16.5, 0.0, 16.5, 36.0, 52.5)
        for y in (-34.0, -20.16, -9.15, 0.0, 9.15, 20.16, 34.0)
    ]
)
R_WORLD_PITCH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
BALL_M = 0.11


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """error_m, std_m (n, 2) of landing points in X and Y; distance_m (n,) from the camera; chi2_dof (n,).

    bound_m (n, 2): one sigma by the information at the truth (Cramer-Rao, with the focal length's error as prior): what
    no unbiased estimator from the same clicks and the same pixels of the ball can be below on average.
    """

    error_m: Array
    std_m: Array
    bound_m: Array
    distance_m: Array
    chi2_dof: Array


def campaign(
    n: int,
    *,
    seed: int = 1,
    ball_px: float = 1.0,
    click_px: float = 1.0,
    focal_std: float = 0.01,
    f_px: float = 2600.0,
) -> Campaign:
    """n kicks. f_px: focal length at 1920 px; it grows by a tenth while the ball flies."""
    rng = np.random.default_rng(seed)
    rows: list[list[float]] = []
    while len(rows) < n:
        row = _kick(rng, ball_px, click_px, focal_std, f_px)
        if row is not None:
            rows.append(row)
    table = np.array(rows)
    return Campaign(
        error_m=table[:, :2], std_m=table[:, 2:4], distance_m=table[:, 4], chi2_dof=table[:, 5], bound_m=table[:, 6:8]
    )  # fmt: skip


def _kick(
    rng: np.random.Generator, ball_px: float, click_px: float, focal_std: float, f_px: float
) -> list[float] | None:
    """Error, sigma (X, Y each), distance, chi2 and bound (X, Y) of one kick; None where too little of the field is in
    the picture."""
    flight_s = rng.uniform(1.2, 2.2)
    n = int(flight_s * 25)
    t = np.arange(n) / 25
    lands = np.array([rng.uniform(-35, 35), rng.uniform(-20, 20)])
    towards, speed = rng.uniform(0, 2 * np.pi), rng.uniform(8, 20)
    velocity = np.array([speed * np.cos(towards), speed * np.sin(towards), GRAVITY_M_S2 * flight_s / 2])
    start = np.array([*(lands - velocity[:2] * flight_s), BALL_M])
    ball = start + velocity * t[:, None] + np.array([0, 0, -GRAVITY_M_S2 / 2]) * t[:, None] ** 2
    # The camera 50 m from where the ball lands, give or take ten, on its side of the field, 12 m up.
    position = np.array([lands[0] + rng.uniform(-15, 15), 0.0, 12.0])
    distance = rng.uniform(40, 60)
    position[1] = lands[1] - np.sqrt(distance**2 - position[2] ** 2 - (position[0] - lands[0]) ** 2)
    away = (ball * [1, 1, 0.5] - position) @ R_WORLD_PITCH.T
    pan, tilt = np.arctan2(away[:, 0], away[:, 2]), np.arctan2(-away[:, 1], np.hypot(away[:, 0], away[:, 2]))
    if (away[:, 2] < 5).any():
        return None
    R = from_pan_tilt_roll(pan, tilt, np.zeros(n))
    truth = TrackCamera(
        f_px=f_px * np.exp(np.linspace(0, np.log(1.1), n)), aspect=np.ones(n), k1=np.full(n, 0.05),
        pp_px=np.tile([959.5, 539.5], (n, 1)), R_cam_world=R, R_ref_world=R[n // 2],
    )  # fmt: skip
    true = PitchCamera(
        position_m=position, R_pitch_world=R_WORLD_PITCH.T, log_focal=0.0, cov=np.zeros((7, 7)),
        residual_px=np.zeros((0, 2)), chi2_dof=1.0,
    )  # fmt: skip
    clicks = [
        (row, *xy, *point)
        for row in np.linspace(0, n - 1, 4).astype(int)
        for xy, point in _visible(true, truth, int(row), rng)
    ]
    if len(clicks) < 8:
        return None
    table = np.array(clicks)
    rows, clicked, points = table[:, 0].astype(int), table[:, 1:3], table[:, 3:]
    stated = {"click_std_px": click_px, "log_focal_std": focal_std}
    track = truth.corrected(rng.normal(0, focal_std))

    own = np.random.default_rng(0)  # so that the bound changes no kick

    def little(shape: tuple[int, ...]) -> Array:
        return own.normal(0, 0.01, shape)

    try:
        camera = fit_pitch_camera(
            track.taken(rows), clicked + rng.normal(0, click_px, (len(table), 2)), points, **stated
        )
        exact = fit_pitch_camera(truth.taken(rows), clicked + little(clicked.shape), points, **stated)
    except ValueError:
        return None  # all clicks in one line: no field user would accept that either
    seen = true.project(truth, ball)
    flown = fit_flight(camera, track, t, seen + rng.normal(0, ball_px, (n, 2)), pixel_std=ball_px)
    _, where, cov = flown.landing(BALL_M)
    # Almost without noise the fit is almost the truth, and its covariance the inverse of the information there.
    _, there, bound = fit_flight(exact, truth, t, seen + little(seen.shape), pixel_std=ball_px).landing(
        BALL_M
    )
    assert np.abs(there - lands).max() < 0.05
    return [
        *(where - lands),
        *np.sqrt(np.diag(cov)),
        distance,
        flown.chi2_dof,
        *np.sqrt(np.diag(bound)),
    ]


def _visible(
    camera: PitchCamera, track: TrackCamera, row: int, rng: np.random.Generator
) -> list[tuple[Array, Array]]:
    """At most five points of the field in a frame, with their pixels."""
    points = np.concatenate([GRID, np.zeros((len(GRID), 1))], axis=1)
    xy = camera.project(track.taken(np.full(len(GRID), row)), points)
    inside = np.flatnonzero(((xy > 0) & (xy < [SIZE[0] - 1, SIZE[1] - 1])).all(axis=1))
    return [(xy[k], GRID[k]) for k in rng.permutation(inside)[:5]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(
        "| f px at 1920 | kicks | rms m | bound, rms m | median m | 90 % m | inside one sigma | chi2 per dof |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for f_px in (2000.0, 2600.0, 4000.0):
        found = campaign(options.n, seed=options.seed, f_px=f_px)
        error = np.linalg.norm(found.error_m, axis=1)
        inside = np.mean(np.abs(found.error_m) < found.std_m)
        print(
            f"| {f_px:.0f} | {len(error)} | {np.sqrt(np.mean(error**2)):.3f} | "
            f"{np.sqrt(np.mean(np.sum(found.bound_m**2, axis=1))):.3f} | {np.median(error):.3f} | "
            f"{np.quantile(error, 0.9):.3f} | {100 * inside:.1f} % | {found.chi2_dof.mean():.2f} |"
        )


if __name__ == "__main__":
    main()
