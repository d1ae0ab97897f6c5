"""A finished run as a Python user has it: arrays, tables, rays, metres on the pitch, new video, panorama, exports.

`process(clip, out)` makes one, `open_result(out)` opens the folder of an earlier one. The files are the truth: nothing
is computed here that they do not hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.rotation import from_pan_tilt_roll
from pipelines import rays
from pipelines.archive import COLUMNS, read_camera_csv, read_run
from pipelines.config import Config, load_config
from pipelines.errors import InputError, MissingToolError
from pipelines.records import CameraTable, RunRecord, ShotRecord

if TYPE_CHECKING:
    import pandas
    import polars

    from mosaic.surface import Surface
    from pipelines.exports.exporter import Exported
    from pipelines.exports.formats import ExportOptions
    from pipelines.frame_geometry import FrameGeometry
    from pipelines.pitch import Pitch
    from pipelines.pitch_templates import PitchTemplate
    from pipelines.render.encode import EncodeOptions
    from pipelines.render.job import Rendered
    from pipelines.render.move import MoveOptions
    from pipelines.render.overlay import OverlayOptions
    from pipelines.render.stabilise import StabiliseOptions

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanoramaPicture:
    """A shot's panorama: image (h, w, 3) uint8, alpha (h, w) uint8 (0: never seen), and the surface, pixel to ray."""

    image: NDArray[np.uint8]
    alpha: NDArray[np.uint8]
    surface: Surface


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """A run in folder `out`: `run` is run.json, `camera` camera.csv as arrays of n rows (records.py: units, meaning).

    NaN, -1 or '' is a value that is not known. Angles are in degrees as in the files; pixel (0, 0) is the centre of the
    top-left pixel.
    """

    out: Path
    run: RunRecord
    camera: CameraTable

    @property
    def shots(self) -> tuple[ShotRecord, ...]:
        """The shots, with status, reason, files, calibration facts."""
        return self.run.shots

    @property
    def size_px(self) -> tuple[int, int]:
        """(w, h) of the frames as decoded."""
        width, height = self.run.clip["size_px"]
        return int(width), int(height)

    # ---- tables

    def table(self, shot: int | None = None) -> dict[str, NDArray[Any]]:
        """Columns of camera.csv by name, arrays of n rows: all frames, or those of one shot.

        Floats with NaN, whole numbers with -1, text with '' where a cell is empty. Raises InputError: no such shot.
        """
        rows = self._rows(shot)
        columns: dict[str, NDArray[Any]] = {}
        for name, kind, _ in COLUMNS:
            if name[0] == "h" and name[1:].isdigit():
                values: Any = self.camera.homography[:, int(name[1]) - 1, int(name[2]) - 1]
            else:
                values = getattr(self.camera, name)
            columns[name] = (np.array(values, dtype=np.str_) if kind == "text" else values)[rows]
        return columns

    def to_pandas(self, shot: int | None = None) -> pandas.DataFrame:
        """The table as a DataFrame indexed by frame: empty cells are missing values, status is categorical.

        Raises MissingToolError without pandas; InputError: no such shot.
        """
        try:
            import pandas
        except ImportError:
            raise MissingToolError("to_pandas", "pandas is not installed", "pip install pandas") from None
        columns: dict[str, Any] = {}
        for (name, kind, _), values in zip(COLUMNS, self.table(shot).values(), strict=True):
            if kind == "count":
                columns[name] = pandas.arrays.IntegerArray(values.astype(np.int64), values < 0)
            elif kind == "text":
                columns[name] = pandas.Series([str(value) or None for value in values], dtype=object)
            else:
                columns[name] = values
        frame = pandas.DataFrame(columns)
        frame["status"] = frame["status"].astype("category")
        return frame.set_index("frame")

    def to_polars(self, shot: int | None = None) -> polars.DataFrame:
        """The table as a polars DataFrame, null where a cell is empty.

        Raises MissingToolError without polars; InputError: no such shot.
        """
        try:
            import polars
        except ImportError:
            raise MissingToolError("to_polars", "polars is not installed", "pip install polars") from None
        series = []
        for (name, kind, _), values in zip(COLUMNS, self.table(shot).values(), strict=True):
            if kind == "float":
                series.append(polars.Series(name, values, dtype=polars.Float64, nan_to_null=True))
                continue
            empty = "" if kind == "text" else -1
            cells = [None if value == empty else value for value in values.tolist()]
            series.append(polars.Series(name, cells, dtype=polars.String if kind == "text" else polars.Int64))
        return polars.DataFrame(series)

    # ---- the camera

    def intrinsics(self) -> FloatArray:
        """K (n, 3, 3) px per row of `camera`: camera axes to undistorted pixels. NaN where not known."""
        c = self.camera
        K = np.zeros((len(c), 3, 3))
        K[:, 0, 0], K[:, 1, 1] = c.f_px, c.f_px / c.aspect
        K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = c.cx_px, c.cy_px, 1.0
        K[~np.isfinite(K).all(axis=(1, 2))] = np.nan
        return K

    def rotations(self) -> FloatArray:
        """R_cam_world (n, 3, 3) per row of `camera`: shot world to camera axes (x right, y down, z forward); NaN."""
        c = self.camera
        return from_pan_tilt_roll(*np.radians([c.pan_deg, c.tilt_deg, c.roll_deg]))

    def geometry(self) -> FrameGeometry:
        """What camera.csv does not say of its frames: rows read at different times, a pupil before the pan axis.

        The methods below use it; K and R above are those of a frame's middle row.
        """
        from pipelines.frame_geometry import frame_geometry

        return frame_geometry(self.run, self.camera)

    def pixel_to_ray(self, frame: ArrayLike, xy_px: ArrayLike) -> FloatArray:
        """Unit rays (..., 3) of pixels (..., 2) of frames (...): see rays.pixel_to_ray."""
        return rays.pixel_to_ray(self.camera, frame, xy_px, self.geometry())

    def ray_to_pixel(self, frame: ArrayLike, directions: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of directions (..., 3) in frames (...): see rays.ray_to_pixel."""
        return rays.ray_to_pixel(self.camera, frame, directions, self.geometry())

    def pixel_to_pan_tilt(self, frame: ArrayLike, xy_px: ArrayLike) -> FloatArray:
        """Pan and tilt (..., 2) in degrees of pixels (..., 2) of frames (...)."""
        return rays.pixel_to_pan_tilt(self.camera, frame, xy_px, self.geometry())

    # ---- the pitch, and new video

    def pitch(
        self,
        clicks: str | Path | Sequence[Sequence[object]],
        *,
        template: str | PitchTemplate | None = None,
        position_m: Sequence[float] | None = None,
        click_std_px: float = 1.0,
    ) -> Pitch:
        """Where a shot's camera stands, from clicked points of the pitch: metres of pixels, pixels of metres, flights.

        clicks: a CSV (see `clicks.read_clicks`), or rows (frame, x_px, y_px, name) or (frame, x_px, y_px, X_m, Y_m);
        four or more, two where position_m (3,) of the camera is known. template: 'football', 'football:100x64',
        'basketball', 'american-football', or your own. click_std_px: one-sigma error of a click. Raises InputError:
        see `pitch.pitch_of`; ValueError: no such template.
        """
        from pipelines.clicks import clicks_of, read_clicks
        from pipelines.pitch import fit_pitch
        from pipelines.pitch_templates import template_named

        known = template_named(template) if isinstance(template, str) else template
        from_file = isinstance(clicks, (str, Path))
        points = (
            read_clicks(Path(clicks), known) if isinstance(clicks, (str, Path)) else clicks_of(clicks, known)
        )
        return fit_pitch(
            self.run, self.camera, points, click_std_px=click_std_px, position_m=position_m,
            source=clicks if from_file else "clicks",
        )  # fmt: skip

    def render(
        self,
        path: str | Path,
        what: StabiliseOptions | OverlayOptions | MoveOptions,
        *,
        encode: EncodeOptions | None = None,
        progress: Callable[[str, int, int | None], None] | None = None,
    ) -> Rendered:
        """New video at `path` (.mp4, .mov, .mkv): held still, with a picture in the scene, or a camera move.

        What it is follows from the kind of options. Returns the facts of it. Raises InputError and OutputError as the
        function of that name in pipelines.render.
        """
        from pipelines.progress import silent
        from pipelines.render.move import MoveOptions, move
        from pipelines.render.opened import open_run
        from pipelines.render.overlay import OverlayOptions, overlay
        from pipelines.render.stabilise import stabilise

        def told(stage: str, done: int, total: int | None) -> None:
            (progress or silent)(stage, done, total)

        run, target = open_run(self.out), Path(path)
        if isinstance(what, OverlayOptions):
            return overlay(run, target, what, encode=encode, progress=told)
        if isinstance(what, MoveOptions):
            return move(run, target, what, encode=encode, progress=told)
        return stabilise(run, target, what, encode=encode, progress=told)

    # ---- files

    def pairs(self, shot: int) -> dict[str, NDArray[Any]]:
        """pairs.npz of a shot: every registered pair, arrays of m rows (src, dst, H_dst_src, status, info, ...).

        Raises InputError: no such shot, no such file.
        """
        path = self._file(shot, "pairs.npz")
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored}

    def panorama(self, shot: int) -> PanoramaPicture:
        """The shot's panorama.tif with its surface. Raises InputError: no such shot, or it has no panorama."""
        import tifffile

        from mosaic.framestore import eight_bits
        from pipelines.exports.panorama_json import read_surface

        path = self._file(shot, "panorama.tif")
        picture = eight_bits(tifffile.imread(path))
        surface = read_surface(path.with_name("panorama.json"))
        return PanoramaPicture(image=picture[..., :3], alpha=picture[..., 3], surface=surface)

    def export(
        self,
        names: str | Sequence[str],
        *,
        target: str | Path | None = None,
        options: ExportOptions | None = None,
        shots: Sequence[int] | None = None,
    ) -> list[Exported]:
        """Write exports, 'usd' or 'usd,chan' or a sequence; places, options and errors as exports.place.export_folder.

        Raises ValueError besides: no such format.
        """
        from pipelines.exports.formats import parse_names
        from pipelines.exports.place import export_folder

        return export_folder(self.out, parse_names(names), target=target, options=options, shots=shots)

    def _rows(self, shot: int | None) -> NDArray[np.intp]:
        if shot is None:
            return np.arange(len(self.camera))
        self._shot(shot)
        return np.flatnonzero(self.camera.shot == shot)

    def _shot(self, shot: int) -> ShotRecord:
        for record in self.shots:
            if record.index == shot:
                return record
        known = ", ".join(str(record.index) for record in self.shots) or "none"
        raise InputError(f"shot {shot}", "is not in this run", f"its shots: {known}")

    def _file(self, shot: int, name: str) -> Path:
        self._shot(shot)
        path = self.out / f"shot-{shot:03d}" / name
        if not path.is_file():
            raise InputError(path, "no such file", "run again with panorama.enabled, into this folder")
        return path


def open_result(out: str | Path) -> Result:
    """The finished run in a folder. Raises InputError: none there, or damaged."""
    folder = Path(out)
    return Result(out=folder, run=read_run(folder), camera=read_camera_csv(folder / "camera.csv"))


def process(
    clip: str | Path,
    out: str | Path,
    settings: Config | Mapping[str, Any] | None = None,
    *,
    progress: Callable[[str, int, int | None], None] | None = None,
    resume: bool = False,
) -> Result:
    """The whole job: clip in, folder of results out (README: what a run writes), opened.

    settings: a Config, or {'panorama.enabled': False, ...} with the names of `run --help-config`. progress: called with
    stage, done, total. resume: keep the shots that an interrupted run finished. Raises InputError, ConfigError,
    OutputError for a user's mistakes; a shot that failed is a result, not an exception.
    """
    from pipelines.run import process as run

    if settings is None or isinstance(settings, Mapping):
        settings = load_config(None, {name: str(value) for name, value in (settings or {}).items()})
    run(Path(clip), Path(out), settings, progress, resume)
    return open_result(out)
