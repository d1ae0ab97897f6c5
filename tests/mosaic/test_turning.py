"""What turning cameras do holds a loose homography, says nothing of their focal length, and lets others go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosaic.coords import default_anchors, normalise_homography, transfer
from mosaic.pair import PairOptions, register
from mosaic.records import FlowGrid, PairFit, PairStatus
from mosaic.turning import IMPOSSIBLE, LIKELY, contradiction, held, nearest_turn
from tests.mosaic.textures import as_uint8, corner_error_px, homography, picture

SIZE = (1280, 720)
ANCHORS = default_anchors(SIZE)


def _camera(f: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    """K (3, 3), f in half widths."""
    return np.array(
        [[f * size[0] / 2, 0, (size[0] - 1) / 2], [0, f * size[0] / 2, (size[1] - 1) / 2], [0, 0, 1]]
    )


def _turned(f: float, zoom: float, pan: float, tilt: float, roll: float) -> np.ndarray:
    """Homography of a camera that turned (in half widths, roll in rad) and zoomed."""
    R = Rotation.from_rotvec([tilt / f, pan / f, roll]).as_matrix()
    return _camera(f * zoom) @ R @ np.linalg.inv(_camera(f))


def _drawn(rng: np.random.Generator) -> np.ndarray:
    f = float(np.exp(rng.uniform(np.log(1.5), np.log(8))))
    return _turned(f, float(np.exp(0.1 * rng.normal())), *rng.uniform(-0.5, 0.5, 2), 0.05 * rng.normal())


def _loose(rng: np.random.Generator, px: float) -> np.ndarray:
    """Information (8, 8) of the anchors from textures in a band: a homography from points, the lower picture unseen."""
    points = np.column_stack([rng.uniform(0, SIZE[0], 60), rng.uniform(0, 0.4 * SIZE[1], 60)])
    J = np.zeros((60, 2, 8))
    for k in range(8):
        moved = ANCHORS.copy()
        moved.ravel()[k] += 1e-3
        J[:, :, k] = (transfer(_through(moved), points) - points) / 1e-3
    J = J.reshape(-1, 8)
    return J.T @ J / px**2


def _through(anchors: np.ndarray) -> np.ndarray:
    """The homography (3, 3) that takes the anchors there."""
    rows = []
    for (x, y), (u, v) in zip(ANCHORS, anchors, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    return normalise_homography(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))


def _fit(H: np.ndarray, info: np.ndarray) -> PairFit:
    return PairFit(
        src=0, dst=1, H_dst_src=H, status=PairStatus.OK, reason="", overlap=1.0, rms_grey=2.0, score=0.1, gain=1.0,
        offset=0.0, n_steps=1, route="identity", flow=FlowGrid.empty(), anchors_px=ANCHORS, info=info,
    )  # fmt: skip


def _measured(H: np.ndarray, info: np.ndarray, rng: np.random.Generator) -> PairFit:
    """A fit of a true H with an error drawn from its information."""
    noise = np.linalg.solve(np.linalg.cholesky(info).T, rng.normal(size=8)).reshape(4, 2)
    return _fit(_through(transfer(H, ANCHORS) + noise), info)


def test_loose_pairs_of_turning_cameras_come_nearer_and_state_it():
    rng = np.random.default_rng(3)
    before, after, chi2 = [], [], []
    for _ in range(120):
        H = _drawn(rng)
        fit = _measured(H, _loose(rng, 2.0), rng)
        now = held(fit, SIZE, SIZE)
        d = (transfer(now.H_dst_src, ANCHORS) - transfer(H, ANCHORS)).ravel()
        before.append(np.linalg.norm(transfer(fit.H_dst_src, ANCHORS) - transfer(H, ANCHORS)))
        after.append(np.linalg.norm(d))
        chi2.append(d @ now.info @ d / 8)
    assert np.median(after) < 0.6 * np.median(before)
    # The constraints are exact here, and looser in the prior: below 1.
    assert 0.4 < np.mean(chi2) < 1.1


@pytest.mark.parametrize("f", [1.5, 3.0, 8.0])
def test_a_camera_is_left_where_it_is(f):
    """Also one that turned by half its width, zoomed and rolled, however loose the pixels."""
    H = _turned(f, 1.3, 0.9, 0.3, 0.2)
    now = held(_fit(H, _loose(np.random.default_rng(1), 3.0)), SIZE, SIZE)
    stds = np.sqrt(np.diag(np.linalg.inv(now.info)))
    away = np.abs(transfer(now.H_dst_src, ANCHORS) - transfer(H, ANCHORS)).ravel()
    assert (away < 0.2 * stds).all()


def test_the_focal_length_stays_open():
    """Which focal length it was is as uncertain as the pixels leave it."""
    f, pose = 3.0, (1.0, 0.4, 0.1, 0.0)
    J = np.array(
        [
            (transfer(_turned(f * 1.001, *pose), ANCHORS) - transfer(_turned(f, *pose), ANCHORS)).ravel()
            / 1e-3,
            *(
                (
                    transfer(_turned(f, *np.add(pose, step)), ANCHORS) - transfer(_turned(f, *pose), ANCHORS)
                ).ravel()
                / 1e-4
                for step in 1e-4 * np.eye(4)
            ),
        ]
    )
    fit = _fit(_turned(f, *pose), _loose(np.random.default_rng(2), 1.0))

    def log_f_std(info: np.ndarray) -> float:
        return float(np.sqrt(np.linalg.inv(J @ info @ J.T)[0, 0]))

    assert log_f_std(held(fit, SIZE, SIZE).info) == pytest.approx(log_f_std(fit.info), rel=0.02)


def test_what_no_turning_camera_does_is_left_to_the_pixels():
    """A skewed picture, 40 px at its side: .1 px of pixel error is not made .02 px worse."""
    shear = np.array([[1, 0.06, 0], [0.06, 1, 0], [0, 0, 1.0]])
    H = _camera(1.0) @ shear @ np.linalg.inv(_camera(1.0))
    fit = _fit(H, np.eye(8) / 0.1**2)
    now = held(fit, SIZE, SIZE)
    assert corner_error_px(now.H_dst_src, H, SIZE) < 0.02
    assert np.trace(now.info) < 1.02 * np.trace(fit.info)


def test_cameras_are_contradicted_as_chance_has_it_and_a_shear_far_beyond():
    rng = np.random.default_rng(8)
    found = []
    for _ in range(200):
        fit = _measured(_drawn(rng), _loose(rng, 5.0), rng)
        found.append(contradiction(fit, SIZE, SIZE))
    # Chi-square of three, the focal length being open, up to four; and a lens is allowed for that they do not have.
    assert 2.0 < np.mean(found) < 4.5 and max(found) < IMPOSSIBLE
    shear = _camera(1.0) @ np.array([[1, 0.01, 0], [0.01, 1, 0], [0, 0, 1.0]]) @ np.linalg.inv(_camera(1.0))
    assert contradiction(_fit(shear, np.eye(8) / 0.1**2), SIZE, SIZE) > 2 * IMPOSSIBLE
    assert contradiction(_fit(shear, np.zeros((8, 8))), SIZE, SIZE) == 0.0


def test_the_nearest_turn_has_no_shear_and_a_camera_is_its_own():
    turned = _turned(3.0, 1.1, 0.3, 0.1, 0.05)
    info = np.eye(8) / 0.1**2
    own = nearest_turn(_fit(turned, info), SIZE, SIZE)
    assert own is not None and corner_error_px(own, turned, SIZE) < 0.5
    shear = _camera(1.0) @ np.array([[1, 0.01, 0], [0.01, 1, 0], [0, 0, 1.0]]) @ np.linalg.inv(_camera(1.0))
    near = nearest_turn(_fit(shear @ turned, info), SIZE, SIZE)
    assert near is not None and contradiction(_fit(near, info), SIZE, SIZE) < 0.5
    assert corner_error_px(near, shear @ turned, SIZE) < 10.0


def test_a_loose_pair_that_no_turning_camera_made_is_moved_by_about_its_stated_error():
    """The price: where the pixels hardly contradict it, a camera is assumed."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        H = homography(*rng.uniform(-20, 20, 2), 1.02, 0.5, *rng.uniform(-0.02, 0.02, 2), size_px=SIZE)
        fit = _fit(H, _loose(rng, 1.0))
        d = (transfer(held(fit, SIZE, SIZE).H_dst_src, ANCHORS) - transfer(H, ANCHORS)).ravel()
        assert d @ fit.info @ d < LIKELY


def test_the_way_back_is_held_alike():
    rng = np.random.default_rng(5)
    H, info = _drawn(rng), _loose(rng, 1.0)
    fit = _measured(H, info, rng)
    there = held(fit, SIZE, SIZE)
    # The same knowledge, written of where the anchors of b land in a.
    inverse = np.linalg.inv(fit.H_dst_src)
    step = 1e-3
    J = np.empty((8, 8))
    for k in range(8):
        moved = transfer(fit.H_dst_src, ANCHORS)
        moved.ravel()[k] += step
        through = _through(moved)
        J[:, k] = (transfer(np.linalg.inv(through), ANCHORS) - transfer(inverse, ANCHORS)).ravel() / step
    other = np.linalg.inv(J)
    back = held(_fit(inverse, other.T @ info @ other), SIZE, SIZE)
    moved_px = corner_error_px(there.H_dst_src, fit.H_dst_src, SIZE)
    assert corner_error_px(np.linalg.inv(back.H_dst_src), there.H_dst_src, SIZE) < 0.1 * moved_px


def test_failed_and_undetermined_fits_pass_through():
    lost = replace(_fit(np.full((3, 3), np.nan), np.zeros((8, 8))), status=PairStatus.FAILED, reason="score")
    open_ = _fit(homography(5, 3), np.zeros((8, 8)))
    assert held(lost, SIZE, SIZE) is lost and held(open_, SIZE, SIZE) is open_


def test_register_can_leave_all_to_the_pixels():
    H = homography(9, -4, 1.02, 0.6)
    a, b = as_uint8(picture(6), noise=4, seed=1), as_uint8(picture(6, H), noise=4, seed=2)
    held_fit, free = (register(a, b, options=PairOptions(turning=on)) for on in (True, False))
    assert np.trace(held_fit.info) > np.trace(free.info)
    assert corner_error_px(held_fit.H_dst_src, free.H_dst_src) < 0.1
