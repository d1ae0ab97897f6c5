"""HomographyFamily: its Jacobian and A against float64 autograd and central differences, also next to identity."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaic.coords import transfer
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import homography

SIZE = (1280, 720)
FAMILY = HomographyFamily(size_px=SIZE)
few = settings(max_examples=25, deadline=None, derandomize=True, database=None)
homographies = st.builds(
    homography,
    dx=st.floats(-300, 300),
    dy=st.floats(-200, 200),
    zoom=st.floats(0.4, 2.5),
    roll_deg=st.floats(-179, 179),
    px=st.floats(-0.3, 0.3),
    py=st.floats(-0.3, 0.3),
    size_px=st.just(SIZE),
)
POINTS = np.random.default_rng(0).uniform([0, 0], [1279, 719], (30, 2))


def near_identity(seed: int) -> np.ndarray:
    """Identity but for 1e-7 of every parameter, in the increments' own chart."""
    return FAMILY.update(np.eye(3), 1e-7 * np.random.default_rng(seed).normal(size=8))


def moved(H: torch.Tensor, d: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """The family in torch, written from its docstring: C (I + M(d)) C^-1 H on points (n, 2)."""
    w, h = SIZE
    C = torch.tensor([[w / 2, 0, (w - 1) / 2], [0, w / 2, (h - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    M = torch.eye(3, dtype=torch.float64) + torch.cat([d, d.new_zeros(1)]).reshape(3, 3)
    p = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1) @ (C @ M @ torch.linalg.inv(C) @ H).T
    return p[:, :2] / p[:, 2:]


def check_against_autograd(H: np.ndarray) -> None:
    where, J, A = FAMILY.warp(H, FAMILY.prepare(POINTS))
    np.testing.assert_allclose(where, transfer(H, POINTS), rtol=1e-12, atol=1e-9)
    good = np.isfinite(where).all(axis=1)
    assert good.any()
    points, tensor = torch.from_numpy(POINTS[good]), torch.from_numpy(H)
    zero = torch.zeros(8, dtype=torch.float64)
    by_step = torch.autograd.functional.jacobian(lambda d: moved(tensor, d, points), zero).numpy()
    # J is handed on in float32.
    np.testing.assert_allclose(J[good], by_step, rtol=2e-6, atol=1e-4)
    by_point = torch.autograd.functional.jacobian(lambda x: moved(tensor, zero, x).sum(dim=0), points)
    np.testing.assert_allclose(A[good], by_point.permute(1, 0, 2).numpy(), rtol=1e-9, atol=1e-12)


@few
@given(H=homographies)
def test_derivatives_are_those_of_autograd(H):
    check_against_autograd(H)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_hold_next_to_identity(seed):
    H = near_identity(seed)
    assert 0 < np.abs(H - np.eye(3)).max() < 1e-3
    check_against_autograd(H)


@few
@given(H=homographies, seed=st.integers(0, 1000))
def test_derivatives_are_central_differences_of_update_and_warp(H, seed):
    """What the estimator does with them: update by a small step, or look at a neighbouring point."""
    prepared = FAMILY.prepare(POINTS)
    where, J, A = FAMILY.warp(H, prepared)
    direction = np.random.default_rng(seed).normal(size=8)
    e = 1e-6
    plus, minus = (FAMILY.warp(FAMILY.update(H, s * e * direction), prepared)[0] for s in (1, -1))
    inner = np.isfinite(plus + minus).all(axis=1) & (np.abs(where).max(axis=1) < 1e4)
    difference = (plus - minus)[inner] / (2 * e)
    np.testing.assert_allclose((J @ direction)[inner], difference, rtol=1e-4, atol=0.05)
    for axis in (0, 1):
        h = 1e-3 * np.eye(2)[axis]
        plus, minus = (FAMILY.warp(H, FAMILY.prepare(POINTS + s * h))[0] for s in (1, -1))
        np.testing.assert_allclose(A[inner, :, axis], (plus - minus)[inner] / 2e-3, rtol=1e-4, atol=1e-5)


def test_next_to_identity_differences_do_not_drown():
    """At 1e-7 from identity the update is not rounded away: points move as J says, to 1e-4 of it."""
    prepared = FAMILY.prepare(POINTS)
    where, J, _ = FAMILY.warp(np.eye(3), prepared)
    np.testing.assert_array_equal(where, POINTS)
    for k in range(8):
        step = 1e-7 * np.eye(8)[k]
        there = FAMILY.warp(FAMILY.update(np.eye(3), step), prepared)[0]
        np.testing.assert_allclose((there - POINTS) / 1e-7, J[..., k], rtol=1e-4, atol=0.01)


@few
@given(H=homographies)
def test_updates_keep_determinant_one_and_nothing_is_a_step(H):
    assert np.linalg.det(FAMILY.update(H, np.full(8, 0.01))) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(FAMILY.update(H, np.zeros(8)), H, rtol=1e-9, atol=1e-9)


def test_points_behind_are_nan_and_pull_at_nothing():
    H = homography(px=1.5, size_px=SIZE)
    where, J, A = FAMILY.warp(H, FAMILY.prepare(POINTS))
    behind = np.isnan(transfer(H, POINTS)).all(axis=1)
    assert behind.any() and not behind.all()
    np.testing.assert_array_equal(np.isnan(where).all(axis=1), behind)
    assert not J[behind].any() and np.isfinite(A).all()
