"""``mcaptrack models``: list the detectors of the catalogue, and fetch their weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import mcaptrack
from mcaptrack import Model
from mcaptrack.api.declared import Option
from mcaptrack.api.options import FILES
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import show
from mcaptrack.errors import McaptrackError, command


class Models(Once[tuple[Model, ...] | Path]):
    """List the detectors; or, with ``get``, fetch the weights of one."""

    class More:
        """Options that the list has no use for."""

        source: Annotated[
            str | None, Option(FILES, flag="from", metavar="FILE|URL", help="Take the weights from here instead.")
        ] = None

    @property
    def function(self) -> Callable[..., tuple[Model, ...] | Path]:
        """The function: another one fetches."""
        return mcaptrack.get_model if self.values["words"] else mcaptrack.models

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: the model to fetch, if there is one, and from where."""
        words, source = self.values["words"] or [], self.values["source"]
        if not words and source is not None:
            raise McaptrackError("--from goes with get and the name of a model")
        if words and (words[0] != "get" or len(words) != 2):
            names_them = f"{command('models')} lists the names"
            raise McaptrackError(f"models takes nothing, or get and a name, not {' '.join(words)}; {names_them}")
        return {"name": words[1], "source": source} if words else {}

    def data(self, done: tuple[Model, ...] | Path) -> dict[str, Any]:
        """Return the models, or the file that was fetched, as values of JSON."""
        if isinstance(done, Path):
            return {"name": self.values["words"][1], "path": str(done)}
        return {"models": [{**asdict(model), "path": _file_of(model)} for model in done]}

    def show(self, done: tuple[Model, ...] | Path, talk: common.Talk) -> None:
        """Print the models, or where the weights are."""
        if isinstance(done, Path):
            talk.say(f"{done}: {command('run', 'LOG', '--detector', self.values['words'][1])} uses it")
            return
        for model in done:
            where = _file_of(model) or f"not fetched; {command('models', 'get', model.name)} fetches it"
            size = f"{model.size_bytes / 1e6:.1f} MB"
            show(
                f"{model.name}  {size}, {model.licence}, trained on {model.trained_on}",
                f"  good for  {model.good_for}",
                f"  source    {model.source}",
                f"  file      {where}",
            )
            if self.values["verbose"]:
                show(f"  sha256    {model.sha256}", *(f"  url       {url}" for url in model.urls))


def _file_of(model: Model) -> str | None:
    """Return the file of the weights, if they were fetched."""
    return str(model.path) if model.path.is_file() else None
