"""The clip with a picture put into the scene: a board or logo that stays where it is, with the players in front of it.

Its corners are given in one frame's pixels, in panorama pixels, as pan and tilt, or on the pitch in metres; they become
directions of the shot's world, and those are drawn through each frame's camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.errors import InputError
from pipelines.exports.panorama_json import read_surface
from pipelines.pitch import Pitch
from pipelines.progress import Progress, silent
from pipelines.rays import pan_tilt_to_ray
from pipelines.render.encode import EncodeOptions
from pipelines.render.inlay import Inlay, draw, place, read_picture
from pipelines.render.job import (
    Rendered,
    chosen_rows,
    full_scale,
    pictures,
    stretches,
    to_8_bits,
    writer_like,
)
from pipelines.render.matte import MatteOptions, difference, front_matte
from pipelines.render.opened import OpenedRun, one_shot, open_its_clip
from pipelines.render.plate import Plate, fit_light, read_plate
from pipelines.render.views import View

FloatArray = NDArray[np.float64]
CornerSpace = Literal["frame", "panorama", "pan-tilt", "pitch", "rays"]

LIGHT_STEP = 4  # the light of the whole frame is measured on pictures of a quarter of the width
PAD_PX = 32  # beside the inlay, so that a player who is half in front of it is seen whole enough to be one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OverlayOptions:
    """corners: of the picture, top left, top right, bottom right, bottom left, as `space` says:

    'frame' px of frame `at` (4, 2), 'panorama' px (4, 2), 'pan-tilt' degrees (4, 2), 'pitch' m on the pitch (4, 2),
    which needs `pitch`, 'rays' directions (4, 3) in the shot's world. opacity 0..1. in_front: over the players too,
    which needs no panorama. shot: whose world is meant, and only its frames are written; None: the shot of frame `at`
    or the only one, and the whole clip is written.
    """

    picture: str | Path
    corners: ArrayLike
    space: CornerSpace = "frame"
    at: int | None = None
    opacity: float = 1.0
    in_front: bool = False
    shot: int | None = None
    sound: bool = True
    clip: Path | None = None
    pitch: Pitch | None = None
    matte: MatteOptions = field(default_factory=MatteOptions)


def overlay(
    run: OpenedRun,
    path: Path,
    options: OverlayOptions,
    *,
    encode: EncodeOptions | None = None,
    progress: Progress = silent,
) -> Rendered:
    """Write the clip with the picture in it. Raises InputError: the corners, the frame, the picture, the panorama or
    the clip; OutputError: cannot be written."""
    index, views = _shot_and_views(run, options)
    rays = corner_rays(run, index, views, options)
    levels = read_picture(Path(options.picture))
    try:
        inlay = place(levels, rays)
    except ValueError as error:
        raise InputError(
            "corners", str(error), "give top left, top right, bottom right, bottom left"
        ) from None
    plate = None if options.in_front else read_plate(run.panorama_path(index))
    rows = chosen_rows(run, options.shot)
    drawn = 0
    covered = unknown = 0.0
    with (
        open_its_clip(run, options.clip) as clip,
        writer_like(run, clip, rows, path, sound=options.sound, encode=encode, mixed=True) as writer,
    ):
        for row, picture in pictures(run, clip, rows, progress, "overlay", encode, mixed=True):
            if row in views:
                found = inserted(picture, inlay, views[row], plate, options)
                if found is not None:
                    picture, area, blind = found
                    drawn, covered, unknown = drawn + 1, covered + area, unknown + blind
            writer.write(picture)
        sound = writer.sound
    return Rendered(
        path=path,
        what="overlay",
        size_px=run.size_px,
        n_frames=len(rows),
        n_changed=drawn,
        sound=sound,
        passed=stretches(run, [row for row in rows if row not in views]),
        facts={
            "shot": index,
            "corner_rays": rays.tolist(),
            "behind_players": plate is not None,
            "unknown_share": unknown / covered if covered and plate is not None else None,
        },
    )


def corner_rays(run: OpenedRun, index: int, views: dict[int, View], options: OverlayOptions) -> FloatArray:
    """Directions (4, 3) of the corners in the shot's world. Raises InputError: shape, or a corner that has none."""
    corners = np.asarray(options.corners, np.float64)
    size = 3 if options.space == "rays" else 2
    if corners.shape != (4, size) or not np.isfinite(corners).all():
        raise InputError("corners", f"are {corners.shape}, not four of {size} numbers", "give four corners")
    if options.space == "rays":
        return corners
    if options.space == "pan-tilt":
        return pan_tilt_to_ray(corners)
    if options.space == "pitch":
        if options.pitch is None:
            raise InputError(
                "corners", "are metres on the pitch, but where is it", "give clicked points with --clicks"
            )
        try:
            return options.pitch.to_rays(corners)
        except ValueError as error:
            raise InputError("corners", str(error), "check the metres") from None
    if options.space == "panorama":
        return read_surface(run.panorama_path(index).with_suffix(".json")).pixel_to_ray(corners)
    rays = views[run.rows[options.at or 0]].pixel_to_ray(corners)
    if not np.isfinite(rays).all():
        raise InputError("corners", "the lens model has no such point", "keep them nearer to the picture")
    return rays


def inserted(
    picture: NDArray[Any], inlay: Inlay, view: View, plate: Plate | None, options: OverlayOptions
) -> tuple[NDArray[Any], float, float] | None:
    """A frame with the inlay in it; px that it covers, and px of those where the plate was never seen.

    picture: uint8, or uint16 of 0..65535. None where the inlay is not in the picture.
    """
    found = draw(inlay, view)
    if found is None:
        return None
    (rows, columns), rgba = found
    rgba = rgba * np.float32(options.opacity)
    area, blind = float((rgba[..., 3] > 0).sum()), 0.0
    if area == 0:
        return None
    if plate is not None:
        front, known = players_in_front(to_8_bits(picture), view, plate, (rows, columns), options.matte)
        blind = float(((rgba[..., 3] > 0) & ~known).sum())
        rgba = rgba * (1 - front[..., None])
    out = picture.copy()
    under = out[rows, columns].astype(np.float32)
    white = full_scale(picture)
    mixed = under * (1 - rgba[..., 3:] / 255) + rgba[..., :3] * np.float32(white / 255)
    out[rows, columns] = np.clip(mixed + 0.5, 0, white).astype(picture.dtype)
    return out, area, blind


def players_in_front(
    picture: NDArray[np.uint8],
    view: View,
    plate: Plate,
    box: tuple[slice, slice],
    options: MatteOptions,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Matte 0..1 of what stands before the plate in a box of a frame, and where the plate was seen there."""
    h, w = picture.shape[:2]
    coarse = cv2.resize(
        picture[: h - h % LIGHT_STEP, : w - w % LIGHT_STEP],
        (w // LIGHT_STEP, h // LIGHT_STEP),
        interpolation=cv2.INTER_AREA,
    ).astype(np.uint8, copy=False)
    light = fit_light(coarse, *plate.seen_by(view.reduced(LIGHT_STEP)))
    rows = slice(max(box[0].start - PAD_PX, 0), min(box[0].stop + PAD_PX, h))
    columns = slice(max(box[1].start - PAD_PX, 0), min(box[1].stop + PAD_PX, w))
    behind, known = plate.seen_by(view.cropped(rows, columns))
    matte = front_matte(difference(picture[rows, columns], behind, known, light), options, w)
    inner = (
        slice(box[0].start - rows.start, box[0].stop - rows.start),
        slice(box[1].start - columns.start, box[1].stop - columns.start),
    )
    return matte[inner], known[inner]


def _shot_and_views(run: OpenedRun, options: OverlayOptions) -> tuple[int, dict[int, View]]:
    """The shot whose world the corners are in, and its views; everything that can be wrong about it is said here."""
    if options.space == "frame":
        if options.at is None:
            raise InputError("corners", "are in px, but of which frame", "give its number with --at")
        row = run.rows.get(options.at)
        if row is None:
            numbers = run.table.frame
            raise InputError(
                f"frame {options.at}", "is not in this run", f"it has {numbers[0]} to {numbers[-1]}"
            )
        index = int(run.table.shot[row])
        if index < 0 or (options.shot is not None and options.shot != index):
            where = f"is in shot {index}" if index >= 0 else "belongs to no shot"
            raise InputError(f"frame {options.at}", where, "choose a frame of the shot that is meant")
        views = run.shot_views(index)
        if row not in views:
            cause = f"is {run.table.status[row] or 'without a camera'}, so its pixels have no direction"
            raise InputError(f"frame {options.at}", cause, "choose another frame of the shot")
    else:
        if (
            options.space == "pitch"
            and options.pitch is not None
            and options.shot in (None, options.pitch.shot)
        ):
            return options.pitch.shot, run.shot_views(options.pitch.shot)
        calibrated = [record.index for record in run.record.shots if run.calibrated(record.index)]
        index = one_shot(run, calibrated, options.shot, "no shot has a calibrated camera")
        views = run.shot_views(index)
    if not run.calibrated(index):
        if options.space != "frame":
            raise run.why_no_camera(index)
        if not options.in_front:
            problem = run.why_no_camera(index)
            cure = "without one players cannot be kept in front: add --in-front, or give --calibration.focal_px to run"
            raise InputError(problem.what, problem.cause, cure)
    return index, views
