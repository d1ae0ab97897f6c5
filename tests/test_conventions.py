"""What mosaic and calib must agree on and each writes for itself: style.md keeps no shared package for it.

Pixel centre, axis order, the gauge of H, the grid and the anchors that `info` is written in. Each test here takes the
same question to both packages and compares the answers; it never states a third definition of its own.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import pipelines
from pipelines.records import FRAME_STATUSES, CameraTable

ROOT = Path(__file__).parent.parent


def test_version_is_stated_once() -> None:
    from importlib.metadata import version

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version("broadcast-mosaic") == project["version"]
    assert f"## [{project['version']}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert not re.search(r"__version__\s*=\s*['\"]", Path(pipelines.__file__).read_text(encoding="utf-8"))


def test_every_frame_status_has_a_sign_in_the_report() -> None:
    from pipelines.report.words import STATUS_SIGNS

    assert tuple(STATUS_SIGNS) == FRAME_STATUSES


def test_every_reason_code_of_both_packages_has_words_and_a_cure_in_the_report() -> None:
    """A code that arises without a sentence would reach the reader as it is. `duplicate` needs no cure."""
    from calib.gates import SENTENCES
    from mosaic.records import PAIR_REASONS
    from pipelines.report.words import REASONS

    codes = (set(SENTENCES) | set(PAIR_REASONS)) - {"ok", ""}
    assert codes - set(REASONS) == set()
    assert {code for code in codes if not REASONS[code][1]} <= {"duplicate"}


def test_both_packages_have_one_gauge_and_one_anchor_chart() -> None:
    """A homography leaves mosaic as where its four anchors land; calib makes the same one, det 1, of them again."""
    import calib.homography
    import mosaic.coords

    H = np.array([[1.1, 0.02, 30.0], [-0.01, 1.07, -12.0], [2e-5, -1e-5, 1.0]]) * 3.0
    ours = mosaic.coords.normalise_homography(H)
    assert np.linalg.det(ours) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(calib.homography.normalise(H), ours, rtol=1e-12)
    anchors = mosaic.coords.default_anchors((1280, 720))
    landed = mosaic.coords.transfer(ours, anchors)
    np.testing.assert_allclose(calib.homography.apply(ours, anchors), landed, rtol=1e-12)
    np.testing.assert_allclose(calib.homography.from_anchors(anchors, landed), ours, rtol=1e-9, atol=1e-12)


def test_both_packages_give_nan_for_points_behind_the_camera() -> None:
    """The line at infinity runs through x = 1000 here: what lies past it must not come back as a place in front."""
    import calib.homography
    import mosaic.coords

    H = mosaic.coords.normalise_homography(np.array([[1.0, 0, 0], [0, 1.0, 0], [-1e-3, 0, 1.0]]))
    front, behind = np.array([[900.0, 10.0]]), np.array([[1100.0, 10.0]])
    np.testing.assert_allclose(calib.homography.apply(H, front), mosaic.coords.transfer(H, front), rtol=1e-12)
    assert np.isnan(mosaic.coords.transfer(H, behind)).all()
    assert np.isnan(calib.homography.apply(H, behind)).all()


def test_camera_columns_carry_their_units() -> None:
    """A column that is an angle, a length in pixels or a time says so in its name; the others have no unit."""
    bare = {
        "frame",
        "timecode",
        "source_frame",
        "field",
        "shot",
        "status",
        "reason",
        "aspect",
        "k1",
        "overlap",
    }
    bare |= {"zoom_ratio", "zoom_ratio_std", "homography"}
    names = set(CameraTable.__dataclass_fields__)
    assert {name for name in names - bare if not name.endswith(("_px", "_deg", "_s"))} == set()
