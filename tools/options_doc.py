"""Write the tables of docs/options.md anew, from what options declare.

.venv/bin/python tools/options_doc.py
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from typer.main import get_command

from mcaptrack.cli import app
from mcaptrack.cli.many import NAMES
from mcaptrack.cli.settings import Setting
from mcaptrack.transforms import STAGES, Stage
from mcaptrack.transforms.protocol import bare_type, choices, limits

DOCUMENT = Path(__file__).parent.parent / "docs" / "options.md"
BEGIN, END = "<!-- options: begin, written by tools/options_doc.py -->", "<!-- options: end -->"
_HEAD = "| option | values | default | meaning |\n|---|---|---|---|"
_OTHERS = """## Numbers that other commands take

`mcaptrack COMMAND --help` lists all options of a command; here are those that are numbers.
Those of `run` for [many logs](fleet.md) are options of all commands that take many."""
_KINDS = {bool: "yes or no", int: "whole number", float: "number", str: "text"}


def described() -> str:
    """All options of stages, and the numbers that other commands take, as Markdown."""
    parts = []
    for command, stage in STAGES.items():
        known: set[str] = set()
        for name, kind in stage.built_in().items():
            made = kind()
            rows = [_row(made, field) for field in fields(kind) if not field.metadata.get("context")]
            new = [row for row in rows if row.split("`")[1] not in known]
            known |= {row.split("`")[1] for row in rows}
            if not new:
                continue
            new = new if _stands(parts, command) else [*_choice_row(stage), *new]
            several = f", with `--{stage.kind} {name}` alone" if _stands(parts, command) else ""
            head = f"### {command}{several}"
            parts.append("\n".join([head, "", _HEAD, *new]))
    parts.append(_OTHERS)
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        shown = {one.name: one for one in command.params if one.param_type_name == "option" and not one.hidden}
        numbers = [one for one in command.settings.values() if one.kind in (int, float) and one.parameter in shown]
        if name != "run":  # the options for many logs are the same in all commands
            numbers = [one for one in numbers if one.parameter not in NAMES]
        if numbers and name not in STAGES:
            rows = [_number_row(one, shown[one.parameter]) for one in numbers]
            parts.append("\n".join([f"### {name}", "", _HEAD, *rows]))
    return "\n\n".join(parts)


def _number_row(setting: Setting, option: Any) -> str:
    range_ = limits(setting.declared.least, setting.declared.most)
    default = option.show_default if isinstance(option.show_default, str) else option.default
    words = option.help.removesuffix(".").removesuffix(f"{range_[:1].upper()}{range_[1:]}").strip().removesuffix(".")
    return f"| `--{setting.name}` | {_KINDS[setting.kind]} {range_} | {default} | {words} |"


def _choice_row(stage: Stage) -> list[str]:
    """The option that chooses what does a stage."""
    if not stage.kind:
        return []
    there = stage.built_in()
    known = " ".join(f"`{name}`" for name in there)
    words = f"The {stage.kind} to use"
    known += ", one of an installed package, or `module:Class`"
    return [f"| `--{stage.kind}` | {known} | {next(iter(there))} | {words} |"]


def _stands(parts: list[str], command: str) -> bool:
    """Whether there is a table of this command already."""
    return any(part.startswith(f"### {command}") for part in parts)


def _row(made: Any, field: Any) -> str:
    kind = bare_type(get_type_hints(type(made))[field.name])
    default = getattr(made, field.name)
    shown = "none" if default is None else str(default).lower() if kind is bool else f"{default}"
    values = (
        " ".join(f"`{name}`" for name in choices(kind))
        or f"{_KINDS[kind]} {limits(field.metadata['least'], field.metadata['most'])}"
    )
    words = field.metadata["help"]
    name = f"--{field.name.replace('_', '-')}" if field.metadata["flag"] else f"--set {field.name}="
    return f"| `{name}` | {values.strip()} | {shown} | {words[:1].upper()}{words[1:]} |"


def with_options(text: str) -> str:
    """The document with its tables as they are now."""
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{described()}\n\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    DOCUMENT.write_text(with_options(DOCUMENT.read_text()))
