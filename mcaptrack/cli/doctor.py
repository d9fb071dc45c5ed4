"""``mcaptrack doctor``: print what this installation has and lacks, and what may be done with a store."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import typer

import mcaptrack
from mcaptrack.cli import common
from mcaptrack.cli.text import say, show, stdout_to_stderr


@common.one_line
def doctor(
    store: Annotated[
        str | None,
        typer.Argument(
            metavar="STORE", help="A bucket or prefix to try, such as s3://robots/night.", show_default=False
        ),
    ] = None,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Print what this installation has: versions, codecs, memory, folders, plug-ins, and what may be done with a store.

    The network is used for a store only: objects are listed there, and a small hidden one is written, read, replaced
    and removed. The exit code is 0 if all that a plain run needs is there, and 1 otherwise, with one line for each
    fault.

    Example: mcaptrack doctor

    Example: mcaptrack doctor s3://robots/night
    """
    with stdout_to_stderr():
        found = mcaptrack.doctor(store)
    if json:
        common.print_json(found.to_json())
    elif not quiet:
        lines = list(_lines(found, verbose))
        width = max(len(name) for name, _ in lines)
        show(*(f"{name:<{width}}  {words}" for name, words in lines))
    for fault in found.faults:
        say(fault, "error")
    if found.faults:
        raise typer.Exit(common.REFUSED)


def _lines(found: mcaptrack.DoctorResult, verbose: bool) -> Iterator[tuple[str, str]]:
    """Yield the lines of the page: their names and their texts."""
    yield "mcaptrack", found.version
    yield "Python", f"{found.python}, {found.system}"
    missing = [name for name, version in found.packages.items() if not version]
    yield "packages", f"{len(found.packages) - len(missing)} of {len(found.packages)} that are needed"
    if verbose:
        yield from ((f"  {name}", version or "missing") for name, version in found.packages.items())
    for extra, lacking in found.extras.items():
        install = f"lacks {', '.join(lacking)}; `pip install 'mcaptrack[{extra}]'` installs what it needs"
        yield f"extra {extra}", install if lacking else "installed"
    for codec, why in found.codecs.items():
        yield f"codec {codec}", why or "works"
    yield "ONNX Runtime", ", ".join(found.onnx_providers) or "not installed"
    yield "cores", f"{found.cores:g}"
    yield "memory", "unknown" if found.memory_bytes is None else f"{found.memory_bytes / 1e9:.1f} GB"
    yield "threads", ", ".join(f"{name} {number}" for name, number in found.threads.items())
    free = "" if found.temporary_bytes_free is None else f", {found.temporary_bytes_free / 1e9:.1f} GB free"
    yield "temporary files", f"{found.temporary_folder or 'no folder can be written'}{free}"
    can = "" if found.cache_can_be_written else ", which can't be written"
    yield "fetched weights", f"{found.cache_folder}{can}"
    for name, why in found.plugins.items():
        yield name, why or "can be imported"
    if found.store is not None:
        yield "store", found.store.url
        yield (
            "  server",
            f"{found.store.server}, region {found.store.region}" if found.store.region else found.store.server,
        )
        yield "  credentials", found.store.credentials
        yield from ((f"  {name}", why or "works") for name, why in found.store.access.items())
    yield "faults", f"{len(found.faults)}, see below" if found.faults else "none"
