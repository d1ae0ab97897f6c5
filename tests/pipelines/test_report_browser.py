"""report.html in a headless browser: hover, keyboard, zoom, phone, dark, paper; 100,000 frames; no request leaves it.

Which part follows which: curve, status strip, film strip, panorama and slider each move all the others.
"""

from __future__ import annotations

import base64
import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.report.build import write_report
from pipelines.report.graph import registration_graph
from tests.pipelines.browser import Browser, Page, chromium
from tests.pipelines.fake_run import fake_run, fake_table, fake_thumbnails, write_fake_panorama

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(chromium() is None, reason="chromium is not installed"),
]
N = 200
PHONE = {"size": (390, 844), "mobile": True}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as started:
        yield started


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A report of 200 made-up frames: shot 0 with a panorama, shot 1 relative."""
    out = tmp_path_factory.mktemp("report")
    table = fake_table(N)
    write_fake_panorama(out)
    keys = np.arange(0, 110, 10)
    pairs = [(a, b) for i, a in enumerate(keys) for b in keys[i + 1 : i + 3]]
    status = ["ok", "weak", "failed"] * len(pairs)
    np.savez(out / "shot-000" / "pairs.npz", src=[p[0] for p in pairs], dst=[p[1] for p in pairs],
             status=np.array(status[: len(pairs)]))  # fmt: skip
    run = fake_run(table)
    run.shots[0].calibration["keyframes"] = keys.tolist()  # type: ignore[index]
    return write_report(out, run, table, fake_thumbnails(table, 10)).as_uri()


def state(page: Page) -> dict[str, Any]:
    """What each part says of the frame at the cursor."""
    return page.evaluate(
        """(() => { const one = (q) => document.querySelector(q);
        const film = one("#film img.now");
        return { slider: +one("#slider").value, words: one("#readout").textContent,
                 outline: one(".pano .now").getAttribute("points"), film: film ? +film.dataset.frame : null,
                 focal: one(".chart .value").textContent,
                 line: parseFloat(one(".u-cursor-x").style.transform.slice(10)) }; })()"""
    )


def test_every_part_moves_all_the_others(browser: Browser, report: str) -> None:
    page = browser.open(report)
    seen = [state(page)]
    for selector, across, expected in (
        (".chart .u-over", 0.25, 0.25 * (N - 1)),
        ("#strip", 0.5, 0.5 * (N - 1)),
        ("#film", 0.35, 0.35 * (N - 1)),
        (".chart:nth-of-type(4) .u-over", 0.1, 0.1 * (N - 1)),
    ):
        page.hover(selector, across)
        now = state(page)
        # The strips have a margin of 70 px of 1140 beside the plot.
        assert abs(now["slider"] - expected) < 10, selector
        assert f"frame {now['slider']}" in now["words"]
        assert now["film"] is not None and abs(now["film"] - now["slider"]) <= 20
        assert all(now[key] != seen[-1][key] for key in ("slider", "words", "outline", "line")), selector
        seen.append(now)
    assert page.errors == []


def test_the_panorama_finds_the_frame_that_looks_there(browser: Browser, report: str) -> None:
    page = browser.open(report)
    found = []
    for across in (0.2, 0.35, 0.5):
        page.hover(".pano", across)
        now = state(page)
        found.append(now["slider"])
        # The outline that is drawn holds the point.
        corners = np.array([[float(v) for v in p.split(",")] for p in now["outline"].split(" ")])
        width = page.evaluate("document.querySelector('.pano svg').viewBox.baseVal.width")
        assert corners[:, 0].min() < across * width < corners[:, 0].max()
        assert f"frame {now['slider']}" in now["words"]
    # The fake camera pans to the right: further right is later.
    assert found == sorted(found) and len(set(found)) == 3


def test_a_frame_without_a_camera_has_no_outline(browser: Browser, report: str) -> None:
    page = browser.open(report)
    page.hover("#strip", (56 + 0.315 * 1070) / 1140)  # fake_table: lost from 30 to 33 %
    now = state(page)
    assert "lost" in now["words"] and now["outline"] == ""
    page.hover("#strip", (56 + 0.2 * 1070) / 1140)
    assert state(page)["outline"] != ""


def test_keys_step_and_the_slider_can_be_focused(browser: Browser, report: str) -> None:
    page = browser.open(report)
    start = state(page)["slider"]
    for key, shift, step in (("ArrowRight", False, 1), ("ArrowRight", True, 10), ("ArrowLeft", False, -1)):
        before = state(page)["slider"]
        page.press(key, shift=shift)
        assert state(page)["slider"] == before + step
    page.press("End")
    assert state(page)["slider"] == N - 1 and "shot 1" in state(page)["words"]
    page.press("Home")
    assert state(page)["slider"] == start == 0
    # Tab reaches, in this order: the skip link, the files, the table of shots, ..., the slider.
    stops = []
    for _ in range(40):
        page.press("Tab")
        stops.append(page.evaluate("document.activeElement.id || document.activeElement.className"))
        if stops[-1] == "slider":
            break
    assert stops[0] == "skip" and stops[-1] == "slider" and "wide" in stops
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid", "focus must be seen"


def test_dragging_zooms_every_curve_and_double_click_shows_all(browser: Browser, report: str) -> None:
    page = browser.open(report)
    strip = "document.getElementById('strip').toDataURL()"
    ticks = "[...document.querySelectorAll('.uplot canvas')].map((c) => c.toDataURL()).join()"
    before = page.evaluate(strip), page.evaluate(ticks)
    left, top, width, height = page.place_of(".chart .u-over")
    page.drag(left + 0.2 * width, top + height / 2, left + 0.4 * width, top + height / 2)
    zoomed = page.evaluate(strip), page.evaluate(ticks)
    assert zoomed[0] != before[0] and zoomed[1] != before[1]
    page.move(left + 0.5 * width, top + height / 2)
    assert abs(state(page)["slider"] - 0.3 * N) < 3, "the middle of the plot is now 30 % of the clip"
    page.click(left + 0.5 * width, top + height / 2, count=2)
    page.move(left + 0.5 * width, top + height / 2)
    assert abs(state(page)["slider"] - 0.5 * N) < 3


@pytest.mark.parametrize("view", [{}, PHONE, {"dark": True}, {"size": (768, 1024)}])
def test_nothing_is_cut_off_or_invisible(browser: Browser, report: str, view: dict[str, Any]) -> None:
    page = browser.open(report, **view)
    page.settle()
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    page.hover("#strip", 0.9)  # relative: the longest words
    assert "zooms" in state(page)["words"]
    assert page.evaluate(
        "[...document.querySelectorAll('#readout span')].every((e) => e.getBoundingClientRect().right <= innerWidth)"
    )
    # Text against what lies behind it: WCAG asks for 4.5.
    worst = page.evaluate(
        """(() => { const rgb = (c) => c.match(/[\\d.]+/g).map(Number);
        const lum = (c) => { const [r, g, b] = rgb(c).slice(0, 3).map((v) => { v /= 255;
          return v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4; }); return .2126 * r + .7152 * g + .0722 * b; };
        const back = (e) => { for (; e; e = e.parentElement) { const c = getComputedStyle(e).backgroundColor;
          if (rgb(c).length === 3 || rgb(c)[3] > 0) return c; } return "rgb(255,255,255)"; };
        let worst = [99, ""];
        for (const e of document.querySelectorAll("p, li, td, th, h1, h2, h3, a, code, summary, figcaption, span")) {
          if (!e.textContent.trim() || !e.offsetParent || e.closest("[aria-hidden]")) continue;
          const [a, b] = [lum(getComputedStyle(e).color), lum(back(e))].sort((x, y) => y - x);
          const contrast = (a + .05) / (b + .05);
          if (contrast < worst[0]) worst = [contrast, e.outerHTML.slice(0, 80)]; }
        return worst; })()"""
    )
    assert worst[0] >= 4.5, worst[1]
    assert page.errors == []


def test_statuses_can_be_told_apart_without_colour(browser: Browser, report: str, tmp_path: Path) -> None:
    page = browser.open(report)
    grey = {}
    for status, box in page.evaluate(
        "[...document.querySelectorAll('.swatch')].map((c) => [c.dataset.status, c.toDataURL()])"
    ):
        picture = Image.open(io.BytesIO(base64.b64decode(box.partition(",")[2]))).convert("LA")
        values = np.asarray(picture, float)
        grey[status] = values[..., 0] * values[..., 1] / 255 + (255 - values[..., 1])  # on white paper
    names = sorted(grey)
    assert len(names) == 6
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            assert np.sqrt(np.mean((grey[a] - grey[b]) ** 2)) > 20, (a, b)


def test_paper_holds_the_whole_width(browser: Browser, report: str) -> None:
    page = browser.open(report)
    pdf = page.print_pdf()
    assert pdf.startswith(b"%PDF") and 2 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") <= 12
    assert page.errors == []
    page.call("Emulation.setEmulatedMedia", {"media": "print"})
    page.settle()
    wide = page.evaluate(
        "Math.max(...[...document.querySelectorAll('canvas, #film')].map((c) => c.getBoundingClientRect().width))"
    )
    assert wide <= 680, "A4 in CSS px"
    assert page.evaluate("getComputedStyle(document.getElementById('cursor')).display") == "none"


def test_pictures_and_curves_have_words(browser: Browser, report: str) -> None:
    page = browser.open(report)
    nameless = page.evaluate(
        """[...document.querySelectorAll("img, [role=img], svg, canvas, input")].filter((e) =>
        !e.closest("[aria-hidden]") && !e.closest(".uplot[aria-label]") && !e.getAttribute("alt") &&
        !e.getAttribute("aria-label")).map((e) => e.outerHTML.slice(0, 80))"""
    )
    assert nameless == []
    assert page.evaluate("document.documentElement.lang") == "en"


def test_100_000_frames_open_in_time_and_ask_nobody(browser: Browser, tmp_path: Path) -> None:
    """The promise is 3 s and 15 MB, from asking to curves drawn. The quicker of two: others share the cores."""
    table = fake_table(100_000)
    write_fake_panorama(tmp_path, (9000, 2000))
    path = write_report(tmp_path, fake_run(table), table, fake_thumbnails(table, 200))
    assert path.stat().st_size < 15e6
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        page = browser.open(path.as_uri())
        page.settle()
        seconds.append(time.perf_counter() - started)
    assert min(seconds) < 3.0
    assert page.evaluate("document.documentElement.dataset.ready") == "6"
    moved = time.perf_counter()
    page.hover(".chart .u-over", 0.6)
    assert time.perf_counter() - moved < 1.0
    assert (
        abs(state(page)["slider"] / int(page.evaluate("document.getElementById('slider').max")) - 0.6) < 0.1
    )
    schemes = {url.partition(":")[0] for url in page.requests}
    assert schemes <= {"file", "data"} and page.errors == []


# ---- the registration graph


def test_graph_draws_a_pair_an_arc(browser: Browser, report: str) -> None:
    page = browser.open(report)
    arcs = page.evaluate("[...document.querySelectorAll('.graph path')].map((p) => p.getAttribute('class'))")
    assert (arcs.count("g-ok"), arcs.count("g-weak"), arcs.count("g-failed")) == (7, 6, 6)
    said = page.evaluate("document.querySelector('.graph').getAttribute('aria-label')")
    assert said == "19 pairs between 11 keyframes: 7 ok, 6 weak, 6 failed"
    dashes = [
        page.evaluate(f"getComputedStyle(document.querySelector('.graph .{name}')).strokeDasharray")
        for name in ("g-ok", "g-weak", "g-failed")
    ]
    assert len(set(dashes)) == 3, "told apart without colour"


def test_graph_of_a_long_shot_is_thinned_and_says_so(tmp_path: Path) -> None:
    keys = np.arange(2000)
    path = tmp_path / "pairs.npz"
    np.savez(path, src=keys[:-1], dst=keys[1:], status=np.full(1999, "ok"))
    drawing = registration_graph(path, keys.tolist())
    assert drawing is not None and drawing.svg.count("<path") == 500 and "500 of them drawn" in drawing.words
    assert registration_graph(tmp_path / "none.npz", [0, 1]) is None
    assert registration_graph(path, []) is None
    (tmp_path / "damaged.npz").write_bytes(b"PK nothing")
    assert registration_graph(tmp_path / "damaged.npz", [0, 1]) is None


def test_the_data_block_is_the_only_source(report: str) -> None:
    """The page's numbers are in it: nothing is fetched when it is opened."""
    text = Path(report.removeprefix("file://")).read_text(encoding="utf-8")
    block = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert len(block["frame"]) == N and "fetch(" not in text and "XMLHttpRequest" not in text
