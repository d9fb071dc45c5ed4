"""Transforms: frames of one channel in, frames of other channels out.

``protocol`` has the interface of transforms and their laws, ``stages`` the stages of the pipeline and their transforms,
which are imported when they are first used. ``mcaptrack.registry`` finds transforms by name.
"""

from mcaptrack import _lazily, _listed

_MODULES = _listed(__file__)
_imported = _lazily(__name__, _MODULES)


def __getattr__(name: str) -> object:
    """Import a transform when it is first used: what only asks for topics of stages loads none.

    ``TRANSFORMS`` are the default transforms of the stages, ``TRACKERS`` the built-in trackers of boxes in pictures, by
    name.
    """
    if name == "TRANSFORMS":
        return {name: stage.default for name, stage in _imported("STAGES").items()}
    if name == "TRACKERS":
        return {name: kind for name, kind in _imported("STAGES")["track"].built_in().items() if name != "ground"}
    if name == "__all__":
        return sorted({*_MODULES, "TRACKERS", "TRANSFORMS"})
    return _imported(name)
