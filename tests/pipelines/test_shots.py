"""A shot longer than shots may be goes on as the next one, and no frame is lost between them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from mosaic.records import PairStatus
from pipelines.edits import EditFound, edit_picture
from pipelines.shots import ShotSplitter, TrackedShot, _spanned
from tests.mosaic.textures import as_uint8, picture


class _Tracker:
    """Follows every picture."""

    def __init__(self) -> None:
        self.observations: list[Any] = []
        self.fits: list[Any] = []
        self.keyframes: dict[int, Any] = {}
        self.images = None
        self.size_px = (320, 180)

    def start(self, look: Any) -> None:
        self.observations.append(SimpleNamespace(frame=look.frame, motion_px=0.0))

    def step(self, look: Any, *, rescue: bool = True) -> bool:
        self.start(look)
        return True


def _frames_of_shots(n_frames: int, max_frames: int | None) -> list[tuple[list[int], str]]:
    splitter = ShotSplitter(_Tracker, bridge_frames=10, max_frames=max_frames)  # type: ignore[arg-type]
    edit = edit_picture(as_uint8(picture(1, size_px=(320, 180))))
    shots: list[TrackedShot] = []
    for frame in range(n_frames):
        shots += splitter.push(SimpleNamespace(frame=frame, pts_s=frame / 25, edit=edit))  # type: ignore[arg-type]
    shots += splitter.finish()
    return [([o.frame for o in shot.tracker.observations], shot.end) for shot in shots]


def test_a_long_shot_is_divided_and_every_frame_is_in_one_part():
    parts = _frames_of_shots(70, 30)
    assert [frame for frames, _ in parts for frame in frames] == list(range(70))
    assert [(len(frames), end) for frames, end in parts] == [(30, "length"), (30, "length"), (10, "end")]


def test_without_a_limit_it_is_one_shot():
    assert [(len(frames), end) for frames, end in _frames_of_shots(70, None)] == [(70, "end")]


@pytest.mark.parametrize(
    ("src", "dst", "status", "route", "score", "spanned"),
    [
        (30, 61, PairStatus.OK, "predicted", 0.45, True),  # from before it to after it
        (38, 58, PairStatus.OK, "link", 0.25, False),  # not two thirds of it
        (38, 68, PairStatus.OK, "link", 0.25, True),
        (38, 68, PairStatus.OK, "link", 0.40, False),  # mixed pictures may agree so far
        (30, 61, PairStatus.WEAK, "predicted", 0.25, False),
        (30, 61, PairStatus.OK, "features", 0.25, False),  # finds the same stands from another camera
        (30, 61, PairStatus.OK, "composed", 0.25, False),
    ],
)
def test_an_edit_that_a_sure_pair_crosses_is_none(src, dst, status, route, score, spanned):
    """Of a gradual edit from frame 30 to 61."""
    pair = SimpleNamespace(src=src, dst=dst, status=status, route=route, score=score)
    found = EditFound(last=30, first=61, kind="transition")
    assert _spanned(SimpleNamespace(fits=[pair]), found) is spanned  # type: ignore[arg-type]
