"""What run.json says about a shot's calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.pupil_facts import pupil_facts
from pipelines.readout import readout_facts
from pipelines.shot import CalibratedShot
from pipelines.shutter import shutter_facts
from pipelines.tracking import ShotTracker


def calibration_facts(shot: CalibratedShot, tracker: ShotTracker) -> dict[str, Any]:
    """What run.json says about a shot's calibration. JSON-ready but for numpy scalars and NaN."""
    solution, verdict, head = shot.keyframes.solution, shot.verdict, shot.level
    reasons: dict[str, int] = {}
    for fit in tracker.fits:
        key = str(fit.status) if fit.usable else f"{fit.status}: {fit.reason}"
        reasons[key] = reasons.get(key, 0) + 1
    residual = shot.solution.rms_px[np.isfinite(shot.solution.rms_px)]
    return {
        "claims_focal": verdict.claims_focal,
        "reason": verdict.reason,
        "sentence": verdict.sentence,
        "sigma_relative": verdict.sigma_log_f_total,
        "sigma_parts": dict(verdict.sigma_parts),
        "s10_px": verdict.s10_px,
        "chi2_dof": verdict.chi2_dof,
        "rotation_deg": verdict.rotation_deg,
        "zoom_range": verdict.zoom_range,
        "support_rows": verdict.support_rows,
        "flags": list(verdict.flags),
        "lens": {
            "pp_px": solution.lens.pp_px.tolist(),
            "aspect": solution.lens.aspect,
            "k1_half_c0": solution.lens.c0,
            "k1_half_c1": solution.lens.c1,
            "std": dict(solution.lens_std),
        },
        "level": {
            "observable": head.observable,
            "reason": head.reason,
            "sentence": head.sentence,
            "tilt0_deg": float(np.degrees(head.tilt0_rad)),
            "rho_deg": float(np.degrees(head.rho_rad)),
            "tilt0_std_deg": float(np.degrees(head.tilt0_std_rad)),
            "rho_std_deg": float(np.degrees(head.rho_std_rad)),
        },
        "pupil": pupil_facts(shot.keyframes.pupil, head.R_head_world if head.observable else np.eye(3)),
        "rolling_shutter": readout_facts(shot.keyframes.readout),
        "shutter": shutter_facts(shot.keyframes.shutter),
        "keyframes": [int(k) for k in sorted(tracker.keyframes)],
        "keyframe_pairs": len(shot.keyframes.fits),
        "keyframe_pairs_usable": sum(f.usable for f in shot.keyframes.fits),
        "rotation_fit": None if shot.explained is None else shot.explained.facts(),
        "rounds": shot.keyframes.rounds,
        "converged": solution.converged,
        "first_pass_pairs": reasons,
        "residual_median_px": float(np.median(residual)) if len(residual) else float("nan"),
    }
