"""The report's small pictures: in colour, even in time, upright in shape, of frames that go by anyway."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from pipelines.film import NAME, PICTURES, WIDTH_PX, chosen, filmed, read_film, write_film
from pipelines.report.build import write_report
from tests.pipelines.fake_run import fake_run, fake_table, fake_thumbnails

RED = (200, 40, 30)


def opened(jpeg: bytes) -> Image.Image:
    return Image.open(io.BytesIO(jpeg))


def frame_of(index: int, size: tuple[int, int] = (320, 176), pixel_aspect: float = 1.0) -> Any:
    return SimpleNamespace(
        index=index, pixel_aspect=pixel_aspect, picture=lambda: np.full((size[1], size[0], 3), RED, np.uint8)
    )


def film_of(frames: list[int], wanted: set[int], **kind: Any) -> dict[int, bytes]:
    film: dict[int, bytes] = {}
    passed = [f.index for f in filmed((frame_of(i, **kind) for i in frames), wanted, film)]
    assert passed == frames, "every frame goes on"
    return film


def test_pictures_are_in_colour_and_even_over_the_shot() -> None:
    frames = list(range(100, 1100))
    film = film_of(frames, chosen(frames))
    shown = sorted(film)
    assert (shown[0], shown[-1], len(shown)) == (100, 1099, PICTURES)
    assert np.ptp(np.diff(shown)) <= 1
    picture = opened(film[100])
    assert picture.size == (WIDTH_PX, 88)
    assert np.abs(np.asarray(picture, float).mean((0, 1)) - RED).max() < 4
    assert chosen([7, 8]) == {7, 8} and chosen([]) == set()


def test_pixels_of_an_anamorphic_clip_are_made_square() -> None:
    film = film_of([3], {3}, size=(720, 576), pixel_aspect=64 / 45)
    assert opened(film[3]).size == (WIDTH_PX, 90)  # 16 : 9


def test_what_is_written_is_read_and_damage_is_no_film(tmp_path: Path) -> None:
    film = {4: b"\xff\xd8\xffone", 9: b"\xff\xd8\xfflonger"}
    write_film(tmp_path / NAME, film)
    assert read_film(tmp_path / NAME) == film
    assert read_film(tmp_path / "none.npz") == {}
    for damage in (b"", b"PK no archive"):
        (tmp_path / NAME).write_bytes(damage)
        assert read_film(tmp_path / NAME) == {}
    write_film(tmp_path / "empty.npz", {})
    assert not (tmp_path / "empty.npz").exists()


def test_the_report_prefers_a_shots_film_to_gray_pictures(tmp_path: Path) -> None:
    table = fake_table(200)
    run = fake_run(table)
    film = film_of([0, 50, 100], {0, 50, 100})
    (tmp_path / "shot-000").mkdir()
    write_film(tmp_path / "shot-000" / NAME, film)
    gray = fake_thumbnails(table, 25)
    page = write_report(tmp_path, run, table, gray).read_text(encoding="utf-8")
    block = re.search(r'id="data">(.*?)</script>', page, re.S)
    assert block is not None
    shown = {int(frame) for frame in json.loads(block[1])["thumbnails"]}
    first = run.shots[1].first_frame
    assert shown == {0, 50, 100} | {
        frame for frame in gray if frame >= first or frame > run.shots[0].last_frame
    }
