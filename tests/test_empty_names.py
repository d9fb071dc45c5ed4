"""An empty name is a variable that is not set: as a path it would be the working folder, and all logs in it."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

import mcaptrack
from mcaptrack import McaptrackError, fleet
from tests.commands import GROUP, call

#: Ways to give an empty value to each argument, and to each option that is not a switch.
EMPTY = [
    (command, *words)
    for command, declared in GROUP.commands.items()
    for words in [
        *([""] for parameter in declared.params if parameter.param_type_name == "argument"),
        *([f"--{name}", ""] for name, setting in declared.settings.items() if setting.kind is not bool),
        *([f"--{name}="] for name, setting in declared.settings.items() if setting.kind is Path),
    ]
]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.mcap").write_bytes(b"what was recorded")
    yield tmp_path
    assert [path.read_bytes() for path in tmp_path.iterdir() if path.name != "own.toml"] == [b"what was recorded"]


def test_the_command_line_refuses_every_empty_value():
    assert len(EMPTY) > 200
    for words in EMPTY:
        outcome = call(*words)
        assert (outcome.code, outcome.out, outcome.err.count("\n")) == (2, "", 1), (words, outcome)
        assert "it is empty" in outcome.err, (words, outcome)
    assert call("drop", "", "/camera/truth").code == 2


def test_files_and_lists_in_variables_too(folder):
    (folder / "own.toml").write_text('[run]\noutput = ""\n[evaluate]\ntruth = ["b", ""]\n')
    for outcome in (
        call("run", "b.mcap", "--config", "own.toml"),
        call("evaluate", "b.mcap", "--config", "own.toml"),
        call("evaluate", "b.mcap", environment={"MCAPTRACK_EVALUATE_TRUTH": "b ''"}),
    ):
        assert outcome.code == 2
        assert "it is empty" in outcome.err
    unset = call("run", "b.mcap", environment={"MCAPTRACK_RUN_OUTPUT": ""})
    assert "b.mcap does not exist" in unset.err  # an empty variable is one that is not set


def _functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    for name in mcaptrack.__all__:
        value = getattr(mcaptrack, name)
        yield from [(name, value)] if inspect.isfunction(value) else []
        yield from inspect.getmembers(value, inspect.isfunction) if inspect.isclass(value) else []
    yield from [("fleet.run", fleet.run), ("find_logs", fleet.find_logs)]


def _is_path(kind: Any) -> bool:
    return get_origin(kind) is os.PathLike or (isinstance(kind, type) and issubclass(kind, Path))


def _holds(kind: Any, of: Callable[[Any], bool]) -> bool:
    return of(kind) or any(_holds(member, of) for member in get_args(kind))


def _path_parameters() -> Iterator[tuple[str, Callable[..., Any], str, Any]]:
    for name, function in _functions():
        bare = inspect.unwrap(function)
        hints = {key: hint for key, hint in getattr(bare, "__annotations__", {}).items() if key != "return"}
        if name.startswith("_") or not any("Path" in str(hint) or "Like" in str(hint) for hint in hints.values()):
            continue
        holder = type("Hints", (), {"__annotations__": hints})
        for key, kind in get_type_hints(holder, bare.__globals__).items():
            if _holds(kind, _is_path):
                yield name, function, key, kind


def test_the_library_refuses_every_empty_name():
    tried = set()
    for name, function, parameter, kind in _path_parameters():
        others = {
            key: "nothing.mcap"
            for key, about in inspect.signature(function).parameters.items()
            if about.default is about.empty and about.kind not in (about.VAR_KEYWORD, about.VAR_POSITIONAL)
        }
        is_mapping = _holds(kind, lambda one: get_origin(one) is Mapping) and not _holds(kind, lambda one: one is Any)
        for empty in [{"t": ""}] if is_mapping else ["", *([["a.mcap", ""]] if "Sequence" in str(kind) else [])]:
            with pytest.raises(McaptrackError, match="is an empty name"):
                function(**{**others, parameter: empty})
        tried.add(f"{name}.{parameter}")
    assert {"open.path", "drop.log", "drop.output", "run.output"} <= tried
    with pytest.raises(McaptrackError, match=r"is an empty name|an empty name is no file"):
        fleet.run(mcaptrack.check, (name for name in ["b.mcap", ""]))
