"""`pitch` and `flight` on a clip of the generator, whose camera stands 70 m behind the centre spot and 15 m up: clicks
are the generator's own pixels of pitch points, metres and landing points are compared with its ground.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines import cli, open_result
from pipelines.clicks import Clicks, clicks_of, read_clicks
from pipelines.errors import InputError
from pipelines.pitch import Pitch, fit_pitch, pitch_of
from pipelines.pitch_templates import TEMPLATES, football
from pipelines.render.opened import open_run
from pipelines.render.overlay import OverlayOptions, corner_rays
from tests.pipelines.end_to_end import SIZE, Finished, one_line
from tests.synth.camera import SynthCamera
from tests.synth.stadium import make_stadium

STADIUM = make_stadium()
POSITION = np.array([0.0, -STADIUM.camera_back, STADIUM.camera_height])
FRAMES = (2, 14, 25, 36, 47)


def camera(run: Finished, frame: int) -> SynthCamera:
    t = run.truth
    return SynthCamera(
        width=SIZE[0], height=SIZE[1], f_px=t["f_px"][frame], pan_rad=np.deg2rad(t["pan_deg"][frame]),
        tilt_rad=np.deg2rad(t["tilt_deg"][frame]), roll_rad=np.deg2rad(t["roll_deg"][frame]), cx_px=t["cx_px"][frame],
        cy_px=t["cy_px"][frame],
    )  # fmt: skip


def true_pixel(run: Finished, frame: int, point: tuple[float, ...]) -> np.ndarray:
    """Where the generator's camera sees a point of the pitch (X, Y) or above it (X, Y, Z)."""
    x, y, z = (*point, 0.0)[:3]
    world = np.array([x, STADIUM.camera_height - z, y + STADIUM.camera_back])
    return camera(run, frame).point_to_pixel(world)


def click_rows(run: Finished, noise_px: float = 0.0) -> list[dict[str, Any]]:
    """Every template point that is well inside the picture, in five frames."""
    rng, rows = np.random.default_rng(0), []
    for frame in FRAMES:
        for name, point in football().points.items():
            x, y = true_pixel(run, frame, point) + rng.normal(0, 1, 2) * noise_px
            if 8 < x < SIZE[0] - 8 and 8 < y < SIZE[1] - 8:
                rows.append({"frame": frame, "x_px": x, "y_px": y, "point": name})
    return rows


def write_rows(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.fixture(scope="module")
def clicks(pan_run: Finished, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rows(tmp_path_factory.mktemp("pitch") / "clicks.csv", click_rows(pan_run, 0.5))


@pytest.fixture(scope="module")
def found(pan_run: Finished, clicks: Path) -> Pitch:
    return pitch_of(pan_run.out, read_clicks(clicks, football()), click_std_px=0.5)


def test_the_camera_stands_where_the_generators_does(found: Pitch) -> None:
    std = np.sqrt(np.diag(found.camera.cov)[:3])
    assert (std < 1.5).all()
    assert (np.abs(found.camera.position_m - POSITION) < 4 * std + 0.05).all()
    assert 0.3 < found.camera.chi2_dof < 3


def test_pixels_become_the_generators_metres(pan_run: Finished, found: Pitch) -> None:
    """Points between the clicked ones, in frames that nobody clicked: within four of their own sigmas, and useful."""
    for frame, point in ((8, (3.0, 4.0)), (20, (-6.0, 12.0)), (42, (5.0, -3.0)), (30, (0.0, 20.0))):
        xy = true_pixel(pan_run, frame, point)
        if not ((xy > 0) & (xy < SIZE)).all():
            continue
        metres, cov = found.to_metres(frame, xy)
        std = np.sqrt(np.diagonal(cov[0]))
        assert (np.abs(metres[0] - point) < 4 * std).all() and std.max() < 1.0, (frame, metres, std)
        np.testing.assert_allclose(found.to_pixels(frame, metres)[0], xy, atol=1e-6)
        back = found.to_pixels(frame, [[*point, 2.0]])[0]  # two metres above it
        np.testing.assert_allclose(back, true_pixel(pan_run, frame, (*point, 2.0)), atol=1.5)
    above = found.to_metres(25, [[320.0, -200.0]])[0]
    assert np.isnan(above).all()


def test_the_command_says_the_same(
    pan_run: Finished, clicks: Path, found: Pitch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(pan_run.out)
    words = ["pitch", out, "--clicks", str(clicks), "--template", "football", "--click-px", "0.5"]
    assert cli.main([*words, "--frame", "25", "--pixel", "320,250", "--pixel", "100,300", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    metres, cov = found.to_metres(25, [[320.0, 250.0], [100.0, 300.0]])
    for row, m, c in zip(told["points"], metres, cov, strict=True):
        np.testing.assert_allclose([row["X_m"], row["Y_m"]], m, atol=1e-9)
        np.testing.assert_allclose(
            [row["std_X_m"] ** 2, row["cov_XY_m2"], row["std_Y_m"] ** 2], c[[0, 0, 1], [0, 1, 1]]
        )
    np.testing.assert_allclose(told["camera"]["position_m"], found.camera.position_m)
    wanted = write_rows(
        tmp_path / "wanted.csv",
        [{"frame": 25, "x_px": 320, "y_px": 250}, {"frame": 25, "x_px": 9, "y_px": -200}],
    )
    assert cli.main([*words, "--points", str(wanted)]) == 0
    shown = capsys.readouterr()
    rows = list(csv.DictReader(io.StringIO(shown.out)))
    assert float(rows[0]["X_m"]) == pytest.approx(metres[0, 0]) and rows[1]["X_m"] == ""
    assert "1 of 2 pixels are not on the pitch" in one_line(shown.err)
    assert cli.main([*words, "--frame", "25", "--pixel", "9,-200"]) == 1


def test_a_flight_comes_down_where_the_ball_does(
    pan_run: Finished, clicks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ball in the air over the middle of the clip, in the generator's pixels with a third of a pixel of noise."""
    rng = np.random.default_rng(8)
    start, velocity = np.array([-9.0, 3.0, 0.11]), np.array([11.0, 2.0, 8.0])
    rows = []
    for frame in range(6, 44):
        t = (frame - 6) / 25
        x, y = true_pixel(
            pan_run, frame, tuple(start + velocity * t - [0, 0, 9.81 / 2 * t * t])
        ) + rng.normal(0, 0.3, 2)
        if 0 < x < SIZE[0] and 0 < y < SIZE[1]:
            rows.append({"frame": frame, "x_px": x, "y_px": y})
    assert len(rows) > 15
    ball = write_rows(tmp_path / "ball.csv", rows)
    words = [
        "flight",
        str(pan_run.out),
        "--clicks",
        str(clicks),
        "--template",
        "football",
        "--click-px",
        "0.5",
    ]
    assert cli.main([*words, "--ball", str(ball), "--ball-px", "0.3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    lands = start[:2] + velocity[:2] * 2 * velocity[2] / 9.81
    landing = told["landing"]
    std = np.array([landing["std_X_m"], landing["std_Y_m"]])
    assert (np.abs([landing["X_m"], landing["Y_m"]] - lands) < 4 * std).all() and std.max() < 3
    assert told["speed_m_s"] == pytest.approx(np.linalg.norm(velocity), rel=0.15)
    assert len(told["points"]) == len(rows) and told["chi2_dof"] < 4
    assert cli.main([*words, "--ball", str(ball)]) == 0
    shown = capsys.readouterr()
    assert "comes down at" in one_line(shown.err)
    assert len(list(csv.DictReader(io.StringIO(shown.out)))) == len(rows)


def test_an_overlay_lies_where_the_metres_say(pan_run: Finished, found: Pitch) -> None:
    """A board of 4 x 4 m on the pitch: its corners, by the run's own cameras, are the generator's pixels to a pixel."""
    board = [(-2.0, 6.0), (2.0, 6.0), (2.0, 2.0), (-2.0, 2.0)]
    opened = open_run(pan_run.out)
    views = opened.shot_views(0)
    options = OverlayOptions(picture=Path("board.png"), corners=board, space="pitch", pitch=found)
    rays = corner_rays(opened, 0, views, options)
    for frame in (10, 25, 40):
        wanted = np.array([true_pixel(pan_run, frame, point) for point in board])
        np.testing.assert_allclose(views[frame].ray_to_pixel(rays), wanted, atol=1.5)


def test_mistakes_are_said_in_one_line(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = click_rows(pan_run)
    files = {
        "few": good[:3],
        "misnamed": [{**good[0], "point": "centre sport"}, *good[1:]],
        "wrong": [{**good[0], "x_px": good[0]["x_px"] + 60}, *good[1:]],
        "far": [{**good[0], "frame": 5000}, *good[1:]],
        "columns": [{"frame": 1, "x": 2}],
        "text": [{**good[0], "x_px": "left"}, *good[1:]],
    }
    paths = {name: write_rows(tmp_path / f"{name}.csv", rows) for name, rows in files.items()}
    paths["none"] = tmp_path / "none.csv"
    for name, said in (
        ("few", "3 points, 4 are needed"), ("misnamed", "did you mean 'centre spot'"),
        ("wrong", "the clicks contradict each other: point 1, in frame 2"), ("far", "frame 5000 is not in the table"),
        ("columns", "lacks columns"), ("text", "no number"), ("none", "no such file"),
    ):  # fmt: skip
        words = ["pitch", str(pan_run.out), "--clicks", str(paths[name]), "--template", "football"]
        assert cli.main([*words, "--frame", "3", "--pixel", "1,2"]) == 2, name
        assert said in one_line(capsys.readouterr().err), name
    clicks = str(write_rows(tmp_path / "good.csv", good))
    for words, said in (
        (["pitch", str(pan_run.out), "--frame", "3", "--pixel", "1,2"], "--clicks FILE"),
        (
            ["pitch", str(pan_run.out), "--clicks", clicks, "--frame", "3", "--pixel", "1,2"],
            "no template was chosen",
        ),
        (["pitch", str(pan_run.out), "--clicks", clicks], "--points FILE, or --frame N"),
        (["pitch", "--list-points", "cricket"], "no template is called 'cricket'"),
        (["flight", str(pan_run.out), "--clicks", clicks], "give --ball FILE"),
    ):
        assert cli.main(words) == 2
        assert said in one_line(capsys.readouterr().err)


def test_clicks_of_frames_without_a_camera_are_refused(pan_run: Finished) -> None:
    opened = open_run(pan_run.out)
    bare = dataclasses.replace(opened.table, f_px=np.full(len(opened.table), np.nan))
    four = Clicks(frame=np.full(4, 3), xy_px=np.ones((4, 2)), XY_m=np.ones((4, 2)))
    with pytest.raises(InputError, match="frame 3 has no calibrated camera"):
        fit_pitch(opened.record, bare, four)


@pytest.mark.parametrize("name", TEMPLATES)
def test_templates_lie_within_their_field_and_are_symmetric(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field = TEMPLATES[name]()
    points = set(field.points.values())
    for x, y in points:
        assert abs(x) <= field.length_m / 2 + 1e-9 and abs(y) <= field.width_m / 2 + 1e-9
        assert any(np.allclose((-x, -y), other) for other in points)
    for x0, y0, x1, y1 in field.lines:
        assert (x0 == x1) != (y0 == y1)  # along the field or across it
    assert cli.main(["pitch", "--list-points", name]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(field.points)


def test_templates_have_the_sizes_of_the_rules() -> None:
    points = football().points
    assert points["right far corner"] == (52.5, 34.0)
    assert points["left near penalty area corner"] == pytest.approx((-36.0, -20.16))
    # The penalty arc: 9.15 m from the spot.
    arc = np.subtract(points["right far arc at penalty area"], points["right penalty spot"])
    assert np.hypot(*arc) == pytest.approx(9.15)
    nfl = TEMPLATES["american-football"]()
    assert nfl.length_m == pytest.approx(109.728) and nfl.width_m == pytest.approx(48.768)
    assert nfl.points["50 far hash"][1] - nfl.points["50 near hash"][1] == pytest.approx(18.5 * 0.3048)
    court = TEMPLATES["basketball"]().points
    bend = np.subtract(court["right far three-point line bend"], (14 - 1.575, 0))
    assert np.hypot(*bend) == pytest.approx(6.75)


def test_clicks_may_be_rows_of_python(pan_run: Finished, clicks: Path, found: Pitch) -> None:
    named = [(r["frame"], r["x_px"], r["y_px"], r["point"]) for r in click_rows(pan_run, 0.5)]
    metric = [(*row[:3], *football().points[row[3]]) for row in named]
    result = open_result(pan_run.out)
    for given, template in ((named, "football"), (metric, None), (str(clicks), football())):
        other = result.pitch(given, template=template, click_std_px=0.5)  # type: ignore[arg-type]
        np.testing.assert_allclose(other.camera.position_m, found.camera.position_m, atol=1e-6)
    for rows, template, said in (
        ([(1, 2.0, 3.0)], None, "a row has 3 values"),
        ([(1, 2.0, "here", 3.0, 4.0)], None, "no number"),
        ([(1, 2.0, 3.0, "corner flag")], "football", "no point is called 'corner flag'"),
        ([(1, 2.0, 3.0, "centre spot")], None, "no template was chosen"),
        ([], None, "has no rows"),
    ):
        with pytest.raises(InputError, match=said):
            clicks_of(rows, None if template is None else football())
    with pytest.raises(ValueError, match="football, basketball, american-football"):
        result.pitch(named, template="curling")
