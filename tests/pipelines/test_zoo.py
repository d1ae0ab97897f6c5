"""Every format of the zoo decodes to the pictures that were put in; and the ways to hand in a clip that are no file."""

from __future__ import annotations

import io
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pipelines import cli
from pipelines.decode import open_clip
from pipelines.errors import InputError, OutputError
from pipelines.hdr import NODES, TRANSFERS, bt709_table
from pipelines.probe import probe
from pipelines.stdin import SPOOL, spooled
from tests.pipelines.clips import ramp, write_clip
from tests.pipelines.end_to_end import one_line, run
from tests.pipelines.zoo import CASES, FULL, PQ, Case, N, decode, expected, make

CODECS = {"libx264": "h264", "libx265": "hevc", "prores_ks": "prores", "libsvtav1": "av1"}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_pictures_are_those_that_were_put_in(case: Case, tmp_path: Path) -> None:
    if case.missing():
        pytest.skip(case.missing())
    path = make(case, tmp_path)
    found = decode(case, path)
    facts = found.clip.facts
    assert facts.size_px == case.size and facts.bit_depth >= case.bits
    assert facts.codec == CODECS.get(case.codec, case.codec)
    film = case.scan == "soft" or case.scan.startswith("telecine")
    fields = 1 if film or case.scan == case.flags == "progressive" else 2
    spacing = 1001 / 24000 if film else 0.04 / fields
    assert found.n_pictures == fields * N and found.clip.counts["decoded"] == case.n_coded
    spaced = np.diff(found.pts_s)
    if (
        case.scan == "soft"
    ):  # shown for three fields and two in turn, as the file asks: the time is the field's
        assert spaced[:-1] == pytest.approx(
            np.resize([1001 / 20000, 1001 / 30000], len(spaced) - 1), abs=1e-4
        )
    else:
        assert spaced == pytest.approx(spacing, abs=1.1e-3)  # Matroska and FLV count in ms
    # Neighbour pictures differ by 30 grey levels and more: a swapped or doubled one cannot pass.
    assert found.worst_grey < case.noise
    if case.scan not in ("progressive", "soft"):
        assert facts.scan_seen == case.scan
    assert any(w.startswith("flagged") for w in facts.warnings) == (not film and case.flags != case.scan)
    assert not any("truncated" in w or "damaged" in w or "gap" in w for w in facts.warnings)
    header = probe(path, shots=False)
    assert header["size_px"] == list(case.size)
    if (
        case.scan != "soft"
    ):  # a raw stream says the rate of its fields, and its pictures come at four fifths of it
        assert header["picture_fps"] == pytest.approx(1 / spacing)


def test_a_shift_by_one_picture_would_be_seen() -> None:
    case = CASES[0]
    assert np.abs(expected(case, 3) - expected(case, 4)).mean() > 10 * case.noise


@pytest.mark.parametrize("case", [c for c in CASES if c.colour is not None], ids=lambda case: case.name)
def test_grey_stays_grey_in_every_colour_space_and_range(case: Case, tmp_path: Path) -> None:
    found = decode(case, make(case, tmp_path))
    facts = found.clip.facts
    assert case.colour is not None
    assert (facts.colour["space"], facts.colour["primaries"], facts.colour["transfer"]) == case.colour
    assert facts.colour["range"] == case.color_range
    rgb = found.rgb.astype(float)
    assert np.ptp(rgb, axis=2).max() <= 3  # no tint
    code = expected(case, 3)
    shown = code if case.color_range == FULL else (code - 16) * 255 / 219
    mapped = case.colour[1] == 9  # BT.2020: what screens show is BT.709
    if mapped:
        diagonal = np.arange(NODES)
        table = bt709_table(case.colour[2] if case.colour[2] in TRANSFERS else 1, 9)[
            diagonal, diagonal, diagonal, 1
        ]
        shown = 255 * np.interp(shown / 255, diagonal / (NODES - 1), table)
    assert np.abs(rgb.mean(axis=2) - shown).mean() < case.noise
    assert any("mapped to BT.709" in w for w in facts.warnings) == mapped
    assert ("PQ" in facts.colour["transfer_name"]) == (case.colour == PQ)


def test_a_scene_at_rest_does_not_overrule_flags(tmp_path: Path) -> None:
    still = [ramp(0)] * 12
    with open_clip(write_clip(tmp_path / "a.mkv", 12, pictures=still)) as clip:
        assert (clip.facts.scan_seen, clip.facts.interlaced) == ("unknown", False)


def test_globs_are_image_sequences(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    for i in (1, 2, 10):
        cv2.imwrite(str(tmp_path / f"a{i}.png"), ramp(i))
    cv2.imwrite(str(tmp_path / "b1.png"), ramp(20))
    (tmp_path / "a3.txt").write_text("no image")
    with open_clip(tmp_path / "a*") as clip:
        frames = list(clip)
    assert len(frames) == 3
    np.testing.assert_array_equal(frames[2].gray, ramp(10))
    with pytest.raises(InputError, match="no file matches"):
        open_clip(tmp_path / "c*.png")
    with pytest.raises(InputError, match="in quotes"), open_clip(tmp_path / "b1.png") as clip:
        list(clip)
    (tmp_path / "odd[1].mkv").write_bytes(write_clip(tmp_path / "c.mkv", 2).read_bytes())
    with open_clip(tmp_path / "odd[1].mkv") as clip:  # a name with such signs is still a file
        assert clip.facts.codec == "ffv1"


class Stdin:
    """Standard input that is no terminal."""

    def __init__(self, content: bytes) -> None:
        self.buffer = io.BytesIO(content)


def test_standard_input_is_probed_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = write_clip(tmp_path / "a.ts", 12, codec="libx264", size=(320, 240)).read_bytes()
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(sys, "stdin", Stdin(content))
    assert cli.main(["probe", "-", "--no-shots"]) == 0
    assert "320x240" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["a.ts"]


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", "gives nothing"),
        (b"not a video\n" * 50, "standard input: is not a video"),
        (bytes(3000), "more than 2e-06 GB"),
    ],
)
def test_unusable_standard_input_is_one_line_and_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    content: bytes,
    cause: str,
) -> None:
    monkeypatch.setattr(sys, "stdin", Stdin(content))
    out = tmp_path / "out"
    assert cli.main(["run", "-", "-o", str(out), "--decode.stdin_max_gb", "2e-6"]) == 2
    assert cause in one_line(capsys.readouterr().err)
    assert not out.exists()
    assert cli.main(["run", "-", "a.mp4", "-o", str(out)]) == 2
    assert "only be the one clip" in one_line(capsys.readouterr().err)


def test_a_spool_that_a_killed_run_left_goes_and_one_in_use_stays(tmp_path: Path) -> None:
    (tmp_path / f"{SPOOL}old").write_bytes(b"left")
    with (
        spooled(io.BytesIO(b"one"), tmp_path, 100) as first,
        spooled(io.BytesIO(b"two"), tmp_path, 100) as second,
    ):
        assert (first.read_bytes(), second.read_bytes()) == (b"one", b"two")
        assert {p.name for p in tmp_path.iterdir()} == {first.name, second.name}
    assert list(tmp_path.iterdir()) == []


def test_no_room_for_standard_input_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError), spooled(io.BytesIO(b"one"), tmp_path / "file" / "out", 100):
        pass


def test_pixel_aspect_and_rotation_go_together(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", 3, codec="libx264", rotation=90, sar=Fraction(64, 45))
    with open_clip(path) as clip:
        assert clip.facts.size_px == (48, 64)
        assert clip.facts.pixel_aspect == pytest.approx(45 / 64, rel=1e-3)


@pytest.mark.slow
def test_standard_input_gives_what_the_file_gives(
    pan_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ("--run.max_frames", "12", "--panorama.enabled", "false", "-q")
    by_name = run(pan_clip, tmp_path / "file", *few)
    monkeypatch.setattr(sys, "stdin", Stdin(pan_clip.read_bytes()))
    piped = run(Path("-"), tmp_path / "piped", *few)
    assert (piped.code, piped.stderr) == (by_name.code, "")
    assert piped.camera_bytes == by_name.camera_bytes
    assert piped.record["clip"]["path"] == "-"
    assert piped.record["digest"] == by_name.record["digest"]  # so that --resume knows it again
    assert not list(piped.out.glob(".*"))
