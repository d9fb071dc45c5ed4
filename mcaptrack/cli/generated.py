"""The parts of documentation pages that are written from declarations: options, environment variables, tables.

A page holds ``<!-- generated: NAME -->`` where a part of ``PARTS`` belongs; `mcaptrack docs` and the site put it there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, get_type_hints

MARK = re.compile(r"<!-- generated: (\w+) -->")
_HEAD = "| option | values | default | meaning |\n|---|---|---|---|"
_KINDS = {bool: "yes or no", int: "whole number", float: "number", str: "text"}


def with_parts(page: str, parts: Mapping[str, Callable[[], str]]) -> str:
    """The text of a page with its generated parts. Raises KeyError for a part that there isn't."""
    return MARK.sub(lambda found: parts[found[1]](), page)


def environment() -> str:
    """The environment variables that are not options, as a table in Markdown."""
    from mcaptrack.environment import VARIABLES

    rows = (f"| `{name}` | {meaning} |" for name, meaning in VARIABLES.items())
    return "\n".join(["| variable | meaning |", "|---|---|", *rows])


def stage_options() -> str:
    """All parameters of stages, a table for each implementation with parameters of its own, as Markdown."""
    from mcaptrack.transforms import STAGES

    sections = []
    for command, stage in STAGES.items():
        listed: set[str] = set()
        for name, kind in stage.built_in().items():
            default = kind()
            rows = {
                field.name: _parameter(default, field) for field in fields(kind) if not field.metadata.get("context")
            }
            new_rows = [row for field, row in rows.items() if field not in listed]
            if not new_rows:
                continue
            heading = f"### {command}"
            if listed:
                heading += f", with `--{stage.kind} {name}` alone"
            elif stage.kind:
                names = " ".join(f"`{each}`" for each in stage.built_in())
                values = f"{names}, one of an installed package, or `module:Class`"
                new_rows.insert(0, f"| `--{stage.kind}` | {values} | {name} | The {stage.kind} to use |")
            listed |= rows.keys()
            sections.append("\n".join([heading, "", _HEAD, *new_rows]))
    return "\n\n".join(sections)


def _parameter(transform: Any, field: Any) -> str:
    """The row of a parameter of a transform."""
    from mcaptrack.ranges import limits
    from mcaptrack.transforms.protocol import bare_type, choices

    kind = bare_type(get_type_hints(type(transform))[field.name])
    value = getattr(transform, field.name)
    default = "none" if value is None else str(value).lower() if kind is bool else f"{value}"
    values = (
        " ".join(f"`{name}`" for name in choices(kind))
        or f"{_KINDS[kind]} {limits(field.metadata['least'], field.metadata['most'])}"
    )
    text = field.metadata["help"]
    name = f"--{field.name.replace('_', '-')}" if field.metadata["flag"] else f"--set {field.name}="
    return f"| `{name}` | {values.strip()} | {default} | {text[:1].upper()}{text[1:]} |"


def other_numbers() -> str:
    """The options with numbers of commands that are no stages, as Markdown; those for many logs with `run` alone."""
    from typer.main import get_command

    from mcaptrack.cli import app
    from mcaptrack.cli.many import NAMES
    from mcaptrack.ranges import limits
    from mcaptrack.transforms import STAGES

    sections = []
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        options = {each.name: each for each in command.params if each.param_type_name == "option" and not each.hidden}
        rows = []
        for setting in command.settings.values():
            option = options.get(setting.parameter)
            is_listed = setting.kind in (int, float) and (name == "run" or setting.parameter not in NAMES)
            if option is None or not is_listed:
                continue
            bounds = limits(setting.declared.least, setting.declared.most)
            default = option.show_default if isinstance(option.show_default, str) else option.default
            text = option.help.removesuffix(".").removesuffix(f"{bounds[:1].upper()}{bounds[1:]}").strip()
            text = text.removesuffix(".")
            rows.append(f"| `--{setting.name}` | {_KINDS[setting.kind]} {bounds} | {default} | {text} |")
        if rows and name not in STAGES:
            sections.append("\n".join([f"### {name}", "", _HEAD, *rows]))
    return "\n\n".join(sections)


def tables() -> str:
    """All tables with their columns, as Markdown."""
    from mcaptrack.tables import TABLES

    sections = []
    for table in TABLES.values():
        key = ", ".join(f"`{name}`" for name in dict.fromkeys(("recording", *table.key)))
        order = f" Sorted by {', '.join(f'`{name}`' for name in table.order)}." if table.order else ""
        rows = []
        for field in table.arrow:
            about = {name.decode(): value.decode() for name, value in field.metadata.items()}
            kind = re.sub(r"^(string|dictionary<.*)$", "text", str(field.type))
            kind += ", may be null" if field.nullable else ""
            rows.append(f"| `{field.name}` | {kind} | {about['unit']} | {about['description']} |")
        head = ["| column | type | unit | meaning |", "|---|---|---|---|"]
        sections.append("\n".join([f"### {table.name}", "", table.doc, "", f"Key: {key}.{order}", "", *head, *rows]))
    return "\n\n".join(sections)


def class_limits() -> str:
    """The limits of motion of each class, as a table in Markdown."""
    from mcaptrack.transforms.motion_limits import LIMITS

    rows = (
        f"| {row.name} | {row.speed_m_per_s:g} | {row.max_speed_m_per_s:g} | {row.drift_m_per_s:g} | {row.noise_m:g} "
        f"| {row.gate_m:g} | {'yes' if row.turns else 'no'} | {', '.join(f'{side:g}' for side in row.size_m)} |"
        for row in LIMITS.values()
    )
    head = (
        "| class | usual speed, m/s | most, m/s | drift, m/s within 1 s | noise, m | gate, m | arcs "
        "| length, width, height, m |"
    )
    return "\n".join([head, "|---" * 8 + "|", *rows])


#: The parts by name.
PARTS: dict[str, Callable[[], str]] = {
    part.__name__: part for part in (environment, stage_options, other_numbers, tables, class_limits)
}
