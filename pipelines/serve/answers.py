"""What the viewer asks: what a run holds, what a point of a panorama is, which frames see it, where a frame lies.

Everything is JSON-ready; numbers of frames are those of camera.csv.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mosaic.surface import Surface
from pipelines.archive import read_camera_csv, read_run
from pipelines.errors import InputError
from pipelines.exports.panorama_json import read_surface
from pipelines.frame_geometry import frame_geometry
from pipelines.rays import pixel_to_ray, ray_to_pan_tilt, ray_to_pixel
from pipelines.records import RunRecord
from pipelines.report.build import clip_line, clip_name
from pipelines.report.words import STATUS_SIGNS
from pipelines.serve.tiles import Tiles

SIDE = 8  # points on each side of a frame's outline: lens and surface bend it
DATA_BLOCK = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)


class ServedRun:
    """A run opened for the viewer. Raises InputError: no finished run there, or a damaged panorama."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.run = read_run(out)
        self.table = read_camera_csv(out / "camera.csv")
        if not self.run.clip.get("size_px"):
            raise InputError(out / "run.json", "does not say how large the pictures are", "run again")
        self.size_px = (int(self.run.clip["size_px"][0]), int(self.run.clip["size_px"][1]))
        self.geometry = frame_geometry(self.run, self.table)
        self.tiles: dict[int, Tiles] = {}
        self.surfaces: dict[int, Surface] = {}
        for shot in self.run.shots:
            path = out / f"shot-{shot.index:03d}" / "panorama.tif"
            if path.is_file() and path.with_suffix(".json").is_file():
                self.tiles[shot.index] = Tiles(path)
                self.surfaces[shot.index] = read_surface(path.with_suffix(".json"))
        self.thumbnails = read_thumbnails(out / "report.html")
        self.files = listed_files(self.run, out)

    def close(self) -> None:
        """Let go of the panoramas."""
        for tiles in self.tiles.values():
            tiles.close()

    def overview(self) -> dict[str, Any]:
        """The clip in a line, and per shot: frames, status, panorama with its levels (None where there is none)."""
        return {
            "name": clip_name(self.run.clip),
            "clip": clip_line(self.run.clip),
            "report": (self.out / "report.html").is_file(),
            "shots": [
                {
                    "index": shot.index,
                    "first_frame": shot.first_frame,
                    "last_frame": shot.last_frame,
                    "status": shot.status,
                    "panorama": self._picture(shot.index),
                }
                for shot in self.run.shots
            ],
        }

    def _picture(self, shot: int) -> dict[str, Any] | None:
        if shot not in self.tiles:
            return None
        tiles, surface = self.tiles[shot], self.surfaces[shot]
        return {"levels": tiles.levels, "tile_px": tiles.tile_px, "projection": surface.kind}

    def point(self, shot: int, x: float, y: float) -> dict[str, Any] | None:
        """A panorama pixel of a shot: its ray, pan and tilt, and the frames that see it; None: no such panorama.

        frames: stretches [first, last]; best: the frame that has it nearest to its middle, with the pixel there.
        """
        surface = self.surfaces.get(shot)
        if surface is None or not np.isfinite([x, y]).all():
            return None
        ray = surface.pixel_to_ray([x, y])
        pan, tilt = ray_to_pan_tilt(ray)
        rows = np.flatnonzero((self.table.shot == shot) & np.isfinite(self.table.f_px))
        frames = self.table.frame[rows]
        xy = ray_to_pixel(self.table, frames, ray, self.geometry) if len(rows) else np.zeros((0, 2))
        w, h = self.size_px
        with np.errstate(invalid="ignore"):
            inside = ((xy > -0.5) & (xy < [w - 0.5, h - 0.5])).all(axis=-1)
        seeing, where = frames[inside], xy[inside]
        best = None
        if len(seeing):
            nearest = int(np.argmin(np.linalg.norm(where - [(w - 1) / 2, (h - 1) / 2], axis=-1)))
            best = {"frame": int(seeing[nearest]), "pixel": np.round(where[nearest], 2).tolist()}
        calibrated = bool(len(rows))
        return {
            "pixel": [x, y],
            "ray": np.round(ray, 9).tolist() if calibrated else None,
            "pan_deg": round(float(pan), 5) if calibrated else None,
            "tilt_deg": round(float(tilt), 5) if calibrated else None,
            "n_frames": len(seeing),
            "frames": stretches(seeing),
            "best": best,
            "why_none": "" if calibrated else "this shot has no focal length, so a point has no direction",
        }

    def frame(
        self, number: int, shot: int, x: float | None = None, y: float | None = None
    ) -> dict[str, Any] | None:
        """A frame of a shot: its status, time, outline on the panorama, thumbnail; where it sees panorama pixel (x, y).

        None: no such frame. The thumbnail is that of the nearest frame that has one, whose number goes with it.
        """
        rows = np.flatnonzero((self.table.frame == number) & (self.table.shot == shot))
        surface = self.surfaces.get(shot)
        if not len(rows) or surface is None:
            return None
        row = int(rows[0])
        pts_s = float(self.table.pts_s[row])
        status = self.table.status[row]
        answer: dict[str, Any] = {
            "frame": number,
            "pts_s": round(pts_s, 4) if np.isfinite(pts_s) else None,
            "timecode": self.table.timecode[row],
            "status": status,
            "sign": STATUS_SIGNS.get(status, ("?", ""))[0],
            "outline": None,
            "pixel": None,
            "thumbnail": self._nearest_thumbnail(number, shot),
        }
        if np.isfinite(self.table.f_px[row]):
            border = pixel_to_ray(self.table, number, _border(*self.size_px), self.geometry)
            outline = surface.ray_to_pixel(border)
            if np.isfinite(outline).all():
                answer["outline"] = np.round(outline, 1).tolist()
            if x is not None and y is not None and np.isfinite([x, y]).all():
                seen = ray_to_pixel(self.table, number, surface.pixel_to_ray([x, y]), self.geometry)
                answer["pixel"] = np.round(seen, 2).tolist() if np.isfinite(seen).all() else None
        return answer

    def _nearest_thumbnail(self, number: int, shot: int) -> int | None:
        own = self.table.frame[self.table.shot == shot]
        known = [frame for frame in self.thumbnails if own[0] <= frame <= own[-1]]
        return min(known, key=lambda frame: abs(frame - number), default=None)


def stretches(frames: np.ndarray) -> list[list[int]]:
    """Rising frame numbers as [first, last] of every unbroken stretch."""
    if not len(frames):
        return []
    pieces = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    return [[int(piece[0]), int(piece[-1])] for piece in pieces]


def listed_files(run: RunRecord, out: Path) -> dict[str, Path]:
    """Name, as the report links to it, to file: what the run says it wrote for its shots, inside OUT."""
    names = {name for shot in run.shots for name in shot.files}
    names |= {name for group in (run.extra.get("merging") or {}).get("groups", ()) for name in group["files"]}
    inside = (name for name in names if not PurePosixPath(name).is_absolute())
    return {name: out / name for name in inside if ".." not in PurePosixPath(name).parts}


def read_thumbnails(report: Path) -> dict[int, tuple[str, bytes]]:
    """Frame to (media type, bytes) of the thumbnails in a report.html; empty where there is none."""
    try:
        block = DATA_BLOCK.search(report.read_text(encoding="utf-8"))
        uris = json.loads(block[1])["thumbnails"] if block else {}
    except (OSError, ValueError, KeyError):
        return {}
    found = {}
    for frame, uri in uris.items():
        head, _, body = str(uri).partition(";base64,")
        if head.startswith("data:image/"):
            found[int(frame)] = (head.removeprefix("data:"), base64.b64decode(body))
    return found


def _border(width: int, height: int) -> np.ndarray:
    """(4 SIDE, 2) px round a picture's outer edge, from the top left clockwise."""
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    steps = np.linspace(0, 1, SIDE, endpoint=False)[:, None]
    return np.concatenate(
        [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
