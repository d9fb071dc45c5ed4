"""The generated parts of the site: commands, messages, library, the changelog.

MkDocs calls ``on_page_markdown`` for each page (``hooks`` in mkdocs.yml). A page has the text
``<!-- generated: NAME -->`` where a part belongs: one of ``GENERATED``, or of those that `mcaptrack docs` prints, too
(``mcaptrack.cli.generated.PARTS``).
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterable
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import griffe

ROOT = Path(__file__).resolve().parent.parent
REPOSITORY = "https://github.com/mcaptrack/mcaptrack"
_KINDS = {bool: "", int: "whole number", float: "number", Path: "path"}


class Completed(griffe.Extension):
    """Docstrings of declared functions, with the parameters that annotations describe: what Python has when it runs."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Replace the docstring of a function that is a command."""
        if any(str(decorator.value).startswith("declared(") for decorator in func.decorators):
            doc = inspect.getdoc(getattr(import_module(func.module.path), func.name)) or ""
            func.docstring = griffe.Docstring(doc, parent=func)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page, without the marks of its blocks, with what is generated."""
    sys.path[:0] = [path for path in (str(ROOT),) if path not in sys.path]
    text = re.sub(r"^ *<!-- (?:not run|file|exit): .+? -->\n", "", markdown, flags=re.M)
    from mcaptrack.cli.generated import PARTS, with_parts

    return with_parts(text, PARTS | GENERATED)


def commands() -> str:
    """Every command with its options, as its help has them; those that all commands have stand above."""
    from typer.main import get_command

    from mcaptrack.cli import app
    from mcaptrack.cli.help import LAST_PANELS

    parts: list[str] = []
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        panels: dict[str, list[str]] = {}
        for one in command.params:
            if one.param_type_name == "option" and not one.hidden:
                panels.setdefault(one.rich_help_panel or "Options", []).append(_option(one, command.settings))
        common = panels.pop(LAST_PANELS[-1], [])
        if not parts:
            parts.append(_table(LAST_PANELS[-1], common))
        help_lines = (command.help or "").splitlines()
        examples = [line.removeprefix("Example: ") for line in help_lines if line.startswith("Example: ")]
        words = [line for line in help_lines if not line.startswith("Example: ")]
        parts.append("\n".join([f"## {name}", "", *words, "", "```sh", *examples, "```"]))
        parts += [_table(panel, rows) for panel, rows in panels.items()]
    return "\n\n".join(parts)


def _table(heading: str, rows: list[str]) -> str:
    return "\n".join([f"**{heading}**", "", "| option | values | default | meaning |", "|---|---|---|---|", *rows])


def _option(one: Any, settings: dict[str, Any]) -> str:
    kind = next((setting.kind for setting in settings.values() if setting.parameter == one.name), str)
    chosen = get_args(kind)
    values = " ".join(f"`{value}`" for value in chosen) if chosen else _KINDS.get(kind, "text")
    shown = one.show_default
    is_shown = shown is not False and one.default is not None and not callable(one.default)
    default = shown if isinstance(shown, str) else f"{one.default}" if is_shown else ""
    names = ", ".join(f"`{name}`" for name in (*one.opts, *one.secondary_opts))
    return f"| {names} | {values} | {_cell(default)} | {_cell(one.help or '')} |"


def messages() -> str:
    """Every message of the rows, as schemas/ defines it."""
    parts = []
    for path in sorted((ROOT / "schemas").glob("*.proto")):
        text = path.read_text(encoding="utf-8")
        about = re.match(r"// (.*)\n", text)
        lines = [
            f"## mcaptrack.{path.stem}",
            "",
            about[1] if about else "",
            "",
            "| field | type | meaning |",
            "|---|---|---|",
        ]
        for optional, kind, name, words in re.findall(r"^ +(optional )?(\w+) (\w+) = \d+; *// (.*)$", text, re.M):
            lines.append(f"| `{name}` | {kind}{', may be missing' if optional else ''} | {_cell(words)} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def library() -> str:
    """What the package exports: functions, then classes."""
    import mcaptrack

    return _references(mcaptrack, sorted(mcaptrack.__all__, key=lambda name: (name[0].isupper(), name)))


def transforms() -> str:
    """What a transform is, then the transforms with their parameters."""
    from mcaptrack import transforms
    from mcaptrack.transforms import protocol

    parts = [_references(protocol, ["Transform", "option", "context"])]
    plain = "    options: { members: false, show_bases: false, show_signature: false }"
    for name in transforms.__all__:
        one = getattr(transforms, name)
        if not (isinstance(one, type) and is_dataclass(one) and hasattr(one, "writes")):
            continue
        rows = [
            f"| `{field.name}` | <code>{_cell(str(field.type))}</code> | {_cell(str(field.default))} | "
            f"{_cell(field.metadata['help'])} |"
            for field in fields(one)
            if "help" in field.metadata
        ]
        table = "\n".join(["| parameter | type | default | meaning |", "|---|---|---|---|", *rows])
        parts += [f"::: {one.__module__}.{one.__qualname__}\n{plain}", table if rows else ""]
    return "\n\n".join(parts)


def predictors() -> str:
    """What a predictor is, and what makes one."""
    from mcaptrack import predictors

    return _references(predictors, predictors.__all__)


def metrics() -> str:
    """The metrics, and what they are computed from."""
    from mcaptrack.evaluation import metrics
    from mcaptrack.evaluation.metrics import displacement

    parts = [_references(metrics, metrics.__all__)]
    for module in (metrics, displacement):
        own = [each for each, found in vars(module).items() if getattr(found, "__module__", "") == module.__name__]
        parts.append(_references(module, [each for each in own if not each.startswith("_")], set(metrics.__all__)))
    return "\n\n".join(parts)


def _references(module: Any, names: Iterable[str], known: Collection[str] = ()) -> str:
    """Directives of mkdocstrings for classes and functions of a module, where they are defined."""
    found = [getattr(module, name) for name in names if name not in known]
    places = [f"{one.__module__}.{one.__qualname__}" for one in found if isinstance(one, type) or callable(one)]
    return "\n\n".join(f"::: {place}" for place in dict.fromkeys(places) if place.startswith("mcaptrack."))


def changes() -> str:
    """The changelog, its headings one level down."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n", 1)[1]
    return re.sub(r"\]\((?!https?:)([^)#]+)", rf"]({REPOSITORY}/blob/main/\1", text)


def _cell(text: str) -> str:
    """Text in a cell of a table."""
    return re.sub(r"\s+", " ", text).replace("|", "&#124;").replace("<", "&lt;").strip()


GENERATED: dict[str, Callable[[], str]] = {
    made.__name__: made for made in (commands, messages, library, transforms, predictors, metrics, changes)
}
