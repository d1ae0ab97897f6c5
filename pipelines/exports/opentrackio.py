"""OpenTrackIO 1.0.1 (SMPTE RiS-OSVP): a JSON sample a line, every frame of the shot, in order.

Z up, Y forward, X right, rotations intrinsic Z, X, Y and right-handed: pan is positive to the LEFT, so it is -pan_deg;
tilt and roll as ours. Lens in mm on the sensor, y down as in SMPTE's note on OpenCV. radial[0] is k1 / F^2 with F in mm
and the model is named, because readers take a nameless one for its inverse. Null is not allowed: a frame without a
camera is a sample without lens and transforms, and tracker.status and notes say why. Ids are made from the clip's
identity, so that the same run gives the same bytes. Source: the standard's schema and notes.
"""

from __future__ import annotations

import json
import math
import re
import uuid
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from pipelines.exports.cameras import ShotCameras
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_file
from pipelines.report.words import reason_words

PROTOCOL = {"name": "OpenTrackIO", "version": [1, 0, 1]}
MODEL = "Brown-Conrady U-D"
SPACE = uuid.UUID("6f3c1c0e-5a0e-5d1b-9b55-0d9a3c1f7f10")  # of our ids; a constant of this program
PIXEL_CENTRE = 0.5


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the samples; returns the sensor width used and whether it is nominal."""
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        for sample in samples(cameras):
            stream.write(json.dumps(sample, allow_nan=False, ensure_ascii=False) + "\n")
    return {"sensor_width_mm": cameras.sensor_mm, "sensor_width_is_nominal": cameras.sensor_width_mm is None}


def samples(cameras: ShotCameras) -> Iterator[dict[str, Any]]:
    """The samples as JSON-ready objects."""
    (w, h), mm = cameras.size_px, cameras.sensor_mm
    source = uuid.uuid5(SPACE, f"{cameras.identity}|{cameras.clip}|{cameras.shot}")
    camera: dict[str, Any] = {
        "captureFrameRate": rational(cameras.fps),
        "activeSensorResolution": {"width": w, "height": h},
    }
    known_aspect = cameras.aspect[cameras.rows]
    if len(known_aspect):
        height_mm = mm * h / w * float(known_aspect[0])
        camera["activeSensorPhysicalDimensions"] = {"width": mm, "height": height_mm}
    for i in range(len(cameras.frame)):
        sample: dict[str, Any] = {
            "protocol": PROTOCOL,
            "sampleId": uuid.uuid5(source, str(int(cameras.frame[i]))).urn,
            "sourceId": source.urn,
            "sourceNumber": 1,
            "static": {"camera": camera},
            "timing": timing(cameras, i),
            "tracker": {"status": cameras.status[i] or "unknown", "notes": note(cameras, i)},
        }
        if cameras.known[i]:
            sample["lens"] = lens(cameras, i)
            sample["transforms"] = [
                {
                    "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
                    "rotation": {
                        "pan": -float(cameras.pan_deg[i]),
                        "tilt": float(cameras.tilt_deg[i]),
                        "roll": float(cameras.roll_deg[i]),
                    },
                    "id": "Camera",
                }
            ]
        yield sample


def lens(cameras: ShotCameras, i: int) -> dict[str, Any]:
    """The lens block of a row that is known: mm on the sensor, y down."""
    (w, h), mm = cameras.size_px, cameras.sensor_mm
    focal = float(cameras.f_px[i]) * mm / w
    return {
        "pinholeFocalLength": focal,
        "projectionOffset": {
            "x": (float(cameras.cx_px[i]) + PIXEL_CENTRE - w / 2) * mm / w,
            "y": (float(cameras.cy_px[i]) + PIXEL_CENTRE - h / 2) * mm / w * float(cameras.aspect[i]),
        },
        "distortion": [{"model": MODEL, "radial": [float(cameras.k1[i]) / focal**2]}],
    }


def timing(cameras: ShotCameras, i: int) -> dict[str, Any]:
    """Frame rate, number, presentation time (left out before 0) and time code of a row."""
    block: dict[str, Any] = {
        "mode": "internal",
        "sampleRate": rational(cameras.picture_fps),
        "sequenceNumber": int(cameras.frame[i]) % 65536,
    }
    pts = float(cameras.pts_s[i])
    if math.isfinite(pts) and pts >= 0:
        seconds, rest = divmod(round(pts * 1e9), 10**9)
        block["sampleTimestamp"] = {"seconds": seconds, "nanoseconds": rest}
    match = re.fullmatch(r"(\d\d):(\d\d):(\d\d)[:;.](\d\d+)", cameras.timecode[i])
    if match:
        names = ("hours", "minutes", "seconds", "frames")
        block["timecode"] = {
            **dict(zip(names, (int(part) for part in match.groups()), strict=True)),
            "frameRate": rational(cameras.fps),
        }
    return block


def note(cameras: ShotCameras, i: int) -> str:
    """Why a frame has no camera, and whether its millimetres are nominal; never empty, as the schema asks."""
    parts = []
    if cameras.reason[i]:
        parts.append(reason_words(cameras.reason[i])[0])
    if cameras.known[i] and cameras.sensor_width_mm is None:
        parts.append(f"sensor width not known: mm are of a nominal {cameras.sensor_mm} mm sensor")
    parts.append(f"angles relative to: {cameras.world}")
    return "; ".join(parts)[:1023]


def rational(rate: float) -> dict[str, int]:
    """A frame rate as the schema's fraction: 29.97 as 30000/1001."""
    fraction = Fraction(rate).limit_denominator(1001)
    return {"num": fraction.numerator, "denom": fraction.denominator}
