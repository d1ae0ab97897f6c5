"""Graphics fixed on the screen are found while a texture moves under them, and only then."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from pipelines.config import OverlayOptions
from pipelines.errors import ConfigError
from pipelines.overlays import OverlayFinder

W, H = 480, 272
BOARD = (slice(20, 52), slice(24, 120))
LOGO = (slice(24, 56), slice(390, 440))


def world(rng: np.random.Generator) -> NDArray[np.float64]:
    """Wide scene: coarse and fine texture above, nearly flat grass below, a level edge that a pan never moves."""
    noise = rng.normal(size=(H, 3 * W))
    texture = 60 * ndimage.gaussian_filter(noise, 3) * 6 + 15 * ndimage.gaussian_filter(noise, 1) * 3
    scene = 110 + texture
    scene[H // 2 :] = 90 + 0.05 * texture[H // 2 :]
    scene[H // 2 - 6 : H // 2 - 2] = 200
    return scene


def letters(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Strokes of 6 px, half of the cells on."""
    cells = rng.random((shape[0] // 6 + 1, shape[1] // 6 + 1)) > 0.5
    return np.kron(cells, np.ones((6, 6)))[: shape[0], : shape[1]]


def frames(
    n: int, step_px: float, *, graphics: bool = True, bars: int = 0, seed: int = 1
) -> Iterator[NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    scene = world(rng)
    board = 40 + 180 * letters(rng, (32, 96))
    logo = letters(rng, (32, 50)) > 0
    for i in range(n):
        start = round(i * step_px) % (2 * W)
        picture = scene[:, start : start + W].copy()
        if graphics:
            picture[BOARD] = board
            picture[BOARD][10:22, 40:58] = 40 + 180 * letters(np.random.default_rng(i), (12, 18))  # a clock
            under = picture[LOGO]
            picture[LOGO] = np.where(logo, 0.5 * under + 0.5 * 235, under)
        picture += rng.normal(scale=2, size=picture.shape)
        if bars:
            picture[:bars] = picture[-bars:] = 16 + rng.normal(scale=1, size=(bars, W))
        yield np.clip(picture, 0, 255).astype(np.uint8)


def find(n: int, step_px: float, **kinds: object) -> OverlayFinder:
    finder = OverlayFinder((W, H))
    for i, picture in enumerate(frames(n, step_px, **kinds)):  # type: ignore[arg-type]
        finder.update(picture, step_px if i else float("nan"))
    return finder


def test_opaque_board_and_half_transparent_logo_are_masked_and_little_else() -> None:
    finder = find(60, 24.0)
    usable = finder.mask()
    assert usable is not None and usable.shape == (H, W) and usable.dtype == bool
    assert (~usable[BOARD]).mean() >= 0.95
    assert (~usable[LOGO]).mean() >= 0.90
    elsewhere = np.ones((H, W), bool)
    for rows, columns in (BOARD, LOGO):  # a frame of 8 px around them may go: dilation and the quarter size
        elsewhere[rows.start - 8 : rows.stop + 8, columns.start - 8 : columns.stop + 8] = False
    assert (~usable[elsewhere]).mean() <= 0.005
    facts = finder.facts()
    assert len(facts["graphics"]) == 2 and facts["reason"] == ""


def test_a_moving_scene_without_graphics_has_no_mask() -> None:
    finder = find(60, 24.0, graphics=False)
    assert finder.mask() is None
    assert finder.facts()["graphics"] == []


@pytest.mark.parametrize("step_px", [0.0, 0.3])
def test_a_resting_camera_says_nothing_however_long(step_px: float) -> None:
    finder = find(150, step_px)
    assert finder.mask() is None and finder.facts()["reason"] == "camera_moved_too_little"


def test_frames_with_unknown_motion_count_as_rest() -> None:
    finder = OverlayFinder((W, H))
    for picture in frames(30, 24.0):
        finder.update(picture, float("nan"))
    assert finder.n_samples == 1


def test_nothing_is_said_before_enough_samples() -> None:
    assert find(11, 24.0).mask() is None
    assert find(16, 24.0).mask() is not None


def test_letterbox_rows_are_exact_and_need_no_motion() -> None:
    finder = find(60, 0.0, bars=34)
    assert finder.facts()["bars"] == {"top": 34, "bottom": 34, "left": 0, "right": 0}
    usable = finder.mask()
    assert usable is not None and not usable[:35].any() and not usable[-35:].any() and usable[40:-40].all()


def test_a_dark_picture_is_not_all_letterbox() -> None:
    finder = OverlayFinder((W, H))
    for _ in range(60):
        finder.update(np.full((H, W), 17, np.uint8), 5.0)
    assert finder.mask() is None and finder.facts()["bars"] == {}


def test_a_board_that_goes_away_is_let_go() -> None:
    finder = find(40, 24.0)
    assert finder.mask() is not None
    for picture in frames(200, 24.0, graphics=False, seed=2):
        finder.update(picture, 24.0)
    assert finder.mask() is None


def test_switched_off_it_stays_silent() -> None:
    finder = OverlayFinder((W, H), OverlayOptions(enabled=False))
    for picture in frames(30, 24.0):
        finder.update(picture, 24.0)
    assert finder.mask() is None and finder.facts()["enabled"] is False


def test_float_frames_and_odd_sizes() -> None:
    finder = OverlayFinder((W - 3, H - 1))
    for picture in frames(30, 24.0):
        finder.update(picture[:-1, :-3].astype(np.float32), 24.0)
    usable = finder.mask()
    assert usable is not None and usable.shape == (H - 1, W - 3) and not usable[36, 60]
    with pytest.raises(ValueError, match="480x272"):
        finder.update(np.zeros((H, W), np.uint8), 1.0)


def test_a_mask_file_is_taken_instead_of_what_would_be_found(tmp_path: Path) -> None:
    picture = np.full((H, W), 255, np.uint8)
    picture[100:140, 200:300] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), picture)
    finder = OverlayFinder((W, H), OverlayOptions(mask_file=str(tmp_path / "mask.png")))
    for moving in frames(30, 24.0):
        finder.update(moving, 24.0)
    usable = finder.mask()
    assert usable is not None
    np.testing.assert_array_equal(usable, picture > 0)
    facts = finder.facts()
    assert facts["graphics"] == [{"x": 200, "y": 100, "w": 100, "h": 40}] and facts["mask_file"].endswith(
        "mask.png"
    )


@pytest.mark.parametrize("kind", ["missing", "size", "black", "pipe"])
def test_a_mask_file_that_cannot_be_meant_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "mask.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind != "missing":
        value = 0 if kind == "black" else 255
        cv2.imwrite(str(path), np.full((H, W if kind == "black" else W - 2), value, np.uint8))
    with pytest.raises(ConfigError, match=r"mask\.png"):
        OverlayFinder((W, H), OverlayOptions(mask_file=str(path)))
