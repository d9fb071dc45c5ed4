"""Names are bytes: logs whose names are as long as they can be, not UTF-8, or look like URLs or options."""

from __future__ import annotations

import inspect
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import McaptrackError, fleet
from mcaptrack.cli.common import refuse_url
from mcaptrack.location import sibling
from mcaptrack.log import results_path
from mcaptrack.log.journal import journal_of
from tests.commands import GROUP, call
from tests.extension_cases import of_extensions
from tests.tiers import one_in

NAMES = {
    "not UTF-8": os.fsdecode(b"a\xff\xfe.mcap"),
    "a time": "walk-12:00.mcap",
    "as long as can be": "n" * 250 + ".mcap",
    "letters of two bytes": "\u00e9" * 124 + "xx.mcap",
    "a store": "s3:foo.mcap",
    "an address": "http:x.mcap",
    "lines": "a\nb\x1b[2J.mcap",
    "an option": "--json.mcap",
    "no room for a journal": "n" * 243 + ".mcap",
    "a blank": " ",
}


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
@pytest.mark.parametrize("name", one_in(len(NAMES), NAMES.values()), ids=NAMES)
def test_logs_of_all_names_are_used_as_others_are(template, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    shutil.copy(template, name)
    for line in (
        ["info", "--json"],
        ["track", "--force"],
        ["run"],
        ["export", "--force"],
        *of_extensions("NAMED").values(),
        ["recover"],
        ["track", "--sidecar", "--force"],
        ["drop", "/camera/predictions*"],
        ["info", "--json"],
    ):
        words = [*line[:1], *(["draw"] if "draw" in line else []), f"./{name}", *(w for w in line[1:] if w != "draw")]
        outcome = call(*words)
        assert outcome.code == 0, (line, outcome)
        assert all(text.isprintable() for text in (outcome.out + outcome.err).split("\n")), (line, outcome)
        if line[0] == "info":
            assert json.loads(outcome.out)["results"][0]["log"] == name
    assert results_path(Path(name)).is_file()
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.parametrize("command", ["info", "run", "drop", "export", *of_extensions("NEEDS")])
def test_names_that_no_file_can_have_are_refused_in_one_line(command):
    outcome = call(
        command, "n" * 300 + ".mcap", *of_extensions("NEEDS").get(command, ["/a"] if command == "drop" else [])
    )
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1)
    assert "File name too long" in outcome.err


@given(
    st.sets(
        st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=60), min_size=1, max_size=9
    )
)
def test_names_beside_a_log_fit_and_differ(parts):
    names = {part * (250 // len(part.encode())) for part in parts if part.strip(".")}
    paths = [Path(f"{name}.mcap") for name in names]
    for beside in (results_path, journal_of, lambda path: sibling(path, ".page.html")):
        found = [beside(path).name for path in paths]
        assert len(set(found)) == len(paths)
        assert all(len(name.encode()) <= 255 for name in found)
    assert sibling(Path("a/b.c.mcap"), ".tables") == Path("a/b.c.tables")


# An empty name is a variable that is not set: as a path it would be the working folder, and all logs in it.


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


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.mcap").write_bytes(b"what was recorded")
    yield tmp_path
    assert [path.read_bytes() for path in tmp_path.iterdir() if path.name != "own.toml"] == [b"what was recorded"]


@pytest.mark.usefixtures("folder")
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


@pytest.mark.usefixtures("folder")
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


# URLs, pipes and devices are refused by every argument and option that takes a path.


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
