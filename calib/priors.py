"""What users know before any picture, as Priors: field of view, focal length in mm, the lens of an earlier match.

Half-width distortion k1_half(f) = c0 + c1 log(f / W) does not depend on the resolution, so a profile made at one serves
another of the same framing. Nothing here is estimated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import serial
from calib.records import KnownFocal, Priors, Solution

PROFILE_FORMAT = 1


def focal_px_from_fov(hfov_rad: float, width_px: int) -> float:
    """fx px of the full horizontal angle of the undistorted picture. Raises ValueError outside (0, pi)."""
    if not 0 < hfov_rad < np.pi:
        raise ValueError(f"hfov_rad must lie between 0 and pi, got {hfov_rad}")
    return float(width_px / (2 * np.tan(hfov_rad / 2)))


def focal_px_from_mm(focal_mm: float, sensor_width_mm: float, width_px: int) -> float:
    """fx px of a focal length and the width of the sensor's used part, mm. Raises ValueError unless both are > 0."""
    if not (focal_mm > 0 and sensor_width_mm > 0):
        raise ValueError(f"lengths must be positive, got {focal_mm} and {sensor_width_mm} mm")
    return float(focal_mm / sensor_width_mm * width_px)


def focal_mm_from_px(focal_px: float, sensor_width_mm: float, width_px: int) -> float:
    """Inverse of `focal_px_from_mm`."""
    if not sensor_width_mm > 0:
        raise ValueError(f"sensor_width_mm must be positive, got {sensor_width_mm}")
    return float(focal_px * sensor_width_mm / width_px)


def with_known_focal(priors: Priors, frame: int, f_px: float, std_px: float) -> Priors:
    """The priors with one more known focal, px of the decoded width. Raises ValueError unless both are positive."""
    if not (f_px > 0 and std_px > 0):
        raise ValueError(f"focal and its error must be positive, got {f_px} +- {std_px} px")
    return replace(
        priors, known_focals=(*priors.known_focals, KnownFocal(frame=frame, f_px=f_px, std_px=std_px))
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LensProfile:
    """The lens of a calibrated shot, for the next: k1_half(f) = c0 + c1 log(f / W) with errors, and where it was seen.

    pp_offset_w: principal point less the centre, in widths, (x, y), and its errors. log_f_w: range of log(f / W) that
    the shot covered: outside of it c1 is an extrapolation. k2, k2_std: the second coefficient, 0 where the shot was
    calibrated without one. A drift of the principal point is not kept.
    """

    c0: float
    c1: float
    c0_std: float
    c1_std: float
    pp_offset_w: tuple[float, float]
    pp_std_w: tuple[float, float]
    log_f_w: tuple[float, float]
    k2: float = 0.0
    k2_std: float = 0.0

    def save(self, path: str | Path) -> None:
        """Write as JSON."""
        Path(path).write_text(
            json.dumps({"lens_profile": PROFILE_FORMAT, **serial.to_plain(self)}, indent=1) + "\n",
            encoding="utf-8",
        )

    @classmethod
    def load(cls, path: str | Path) -> LensProfile:
        """Read what save() wrote. Raises ValueError for another file."""
        try:
            value = json.loads(Path(path).read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise ValueError(f"{path} is no lens profile: {error}") from error
        if not isinstance(value, Mapping) or value.get("lens_profile") != PROFILE_FORMAT:
            raise ValueError(f"{path} is no lens profile of format {PROFILE_FORMAT}")
        rest = {k: v for k, v in value.items() if k != "lens_profile"}
        return serial.from_plain(cls, rest)


def lens_profile(solution: Solution) -> LensProfile:
    """The profile of a calibrated shot. A coefficient that the shot held fixed keeps its prior's error.

    Raises ValueError for a solution that did not converge.
    """
    if not solution.converged:
        raise ValueError(f"a solution that stopped with {solution.stop!r} has no lens to save")
    lens, std, W = solution.lens, solution.lens_std, solution.lens.size_px[0]
    centre = (np.array(lens.size_px) - 1) / 2
    offset = (lens.pp_px - centre) / W
    log_f_w = solution.log_f[np.isfinite(solution.log_f)] - np.log(W)
    priors = solution.priors
    return LensProfile(
        c0=lens.c0, c1=lens.c1, c0_std=std.get("c0", 0.0) or priors.c0_std, c1_std=std.get("c1", 0.0) or priors.c1_std,
        pp_offset_w=(float(offset[0]), float(offset[1])),
        pp_std_w=((std.get("pp_x", 0.0) or priors.pp_std_x * W) / W, (std.get("pp_y", 0.0) or priors.pp_std_y * W) / W),
        log_f_w=(float(log_f_w.min()), float(log_f_w.max())), k2=lens.k2, k2_std=std.get("k2", 0.0),
    )  # fmt: skip


def with_profile(priors: Priors, profile: LensProfile, *, trust: float = 2.0) -> Priors:
    """The priors with the distortion of a profile; the principal point stays the priors' (parallax is in it).

    trust: factor on the profile's statistical errors, which do not contain what a shot's edges share. Never wider than
    the priors were. The correlation of c0 and c1 is left out: on the safe side within the profile's range. A profile
    with a k2 hands it on, held where the priors do not free it. Raises ValueError unless trust is positive.
    """
    if not trust > 0:
        raise ValueError(f"trust must be positive, got {trust}")
    return replace(
        priors, c0_mean=profile.c0, c0_std=min(trust * profile.c0_std, priors.c0_std),
        c1_mean=profile.c1, c1_std=min(trust * profile.c1_std, priors.c1_std),
        k2_mean=profile.k2 or priors.k2_mean,
        k2_std=min(trust * profile.k2_std, priors.k2_std) if profile.k2 else priors.k2_std,
    )  # fmt: skip
