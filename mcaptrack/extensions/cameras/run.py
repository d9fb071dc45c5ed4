"""The options of ``run`` for scenes of several cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import chooser
from mcaptrack.transforms import Transform

if TYPE_CHECKING:
    from mcaptrack.pipeline.scenes import SceneMaker

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
    from mcaptrack.extensions.cameras.scenes import FusedScenes

    return FusedScenes(fuse, fuser)
