"""Add the options of plug-ins (detectors, trackers and so on of other packages) to the command that uses them.

The command line, the environment and files are searched for names of plug-ins before the command line is parsed. Only
plug-ins that are named there are imported; and, if a file or the environment sets an option that no built-in transform
has, all that installed packages declare as entry points.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import typer

from mcaptrack.cli import common
from mcaptrack.cli.command import values_of
from mcaptrack.cli.config import ConfigFile, read_files
from mcaptrack.cli.help import HELP
from mcaptrack.cli.stages import StageCommand
from mcaptrack.cli.text import say, stdout_to_stderr
from mcaptrack.environment import PREFIX
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import listening
from mcaptrack.registry import names, own
from mcaptrack.transforms import STAGES, Stage, Transform


def commands_with_plugins(commands: Mapping[str, Any], arguments: Sequence[str], config: Path | None) -> dict[str, Any]:
    """Return the commands of stages that have options of plug-ins which this call chooses for them.

    A plug-in on the command line that can't be loaded ends the command with exit code 1.
    """
    called = next((word for word in arguments if not word.startswith("-")), "")
    if called not in commands:
        return {}
    files = [] if set(arguments) & set(HELP) else read_files(config)
    functions: dict[str, Any] = {}
    for stage in STAGES.values():
        if not stage.option:
            continue
        try:
            with stdout_to_stderr(), listening(lambda notice: say(notice.message, "warning")):
                plugins = dict(_of_words(stage, arguments)) if called in (stage.name, "run") else {}
                plugins |= _of_settings(stage, files, commands)
            plugins = {name: cls for name, cls in plugins.items() if cls is not stage.default}
            if plugins:
                functions[stage.name] = StageCommand.function_of(stage.name, plugins)
        except McaptrackError as error:
            say(str(error), "error")
            raise typer.Exit(common.REFUSED) from None
    return functions


def _of_words(stage: Stage, arguments: Sequence[str]) -> Iterator[tuple[str, type[Transform]]]:
    assert stage.option
    for name in filter(None, values_of(arguments, f"--{stage.option}")):  # the parser refuses an empty one
        if stage.split(name)[0] in own(stage.option):
            continue
        with nullcontext() if stage.kind else suppress(McaptrackError):  # a predictor: the command reports the error
            yield name, stage.choose(name)


def _of_settings(stage: Stage, files: Sequence[ConfigFile], commands: Mapping[str, Any]) -> dict[str, type[Transform]]:
    """Return the plug-ins that environment and files name for a stage; the stage that uses it reports a missing one.

    A file in the working folder can't name modules.
    """
    kind = stage.option
    assert kind
    plugin_names = [os.environ.get(f"{PREFIX}{command}_{kind}".upper(), "") for command in (stage.name, "run")]
    options: set[str] = set()
    for file in files:
        for command in (stage.name, "run"):
            table = file.tables.get(command)
            name = table.get(kind) if isinstance(table, dict) else None
            if isinstance(name, str) and (file.trusted or ":" not in name):
                plugin_names.append(name)
        table = file.tables.get(stage.name)
        options |= {key.replace("_", "-") for key in table} if isinstance(table, dict) else set()
    start = f"{PREFIX}{stage.name}_".upper()
    options |= {name.removeprefix(start).lower().replace("_", "-") for name in os.environ if name.startswith(start)}
    if options and options - set(commands[stage.name].settings):
        plugin_names += names(kind)
    out = {}
    for name in dict.fromkeys(plugin_names):
        if name and stage.split(name)[0] not in own(kind):
            with suppress(McaptrackError):
                out[name] = stage.choose(name)
    return out
