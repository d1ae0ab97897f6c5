"""Files of a run: bit-exact round trips, empty cells, whole or not at all, one writer, resume."""

from __future__ import annotations

import csv
import errno
import json
import math
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from pipelines.archive import (
    COLUMNS,
    join_tables,
    read_camera_csv,
    read_run,
    to_json,
    whole_file,
    write_arrays,
    write_camera_csv,
    write_camera_jsonl,
    write_camera_parquet,
    write_run,
)
from pipelines.config import load_config
from pipelines.errors import InputError, MissingToolError, OutputError
from pipelines.output_folder import OutputFolder, load_finished_shots, run_digest
from pipelines.records import CameraTable
from tests.pipelines.tables import camera_table, run_record, shot_record

# As product.md has them.
PRODUCT_COLUMNS = re.findall(
    r"\w+",
    """
    frame pts_s timecode source_frame field shot status reason f_px f_std_px f_stat_px zoom_ratio zoom_ratio_std
    hfov_deg pan_deg tilt_deg roll_deg cx_px cy_px aspect k1 residual_px overlap
    h11 h12 h13 h21 h22 h23 h31 h32 h33
    """,
)


def awkward_table(n: int = 40) -> CameraTable:
    """Values that a careless writer loses: tiny, huge, negative zero, sums that do not print short, empty."""
    rng = np.random.default_rng(3)
    awkward = np.array([0.1 + 0.2, -0.0, 5e-324, 1.7976931348623157e308, 1 / 3, -1e-17, math.nan])

    def column() -> np.ndarray:
        values = rng.normal(size=n) * 10.0 ** rng.integers(-8, 8, n)
        values[rng.permutation(n)[:7]] = awkward
        return values

    floats = {
        name: column() for name, kind, _ in COLUMNS if kind == "float" and hasattr(camera_table(0), name)
    }
    return camera_table(
        n,
        **floats,
        homography=np.stack([column() for _ in range(9)], axis=-1).reshape(n, 3, 3),
        timecode=tuple(f"10:00:00;{i % 30:02d}" if i % 3 else "" for i in range(n)),
        status=tuple("ok" if i % 2 else "lost" for i in range(n)),
        reason=tuple(["", 'a "quoted", one', "line\nbreak", "ünïcode"][i % 4] for i in range(n)),
        field=np.arange(n) % 3 - 1,
        shot=np.arange(n) % 5 - 1,
    )


def assert_same(a: CameraTable, b: CameraTable) -> None:
    for column in fields(CameraTable):
        left, right = getattr(a, column.name), getattr(b, column.name)
        if isinstance(left, tuple):
            assert left == right, column.name
        else:
            assert left.dtype.kind == right.dtype.kind
            # NaN payload apart, to the last bit: -0.0 is not 0.0 here.
            np.testing.assert_array_equal(np.isnan(left), np.isnan(right), err_msg=column.name)
            known = ~np.isnan(left)
            assert left[known].tobytes() == right[known].tobytes(), column.name


def test_csv_has_the_contract_columns_and_comes_back_bit_for_bit(tmp_path: Path) -> None:
    table = awkward_table()
    write_camera_csv(tmp_path / "camera.csv", table)
    with (tmp_path / "camera.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.reader(stream))
    assert rows[0] == PRODUCT_COLUMNS
    assert len(rows) == 41 and all(len(row) == len(PRODUCT_COLUMNS) for row in rows)
    assert_same(read_camera_csv(tmp_path / "camera.csv"), table)


def test_unknown_is_an_empty_cell_and_null_never_nan_or_minus_one(tmp_path: Path) -> None:
    table = camera_table(1, shot=np.array([-1]), status=("graphic",))
    write_camera_csv(tmp_path / "camera.csv", table)
    write_camera_jsonl(tmp_path / "camera.jsonl", table)
    line = (tmp_path / "camera.csv").read_text().splitlines()[1]
    assert line == "0,,,0,,,graphic," + "," * 24
    row = json.loads((tmp_path / "camera.jsonl").read_text())
    assert list(row) == PRODUCT_COLUMNS
    assert {k for k, v in row.items() if v is not None} == {"frame", "source_frame", "status"}


def test_jsonl_holds_the_values_of_the_csv(tmp_path: Path) -> None:
    table = awkward_table()
    write_camera_jsonl(tmp_path / "camera.jsonl", table)
    text = (tmp_path / "camera.jsonl").read_text(encoding="utf-8")
    assert "NaN" not in text and "Infinity" not in text
    rows = [json.loads(line) for line in text.splitlines()]
    k1 = np.array([math.nan if row["k1"] is None else row["k1"] for row in rows])
    np.testing.assert_array_equal(k1, table.k1)
    h23 = np.array([math.nan if row["h23"] is None else row["h23"] for row in rows])
    np.testing.assert_array_equal(h23, table.homography[:, 1, 2])
    assert rows[2]["reason"] == "line\nbreak" and rows[0]["reason"] is None


def test_parquet_keeps_values_nulls_and_units(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = awkward_table()
    write_camera_parquet(tmp_path / "camera.parquet", table)
    stored = parquet.read_table(tmp_path / "camera.parquet")
    assert stored.column_names == PRODUCT_COLUMNS
    assert stored.schema.field("pan_deg").metadata == {b"unit": b"deg"}
    assert stored.column("k1").null_count == int(np.isnan(table.k1).sum())
    np.testing.assert_array_equal(stored.column("k1").to_numpy(zero_copy_only=False), table.k1)
    assert tuple(stored.column("status").to_pylist()) == table.status


def test_parquet_without_pyarrow_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingToolError, match=r"broadcast-mosaic\[parquet\]"):
        write_camera_parquet(tmp_path / "camera.parquet", camera_table(1))
    assert not list(tmp_path.iterdir())


def test_an_infinite_value_is_our_bug_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"f_px.*row 1"):
        write_camera_csv(tmp_path / "camera.csv", camera_table(2, f_px=np.array([1.0, math.inf])))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "no column"),
        ("frame,pts_s\n0,1\n", "no column timecode"),
        (",".join(PRODUCT_COLUMNS) + "\n1,x\n", "damaged"),
    ],
)
def test_a_foreign_or_damaged_csv_is_refused(tmp_path: Path, text: str, cause: str) -> None:
    (tmp_path / "camera.csv").write_text(text)
    with pytest.raises(InputError, match=cause):
        read_camera_csv(tmp_path / "camera.csv")


def test_joined_tables_are_sorted_by_frame_and_refuse_doubles() -> None:
    late = camera_table(2, frame=np.array([5, 6]), status=("ok", "weak"))
    early = camera_table(2, frame=np.array([1, 2]), status=("lost", "ok"))
    joined = join_tables([late, early])
    assert joined.frame.tolist() == [1, 2, 5, 6] and joined.status == ("lost", "ok", "ok", "weak")
    with pytest.raises(ValueError, match="2 frames"):
        join_tables([late, late])


def test_run_json_comes_back_equal(tmp_path: Path) -> None:
    record = run_record((shot_record(0), shot_record(1, status="failed", focal=None)), extra={"note": "x"})
    write_run(tmp_path / "run.json", record)
    back = read_run(tmp_path)
    for name in ("versions", "config", "clip", "timings_s", "world", "warnings", "complete", "extra"):
        assert getattr(back, name) == getattr(record, name), name
    for a, b in zip(back.shots, record.shots, strict=True):
        assert all(getattr(a, f.name) == getattr(b, f.name) for f in fields(type(a)))


def test_run_json_is_valid_json_whatever_numpy_puts_in(tmp_path: Path) -> None:
    odd = {
        "a": np.float64("nan"),
        "b": np.arange(2),
        "c": Path("x"),
        "d": np.int64(3),
        "e": (1, np.inf),
        "f": {"z", "y"},
    }
    assert to_json(odd) == {"a": None, "b": [0, 1], "c": "x", "d": 3, "e": [1, None], "f": ["y", "z"]}
    with pytest.raises(TypeError, match="object"):
        to_json(object())


@pytest.mark.parametrize(
    "text", ["", "{", '{"format": "other"}', '{"format": "broadcast-mosaic run", "format_version": 1}']
)
def test_a_damaged_run_json_is_an_input_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError):
        read_run(tmp_path)


def test_npz_of_the_same_arrays_is_the_same_bytes(tmp_path: Path) -> None:
    arrays = {"H_dst_src": np.eye(3)[None], "status": np.array(["ok"])}
    write_arrays(tmp_path / "a.npz", arrays)
    write_arrays(tmp_path / "b.npz", arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        assert stored["status"].tolist() == ["ok"]
    with pytest.raises(ValueError, match="objects"):
        write_arrays(tmp_path / "c.npz", {"x": np.array([None])})


def test_a_file_gets_its_name_only_when_whole(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("before")
    with pytest.raises(RuntimeError), whole_file(tmp_path / "a") as stream:
        stream.write(b"half")
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_text() == "before"


# ---- the folder


def run_once(out: Path, digest: str, names: tuple[str, ...], text: str = "new") -> None:
    with OutputFolder(out, digest) as folder:
        for name in names:
            folder.stage(name).write_text(text)
        folder.publish(run_record())


def tree(out: Path) -> dict[str, str]:
    return {p.relative_to(out).as_posix(): p.read_text() for p in out.rglob("*") if p.is_file()}


def test_outputs_appear_together_and_nothing_else_stays(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with OutputFolder(out, "d1") as folder:
        folder.write_camera(camera_table(2))
        folder.stage("shot-000/panorama.jpg").write_text("p")
        folder.stage(".scratch-1/frame.yuv").write_text("s")
        assert not (out / "camera.csv").exists() and not (out / "shot-000").exists()
        folder.publish(run_record())
    assert sorted(tree(out)) == ["camera.csv", "camera.jsonl", "run.json", "shot-000/panorama.jpg"]
    run = read_run(out)
    assert run.extra["files"] == sorted(tree(out)) and run.extra["digest"] == "d1"
    assert [p.name for p in out.iterdir() if p.name.startswith(".")] == []


def test_a_failed_run_leaves_earlier_outputs_untouched(tmp_path: Path) -> None:
    run_once(tmp_path, "d1", ("camera.csv", "shot-000/a"), "old")
    before = tree(tmp_path)
    with pytest.raises(RuntimeError), OutputFolder(tmp_path, "d2") as folder:
        folder.stage("camera.csv").write_text("half")
        raise RuntimeError
    assert tree(tmp_path) == before


def test_what_the_run_before_left_over_goes_and_strangers_stay(tmp_path: Path) -> None:
    run_once(tmp_path, "d1", ("camera.csv", "shot-000/a", "shot-001/a"))
    (tmp_path / "mine.txt").write_text("user")
    run_once(tmp_path, "d2", ("camera.csv", "shot-000/a"))
    assert sorted(tree(tmp_path)) == ["camera.csv", "mine.txt", "run.json", "shot-000/a"]
    assert not (tmp_path / "shot-001").exists()


def test_a_lying_run_json_deletes_nothing_outside(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text(json.dumps({"files": ["../victim", str(victim)]}))
    run_once(out, "d1", ("camera.csv",))
    assert victim.read_text() == "precious"


def test_two_runs_in_one_folder_are_refused(tmp_path: Path) -> None:
    with (
        OutputFolder(tmp_path, "d1"),
        pytest.raises(OutputError, match="another run"),
        OutputFolder(tmp_path, "d2"),
    ):
        pass
    with OutputFolder(tmp_path, "d2"):
        pass


def test_a_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    for out in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(OutputError, match="is a file"), OutputFolder(out, "d"):
            pass


def test_a_full_disk_is_the_users_to_mend(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="--resume"), OutputFolder(tmp_path, "d"):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="Input/output") as caught, OutputFolder(tmp_path, "d"):
        raise OSError(errno.EIO, "Input/output error")
    assert not isinstance(caught.value, OutputError)


def interrupted(out: Path, digest: str) -> None:
    with pytest.raises(KeyboardInterrupt), OutputFolder(out, digest) as folder:
        folder.stage("shot-000/panorama.tif").write_text("p0")
        folder.save_shot(shot_record(0, files=("shot-000/panorama.tif",)), camera_table(10))
        folder.stage("shot-001/panorama.tif").write_text("half")
        raise KeyboardInterrupt


def test_finished_shots_are_found_again_by_the_same_run_only(tmp_path: Path) -> None:
    interrupted(tmp_path, "d1")
    assert load_finished_shots(tmp_path, "d2") == []
    with OutputFolder(tmp_path, "d1", resume=True) as folder:
        [(record, rows)] = folder.finished_shots()
        assert record.index == 0 and record.focal == shot_record().focal
        assert_same(rows, camera_table(10))
        folder.publish(run_record((record,)))
    assert tree(tmp_path)["shot-000/panorama.tif"] == "p0"
    assert "shot-000/shot.json" not in tree(tmp_path)


def test_without_resume_an_interrupted_run_is_forgotten(tmp_path: Path) -> None:
    interrupted(tmp_path, "d1")
    with OutputFolder(tmp_path, "d1") as folder:
        assert folder.finished_shots() == [] and not list(folder.staging.iterdir())


def test_a_shot_whose_files_are_not_all_there_is_done_again(tmp_path: Path) -> None:
    interrupted(tmp_path, "d1")
    (tmp_path / ".partial-d1" / "shot-000" / "panorama.tif").unlink()
    assert load_finished_shots(tmp_path, "d1") == []
    interrupted(tmp_path, "d1")
    (tmp_path / ".partial-d1" / "shot-000" / "rows.npz").write_bytes(b"PK")
    assert load_finished_shots(tmp_path, "d1") == []


def test_digest_depends_on_what_changes_results_only() -> None:
    base = run_digest(load_config(), "clip")
    assert base == run_digest(load_config(None, {"run.threads": "3", "run.resume": "true"}), "clip")
    assert base != run_digest(load_config(None, {"shots.min_frames": "11"}), "clip")
    assert base != run_digest(load_config(), "another clip")
