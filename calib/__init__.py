"""Homographies to a calibrated camera track: self-calibration of a rotating and zooming camera.

numpy and scipy only; knows no image. calibrate() takes a handful of homographies with covariance and gives cameras with
covariance and a verdict. For shots: refine() calibrates a graph of keyframes, solve_poses() the frames in between,
judge() says whether the focal length may be published, RunningCalibrator does it while frames arrive.
"""

from calib.calibration import CalibrateOptions, Calibration
from calib.gates import GateOptions, judge
from calib.homography_fit import fit_homography
from calib.level import LevelOptions, level
from calib.observability import observability
from calib.poses import PoseOptions, solve_poses
from calib.pupil import PupilFit, PupilOptions, fit_pupil
from calib.records import (
    HomographyEdge,
    HomographyGraph,
    KnownFocal,
    Lens,
    Level,
    Priors,
    Solution,
    StraightLine,
    Verdict,
)
from calib.refine import RefineOptions, refine
from calib.running import CameraEstimate, RunningCalibrator, RunningOptions
from calib.selfcalibration import calibrate
from calib.straightness import fit_lines

__all__ = [
    "CalibrateOptions",
    "Calibration",
    "CameraEstimate",
    "GateOptions",
    "HomographyEdge",
    "HomographyGraph",
    "KnownFocal",
    "Lens",
    "Level",
    "LevelOptions",
    "PoseOptions",
    "Priors",
    "PupilFit",
    "PupilOptions",
    "RefineOptions",
    "RunningCalibrator",
    "RunningOptions",
    "Solution",
    "StraightLine",
    "Verdict",
    "calibrate",
    "fit_homography",
    "fit_lines",
    "fit_pupil",
    "judge",
    "level",
    "observability",
    "refine",
    "solve_poses",
]
