"""Transforms: frames of one channel in, frames of others out. See ``protocol`` for what a transform is and its laws.

``stages`` says which steps there are and which transforms can do each; ``mcaptrack.registry`` finds transforms by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from mcaptrack.transforms.detect import FrameDifferenceDetector, KnnDetector, Mog2Detector, MotionDetector
from mcaptrack.transforms.predict import Predict
from mcaptrack.transforms.protocol import Transform
from mcaptrack.transforms.retrack import PROFILES, Retrack, RetrackByConsistency
from mcaptrack.transforms.sample import Sample
from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort
from mcaptrack.transforms.stages import FULL, STAGES, Stage

__all__ = [
    "FULL",
    "PROFILES",
    "STAGES",
    "TRACKERS",
    "TRANSFORMS",
    "ByteTrack",
    "FrameDifferenceDetector",
    "KnnDetector",
    "Mog2Detector",
    "MotionDetector",
    "OcSort",
    "Predict",
    "Retrack",
    "RetrackByConsistency",
    "Sample",
    "Sort",
    "Stage",
    "Transform",
]

#: The default transform of each step.
TRANSFORMS: Final[Mapping[str, type[Transform]]] = MappingProxyType(
    {name: stage.default for name, stage in STAGES.items()}
)
#: The built-in trackers by name.
TRACKERS: Final[Mapping[str, type[Transform]]] = MappingProxyType(STAGES["track"].built_in())
