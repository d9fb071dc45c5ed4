"""``mcaptrack render``: what it prints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mcaptrack.cli import common
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import counted
from mcaptrack.extensions.render.api import default_suffix
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import RenderResult


class Render(EachLog["RenderResult"]):
    """Draw the annotated video."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments; in a folder the name of the output says what is written."""
        arguments = super().arguments(names)
        return arguments | {"gif": arguments["gif"] and self.folder(arguments["output"]) is None}

    def suffix(self) -> str:
        """Return the end of the names of outputs."""
        return default_suffix(**{name: self.values[name] for name in ("compare", "heatmap", "blur", "gif")})

    def show(self, log: Location, done: RenderResult, talk: common.Talk) -> None:
        """Print what was drawn."""
        talk.say(f"{done.video}: {self.line(done)}")

    def line(self, done: RenderResult) -> str:
        """Return what was drawn in a line."""
        if self.values["heatmap"]:
            return f"where people of {', '.join(done.views)} spend their time"
        drawn = f" with {', '.join(done.views)}" if done.views else ""
        hidden = f", people hidden in {', '.join(done.blurred)}" if done.blurred else ""
        return f"{counted(done.pictures, 'picture')}{drawn}{hidden}"

    def data(self, done: RenderResult) -> dict[str, Any]:
        """Return the result as values of JSON."""
        written = {"log": str(done.log), "output": str(done.video), "pictures": done.pictures}
        return written | {"views": list(done.views), "blurred": list(done.blurred)}
