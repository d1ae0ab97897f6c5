"""The clip held still: every frame as its shot's reference camera would see it, or a camera on a smoothed path.

Frames without a camera go through as they are. Shots whose focal length is not known are laid over their reference
frame by their homographies; a smoothed path and a filled border need a focal length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.progress import Progress, silent
from pipelines.render.encode import EncodeOptions
from pipelines.render.job import (
    Rendered,
    chosen_rows,
    full_scale,
    pictures,
    stretches,
    to_8_bits,
    writer_like,
)
from pipelines.render.opened import OpenedRun, open_its_clip
from pipelines.render.paths import smoothed
from pipelines.render.plate import Plate, fit_light, read_plate
from pipelines.render.views import View, camera_view, seen, warp_map

FEATHER_PX = 8.0  # over which a frame's border goes over into the panorama
FINER = 1.25  # a frame with a focal length longer by this much is blurred first, else it flickers


@dataclass(frozen=True, slots=True, kw_only=True)
class StabiliseOptions:
    """to: 'reference' (the shot's reference frame) or 'smooth' (the camera's own path, smoothed with sigma smooth_s).

    fill: what borders show, 'black' or 'panorama'. zoom: focal length of the new camera over the old one's; above 1
    hides borders. shot: only this one; None = the whole clip. sound: copy it.
    """

    to: Literal["reference", "smooth"] = "reference"
    smooth_s: float = 1.0
    fill: Literal["black", "panorama"] = "black"
    zoom: float = 1.0
    shot: int | None = None
    sound: bool = True
    clip: Path | None = None


def stabilise(
    run: OpenedRun,
    path: Path,
    options: StabiliseOptions | None = None,
    *,
    encode: EncodeOptions | None = None,
    progress: Progress = silent,
) -> Rendered:
    """Write the stabilised clip. Raises InputError: no shot with cameras, no panorama to fill from, the clip has gone;
    OutputError: cannot be written."""
    options = options or StabiliseOptions()
    rows = chosen_rows(run, options.shot)
    shots = sorted({int(run.table.shot[row]) for row in rows} - {-1})
    sources: dict[int, View] = {}
    targets: dict[int, View] = {}
    for index in shots:
        views = run.shot_views(index)
        if not views:
            continue
        if (options.to == "smooth" or options.fill == "panorama") and not run.calibrated(index):
            if len(shots) == 1:
                raise run.why_no_camera(index)
            continue  # said at the end: its frames go through
        sources |= views
        targets |= target_views(run, index, views, options)
    if not sources:
        raise run.why_no_camera(shots[0]) if shots else _no_shot(run)
    plates = _Plates(run) if options.fill == "panorama" else None
    for index in {int(run.table.shot[row]) for row in sources} if plates else ():
        run.panorama_path(index)  # before a long clip is decoded for nothing
    unseen = 0.0
    with (
        open_its_clip(run, options.clip) as clip,
        writer_like(
            run, clip, rows, path, sound=options.sound, encode=encode, mixed=plates is not None
        ) as writer,
    ):
        for row, picture in pictures(
            run, clip, rows, progress, "stabilised", encode, mixed=plates is not None
        ):
            if row in sources:
                plate = plates.of(int(run.table.shot[row])) if plates else None
                picture, share = held_still(picture, sources[row], targets[row], plate)
                unseen += share
            writer.write(picture)
        sound = writer.sound
    return Rendered(
        path=path,
        what="stabilised",
        size_px=run.size_px,
        n_frames=len(rows),
        n_changed=len(sources),
        sound=sound,
        passed=stretches(run, [row for row in rows if row not in sources]),
        facts={"to": options.to, "fill": options.fill, "black_share": unseen / len(sources)},
    )


def target_views(
    run: OpenedRun, index: int, views: dict[int, View], options: StabiliseOptions
) -> dict[int, View]:
    """Row to the view that its frame shall be shown in."""
    rows = sorted(views)
    if options.to == "reference":
        reference = run.rows.get(run.shot(index).reference_frame, -1)
        # The reference frame has a camera unless it was taken out as doubtful: then the nearest one holds still.
        row = min(rows, key=lambda r: abs(r - reference))
        held = views[row].still().scaled(options.zoom)
        return dict.fromkeys(rows, held)
    t = run.table
    columns = np.stack(
        [np.log(t.f_px[rows]), *np.radians([t.pan_deg[rows], t.tilt_deg[rows], t.roll_deg[rows]])], axis=1
    )
    path = smoothed(t.pts_s[rows], columns, options.smooth_s)
    return {
        row: camera_view(
            run.size_px,
            float(np.exp(values[0])),
            values[1:],
            pp_px=views[row].pp_px,
            aspect=views[row].aspect,
            k1=views[row].k1,
            parallax=views[row].parallax,
        ).scaled(options.zoom)
        for row, values in zip(rows, path, strict=True)
    }


def held_still(
    picture: NDArray[Any], source: View, target: View, plate: Plate | None
) -> tuple[NDArray[Any], float]:
    """A frame (h, w, 3) as the target sees it, its border filled from a plate if there is one; share left black.

    picture: uint8, or uint16 of 0..65535.
    """
    map_x, map_y = warp_map(source, target)
    inside = seen(map_x, map_y, source.size_px)
    ratio = _scale_ratio(map_x, map_y)
    if ratio > FINER:
        picture = np.asarray(
            cv2.GaussianBlur(picture, (0, 0), 0.5 * float(np.sqrt(ratio**2 - 1))), picture.dtype
        )
    moved: NDArray[Any] = np.asarray(
        cv2.remap(picture, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), picture.dtype
    )
    if plate is None:
        moved[~inside] = 0
        return moved, float(1 - inside.mean())
    behind, known = plate.seen_by(target)
    light = fit_light(to_8_bits(moved), behind, known & inside)
    w, h = source.size_px
    to_border = np.minimum(np.minimum(map_x + 0.5, w - 0.5 - map_x), np.minimum(map_y + 0.5, h - 0.5 - map_y))
    mixed = (to_border < FEATHER_PX) & known
    weight = np.clip(to_border[mixed] / FEATHER_PX, 0.0, 1.0)[:, None]
    white = full_scale(moved)
    filled = weight * moved[mixed] + (1 - weight) * light.applied(behind[mixed]) * (white / 255)
    moved[mixed] = np.clip(filled + 0.5, 0, white).astype(moved.dtype)
    empty = ~(inside | known)
    moved[empty] = 0
    return moved, float(empty.mean())


def _scale_ratio(map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> float:
    """Source pixels per target pixel in the picture's middle."""
    h, w = map_x.shape
    y, x = h // 2, w // 2
    ax, ay = map_x[y, x + 1] - map_x[y, x], map_y[y, x + 1] - map_y[y, x]
    bx, by = map_x[y + 1, x] - map_x[y, x], map_y[y + 1, x] - map_y[y, x]
    area = abs(float(ax * by - ay * bx))
    return float(np.sqrt(area)) if 0 < area < 1e4 else 1.0


class _Plates:
    """The plate of the shot that is being rendered: one at a time is held."""

    def __init__(self, run: OpenedRun) -> None:
        self._run, self._shot = run, -1
        self._plate: Plate | None = None

    def of(self, shot: int) -> Plate:
        if self._plate is None or self._shot != shot:
            self._plate = None  # the old one goes before the new one comes
            self._shot, self._plate = shot, read_plate(self._run.panorama_path(shot))
        return self._plate


def _no_shot(run: OpenedRun) -> Exception:
    from pipelines.errors import InputError

    return InputError(run.out, "has no shot with cameras", "see report.html for the reasons")
