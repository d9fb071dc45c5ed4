"""Detect and track people in a video or a log, repair the tracks, predict where people go, and write the results."""

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

__version__ = "0.3.0"
#: Version of the shape of everything that is printed, or put into a page, as JSON.
SCHEMA_VERSION = 1


def _listed(file: str) -> dict[str, str]:
    """The module of each name of a package, by the stub beside its ``file``, which alone lists them."""
    with open(f"{file}i", encoding="utf-8") as stub:
        imports = [line.split() for line in stub if line.startswith("from mcaptrack.") and ".extensions." not in line]
    return {name: module for _, module, _, name, *_ in imports}


def _lazily(package: str, modules: Mapping[str, str]) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package: it imports a name from its module when the name is first used."""

    def imported(name: str) -> object:
        if name not in modules:
            raise _unknown(package, name, modules)
        from importlib import import_module

        return getattr(import_module(modules[name]), name)

    return imported


def _unknown(package: str, name: str, names: Iterable[str]) -> AttributeError:
    from mcaptrack.errors import did_you_mean

    meant = f"; {did_you_mean(name, names)}".rstrip("; ")
    return AttributeError(f"module {package!r} has no attribute {name!r}{meant}")


#: Where the names of the package are defined; each is imported when it is first used: `import mcaptrack` stays light.
_MODULES = _listed(__file__)
_imported = _lazily(__name__, _MODULES)


def __getattr__(name: str) -> object:
    """Import a name when it is first used: of the package, or of an entry point for commands or for names.

    A module of the package is never one of these.
    """
    if name == "__all__":
        return sorted({*_MODULES, *_of_entry_points(own=True)})
    from importlib.util import find_spec

    if name in _MODULES or name.startswith("_") or find_spec(f"{__name__}.{name}"):
        return _imported(name)
    from mcaptrack.installed import missing_extension
    from mcaptrack.registry import find

    kinds = _of_entry_points()
    if name in kinds:
        return find(kinds[name], name).cls
    if text := missing_extension(name):
        # Of `from mcaptrack import NAME` Python drops the text of an AttributeError.
        error = ImportError if sys._getframe(1).f_code.co_name == "_handle_fromlist" else AttributeError
        raise error(f"module {__name__!r} has no attribute {name!r}: {text}")
    raise _unknown(__name__, name, [*_MODULES, *kinds])


def _of_entry_points(*, own: bool = False) -> dict[str, Any]:
    """The kinds of the entry points that give names to the package, by name; with ``own`` those of extensions alone."""
    from mcaptrack.registry import Kind, points

    kinds: tuple[Kind, ...] = ("command", "name")
    names = {point.name: kind for kind in kinds for point in points(kind) if point.is_own or not own}
    return {name: kind for name, kind in names.items() if name.isidentifier()}


def __dir__() -> list[str]:
    """List the names of the package, also those that were not imported yet."""
    return sorted({*globals(), *_MODULES, *_of_entry_points()})
