"""What came earlier in a clip changes nothing later: the same pictures again give the same shots and cameras."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.memory import loop
from mosaic.estimator import RegisterOptions
from mosaic.records import PairStatus
from pipelines.config import RegistrationOptions
from pipelines.edits import EditFinder, edit_picture
from pipelines.keyframes import Keyframe
from pipelines.preparation import PreparedFrame, prepare_frame
from pipelines.routes import Known, Motion, recover
from pipelines.tracking import selection_of
from tests.pipelines.end_to_end import pan_spec, run
from tests.pipelines.test_edits import H, W, view
from tests.synth.clip import ClipSpec, SynthClip
from tests.synth.edits import Edit, Programme, write_programme
from tests.synth.paths import BROADCAST_LENS, PathSpec

LOOPS = 3


@pytest.mark.slow
@pytest.mark.parametrize("options", [("--overlays.enabled", "false"), ()], ids=["no_mask", "overlays"])
def test_a_looped_programme_gives_the_same_shots_and_cameras_in_every_loop(
    tmp_path: Path, options: tuple[str, ...]
) -> None:
    # 71 frames: no multiple of the intervals at which edits, graphics and masks are looked at.
    shots = (pan_spec(4, 47, scoreboard=True), pan_spec(5, 36, pan_deg=9.0))
    shots = tuple(dataclasses.replace(s, width=320, height=180) for s in shots)
    programme = Programme(shots=shots, edits=(Edit(kind="dissolve", n_frames=12),))
    write_programme(tmp_path / "once.mp4", programme)
    n = programme.n_frames
    assert n == 71
    clip = loop(tmp_path / "once.mp4", tmp_path / "looped.mp4", LOOPS, n)
    done = run(clip, tmp_path / "out", "--panorama.enabled", "false", *options)
    table = done.table
    assert len(table.frame) == LOOPS * n and len(done.record["shots"]) == 2 * LOOPS
    parts = [slice(k * n, (k + 1) * n) for k in range(LOOPS)]
    # A mask changes the focal's stated error, and with it the side of 5 % that a frame is on: `ok` and `weak` are one.
    status = np.array(["ok" if s == "weak" and not options else s for s in table.status])
    for later in parts[1:]:
        np.testing.assert_array_equal(status[later], status[parts[0]])
        if not options:
            # The mask of graphics is knowledge of the clip so far: what it leaves free moves by the width of a rim, and
            # the cameras by far less than their error (f: 3.3 %).
            np.testing.assert_allclose(table.zoom_ratio[later], table.zoom_ratio[parts[0]], rtol=1e-3)
            np.testing.assert_allclose(table.pan_deg[later], table.pan_deg[parts[0]], atol=0.1)
            continue
        for name in ("zoom_ratio", "f_px", "f_std_px", "pan_deg", "tilt_deg", "roll_deg", "homography"):
            values = getattr(table, name)
            np.testing.assert_allclose(values[later], values[parts[0]], rtol=1e-9, atol=1e-9, err_msg=name)


def test_motion_over_a_long_clip_does_not_wear_out_the_edit_finder() -> None:
    """Steps that zoom, as a wrong registration across a cut does: counted from the clip on they grow past 10^15."""
    pan, wrong = np.eye(3), np.diag([2.5, 2.5, 1.0])
    pan[0, 2] = -3.0
    n, n_shots = 20, 40
    views = [view(seed, n) for seed in (1, 2)]
    finder, found = EditFinder((W, H)), []
    for k in range(n * n_shots):
        edit = finder.push(k, edit_picture(views[k // n % 2][k % n]), pan if k % n else wrong)
        if edit is not None:
            finder.begin(edit.first)
            found.append((edit.last, edit.first))
    # Such motion may move an edit's ends by a frame, but by the same in every turn.
    assert len(found) == n_shots - 1 and all(
        abs(last + 1 - n * k) <= 1 for k, (last, _) in enumerate(found, 1)
    )
    assert [(last + 2 * n, first + 2 * n) for last, first in found[:-2]] == found[2:]


def venue_shot(seed: int, *, close: bool) -> SynthClip:
    """A shot of the venue of a seed: by the main camera, or by one nearer to the pitch."""
    k = 3 if close else 2
    path = PathSpec(
        pan_deg=5.0 if close else 10.0, pan0_deg=(-8.0 if close else 3.0) + 3 * k, f0_per_width=2.0 if close else 1.2,
        zoom=1.1 + 0.1 * k,
    )  # fmt: skip
    return SynthClip(
        ClipSpec(
            seed=10 * seed + k, world_seed=seed, width=480, height=270, n_frames=24, lens=BROADCAST_LENS, path=path,
            player_share=0.06, camera_moved_m=(6.0 + 2 * k, 3.0) if close else (0.0, 0.0),
        )
    )  # fmt: skip


def looked(clip: SynthClip, index: int, frame: int) -> PreparedFrame:
    gray = cv2.cvtColor(clip.frame(index).image, cv2.COLOR_RGB2GRAY)
    return prepare_frame(frame, frame / 25, gray, selection=selection_of(RegistrationOptions()))


def known_of(look: PreparedFrame) -> Known:
    keyframe = Keyframe(frame=look.frame, template=look.template, small=look.small)
    return Known(
        previous=look, keyframe=keyframe, H_previous_keyframe=np.eye(3), motion=Motion(), camera=None
    )


@pytest.mark.parametrize("seed", [803, 806, 811])
def test_another_camera_of_the_same_venue_is_no_bridge_over_the_cut(seed: int) -> None:
    """Features find the stands in both. Such a pair hid the same cut of a long stream whenever a mask's rim let it."""
    before, after = venue_shot(seed, close=False), venue_shot(seed, close=True)
    reached = recover(looked(after, 0, 1), known_of(looked(before, 23, 0)), RegisterOptions())
    assert reached.usable == []


def test_a_lost_frame_of_the_same_view_is_found_again_without_doubt() -> None:
    path = PathSpec(pan_deg=20.0, zoom=1.1)
    clip = SynthClip(ClipSpec(seed=8, width=480, height=270, n_frames=12, path=path, player_share=0.06))
    reached = recover(looked(clip, 11, 1), known_of(looked(clip, 0, 0)), RegisterOptions())
    assert [fit.status for fit in reached.usable] == [PairStatus.OK]
    assert abs(reached.usable[0].H_dst_src[0, 2]) > 0.2 * 480
