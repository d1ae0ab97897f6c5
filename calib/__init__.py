"""Homographies to a calibrated camera track: self-calibration of a rotating and zooming camera."""
