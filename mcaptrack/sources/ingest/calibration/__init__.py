"""Calibrations of cameras in files of OpenCV, ROS and Kalibr, and what of them goes into a log."""

from mcaptrack.sources.ingest.calibration.content import Calibrated, GivenCalibration, is_calibration

__all__ = ["Calibrated", "GivenCalibration", "is_calibration"]
