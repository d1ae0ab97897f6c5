"""The folder of a run: one writer at a time, earlier outputs untouched until the new ones are whole, resume.

Everything is written into OUT/.partial-<digest>/ and moved to its final name at the end, run.json last. The digest
stands for clip and settings, so that --resume finds only shots that this very run would make again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import IO, Any, Self

from pipelines.archive import (
    program_version,
    read_table_arrays,
    run_as_dict,
    shot_from_dict,
    to_json,
    write_camera_csv,
    write_camera_jsonl,
    write_camera_parquet,
    write_json,
    write_table_arrays,
)
from pipelines.config import Config
from pipelines.errors import OutputError
from pipelines.records import CameraTable, RunRecord, ShotRecord

LOCK = ".lock"
# EFBIG: the file system's or the account's limit on one file.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
PARTIAL = ".partial-"
STATE = ("shot.json", "rows.npz")  # what resume needs of a finished shot; not an output

# Settings that change how fast a run is or what is written beside it, not what a shot's results are.
NOT_IN_DIGEST = (
    ("run", "resume"),
    ("run", "threads"),
    ("decode", "threads"),
    ("decode", "queue_frames"),
    ("decode", "stdin_max_gb"),
    ("output", "parquet"),
    ("output", "exports"),
)


def run_digest(config: Config, clip_identity: str) -> str:
    """Sixteen hex digits for clip content, settings that matter to a result, and version of the program."""
    settings = config.as_dict()
    for section, key in NOT_IN_DIGEST:
        settings[section].pop(key)
    text = json.dumps([program_version(), clip_identity, settings], sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class OutputFolder:
    """`with OutputFolder(out, digest, resume=...) as folder:` then stage files, save shots, and `publish` once.

    Raises OutputError on entering: not a folder, not writable, in use. On an exception inside, finished shots stay for
    --resume, everything else that was staged goes; what lay in OUT before is as it was.
    """

    def __init__(self, out: str | Path, digest: str, *, resume: bool = False) -> None:
        self.out = Path(out)
        self.digest = digest
        self.resume = resume
        self.staging = self.out / f"{PARTIAL}{digest}"
        self._lock: IO[bytes] | None = None
        self._made = False

    def __enter__(self) -> Self:
        try:
            self._made = not self.out.exists()
            self.out.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise OutputError(self.out, "is a file, not a folder", "choose another folder with -o") from None
        except OSError as error:
            raise OutputError(
                self.out, f"cannot be made ({error.strerror})", "choose another folder with -o"
            ) from None
        try:
            self._lock = _take_lock(self.out)
            for old in self.out.glob(f"{PARTIAL}*"):
                if not (self.resume and old == self.staging):
                    shutil.rmtree(old)
            self.staging.mkdir(exist_ok=True)
            # Scratch of a run that was killed may be gigabytes, and a resume has no use for it.
            for scratch in self.staging.glob(".*"):
                if scratch.is_dir():
                    shutil.rmtree(scratch)
        except OSError as error:
            self._release()
            cause = f"cannot be written ({error.strerror})"
            raise OutputError(self.out, cause, "choose another folder with -o") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None or not any(self.staging.glob("*/shot.json")):
                shutil.rmtree(self.staging, ignore_errors=True)
        finally:
            self._release()
        if self._made and not any(self.out.iterdir()):
            self.out.rmdir()  # an unusable clip leaves nothing behind
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            raise OutputError(
                self.out, str(error.strerror).lower(), "make room and run again with --resume"
            ) from error

    def stage(self, name: str) -> Path:
        """Where to write the output that will be OUT/name; its folder exists."""
        path = self.staging / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_camera(self, table: CameraTable, *, parquet: bool = False) -> None:
        """camera.csv, camera.jsonl and, if asked for, camera.parquet."""
        write_camera_csv(self.stage("camera.csv"), table)
        write_camera_jsonl(self.stage("camera.jsonl"), table)
        if parquet:
            write_camera_parquet(self.stage("camera.parquet"), table)

    def save_shot(self, record: ShotRecord, rows: CameraTable) -> None:
        """Keep a finished shot for --resume. Its files (record.files) must have been staged."""
        save_shot(self.staging, record, rows)

    def finished_shots(self) -> list[tuple[ShotRecord, CameraTable]]:
        """Shots that an interrupted run of the same digest finished; [] without --resume."""
        return load_finished_shots(self.out, self.digest) if self.resume else []

    def publish(self, record: RunRecord) -> None:
        """Give every staged file its final name, run.json last, and remove what the run before left over.

        run.json gets `files` (all of them) and `digest` beside the record's own values.
        """
        names = [path.relative_to(self.staging) for path in self.staging.rglob("*") if path.is_file()]
        # Hidden names are scratch of the stages, whole folders of it included.
        kept = [n for n in names if n.name not in STATE and not any(part.startswith(".") for part in n.parts)]
        files = sorted(n.as_posix() for n in kept)
        self._refuse_blocked(files)
        stale = _files_of_earlier_run(self.out) - set(files) - {"run.json"}
        data = {**run_as_dict(record), "digest": self.digest, "files": sorted({*files, "run.json"})}
        write_json(self.staging / "run.json", data)
        (self.staging / ".publishing").touch()
        for name in [*(f for f in files if f != "run.json"), "run.json"]:
            target = self.out / name
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.staging / name, target)
        for name in stale:
            (self.out / name).unlink(missing_ok=True)
            folder = (self.out / name).parent
            while folder != self.out and folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
                folder = folder.parent

    def _refuse_blocked(self, files: Iterable[str]) -> None:
        """Raises OutputError, before anything is replaced: a user's folder stands where a file goes, or the reverse."""
        for name in files:
            target = self.out / name
            parents = [place for place in target.parents if self.out in place.parents]
            blocked = next((place for place in parents if place.exists() and not place.is_dir()), None)
            if blocked is not None or target.is_dir():
                cause = "is in the way of the results"
                raise OutputError(blocked or target, cause, "move it, or choose another folder with -o")

    def _release(self) -> None:
        if self._lock is not None:
            (self.out / LOCK).unlink(missing_ok=True)
            self._lock.close()
            self._lock = None


@contextmanager
def held_folder(out: Path) -> Iterator[None]:
    """OUT, made if need be, with its lock held and nothing else done to it: for the folder above those of many clips.

    Raises OutputError: it cannot be made or written, or another run uses it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = _take_lock(out)
    except (FileExistsError, NotADirectoryError):
        raise OutputError(out, "is a file, not a folder", "choose another folder with -o") from None
    except OSError as error:
        cause = f"cannot be written ({error.strerror})"
        raise OutputError(out, cause, "choose another folder with -o") from None
    try:
        yield
    finally:
        (out / LOCK).unlink(missing_ok=True)
        lock.close()


def save_shot(staging: Path, record: ShotRecord, rows: CameraTable) -> None:
    """Rows first, then shot.json: the shot counts as finished when that has its name."""
    folder = staging / f"shot-{record.index:03d}"
    write_table_arrays(folder / "rows.npz", rows)
    values = {name: getattr(record, name) for name in record.__slots__}
    write_json(folder / "shot.json", to_json(values))


def load_finished_shots(out: str | Path, digest: str) -> list[tuple[ShotRecord, CameraTable]]:
    """Finished shots of an interrupted run with this digest, by index; one that is not whole is left out."""
    staging = Path(out) / f"{PARTIAL}{digest}"
    publishing = (staging / ".publishing").exists()
    found = []
    for path in sorted(staging.glob("shot-*/shot.json")):
        try:
            record = shot_from_dict(json.loads(path.read_text(encoding="utf-8")))
            rows = read_table_arrays(path.with_name("rows.npz"))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        places = [staging, Path(out)] if publishing else [staging]
        if all(any((place / name).is_file() for place in places) for name in record.files):
            found.append((record, rows))
    return sorted(found, key=lambda shot: shot[0].index)


def _files_of_earlier_run(out: Path) -> set[str]:
    """What the run.json in OUT says it wrote: names inside OUT only, whatever that file claims."""
    try:
        data = json.loads((out / "run.json").read_text(encoding="utf-8"))
        names = [str(name) for name in data["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {n for n in names if not PurePosixPath(n).is_absolute() and ".." not in PurePosixPath(n).parts}


def _take_lock(out: Path) -> IO[bytes]:
    """An advisory lock that the system drops when the process dies. Raises OutputError: somebody holds it."""
    path = out / LOCK
    for _ in range(100):
        stream = path.open("ab")
        try:
            lock_now(stream)
        except OSError as error:
            stream.close()
            if error.errno not in (errno.EACCES, errno.EAGAIN, errno.EWOULDBLOCK, errno.EDEADLK):
                raise
            cause = "another run is writing into this folder"
            raise OutputError(out, cause, "wait for it, or choose another folder with -o") from None
        # The holder before us removes the file when it ends: a lock on a file without a name guards nothing.
        try:
            if os.path.samestat(os.fstat(stream.fileno()), path.stat()):
                return stream
        except FileNotFoundError:
            pass
        stream.close()
    raise OutputError(out, "its lock file keeps changing", "see that no other run uses this folder")


def lock_now(stream: IO[Any]) -> None:
    """An advisory lock on an open file, until it is closed. Raises OSError: somebody else holds it."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        return
    fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
