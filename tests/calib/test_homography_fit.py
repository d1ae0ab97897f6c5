"""Every way to a homography: as good as its covariance says, invariant to units, refusing what it cannot know."""

import numpy as np
import pytest

from calib import homography
from calib.homography_fit import METHODS, fit_homography

H_TRUE = homography.normalise(np.array([[1.1, 0.05, 30], [-0.04, 1.05, -20], [1e-4, -5e-5, 1]]))
PROBE = np.array([[100, 100], [1100, 100], [1100, 600], [100, 600]], float)
SIGMA, N_RUNS, N_POINTS = 0.5, 80, 60


def matches(rng, two_sided, n=N_POINTS, H=H_TRUE):
    a = rng.uniform([0, 0], [1280, 720], (n, 2))
    b = homography.apply(H, a) + SIGMA * rng.standard_normal(a.shape)
    return a + SIGMA * rng.standard_normal(a.shape) * two_sided, b


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_covariance_is_confirmed_by_simulation(method, two_sided):
    rng = np.random.default_rng(5)
    J = homography.point_jacobian(H_TRUE, PROBE).reshape(8, 9)
    values, misfit = [], []
    for _ in range(N_RUNS):
        found = fit_homography(*matches(rng, two_sided), sigma_px=SIGMA, two_sided=two_sided, method=method)
        assert found.converged and np.linalg.det(found.H) == pytest.approx(1, abs=1e-9)
        e = (homography.apply(found.H, PROBE) - homography.apply(H_TRUE, PROBE)).ravel()
        values.append(e @ np.linalg.solve(J @ found.cov @ J.T, e))
        misfit.append(found.chi2)
    # chi2(8): mean 8, variance 16; chi2(112): variance 224. Four standard errors.
    assert abs(np.mean(values) - 8) < 4 * np.sqrt(16 / N_RUNS)
    assert abs(np.mean(misfit) - (2 * N_POINTS - 8)) < 4 * np.sqrt(2 * (2 * N_POINTS - 8) / N_RUNS)


def test_exact_likelihood_has_no_first_view_where_sampsons_weights_have():
    """Few points, strong perspective: swapping the views inverts H exactly only if both views' points are fitted."""
    rng = np.random.default_rng(6)
    H = homography.normalise(np.array([[1.4, 0.3, 30], [-0.2, 0.8, -20], [6e-4, -3e-4, 1]]))
    gap = {"exact": 0.0, "ml": 0.0}
    for _ in range(20):
        a, b = matches(rng, True, n=7, H=H)
        for method in gap:
            there, back = (
                fit_homography(*pair, sigma_px=SIGMA, two_sided=True, method=method).H
                for pair in ((a, b), (b, a))
            )
            moved = homography.apply(homography.invert(back), PROBE[:1]) - homography.apply(there, PROBE[:1])
            gap[method] = max(gap[method], float(np.abs(moved).max()))
    assert gap["exact"] < 1e-3 and gap["ml"] > 10 * gap["exact"]


@pytest.mark.parametrize("method", METHODS)
def test_units_of_the_points_do_not_matter(method):
    a, b = matches(np.random.default_rng(7), True)
    plain = fit_homography(a, b, sigma_px=SIGMA, two_sided=True, method=method)
    scaled = fit_homography(3 * a + 100, 3 * b + 100, sigma_px=3 * SIGMA, two_sided=True, method=method)
    T = np.array([[3, 0, 100], [0, 3, 100], [0, 0, 1.0]])
    expected = homography.normalise(T @ plain.H @ np.linalg.inv(T))
    np.testing.assert_allclose(scaled.H, expected, atol=1e-6 * np.abs(expected).max())
    J = homography.point_jacobian(plain.H, PROBE).reshape(8, 9)
    Js = homography.point_jacobian(scaled.H, 3 * PROBE + 100).reshape(8, 9)
    np.testing.assert_allclose(Js @ scaled.cov @ Js.T, 9 * J @ plain.cov @ J.T, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_points_that_leave_it_open_give_nan(method):
    line = np.stack([np.linspace(0, 1000, 10), np.linspace(0, 500, 10)], 1)
    found = fit_homography(line, line + 3, sigma_px=1.0, method=method)
    assert np.isnan(found.H).all() and np.isnan(found.cov).all() and not found.converged
    with pytest.raises(ValueError):
        fit_homography(line, line[:4], sigma_px=1.0, method=method)


def test_an_unknown_method_is_a_mistake():
    with pytest.raises(ValueError, match="renormalisation"):
        fit_homography(PROBE, PROBE, sigma_px=1.0, method="ransac")
