"""The rows of camera.csv for a shot: from a solved track and its verdict to values, error bars, statuses."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calib import rotation
from calib.records import Level, Solution, Verdict
from mosaic.coords import normalise_homography
from mosaic.records import PairFit
from pipelines.links import contradicted_frames
from pipelines.records import CameraTable

WEAK_SIGMA = 0.05  # f_std_px / f_px above which a frame is 'weak' (product.md)
ZOOM_FLOOR_PX = 0.1
INTERPOLATED_INFLATION = 3.0  # error bars of a bridged frame against its neighbours'

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFacts:
    """What is known of a frame without its camera."""

    frame: int
    pts_s: float
    timecode: str
    source_frame: int
    field: int | None
    status: str  # of pass one: 'ok', 'interpolated', 'lost'
    reason: str


def shot_rows(
    *,
    shot: int,
    facts: Sequence[FrameFacts],
    solution: Solution,
    verdict: Verdict,
    level: Level | None,
    fits: Iterable[PairFit],
    doubtful: Collection[int] = (),
    log_f_ref: float | None = None,
) -> CameraTable:
    """camera.csv rows of one shot, a row per frame of `facts`, in their order.

    Frames that the solution lacks are bridged between solved neighbours (status 'interpolated') or 'lost'. Angles are
    in the levelled head frame when `level` is observable, else in the reference camera's axes. doubtful: frames whose
    camera was taken out because no verified pair leads to it. log_f_ref: of the reference frame, where that is a frame
    of another shot in whose axes the solution is; else it is solution.reference.
    """
    n = len(facts)
    width = solution.lens.size_px[0]
    misfit = contradicted_frames(solution)
    row_of = {
        int(f): i for i, f in enumerate(solution.frames) if np.isfinite(solution.log_f[i]) and not misfit[i]
    }
    contradicted = {int(f) for f in solution.frames[misfit]}
    at = np.array([row_of.get(f.frame, -1) for f in facts])
    solved = at >= 0
    log_f, R, status, reason = _filled(facts, solution, at)
    have = np.isfinite(log_f)
    claims = verdict.claims_focal
    overlap = _overlaps(facts, fits)

    sigma_stat = np.where(solved, solution.sigma_log_f[at], np.nan)
    sigma_zoom = np.where(solved, solution.sigma_log_zoom[at], np.nan)
    bridged = have & ~solved
    if solved.any():
        for sigma in (sigma_stat, sigma_zoom):
            known = sigma[solved & np.isfinite(sigma)]
            sigma[bridged] = INTERPOLATED_INFLATION * known.max() if len(known) else np.nan
    # What all frames share beyond the statistical part: lens model, parallax (calib.gates).
    common = float(verdict.sigma_parts.get("cluster", 0.0))
    systematic = float(np.sqrt(max(verdict.sigma_log_f_total**2 - common**2, 0.0))) if claims else np.nan
    sigma_total = np.sqrt(sigma_stat**2 + systematic**2)
    f = np.exp(log_f)
    reference = row_of.get(solution.reference)
    if log_f_ref is None:
        log_f_ref = float(solution.log_f[reference]) if reference is not None else np.nan
    zoom = np.exp(log_f - log_f_ref)
    # What frames share in px, at a quarter of the width from the middle; a shot that cannot say has at least a tenth.
    shared_px = float(np.nan_to_num(verdict.sigma_parts.get("systematic_px", 0.0)))
    zoom_systematic = max(shared_px, ZOOM_FLOOR_PX) / (solution.lens.size_px[0] / 4.0)

    for i in range(n):
        if not have[i]:
            status[i] = "lost"
            if facts[i].frame in doubtful:
                reason[i] = "doubtful_link"
                continue
            reason[i] = "misfit" if facts[i].frame in contradicted else reason[i] or "not_linked"
        elif status[i] == "interpolated":
            reason[i] = reason[i] or "bridged"
        elif not claims:
            status[i], reason[i] = "relative", verdict.reason
        elif sigma_total[i] > WEAK_SIGMA or not np.isfinite(sigma_total[i]):
            status[i], reason[i] = "weak", "focal_error_above_5_percent"
        else:
            status[i], reason[i] = "ok", ""

    K = solution.lens.K(np.where(have, log_f, 0.0))
    world = level.R_head_world if level is not None and level.observable else np.eye(3)
    pan, tilt, roll = rotation.to_pan_tilt_roll(R @ world.T)
    K_ref = solution.lens.K(log_f_ref if np.isfinite(log_f_ref) else 0.0)
    H = normalise_homography(K_ref @ np.swapaxes(R, -1, -2) @ np.linalg.inv(K))
    focal = np.where(have & claims, f, np.nan)
    given = have & claims

    def only(values: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
        return np.where(mask, values, np.nan)

    rms = np.where(solved, solution.rms_px[at], np.nan)
    return CameraTable(
        frame=np.array([x.frame for x in facts], np.int64),
        pts_s=np.array([x.pts_s for x in facts], float),
        timecode=tuple(x.timecode for x in facts),
        source_frame=np.array([x.source_frame for x in facts], np.int64),
        field=np.array([-1 if x.field is None else x.field for x in facts], np.int64),
        shot=np.full(n, shot, np.int64),
        status=tuple(status),
        reason=tuple(reason),
        f_px=focal,
        f_std_px=focal * sigma_total,
        f_stat_px=focal * sigma_stat,
        zoom_ratio=only(zoom, have),
        zoom_ratio_std=only(zoom * np.sqrt(sigma_zoom**2 + zoom_systematic**2), have),
        hfov_deg=np.degrees(2 * np.arctan(width / (2 * focal))),
        pan_deg=only(np.degrees(np.unwrap(np.where(have, pan, 0.0))), given),
        tilt_deg=only(np.degrees(tilt), given),
        roll_deg=only(np.degrees(roll), given),
        cx_px=np.where(given, solution.lens.pp_px[0], np.nan),
        cy_px=np.where(given, solution.lens.pp_px[1], np.nan),
        aspect=np.where(have, solution.lens.aspect, np.nan),
        k1=only(solution.lens.k1_opencv(np.where(have, log_f, 0.0)), given),
        residual_px=rms,
        overlap=only(overlap, have),
        homography=np.where(have[:, None, None], H, np.nan),
    )


def _filled(
    facts: Sequence[FrameFacts], solution: Solution, at: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray, list[str], list[str]]:
    """log f, R, status, reason per fact; single gaps bridged between solved neighbours, in time."""
    n = len(facts)
    log_f = np.where(at >= 0, solution.log_f[at], np.nan)
    R = np.where((at >= 0)[:, None, None], solution.R[at], np.eye(3))
    status = ["ok"] * n
    reason = [""] * n
    known = np.flatnonzero(at >= 0)
    for i in np.flatnonzero(at < 0).tolist():
        status[i], reason[i] = "lost", facts[i].reason or "not_linked"
        before, after = known[known < i], known[known > i]
        if len(before) == 0 or len(after) == 0:
            continue
        a, b = int(before[-1]), int(after[0])
        if b - a > 12:
            continue
        t = (facts[i].pts_s - facts[a].pts_s) / max(facts[b].pts_s - facts[a].pts_s, 1e-9)
        log_f[i] = (1 - t) * log_f[a] + t * log_f[b]
        R[i] = rotation.exp(t * rotation.log(R[b] @ R[a].T)) @ R[a]
        status[i], reason[i] = "interpolated", facts[i].reason or "bridged"
    return log_f, R, status, reason


def _overlaps(facts: Sequence[FrameFacts], fits: Iterable[PairFit]) -> FloatArray:
    best: dict[int, float] = {}
    for fit in fits:
        if fit.usable:
            for frame in (fit.src, fit.dst):
                best[frame] = max(best.get(frame, 0.0), min(fit.overlap, 1.0))
    return np.array([best.get(x.frame, np.nan) for x in facts])


def blank_rows(facts: Sequence[FrameFacts], shot: int, status: str, reason: str) -> CameraTable:
    """Rows of frames without a camera: 'lost' or 'graphic', everything else empty."""
    n = len(facts)
    empty = np.full(n, np.nan)
    values: dict[str, object] = {c.name: empty for c in fields(CameraTable)}
    values |= {
        "frame": np.array([x.frame for x in facts], np.int64),
        "pts_s": np.array([x.pts_s for x in facts], float),
        "timecode": tuple(x.timecode for x in facts),
        "source_frame": np.array([x.source_frame for x in facts], np.int64),
        "field": np.array([-1 if x.field is None else x.field for x in facts], np.int64),
        "shot": np.full(n, shot, np.int64),
        "status": (status,) * n,
        "reason": (reason,) * n,
        "homography": np.full((n, 3, 3), np.nan),
    }
    return CameraTable(**values)  # type: ignore[arg-type]


def concatenate(tables: Sequence[CameraTable]) -> CameraTable:
    """One table of several, ordered by frame. ValueError when a frame comes twice."""
    frames = np.concatenate([t.frame for t in tables]) if tables else np.zeros(0, np.int64)
    order = np.argsort(frames, kind="stable")
    if len(np.unique(frames)) != len(frames):
        raise ValueError("two tables hold the same frame")
    values: dict[str, object] = {}
    for column in fields(CameraTable):
        parts = [getattr(t, column.name) for t in tables]
        if parts and isinstance(parts[0], tuple):
            flat = [x for part in parts for x in part]
            values[column.name] = tuple(flat[i] for i in order)
        else:
            values[column.name] = np.concatenate(parts)[order] if parts else np.zeros(0)
    return CameraTable(**values)  # type: ignore[arg-type]


def status_counts(table: CameraTable) -> Mapping[str, int]:
    """Frames per status, statuses in alphabetical order."""
    return {s: table.status.count(s) for s in sorted(set(table.status))}
