"""FreeD type D1: 29 bytes a packet, big-endian; as a file of packets, or sent by UDP at the clip's frame rate.

Pan right, tilt up, roll clockwise positive, in 1/32768 degree; pan and roll are wrapped to -180..180. The position is
0: a camera that only turns has no metres. The zoom field is in arbitrary units by the standard; ours is
round(f_mm * 1000) where the sensor's width is known, else round(f_px * 16), and the notes say which. User field: frame
mod 65536. There is no 'invalid' packet, so a frame without a camera is not sent. Source: the Free-d protocol as
published by Vinten, appendix B.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import InputError
from pipelines.exports.cameras import ShotCameras
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_file

PACKET_BYTES = 29
DEGREE = 32768  # steps
ZOOM_PER_MM, ZOOM_PER_PX = 1000, 16
LIMIT = 1 << 24


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the packets one after the other; returns the zoom law and what the format cannot say."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        for _, data in packets(cameras, options):
            stream.write(data)
    return facts(cameras)


def facts(cameras: ShotCameras) -> dict[str, Any]:
    """The zoom law in words, and in px what the format leaves out."""
    known = cameras.sensor_width_mm is not None
    return {
        "zoom_law": f"zoom = round(focal length in mm * {ZOOM_PER_MM}), sensor {cameras.sensor_mm} mm wide"
        if known
        else f"zoom = round(f_px * {ZOOM_PER_PX}), f_px for a picture {cameras.size_px[0]} px wide",
        "focus": "0: not known",
        "packet_bytes": PACKET_BYTES,
        "packets_per_s": cameras.picture_fps,
        "not_in_this_format": {
            "distortion_px": round(cameras.largest_distortion_px(), 3),
            "principal_point_offset_px": round(cameras.largest_pp_offset_px(), 3),
        },
    }


def packets(cameras: ShotCameras, options: ExportOptions) -> Iterator[tuple[int, bytes]]:
    """(row, packet) of every frame with a camera. Raises InputError when a focal length does not fit the zoom field."""
    known = cameras.sensor_width_mm is not None
    scale = ZOOM_PER_MM * cameras.sensor_mm / cameras.size_px[0] if known else ZOOM_PER_PX
    for i in cameras.rows.tolist():
        zoom = round(float(cameras.f_px[i]) * scale)
        if not 0 <= zoom < LIMIT:
            cause = f"a focal length of {cameras.f_px[i]:.0f} px does not fit FreeD's zoom field"
            raise InputError(cameras.clip, cause, "check --sensor-width-mm")
        yield (
            i,
            packet(
                options.camera_id,
                pan_deg=float(cameras.pan_deg[i]),
                tilt_deg=float(cameras.tilt_deg[i]),
                roll_deg=float(cameras.roll_deg[i]),
                zoom=zoom,
                user=int(cameras.frame[i]) % 65536,
            ),
        )


def packet(
    camera_id: int,
    *,
    pan_deg: float,
    tilt_deg: float,
    roll_deg: float,
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    zoom: int = 0,
    focus: int = 0,
    user: int = 0,
) -> bytes:
    """One D1 packet. Angles in degrees, position (X right, Y forward, Z up) in mm, zoom and focus 24 bit, user 16 bit.

    Raises ValueError when a value does not fit its field.
    """
    angles = [round(a * DEGREE) for a in (wrapped(pan_deg), tilt_deg, wrapped(roll_deg))]
    values = [*angles, *(round(p * 64) for p in position_mm)]
    if not -90 <= tilt_deg <= 90:
        raise ValueError(f"tilt {tilt_deg} lies outside -90..90 degrees")
    try:
        data = bytes([0xD1, camera_id])
        data += b"".join(value.to_bytes(3, "big", signed=True) for value in values)
        data += zoom.to_bytes(3, "big") + focus.to_bytes(3, "big") + user.to_bytes(2, "big")
    except OverflowError as error:
        raise ValueError(f"a value does not fit its FreeD field: {error}") from None
    return data + bytes([(0x40 - sum(data)) % 256])


def wrapped(angle_deg: float) -> float:
    """The angle within -180..180 degrees; both ends stay as they are, as the standard has a code for each."""
    return angle_deg if -180 <= angle_deg <= 180 else float((angle_deg + 180) % 360 - 180)


def send(
    cameras: ShotCameras, options: ExportOptions, address: tuple[str, int], *, speed: float = 1.0
) -> int:
    """Send the packets by UDP, one a datagram, each when its frame is due; returns how many.

    Due times are absolute, start + (pts - first pts) / speed, so that late wake-ups do not add up. Raises OSError when
    the network refuses, ValueError when speed is not positive.
    """
    if not speed > 0:
        raise ValueError(f"speed is {speed}, must be positive")
    sent = 0
    with socket.socket(_family(address), socket.SOCK_DGRAM) as link:
        start = time.monotonic()
        first: float | None = None
        for i, data in packets(cameras, options):
            due = float(cameras.pts_s[i])
            if not np.isfinite(due):
                due = float(cameras.frame[i]) / cameras.picture_fps
            first = due if first is None else first
            wait = start + (due - first) / speed - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            link.sendto(data, address)
            sent += 1
    return sent


def _family(address: tuple[str, int]) -> socket.AddressFamily:
    return socket.getaddrinfo(address[0], address[1], type=socket.SOCK_DGRAM)[0][0]
