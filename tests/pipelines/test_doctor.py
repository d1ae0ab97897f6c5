"""`doctor`: what is there, what is missing, what is broken; and shell completion, which says what may come next."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipelines import cli, doctor
from tests.pipelines.end_to_end import one_line


def by_name(findings: list[doctor.Finding]) -> dict[tuple[str, str], doctor.Finding]:
    return {(f.group, f.name): f for f in findings}


def test_a_sound_installation_is_ready(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert text.rstrip().endswith("ready to use") and " ! " not in text
    assert cli.main(["doctor", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = {(f["group"], f["name"]): f["found"] for f in document["findings"]}
    assert document["ok"] is True and document["exit_code"] == 0
    assert found["versions", "numpy"] == metadata.version("numpy")
    assert "decoder" in found["codecs", "h264"] and "no decoder" not in found["codecs", "h264"]
    assert {group for group, _ in found} == {
        "versions", "codecs", "gpu", "threads", "optional", "fonts", "folders",
    }  # fmt: skip
    assert int(found["threads", "torch"]) >= 1


def test_a_package_that_cannot_be_loaded_is_a_problem_with_a_cure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    load = importlib.import_module

    def broken(name: str, *args: Any) -> Any:
        if name == "scipy":
            raise ImportError("libgfortran.so.5: cannot open shared object file\nmore")
        return load(name, *args)

    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    assert cli.main(["doctor"]) == 2
    [line] = [line for line in capsys.readouterr().out.splitlines() if " ! " in line]
    assert "libgfortran.so.5" in line and "pip install scipy" in line


def test_what_render_writes_with_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    import av

    found = by_name(doctor.examine())
    assert all(found["codecs", name].state == "ok" for name in ("libx264", "libx265", "prores_ks"))
    assert "hevc10" in found["codecs", "libx265"].found

    def unknown(name: str, mode: str) -> None:
        raise ValueError(f"{name}: no such encoder")

    monkeypatch.setattr(av.codec, "Codec", unknown)
    findings = list(doctor.encoders())
    assert len(findings) == 3 and all(f.state == "missing" and f.cure for f in findings)


def test_two_opencv_builds_are_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def two() -> Iterator[Any]:
        for name in ("opencv-contrib-python-headless", "opencv_python", "numpy"):
            yield SimpleNamespace(metadata={"Name": name})

    monkeypatch.setattr(doctor.metadata, "distributions", two)
    found = by_name(list(doctor.versions()))["versions", "cv2"]
    assert found.state == "problem" and "opencv-python" in found.found and "uninstall" in found.cure


def test_what_is_optional_is_missing_not_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    monkeypatch.setattr(doctor, "OPTIONAL", (("no-such-package", "dreams", "pip install it"),))
    found = by_name(list(doctor.optional()))
    for name, cure in (("no-such-package", "pip install it"), ("nona", "hugin-tools")):
        finding = found["optional", name]
        assert finding.state == "missing" and cure in finding.cure
    assert doctor.as_document(list(found.values()))["ok"] is True


def test_a_group_that_fails_does_not_hide_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    found = by_name(doctor.examine())
    assert found["codecs", "examination"].state == "problem"
    assert found["versions", "av"].state == "problem" and found["threads", "cores"].state == "ok"


def test_too_little_room_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: SimpleNamespace(free=2**30))
    found = by_name(list(doctor.folders()))
    for name, cure in (("results", "-o"), ("temporary", "TMPDIR")):
        finding = found["folders", name]
        assert finding.state == "problem" and "1.0 GiB free" in finding.found and cure in finding.cure


def test_a_terminal_without_the_signs_is_told_and_shows_question_marks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor.sys, "stdout", SimpleNamespace(encoding="ascii"))
    (terminal,) = (f for f in doctor.fonts() if f.name == "terminal")
    assert terminal.state == "missing" and "utf-8" in terminal.cure
    # The commands themselves go on: a clip called so must not end in a traceback.
    code = "import sys; from pipelines.cli import main; sys.exit(main(sys.argv[1:]))"
    clip = tmp_path / "3 ± 1.y4m"
    clip.write_bytes(b"YUV4MPEG2 W32 H32 F25:1 Ip A1:1 C420jpeg\n" + (b"FRAME\n" + bytes(32 * 48)) * 2)
    done = subprocess.run(
        [sys.executable, "-c", code, "probe", "--no-shots", str(clip)],
        env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "3 ? 1.y4m" in done.stdout and "Traceback" not in done.stderr


def test_doctor_takes_no_settings(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--shots.min_frames", "3"]) == 2
    assert "has no settings" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["exp"], ["export"]),
        (["export", "out", "--to", "colmap,op"], ["colmap,opentrackio", "colmap,opencv"]),
        (["run", "a.mp4", "--exp"], ["--export"]),
        (["pitch", "out", "--template", "f"], ["football"]),
    ],
)
def test_the_shell_completes_commands_options_and_formats(words: list[str], expected: list[str]) -> None:
    environment = {
        **os.environ,
        "_BROADCAST_MOSAIC_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(["broadcast-mosaic", *words]),
        "COMP_CWORD": str(len(words)),
    }
    code = "import sys; sys.argv = ['broadcast-mosaic']; from pipelines.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == expected and done.stderr == ""
