"""Fusers, transforms from the boxes of several cameras to the detections of one scene, and how they are found; and the
scenes of runs: cameras with measured ground planes are fused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

from mcaptrack import log
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import chooser
from mcaptrack.api.running import transform_of
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.pipeline.scenes import Member, Progress, Say, SceneMaker
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.registry import Entry
from mcaptrack.schema import DETECTIONS, SIGHTINGS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import detections_topic
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


class FusedScenes(SceneMaker):
    """Fuses cameras, unless ``fuse`` is false, by a fuser. Modules are imported when they are used."""

    def __init__(self, fuse: bool, fuser: str | Transform | None) -> None:
        self.off = "" if fuse else "`fuse=False` was given"
        self._fuser = None if fuser is None else transform_of(FUSION, fuser, {})

    def joinable(self, opened: log.Log, cameras: Sequence[str]) -> tuple[list[str], str]:
        """Return which cameras have detections and a measured ground plane, and why others can't be fused."""
        from mcaptrack.extensions.cameras.fusing import fusable

        return fusable(opened, cameras)

    def join(self, opened: log.Log, cameras: Sequence[str], prefix: str, progress: Progress) -> Mapping[str, Made]:
        """Fuse cameras, unless they don't see the same people."""
        from mcaptrack.extensions.cameras.fusing import fuse_cameras

        fuser = self._fuser or FUSION.make()
        return fuse_cameras(opened, cameras, prefix, fuser, {}, progress, is_chosen=False, takes_strangers=False)

    def join_again(
        self, opened: log.Log, prefix: str, force: bool, adds: bool, say: Say, progress: Progress
    ) -> Mapping[str, Made] | None:
        """Fuse the cameras of a scene again, if a fuser made it."""
        from mcaptrack.extensions.cameras.fusing import fuse_again

        return fuse_again(opened, prefix, force, say, progress, adds, self._fuser)

    def maker_of(self, how: Provenance) -> tuple[Stage, Transform] | None:
        """Return the fuser that made a scene."""
        fuser = fuser_of(how)[0] if FUSION.kind in how.parameters else None
        return None if fuser is None else (FUSION, fuser)

    def members(self, state: RunState) -> Sequence[Member]:
        """Return the cameras with pictures and a ground plane."""
        from mcaptrack.extensions.cameras.on_pictures import members_of

        how = state.provenance(detections_topic(state.prefix))
        return members_of(state, how) if how is not None and FUSION.kind in how.parameters else ()


#: The heading in the help of ``run``.
_SEVERAL: Final = "Several cameras"
_FUSER: Final = chooser(
    "fuser", "The {kind}, also where another one was used before", _SEVERAL, shown="as before, or feet"
)


@declared()
def scenes(
    *,
    fuse: Annotated[
        bool,
        Option(
            _SEVERAL,
            tuning=True,
            help="Fuse several cameras with measured ground planes to a scene, as `mcaptrack fuse` does.\n\n"
            "Scenes that were made before are brought up to date.",
        ),
    ] = True,
    fuser: Annotated[str | Transform | None, _FUSER] = None,
) -> SceneMaker:
    """Make scenes of the cameras of a run, or none."""
    return FusedScenes(fuse, fuser)
