"""``mcaptrack doctor``: what it prints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import say, show

if TYPE_CHECKING:
    from mcaptrack import DoctorResult


class Doctor(Once["DoctorResult"]):
    """Print what this installation has and lacks, and what may be done with a store."""

    def data(self, done: DoctorResult) -> dict[str, Any]:
        """Return what there is as values of JSON."""
        return done.to_json()

    def show(self, done: DoctorResult, talk: common.Talk) -> None:
        """Print a line for each thing that is there, or lacking."""
        if not self.values["quiet"]:
            lines = list(_lines(done, self.values["verbose"]))
            width = max(len(name) for name, _ in lines)
            show(*(f"{name:<{width}}  {value}" for name, value in lines))

    def code(self, done: DoctorResult) -> int:
        """Print the faults; return the exit code."""
        for fault in done.faults:
            say(fault, "error")
        return common.REFUSED if done.faults else common.DONE


def _lines(result: DoctorResult, verbose: bool) -> Iterator[tuple[str, str]]:
    """Yield the lines of the page: their names and their texts."""
    yield "mcaptrack", result.version
    yield "Python", f"{result.python}, {result.system}"
    missing = [name for name, version in result.packages.items() if not version]
    yield "packages", f"{len(result.packages) - len(missing)} of {len(result.packages)} that are needed"
    if verbose:
        yield from ((f"  {name}", version or "missing") for name, version in result.packages.items())
    for extra, lacking in result.extras.items():
        install = f"lacks {', '.join(lacking)}; `pip install 'mcaptrack[{extra}]'` installs what it needs"
        yield f"extra {extra}", install if lacking else "installed"
    for codec, why in result.codecs.items():
        yield f"codec {codec}", why or "works"
    yield "cores", f"{result.cores:g}"
    yield "memory", "unknown" if result.memory_bytes is None else f"{result.memory_bytes / 1e9:.1f} GB"
    yield "threads", ", ".join(f"{name} {number}" for name, number in result.threads.items())
    free = "" if result.temporary_bytes_free is None else f", {result.temporary_bytes_free / 1e9:.1f} GB free"
    yield "temporary files", f"{result.temporary_folder or 'no folder can be written'}{free}"
    yield from result.parts.items()
    yield "extensions", ", ".join(name for name, why in result.extensions.items() if not why) or "none"
    yield from ((f"  {name}", why) for name, why in result.extensions.items() if why)
    for name, why in result.plugins.items():
        yield name, why.removeprefix(name).lstrip(": ") or "can be imported"
    if result.store is not None:
        yield "store", result.store.url
        yield (
            "  server",
            f"{result.store.server}, region {result.store.region}" if result.store.region else result.store.server,
        )
        yield "  credentials", result.store.credentials
        yield from ((f"  {name}", why or "works") for name, why in result.store.access.items())
    doubts = f"; {len(result.warnings)} of what it can do without, see above" if result.warnings else ""
    yield "faults", f"{len(result.faults)}, see below" if result.faults else f"none{doubts}"
