"""Clips whose motion cannot reveal the focal length: nothing is claimed, and what is known is right."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from tests.pipelines.end_to_end import Finished, corner_errors_px, run, small_spec, true_homographies
from tests.synth.clip import write_clip
from tests.synth.paths import PathSpec

pytestmark = pytest.mark.slow  # whole runs

NOT_CLAIMED = ("f_px", "f_std_px", "f_stat_px", "hfov_deg", "pan_deg", "tilt_deg", "roll_deg")
KINDS = ("pure_zoom", "locked_off")


@pytest.fixture(scope="module")
def finished(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Finished]:
    """A zoom by 1.5 (and back) without a turn, and a shot in which only players move."""
    paths = {"pure_zoom": PathSpec(kind="pure_zoom", zoom=1.5), "locked_off": PathSpec(kind="locked_off")}
    done = {}
    for seed, (kind, path) in enumerate(paths.items(), start=5):
        clip = clips / f"{kind}.mp4"
        write_clip(clip, small_spec(seed, 36 if kind == "pure_zoom" else 24, path))
        done[kind] = run(clip, tmp_path_factory.mktemp(kind) / "out", "-q")
    return done


def check_claims_no_focal(done: Finished, reasons: set[str]) -> None:
    assert (done.code, done.stderr) == (0, "")
    with (done.out / "camera.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {r["status"] for r in rows} == {"relative"}
    assert {r["reason"] for r in rows} <= reasons
    assert {r[name] for r in rows for name in NOT_CLAIMED} == {""}
    [shot] = done.record["shots"]
    assert (shot["status"], shot["focal"]) == ("relative", None)
    assert shot["reason"] in reasons and shot["sentence"]
    assert "not known" in (done.out / "report.html").read_text(encoding="utf-8").lower()


def test_pure_zoom_claims_no_focal(finished: dict[str, Finished]) -> None:
    check_claims_no_focal(finished["pure_zoom"], {"zoom_only"})


def test_locked_off_claims_no_focal(finished: dict[str, Finished]) -> None:
    check_claims_no_focal(finished["locked_off"], {"no_rotation"})


@pytest.mark.parametrize("kind", KINDS)
def test_zoom_ratio_and_homographies_are_right_without_a_focal(
    finished: dict[str, Finished], kind: str
) -> None:
    done = finished[kind]
    table, truth = done.table, done.truth
    reference = done.record["shots"][0]["reference_frame"]
    zoom = truth["f_px"] / truth["f_px"][reference]
    assert zoom.max() / zoom.min() == pytest.approx(1.0 if kind == "locked_off" else 1.5, rel=1e-3)
    np.testing.assert_allclose(table.zoom_ratio, zoom, rtol=0.005)
    assert corner_errors_px(table.homography, true_homographies(truth, reference)).max() < 0.75
    np.testing.assert_allclose(table.homography[reference], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_panorama_is_made_without_a_focal(finished: dict[str, Finished], kind: str) -> None:
    [shot] = finished[kind].record["shots"]
    assert shot["panorama"]["seen_share"] > 0.9
    for name in shot["files"]:
        assert (finished[kind].out / name).stat().st_size > 0
