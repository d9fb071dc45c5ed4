"""``mcaptrack models``: list the detectors of the catalogue, and fetch their weights."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer

import mcaptrack
from mcaptrack.cli import common
from mcaptrack.cli.text import say, show
from mcaptrack.errors import McaptrackError, command


@common.one_line
def models(
    action: Annotated[
        str | None, typer.Argument(metavar="[get", help="`get` fetches the weights of NAME.", show_default="a list")
    ] = None,
    name: Annotated[str | None, typer.Argument(metavar="NAME]", help="The model to fetch.", show_default=False)] = None,
    source: Annotated[
        str | None,
        common.option("--from", panel=common.FILES, metavar="FILE|URL", help="Take the weights from here instead."),
    ] = None,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """List the learned detectors of the catalogue, or fetch the weights of one, once.

    Only a file with the known SHA-256 is taken. The weights are kept in your folder of caches, or where the environment
    variable MCAPTRACK_MODELS says.

    Example: mcaptrack models

    Example: mcaptrack models get yolox-nano
    """
    if action is None:
        if source is not None:
            raise McaptrackError("--from goes with get and the name of a model")
        _list(json, verbose)
        return
    if action != "get" or name is None:
        text = " ".join(filter(None, (action, name)))
        raise McaptrackError(
            f"models takes nothing, or get and a name, not {text}; {command('models')} lists the names"
        )
    path = mcaptrack.get_model(name, source=source)
    if json:
        common.print_json({"name": name, "path": str(path)})
    elif not quiet:
        say(f"{path}: {command('run', 'LOG', '--detector', name)} uses it")


def _list(json: bool, verbose: bool) -> None:
    models: list[dict[str, Any]] = [
        {**asdict(model), "path": str(model.path) if model.path.is_file() else None} for model in mcaptrack.models()
    ]
    if json:
        common.print_json({"models": models})
        return
    for model in models:
        where = model["path"] or f"not fetched; {command('models', 'get', model['name'])} fetches it"
        size = f"{model['size_bytes'] / 1e6:.1f} MB"
        lines = [
            f"{model['name']}  {size}, {model['licence']}, trained on {model['trained_on']}",
            f"  good for  {model['good_for']}",
            f"  source    {model['source']}",
            f"  file      {where}",
        ]
        lines += [f"  sha256    {model['sha256']}", *(f"  url       {url}" for url in model["urls"])] if verbose else []
        show(*lines)
