"""Film in 60i comes out as the film: each picture once, whole, evenly spaced; what is no film is left as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.config import DecodeOptions
from pipelines.decode import Frame, open_clip
from pipelines.scan import STEP, judge_scan
from tests.pipelines.clips import write_clip
from tests.pipelines.zoo import NTSC, SIZE, luma, woven

FILM_S = 1001 / 24000
SAME_GREY = 2.0  # mean, of a picture that is the same but for rounding; neighbours differ by 30


def film_clip(path: Path, first: int, n: int, order: str = "tff", then: int = 0) -> Path:
    """n frames of film in 60i from frame `first` of its cycles, then so many frames of true 30p."""
    pictures = [woven(first + k, f"telecine_{order}") for k in range(n)]
    last = shown(pictures[-1])
    pictures += [luma(last + 1 + k) for k in range(then)]
    return write_clip(
        path, len(pictures), size=SIZE, fps=NTSC, pictures=[np.rint(p).astype(np.uint8) for p in pictures]
    )


def shown(grey: np.ndarray) -> int:
    """Which picture of the film this is; -1 for none."""
    errors = [np.abs(grey - luma(k)).mean() for k in range(60)]
    best = int(np.argmin(errors))
    return best if errors[best] < SAME_GREY else -1


def decoded(path: Path) -> tuple[list[int], np.ndarray, list[Frame]]:
    with open_clip(path) as clip:
        frames = list(clip)
        assert clip.facts.deinterlace == "fieldmatch" and clip.facts.scan_seen.startswith("telecine")
        assert any("pull-down" in w for w in clip.facts.warnings)
    return [shown(f.gray) for f in frames], np.array([f.pts_s for f in frames]), frames


@pytest.mark.parametrize("order", ["tff", "bff"])
@pytest.mark.parametrize("first", range(5))
def test_film_that_begins_anywhere_in_a_cycle(tmp_path: Path, first: int, order: str) -> None:
    pictures, pts_s, frames = decoded(film_clip(tmp_path / "a.mkv", first, 40, order))
    # Of a mixed frame at either end the other half is missing: that picture is interpolated, or its cycle lacks one.
    whole = pictures[4:-2]
    assert whole == list(range(whole[0], whole[0] + len(whole)))
    assert len(pictures) in (32, 33)
    assert np.diff(pts_s)[5:] == pytest.approx(FILM_S, abs=1.1e-3)
    assert pts_s[-1] - pts_s[0] == pytest.approx(39 / float(NTSC), abs=0.05)
    assert [f.index for f in frames] == list(range(len(frames))) and frames[0].field is None


def test_pictures_are_never_mixed(tmp_path: Path) -> None:
    pictures, _, _ = decoded(film_clip(tmp_path / "a.mkv", 0, 40))
    assert pictures == list(range(32))


def test_true_video_between_film_loses_nothing(tmp_path: Path) -> None:
    pictures, pts_s, _ = decoded(film_clip(tmp_path / "a.mkv", 0, 30, then=20))
    assert pictures == list(range(24 + 20))
    assert np.diff(pts_s)[-15:] == pytest.approx(1 / float(NTSC), abs=1.1e-3)
    assert (np.diff(pts_s) > 0.02).all()


def test_a_scene_at_rest_keeps_the_rate(tmp_path: Path) -> None:
    still = [np.rint(woven(k, "telecine_tff")).astype(np.uint8) for k in range(30)]
    path = write_clip(tmp_path / "a.mkv", 60, size=SIZE, fps=NTSC, pictures=still + [still[-1]] * 30)
    pictures, pts_s, _ = decoded(path)
    assert pictures == [*range(24), *[23] * 24]
    assert np.diff(pts_s) == pytest.approx(FILM_S, abs=1.1e-3)


def opened_by(opening: list[np.ndarray], path: Path, n_film: int = 60) -> Path:
    """Frames as they are, then film in 60i that goes on from frame 0 of its cycle."""
    pictures = [*opening, *(woven(k, "telecine_tff") for k in range(n_film))]
    grey = [np.rint(p).astype(np.uint8) for p in pictures]
    return write_clip(path, len(grey), size=SIZE, fps=NTSC, pictures=grey)


@pytest.mark.parametrize("n_before", [40, 130])
@pytest.mark.parametrize("rest", [True, False], ids=["at_rest", "moving"])
def test_film_that_begins_after_an_opener_is_put_together(tmp_path: Path, n_before: int, rest: bool) -> None:
    opener = [luma(0 if rest else k % 40) for k in range(n_before)]
    pictures, _, _ = decoded(opened_by(opener, tmp_path / "a.mkv"))
    film = [p for p in pictures if p >= 0][-30:]
    assert film == list(range(film[0], film[0] + 30))


def test_film_after_the_first_ten_seconds_is_looked_for_all_over_the_clip(tmp_path: Path) -> None:
    path = opened_by([luma(0)] * 400, tmp_path / "a.mkv", n_film=250)
    with open_clip(path) as clip:
        assert clip.facts.scan_seen == "telecine_tff" and clip.facts.deinterlace == "fieldmatch"


def test_a_clip_that_is_progressive_throughout_stays_so(tmp_path: Path) -> None:
    pictures = [np.rint(luma(k % 50)).astype(np.uint8) for k in range(60)]
    with open_clip(write_clip(tmp_path / "a.mkv", 60, size=SIZE, fps=NTSC, pictures=pictures)) as clip:
        assert (clip.facts.scan_seen, clip.facts.deinterlace) == ("progressive", "none")
        assert len(list(clip)) == 60


def test_left_alone_when_asked(tmp_path: Path) -> None:
    path = film_clip(tmp_path / "a.mkv", 0, 20)
    with open_clip(path, DecodeOptions(deinterlace="off")) as clip:
        frames = list(clip)
        assert clip.facts.deinterlace == "none" and len(frames) == 20
    np.testing.assert_array_equal(frames[1].gray, np.rint(woven(1, "telecine_tff")).astype(np.uint8))


@pytest.mark.parametrize(("scan", "seen"), [("tff", "tff"), ("bff", "bff"), ("progressive", "progressive")])
def test_only_pull_down_is_called_so(scan: str, seen: str) -> None:
    pictures = [luma(k) if scan == "progressive" else woven(k, scan) for k in range(24)]
    assert judge_scan(p[:, ::STEP].astype(np.float32) for p in pictures) == seen


def test_one_mixed_frame_in_five_is_pull_down_too() -> None:
    first, second = (0, 1, 1, 2, 3), (0, 1, 2, 2, 3)  # 2:3:3:2
    pictures = []
    for k in range(24):
        picture = luma(4 * (k // 5) + first[k % 5]).copy()
        picture[1::2] = luma(4 * (k // 5) + second[k % 5])[1::2]
        pictures.append(picture)
    assert judge_scan(p[:, ::STEP].astype(np.float32) for p in pictures) == "telecine_tff"
