"""Transforms: frames of one channel in, frames of other channels out.

``protocol`` has the interface of transforms and their laws, ``stages`` the stages of the pipeline and their transforms,
which are imported when they are first used. ``mcaptrack.registry`` finds transforms by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from mcaptrack import _lazily
from mcaptrack.transforms.protocol import Transform
from mcaptrack.transforms.stages import FULL, STAGES, Stage

if TYPE_CHECKING:
    from mcaptrack.transforms.detect import KnnDetector, MedianDetector, OnnxDetector
    from mcaptrack.transforms.ground import GroundTracker
    from mcaptrack.transforms.motion import EstimateMotion
    from mcaptrack.transforms.predict import Predict
    from mcaptrack.transforms.retrack import PROFILES, Retrack, RetrackByConsistency
    from mcaptrack.transforms.sample import Sample
    from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort

    #: The default transform of each stage.
    TRANSFORMS: Mapping[str, type[Transform]]
    #: The built-in trackers of boxes in pictures, by name.
    TRACKERS: Mapping[str, type[Transform]]

__all__ = [
    "FULL",
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

_ROOMS: Final = {
    "detect": ("KnnDetector", "MedianDetector", "OnnxDetector"),
    "ground": ("GroundTracker",),
    "motion": ("EstimateMotion",),
    "predict": ("Predict",),
    "retrack": ("PROFILES", "Retrack", "RetrackByConsistency"),
    "sample": ("Sample",),
    "sort": ("ByteTrack", "OcSort", "Sort"),
}
_MODULES: Final = {name: f"{__name__}.{room}" for room, names in _ROOMS.items() for name in names}

if not TYPE_CHECKING:  # with it a type checker would take any name for one of this package
    _imported = _lazily(__name__, _MODULES)

    def __getattr__(name: str) -> object:
        """Import a transform when it is first used: what only asks for topics of stages loads none."""
        if name == "TRANSFORMS":
            return {name: stage.default for name, stage in STAGES.items()}
        if name == "TRACKERS":
            return {name: kind for name, kind in STAGES["track"].built_in().items() if name != "ground"}
        return _imported(name)
