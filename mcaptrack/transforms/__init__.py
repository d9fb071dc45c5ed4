"""The verbs: channels to channels. See ``protocol`` for what a transform is and which laws hold for all.

To add one: a module here, a name in ``TRANSFORMS``, a test file; and where it reads and writes, in ``pipeline.ROUTES``.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from mcaptrack.transforms.detect import Detect
from mcaptrack.transforms.predict import Predict
from mcaptrack.transforms.protocol import Transform
from mcaptrack.transforms.retrack import PROFILES, Retrack
from mcaptrack.transforms.sample import Sample
from mcaptrack.transforms.sort import Sort

__all__ = ["PROFILES", "TRANSFORMS", "Detect", "Predict", "Retrack", "Sample", "Sort", "Transform"]

#: All transforms by the name of their command.
TRANSFORMS: Final[MappingProxyType[str, type[Transform]]] = MappingProxyType(
    {"detect": Detect, "track": Sort, "sample": Sample, "predict": Predict, "retrack": Retrack}
)
