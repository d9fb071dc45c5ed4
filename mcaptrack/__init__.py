"""Find people in a video or a log, track them, repair the tracks, predict where they go, and write it all back."""

__version__ = "0.2.0.dev0"
#: Version of the shape of everything that is printed, or put into a page, as JSON.
SCHEMA_VERSION = 1

#: What the package gives beyond its parts, and where it stands.
_LAZY = {"open": "mcaptrack.api", "Recording": "mcaptrack.api", "McaptrackError": "mcaptrack.errors"}


def __getattr__(name: str) -> object:
    """``mcaptrack.open`` and so on, once somebody asks: importing the package stays light."""
    if name not in _LAZY:
        raise AttributeError(f"module 'mcaptrack' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LAZY[name]), name)
