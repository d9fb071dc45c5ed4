"""Calibrations of cameras in files of OpenCV, ROS and Kalibr, and what of them goes into a log."""

from mcaptrack.sources.ingest.calibration.given import Calibrated, GivenCalibration, LengthUnit
from mcaptrack.sources.ingest.calibration.trees import is_calibration

__all__ = ["Calibrated", "GivenCalibration", "LengthUnit", "is_calibration"]
