"""What single formats say: FreeD's golden packets and fields, SoccerNet's world and picture size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.exports.freed import packet, wrapped
from tests.pipelines.export_readers import about, decode_freed
from tests.pipelines.export_truth import FIRST, N, Truth, truth
from tests.pipelines.test_exports import PLAIN, write

# ---- FreeD's golden packets: from an independent decoder (formats.md A1)


@pytest.mark.parametrize(
    ("values", "golden"),
    [
        (
            {"camera_id": 1, "pan_deg": 0, "tilt_deg": 0, "roll_deg": 0},
            "d10100000000000000000000000000000000000000000000000000006e",
        ),
        (
            {
                "camera_id": 1, "pan_deg": 12.5, "tilt_deg": -3.25, "roll_deg": 0.5,
                "position_mm": (1000, -2000, 1500.5), "zoom": 4660, "focus": 2748, "user": 7,
            },
            "d101064000fe600000400000fa00fe0c00017720001234000abc0007db",
        ),
        (
            {
                "camera_id": 255, "pan_deg": -180, "tilt_deg": 90, "roll_deg": -1 / 32768,
                "position_mm": (-131071.984375, 131071.984375, 0), "zoom": 65535, "focus": 1, "user": 65535,
            },
            "d1ffa600002d0000ffffff8000017fffff00000000ffff000001ffffa5",
        ),
    ],
)  # fmt: skip
def test_freed_packets_are_the_golden_ones(values: dict[str, Any], golden: str) -> None:
    assert packet(**values).hex() == golden


def test_freed_refuses_what_its_fields_cannot_hold() -> None:
    good = {"pan_deg": 0.0, "tilt_deg": 0.0, "roll_deg": 0.0}
    for spoiled in (
        {"tilt_deg": 91.0},
        {"zoom": 1 << 24},
        {"user": 65536},
        {"position_mm": (0, 0, 200_000.0)},
    ):
        with pytest.raises(ValueError, match=r"tilt|field"):
            packet(1, **{**good, **spoiled})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("angle", "expected"), [(180, 180), (-180, -180), (190, -170), (-190, 170), (540, -180)]
)
def test_angles_are_wrapped(angle: float, expected: float) -> None:
    assert wrapped(angle) == expected


def test_freed_zoom_is_millimetres_only_with_a_sensor(tmp_path: Path) -> None:
    known = truth(**PLAIN)
    for width_mm, law in ((None, "f_px * 16"), (9.6, "9.6 mm wide")):
        [shot, _] = write(tmp_path, "freed", known, sensor_width_mm=width_mm)
        assert shot.path is not None and law in json.loads(shot.notes.read_text())["zoom_law"]
        zoom = decode_freed(shot.path.read_bytes()[:29])["zoom"]
        assert zoom == round(known.f_px[0] * (16 if width_mm is None else 9.6 / 1920 * 1000))


# ---- SoccerNet


def test_soccernet_keeps_its_readers_picture_size(tmp_path: Path) -> None:
    """The reader takes twice the principal point for the picture's size: the middle is (W/2, H/2) for it."""
    for centred, expected in ((True, [960.0, 540.0]), (False, [966.25, 530.5])):
        [shot, _] = write(tmp_path, "soccernet", truth(centred=centred))
        assert shot.path is not None
        data = json.loads((shot.path / f"camera_{FIRST:05d}.json").read_text())
        assert data["principal_point"] == expected


def test_soccernet_camera_looks_across_the_pitch(tmp_path: Path) -> None:
    """Golden by hand: at pan 0, tilt -10 the camera looks along -y and 10 degrees down, which is +z there."""
    known = truth()
    level = Truth(
        f_px=known.f_px, k1=np.zeros(N), pan_deg=np.zeros(N), tilt_deg=np.full(N, -10.0), roll_deg=np.zeros(N)
    )
    [shot, _] = write(tmp_path, "soccernet", level)
    assert shot.path is not None
    data = json.loads((shot.path / f"camera_{FIRST:05d}.json").read_text())
    assert (data["pan_degrees"], data["tilt_degrees"], data["roll_degrees"]) == (0.0, 80.0, 0.0)
    forward = (about(2, 0) @ about(0, 80) @ about(2, 0))[:, 2]
    np.testing.assert_allclose(forward, [0, -np.cos(np.radians(10)), np.sin(np.radians(10))], atol=1e-12)
