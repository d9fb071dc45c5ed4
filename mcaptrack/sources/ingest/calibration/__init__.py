"""Calibrations of cameras in files of OpenCV, ROS and Kalibr, and what of them goes into a log."""

from mcaptrack.sources.ingest.calibration.given import Calibrated, GivenCalibration
from mcaptrack.sources.ingest.calibration.trees import is_calibration

__all__ = ["Calibrated", "GivenCalibration", "is_calibration"]
