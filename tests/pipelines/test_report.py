"""report.html from made-up records: what it says, that it is one whole offline page, and that it stays small."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.records import FRAME_STATUSES, CameraTable, RunRecord
from pipelines.report import words
from pipelines.report.build import write_report
from pipelines.report.pictures import MAX_SIDE_PX, data_uri, panoramas, thumbnail_uris
from pipelines.report.series import CURVES, drawn_rows, runs, series_json
from tests.pipelines.fake_run import fake_run, fake_table, fake_thumbnails, write_fake_panorama


class Page(HTMLParser):
    """Tags with attributes, the text outside scripts, and the JSON block of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.block = ""
        self._inside = ""
        self._glued = False
        self.feed(text)
        self.data: dict[str, Any] = json.loads(
            self.block, parse_constant=lambda name: pytest.fail(f"{name} in JSON")
        )
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "wbr":  # a place to break a line at, not a gap between words
            self._glued = True
        if tag in {"script", "style"}:
            self._inside = "data" if dict(attrs).get("id") == "data" else "code"

    def handle_endtag(self, tag: str) -> None:
        if tag in {"script", "style"}:
            self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "data":
            self.block += data
        elif not self._inside and self._glued:
            self.words[-1] += data
            self._glued = False
        elif not self._inside:
            self.words.append(data)


def build(out: Path, run: RunRecord, table: CameraTable, **kwargs: Any) -> Page:
    return Page(write_report(out, run, table, **kwargs).read_text(encoding="utf-8"))


def emptied(table: CameraTable) -> CameraTable:
    """The same rows with every measurement missing."""
    columns: dict[str, Any] = {
        column.name: np.full_like(value, np.nan)
        for column in dataclasses.fields(table)
        if isinstance(value := getattr(table, column.name), np.ndarray) and value.dtype == np.float64
    }
    return dataclasses.replace(
        table, status=("lost",) * len(table), reason=("no_texture",) * len(table), **columns
    )


def test_summary_says_range_error_and_cure_in_words(tmp_path: Path) -> None:
    table = fake_table()
    page = build(tmp_path, fake_run(table), table)
    low = int(np.nanargmin(table.f_px))
    assert f"{table.f_px[low]:.0f} ± {table.f_std_px[low]:.0f} px" in page.text
    assert "the camera zooms but does not pan" in page.text
    assert "Would help: a shot that also pans, or a known focal length as a prior" in page.text
    assert "3 frames could not be decoded." in page.text
    assert "zoom ×1.7" in page.text


def test_a_bridged_frame_of_a_relative_shot_has_no_camera(tmp_path: Path) -> None:
    table = fake_table()
    status = list(table.status)
    status[-1] = "interpolated"  # shot 1 is relative: no focal length in it
    table = dataclasses.replace(
        table, status=tuple(status), f_px=np.where(table.frame == 7, table.f_px, np.nan)
    )
    page = build(tmp_path, fake_run(table), table)
    assert "1 frame (0.2 %) has a calibrated camera; 376 frames with zoom and motion only" in page.text


def test_each_status_of_the_run_is_named_signed_and_patterned(tmp_path: Path) -> None:
    table = fake_table()
    page = build(tmp_path, fake_run(table), table)
    assert {s for s in table.status} == set(FRAME_STATUSES), "the fake run must show every status"
    swatches = [
        attrs["data-status"] for tag, attrs in page.tags if tag == "canvas" and "data-status" in attrs
    ]
    assert swatches == list(FRAME_STATUSES)
    assert all(sign in page.text and meaning in page.text for sign, meaning in words.STATUS_SIGNS.values())
    assert len({sign for sign, _ in words.STATUS_SIGNS.values()}) == len(FRAME_STATUSES)


def test_calibration_verdict_timings_and_configuration_are_stated(tmp_path: Path) -> None:
    table = fake_table()
    text = build(tmp_path, fake_run(table), table).text
    for fact in ("1.92 %", "1.53 %", "sigma_parts.systematic_px 0.21 ", "0.87", "2.61",
                 "No focal length is claimed", "gates.chi2_dof_max 6",
                 "gates.known_focal not known", "11.70 s", "equirectangular", "2.13.0"):  # fmt: skip
        assert fact in text, fact


def test_verdict_is_said_in_words_before_its_raw_numbers(tmp_path: Path) -> None:
    """As run.json has them: what the error is made of, the evidence against what is shared, the lens in per cent."""
    table = fake_table()
    run = fake_run(table)
    facts = {
        "sigma_relative": 0.0403, "s10_px": 0.336, "chi2_dof": 1.006, "rotation_deg": 40.48, "support_rows": 5,
        "sigma_parts": {"cluster": 0.0045, "signal": 0.0393, "halves": 0.0078, "constant_k": 0.0, "pupil": 0.0,
                        "systematic_px": 0.132, "constant_k_difference": -0.044},
        "lens": {"pp_px": [641.2, 321.9], "aspect": 1.0, "k1_half_c0": 0.04, "k1_half_c1": 0.0,
                 "std": {"pp_x": 0.3, "pp_y": None}},
        "level": {"observable": False, "sentence": "The pan axis is not known.", "tilt0_deg": None},
        "rolling_shutter": {"found": True, "share_of_frame": 0.4, "first_row_px": 2.6},
        "flags": ["aspect_assumed"], "keyframes": [0, 9, 20], "keyframe_pairs": 3, "keyframe_pairs_usable": 2,
    }  # fmt: skip
    shots = (dataclasses.replace(run.shots[0], calibration=facts), run.shots[1])
    text = build(tmp_path, dataclasses.replace(run, shots=shots), table).text
    said = text[text.index("error of the focal length") : text.index("by their names in run.json")]
    for words_ in (
        "4.03 % one sigma, made of errors that all pairs share, such as lens model and parallax: 3.9 %; halves",
        "noise, from pair to pair: 0.45 %", "0.336 px by how much", "may be 0.13 px", "40.5°", "5 of 5",
        "3 keyframes, 2 of 3 pairs", "641.2 ± 0.30, 321.9 px", "+4.0 %", "The pan axis is not known.",
        "40 % of the time between pictures", "the file's, not measured",
    ):  # fmt: skip
        assert words_ in said, words_
    assert "another lens model" not in said, "a part that is nothing is not named"
    assert "nan" not in said.lower() and "None" not in said


def test_a_shot_that_claims_nothing_says_what_its_error_would_be_and_why_it_has_no_panorama(
    tmp_path: Path,
) -> None:
    table = fake_table()
    run = fake_run(table)
    for sigma, said in ((0.14, "14.0 % one sigma"), (12.5, "above 100 % nothing is known of it")):
        lost = dataclasses.replace(
            run.shots[1], calibration={"claims_focal": False, "sigma_relative": sigma},
            warnings=("no panorama: the pictures do not hang together", "a gap of 3 frames"),
        )  # fmt: skip
        text = build(tmp_path, dataclasses.replace(run, shots=(run.shots[0], lost)), table).text
        assert f"error that a focal length would have {said}" in text
        assert "No panorama: the pictures do not hang together." in text
        assert text.count("do not hang together") == 1 and "a gap of 3 frames" in text


def test_tiles_of_a_deep_zoom_panorama_are_one_line(tmp_path: Path) -> None:
    table = fake_table()
    run = fake_run(table)
    tiles = tuple(f"shot-000/panorama_files/9/{n}_0.jpg" for n in range(300))
    shots = (dataclasses.replace(run.shots[0], files=("shot-000/pairs.npz", *tiles)), run.shots[1])
    text = build(tmp_path, dataclasses.replace(run, shots=shots), table).text
    assert "shot-000/panorama_files/ (300 files)" in text and "7_0.jpg" not in text


def test_page_asks_nobody_for_anything(tmp_path: Path) -> None:
    table = fake_table()
    write_fake_panorama(tmp_path)
    page = build(tmp_path, fake_run(table), table, thumbnails=fake_thumbnails(table))
    loaded = [
        attrs[key]
        for tag, attrs in page.tags
        for key in ("src", "srcset", "data", "poster")
        if attrs.get(key)
    ]
    loaded += [attrs["href"] for tag, attrs in page.tags if tag == "link"]
    assert loaded and all(address and address.startswith("data:") for address in loaded)
    links = [attrs.get("href") or "" for tag, attrs in page.tags if tag == "a"]
    assert "camera.csv" in links and "shot-000/panorama.jpg" in links
    assert [link for link in links if re.match(r"[a-z]+:|//", link)] == []
    policy = next(
        a["content"] for t, a in page.tags if t == "meta" and a.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy and policy.startswith("default-src 'none'; img-src data:;")
    css = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"@import|url\(\s*['\"]?(?!data:)", css) == []


@pytest.mark.parametrize(
    "nasty", ["<script>alert(1)</script>", "</script><b>x", '"><img src=x onerror=y>', "<!--", "\u2028"]
)
def test_names_from_outside_stay_text(tmp_path: Path, nasty: str) -> None:
    table = fake_table(60)
    plain = build(tmp_path, fake_run(table), table)
    reasons = tuple(f"odd{nasty}" if word == "lost" else "" for word in table.status)
    hostile = dataclasses.replace(table, reason=reasons, timecode=(nasty,) * 60)
    run = fake_run(table, clip_path=f"a{nasty}b.mp4")
    run = dataclasses.replace(run, config={nasty: nasty}, warnings=(nasty,))
    page = build(tmp_path, run, hostile)
    names = [tag for tag, _ in page.tags]
    assert names.count("script") == [tag for tag, _ in plain.tags].count("script")
    assert "b" not in names and not any("onerror" in attrs for _, attrs in page.tags)
    assert page.data["timecode"][0] == nasty
    assert any(reason.endswith(nasty) for reason in page.data["reasons"])
    title = re.search(r"<title>(.*?)</title>", (tmp_path / "report.html").read_text(encoding="utf-8"), re.S)
    assert title and "<" not in title[1]


def test_json_block_has_null_for_empty_cells_and_keeps_values(tmp_path: Path) -> None:
    table = fake_table()
    data = build(tmp_path, fake_run(table), table).data
    assert data["frame"] == table.frame.tolist()
    for name in CURVES:
        got = np.array([np.nan if v is None else v for v in data["columns"][name]])
        np.testing.assert_allclose(got, getattr(table, name), rtol=1e-6)
        assert np.isnan(got).any()


def test_run_without_any_measurement_claims_nothing(tmp_path: Path) -> None:
    table = emptied(fake_table(50))
    run = fake_run(fake_table(50))
    shots = tuple(
        dataclasses.replace(
            shot, status="failed", reason="no_texture", sentence="", focal=None, calibration={}
        )
        for shot in run.shots
    )
    page = build(tmp_path, dataclasses.replace(run, shots=shots, complete=False), table)
    assert "0 frames (0.0 %) have a calibrated camera; 50 frames lost." in page.text
    assert "Nothing measured." in page.text and "± " not in page.text
    # All of it failed, and nothing was interrupted: a report is written at a run's end.
    assert "2 of 2 shots failed (0, 1): their frames have no camera." in page.text
    assert "interrupted" not in page.text
    assert all(value is None for name in CURVES for value in page.data["columns"][name])


def test_clip_without_frames_or_shots_still_gives_a_page(tmp_path: Path) -> None:
    full = fake_table(10)
    empty = CameraTable(**{c.name: getattr(full, c.name)[:0] for c in dataclasses.fields(full)})
    run = RunRecord(versions={}, config={}, clip={}, shots=(), timings_s={})
    text = build(tmp_path, run, empty).text
    assert "Nothing could be measured." in text and "No shot was found" in text


def test_100_000_frames_stay_small_with_extremes_and_gaps(tmp_path: Path) -> None:
    table = fake_table(100_000)
    residual = table.residual_px.copy()
    residual[71_234] = 9.5  # one frame in 100 000
    residual[12_345] = np.nan
    table = dataclasses.replace(table, residual_px=residual)
    write_fake_panorama(tmp_path, (9000, 2000))
    path = write_report(tmp_path, fake_run(table), table, fake_thumbnails(table, 500))
    assert path.stat().st_size < 15e6
    rows = drawn_rows(table)
    assert len(rows) <= 20_000 and (np.diff(rows) > 0).all()
    for name in CURVES:
        column = getattr(table, name)
        assert np.nanmax(column[rows]) == np.nanmax(column) and np.nanmin(column[rows]) == np.nanmin(column)
    assert {71_234, 12_344, 12_345, 12_346} <= set(rows.tolist())


def test_table_that_changes_at_every_frame_stays_within_the_points() -> None:
    table = fake_table(30_000)
    flicker = dataclasses.replace(table, status=tuple("ok" if i % 2 else "lost" for i in range(30_000)))
    rows = drawn_rows(flicker)
    assert 10_000 < len(rows) <= 20_000
    assert len(runs(flicker)) == 30_000, "the strip is never thinned"


def test_status_strip_is_exact() -> None:
    table = fake_table(500)
    data = series_json(table, max_points=60)
    assert len(data["row"]) <= 60
    status = [data["statuses"][word] for _, n, word, _, _ in data["runs"] for _ in range(n)]
    reason = [data["reasons"][code] for _, n, _, code, _ in data["runs"] for _ in range(n)]
    shot = [shot for _, n, _, _, shot in data["runs"] for _ in range(n)]
    assert (tuple(status), tuple(reason), shot) == (table.status, table.reason, table.shot.tolist())


def test_panorama_is_scaled_with_its_outlines(tmp_path: Path) -> None:
    table = fake_table()
    path = write_fake_panorama(tmp_path, (8192, 1843))
    run = fake_run(table)
    entry = panoramas(tmp_path, run.shots)[0]
    assert entry["size_px"] == [MAX_SIDE_PX, round(1843 * MAX_SIDE_PX / 8192)]
    given = (run.shots[0].panorama or {})["outlines"]
    frame = sorted(given)[3]
    # Outlines are in pixels of the 4000 x 900 panorama that the record states, pixel centres at whole numbers.
    scale = np.array(entry["size_px"]) / [4000, 900]
    np.testing.assert_allclose(
        entry["outlines"][str(frame)], (np.array(given[frame]) + 0.5) * scale, atol=0.051
    )
    with Image.open(path) as own:
        assert own.size == (8192, 1843), "the run's own file is left as it is"


@pytest.mark.parametrize("spoil", ["missing", "damaged"])
def test_panorama_that_cannot_be_had_is_a_sentence(tmp_path: Path, spoil: str) -> None:
    table = fake_table(60)
    if spoil == "damaged":
        write_fake_panorama(tmp_path).write_bytes(b"\xff\xd8\xff no picture")
    text = build(tmp_path, fake_run(table), table).text
    assert (
        "panorama.jpg cannot be read" if spoil == "damaged" else "no panorama was written for this shot"
    ) in text


def test_many_large_panoramas_share_the_bytes(tmp_path: Path) -> None:
    """Noise is what JPEG packs worst: four of 2400 x 1000 do not fit at full size."""
    run = fake_run(fake_table(60))
    noise = np.random.default_rng(1).integers(0, 255, (1000, 2400, 3), np.uint8)
    shots = tuple(dataclasses.replace(run.shots[0], index=i, files=()) for i in range(4))
    for i in range(4):
        folder = tmp_path / f"shot-{i:03d}"
        folder.mkdir()
        Image.fromarray(noise).save(folder / "panorama.jpg", quality=70)
    entries = panoramas(tmp_path, shots)
    assert sum(len(entry["uri"]) for entry in entries.values()) < 5e6 * 4 / 3 + 300
    sizes = {tuple(entry["size_px"]) for entry in entries.values()}
    assert len(sizes) == 1 and 500 < min(sizes)[0] < 2400


def test_incomplete_outlines_are_left_out(tmp_path: Path) -> None:
    table = fake_table(60)
    write_fake_panorama(tmp_path)
    run = fake_run(table)
    outlines = {
        "0": [[0, 0], [9, 0], [9, 9]],
        "1": [[0, 0], None, [9, 9], [0, 9]],
        "2": None,
        "10": [[float("nan"), 0]] * 4,
    }
    panorama = dict(run.shots[0].panorama or {}) | {"outlines": outlines}
    shot = dataclasses.replace(run.shots[0], panorama=panorama)
    assert list(panoramas(tmp_path, (shot,))[0]["outlines"]) == ["0"]


def test_thumbnails_are_thinned_to_their_share() -> None:
    picture = b"\xff\xd8\xff" + bytes(20_000)
    kept = thumbnail_uris({frame: picture for frame in range(0, 10_000, 50)})
    assert 20 <= len(kept) <= 50 and min(kept) == 0


def test_thumbnail_that_is_no_picture_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="neither JPEG, PNG nor WebP"):
        data_uri(b"<svg onload=x>")


def test_failed_write_leaves_the_earlier_report(tmp_path: Path) -> None:
    table = fake_table(60)
    before = write_report(tmp_path, fake_run(table), table).read_bytes()
    broken = dataclasses.replace(fake_run(table), timings_s={"decode": None})  # type: ignore[dict-item]
    with pytest.raises(TypeError):
        write_report(tmp_path, broken, table)
    assert (tmp_path / "report.html").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_same_records_give_the_same_bytes(tmp_path: Path) -> None:
    table = fake_table(60)
    first = write_report(tmp_path, fake_run(table), table).read_bytes()
    assert write_report(tmp_path, fake_run(table), table).read_bytes() == first


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0, 3, "0"), (1234.5, 3, "1234"), (0.01234, 3, "0.0123"), (-2.5, 2, "−2.5"), (float("nan"), 3, "not known"),
     (1e-12, 3, "1.00e-12")],
)  # fmt: skip
def test_numbers_are_written_for_people(value: float, digits: int, text: str) -> None:
    assert words.number(value, digits) == text


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_browser_draws_the_page_and_the_keys_move_the_cursor(tmp_path: Path) -> None:
    """Opened in a headless browser: every curve is drawn, the arrow key moves slider, words and outline."""
    table = fake_table(200)
    write_fake_panorama(tmp_path)
    path = write_report(tmp_path, fake_run(table), table, fake_thumbnails(table))
    probe = """<script>
      const press = (key, shiftKey) =>
        document.body.dispatchEvent(new KeyboardEvent("keydown", { key, shiftKey, bubbles: true }));
      const before = document.querySelector(".pano .now").getAttribute("points");
      press("ArrowRight", true); press("ArrowRight", false); press("ArrowRight", true);
      const d = document.documentElement.dataset;
      d.slider = document.getElementById("slider").value;
      d.moved = before !== document.querySelector(".pano .now").getAttribute("points");
      d.drawn = [...document.querySelectorAll(".uplot canvas, #strip")].every((c) =>
        c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some((v) => v));
      d.wide = document.documentElement.scrollWidth > window.innerWidth;
    </script></body>"""
    page = tmp_path / "probe.html"
    page.write_text(path.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    flags = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    )
    dom = subprocess.run(
        ["chromium", *flags.split(), f"--user-data-dir={tmp_path / 'profile'}", "--window-size=390,900",
         "--virtual-time-budget=3000", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    found = dict(re.findall(r'data-(\w+)="([^"]*)"', dom[: dom.index("<head>")]))
    assert found == {
        "rows": "200",
        "ready": "6",
        "slider": "21",
        "moved": "true",
        "drawn": "true",
        "wide": "false",
    }
    assert 'aria-valuetext="frame 21, 0.840 s, ' in dom
