"""`probe` on a clip of two pans behind one scoreboard: its cut, its shots, its graphic; the same keys without them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipelines import cli
from pipelines.probe import REASONS, colour_words, probe, probe_text
from tests.pipelines.clips import write_clip

SIZE = (320, 192)
N_FIRST, N_SECOND, STEP_PX = 24, 20, 8
BOARD = {"x": 24, "y": 16, "w": 80, "h": 32}


def pan(seed: int, n: int) -> list[np.ndarray]:
    """Pictures (h, w) uint8 of a camera that pans over a texture in whole pixels; each has noise of its own."""
    rng = np.random.default_rng(seed)
    w, h = SIZE
    wide = sum(
        gaussian_filter(rng.normal(size=(h, w + n * STEP_PX)), s, mode="wrap") * s for s in (1.5, 5, 15)
    )
    wide = 120 + 35 * wide / wide.std()
    noisy = (wide[:, i * STEP_PX : i * STEP_PX + w] + rng.normal(0, 1.5, (h, w)) for i in range(n))
    return [np.clip(picture, 16, 235).astype(np.uint8) for picture in noisy]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(5)
    board = np.kron(rng.integers(0, 2, (4, 10)), np.ones((8, 8), int)) * 180 + 30
    pictures = [*pan(0, N_FIRST), *pan(1, N_SECOND)]
    for picture in pictures:
        picture[BOARD["y"] : BOARD["y"] + BOARD["h"], BOARD["x"] : BOARD["x"] + BOARD["w"]] = board
    path = tmp_path_factory.mktemp("probe") / "two.mkv"
    return write_clip(path, len(pictures), size=SIZE, pictures=pictures)


def test_probe_finds_the_cut_and_the_scoreboard(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Four frames are bridged, not ten: each costs a rescue here.
    assert cli.main(["probe", str(clip), "--json", "--shots.bridge_frames", "4"]) == 0
    facts = json.loads(capsys.readouterr().out)
    shots = facts["shots"]
    assert shots["estimated"] and shots["complete"] and shots["reason"] == ""
    assert shots["n_frames"] == N_FIRST + N_SECOND and shots["n_frames_in_no_shot"] == 0
    assert [(s["first_frame"], s["last_frame"], s["ended_by"]) for s in shots["list"]] == [
        (0, N_FIRST - 1, "cut"),
        (N_FIRST, N_FIRST + N_SECOND - 1, "end"),
    ]
    assert shots["list"][1]["start_s"] == pytest.approx(N_FIRST / 25)
    for shot in shots["list"]:
        assert shot["motion_px_per_frame"] == pytest.approx(STEP_PX, abs=0.1)
    overlays = facts["overlays"]
    assert overlays["estimated"] and len(overlays["graphics"]) == 1
    for key, value in BOARD.items():
        # Found at a quarter of the size and widened a little.
        assert overlays["graphics"][0][key] == pytest.approx(value, abs=17)
    text = probe_text(facts)
    assert "2, by a quick look" in text and "frames 24 to 43" in text and "then a cut" in text


def test_probe_stops_where_it_is_told(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["probe", str(clip), "--seconds", "0.4", "--json"]) == 0
    shots = json.loads(capsys.readouterr().out)["shots"]
    assert (shots["n_frames"], shots["seconds"], shots["complete"]) == (10, 0.4, False)
    assert [(s["last_frame"], s["ended_by"]) for s in shots["list"]] == [(9, "limit")]
    assert cli.main(["probe", str(clip), "--seconds", "0.4"]) == 0
    shown = capsys.readouterr()
    assert cli.main(["probe", str(clip), "--seconds", "inf", "--json"]) == 0
    everything = json.loads(capsys.readouterr().out)["shots"]
    assert (everything["seconds"], everything["complete"]) == (None, True)
    assert "1 in the first 0.4 s" in shown.out and "moved too little" in shown.out and shown.err == ""


def test_without_shots_the_keys_are_the_same_and_nothing_is_registered(
    clip: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pipelines.first_look", None)  # importing it would fail
    assert cli.main(["probe", str(clip), "--no-shots", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["shots"]["estimated"] is False and facts["shots"]["list"] == []
    assert facts["overlays"]["estimated"] is False and facts["overlays"]["masked_share"] is None
    assert facts["shots"]["reason"] in REASONS and "--no-shots" in probe_text(facts)
    monkeypatch.undo()
    full = probe(clip, seconds=0.3)
    for key in ("shots", "overlays"):
        assert set(facts[key]) == set(full[key])
    assert set(facts) - {"exit_code"} == set(full)


def test_settings_reach_the_quick_look(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--shots.min_frames", "22", "--shots.bridge_frames", "4", "--overlays.enabled", "false"]
    assert cli.main(["probe", str(clip), "--json", *arguments]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [s["n_frames"] for s in facts["shots"]["list"]] == [N_FIRST]
    assert facts["shots"]["n_frames_in_no_shot"] == N_SECOND
    assert facts["overlays"]["estimated"] is False and facts["overlays"]["reason"] == "switched_off"


def test_progress_is_told(clip: Path) -> None:
    told: list[tuple[str, int, int | None]] = []
    probe(clip, seconds=0.4, progress=lambda *now: told.append(now))
    assert told == [("first look", i, 10) for i in range(1, 11)]


@pytest.mark.parametrize(
    ("space", "primaries", "transfer", "levels", "said"),
    [
        (1, 1, 1, 1, "BT.709, limited range"),
        (9, 9, 16, 1, "matrix BT.2020, primaries BT.2020, transfer PQ, limited range"),
        (2, 2, 2, 0, "not tagged, range not tagged; RGB as by ITU601"),
        (6, 77, 1, 2, "matrix BT.601 (525 lines), primaries code 77, transfer BT.709, full range"),
    ],
)
def test_colour_is_said_by_name(space: int, primaries: int, transfer: int, levels: int, said: str) -> None:
    tags = {
        "space": space,
        "primaries": primaries,
        "transfer": transfer,
        "range": levels,
        "rgb_matrix": "ITU601",
    }
    assert colour_words(tags) == said
