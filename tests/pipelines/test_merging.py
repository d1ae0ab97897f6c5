"""Shots of one camera: merged when asked for and shown to be one, refused with a reason when they are not.

One clip has it all: a shot, a cutaway to another venue, the same camera again, and the same pitch from another place.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from calib.records import Lens, Priors, Solution
from calib.rotation import from_pan_tilt_roll
from mosaic.framestore import FrameStore
from pipelines import run as run_module
from pipelines.archive import read_run, shot_from_dict
from pipelines.compare import compare_run
from pipelines.config import DecodeOptions, load_config
from pipelines.decode import open_clip
from pipelines.exports.panorama_json import read_surface
from pipelines.merged_panorama import JoinedStores
from pipelines.merging import SENTENCES, MergeOptions
from pipelines.rays import pixel_to_ray
from pipelines.report import words
from pipelines.report.words import merging as words_of_merging
from pipelines.result import open_result
from pipelines.shot_pairs import scene_only, spread, without_common
from tests.pipelines.end_to_end import Finished, run
from tests.synth.clip import ClipSpec, truth_path, write_clip
from tests.synth.paths import PathSpec

FIRST, CUTAWAY, AGAIN, ELSEWHERE = range(4)
N_FRAMES = (36, 20, 36, 36)


def _spec(seed: int, venue: int, n_frames: int, pan_deg: float, pan0_deg: float, **values: Any) -> ClipSpec:
    path = PathSpec(pan_deg=pan_deg, pan0_deg=pan0_deg, zoom=1.2, zoom_style="in")
    return ClipSpec(
        seed=seed, world_seed=venue, width=720, height=404, n_frames=n_frames, path=path, n_players=6,
        player_share=0.03, noise_grey=1.5, max_px_per_rad=960.0, **values,
    )  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("merging") / "clip.mp4"
    write_clip(
        path,
        [
            _spec(8, 8, N_FRAMES[FIRST], 14.0, 0.0),
            _spec(11, 33, N_FRAMES[CUTAWAY], 6.0, 0.0, texture="arena"),
            _spec(9, 8, N_FRAMES[AGAIN], 14.0, 6.0, exposure_ramp_stops=0.3),
            _spec(9, 8, N_FRAMES[ELSEWHERE], 14.0, 6.0, camera_moved_m=(8.0, 3.0)),
        ],
    )
    return path


@pytest.fixture(scope="module")
def merged(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run(clip, tmp_path_factory.mktemp("merged") / "out", "--merge-shots")


@pytest.fixture(scope="module")
def plain(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run(clip, tmp_path_factory.mktemp("plain") / "out")


def _attempts(finished: Finished, shot: int) -> list[dict[str, Any]]:
    return [a for a in finished.record["merging"]["attempts"] if a["shot"] == shot]


@pytest.mark.slow
def test_the_same_camera_after_a_cutaway_is_merged_with_its_evidence(merged: Finished) -> None:
    assert merged.code == 0, merged.stderr
    (attempt,) = _attempts(merged, AGAIN)
    assert attempt["merged"] and attempt["into"] == FIRST and attempt["reason"] == ""
    assert attempt["pairs_verified"] >= 3 and attempt["pairs_kept"] >= 3
    assert 0.5 < attempt["overlap"] <= 1
    assert attempt["residual_px"] <= attempt["residual_limit_px"]
    assert abs(attempt["focal_difference"]) <= attempt["focal_difference_allowed"]
    assert 3 < attempt["rotation_deg"]["pan"] < 12  # the second shot pans about 6 degrees further right
    (group,) = merged.record["merging"]["groups"]
    assert group["shots"] == [FIRST, AGAIN] and group["world_of_shot"] == FIRST
    shots = merged.record["shots"]
    assert [s["merged_into"] for s in shots] == [None, None, FIRST, None]
    assert shots[AGAIN]["reference_frame"] == shots[FIRST]["reference_frame"]
    assert "merged into" in merged.record["world"]


@pytest.mark.slow
def test_another_venue_and_another_place_are_refused_with_a_reason(merged: Finished) -> None:
    for attempt in _attempts(merged, CUTAWAY):
        assert not attempt["merged"] and attempt["reason"] in ("no_match", "too_few_pairs")
    first, *others = _attempts(merged, ELSEWHERE)
    # The pictures of the other place do register: what refuses them is that no turn explains the pairs.
    assert first["into"] == FIRST and first["pairs_verified"] >= 3
    assert not first["merged"] and first["reason"] in ("contradicted", "residual")
    assert first["residual_px"] > 2 * first["residual_limit_px"]
    assert all(not a["merged"] for a in others)
    assert all(a["sentence"] == SENTENCES[a["reason"]] for a in merged.record["merging"]["attempts"])


@pytest.mark.slow
def test_the_merged_track_is_one_frame_of_reference_against_the_truth(merged: Finished) -> None:
    result = open_result(merged.out)
    table, truth = result.camera, merged.truth
    R = result.rotations()
    pan, tilt, roll = np.radians([truth["pan_deg"], truth["tilt_deg"], truth["roll_deg"]])
    R_true = from_pan_tilt_roll(pan, tilt, roll)
    a = np.flatnonzero((table.shot == FIRST) & np.isfinite(table.f_px))[::4]
    b = np.flatnonzero((table.shot == AGAIN) & np.isfinite(table.f_px))[::4]

    def errors_deg(left: Any, right: Any) -> Any:
        E = (R[right] @ R[left][:, None].swapaxes(-1, -2)) @ np.swapaxes(
            R_true[right] @ R_true[left][:, None].swapaxes(-1, -2), -1, -2
        )
        trace = np.clip((np.trace(E, axis1=-2, axis2=-1) - 1) / 2, -1, 1)
        return np.degrees(np.arccos(trace))

    across, within = errors_deg(a, b), np.concatenate([errors_deg(a, a).ravel(), errors_deg(b, b).ravel()])
    # What a wrong focal makes of a turn is the same across the shots as within one: the joint adds a tenth of a pixel.
    pixel_deg = np.degrees(1 / np.nanmedian(table.f_px))
    assert np.median(across) < 2 * np.median(within) + 0.3 * pixel_deg
    assert across.max() < 3 * pixel_deg
    ref = np.flatnonzero(table.frame == read_run(merged.out).shots[AGAIN].reference_frame)[0]
    zoom = truth["f_px"] / truth["f_px"][ref]
    assert np.abs(table.zoom_ratio[b] / zoom[b] - 1).max() < 0.003
    comparison = compare_run(merged.out, truth_path(merged.clip))
    again = comparison["shots"][AGAIN]
    assert again["compared"] >= N_FRAMES[AGAIN] - 2 and again["wrong_shot"] <= 2


@pytest.mark.slow
def test_the_merged_panorama_holds_both_shots_where_their_cameras_say(merged: Finished) -> None:
    result = open_result(merged.out)
    folder = merged.out / "merged-000"
    surface = read_surface(folder / "panorama.json")
    picture = tifffile.imread(folder / "panorama.tif").astype(float)
    own = result.panorama(AGAIN)
    first = result.panorama(FIRST)
    assert surface.width > first.surface.width and "of shot 0" in (folder / "panorama.json").read_text()
    # A place of the second shot's own panorama is at the same ray in the merged one, and looks the same.
    y, x = np.mgrid[20 : own.surface.height - 20 : 7, 20 : own.surface.width - 20 : 7]
    rays = own.surface.pixel_to_ray(np.stack([x, y], -1).reshape(-1, 2))
    at = np.rint(surface.ray_to_pixel(rays)).astype(int)
    inside = ((at >= 0) & (at < [surface.width, surface.height])).all(axis=1)
    seen = own.alpha[y.ravel(), x.ravel()] > 0
    both = np.flatnonzero(inside & seen)
    both = both[picture[at[both, 1], at[both, 0], 3] > 0]
    assert len(both) > 0.95 * seen.sum()
    here = own.image[y.ravel()[both], x.ravel()[both]].astype(float)
    there = picture[at[both, 1], at[both, 0], :3]
    assert np.corrcoef(here.mean(1), there.mean(1))[0, 1] > 0.9
    assert set(merged.record["merging"]["groups"][0]["panorama"]["frames_of_shots"]) == {"0", "2"}


@pytest.mark.slow
def test_frames_of_both_shots_lie_in_the_merged_panorama_where_the_table_says(merged: Finished) -> None:
    table = merged.table
    surface = read_surface(merged.out / "merged-000" / "panorama.json")
    picture = tifffile.imread(merged.out / "merged-000" / "panorama.tif").astype(float)
    chosen = {
        int(table.frame[rows[len(rows) // 2]]): shot
        for shot in (FIRST, AGAIN)
        for rows in [np.flatnonzero((table.shot == shot) & np.isfinite(table.f_px))]
    }
    x, y = np.meshgrid(np.arange(60, 660, 5), np.arange(60, 344, 5))
    xy = np.stack([x, y], -1).reshape(-1, 2)
    with open_clip(merged.clip, DecodeOptions()) as opened:
        pictures = {f.index: f.picture().astype(float) for f in opened if f.index in chosen}

    def alike(frame: int, shift_px: NDArray[np.float64]) -> float:
        at = np.rint(surface.ray_to_pixel(pixel_to_ray(table, frame, xy + shift_px))).astype(int)
        at = np.clip(at, 0, [surface.width - 1, surface.height - 1])
        seen = picture[at[:, 1], at[:, 0], 3] > 0
        here = pictures[frame][xy[seen, 1], xy[seen, 0]].mean(1)
        return float(np.corrcoef(here, picture[at[seen, 1], at[seen, 0], :3].mean(1))[0, 1])

    # Of nine places 4 px apart the one that table and panorama name is the likest: worlds apart would show no peak.
    shifts = np.array([[dx, dy] for dy in (-4.0, 0.0, 4.0) for dx in (-4.0, 0.0, 4.0)])
    for frame in chosen:
        likeness = [alike(frame, shift) for shift in shifts]
        assert np.argmax(likeness) == 4 and likeness[4] > 0.7, (frame, likeness)


@pytest.mark.slow
def test_shots_that_stay_by_themselves_are_as_without_the_option(merged: Finished, plain: Finished) -> None:
    assert "merging" not in plain.record and all(s["merged_into"] is None for s in plain.record["shots"])
    assert not (plain.out / "merged-000").exists()
    lines, same = ((f.out / "camera.csv").read_text().splitlines() for f in (merged, plain))
    alone = [i for i, s in enumerate(plain.table.shot.tolist(), 1) if s in (CUTAWAY, ELSEWHERE)]
    assert len(alone) > 40 and [lines[i] for i in alone] == [same[i] for i in alone]
    for shot in (CUTAWAY, ELSEWHERE):
        name = f"shot-{shot:03d}/panorama"
        a, b = (tifffile.imread(f.out / f"{name}.tif") for f in (merged, plain))
        assert np.array_equal(a, b)
        assert (merged.out / f"{name}.json").read_bytes() == (plain.out / f"{name}.json").read_bytes()


@pytest.mark.slow
def test_a_resumed_run_solves_again_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    clip = tmp_path / "clip.mp4"
    shots = [
        _spec(8, 8, 24, 12.0, 0.0),
        _spec(11, 33, 16, 6.0, 0.0, texture="arena"),
        _spec(9, 8, 24, 12.0, 4.0),
    ]
    write_clip(clip, [replace(spec, width=480, height=270, max_px_per_rad=640.0) for spec in shots])
    options = ("--merge-shots", "--panorama.enabled", "false")
    whole = run(clip, tmp_path / "whole", *options)
    with monkeypatch.context() as patched:
        patched.setattr(run_module, "thumbnails", interrupted)  # when the first shot has just been saved
        assert run(clip, tmp_path / "out", *options).code == 130
    assert list((tmp_path / "out").glob(".partial-*/shot-*/shot.json"))
    again = run(clip, tmp_path / "out", *options, "--resume")
    assert again.code == 0 and again.camera_bytes == whole.camera_bytes
    assert again.record["merging"] == whole.record["merging"]
    assert "solved again" in again.stderr
    # Without panoramas the tracks alone are merged.
    (group,) = whole.record["merging"]["groups"]
    assert (
        group["shots"] == [0, 2] and group["files"] == ["merged-000/pairs.npz"] and group["panorama"] is None
    )


# ---- parts


def test_merging_is_off_unless_it_is_asked_for() -> None:
    assert load_config().shots.merge is False
    assert load_config(None, {"shots.merge": "true"}).shots.merge is True


def test_a_record_of_before_knows_of_no_merging(tmp_path: Path) -> None:
    values: dict[str, Any] = {
        "index": 0, "first_frame": 0, "last_frame": 9, "reference_frame": 0, "status": "relative", "reason": "",
        "sentence": "", "focal": None, "calibration": {}, "panorama": None, "files": [], "status_counts": {},
        "timings_s": {}, "warnings": [],
    }  # fmt: skip
    assert shot_from_dict(json.loads(json.dumps(values))).merged_into is None
    assert shot_from_dict({**values, "merged_into": 3}).merged_into == 3


def _solution(pans_deg: list[float], log_f: list[float]) -> Solution:
    n = len(pans_deg)
    R = from_pan_tilt_roll(np.radians(pans_deg), np.zeros(n), np.zeros(n))
    nan = np.full(n, np.nan)
    return Solution(
        frames=np.arange(n) * 10, log_f=np.array(log_f), R=R, reference=0,
        lens=Lens(size_px=(640, 360), pp_px=np.array([320.0, 180.0])),
         sigma_log_f=nan, sigma_log_zoom=nan, cov_rot=np.full((n, 3, 3), np.nan), sigma_mean_log_f=np.nan,
        sigma_mean_formal=np.nan, lens_std={}, chi2_dof=np.nan, s10_px=0.0, edge_chi2=np.zeros(0),
        edge_kappa=np.zeros(0), edge_ok=np.zeros(0, bool), rms_px=nan, converged=True, stop="", n_steps=0, cost=0.0,
        priors=Priors(),
    )  # fmt: skip


def test_keyframes_to_compare_lie_far_apart() -> None:
    solution = _solution([0, 9, 10, 11, 20], [6.9] * 5)
    chosen = spread(solution, [int(f) for f in solution.frames], 3)
    assert chosen[0] == 20 and set(chosen[1:]) == {0, 40}  # the middle, then both ends of the pan
    nothing = replace(solution, log_f=np.full(5, np.nan))
    assert spread(nothing, [0, 10, 20], 2) == [0, 10]


def test_graphics_do_not_match_themselves() -> None:
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (90, 160), dtype=np.uint8)
    mask = np.ones((360, 640), bool)
    mask[20:60, 40:200] = False
    without = scene_only(small, mask)
    assert np.array_equal(without[30:], small[30:])
    assert np.std(without[6:14, 12:48].astype(float)) < 0.6 * np.std(small[6:14, 12:48].astype(float))
    assert scene_only(small, None) is small


def test_a_graphic_that_no_mask_knows_is_taken_out_of_a_pair_of_pictures() -> None:
    rng = np.random.default_rng(1)

    def picture(text: str) -> NDArray[np.uint8]:
        out = np.clip(rng.normal(90, 3, (180, 320)), 0, 255).astype(np.uint8)
        cv2.putText(out, "TEAM 0-0", (20, 40), cv2.FONT_HERSHEY_DUPLEX, 1.0, 250, 2)
        cv2.putText(out, text, (60, 130), cv2.FONT_HERSHEY_DUPLEX, 1.5, 20, 3)
        cv2.line(out, (0, int(rng.integers(60, 90))), (319, int(rng.integers(90, 120))), 220, 3)
        return out

    a, b = picture("north"), picture("south stand")
    for before, after in zip((a, b), without_common(a, b), strict=True):
        assert after[18:42, 20:180].std() < 0.2 * before[18:42, 20:180].std()
        assert np.mean(after[60:] == before[60:]) > 0.9
    # A camera that looks the same way again: all that it sees stands still, and stays.
    noisy = np.clip(a + rng.normal(0, 2, a.shape), 0, 255).astype(np.uint8)
    assert all(x is y for x, y in zip(without_common(a, noisy), (a, noisy), strict=True))


def test_stores_of_several_shots_read_as_one(tmp_path: Path) -> None:
    pictures = {k: np.full((32, 48, 3), k, np.uint8) for k in (3, 7, 20)}
    with FrameStore(tmp_path, (48, 32)) as a, FrameStore(tmp_path, (48, 32)) as b:
        a.put(3, pictures[3])
        a.put(7, pictures[7])
        b.put(20, pictures[20])
        joined = JoinedStores([a, b])
        assert joined.frames == (3, 7, 20) and 7 in joined and 8 not in joined
        for k, picture in pictures.items():
            assert np.array_equal(joined.get(k).rgb, picture)
            assert np.array_equal(joined.rows(k, 4, 9, np.empty(48 * 32 * 3, np.uint8)), picture[4:9])
            assert joined.coarse(k)[0].mean() == k


def test_the_report_tells_of_merges_and_refusals() -> None:
    evidence = {"pairs_kept": 25, "residual_px": 0.129, "residual_own_px": 0.103}
    facts = {
        "groups": [{"shots": [0, 2], "folder": "merged-000", "pairs_across": 25, "files": []}],
        "attempts": [
            {"shot": 1, "into": 0, "merged": False, "reason": "no_match", "sentence": SENTENCES["no_match"]},
            {"shot": 2, "into": 0, "merged": True, "reason": "", "sentence": SENTENCES[""], **evidence},
            {"shot": 3, "into": -1, "merged": False, "reason": "no_room", "sentence": SENTENCES["no_room"]},
        ],
    }
    told = words_of_merging(facts)
    assert told[0].startswith("Shots 0, 2 are one camera: merged-000")
    assert SENTENCES["no_match"] in told[1] and "0.13 px" in told[2] and "no other" in told[3]
    assert words.merging({}) == []
    assert MergeOptions().min_pairs >= 3
