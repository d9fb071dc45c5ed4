"""The generated parts of the site: commands, library, parts of the pipeline, answers to queries.

MkDocs calls ``on_config``, then ``on_page_markdown`` for each page (``hooks`` in mkdocs.yml). A page has the text
``<!-- generated: NAME -->`` where a part belongs: one of ``GENERATED``, or of those that `mcaptrack docs` prints, too
(``mcaptrack.cli.docs.PARTS``). Below each query of docs/extensions/sql.md stands what the tables of
`mcaptrack demo` answer:
those in the folder that the environment variable DEMO names, or those of one that is made for it (a minute).
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import chdir
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import griffe

ROOT = Path(__file__).resolve().parent.parent
_KINDS = {bool: "", int: "whole number", float: "number", Path: "path"}


class Completed(griffe.Extension):
    """Declared functions with what Python has when it runs: options of extensions, and docstrings that describe all."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Replace the docstring of a function that is a command, and its ``**more`` by the options that are there."""
        if not any(str(decorator.value).startswith("declared(") for decorator in func.decorators):
            return
        command = getattr(import_module(func.module.path), func.name)
        parameters = inspect.signature(command).parameters
        for name in [parameter.name for parameter in func.parameters if parameter.name not in parameters]:
            del func.parameters[name]
        for name, parameter in parameters.items():
            if name not in func.parameters:
                kind = inspect.formatannotation(get_args(parameter.annotation)[0])
                keyword = griffe.ParameterKind.keyword_only
                func.parameters.add(
                    griffe.Parameter(name, annotation=kind, kind=keyword, default=repr(parameter.default))
                )
        doc = inspect.getdoc(command) or ""
        func.docstring = griffe.Docstring(doc, parent=func, parser=griffe.Parser.numpy)


def on_config(config: Any) -> Any:
    """The settings, with the pages of the extensions that are there in the list of pages."""
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in sorted((ROOT / "docs").glob("extensions/*.md"))]
    named = {"Extensions": sorted(pages, key=lambda page: (page != "extensions/extensions.md", page))}
    config.nav = [named if entry == {"Extensions": "EXTENSIONS"} else entry for entry in config.nav]
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The page, without the marks of its blocks, with what is generated."""
    sys.path[:0] = [path for path in (str(ROOT),) if path not in sys.path]
    from mcaptrack.cli.docs import PARTS, with_parts
    from tools.pages import with_links_that_lead

    text = re.sub(r"^ *<!-- (?:not run|file|exit): .+? -->\n", "", with_links_that_lead(markdown), flags=re.M)
    text = with_parts(text, PARTS | GENERATED)
    return with_answers(text) if page.file.src_uri == "extensions/sql.md" else text


@cache
def with_answers(text: str) -> str:
    """The page of queries, with the answer that DuckDB alone gives below each of those about one log."""
    import duckdb

    import mcaptrack

    with TemporaryDirectory() as folder, duckdb.connect() as connection:
        if "DEMO" not in os.environ:
            mcaptrack.demo(output=folder, force=True)

        def answered(block: re.Match[str]) -> str:
            if block[1].startswith("create view"):
                connection.execute(block[1])
            elif "before join" not in block[1]:  # that one is about two logs
                relation = connection.sql(block[1])
                head = f"| {' | '.join(relation.columns)} |\n{'|---' * len(relation.columns)}|\n"
                rows = [f"| {' | '.join(map(_value, row))} |\n" for row in relation.fetchall()]
                return f"{block[0]}\n{head}{''.join(rows)}"
            return block[0]

        with chdir(os.environ.get("DEMO", folder)):
            return re.sub(r"^```sql\n(.*?)```\n", answered, text, flags=re.S | re.M)


def _value(value: object) -> str:
    return "null" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


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


def library() -> str:
    """What the package exports: functions, then classes."""
    import mcaptrack

    return _references(mcaptrack, sorted(mcaptrack.__all__, key=lambda name: (name[0].isupper(), name)), level=2)


def transforms() -> str:
    """What a transform is, then the transforms with their parameters."""
    from mcaptrack import transforms
    from mcaptrack.transforms import protocol

    parts = [_references(protocol, ["Transform", "option", "context"])]
    plain = "    options: { heading_level: 3, members: false, show_bases: false, show_signature: false }"
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


def _references(module: Any, names: Iterable[str], known: Collection[str] = (), level: int = 3) -> str:
    """Directives of mkdocstrings for classes and functions of a module, where they are defined."""
    found = [getattr(module, name) for name in names if name not in known]
    places = [f"{one.__module__}.{one.__qualname__}" for one in found if isinstance(one, type) or callable(one)]
    options = f"\n    options: {{ heading_level: {level} }}"
    return "\n\n".join(f"::: {place}{options}" for place in dict.fromkeys(places) if place.startswith("mcaptrack."))


def registry() -> str:
    """How parts are found by their names."""
    from mcaptrack import registry

    return _references(registry, ["find", "names", "entry_of", "Entry"])


def contracts() -> str:
    """What label formats, readers of messages and exporters of a user's own have to be, and give."""
    from mcaptrack import contracts

    return _references(contracts, ["LabelFormat", "LabelBoxes", "MessageReader", "Box", "Box3d", "Exporter"])


def fleet() -> str:
    """Functions over many logs."""
    from mcaptrack import fleet

    return _references(fleet, ["run", "FleetResult", "LogOutcome"])


def testing() -> str:
    """The checks of parts of a user's own."""
    from mcaptrack import testing

    return _references(testing, testing.__all__)


def _cell(text: str) -> str:
    """Text in a cell of a table."""
    return re.sub(r"\s+", " ", text).replace("|", "&#124;").replace("<", "&lt;").strip()


GENERATED: dict[str, Callable[[], str]] = {
    made.__name__: made
    for made in (commands, library, fleet, transforms, predictors, metrics, contracts, registry, testing)
}
