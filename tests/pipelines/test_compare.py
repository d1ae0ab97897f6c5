"""Compare knows the size of errors that are put in, and is blind to the gauge alone."""

from __future__ import annotations

import csv
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.rotation import from_pan_tilt_roll, to_pan_tilt_roll
from pipelines.archive import write_camera_csv, write_run
from pipelines.compare import COLUMNS, TRUTH_COLUMNS, compare_run, comparison_table
from pipelines.errors import InputError
from tests.pipelines.tables import camera_table, run_record, shot_record

W, H, N, REF = 1920, 1080, 21, 10


def camera(n: int = N, k1_half: float = 0.03) -> dict[str, NDArray[Any]]:
    """A pan of 20 degrees with zoom and a lens that is not straight."""
    s = np.linspace(0, 1, n)
    f = 2400 * 1.5**s
    return {
        "frame": np.arange(n),
        "f_px": f,
        "pan_deg": -10 + 20 * s,
        "tilt_deg": -8 + 2 * np.sin(3 * s),
        "roll_deg": np.full(n, 0.4),
        "cx_px": np.full(n, 955.0),
        "cy_px": np.full(n, 545.0),
        "aspect": np.ones(n),
        "k1": k1_half * (2 * f / W) ** 2,
        "shot": np.zeros(n, int),
    }


def rotations(c: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    return from_pan_tilt_roll(*(np.radians(c[name]) for name in ("pan_deg", "tilt_deg", "roll_deg")))


def homographies(c: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    K = np.tile(np.eye(3), (len(c["f_px"]), 1, 1))
    K[:, 0, 0], K[:, 1, 1] = c["f_px"], c["f_px"] / c["aspect"]
    K[:, 0, 2], K[:, 1, 2] = c["cx_px"], c["cy_px"]
    R = rotations(c)
    out = K[REF] @ R[REF] @ np.swapaxes(R, 1, 2) @ np.linalg.inv(K)
    return out / np.cbrt(np.linalg.det(out))[:, None, None]


def write(
    folder: Path, estimate: dict[str, NDArray[Any]], truth: dict[str, NDArray[Any]], **columns: Any
) -> Path:
    """A run with that camera in `folder`, and truth.csv beside it."""
    n = len(estimate["frame"])
    names = {f.name for f in fields(type(camera_table(0)))}
    values: dict[str, Any] = {k: v for k, v in estimate.items() if k in names}
    values["homography"] = homographies(estimate)
    values["zoom_ratio"] = estimate["f_px"] / estimate["f_px"][REF]
    values["f_std_px"] = 0.01 * estimate["f_px"]
    values["status"] = ("ok",) * n
    values |= columns
    write_camera_csv(folder / "camera.csv", camera_table(n, **values))
    shots = (shot_record(0, first_frame=0, last_frame=n - 1, reference_frame=REF),)
    write_run(folder / "run.json", run_record(shots, clip={"size_px": [W, H]}))
    with (folder / "truth.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(TRUTH_COLUMNS)
        rows.writerows(zip(*(truth[name].tolist() for name in TRUTH_COLUMNS), strict=True))
    return folder / "truth.csv"


def compared(folder: Path, **kinds: Any) -> dict[str, Any]:
    estimate, truth = kinds.pop("estimate", camera()), kinds.pop("truth", camera())
    result = compare_run(folder, write(folder, estimate, truth, **kinds))
    json.dumps(result, allow_nan=False)
    return result["shots"][0]


def test_the_truth_itself_has_no_error(tmp_path: Path) -> None:
    shot = compared(tmp_path)
    assert shot["compared"] == N and shot["inside_1_sigma"] == 1.0
    for key in ("focal_p95", "zoom_max", "corner_px", "corner_in_reference_px", "transfer_px", "pan_rms_deg"):
        assert shot[key] < 1e-6, key
    assert shot["focal_std_claimed"] == pytest.approx(0.01)


def test_another_world_orientation_is_no_error(tmp_path: Path) -> None:
    estimate = camera()
    turned = rotations(estimate) @ from_pan_tilt_roll(0.7, 0.2, -0.3).T
    for name, values in zip(("pan_deg", "tilt_deg", "roll_deg"), to_pan_tilt_roll(turned), strict=True):
        estimate[name] = np.degrees(values)
    shot = compared(tmp_path, estimate=estimate)
    assert max(shot[k] for k in ("pan_rms_deg", "tilt_rms_deg", "roll_rms_deg")) < 1e-6
    assert shot["corner_px"] < 1e-6


def test_a_focal_error_shows_in_focal_and_coverage_not_in_zoom(tmp_path: Path) -> None:
    estimate = camera()
    estimate["f_px"] = estimate["f_px"] * 1.015
    shot = compared(tmp_path, estimate=estimate, f_std_px=0.01 * camera()["f_px"])
    assert shot["focal_median"] == pytest.approx(0.015) and shot["focal_bias"] == pytest.approx(0.015)
    assert shot["inside_1_sigma"] == 0.0 and shot["inside_2_sigma"] == 1.0
    assert shot["zoom_max"] < 1e-9


def test_no_error_bar_is_inside_nothing(tmp_path: Path) -> None:
    shot = compared(tmp_path, f_std_px=np.full(N, np.nan))
    assert shot["inside_2_sigma"] == 0.0 and shot["focal_std_claimed"] is None


def test_homography_errors_have_the_size_put_in(tmp_path: Path) -> None:
    # Half the frames are shifted by 3 px to the right before they go to the reference frame: rms 3 / sqrt(2).
    shift = np.eye(3)
    shift[0, 2] = 3.0
    H_frames = homographies(camera())
    H_frames[::2] = H_frames[::2] @ shift
    shot = compared(tmp_path, homography=H_frames)
    share = len(range(0, N, 2)) / N
    assert shot["corner_px"] == pytest.approx(3 * np.sqrt(share), rel=1e-6)
    assert shot["transfer_px"] == pytest.approx(
        3 * np.sqrt(share), rel=0.15
    )  # the lens stretches it a little
    assert shot["corner_in_reference_px"] > 0
    assert shot["focal_p95"] < 1e-9


def test_a_wrong_lens_shows_in_raw_pixels_only(tmp_path: Path) -> None:
    estimate = camera()
    estimate["k1"] = np.zeros(N)
    shot = compared(tmp_path, estimate=estimate)
    assert shot["corner_px"] < 1e-6
    assert shot["transfer_px"] > 1.0


def test_relative_shots_are_judged_by_zoom_and_homography(tmp_path: Path) -> None:
    empty = np.full(N, np.nan)
    names = ("f_px", "f_std_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "k1")
    shot = compared(tmp_path, **dict.fromkeys(names, empty))
    assert shot["with_focal"] == 0 and shot["focal_median"] is None and shot["pan_rms_deg"] is None
    assert shot["zoom_max"] < 1e-9 and shot["corner_px"] < 1e-6 and shot["transfer_px"] is None


def test_frames_of_another_shot_or_beyond_the_truth_are_left_out(tmp_path: Path) -> None:
    truth = {name: values[:-3] for name, values in camera().items()}
    truth["shot"] = np.where(np.arange(N - 3) < 4, 7, 0)
    shot = compared(tmp_path, truth=truth)
    assert shot["wrong_shot"] == 4 and shot["compared"] == N - 7


def test_table_names_every_quantity(tmp_path: Path) -> None:
    text = comparison_table(compare_run(tmp_path, write(tmp_path, camera(), camera())))
    assert "shot 0" in text and "21/21" in text
    for key, heading, _, meaning in COLUMNS:
        [line] = [line for line in text.splitlines() if line.startswith(f"{heading}  ")]
        assert line.endswith(meaning) and not line.removesuffix(meaning).rstrip().endswith("-"), key


def test_foreign_truth_is_refused_with_the_columns_it_needs(tmp_path: Path) -> None:
    truth = write(tmp_path, camera(), camera())
    (tmp_path / "bad.csv").write_text("frame,focal\n0,1\n")
    with pytest.raises(InputError, match="f_px"):
        compare_run(tmp_path, tmp_path / "bad.csv")
    text = truth.read_text().splitlines()
    (tmp_path / "other.csv").write_text("\n".join([text[0], *(f"9{line}" for line in text[1:])]) + "\n")
    with pytest.raises(InputError, match="no frame in common"):
        compare_run(tmp_path, tmp_path / "other.csv")
    with pytest.raises(InputError, match="no such file"):
        compare_run(tmp_path, tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"run\.json"):
        compare_run(tmp_path / "nowhere", truth)
