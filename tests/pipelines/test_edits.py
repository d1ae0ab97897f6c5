"""Edits between moving textures of known motion, and through the splitter on rendered programmes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.edits import inside, matched
from pipelines.config import Config
from pipelines.decode import open_clip
from pipelines.edits import MIXED_CONTRAST, EditFinder, EditFound, edit_picture
from pipelines.first_look import look_at
from tests.pipelines.end_to_end import pan_spec
from tests.synth.edits import Edit, Programme, blend, write_programme

W, H = 320, 180
Pictures = list[NDArray[np.uint8]]


def view(seed: int, n: int, step_px: int = 3) -> Pictures:
    """A pan over a texture as coarse as players and as fine as a crowd."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(H, W + 400))
    scene = 110 + 220 * ndimage.gaussian_filter(noise, 5) + 70 * ndimage.gaussian_filter(noise, 2)
    scene += 60 * ndimage.gaussian_filter(rng.normal(size=scene.shape), 25) * 25
    noisy = (scene[:, step_px * k : step_px * k + W] + rng.normal(scale=1.5, size=(H, W)) for k in range(n))
    return [np.clip(p, 0, 255).astype(np.uint8) for p in noisy]


def joined(a: Pictures, b: Pictures, edit: Edit) -> Pictures:
    n = edit.n_frames
    mixed = []
    for k in range(n):
        pair = [np.dstack([p] * 3) for p in (a[len(a) - n + k], b[k])]
        mixed.append(blend(edit, (k + 1) / (n + 1), *pair)[..., 0])
    return a[: len(a) - n] + mixed + b[n:]


def found(pictures: Pictures, step_px: float = 3.0) -> list[EditFound]:
    finder = EditFinder((W, H))
    motion = np.eye(3)
    motion[0, 2] = -step_px
    edits = []
    for k, picture in enumerate(pictures):
        edit = finder.push(k, edit_picture(picture), motion if k else None)
        if edit is not None:
            finder.begin(edit.first)
            edits.append(edit)
    return edits


def test_a_cut_is_found_to_the_frame() -> None:
    edits = found(joined(view(1, 40), view(2, 40), Edit()))
    assert [(e.last, e.first, e.kind) for e in edits] == [(39, 40, "cut")]


def test_a_shot_of_fourteen_frames_has_both_its_cuts() -> None:
    edits = found(view(1, 40) + view(2, 14) + view(3, 40))
    assert [(e.last, e.first) for e in edits] == [(39, 40), (53, 54)]


@pytest.mark.parametrize("n", [6, 20, 50])
@pytest.mark.parametrize("kind", ["dissolve", "wipe", "iris"])
def test_a_gradual_edit_is_found_where_it_is(kind: str, n: int) -> None:
    edits = found(joined(view(1, 40 + n, 1), view(2, 60 + n, 1), Edit(kind=kind, n_frames=n)), 1.0)
    first, last = 40, 40 + n - 1
    assert len(edits) == 1
    # Most of the mixed frames lie within, and not much beside them.
    covered = set(range(edits[0].last + 1, edits[0].first))
    assert len(covered & set(range(first, last + 1))) >= 0.6 * n
    assert len(covered) <= 1.7 * n + 4


def test_a_fade_is_named() -> None:
    edits = found(joined(view(1, 60), view(2, 60), Edit(kind="fade", n_frames=20)))
    assert [e.kind for e in edits] == ["fade"]
    assert abs(edits[0].last + 1 - 40) <= 2 and abs(edits[0].first - 60) <= 2


def test_black_is_like_nothing_and_warns_of_nothing() -> None:
    dark = [np.full((H, W), 16, np.uint8)] * 20
    rising = [(16 + (p - 16.0) * k / 15).astype(np.uint8) for k, p in enumerate(view(1, 15))]
    found([*dark, *rising, *view(1, 40)])  # warnings are failures
    found([*view(1, 40), *dark, *view(2, 40)])


def test_flashes_cut_nothing() -> None:
    pictures = view(1, 90)
    for k in (30, 31, 60):
        pictures[k] = np.clip(pictures[k] * 1.9 + 60, 0, 255).astype(np.uint8)
    assert found(pictures) == []


@pytest.mark.parametrize("step_px", [3.0, 0.0])
def test_a_pan_is_no_edit_even_where_its_motion_is_not_known(step_px: float) -> None:
    """Without the motion two pictures have nothing in common after a while, but the old view never gave way at once."""
    assert found(view(1, 100), step_px) == []


def crowded(seed: int, n: int) -> Pictures:
    """A slow pan behind seven players, each a quarter of the picture high and more, who run through it."""
    rng = np.random.default_rng(seed)
    looks = [ndimage.zoom(rng.uniform(0, 255, (14, 7)), 8, order=1) for _ in range(7)]
    left, top, speed = rng.uniform(-20, W - 40, 7), rng.uniform(20, 60, 7), rng.normal(0, 3, 7)
    pictures = view(seed, n, 1)
    for k, picture in enumerate(pictures):
        for i, look in enumerate(looks):
            x = int(left[i] + speed[i] * k + 10 * np.sin(0.15 * k + i))
            y = int(top[i] + 6 * np.sin(0.3 * k + 2 * i))
            if not -look.shape[1] < x < W:
                continue
            seen = look[: H - y, max(0, -x) : W - x]
            picture[y : y + seen.shape[0], max(0, x) : max(0, x) + seen.shape[1]] = seen
    return pictures


@pytest.mark.parametrize("seed", range(4))
def test_a_dissolve_loses_contrast_and_players_who_fill_the_picture_do_not(seed: int) -> None:
    left = {}
    dissolve = joined(view(seed, 50), view(seed + 10, 50), Edit(kind="dissolve", n_frames=20))
    for name, pictures in (("dissolve", dissolve), ("players", crowded(seed, 80))):
        finder = EditFinder((W, H))
        for k, picture in enumerate(pictures):
            finder.push(k, edit_picture(picture), None)
        left[name] = finder._contrast_left(29, 50)
    assert left["dissolve"] < MIXED_CONTRAST - 0.03 and left["players"] > MIXED_CONTRAST + 0.03


@pytest.mark.slow
def test_a_programme_comes_out_in_its_shots(tmp_path: Path) -> None:
    shots = tuple(pan_spec(seed, 60, pan_deg=8.0) for seed in (4, 5, 6, 7))
    edits = (Edit(), Edit(kind="dissolve", n_frames=15), Edit(kind="stinger", n_frames=25))
    programme = Programme(shots=shots, edits=edits)
    truth = write_programme(tmp_path / "programme.mp4", programme)
    with open_clip(tmp_path / "programme.mp4") as clip:
        listed = look_at(clip, Config(), seconds=None)["shots"]["list"]
    spans = [(s["first_frame"], s["last_frame"]) for s in listed]
    assert len(spans) == 4
    hit, missed, wrong = matched(spans, truth)
    assert len(hit) == 3 and missed == [] and wrong == []
    taken, mixed = inside(spans, truth)
    assert taken <= 0.35 * mixed
