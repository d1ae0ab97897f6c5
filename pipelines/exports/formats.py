"""The table of exports: name, file, what a reader must know. Standard library only: --help and the settings read it.

Each module has `write(path, cameras, options) -> notes`: one file (or folder) of one shot, whole or not at all.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from types import ModuleType

from pipelines.errors import MissingToolError


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What a user may choose of an export.

    sensor_width_mm: None = as the run says, else not known. first_frame: number that the clip's picture 0 gets in
    formats with a timeline; None = the format's own habit. camera_id: 0..255, of FreeD packets.
    """

    sensor_width_mm: float | None = None
    first_frame: int | None = None
    camera_id: int = 1

    def __post_init__(self) -> None:
        if self.sensor_width_mm is not None and not 0 < self.sensor_width_mm <= 100:
            raise ValueError(f"sensor_width_mm is {self.sensor_width_mm}, must be in 0..100")
        if not 0 <= self.camera_id <= 255:
            raise ValueError(f"camera_id is {self.camera_id}, must be in 0..255")


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One export. file: its name in the shot's folder (in OUT where per_shot is off); folder: that name is a folder.

    axes, units, numbering, empty: sentences for the notes beside the file. empty says what becomes of a frame without
    a camera. needs: package of the extra, if any.
    """

    name: str
    module: str
    file: str
    what: str
    axes: str
    units: str
    numbering: str
    empty: str
    folder: bool = False
    per_shot: bool = True
    needs: str = ""
    extra: str = ""

    def load(self) -> ModuleType:
        """Its module; imports what that needs. Raises MissingToolError when a package of an extra is missing."""
        self.check()
        return importlib.import_module(f"pipelines.exports.{self.module}")

    def check(self) -> None:
        """Raises MissingToolError when a package of an extra is missing; imports that package, nothing else."""
        if not self.needs:
            return
        try:
            importlib.import_module(self.needs)
        except ImportError:
            cure = f"pip install 'broadcast-mosaic[{self.extra}]'"
            raise MissingToolError(f"export {self.name}", f"{self.needs} is not installed", cure) from None


OURS = (
    "R = Rz(-roll) Rx(-tilt) Ry(-pan), shot world to camera; pan right, tilt up, roll clockwise from behind"
)
LEFT = "a frame without a camera is left out, and listed here"

FORMATS: tuple[Format, ...] = (
    Format(
        name="colmap",
        module="colmap",
        file="colmap",
        folder=True,
        what="COLMAP model, text: a camera per frame (it zooms), no points",
        axes="world to camera, x right, y down, z forward; translation 0",
        units="px; COLMAP's pixel origin: the centre of the top-left pixel is (0.5, 0.5)",
        numbering="image and camera id = frame + 1, image name frame_NNNNNN.png",
        empty=LEFT,
    ),
    Format(
        name="colmap-bin",
        module="colmap_binary",
        file="colmap-bin",
        folder=True,
        what="COLMAP model, binary",
        axes="world to camera, x right, y down, z forward; translation 0",
        units="px; COLMAP's pixel origin: the centre of the top-left pixel is (0.5, 0.5)",
        numbering="image and camera id = frame + 1, image name frame_NNNNNN.png",
        empty=LEFT,
    ),
    Format(
        name="opentrackio",
        module="opentrackio",
        file="camera.opentrackio.jsonl",
        what="OpenTrackIO 1.0.1 samples, a JSON object a line",
        axes="Z up, Y forward, X right; pan positive to the LEFT (-pan_deg), tilt up, roll clockwise from behind",
        units="degrees, mm, m; projectionOffset y down",
        numbering="timing.sequenceNumber = frame mod 65536; time code where the clip has one",
        empty="the sample stays, without lens and transforms; tracker.status and notes say why",
    ),
    Format(
        name="freed",
        module="freed",
        file="camera.freed",
        what="FreeD D1 packets, 29 bytes each; --udp HOST:PORT sends them at frame rate",
        axes="pan right positive (within -180..180), tilt up, roll clockwise; position 0",
        units="1/32768 degree; zoom by the law stated here",
        numbering="user field = frame mod 65536",
        empty="no packet (FreeD has no 'invalid'); listed here",
    ),
    Format(
        name="chan",
        module="chan",
        file="camera.chan",
        what="Nuke .chan: frame, position, rotation (order ZXY), vertical field of view",
        axes="y up, camera looks along -z; rx = tilt, ry = -pan, rz = -roll, rotation order ZXY",
        units="degrees; vertical field of view of the undistorted pinhole",
        numbering="the clip's picture 0 is frame 1 (--first-frame N: N)",
        empty="no line; Nuke interpolates across the gap, so mind the list here",
    ),
    Format(
        name="usd",
        module="usd",
        file="camera.usda",
        what="USD camera with time samples, for Blender, Houdini, Unreal, Nuke",
        axes="y up, camera looks along -z; xformOp:transform is camera to world, row vectors",
        units="focal length and aperture in mm, of a nominal sensor where the width is not known",
        numbering="time code = frame (--first-frame N: frame + N)",
        empty="the attributes are blocked (no value) over the gap",
    ),
    Format(
        name="pto",
        module="pto_cameras",
        file="cameras.pto",
        what="Hugin project of all frames (the run's own panorama.pto has the composited ones)",
        axes="yaw = pan, pitch = tilt, roll = roll, same signs",
        units="degrees; v = horizontal field of view, d and e from the picture's middle",
        numbering="picture name frame_NNNNNN.png",
        empty=LEFT,
    ),
    Format(
        name="soccernet",
        module="soccernet",
        file="soccernet",
        folder=True,
        what="SoccerNet calibration JSON, a file per frame",
        axes="x right, y towards the main camera, z down; pan = pan, tilt = 90 + tilt, roll = roll",
        units="px, degrees; position 0: there is no pitch to measure metres on",
        numbering="camera_NNNNN.json, N = frame from 0",
        empty="no file for the frame; listed here",
    ),
    Format(
        name="opencv",
        module="opencv_yaml",
        file="camera.opencv.yml",
        what="OpenCV FileStorage YAML: camera_matrix, distortion, rvec per frame",
        axes="world to camera, x right, y down, z forward; rvec of R, tvec 0",
        units="px, the centre of the top-left pixel is (0, 0); radians",
        numbering="frame from 0",
        empty=LEFT,
    ),
    Format(
        name="json",
        module="tables",
        file="camera.json",
        what="all columns of camera.csv with their units, one JSON document",
        axes=OURS,
        units="as in camera.csv",
        numbering="frame from 0",
        empty="null",
        per_shot=False,
    ),
    Format(
        name="csv",
        module="tables",
        file="camera.csv",
        what="camera.csv itself, for -o elsewhere",
        axes=OURS,
        units="as in camera.csv",
        numbering="frame from 0",
        empty="an empty cell",
        per_shot=False,
    ),
    Format(
        name="parquet",
        module="tables",
        file="camera.parquet",
        what="the same table as Parquet, units in the field metadata",
        axes=OURS,
        units="as in camera.csv",
        numbering="frame from 0",
        empty="null",
        per_shot=False,
        needs="pyarrow",
        extra="parquet",
    ),
)
NAMES = tuple(entry.name for entry in FORMATS)


def parse_names(text: str | Iterable[str]) -> tuple[str, ...]:
    """'colmap,usd' (or a sequence of names) to known names, each once. Raises ValueError: no such format."""
    words = text.split(",") if isinstance(text, str) else list(text)
    names = [str(word).strip() for word in words]
    for name in names:
        if name not in NAMES:
            near = difflib.get_close_matches(name, NAMES, n=1, cutoff=0.5)
            cure = f"did you mean {near[0]}?" if near else f"one of {', '.join(NAMES)}"
            raise ValueError(f"no export is called {name!r}; {cure}")
    return tuple(dict.fromkeys(names))


def format_named(name: str) -> Format:
    """The entry of a name. Raises ValueError: there is none."""
    [checked] = parse_names([name])
    return next(entry for entry in FORMATS if entry.name == checked)
