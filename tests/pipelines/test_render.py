"""`render` on clips of the generator: what is put in sticks and goes behind players, what is stabilised stands still,
what is re-shot looks like the scene. And what is said when something is missing.

Slip, residual motion and mattes are measured in the pixels of the new video, against the generator's cameras and masks.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from pipelines import cli
from pipelines.archive import read_camera_csv, read_run, write_camera_csv, write_run
from pipelines.errors import InputError
from pipelines.exports.panorama_json import read_surface
from pipelines.rays import ray_to_pan_tilt
from pipelines.render.opened import open_its_clip, open_run
from pipelines.render.overlay import OverlayOptions, corner_rays
from pipelines.render.stabilise import StabiliseOptions, target_views
from pipelines.render.views import camera_view
from pipelines.report.words import reason_words
from tests.pipelines.clips import write_clip as write_tiny_clip
from tests.pipelines.end_to_end import SIZE, Finished, one_line, pan_spec, run
from tests.pipelines.export_truth import FIRST, LOST, N, truth
from tests.pipelines.test_export_command import finished
from tests.synth.camera import SynthCamera
from tests.synth.clip import SynthClip, write_clip

MAGENTA = (230, 20, 220)


def decoded(path: Path, form: str = "rgb24") -> Iterator[np.ndarray]:
    with av.open(str(path)) as container:
        for frame in container.decode(container.streams.video[0]):
            yield frame.to_ndarray(format=form)


def rendered(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    """`broadcast-mosaic render ... --json` as its document; it must have gone well."""
    assert cli.main(["render", *map(str, words), "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


def true_camera(truth_table: dict[str, Any], i: int) -> SynthCamera:
    return SynthCamera(
        width=SIZE[0], height=SIZE[1], f_px=truth_table["f_px"][i], pan_rad=np.deg2rad(truth_table["pan_deg"][i]),
        tilt_rad=np.deg2rad(truth_table["tilt_deg"][i]), roll_rad=np.deg2rad(truth_table["roll_deg"][i]),
        cx_px=truth_table["cx_px"][i], cy_px=truth_table["cy_px"][i],
    )  # fmt: skip


def disc_slips(new: np.ndarray, old: np.ndarray, wanted_px: np.ndarray) -> list[np.ndarray]:
    """Centres of white discs in a rendered frame, less where they should be (n, 2); those near the border left out.

    new, old: luma with and without them.
    """
    slips = []
    y, x = np.mgrid[-12:13, -12:13]
    for wanted in wanted_px:
        if not ((wanted > 20) & (wanted < [SIZE[0] - 20, SIZE[1] - 20])).all():
            continue
        cx, cy = np.round(wanted).astype(int)
        box = (slice(cy - 12, cy + 13), slice(cx - 12, cx + 13))
        # The share of white, whatever is behind it: the plain difference would lean to one side.
        weight = (new[box].astype(float) - old[box]) / np.maximum(255.0 - old[box], 5.0)
        weight[weight < 0.15] = 0  # what the encoder did elsewhere
        found = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum() + [cx, cy]
        slips.append(found - wanted)
    return slips


def corner_words(corners: np.ndarray) -> str:
    return " ".join(f"{x:g},{y:g}" for x, y in corners)


# ---- overlay


@pytest.mark.slow
def test_an_overlay_sticks_to_the_scene(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Centres of six discs in the new video against where the generator's cameras see them: rms below .3 px.

    In luma: chroma is half as fine, and where its samples lie is the decoder's guess.
    """
    spots = np.array(
        [[60.0, 50.0], [300.0, 60.0], [540.0, 50.0], [80.0, 340.0], [310.0, 330.0], [530.0, 350.0]]
    )
    board = np.zeros((400, 600, 4), np.uint8)
    for x, y in spots:
        cv2.circle(board, (int(x), int(y)), 26, (255, 255, 255, 255), -1)
    Image.fromarray(board).save(tmp_path / "discs.png")
    at, n = 25, len(pan_run.truth["frame"])
    corners = np.array([[180.0, 130.0], [480.0, 120.0], [500.0, 330.0], [150.0, 320.0]])
    document = rendered(
        capsys, pan_run.out, "--what", "overlay", "--image", tmp_path / "discs.png", "--at", at,
        "--corners", corner_words(corners), "--in-front", "-o", tmp_path / "over.mp4",
    )  # fmt: skip
    assert document["n_frames"] == document["n_changed"] == n and not document["passed_through"]
    outer = np.array([[-0.5, -0.5], [599.5, -0.5], [599.5, 399.5], [-0.5, 399.5]])
    H = cv2.getPerspectiveTransform(outer.astype(np.float32), corners.astype(np.float32))
    put = cv2.perspectiveTransform(spots[None], H)[0]
    rays = true_camera(pan_run.truth, at).pixel_to_ray(put)
    slips: list[np.ndarray] = []
    for i, (new, old) in enumerate(
        zip(decoded(tmp_path / "over.mp4", "gray"), decoded(pan_run.clip, "gray"), strict=True)
    ):
        slips += disc_slips(new, old, true_camera(pan_run.truth, i).ray_to_pixel(rays))
    assert len(slips) > 3 * n
    rms = float(np.sqrt(np.mean(np.sum(np.square(slips), axis=1))))
    print("mean", np.mean(slips, axis=0))
    print(f"slip {rms:.3f} px rms, {np.abs(slips).max():.3f} at most, of {len(slips)} discs")
    assert rms < 0.3


@pytest.mark.slow
def test_players_stay_in_front_of_an_overlay(
    tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the pixels that a board on the pitch would cover, at least 95 % show what they should: board or player.

    Fourteen players on a tenth of the picture. A board that never, or always, hides would fail the second claim.
    """
    folder = tmp_path_factory.mktemp("players")
    spec = pan_spec(seed=9, n_players=14, player_share=0.10, n_frames=60)
    clip = folder / "players.mp4"
    write_clip(clip, spec)
    out = run(clip, folder / "out").out
    Image.new("RGBA", (300, 200), (*MAGENTA, 255)).save(folder / "board.png")
    corners = np.array([[120.0, 150.0], [520.0, 150.0], [560.0, 330.0], [90.0, 330.0]])
    document = rendered(
        capsys, out, "--what", "overlay", "--image", folder / "board.png", "--at", 30,
        "--corners", corner_words(corners), "-o", folder / "over.mp4",
    )  # fmt: skip
    assert document["behind_players"] and document["unknown_share"] < 0.01
    views = open_run(out).shot_views(0)
    rays = np.array(document["corner_rays"])
    synth = SynthClip(spec)
    counts = np.zeros(4)
    for i, (new, old) in enumerate(zip(decoded(folder / "over.mp4"), decoded(clip), strict=True)):
        if i % 4:
            continue
        area = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        cv2.fillPoly(area, [np.round(views[i].ray_to_pixel(rays)).astype(np.int32)], 1)
        frame = synth.frame(i)
        inside = cv2.erode(area, np.ones((3, 3), np.uint8)).astype(bool) & ~frame.overlay_mask
        towards = np.array(MAGENTA, float) - old
        shown = ((new.astype(float) - old) * towards).sum(-1) / (towards**2).sum(-1)  # 1: board, 0: as it was
        player, front = frame.player_mask[inside], shown[inside] < 0.5
        counts += [(front & player).sum(), player.sum(), (~front & ~player).sum(), (~player).sum()]
    kept, players, covered, free = counts
    right = (kept + covered) / (players + free)
    print(
        f"right {right:.4f}; players kept {kept / players:.4f} of {players:.0f} px, board {covered / free:.4f}"
    )
    assert players > 0.05 * (players + free)
    assert right > 0.95
    assert kept / players > 0.9 and covered / free > 0.95


def test_corners_in_panorama_pixels_and_in_angles_are_the_same_place(pan_run: Finished) -> None:
    opened = open_run(pan_run.out)
    view = opened.shot_views(0)[25]
    corners = np.array([[250.0, 200.0], [350.0, 200.0], [350.0, 260.0], [250.0, 260.0]])
    rays = view.pixel_to_ray(corners)
    surface = read_surface(pan_run.out / "shot-000" / "panorama.json")
    found = []
    for space, values in (
        ("frame", corners), ("panorama", surface.ray_to_pixel(rays)), ("pan-tilt", ray_to_pan_tilt(rays)),
        ("rays", rays),
    ):  # fmt: skip
        options = OverlayOptions(picture=Path("board.png"), corners=values, space=space, at=25)  # type: ignore[arg-type]
        seen = corner_rays(opened, 0, opened.shot_views(0), options)
        found.append(seen / np.linalg.norm(seen, axis=-1, keepdims=True))
    np.testing.assert_allclose(found[3], found[0], atol=1e-9)
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    np.testing.assert_allclose(found[2], found[0], atol=1e-9)


# ---- stabilised


@pytest.mark.slow
@pytest.mark.parametrize("fill", ["black", "panorama"])
def test_a_stabilised_clip_stands_still(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str], fill: str
) -> None:
    """Patches of every new frame against the generator's clean picture of the reference frame: what is left of a pan
    of 18 degrees is below .3 px rms."""
    document = rendered(
        capsys, pan_run.out, "--what", "stabilised", "--fill", fill, "-o", tmp_path / "still.mp4"
    )
    reference = read_run(pan_run.out).shots[0].reference_frame
    clean = cv2.cvtColor(SynthClip(pan_spec()).render_clean(reference), cv2.COLOR_RGB2GRAY).astype(np.float32)
    shifts, tried = [], 0
    for new in decoded(tmp_path / "still.mp4"):
        gray = cv2.cvtColor(new, cv2.COLOR_RGB2GRAY).astype(np.float32)
        for box in (np.s_[60:150, 240:340], np.s_[60:150, 340:440], np.s_[50:110, 210:430]):  # in every frame
            if (gray[box] < 2).mean() > 0.02:  # not seen in this frame: nothing to compare
                continue
            tried += 1
            if (shift := shift_px(clean[box], gray[box])) is not None:
                shifts.append(shift)
    rms = float(np.sqrt(np.mean(np.sum(np.square(shifts), axis=1))))
    print(f"residual motion {rms:.3f} px rms of {len(shifts)} patches of {tried}")
    assert len(shifts) > 0.8 * tried
    assert rms < 0.3
    assert document["black_share"] < (0.05 if fill == "panorama" else 0.6)


def shift_px(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """How far b's content is from a's, px (2,); None where they do not look alike (a player is in it)."""
    start = np.eye(2, 3, dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    try:
        likeness, found = cv2.findTransformECC(a, b, start, cv2.MOTION_TRANSLATION, stop, None, 5)
    except cv2.error:  # it does not converge
        return None
    return found[:, 2] if likeness > 0.15 else None


def test_a_smoothed_path_follows_the_camera_without_its_tremor(pan_run: Finished) -> None:
    opened = open_run(pan_run.out)
    views = opened.shot_views(0)
    targets = target_views(opened, 0, views, StabiliseOptions(to="smooth", smooth_s=0.4))
    middle = np.array([[SIZE[0] / 2, SIZE[1] / 2]])
    away = [
        float(np.linalg.norm(targets[row].ray_to_pixel(views[row].pixel_to_ray(middle)) - middle))
        for row in views
    ]
    assert 0.5 < max(away) < 40  # px: it goes along, through a pan of 300 px in two seconds

    def jerk(of: dict[int, Any]) -> float:
        path = np.concatenate([of[row].pixel_to_ray(middle) for row in sorted(of)])
        path = path / np.linalg.norm(path, axis=1, keepdims=True)
        return float(np.sqrt(np.mean(np.diff(path, 3, axis=0) ** 2)))

    assert jerk(targets) < 0.2 * jerk(views)


def test_lost_frames_go_through_and_are_said(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied_run(pan_run, tmp_path / "out", lost=(20, 21))
    document = rendered(capsys, out, "--what", "stabilised", "-o", tmp_path / "still.mp4")
    assert document["n_changed"] == document["n_frames"] - 2
    stretch = {"first_frame": 20, "last_frame": 21, "status": "lost", "reason": "low_overlap"}
    assert document["passed_through"] == [stretch]
    pictures = list(decoded(tmp_path / "still.mp4"))
    for i, old in enumerate(decoded(pan_run.clip)):
        same = float(np.abs(pictures[i].astype(float) - old).mean()) < 4
        assert same == (i in (20, 21)) or i == read_run(out).shots[0].reference_frame, i
    assert cli.main(["render", str(out), "--what", "stabilised", "-o", str(tmp_path / "again.mp4")]) == 0
    said = capsys.readouterr().out
    assert (
        "2 frames went through unchanged, first 20 to 21" in said and reason_words("low_overlap")[0] in said
    )


def test_a_shot_without_a_focal_length_is_held_still_by_its_homographies(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied_run(pan_run, tmp_path / "out", relative=True)
    for to, fill in (("smooth", "black"), ("reference", "panorama")):
        code = cli.main(["render", str(out), "--what", "stabilised", "--to", to, "--fill", fill])
        assert code == 2
        assert "no calibrated camera" in one_line(capsys.readouterr().err)
    document = rendered(capsys, out, "--what", "stabilised", "-o", tmp_path / "still.mp4")
    assert document["n_changed"] == document["n_frames"]
    pictures = list(decoded(tmp_path / "still.mp4"))
    known = list(decoded_still(pan_run, tmp_path, capsys))
    for i in (
        5,
        25,
        45,
    ):  # the same as with the camera, but for its lens, which bends by a few tenths of a pixel
        assert np.abs(pictures[i].astype(float) - known[i]).mean() < 4


def decoded_still(
    pan_run: Finished, folder: Path, capsys: pytest.CaptureFixture[str]
) -> Iterator[np.ndarray]:
    rendered(capsys, pan_run.out, "--what", "stabilised", "-o", folder / "known.mp4")
    return decoded(folder / "known.mp4")


def copied_run(
    finished_run: Finished, out: Path, *, lost: tuple[int, ...] = (), relative: bool = False
) -> Path:
    """The folder of a run with some frames lost, or without its focal length."""
    shutil.copytree(finished_run.out, out)
    table = read_camera_csv(out / "camera.csv")
    rows = np.isin(table.frame, lost) | relative
    columns = ("f_px", "f_std_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "k1")
    changed: dict[str, Any] = {name: np.where(rows, np.nan, getattr(table, name)) for name in columns}
    if lost:
        changed["homography"] = np.where(rows[:, None, None], np.nan, table.homography)
        changed["status"] = tuple("lost" if r else s for r, s in zip(rows, table.status, strict=True))
        changed["reason"] = tuple("low_overlap" if r else s for r, s in zip(rows, table.reason, strict=True))
    write_camera_csv(out / "camera.csv", dataclasses.replace(table, **changed))
    return out


# ---- move


@pytest.mark.slow
def test_a_move_shows_the_scene_without_the_players(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keyframes at the run's own cameras: the new pictures are the generator's clean ones of those frames."""
    table = pan_run.table
    picks = [5, 25, 45]
    lines = ["time_s,pan_deg,tilt_deg,roll_deg,hfov_deg"]
    for k, i in enumerate(picks):
        hfov = np.degrees(2 * np.arctan(SIZE[0] / 2 / table.f_px[i]))
        lines.append(f"{k},{table.pan_deg[i]!r},{table.tilt_deg[i]!r},{table.roll_deg[i]!r},{hfov!r}")
    (tmp_path / "keys.csv").write_text("\n".join(lines).replace("np.float64(", "").replace(")", ""))
    document = rendered(
        capsys,
        pan_run.out,
        "--what",
        "move",
        "--keys",
        tmp_path / "keys.csv",
        "-o",
        tmp_path / "move.mp4",
        "--fps",
        10,
    )
    assert (document["n_frames"], document["size_px"]) == (21, list(SIZE)) and document["sound"] == "none"
    assert document["black_share"] < 0.05
    synth, views = SynthClip(pan_spec()), open_run(pan_run.out).shot_views(0)
    pictures = list(decoded(tmp_path / "move.mp4"))
    window = cv2.createHanningWindow((400, 100), cv2.CV_32F)
    for k, i in enumerate(picks):
        clean, new = synth.render_clean(i), pictures[10 * k]
        box = np.s_[50:150, 120:520]
        grays = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32)[box] for p in (clean, new)]
        (dx, dy), response = cv2.phaseCorrelate(*grays, window)
        # The new camera's principal point is in the middle, the frame's need not be.
        at = np.array([[319.5, 99.5]])
        virtual = camera_view(
            SIZE, table.f_px[i], np.radians([table.pan_deg[i], table.tilt_deg[i], table.roll_deg[i]])
        )
        wanted = (virtual.ray_to_pixel(views[i].pixel_to_ray(at)) - at)[0]
        assert np.hypot(*([dx, dy] - wanted)) < 0.3 and response > 0.5, (i, dx, dy, wanted, response)
        away = np.abs(np.median(new.astype(float) - clean, axis=(0, 1)))
        assert away.max() < 8  # the panorama has the light of the whole shot


# ---- what is said


def test_what_is_missing_is_said_in_one_line(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGBA", (30, 20)).save(tmp_path / "board.png")
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "keys.csv").write_text("time_s,pan_deg,tilt_deg,hfov_deg\n0,0,0,30\n1,0,0,30\n")
    other = write_tiny_clip(tmp_path / "other.mkv", 12)
    bare = finished(tmp_path / "bare")
    board = ["--what", "overlay", "--image", tmp_path / "board.png", "--corners", "1,1 9,1 9,9 1,9"]
    crossing = [
        "--what",
        "overlay",
        "--image",
        tmp_path / "board.png",
        "--at",
        5,
        "--corners",
        "1,1 9,9 9,1 1,9",
    ]
    for words, said in (
        ([tmp_path, "--what", "stabilised"], "give the folder of a finished run"),
        ([bare, "--what", "stabilised"], "a b.mp4: the run's clip is not there"),
        ([pan_run.out, "--what", "stabilised", "--clip", other], "is not the clip that the run was made from"),
        ([pan_run.out, "--what", "stabilised", "--shot", 3], "shot 3: is not in this run"),
        ([pan_run.out, "--what", "stabilised", "-o", tmp_path / "a.avi"], "which container"),
        ([bare, "--what", "stabilised", "--fill", "panorama"], "shot 0 has no panorama here"),
        ([bare, "--what", "stabilised", "--shot", 1, "--to", "smooth"], "no calibrated camera"),
        ([bare, *board, "--at", FIRST], "shot 0 has no panorama here"),
        ([bare, *board, "--at", FIRST + LOST], f"frame {FIRST + LOST}: is lost"),
        ([bare, *board, "--at", FIRST + N], "belongs to no shot"),
        ([pan_run.out, *board], "of which frame"),
        ([pan_run.out, *board, "--at", 5000], "is not in this run; it has 0 to 49"),
        ([pan_run.out, *crossing], "crosses itself"),
        ([pan_run.out, *board, "--at", 5, "--image", tmp_path / "text.png"], "is no picture that can be read"),
        ([pan_run.out, *board, "--at", 5, "--image", tmp_path / "none.png"], "none.png: no such file"),
        ([pan_run.out, *board, "--at", 5, "--corners", "1,1 2,2"], "four pairs X,Y"),
        ([pan_run.out, "--what", "overlay"], "needs --image FILE and --corners"),
        ([bare, "--what", "move", "--keys", tmp_path / "keys.csv"], "no shot has a panorama"),
        ([pan_run.out, "--what", "move", "--keys", tmp_path / "no.csv"], "no.csv: no such file"),
        ([pan_run.out, "--what", "move"], "needs --keys FILE"),
        ([pan_run.out, "--what", "move", "--keys", tmp_path / "keys.csv", "--size", "big"], "--size is WxH"),
        ([pan_run.out, "--what", "stabilised", "--panorama.enabled", "no"], "render has no settings"),
    ):  # fmt: skip
        assert cli.main(["render", *map(str, words)]) == 2, words
        assert said in one_line(capsys.readouterr().err), words
    assert cli.main(["render", str(bare), "--what", "stabilised", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["kind"] == "input"
    assert not list(tmp_path.glob("*.mp4")) and not (pan_run.out / "stabilised.mp4").exists()


@pytest.mark.parametrize("what", ["stabilised", "move"])
def test_a_video_replaces_a_file_only_when_told_and_the_clip_never(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    (tmp_path / "keys.csv").write_text("time_s,pan_deg,tilt_deg,hfov_deg\n0,0,0,30\n.2,0,0,30\n")
    words = ["render", str(pan_run.out), "--what", what, "--keys", str(tmp_path / "keys.csv"), "-o"]
    mine = tmp_path / "mine.mp4"
    mine.write_text("something of mine")
    assert cli.main([*words, str(mine)]) == 2
    assert "mine.mp4: is there already" in one_line(capsys.readouterr().err)
    assert mine.read_text() == "something of mine"
    before = pan_run.clip.read_bytes()
    assert cli.main([*words, str(pan_run.clip), "--overwrite"]) == 2
    assert "is the run's clip" in one_line(capsys.readouterr().err)
    assert pan_run.clip.read_bytes() == before
    assert cli.main([*words, str(mine), "--overwrite", "-q"]) == 0
    with av.open(str(mine)) as container:
        assert container.streams.video


def test_a_clip_that_moved_is_found_where_it_is(pan_run: Finished, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(pan_run.out, out)
    record = read_run(out)
    write_run(out / "run.json", dataclasses.replace(record, clip={**record.clip, "path": "gone.mp4"}))
    opened = open_run(out)
    with pytest.raises(InputError, match=r"gone.mp4: the run's clip is not there; .* --clip"):
        open_its_clip(opened)
    moved = shutil.copy(pan_run.clip, tmp_path / "another name.mp4")
    with open_its_clip(opened, Path(moved)) as clip:
        assert clip.facts.size_px == SIZE
    assert truth().size_px != SIZE
