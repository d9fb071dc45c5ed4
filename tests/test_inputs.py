"""URLs, pipes and devices are refused by every argument and option that takes a path."""

from __future__ import annotations

import inspect
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from mcaptrack.cli.common import refuse_url
from mcaptrack.errors import McaptrackError
from tests.commands import GROUP, call
from tests.extension_cases import of_extensions

COMMANDS = GROUP.commands


def takes_paths(command: str) -> list[Any]:
    """Return the parameters of a command that have type Path, except config, which is read earlier."""
    parameters = inspect.signature(COMMANDS[command].callback).parameters
    paths = {name for name, one in parameters.items() if "Path" in str(one.annotation)} - {"config"}
    return [p for p in COMMANDS[command].params if p.name in paths or (p.name == "words" and "LOG" in p.metavar)]


PATHS = [(name, parameter) for name in COMMANDS for parameter in takes_paths(name)]


def words_with(name: str, parameter: Any, value: str) -> list[str]:
    """Return a command line with a value for one parameter, and with all required arguments."""
    words = [name]
    for other in COMMANDS[name].params:
        if other.param_type_name == "argument":
            words.append(value if other.name == parameter.name else "a.txt")
            words += of_extensions("ANSWERS").get(name, ())
    return [*words, parameter.opts[0], value] if parameter.param_type_name == "option" else words


def said_of(name: str, parameter: Any, url: str) -> str:
    """Return the one line that a command says of a URL, which changes nothing."""
    Path("a.txt").write_text("1,1,1,1,2,2\n")
    code, _, err = call(*words_with(name, parameter, url))
    assert code == 1
    (said,) = [line for line in err.splitlines() if line]
    assert os.listdir() == ["a.txt"]
    return said.removeprefix("mcaptrack: ")


def test_a_url_is_refused_as_a_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = "is a URL; only files, and logs at s3://, gs:// and az://, are read: copy it here first"
    for name, parameter in PATHS:
        said = said_of(name, parameter, "https://me:secret@example.org/a/b?c=d")
        assert said == f"https://example.org/a/b?... {words}", (name, parameter.name)


#: Arguments that are logs, which may be in a store, beside those that are called so.
LOGS = {*((name, "words") for name in COMMANDS), ("evaluate", "inputs")}


def test_only_logs_are_read_from_a_store(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "obstore", None)  # where an extension reads stores by it
    for name, parameter in PATHS:
        said = said_of(name, parameter, "s3://bucket/a/b.mcap")
        is_log = (name, parameter.name) in LOGS or parameter.name == "logs"
        where = "Amazon S3, " if is_log and name != "drop" else "a store, "
        assert said.startswith(f"s3://bucket/a/b.mcap is in {where}"), (name, parameter.name)


def test_paths_of_all_commands_have_a_test():
    assert {name for name, _ in PATHS} == set(COMMANDS) - {
        "docs",
        "doctor",
        "models",
    }  # two take none, and one URLs, too


def test_a_path_that_looks_like_a_url_is_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("s3:").mkdir()
    Path("s3:/a").write_text("x")
    for name in (Path("s3:/a"), "a.mcap", "C:/a", "12:30.mp4", "a b://c", "://x", "/s3:/x"):
        refuse_url(name)
    with pytest.raises(McaptrackError, match="s3://b is in a store"):
        refuse_url(Path("s3:/b"))


@pytest.mark.usefixtures("never_waits")
def test_a_pipe_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("a.txt").write_text("1,1,1,1,2,2\n")
    for name, parameter in PATHS:
        code, _, err = call(*words_with(name, parameter, "pipe"), *["--truth", "a.txt"] * (name == "evaluate"))
        said = ["mcaptrack: pipe is a pipe, not a file; save its data to a file first"]
        assert (code, err.splitlines()) == (1, said), (name, parameter.name)
