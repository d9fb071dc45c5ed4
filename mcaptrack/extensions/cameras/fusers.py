"""Fusers: transforms from the boxes of several cameras to the detections of one scene, and how they are found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.registry import Entry
from mcaptrack.schema import DETECTIONS, SIGHTINGS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import Stage, Transform

#: Entries of the provenance of a scene beside the parameters of its fuser.
_FINDINGS: Final = ("cameras", "clock_offset_s", "clock_offsets_given", "cameras_given", "detects", "false_share")


@dataclass(frozen=True, kw_only=True)
class Fusion(Stage):
    """Finds fusers, and checks those of other packages, as a stage does with its transforms."""

    def check(self, entry: Entry) -> None:
        """Raise McaptrackError if a class of another package can't be a fuser, which needs all outputs."""
        super().check(entry)
        for suffix in self.writes.keys() - entry.cls.writes.keys():
            raise McaptrackError(f"{entry} has no output {suffix!r}; a fuser also writes which boxes it joined")


FUSION: Final = Fusion(
    name="fuse",
    kind="fuser",
    reads=SIGHTINGS,
    writes={"": DETECTIONS, "sightings": SIGHTINGS},
    input_topic="detections/sightings",
    output_topic="detections",
    rows="detections",
)


def fuser_of(
    provenance: Provenance, named_by_user: Transform | None = None
) -> tuple[Transform | None, McaptrackError | None]:
    """Return the fuser that made a scene, with the same parameters; or None, and the reason why not.

    ``named_by_user`` is the one that the user names, if any.
    """
    parameters = {name: value for name, value in provenance.parameters.items() if name not in _FINDINGS}
    named: Mapping[str, Transform] = {} if named_by_user is None else {FUSION.name: named_by_user}
    try:
        return rebuild(FUSION, replace(provenance, parameters=parameters), named), None
    except McaptrackError as error:
        return None, error
