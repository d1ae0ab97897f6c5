"""What run.json says of a shot's pupil, and back: light, for those who read a finished run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.parallax import Parallax
from calib.pupil import PupilFit


def pupil_facts(pupil: PupilFit | None, R_table_world: NDArray[np.float64]) -> dict[str, Any] | None:
    """JSON-ready; None where the shot was too little calibrated to look for one.

    R_table_world: axes of the solution into those of camera.csv, whose R_head_world is told.
    """
    if pupil is None:
        return None
    parallax = None if pupil.parallax is None else pupil.parallax.of_axes(R_table_world)
    return {
        "accepted": pupil.accepted,
        "reason": pupil.reason,
        "sentence": pupil.sentence,
        "over_height": pupil.over_height,
        "over_height_std": pupil.over_height_std,
        "over_stand": pupil.over_stand,
        "over_stand_std": pupil.over_stand_std,
        "focal_change": float(np.expm1(pupil.shift_log_f)),
        "R_head_world": None if parallax is None else parallax.R_head_world.tolist(),
    }


def parallax_of(calibration: Mapping[str, Any]) -> Parallax | None:
    """The parallax in the axes of camera.csv from a shot's `calibration` in run.json; None where none was taken out."""
    facts = calibration.get("pupil") or {}
    if not facts.get("accepted") or facts.get("R_head_world") is None:
        return None
    return Parallax(
        over_height=float(facts["over_height"]),
        over_stand=float(facts["over_stand"]),
        R_head_world=np.array(facts["R_head_world"], np.float64),
    )
