"""``mcaptrack tune``: find the parameters of a stage that score best, and write them to mcaptrack.toml."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.api.common import warn_unused
from mcaptrack.api.declared import Option
from mcaptrack.api.options import FILES, PathLike
from mcaptrack.cli import common
from mcaptrack.cli.chosen import has_flag, options_of
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once
from mcaptrack.cli.settings import BOM, NAME, read_toml
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes
from mcaptrack.location import sibling
from mcaptrack.transforms import STAGES

if TYPE_CHECKING:
    from mcaptrack import TuneResult

_BARE_NEWLINE: Final = re.compile(r"(?<!\r)\n")
_SHOWN: Final = ("IDF1", "MOTA", "HOTA", "IDSW", "FP", "FN")


class Tune(Once["TuneResult"]):
    """Search parameters, and write the best ones to a file of settings."""

    class More:
        """Options that the function has no use for."""

        output: Annotated[PathLike, Option(FILES, short="o", shown=True, help="Write the settings to this file.")] = (
            Path(NAME)
        )

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        super().__init__(name, values)
        self._has_tracker = STAGES[values["stage"]].kind == "tracker"

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: patterns become files, texts become ranges."""
        given, output = self.values, self.values["output"]
        read_toml(output)  # a file that can't be edited is refused before the search
        tracker = given["tracker"] if self._has_tracker else None
        tuned = (tracker or "sort").replace(":", ".") if self._has_tracker else given["stage"]
        return super().arguments(names) | {
            "inputs": expand(given["inputs"]),
            "truth": expand(given["truth"]) if given["truth"] else None,
            "tracker": tracker,
            "search": dict(map(_range, given["search"] or ())),
            "study": given["study"] or sibling(output, f".{tuned}.trials.jsonl"),
        }

    def data(self, done: TuneResult) -> dict[str, Any]:
        """Return the settings and their scores as values of JSON."""
        names = ("stage", "metric", "settings", "trials", "best", "scores", "default_scores")
        return {"results": [{name: getattr(done, name) for name in names}]}

    def print_result(self, done: TuneResult, talk: common.Talk) -> None:
        """Write the settings to the file, and print them with their scores."""
        given, output, metric = self.values, self.values["output"], done.metric
        if given["truth"]:
            warn_unused("files of detections are of no camera", topic=True, camera=True)
        else:
            warn_unused("it is about label files; logs have theirs inside", fps=True)
        if not self._has_tracker:
            warn_unused(f"{given['stage']} has no trackers", tracker=True)
        by_overlap = done.similarity == "iou"
        compared = "overlap" if by_overlap else "distance"
        warn_unused(f"{compared} is compared", gate_m=by_overlap, min_iou=not by_overlap)
        score, before = done.scores[metric], done.default_scores[metric]
        if done.best == 0:
            talk.say(f"nothing that was tried beats the defaults ({metric} {before:.4f}); {output} stays")
        else:
            write_settings(output, done.stage, _as_options(done))
            talk.say(f"{output}: {metric} {before:.4f} with the defaults, {score:.4f} now")
        super().print_result(done, talk)

    def show(self, done: TuneResult, talk: common.Talk) -> None:
        """Print the scores as a table, and the settings."""
        from rich.table import Table

        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("")
        for name in _SHOWN:
            table.add_column(name, justify="right")
        for name_of_scores, scores in (("defaults", done.default_scores), ("best", done.scores)):
            values = [scores[name] for name in _SHOWN]
            table.add_row(name_of_scores, *(f"{100 * v:.1f}" if isinstance(v, float) else str(v) for v in values))
        console().print(table)
        show("", *(f"{name.replace('_', '-')} = {value}" for name, value in done.settings.items()))


def _as_options(done: TuneResult) -> dict[str, Any]:
    """Return the best settings by option; those of parameters without one are texts of ``--set``."""
    kinds = STAGES[done.stage].built_in().values()
    flagless = {name for kind in kinds for name, field in options_of(kind).items() if not has_flag(field)}
    own = {name.replace("_", "-"): value for name, value in done.settings.items() if name not in flagless}
    texts = [f"{name}={value}" for name, value in done.settings.items() if name in flagless]
    return own | ({"set": texts} if texts else {})


def _range(text: str) -> tuple[str, tuple[float, float] | None]:
    """Return a parameter to search and its range, from text such as min-iou=0.1:0.5, or min-iou for None."""
    name, equals, span = text.partition("=")
    name = name.strip().lstrip("-")
    if not equals:
        return name.replace("-", "_"), None
    try:
        low, high = (float(part) for part in span.split(":"))
    except ValueError:
        raise McaptrackError(f"--search needs a range like {name}=0.1:0.5, not {text}") from None
    return name.replace("-", "_"), (low, high)


def write_settings(path: Path, command: str, settings: Mapping[str, Any]) -> None:
    """Write settings of a command, such as ``{"max-age-s": 2.0}``, into a file of options.

    The rest of the file stays as it is, with comments and line endings. Raises McaptrackError for a file that can't be
    read or edited.
    """
    old = read_toml(path)
    text = edited(path, old.text if old else "", command, settings)
    publish_bytes(path, text.encode("utf-8"))


def edited(path: Path, text: str, command: str, settings: Mapping[str, Any]) -> str:
    """Return the edited text of ``path``; see ``write_settings``."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    bom = BOM if text.startswith(BOM) else ""
    text = text.removeprefix(BOM)
    tables = tomllib.loads(text)
    settings_before = tables.get(command, {})
    if not isinstance(settings_before, dict):
        raise McaptrackError(f"{path}: {command} is a command; write its options below [{command}]")
    wanted = dict(settings_before)
    try:
        document: Any = tomlkit.parse(text)
        if command not in document:
            document[command] = tomlkit.table()
        table = document[command]
        for name, value in settings.items():
            spelt = [key for key in wanted if key.replace("_", "-") == name]
            for key in spelt or [name]:
                table[key] = wanted[key] = value
        new: str = tomlkit.dumps(document)
        if "\r\n" in text and not _BARE_NEWLINE.search(text):
            new = _BARE_NEWLINE.sub("\r\n", new)
        same = tomllib.loads(new) == {**tables, command: wanted}
    except (TOMLKitError, ValueError):
        same = False
    if not same:  # refuse rather than lose a part of the file
        raise McaptrackError(f"{path} is written in a way that can't be edited; write to another file with -o")
    return bom + new
