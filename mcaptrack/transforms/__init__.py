"""Transforms: frames of one channel in, frames of other channels out.

``protocol`` has the interface of transforms and their laws, ``stages`` the stages of the pipeline and their transforms.
``mcaptrack.registry`` finds transforms by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from mcaptrack.transforms.detect import KnnDetector, MedianDetector, OnnxDetector
from mcaptrack.transforms.ground import GroundTracker
from mcaptrack.transforms.motion import EstimateMotion
from mcaptrack.transforms.predict import Predict
from mcaptrack.transforms.protocol import Transform
from mcaptrack.transforms.retrack import PROFILES, Retrack, RetrackByConsistency
from mcaptrack.transforms.sample import Sample
from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort
from mcaptrack.transforms.stages import FULL, FUSION, STAGES, Stage

__all__ = [
    "FULL",
    "FUSION",
    "PROFILES",
    "STAGES",
    "TRACKERS",
    "TRANSFORMS",
    "ByteTrack",
    "EstimateMotion",
    "GroundTracker",
    "KnnDetector",
    "MedianDetector",
    "OcSort",
    "OnnxDetector",
    "Predict",
    "Retrack",
    "RetrackByConsistency",
    "Sample",
    "Sort",
    "Stage",
    "Transform",
]

#: The default transform of each stage.
TRANSFORMS: Final[Mapping[str, type[Transform]]] = MappingProxyType(
    {name: stage.default for name, stage in STAGES.items()}
)
#: The built-in trackers of boxes in pictures, by name.
TRACKERS: Final[Mapping[str, type[Transform]]] = MappingProxyType(
    {name: kind for name, kind in STAGES["track"].built_in().items() if kind is not GroundTracker}
)
