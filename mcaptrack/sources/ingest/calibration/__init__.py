"""Calibrations of cameras in files of OpenCV, ROS and Kalibr, and what of them goes into a log."""

from mcaptrack.sources.ingest.calibration.content import is_calibration
from mcaptrack.sources.ingest.calibration.given import Calibrated, GivenCalibration

__all__ = ["Calibrated", "GivenCalibration", "is_calibration"]
