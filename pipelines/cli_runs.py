"""What a call of `run` says at its end: of one clip or of each of many, and the exit code. No computation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.errors import EXIT_OK, EXIT_SHOTS_FAILED, EXIT_USAGE

if TYPE_CHECKING:
    from pipelines.records import RunRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """One clip, its folder, and either the record of its run or the error as UserError.as_dict gives it."""

    clip: Path
    out: Path
    record: RunRecord | None = None
    error: Mapping[str, str] | None = None

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready, as `--json` prints it."""
        from pipelines.archive import run_as_dict

        run = run_as_dict(self.record) if self.record is not None else None
        return {"clip": str(self.clip), "out": str(self.out), "error": self.error, "run": run}

    def failures(self) -> Iterator[str]:
        """A line for each shot that failed; one when no shot was found."""
        if self.record is None:
            return
        for shot in self.record.shots:
            if shot.status == "failed":
                yield f"{self.clip}: shot {shot.index} failed: {shot.sentence or shot.reason}"
        if not self.record.shots:
            yield f"{self.clip}: no shot was found"


def exit_code(results: Sequence[RunResult]) -> int:
    """2 when a clip could not be used, 1 when a shot failed, none was found, or the program failed; else 0."""
    errors = [result.error["kind"] for result in results if result.error is not None]
    if any(kind not in ("bug", "crash") for kind in errors):
        return EXIT_USAGE
    records = [result.record for result in results if result.record is not None]
    failed = any(
        not record.shots or any(shot.status == "failed" for shot in record.shots) for record in records
    )
    return EXIT_SHOTS_FAILED if errors or failed else EXIT_OK
