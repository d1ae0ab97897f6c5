"""Pixels to rays and back against the generator's cameras, and the command."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from pipelines import cli
from pipelines.archive import read_camera_csv
from pipelines.rays import (
    axis_angle_std_deg,
    pan_tilt_to_pixel,
    pixel_to_pan_tilt,
    pixel_to_ray,
    ray_to_pan_tilt,
    ray_to_pixel,
    rows_of,
)
from tests.pipelines.end_to_end import SIZE, Finished, one_line
from tests.pipelines.export_truth import FIRST, LOST, N, truth
from tests.pipelines.tables import camera_table, table_of_cameras
from tests.pipelines.test_export_command import finished
from tests.synth.camera import SynthCamera, pixel_grid

KNOWN = [i for i in range(N) if i != LOST]


def generator_cameras(n: int = 12) -> list[SynthCamera]:
    """Cameras all over the generator's range: lens, principal point, attitude and zoom."""
    rng = np.random.default_rng(7)
    return [
        SynthCamera(
            width=1280,
            height=720,
            f_px=float(np.exp(rng.uniform(np.log(900), np.log(9000)))),
            pan_rad=float(rng.uniform(-2.5, 2.5)),
            tilt_rad=float(rng.uniform(-0.8, 0.5)),
            roll_rad=float(rng.uniform(-0.1, 0.1)),
            cx_px=float(rng.uniform(600, 680)),
            cy_px=float(rng.uniform(330, 390)),
            k1_half=float(rng.uniform(-0.1, 0.1)),
        )
        for _ in range(n)
    ]


def test_rays_are_the_generators() -> None:
    """Frames broadcast against a grid of pixels; the frames are not in order."""
    cameras = generator_cameras()
    table = table_of_cameras(cameras, frame=np.arange(len(cameras))[::-1] + 5)
    grid = pixel_grid(1280, 720, 79)
    rays = pixel_to_ray(table, table.frame[:, None, None], grid)
    true = np.stack([c.pixel_to_ray(grid) for c in cameras])
    np.testing.assert_allclose(rays, true, atol=1e-12)
    np.testing.assert_allclose(
        ray_to_pixel(table, table.frame[:, None, None], true),
        np.broadcast_to(grid, true[..., :2].shape),
        atol=1e-8,
    )
    angles = pixel_to_pan_tilt(table, table.frame[:, None, None], grid)
    again = pan_tilt_to_pixel(table, table.frame[:, None, None], angles)
    np.testing.assert_allclose(again, np.broadcast_to(grid, again.shape), atol=1e-8)
    # The optical axis looks where the camera is said to look.
    centre = np.stack([table.cx_px, table.cy_px], axis=-1)
    axis = pixel_to_pan_tilt(table, table.frame, centre)
    np.testing.assert_allclose(axis, np.stack([table.pan_deg, table.tilt_deg], axis=-1), atol=1e-9)


def test_pixels_that_are_not_square() -> None:
    known = truth(aspect=45 / 64)
    table = known.table()
    for i in KNOWN:
        rays = known.rays(i)
        np.testing.assert_allclose(ray_to_pixel(table, FIRST + i, rays), known.project(i, rays), atol=1e-9)
        np.testing.assert_allclose(pixel_to_ray(table, FIRST + i, known.project(i, rays)), rays, atol=1e-12)


def test_what_is_not_known_is_nan() -> None:
    known = truth()
    table = known.table()
    assert np.isnan(pixel_to_ray(table, [FIRST + LOST, FIRST + N + 3], [[5.0, 5.0]] * 2)).all()
    behind = -known.rays(0, 3)
    assert np.isnan(ray_to_pixel(table, FIRST, behind)).all()
    # A barrel folds over: no ideal radius has such an observed one.
    values = {"f_px": 500.0, "aspect": 1.0, "k1": -0.3, "cx_px": 0.0, "cy_px": 0.0}
    straight = dict.fromkeys(("pan_deg", "tilt_deg", "roll_deg"), 0.0)
    fold = camera_table(1, **{name: np.array([value]) for name, value in {**values, **straight}.items()})
    assert np.isnan(pixel_to_ray(fold, 0, [900.0, 0.0])).all()
    assert np.isnan(ray_to_pixel(fold, 0, [2.0, 0.0, 1.0])).all()


def test_mistakes_show_the_value() -> None:
    table = truth().table()
    for frame, xy, said in (
        (3, [1.0, 2.0], "frame 3 is not in the table"),
        ([FIRST, 99], [[1.0, 2.0]] * 2, "frame 99 is not"),
        (FIRST, [1.0, 2.0, 3.0], r"shape \(3,\)"),
        ([FIRST, FIRST + 1], [[1.0, 2.0]] * 3, "do not broadcast"),
        (FIRST + 0.5, [1.0, 2.0], "whole numbers"),
    ):
        with pytest.raises(ValueError, match=said):
            pixel_to_ray(table, frame, xy)
    with pytest.raises(ValueError, match="frame 0 is not"):
        rows_of(camera_table(0), 0)


def test_the_angles_error_is_that_of_the_focal_length() -> None:
    """Against the finite difference: the same pixel with f one sigma longer."""
    known = truth(distortion=False)
    table = known.table()
    at = np.array([[0.0, 0.0], [1900.0, 500.0], [known.cx_px, known.cy_px]])
    std = axis_angle_std_deg(table, FIRST, at)
    angle = [
        np.degrees(
            np.arctan(np.hypot(*(at - [known.cx_px, known.cy_px]).T) / (known.f_px[0] * (1 + sign * 1e-4)))
        )
        for sign in (-1, 1)
    ]
    np.testing.assert_allclose(std, (angle[0] - angle[1]) / 2e-4 * 0.02, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_angles_across_a_run_are_true_within_their_error(pan_run: Finished) -> None:
    """Free of the gauge: the angle between what two frames see at given pixels, against the generator's cameras.

    Its error is that of the focal length: 3 stated sigma of the angle, and 0.3 px of the alignment.
    """
    table, track = read_camera_csv(pan_run.out / "camera.csv"), pan_run.truth
    known = np.flatnonzero(np.isfinite(table.f_px))
    a, b = int(known[0]), int(known[-1])
    middle = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
    seen = [pixel_to_ray(table, int(table.frame[i]), middle) for i in (a, b)]
    true = [
        SynthCamera(
            width=SIZE[0], height=SIZE[1], f_px=track["f_px"][i], pan_rad=np.deg2rad(track["pan_deg"][i]),
            tilt_rad=np.deg2rad(track["tilt_deg"][i]), roll_rad=np.deg2rad(track["roll_deg"][i]),
            cx_px=track["cx_px"][i], cy_px=track["cy_px"][i],
        ).pixel_to_ray(middle)
        for i in (a, b)
    ]  # fmt: skip
    angle, wanted = (np.degrees(np.arccos(np.clip(u @ v, -1, 1))) for u, v in (seen, true))
    assert wanted > 10
    relative = float(np.nanmax(table.f_std_px[known] / table.f_px[known]))
    alignment = np.degrees(0.3 / table.f_px[a])
    assert abs(angle - wanted) < 3 * relative * wanted + alignment


# ---- the command


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_command_answers_pixels_and_directions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = truth()
    out = str(finished(tmp_path / "out", known))
    ray = known.rays(0, 1)
    [[x, y]] = known.project(0, ray).tolist()
    assert cli.main(["rays", out, "--frame", str(FIRST), "--pixel", f"{x!r},{y!r}", "--pixel", "0,0"]) == 0
    first, second = rows(capsys.readouterr().out)
    np.testing.assert_allclose([float(first[f"ray_{c}"]) for c in "xyz"], ray[0], atol=1e-12)
    assert float(second["axis_angle_std_deg"]) > 0
    [[pan, tilt]] = ray_to_pan_tilt(ray)
    assert cli.main(["rays", out, "--frame", str(FIRST), "--pan-tilt", f"{pan},{tilt}", "--json"]) == 0
    [point] = json.loads(capsys.readouterr().out)["points"]
    np.testing.assert_allclose([point["x_px"], point["y_px"]], [x, y], atol=1e-8)


def test_command_takes_points_from_a_file_and_leaves_unknown_ones_empty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = truth()
    out = str(finished(tmp_path / "out", known))
    given = tmp_path / "points.csv"
    given.write_text(f"x_px,y_px,frame,player\n10,20,{FIRST + LOST},7\n30,40,{FIRST},8\n")
    answer = tmp_path / "rays.csv"
    assert cli.main(["rays", out, "--points", str(given), "-o", str(answer)]) == 0
    shown = capsys.readouterr()
    assert "1 of 2 points have no answer; first: frame 43 is lost: too little" in one_line(shown.err)
    lost, good = rows(answer.read_text())
    assert lost["ray_x"] == "" and lost["x_px"] == "10.0"
    expected = pixel_to_ray(known.table(), FIRST, [30.0, 40.0])
    assert [float(good[f"ray_{c}"]) for c in "xyz"] == expected.tolist()


def test_command_says_why_there_is_no_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(finished(tmp_path / "out"))
    relative = str(FIRST + N + 2)
    assert cli.main(["rays", out, "--frame", relative, "--pixel", "1,2"]) == 1
    assert "is relative: the camera zooms" in one_line(capsys.readouterr().err)
    assert cli.main(["rays", out, "--frame", str(FIRST), "--pan-tilt", "-9,0"]) == 1
    assert "does not see that direction" in one_line(capsys.readouterr().err)


def test_command_says_when_a_point_is_in_no_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The numbers are given, for a lens goes on beyond its picture; that nobody saw the point is said."""
    known = truth()
    out = str(finished(tmp_path / "out", known))
    w, h = known.run().clip["size_px"]
    asked = ["rays", out, "--frame", str(FIRST)]
    assert cli.main([*asked, "--pixel", f"{w - 1},{h - 1}", "--pixel", "0,0"]) == 0
    assert capsys.readouterr().err == ""
    assert cli.main([*asked, "--pixel", f"{w},5", "--pixel", "3,3"]) == 0
    assert f"1 of 2 points lies outside the {w} x {h} picture" in one_line(capsys.readouterr().err)
    pan, tilt = ray_to_pan_tilt(known.rays(0, 1))[0]
    assert cli.main([*asked, "--pan-tilt", f"{pan + 40},{tilt}"]) == 0
    assert "the point lies outside" in one_line(capsys.readouterr().err)


def test_commands_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(finished(tmp_path / "out"))
    (tmp_path / "bad.csv").write_text("frame,x\n1,2\n")
    (tmp_path / "word.csv").write_text("frame,x_px,y_px\n1,two,3\n")
    for said, args in {
        "give --points FILE, or --frame": ["rays", out],
        "needs --pixel": ["rays", out, "--frame", "40"],
        "two numbers with a comma": ["rays", out, "--frame", "40", "--pixel", "5"],
        "not 'nan,1'": ["rays", out, "--frame", "40", "--pixel", "nan,1"],
        "--frame": ["rays", out, "--frame", "9" * 25, "--pixel", "5,5"],
        "the run has frames 40 to 52": ["rays", out, "--frame", "7", "--pixel", "5,5"],
        "lacks columns": ["rays", out, "--points", str(tmp_path / "bad.csv")],
        "no number": ["rays", out, "--points", str(tmp_path / "word.csv")],
        "no such file": ["rays", out, "--points", str(tmp_path / "none.csv")],
        "finished run": ["rays", str(tmp_path / "nowhere"), "--frame", "1", "--pixel", "1,1"],
    }.items():
        assert cli.main(args) == 2, said
        assert said in one_line(capsys.readouterr().err)
