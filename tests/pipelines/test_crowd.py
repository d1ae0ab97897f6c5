"""A shot whose players fill the picture, without anybody's masks: followed by the scene between them."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from mosaic.crowd import SceneFound, ScenePair
from mosaic.records import PairStatus
from pipelines import crowd
from pipelines.archive import read_camera_csv
from pipelines.compare import compare_run
from pipelines.config import Config, RegistrationOptions
from pipelines.crowd import LITTLE_FRAMES, MUCH, CrowdWatch, doubted
from pipelines.preparation import prepare_frame
from pipelines.routes import Known, Motion, register
from pipelines.run import process
from pipelines.tracking import ShotTracker, selection_of
from tests.mosaic.test_crowd import CROWD
from tests.synth.clip import write_clip
from tests.synth.paths import BROADCAST_LENS, PathSpec

SELECTION = selection_of(RegistrationOptions())


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("crowd")
    path = PathSpec(pan_deg=10, zoom=1.2, tilt_deg=1.0)
    spec = dataclasses.replace(CROWD, width=1280, height=720, lens=BROADCAST_LENS, n_frames=50, path=path)
    write_clip(folder / "clip.mp4", spec)
    process(folder / "clip.mp4", folder / "out", Config.model_validate({"panorama": {"enabled": False}}))
    return folder


@pytest.mark.slow
def test_a_crowded_shot_is_followed_from_end_to_end(followed):
    rows = read_camera_csv(followed / "out" / "camera.csv")
    assert (rows.shot == 0).all() and np.isfinite(rows.zoom_ratio).all()
    shot = compare_run(followed / "out", followed / "clip-truth.csv")["shots"][0]
    assert shot["zoom_rms"] < 0.0005  # .0007 without masks


@pytest.mark.slow
def test_it_says_so(followed):
    record = json.loads((followed / "out" / "run.json").read_text())
    (said,) = [w for w in record["shots"][0]["warnings"] if "people fill" in w]
    assert int(said.split()[2]) > 40


def looks(n=2, shape=(720, 1280)):
    rng = np.random.default_rng(3)
    gray = rng.integers(0, 255, shape).astype(np.uint8)
    return [prepare_frame(k, k / 25, gray, selection=SELECTION) for k in range(n)]


def step_of(source, target):
    tracker = ShotTracker((1280, 720), RegistrationOptions(), priors=None)  # type: ignore[arg-type]
    known = Known(
        previous=source, keyframe=tracker._as_keyframe(source), H_previous_keyframe=np.eye(3), motion=Motion(),
        camera=None,
    )  # fmt: skip
    return register(target, known, tracker.register_options).fits[0]


def found_with(fit, share):
    scene = (np.arange(180 * 320).reshape(180, 320) < share * 180 * 320).astype(np.uint8)
    return SceneFound(fit=fit, scene=ScenePair(source=scene, target=scene))


def test_a_pair_that_convinces_is_not_looked_at_again(monkeypatch):
    a, b = looks()
    monkeypatch.setattr(crowd, "find_scene", lambda *args: pytest.fail("looked"))
    assert CrowdWatch(SELECTION).scene_between(a, b, step_of(a, b)) is None


def test_in_small_pictures_nobody_looks(monkeypatch):
    a, b = looks(shape=(180, 320))
    doubtful = dataclasses.replace(step_of(*looks()), status=PairStatus.WEAK)
    monkeypatch.setattr(crowd, "find_scene", lambda *args: pytest.fail("looked"))
    assert CrowdWatch(SELECTION).scene_between(a, b, doubtful) is None


def test_looks_in_vain_become_rare(monkeypatch):
    a, b = looks()
    doubtful = dataclasses.replace(step_of(a, b), status=PairStatus.WEAK)
    asked = []
    monkeypatch.setattr(crowd, "find_scene", lambda *args: asked.append(1))
    watch = CrowdWatch(SELECTION)
    for _ in range(100):
        assert watch.scene_between(a, b, doubtful) is None
    assert 5 <= len(asked) <= 9 and watch.n_looks == len(asked)


def test_where_little_moves_no_masks_are_made(monkeypatch):
    a, b = looks()
    doubtful = dataclasses.replace(step_of(a, b), status=PairStatus.WEAK)
    monkeypatch.setattr(crowd, "find_scene", lambda *args: found_with(doubtful, 1 - MUCH + 0.1))
    assert CrowdWatch(SELECTION).scene_between(a, b, doubtful) is None


def test_masks_end_when_people_leave_the_picture(monkeypatch):
    a, b = looks()
    doubtful = dataclasses.replace(step_of(a, b), status=PairStatus.WEAK)
    crowded = found_with(doubtful, 0.4)
    monkeypatch.setattr(crowd, "find_scene", lambda *args: crowded)
    watch = CrowdWatch(SELECTION)
    assert watch.scene_between(a, b, doubtful) is crowded
    _, masked = watch.without_people(a, b, crowded.scene)
    np.testing.assert_array_equal(masked.scene, crowded.scene.target)
    assert (masked.pyramid.mask == crowded.scene.target).all()
    watch.accept(masked, b)
    assert watch.masked and watch.frames == (1,)
    np.testing.assert_array_equal(watch.scene(1), crowded.scene.target)
    _, free = watch.without_people(a, b, found_with(doubtful, 0.9).scene)
    for _ in range(LITTLE_FRAMES):
        assert watch.masked
        watch.accept(free, b)
    assert not watch.masked
    watch.cut_back(0)
    assert watch.frames == ()


def test_doubted_pairs_state_errors_twice_as_large():
    a, b = looks()
    fit = step_of(a, b)
    less = doubted(fit)
    np.testing.assert_allclose(4 * less.info, fit.info)
    np.testing.assert_allclose(4 * less.flow.info, fit.flow.info)
