"""Test a transform, or a predictor, against the laws that hold for every one.

from mcaptrack.testing import check_predictor, check_transform

check_transform(MyTracker())
check_predictor(MyPredictor(steps=12, step_s=0.4))
"""

from mcaptrack.testing.error import LawError
from mcaptrack.testing.predictors import check_predictor
from mcaptrack.testing.transforms import LAWS, check_transform, sample_frames

__all__ = ["LAWS", "LawError", "check_predictor", "check_transform", "sample_frames"]
