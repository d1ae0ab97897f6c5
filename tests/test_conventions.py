"""What mosaic and calib must agree on and each writes for itself: style.md keeps no shared package for it.

Pixel centre, axis order, the gauge of H, the grid and the anchors that `info` is written in. Each test here takes the
same question to both packages and compares the answers; it never states a third definition of its own.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

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
