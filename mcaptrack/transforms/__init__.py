"""The verbs: channels to channels. See ``protocol`` for what a transform is and which laws hold for all.

To add one: a module here, a name in ``TRANSFORMS``, a test file; and where it reads and writes, in ``pipeline.ROUTES``.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from mcaptrack.transforms.detect import Detect
from mcaptrack.transforms.predict import Predict
from mcaptrack.transforms.protocol import Transform
from mcaptrack.transforms.retrack import PROFILES, Retrack
from mcaptrack.transforms.sample import Sample
from mcaptrack.transforms.sort import TRACKERS, ByteTrack, OcSort, Sort

__all__ = [
    "ALTERNATIVES",
    "PROFILES",
    "TRACKERS",
    "TRANSFORMS",
    "ByteTrack",
    "Detect",
    "OcSort",
    "Predict",
    "Retrack",
    "Sample",
    "Sort",
    "Transform",
    "choice",
    "chosen",
]

#: All transforms by the name of their command; where there are several, the default.
TRANSFORMS: Final[MappingProxyType[str, type[Transform]]] = MappingProxyType(
    {"detect": Detect, "track": Sort, "sample": Sample, "predict": Predict, "retrack": Retrack}
)


class Alternatives(NamedTuple):
    """Several transforms for one command: the option that chooses, and what there is to choose from."""

    option: str
    kinds: Mapping[str, type[Transform]]


#: The commands that have several transforms.
ALTERNATIVES: Final[Mapping[str, Alternatives]] = MappingProxyType({"track": Alternatives("tracker", TRACKERS)})


def choice(command: str, transform: Transform) -> dict[str, str]:
    """Which of a command's transforms this is, as the provenance says it: {"tracker": "sort"}. {} if it has but one."""
    if command not in ALTERNATIVES:
        return {}
    option, kinds = ALTERNATIVES[command]
    return {option: next(name for name, kind in kinds.items() if kind is type(transform))}


def chosen(command: str, parameters: Mapping[str, Any]) -> type[Transform]:
    """The kind of transform that these parameters of a provenance are of; the default if they don't say."""
    if command not in ALTERNATIVES:
        return TRANSFORMS[command]
    option, kinds = ALTERNATIVES[command]
    return kinds.get(parameters.get(option, ""), TRANSFORMS[command])
