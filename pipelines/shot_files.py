"""The files of one shot's folder and its record: panorama in all its forms, pairs.npz, thumbnail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib import rotation
from mosaic.composite import Panorama
from pipelines.archive import to_json, write_arrays
from pipelines.bridge import CameraPlacement
from pipelines.calibration_facts import calibration_facts
from pipelines.config import Config
from pipelines.exports.panorama_deepzoom import write_panorama_deepzoom
from pipelines.exports.panorama_jpeg import write_panorama_jpeg
from pipelines.exports.panorama_json import write_panorama_json
from pipelines.exports.panorama_png import write_panorama_png
from pipelines.exports.panorama_tiff import write_panorama_tiff
from pipelines.exports.pto import PtoFrame, write_pto
from pipelines.film import NAME as FILM
from pipelines.film import PICTURES, small_jpeg, write_film
from pipelines.output_folder import OutputFolder
from pipelines.records import ShotRecord
from pipelines.shot import CalibratedShot
from pipelines.table import status_counts
from pipelines.tracking import ShotTracker

OUTLINES = 200  # frames whose outline the report can draw


def write_shot(
    folder: OutputFolder, index: int, tracker: ShotTracker, shot: CalibratedShot, config: Config
) -> ShotRecord:
    """Stage OUT/shot-NNN/ and return the shot's record."""
    name = f"shot-{index:03d}"
    files = [f"{name}/pairs.npz"]
    write_arrays(folder.stage(files[0]), pair_arrays(shot))
    write_film(folder.stage(f"{name}/{FILM}"), shot.film)
    panorama: dict[str, Any] | None = None
    if shot.panorama is not None:
        files += write_panorama(folder, name, shot, config)
        panorama = panorama_facts(shot.panorama)
        if shot.trail is not None:
            panorama["moments"] = list(shot.trail.frames)
        shot.panorama.release()
    return shot_record(index, tracker, shot, files, panorama)


def shot_record(
    index: int,
    tracker: ShotTracker,
    shot: CalibratedShot,
    files: Sequence[str],
    panorama: Mapping[str, Any] | None,
) -> ShotRecord:
    """What run.json says of a shot whose files are written."""
    rows = shot.rows
    counts = status_counts(rows)
    solved = np.isfinite(rows.zoom_ratio)
    claimed = np.isfinite(rows.f_px)
    focal = None
    if claimed.any():
        focal = {
            "min_px": float(rows.f_px[claimed].min()),
            "max_px": float(rows.f_px[claimed].max()),
            "median_std_px": float(np.median(rows.f_std_px[claimed])),
            "median_relative_std": float(np.median(rows.f_std_px[claimed] / rows.f_px[claimed])),
        }
    if shot.refused:
        status, reason, sentence = "failed", shot.verdict.reason, shot.verdict.sentence
    elif not solved.any():
        status, reason, sentence = (
            "failed",
            "not_linked",
            "No frame of the shot could be registered to another.",
        )
    elif focal is None:
        status, reason, sentence = "relative", shot.verdict.reason, shot.verdict.sentence
    else:
        status, reason, sentence = "ok", "", shot.verdict.sentence
    return ShotRecord(
        index=index,
        first_frame=int(rows.frame[0]),
        last_frame=int(rows.frame[-1]),
        reference_frame=int(shot.solution.reference),
        status=status,
        reason=reason,
        sentence=sentence,
        focal=focal,
        calibration=to_json(calibration_facts(shot, tracker)),
        panorama=to_json(panorama),
        files=tuple(files),
        status_counts=counts,
        timings_s=dict(shot.timings.seconds),
        warnings=_warnings(tracker, shot),
    )


def pair_arrays(shot: CalibratedShot) -> dict[str, Any]:
    """pairs.npz: every pair of the shot's graph, row by row; flow grids in one long array with `flow_start` offsets."""
    fits = shot.graph.fits
    counts = np.array([len(f.flow.cell) for f in fits], np.int64)
    return {
        "src": np.array([f.src for f in fits], np.int64),
        "dst": np.array([f.dst for f in fits], np.int64),
        "H_dst_src": np.array([f.H_dst_src for f in fits]).reshape(-1, 3, 3),
        "status": np.array([str(f.status) for f in fits], "U8"),
        "reason": np.array([f.reason for f in fits], "U16"),
        "route": np.array([f.route for f in fits], "U24"),
        "overlap": np.array([f.overlap for f in fits]),
        "rms_grey": np.array([f.rms_grey for f in fits]),
        "score": np.array([f.score for f in fits]),
        "gain": np.array([f.gain for f in fits]),
        "offset": np.array([f.offset for f in fits]),
        "anchors_px": np.array([f.anchors_px for f in fits]).reshape(-1, 4, 2),
        "info": np.array([f.info for f in fits], np.float32).reshape(-1, 8, 8),
        "flow_start": np.concatenate([[0], np.cumsum(counts)]),
        "flow_cell": np.concatenate([f.flow.cell for f in fits]) if fits else np.zeros(0, np.int64),
        "flow_src_px": np.concatenate([f.flow.src_px for f in fits]) if fits else np.zeros((0, 2)),
        "flow_dst_px": np.concatenate([f.flow.dst_px for f in fits]) if fits else np.zeros((0, 2)),
        "flow_info": np.concatenate([f.flow.info for f in fits]).astype(np.float32)
        if fits
        else np.zeros((0, 2, 2)),
        "size_px": np.array(shot.graph.size_px, np.int64),
    }


def panorama_facts(panorama: Panorama) -> dict[str, Any]:
    """What run.json and the report need of a panorama; outlines of frames in panorama pixels."""
    surface = panorama.surface
    frames = sorted(panorama.placements)
    stride = max(1, len(frames) // OUTLINES)
    outlines = {}
    for frame in frames[::stride]:
        placement = panorama.placements[frame]
        w, h = placement.size_px
        corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
        border = np.concatenate(
            [
                corners[i]
                + np.linspace(0, 1, 6, endpoint=False)[:, None] * (corners[(i + 1) % 4] - corners[i])
                for i in range(4)
            ]
        )
        pixels = panorama.frame_to_pixel(frame, border)
        if np.isfinite(pixels).all():
            outlines[str(frame)] = np.round(pixels, 1).tolist()
    return {
        "projection": surface.kind,
        "size_px": [surface.width, surface.height],
        "scale_px": surface.scale_px,
        "cx": surface.cx,
        "cy": surface.cy,
        "frames": len(panorama.frames),
        "seen_share": float((np.asarray(panorama.alpha) > 0).mean()),
        "outlines": outlines,
    }


def thumbnails(tracker: ShotTracker) -> dict[int, bytes]:
    """Frame -> small gray JPEG of keyframes of the shot, at most PICTURES of them, first and last included.

    For a shot that has no film of its own (film.py): no picture of it was stored in colour.
    """
    keys = sorted(tracker.keyframes)
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(len(keys), PICTURES)).round().astype(int))
    encoded = {keys[i]: small_jpeg(tracker.keyframes[keys[i]].small) for i in chosen}
    return {int(key): jpeg for key, jpeg in encoded.items() if jpeg}


def write_panorama(
    folder: OutputFolder, name: str, shot: CalibratedShot, config: Config, *, axes_of: int | None = None
) -> list[str]:
    """Stage panorama.tif, .jpg, .json and .pto of a shot; -moments.jpg, .png, .dzi where asked for. Returns names.

    axes_of: the shot whose axes the rays are in, where shots were merged.
    """
    panorama = shot.panorama
    assert panorama is not None  # the caller asked
    world = "levelled: y along the pan axis" if shot.level.observable else "reference camera"
    if axes_of is not None:
        world += f", of shot {axes_of}"
    if not shot.verdict.claims_focal:
        world += "; the focal length is not known, so rays are relative to a nominal one"
    names = [f"{name}/panorama.{kind}" for kind in ("tif", "jpg", "json", "pto")]
    paths = [folder.stage(n) for n in names]
    write_panorama_tiff(panorama, paths[0], threads=2)
    write_panorama_jpeg(panorama, paths[1], max_width_px=config.output.jpeg_max_width)
    write_panorama_json(panorama, paths[2], world=world, parallax=_parallax_facts(panorama))
    write_pto(paths[3], panorama.surface, pto_frames(panorama))
    if shot.trail is not None:
        names.append(f"{name}/panorama-moments.jpg")
        busy = replace(panorama, image=shot.trail.image)
        write_panorama_jpeg(busy, folder.stage(names[-1]), max_width_px=config.output.jpeg_max_width)
    if config.output.png:
        names.append(f"{name}/panorama.png")
        write_panorama_png(panorama, folder.stage(names[-1]))
    if config.output.deepzoom:
        start = folder.stage(f"{name}/panorama.dzi")
        written = write_panorama_deepzoom(panorama, start)
        names += [f"{name}/{path.relative_to(start.parent).as_posix()}" for path in written]
    return names


def _parallax_facts(panorama: Panorama) -> dict[str, Any] | None:
    """The pupil's parallax in the axes of the panorama's rays, as panorama.json has it."""
    placement = next(iter(panorama.placements.values()))
    parallax = placement.parallax if isinstance(placement, CameraPlacement) else None
    if parallax is None:
        return None
    return {
        "over_height": parallax.over_height,
        "over_stand": parallax.over_stand,
        "R_head_world": parallax.R_head_world.tolist(),
        "meaning": "a frame with optical axis a sees the ray d at d - max(over_height down, over_stand along) a; "
        "down and along: the parts of d on the head's y axis (from 0) and across it",
    }


def pto_frames(panorama: Panorama) -> list[PtoFrame]:
    """The composited frames as Hugin cameras. The file names are those an extraction of the frames would have."""
    frames = []
    for frame in panorama.frames:
        placement = panorama.placements[frame]
        assert isinstance(placement, CameraPlacement)
        pan, tilt, roll = rotation.to_pan_tilt_roll(placement.pose.R)
        frames.append(
            PtoFrame(
                name=f"frame_{frame:06d}.png",
                size_px=placement.size_px,
                f_px=placement.px_per_rad,
                pan_rad=float(pan),
                tilt_rad=float(tilt),
                roll_rad=float(roll),
                cx_px=float(placement.lens.pp_px[0]),
                cy_px=float(placement.lens.pp_px[1]),
                k1=float(placement.lens.k1_opencv(placement.pose.log_f)),
            )
        )
    return frames


def _warnings(tracker: ShotTracker, shot: CalibratedShot) -> tuple[str, ...]:
    said = [] if shot.panorama is not None else [f"no panorama: {shot.no_panorama}"]
    if tracker.crowded:
        said.append(
            f"people fill {len(tracker.crowded)} pictures: these were registered by the scene between them"
        )
    return tuple(said)
