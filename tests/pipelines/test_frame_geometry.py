"""Pixels and directions of frames whose rows are read one after the other, against the generator's camera at each row's
own moment; and of a pupil before the pan axis, where rays and render must say the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from calib.parallax import Parallax
from calib.rotation import exp, turned
from pipelines.archive import write_camera_csv, write_run
from pipelines.frame_geometry import FrameGeometry, frame_geometry
from pipelines.pitch import track_of
from pipelines.rays import pixel_to_ray, ray_to_pixel
from pipelines.records import CameraTable, RunRecord
from pipelines.render.opened import open_run
from pipelines.render.overlay import OverlayOptions, overlay
from pipelines.render.views import frame_view
from tests.pipelines.end_to_end import SIZE, pan_spec
from tests.pipelines.tables import camera_table, run_record, shot_record, table_of_cameras
from tests.pipelines.test_render import decoded, disc_slips
from tests.synth.clip import write_clip
from tests.synth.paths import BROADCAST_LENS, CameraPath

SHARE = 0.6
SPEC = pan_spec(pan_deg=40.0, lens=BROADCAST_LENS)
PATH = CameraPath(
    spec=SPEC.path, lens=SPEC.lens, width=SIZE[0], height=SIZE[1], n_frames=SPEC.n_frames, seed=SPEC.seed
)
FAST = range(18, 33)  # the frames in which the pan runs at its full speed


def row_time(frame: int, y_px: float) -> float:
    """When a row is read, in frames."""
    return frame + SHARE * ((y_px + 0.5) / SIZE[1] - 0.5)


def true_pixel(frame: int, ray: np.ndarray, path: CameraPath = PATH) -> np.ndarray:
    """Where the generator sees a direction: the row must see it at its own moment. By bisection over the rows."""
    low, high = -100.0, SIZE[1] + 100.0

    def below(y: float) -> float:
        return float(path.camera(row_time(frame, y)).ray_to_pixel(ray)[1]) - y

    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if below(middle) > 0 else (low, middle)
    return np.asarray(path.camera(row_time(frame, low)).ray_to_pixel(ray))


def with_times(table: CameraTable) -> CameraTable:
    """The table with statuses, and times of 25 pictures a second."""
    return dataclasses.replace(table, status=("ok",) * len(table), pts_s=np.arange(len(table)) / 25.0)


def record(found: bool = True, pupil: dict[str, object] | None = None) -> RunRecord:
    facts = {"rolling_shutter": {"found": found, "share_of_frame": SHARE}, "pupil": pupil}
    return run_record((shot_record(calibration=facts, last_frame=SPEC.n_frames - 1),))


@pytest.fixture(scope="module")
def table() -> CameraTable:
    return table_of_cameras(PATH.cameras())


@pytest.fixture(scope="module")
def geometry(table: CameraTable) -> FrameGeometry:
    return frame_geometry(record(), table)


GRID = np.stack(np.meshgrid(np.linspace(5, 634, 6), np.linspace(2, 357, 7)), axis=-1).reshape(-1, 2)


def test_rows_look_where_they_looked_at_their_own_moment(table: CameraTable, geometry: FrameGeometry) -> None:
    """Slip of rows against the truth. What is left is the speed's own change within the read-out and between frames."""
    before, after = [], []
    for frame in FAST:
        true = np.array([PATH.camera(row_time(frame, y)).pixel_to_ray([x, y]) for x, y in GRID])
        for known, slips in ((None, before), (geometry, after)):
            seen = pixel_to_ray(table, frame, GRID, known)
            slips.append(np.linalg.norm(np.cross(seen, true), axis=-1) * table.f_px[frame])
    assert np.max(before) > 2.0
    assert np.max(after) < 0.1
    view = frame_view(table, 25, SIZE, geometry)
    assert view is not None
    rays = view.pixel_to_ray(GRID)
    np.testing.assert_allclose(
        rays / np.linalg.norm(rays, axis=-1, keepdims=True),
        pixel_to_ray(table, 25, GRID, geometry),
        atol=1e-12,
    )


def test_a_direction_is_seen_by_the_row_that_looked_there(
    table: CameraTable, geometry: FrameGeometry
) -> None:
    before, after = [], []
    for frame in (20, 25, 30):
        rays = PATH.camera(frame).pixel_to_ray(GRID)
        true = np.array([true_pixel(frame, ray) for ray in rays])
        for known, slips in ((None, before), (geometry, after)):
            slips.append(np.linalg.norm(ray_to_pixel(table, frame, rays, known) - true, axis=-1))
        view = frame_view(table, frame, SIZE, geometry)
        assert view is not None
        np.testing.assert_allclose(
            view.ray_to_pixel(rays), ray_to_pixel(table, frame, rays, geometry), atol=1e-6
        )
        # A part of the picture, made smaller, is the same camera.
        part = view.cropped(slice(100, 300), slice(40, 600)).reduced(2)
        np.testing.assert_allclose(
            part.ray_to_pixel(rays), (view.ray_to_pixel(rays) - [40.5, 100.5]) / 2, atol=1e-6
        )
        np.testing.assert_array_equal(
            view.still().ray_to_pixel(rays), frame_view(table, frame, SIZE).ray_to_pixel(rays)
        )  # type: ignore[union-attr]
    print(f"slip at most {np.max(before):.2f} px without, {np.max(after):.4f} px with the rows' own cameras")
    assert np.max(before) > 2.0 and np.max(after) < 0.1


def test_there_and_back_is_the_identity(table: CameraTable) -> None:
    """With a pupil before the axis too, for frames in any order."""
    level = {"accepted": True, "over_height": 0.05, "over_stand": 0.01, "R_head_world": np.eye(3).tolist()}
    both = frame_geometry(record(pupil=level), table)
    assert isinstance(both.parallax[0], Parallax) and both.rolling
    frames = np.array([30, 2, 25])[:, None]
    rays = pixel_to_ray(table, frames, GRID, both)
    np.testing.assert_allclose(
        ray_to_pixel(table, frames, rays, both), np.broadcast_to(GRID, (3, *GRID.shape)), atol=1e-5
    )
    for i, frame in enumerate(frames[:, 0]):
        view = frame_view(table, int(frame), SIZE, both)
        assert view is not None
        np.testing.assert_allclose(view.ray_to_pixel(rays[i]), GRID, atol=1e-5)
        there = view.pixel_to_ray(GRID)
        np.testing.assert_allclose(there / np.linalg.norm(there, axis=-1, keepdims=True), rays[i], atol=1e-9)


def test_pixels_on_the_pitch_take_their_rows_camera(table: CameraTable, geometry: FrameGeometry) -> None:
    frames = np.full(len(GRID), 25)
    track = track_of(table, frames, 25, geometry, GRID[:, 1])
    np.testing.assert_allclose(track.rays(GRID), pixel_to_ray(table, 25, GRID, geometry), atol=1e-12)
    still = track_of(table, frames, 25)
    np.testing.assert_allclose(still.rays(GRID), pixel_to_ray(table, 25, GRID), atol=1e-12)


def test_what_was_not_found_changes_nothing(table: CameraTable) -> None:
    none = frame_geometry(record(found=False), table)
    assert not none.rolling and not none.parallax
    np.testing.assert_array_equal(pixel_to_ray(table, 25, GRID, none), pixel_to_ray(table, 25, GRID))
    rays = pixel_to_ray(table, 25, GRID)
    np.testing.assert_array_equal(ray_to_pixel(table, 25, rays, none), ray_to_pixel(table, 25, rays))
    view = frame_view(table, 25, SIZE, none)
    assert view is not None and view.motion is None


def test_a_frame_without_neighbours_is_taken_to_stand_still() -> None:
    cameras = PATH.cameras()
    table = table_of_cameras(cameras)
    f = np.array(table.f_px)
    f[[24, 26]] = np.nan
    lone = camera_table(
        len(f), f_px=f, **{n: getattr(table, n) for n in ("aspect", "cx_px", "cy_px", "k1")},
        **{n: getattr(table, n) for n in ("pan_deg", "tilt_deg", "roll_deg")},
    )  # fmt: skip
    known = frame_geometry(record(), lone)
    np.testing.assert_array_equal(known.rates[25], 0)
    assert np.any(known.rates[23]) and not np.any(known.rates[24])
    np.testing.assert_allclose(pixel_to_ray(lone, 25, GRID, known), pixel_to_ray(table, 25, GRID), atol=1e-12)
    assert np.isnan(pixel_to_ray(lone, 24, GRID, known)).all()


@pytest.mark.slow
def test_an_overlay_sticks_to_a_clip_of_a_rolling_shutter(tmp_path: Path) -> None:
    """Discs in the new video against where their rows see them: with the read-out time in run.json, and without.

    The cameras are the generator's, so that nothing but the rows is looked at.
    """
    spec = dataclasses.replace(
        pan_spec(pan_deg=10.0, n_frames=16, scoreboard=False, logo=False), readout=SHARE
    )
    clip = tmp_path / "rolling.mp4"
    write_clip(clip, spec)
    path = CameraPath(
        spec=spec.path, lens=spec.lens, width=SIZE[0], height=SIZE[1], n_frames=16, seed=spec.seed
    )
    board = np.zeros((360, 640, 4), np.uint8)
    spots = np.stack(np.meshgrid([80, 240, 400, 560], [40, 320]), axis=-1).reshape(-1, 2)
    for x, y in spots:
        cv2.circle(board, (int(x), int(y)), 8, (255, 255, 255, 255), -1)
    Image.fromarray(board).save(tmp_path / "discs.png")
    corners = np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 359.5], [-0.5, 359.5]])
    at = path.camera(8.0)
    rays = at.pixel_to_ray(spots.astype(float))
    rms = {}
    for found in (False, True):
        out = tmp_path / f"run-{found}"
        out.mkdir()
        known = record(found)
        write_run(
            out / "run.json",
            dataclasses.replace(known, clip={**known.clip, "path": str(clip), "picture_fps": 25}),
        )
        write_camera_csv(out / "camera.csv", with_times(table_of_cameras(path.cameras())))
        options = OverlayOptions(
            picture=tmp_path / "discs.png", corners=at.pixel_to_ray(corners), space="rays", in_front=True
        )
        overlay(open_run(out), out / "over.mp4", options)
        slips: list[np.ndarray] = []
        for i, (new, old) in enumerate(
            zip(decoded(out / "over.mp4", "gray"), decoded(clip, "gray"), strict=True)
        ):
            if 3 <= i < 13:  # where the pan is fast
                slips += disc_slips(new, old, np.array([true_pixel(i, ray, path) for ray in rays]))
        assert len(slips) > 60
        rms[found] = float(np.sqrt(np.mean(np.sum(np.square(slips), axis=1))))
    print(f"slip {rms[False]:.2f} px rms with one camera a frame, {rms[True]:.2f} px with each row's own")
    assert rms[False] > 1.5 and rms[True] < 0.3


def test_points_are_turned_as_by_the_matrices() -> None:
    rng = np.random.default_rng(2)
    points, vectors = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)) * np.geomspace(1e-9, 3, 50)[:, None]
    expected = np.einsum("nij,nj->ni", exp(vectors), points)
    np.testing.assert_allclose(turned(points, vectors), expected, atol=1e-14)
