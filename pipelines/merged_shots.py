"""What becomes of shots that one camera took: rows, files and records in the world of the first, and one panorama.

Which shots these are: merging.py. Shots that stay by themselves are as they were written, byte for byte.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mosaic.records import PairFit
from pipelines.archive import to_json, write_arrays
from pipelines.bridge import CameraPlacement
from pipelines.camera_track import frame_poses, placements_of, repeated_from
from pipelines.config import Config
from pipelines.kept_shots import KeptShot, ShotShelf, rest
from pipelines.links import contradicted_frames, without_doubtful
from pipelines.merged_panorama import panorama_of
from pipelines.merging import Group, find_groups
from pipelines.moments import trail
from pipelines.output_folder import OutputFolder
from pipelines.records import CameraTable, ShotRecord
from pipelines.shot import CalibratedShot
from pipelines.shot_files import pair_arrays, panorama_facts, shot_record, write_panorama
from pipelines.table import shot_rows

Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Member:
    """A merged shot with its cameras in the group's world."""

    kept: KeptShot
    solved: CalibratedShot
    placements: list[CameraPlacement]


def merge_shots(
    shelf: ShotShelf,
    records: list[ShotRecord],
    tables: list[CameraTable],
    *,
    config: Config,
    folder: OutputFolder,
    scratch: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Merge what is one camera; records and tables (one a shot, by number) are replaced in place.

    Returns what run.json says under `merging`: groups with their files, and every attempt with its evidence.
    """
    progress("merge", 0, None)
    groups, attempts = find_groups(shelf, config)
    told = []
    merged = [group for group in groups if len(group.members) > 1]
    for number, group in enumerate(merged):
        name = f"merged-{number:03d}"
        members = [_member(group, shelf.load(i)) for i in group.members]
        for member in members:
            index = member.kept.index
            _rewrite(group, member, shelf, records, config, folder, scratch, progress)
            tables[index] = member.solved.rows
            folder.save_shot(records[index], tables[index])
        told.append(_whole(name, group, members, shelf, config, folder, scratch, progress))
    return dict(to_json({"groups": told, "attempts": [a.as_dict() for a in attempts]}))


def _member(group: Group, kept: KeptShot) -> _Member:
    """The shot's frames against the group's keyframes, and their rows in the group's world."""
    result, fits = group.result, kept.solved.fits
    solution = frame_poses(kept.tracker(), result, [*fits, *kept.solved.steps])
    # Which frames hang on verified pairs is asked within the shot: the group's reference may be in another one.
    keyframes = sorted(kept.keyframes)
    solved = {int(f) for f in result.solution.frames[np.isfinite(result.solution.log_f)]}
    own = kept.solved.keyframes.solution.reference
    local = own if own in solved else next(k for k in keyframes if k in solved)
    keyed = [f for f in fits if f.src in kept.keyframes]
    solution, doubtful = without_doubtful(
        replace(solution, reference=local), [*result.fits, *keyed], repeated_from(kept.observations)
    )
    log_f_ref = float(result.solution.log_f[result.solution.index(result.solution.reference)])
    rows = shot_rows(
        shot=kept.index, facts=kept.facts, solution=solution, verdict=group.verdict, level=group.level, fits=fits,
        doubtful=doubtful, log_f_ref=log_f_ref,
    )  # fmt: skip
    fitting = replace(solution, log_f=np.where(contradicted_frames(solution), np.nan, solution.log_f))
    world = group.level.R_head_world if group.level.observable else np.eye(3)
    placements = placements_of(fitting, world, kept.observations, kept.size_px, result)
    calibrated = replace(
        kept.solved, solution=solution, verdict=group.verdict, level=group.level, keyframes=result, rows=rows
    )
    return _Member(kept=kept, solved=calibrated, placements=placements)


def _rewrite(
    group: Group, member: _Member, shelf: ShotShelf, records: list[ShotRecord], config: Config,
    folder: OutputFolder, scratch: Path, progress: Progress,
) -> None:  # fmt: skip
    """The shot's own panorama and record again, in the group's world. pairs.npz stays: its pairs are the same."""
    index = member.kept.index
    before, store, shot = records[index], shelf.store(index), member.solved
    facts, files = before.panorama, before.files
    if store is not None and any(p.frame in store for p in member.placements):
        panorama = panorama_of(
            [store], member.placements, config, scratch,
            lambda share: progress("merge", round(share * 100), 100),
        )  # fmt: skip
        players = None
        if shot.trail is not None:
            moments = [k for k in shot.trail.frames if k in store and k in panorama.placements]
            players = trail(panorama, store, moments, str(scratch))
        shot = replace(shot, panorama=panorama, trail=players)
        name = f"shot-{index:03d}"
        files = (f"{name}/pairs.npz", *write_panorama(folder, name, shot, config, axes_of=group.first))
        facts = to_json(panorama_facts(panorama))
        panorama.release()
        rest(store)
    record = shot_record(index, member.kept.tracker(), shot, files, facts)
    records[index] = replace(
        record,
        reference_frame=group.result.solution.reference,
        timings_s=before.timings_s,
        warnings=before.warnings,
        merged_into=None if index == group.first else group.first,
    )


def _whole(
    name: str, group: Group, members: list[_Member], shelf: ShotShelf, config: Config, folder: OutputFolder,
    scratch: Path, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Stage OUT/merged-NNN/: the pairs that hold the shots together, and their panorama. What run.json says of it."""
    across = [f for f in group.result.fits if group.owner[f.src] != group.owner[f.dst]]
    shot = members[0].solved
    graph = replace(shot.graph, frames=group.result.solution.frames, fits=tuple(across))
    files = [f"{name}/pairs.npz"]
    write_arrays(folder.stage(files[0]), pair_arrays(replace(shot, graph=graph)))
    stores = [store for i in group.members if (store := shelf.store(i)) is not None]
    facts = None
    placements = [p for m in members for p in m.placements]
    if any(p.frame in store for p in placements for store in stores):
        panorama = panorama_of(
            stores, placements, config, scratch,
            lambda share: progress("merge", round(share * 100), 100),
        )  # fmt: skip
        whole = replace(shot, panorama=panorama, trail=None)
        files += write_panorama(folder, name, whole, config, axes_of=group.first)
        facts = panorama_facts(panorama)
        facts["frames_of_shots"] = {
            str(m.kept.index): len({p.frame for p in m.placements} & set(panorama.frames)) for m in members
        }
        panorama.release()
        for store in stores:
            rest(store)
    return {
        "folder": name,
        "shots": list(group.members),
        "reference_frame": group.result.solution.reference,
        "world_of_shot": group.first,
        "pairs_across": _pairs_across(group, across),
        "sigma_relative": group.verdict.sigma_log_f_total,
        "panorama": facts,
        "files": files,
    }


def _pairs_across(group: Group, across: list[PairFit]) -> int:
    """Usable pairs between keyframes of different shots that the joint calibration kept."""
    held = {
        (e.a, e.b)
        for e, ok in zip(group.result.graph.edges, group.result.solution.edge_ok, strict=True)
        if ok
    }
    return sum((f.src, f.dst) in held for f in across)
