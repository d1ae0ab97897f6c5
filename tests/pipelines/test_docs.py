"""The documentation: the site builds without a warning and asks no other machine; the tour is run as it is written.

The commands that the tour shows are its indented lines that begin with `broadcast-mosaic`; the examples in Python of
docs/python-api.md are run by test_result.py, those of tour, formats and results here.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import pytest
from PIL import Image

from pipelines import cli
from tests.pipelines.end_to_end import Finished
from tests.pipelines.test_pitch import click_rows, write_rows
from tests.synth.clip import truth_path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers")


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def commands(page: Path) -> list[list[str]]:
    """Words of every indented command, without the program's name."""
    lines = re.findall(r"^    broadcast-mosaic (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.slow
@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in NEEDED), reason="mkdocs is not installed"
)
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    said = run.stdout + run.stderr
    assert run.returncode == 0 and "WARNING" not in said and "ERROR" not in said, said
    for page in DOCS.glob("*.md"):
        built = tmp_path / "site" / f"{page.stem}.html"
        assert built.is_file(), page
        # Scripts, styles, pictures and fonts are the site's own; links that a reader may follow are not asked for.
        asked = re.findall(
            r"<(?:script|img|link|iframe)[^>]*\s(?:src|href)=.?(https?://\S+)", built.read_text()
        )
        assert asked == [], page
    reference = (tmp_path / "site" / "api-calib.html").read_text(encoding="utf-8")
    assert 'id="calib.pitch.fit_pitch_camera"' in reference and "log_focal_std" in reference


def test_every_page_is_in_the_navigation() -> None:
    listed = set(
        re.findall(r":\s+([\w-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert listed == {page.name for page in DOCS.glob("*.md")}


@pytest.mark.slow
def test_the_tour_runs_as_it_is_written(
    pan_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a clip of fifty small pictures for the sample's two hundred large ones: the tour's pixels are in both."""
    page = DOCS / "tour.md"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "sample_clip", lambda: (pan_clip, truth_path(pan_clip)))
    shutil.copy(pan_clip, "match.mp4")
    Image.new("RGBA", (120, 60), (200, 20, 120, 255)).save("board.png")
    (keys,) = blocks(page, "csv")
    Path("keys.csv").write_text(keys, encoding="utf-8")
    shown = {}
    for words in commands(page):
        assert cli.main(words) == 0, words
        shown[" ".join(words[:4])] = capsys.readouterr().out
    assert len(shown) >= 7
    for name in ("report.html", "camera.csv", "shot-000/camera.chan", "shot-000/camera.usda"):
        assert Path("demo-out", name).is_file(), name
    for what in ("stabilised", "overlay", "move"):
        with av.open(f"demo-out/{what}.mp4") as container:
            assert sum(1 for _ in container.decode(container.streams.video[0])) > 10
    assert shown["rays demo-out --frame 20"].count("\n") >= 2
    (example,) = blocks(page, "python")
    exec(compile(example, str(page), "exec"), {})
    assert "ok" in capsys.readouterr().out


def test_the_export_examples_run(
    pan_run: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the guide to the formats: its `export` commands, and the examples that read what they wrote."""
    page = DOCS / "formats.md"
    for reader in ("pycolmap", "pandas", "polars", "pyarrow"):
        pytest.importorskip(reader)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(pan_run.out, "match")
    exports = [words for words in commands(page) if words[0] == "export"]
    assert len(exports) >= 3
    for words in exports:
        assert cli.main(words) == 0, words
    names: dict[str, Any] = {}
    examples = blocks(page, "python")
    for example in examples:
        exec(compile(example, str(page), "exec"), names)
    assert len(examples) == 3 and "num_cameras" in capsys.readouterr().out
    known = pan_run.table.f_px > 0
    assert names["K"][0, 0] == pan_run.table.f_px[known][0]
    assert len(names["by_frame"]) == len(names["table"]) == len(pan_run.table)


def test_the_example_of_the_pitch_runs(
    pan_run: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("match").symlink_to(pan_run.out)
    write_rows(Path("clicks.csv"), click_rows(pan_run))
    (example,) = blocks(DOCS / "results.md", "python")
    names: dict[str, object] = {}
    exec(compile(example, "results.md", "exec"), names)
    assert "camera at" in capsys.readouterr().out and names["metres"].shape == (2, 2)  # type: ignore[attr-defined]
