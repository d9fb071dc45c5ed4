"""The verbs: channels to channels. See ``protocol`` for what a transform is and which laws hold for all.

To add one: a module here, a name in ``TRANSFORMS``, a test file; and where it reads and writes, in ``cameras.ROUTES``.
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
    "implementation_of",
    "kinds_of",
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


def kinds_of(command: str) -> Mapping[str, type[Transform]]:
    """The built-in transforms of a command, by name."""
    return ALTERNATIVES[command].kinds if command in ALTERNATIVES else {command: TRANSFORMS[command]}


def implementation_of(command: str, kind: type[Transform]) -> str:
    """Where a transform of others is defined, as in "package.module:Class"; "" for a built-in one.

    A class that inherits from a built-in one does something else, and is one of others.
    """
    return "" if kind in kinds_of(command).values() else f"{kind.__module__}:{kind.__qualname__}"


def choice(command: str, transform: Transform) -> dict[str, str]:
    """Which of a command's transforms this is, as the provenance says it: {"tracker": "sort"}.

    {} if the command has but one, and for a transform of others.
    """
    names = [name for name, kind in kinds_of(command).items() if kind is type(transform)]
    return {ALTERNATIVES[command].option: names[0]} if command in ALTERNATIVES and names else {}


def chosen(command: str, parameters: Mapping[str, Any]) -> tuple[str, str, type[Transform] | None]:
    """Which built-in transform these parameters of a provenance are of: the option that chose it, its name and its
    kind; the usual one if they don't say, None for a name that there is not.
    """
    if command not in ALTERNATIVES:
        return "", command, TRANSFORMS[command]
    option, kinds = ALTERNATIVES[command]
    usual = next(name for name, kind in kinds.items() if kind is TRANSFORMS[command])
    name = str(parameters.get(option, usual))
    return option, name, kinds.get(name)
