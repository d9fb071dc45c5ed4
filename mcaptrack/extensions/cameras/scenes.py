"""The scenes of runs: cameras with measured ground planes are fused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mcaptrack import log
from mcaptrack.api.running import transform_of
from mcaptrack.extensions.cameras.fusers import FUSION, fuser_of
from mcaptrack.pipeline.scenes import Member, Progress, Say, SceneMaker
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import detections_topic
from mcaptrack.transforms import Stage, Transform


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
