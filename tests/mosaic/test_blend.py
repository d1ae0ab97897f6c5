"""Sampling, gains and the robust value, each against numpy or a formula."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.blend import blend_stack, median_network
from mosaic.gains import solve_log_gains
from mosaic.sampling import sample_view


def sampled(
    image,
    x,
    y,
    *,
    cubic=True,
    gain=(1, 1, 1),
    trust=None,
    still=None,
    margin=2.0,
    feather=10.0,
    step=16,
    falloff=(0, 0),
):
    """sample_view of a map x(i), y(j) (functions of tile pixels) over a 48 x 32 tile: out, vote, weight."""
    height, width = 32, 48
    columns, rows = (step * np.arange(n // step + 1.0) for n in (width, height))
    grid = np.stack([*np.meshgrid(x(columns), y(rows)), *np.ones((2, len(rows), len(columns)))], -1).astype(
        np.float32
    )
    out, seen, weight = (
        np.zeros(s, np.uint8) for s in ((3, height, width), (height, width), (height, width))
    )
    everywhere = np.full((1, 1), 255, np.uint8)
    trust, still = (everywhere if plane is None else plane for plane in (trust, still))
    sample_view(
        image, 0, image.shape[0], trust, still, grid, step, np.array(gain, np.float32),
        np.array(falloff, np.float32), np.float32(margin), np.float32(feather), cubic, out, seen, weight,
    )  # fmt: skip
    return out, seen, weight


def ramp(width=120, height=80):
    """Red rises by 2 per column, green by 3 per row, blue is flat."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([2 * x, 3 * y, np.full_like(x, 77)], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("cubic", [True, False])
def test_a_ramp_is_sampled_where_the_map_says(cubic):
    out, seen, _ = sampled(ramp(), lambda u: 20.25 + 0.75 * u, lambda v: 10.4 + 1.5 * v, cubic=cubic)
    u, v = np.arange(48), np.arange(32)
    assert (seen > 0).all()
    # A sample is rounded to whole grey levels: half a level either way, and nothing more.
    assert np.abs(out[0] - 2 * (20.25 + 0.75 * u)).max() <= 0.501
    assert np.abs(out[1] - 3 * (10.4 + 1.5 * v)[:, None]).max() <= 0.501
    assert (out[2] == 77).all()


@pytest.mark.parametrize("cubic", [True, False])
def test_a_half_pixel_shift_would_be_seen(cubic):
    exact, _, _ = sampled(ramp(), lambda u: 20 + u, lambda v: 10 + v, cubic=cubic)
    shifted, _, _ = sampled(ramp(), lambda u: 20.5 + u, lambda v: 10 + v, cubic=cubic)
    np.testing.assert_array_equal(shifted[0].astype(int) - exact[0], 1)


def test_frame_border_is_left_out_and_feathered():
    _, seen, weight = sampled(ramp(), lambda u: u - 4.0, lambda v: 20.0 + v, margin=3.0, feather=10.0)
    assert (seen[:, :7] == 0).all() and (seen[:, 7:] > 0).all()
    assert (weight[:, :7] == 0).all() and weight[0, 7] in (25, 26)  # a tenth of 255
    assert (np.diff(weight[0, 7:17].astype(int)) > 0).all() and (weight[:, 17:] == 255).all()


def test_unseen_map_points_take_their_cells_with_them():
    def x(u):
        return np.where(u > 20, -1e9, 20 + u)

    _, seen, _ = sampled(ramp(), x, lambda v: 20.0 + v)
    assert (seen[:, :17] == 255).all() and (seen[:, 17:] == 0).all()


def test_trust_of_zero_is_not_seen_and_half_trust_halves_the_weight():
    trust = np.full((80, 120), 255, np.uint8)
    trust[:, :30], trust[:, 40:50] = 0, 128
    _, seen, weight = sampled(ramp(), lambda u: 20.0 + u, lambda v: 20.0 + v, trust=trust)
    assert (seen[:, :10] == 0).all() and (seen[:, 20:30] == 128).all() and (seen[:, 10:20] == 255).all()
    assert (weight[:, 20:30] == 128).all() and (weight[:, 10:20] == 255).all()


def test_gain_multiplies_and_saturates():
    out, _, _ = sampled(ramp(), lambda u: 20.0 + u, lambda v: 20.0 + v, gain=(1.25, 10.0, 0.5))
    np.testing.assert_array_equal(out[0, 0], np.floor(2 * (20.0 + np.arange(48)) * 1.25 + 0.5))
    assert (out[1] == 255).all() and (out[2] == 39).all()


@pytest.mark.parametrize("n", [1, 2, 3, 8, 17, 25, 40])
def test_the_pruned_network_finds_the_middle_element(n):
    values = np.random.default_rng(n).integers(0, 256, (n, 500))
    rows = values.copy()
    for a, b in median_network(n):
        rows[a], rows[b] = np.minimum(rows[a], rows[b]), np.maximum(rows[a], rows[b])
    np.testing.assert_array_equal(rows[n // 2], np.sort(values, axis=0)[n // 2])


def stack_of(n, seed=0, noise=2.0, size=(8, 300)):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(60, 190, (3, *size))
    stack = np.clip(np.rint(truth + rng.normal(0, noise, (n, 3, *size))), 0, 255).astype(np.uint8)
    full = np.full((n, *size), 255, np.uint8)
    return truth.transpose(1, 2, 0), stack, full, full.copy()


def test_noise_falls_as_in_a_mean_not_as_in_a_median():
    truth, stack, vote, weight = stack_of(17)
    image, n_seen, spread, *_ = blend_stack(stack, vote, weight)
    error = np.std(image - truth)
    # 2 / sqrt(17) = .49 and .29 of rounding make .56; a median would have 1.25 times the .49, so .67.
    assert error < 0.62
    assert (n_seen == 17).all() and 1.0 < spread.mean() < 4.0


def test_outliers_in_under_half_of_the_views_leave_no_trace():
    truth, stack, vote, weight = stack_of(17)
    stack[:7] = np.array([250, 10, 10], np.uint8)[:, None, None]
    image, *_ = blend_stack(stack, vote, weight)
    assert np.abs(image - truth).max() < 6 and np.abs((image - truth).mean()) < 0.5


def test_views_that_do_not_see_a_pixel_do_not_count():
    truth, stack, vote, weight = stack_of(9)
    stack[4:] = 0
    vote[4:] = 0
    weight[4:] = 0
    image, n_seen, *_ = blend_stack(stack, vote, weight)
    assert (n_seen == 4).all() and np.std(image - truth) < 1.6
    vote[:] = 0
    image, n_seen, *_ = blend_stack(stack, vote, weight)
    assert not image.any() and not n_seen.any()


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("extra", [0, 1, 2, 3])
def test_missing_views_do_not_shift_the_median(n, extra):
    truth, stack, vote, weight = stack_of(n + extra, noise=1.0)
    vote[n:] = 0
    stack[n:] = 255
    image, *_ = blend_stack(stack, vote, weight)
    # Halves are rounded up: of two views the mean is a half in every second pixel, which makes .25.
    assert abs(float((image - truth).mean())) < (0.3 if n == 2 else 0.15)


def test_two_views_that_differ_give_the_better_one_whole_not_a_mixture():
    size = (4, 5)
    stack = np.zeros((2, 3, *size), np.uint8)
    stack[0], stack[1] = 40, np.array([200, 20, 90], np.uint8)[:, None, None]
    weight = np.full((2, *size), 255, np.uint8)
    vote = np.stack([np.full(size, 100, np.uint8), np.full(size, 140, np.uint8)])
    image, *_ = blend_stack(stack, vote, weight)
    assert (image == [200, 20, 90]).all()


def test_low_trust_in_the_many_lets_the_trusted_few_win():
    truth, stack, vote, weight = stack_of(11)
    stack[:8] = 230  # a player who stands there in most views, and is known to be one
    vote[:8] = 25
    image, *_ = blend_stack(stack, vote, weight)
    assert np.abs(image - truth).max() < 9


def test_where_views_disagree_the_votes_decide():
    _, stack, vote, weight = stack_of(9, noise=0.0, size=(2, 2))
    stack[:4], stack[4:] = 60, 180
    vote[:4], vote[4:] = 250, 60
    image, *_ = blend_stack(stack, vote, weight)
    assert (image == 60).all()


def gain_problem(n=12, p=600, noise=0.01, outliers=0.15, seed=3):
    """A chain of frames, each seeing a fifth of the points."""
    rng = np.random.default_rng(seed)
    gain = rng.normal(0, 0.2, n)
    colour = rng.uniform(3.5, 5.2, p)
    at, centre = np.linspace(0, 1, p), np.linspace(0, 1, n)
    weight = (np.abs(at - centre[:, None]) < 0.12).astype(float)
    samples = colour - gain[:, None] + rng.normal(0, noise, (n, p))
    samples += (rng.random((n, p)) < outliers) * rng.normal(0, 0.7, (n, p))
    return gain, samples, weight


def test_gains_are_found_along_a_chain_despite_players():
    gain, samples, weight = gain_problem()
    found = solve_log_gains(samples, weight, prior_std=10.0)
    error = found - gain
    assert np.std(error) < 0.01  # a chain of 12 with about 25 common points each, .01 of noise


def test_equal_exposures_give_gain_one_and_a_lone_frame_is_left_alone():
    gain, samples, weight = gain_problem(noise=0.0, outliers=0.0)
    samples += gain[:, None]
    np.testing.assert_allclose(solve_log_gains(samples, weight), 0, atol=2e-3)
    lone = np.vstack([weight, np.zeros(weight.shape[1])])
    more = np.vstack([samples, np.full(weight.shape[1], 9.9)])
    assert abs(solve_log_gains(more, lone)[-1]) < 2e-3


def test_gains_refuse_shapes_that_do_not_fit():
    with pytest.raises(ValueError, match="must be equal"):
        solve_log_gains(np.zeros((3, 4)), np.zeros((3, 5)))
