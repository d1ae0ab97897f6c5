"""Detail given back: nearer to what the pixels averaged, no border and no strip to be seen, nothing where not asked."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic import detail
from mosaic.canvas import Canvas
from mosaic.detail import SURE_VIEWS, give_back_detail

SIZE = (150, 200)  # more rows than a strip has


def grain(seed=0, sigma=0.7):
    """A picture (h, w, 3) float with detail down to the pixel, about mid gray."""
    noise = np.random.default_rng(seed).normal(0, 1, (*SIZE, 3)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), sigma)
    return 120 + 30 * blurred / blurred.std()


def given_back(folder, image, *, deep=None, n_seen=None, share=0.2, sigma_px=1.0):
    image, deep = image.copy(), None if deep is None else deep.copy()
    n_seen = np.full(SIZE, 17, np.uint8) if n_seen is None else n_seen
    give_back_detail(image, deep, n_seen, Canvas(folder, 10**8), share=share, sigma_px=sigma_px)
    return image, deep


def rms(error):
    return float(np.sqrt((np.asarray(error, np.float64) ** 2).mean()))


def test_what_a_slight_blur_took_comes_back(tmp_path):
    sharp = grain(sigma=1.0)
    seen = np.clip(cv2.GaussianBlur(sharp, (0, 0), 0.45) + 0.5, 0, 255).astype(np.uint8)
    image, _ = given_back(tmp_path, seen)
    assert rms(image - sharp) < 0.7 * rms(seen - sharp)


def test_strips_do_not_show(tmp_path, monkeypatch):
    image = grain().astype(np.uint8)
    in_strips, _ = given_back(tmp_path, image)
    monkeypatch.setattr(detail, "STRIP_ROWS", 1000)
    at_once, _ = given_back(tmp_path, image)
    assert np.array_equal(in_strips, at_once) and not np.array_equal(at_once, image)


def test_the_border_of_what_was_seen_has_no_halo(tmp_path):
    image, n_seen = np.full((*SIZE, 3), 180, np.uint8), np.full(SIZE, 17, np.uint8)
    n_seen[40:90, 60:130] = 0
    image[n_seen == 0] = 0
    result, _ = given_back(tmp_path, image, n_seen=n_seen)
    assert np.array_equal(result, image)


def test_few_views_get_less_of_it(tmp_path):
    image = grain().astype(np.uint8)
    few, _ = given_back(tmp_path, image, n_seen=np.ones(SIZE, np.uint8))
    many, _ = given_back(tmp_path, image)
    ratio = rms(few.astype(float) - image) / rms(many.astype(float) - image)
    assert ratio == pytest.approx(1 / SURE_VIEWS, abs=0.05)


def test_both_depths_stay_the_same_colours(tmp_path):
    exact = grain()
    deep = (exact * 257 + 0.5).astype(np.uint16)
    image, fine = given_back(tmp_path, (exact + 0.5).astype(np.uint8), deep=deep)
    assert np.abs(fine / 257 - image).max() <= 0.51
    assert rms(fine / 257.0 - exact) > 3


def test_nothing_changes_where_it_is_not_asked_for_or_nothing_is_lost(tmp_path):
    image = grain().astype(np.uint8)
    for options in ({"share": 0.0}, {"sigma_px": 0.3}):
        result, _ = given_back(tmp_path, image, **options)
        assert np.array_equal(result, image)
