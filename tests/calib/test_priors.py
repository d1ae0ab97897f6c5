"""What users know: lengths and angles to px and back, and a lens saved from one match that helps the next."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib import Lens, Priors, refine
from calib.priors import (
    LensProfile,
    focal_mm_from_px,
    focal_px_from_fov,
    focal_px_from_mm,
    lens_profile,
    with_known_focal,
    with_profile,
)
from tests.calib.test_refine import common_error, make


def test_lengths_and_angles_are_those_of_a_pinhole():
    assert focal_px_from_fov(np.deg2rad(90), 1920) == pytest.approx(960)
    # A 2/3 inch sensor is 9.59 mm wide: at 50 mm the picture spans 10.96 degrees.
    f = focal_px_from_mm(50, 9.59, 1920)
    assert focal_px_from_fov(2 * np.arctan(9.59 / 2 / 50), 1920) == pytest.approx(f)
    assert focal_mm_from_px(f, 9.59, 1920) == pytest.approx(50)
    for call, arguments in (
        (focal_px_from_fov, (4.0, 1920)),
        (focal_px_from_mm, (-1, 9.59, 1920)),
        (focal_mm_from_px, (1000, 0.0, 1920)),
        (with_known_focal, (Priors(), 0, 0.0, 1.0)),
    ):
        with pytest.raises(ValueError):
            call(*arguments)


def test_a_known_field_of_view_scales_a_shot_that_only_zooms():
    truth, graph = make(1, n=6, pan_deg=0, tilt_deg=0, roll_deg=0, zoom=1.8)
    f0 = float(np.exp(truth.log_f[0]))
    hfov = 2 * np.arctan(1280 / 2 / f0)
    priors = with_known_focal(Priors(), 0, focal_px_from_fov(hfov, 1280), 0.01 * f0)
    solution = refine(graph, priors=priors)
    assert solution.log_f[0] == pytest.approx(truth.log_f[0], abs=0.01)
    assert solution.log_f[-1] - solution.log_f[0] == pytest.approx(np.log(1.8), abs=2e-3)


def test_a_lens_of_one_match_sharpens_the_next(tmp_path):
    first, graph = make(2, n=12, pan_deg=40, zoom=1.8)
    profile = lens_profile(refine(graph))
    assert abs(profile.c0 - first.lens.c0) < 4 * profile.c0_std
    profile.save(tmp_path / "lens.json")
    again = LensProfile.load(tmp_path / "lens.json")
    assert again == profile
    plain, helped, stated = [], [], []
    for seed in range(4):
        truth, short = make(20 + seed, n=6, pan_deg=7, zoom=1.2)
        without = refine(short)
        with_lens = refine(short, priors=with_profile(Priors(), again))
        plain.append(common_error(without, truth))
        helped.append(common_error(with_lens, truth))
        stated.append(with_lens.sigma_mean_log_f / without.sigma_mean_log_f)
    assert np.sqrt(np.mean(np.square(helped))) < 0.7 * np.sqrt(np.mean(np.square(plain)))
    assert np.all(np.array(stated) < 1)


def test_a_profile_is_of_the_picture_and_not_of_its_resolution():
    lens = Lens(size_px=(1280, 720), pp_px=np.array([640.0, 350.0]), c0=0.04, c1=-0.01)
    big = Lens(size_px=(2560, 1440), pp_px=np.array([1280.0, 700.0]), c0=0.04, c1=-0.01)
    assert lens.k1_half(np.log(1500.0)) == pytest.approx(float(big.k1_half(np.log(3000.0))))


def test_other_files_and_bad_solutions_are_refused(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"lens_profile": 99}), encoding="utf-8")
    (tmp_path / "b.json").write_text("no json", encoding="utf-8")
    for name in ("a.json", "b.json"):
        with pytest.raises(ValueError, match="lens profile"):
            LensProfile.load(tmp_path / name)
    _, graph = make(3, n=6, pan_deg=20)
    with pytest.raises(ValueError, match="no_edges"):
        lens_profile(refine(replace(graph, edges=())))
    with pytest.raises(ValueError):
        with_profile(Priors(), LensProfile(c0=0, c1=0, c0_std=1, c1_std=1, pp_offset_w=(0, 0), pp_std_w=(1, 1),
                                           log_f_w=(0, 1)), trust=0)  # fmt: skip
