"""The Python API: results as arrays and tables, and the guide's examples, run as they stand there."""

from __future__ import annotations

import dataclasses
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from pipelines import Config, Result, open_result, process
from pipelines.archive import COLUMNS, cells
from pipelines.errors import ConfigError, InputError, MissingToolError
from tests.pipelines.end_to_end import Finished
from tests.pipelines.export_truth import FIRST, LOST, N, truth
from tests.pipelines.test_export_command import finished
from tests.pipelines.test_pitch import POSITION, click_rows, write_rows

GUIDE = Path(__file__).parents[2] / "docs" / "python-api.md"
NAMES = [name for name, _, _ in COLUMNS]


@pytest.fixture
def result(tmp_path: Path) -> Result:
    return open_result(finished(tmp_path / "out"))


def test_table_has_every_column_of_the_file(result: Result) -> None:
    table = result.table()
    assert list(table) == NAMES and {len(column) for column in table.values()} == {len(result.camera)}
    np.testing.assert_array_equal(table["f_px"], truth().table().f_px)
    assert table["status"].tolist() == list(truth().table().status)
    own = result.table(1)
    assert own["shot"].tolist() == [1] * 3 and own["frame"][0] == FIRST + N + 2
    with pytest.raises(InputError, match="its shots: 0, 1"):
        result.table(2)


def test_pandas_and_polars_see_the_same_cells_as_the_file(result: Result) -> None:
    expected = [tuple(row) for row in cells(result.camera)]
    by_polars = result.to_polars()
    assert by_polars.columns == NAMES and by_polars.rows() == expected
    frame = result.to_pandas()
    assert frame.index.name == "frame" and str(frame["status"].dtype) == "category"
    values = frame.reset_index()[NAMES].astype(object)
    got = [tuple(row) for row in values.where(values.notna(), None).itertuples(index=False)]
    assert got == expected
    assert len(result.to_pandas(0)) == N and result.to_polars(1).height == 3


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_a_missing_table_package_says_what_to_install(
    result: Result, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingToolError, match=f"pip install {package}"):
        getattr(result, f"to_{package}")()


def test_camera_matrices_see_what_the_truth_sees(tmp_path: Path) -> None:
    known = truth(distortion=False, aspect=45 / 64)
    result = open_result(finished(tmp_path / "out", known))
    K, R = result.intrinsics(), result.rotations()
    for i in range(N):
        if i == LOST:
            assert np.isnan(K[i]).all() and np.isnan(R[i]).all()
            continue
        rays = known.rays(i)
        image = rays @ R[i].T @ K[i].T
        np.testing.assert_allclose(image[:, :2] / image[:, 2:], known.project(i, rays), atol=1e-9)
    assert result.size_px == known.size_px


def test_files_that_are_not_there_are_named(result: Result) -> None:
    for ask in (result.pairs, result.panorama):
        with pytest.raises(InputError, match="no such file"):
            ask(0)
    with pytest.raises(ValueError, match="did you mean usd"):
        result.export("usb")
    with pytest.raises(InputError, match="no such file"):
        open_result(result.out / "nowhere")


def test_settings_are_checked_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"panorama\.enabled"):
        process("none.mp4", tmp_path / "out", {"panorama.enable": False})
    with pytest.raises(InputError, match="no such file"):
        process(tmp_path / "none.mp4", tmp_path / "out", Config())
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_process_gives_a_result_with_those_settings(pan_clip: Path, tmp_path: Path) -> None:
    stages: list[str] = []
    blas: list[int] = []

    def progress(stage: str, done: int, total: int | None) -> None:
        stages.append(stage)
        if not blas:
            blas.extend(lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas")

    settings = {"panorama.enabled": False, "run.max_frames": 30}
    with threadpool_limits(2, user_api="blas"):
        before = {lib["filepath"]: lib["num_threads"] for lib in threadpool_info()}
        result = process(str(pan_clip), tmp_path / "out", settings, progress=progress)
        after = {lib["filepath"]: lib["num_threads"] for lib in threadpool_info()}
    assert len(result.table()["frame"]) == 30 and "first pass" in stages
    assert result.run.config["panorama"]["enabled"] is False
    assert set(blas) == {1}  # two threads wait for each other over small matrices
    assert {path: after[path] for path in before} == before
    assert np.isfinite(result.camera.zoom_ratio).all()
    assert len(result.pairs(0)["src"]) > 10


def examples() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.S | re.M)


@pytest.mark.slow
def test_the_guides_examples_run_as_written(
    pan_run: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """process() is the one thing not run again: its folder is the session's run with the same settings."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(pan_run.clip, "match.mp4")
    shutil.copytree(pan_run.out, "match")
    write_rows(Path("clicks.csv"), click_rows(pan_run))
    import pipelines.run

    real, asked = pipelines.run.process, []

    def once(clip: Path, out: Path, config: Config, *rest: Any) -> Any:
        if not clip.exists():
            return real(clip, out, config, *rest)
        asked.append((str(clip), str(out), config.registration.n_fine))
        return None

    monkeypatch.setattr(pipelines.run, "process", once)
    blocks = examples()
    assert len(blocks) > 8
    names: dict[str, Any] = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"{GUIDE.name}, example {number}", "exec"), names)
    assert asked == [("match.mp4", "match", 3000)]
    said = capsys.readouterr().out
    assert "50 of 50 frames have a focal length" in said and "not there.mp4" in said
    np.testing.assert_allclose(names["again"], names["corners"], atol=1e-6)
    fit = names["fit"]
    assert fit.status == "ok"
    np.testing.assert_allclose(
        fit.H_dst_src / fit.H_dst_src[2, 2], [[1, 0, -9], [0, 1, -6], [0, 0, 1]], atol=0.05
    )
    assert (names["pairs"]["H_dst_src"].shape[1:], names["K"].shape) == ((3, 3), (50, 3, 3))
    assert Path("match/shot-000/camera.usda").is_file()
    np.testing.assert_allclose(names["pitch"].camera.position_m, POSITION, atol=3)
    np.testing.assert_allclose(
        names["again_there"].camera.position_m, names["pitch"].camera.position_m, atol=0.5
    )
    assert names["done"].path == Path("board.mov") and names["done"].n_changed > 20
    assert "50 of 50 frames are new" in said


def test_results_cannot_be_changed_by_accident(result: Result) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.out = Path("/")  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        result.camera.f_px[0] = 1.0
