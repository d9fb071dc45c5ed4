"""The laws that hold for functions of packages: commands, finishers, makers of scenes, sections and so on."""

from __future__ import annotations

import inspect
import json
import keyword
import pickle
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, get_type_hints

import numpy as np

from mcaptrack import _MODULES
from mcaptrack import log as logs
from mcaptrack.api.declared import Argument, PythonOnly, about, arguments_of, hints_of, options_of, words_of
from mcaptrack.api.finishing import FORCE, PartsOfRun
from mcaptrack.api.options import PathLike, no_progress
from mcaptrack.api.running import RunResult, Where, work
from mcaptrack.api.stages import track
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.pipeline.scenes import Scenes
from mcaptrack.pipeline.several import write_scene
from mcaptrack.pipeline.staleness import is_stale
from mcaptrack.registry import Entry, Kind, answer_of
from mcaptrack.schema.provenance import FUSE
from mcaptrack.sources.cameras import cameras, detections_topic, provenance_of, scenes_of
from mcaptrack.testing.transforms import LawError, law, present, same_process, unchanged
from mcaptrack.viewing.formatting import plain, section_of

#: What a command may return, beside nothing and dataclasses.
_PRINTED: Final = (str, int, float, dict, list, tuple, np.ndarray, np.generic)
#: What tracks are called in the report, by their role.
_NAMES: Final = {role: role for role in ("tracks", "samples", "online", "offline", "truth")}
_SCENE: Final = "/world"


def check_command(function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """Check a command against the laws that hold for every one.

    The laws: its function is declared, and says what it does, and what each of its parameters means; its parameters
    have types that a command line can say; it returns nothing, text, a number, or a mapping, sequence or dataclass of
    these; it leaves the process that it runs in as it was.

    Parameters
    ----------
    function : callable
        The function.
    *arguments, **options
        What to call it with.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.api.declared import declared
    >>> from mcaptrack.testing import check_command
    >>> @declared()
    ... def hello(name: str = "you") -> str:
    ...     '''Say hello.
    ...
    ...     Parameters
    ...     ----------
    ...     name : str, default "you"
    ...         Who is greeted.
    ...     '''
    ...     return f"hello {name}"
    >>> check_command(hello)
    """
    name = getattr(function, "__name__", repr(function))
    _check_declaration(function, name)
    with same_process(name):
        result = function(*arguments, **options)
    if not (result is None or isinstance(result, _PRINTED) or hasattr(result, "__dataclass_fields__")):
        raise LawError(f"conforms: {name} returns a {type(result).__name__}, which can't be printed")


def _check_declaration(function: Callable[..., Any], name: str, given: Collection[str] = ()) -> None:
    """Check what a function says of itself: its help, and the types and the meaning of its parameters.

    Those that are ``given`` are no options of its own.
    """
    if not hasattr(function, "most_used"):
        raise LawError(f"declares: {name} is not declared; put @declared() of mcaptrack.api.declared above it")
    try:
        parameters, placed = options_of(function), arguments_of(function)
    except Exception as error:
        raise LawError(f"declares: {name} has types that a command line can't say ({error!r})") from None
    if not words_of(function).text:
        raise LawError(f"declares: {name} has no docstring, which is the help of its command")
    silent = [parameter.name for parameter in parameters if not (parameter.help or parameter.name in given)]
    silent += [parameter for parameter, argument in placed.items() if not argument.text]
    if silent:
        raise LawError(f"declares: {name} doesn't say what {silent[0]} means; its docstring may")
    needed = [
        parameter.name
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty
        and not any(isinstance(part, Argument | PythonOnly) for part in about(hints_of(function)[parameter.name]))
    ]
    if needed:
        raise LawError(f"declares: {name} has no default of {needed[0]}; options may be left out")


def check_finisher(function: Callable[..., Any], log: PathLike, *, name: str = "", **options: Any) -> None:
    """Check a finisher against the laws that hold for every one.

    The laws: its function is declared, and says what each of its options means; what it makes is below its input, in
    its name; it makes something of this log, and nothing when all is up to date, with these options or with none; it
    makes the same again where tracks have changed, if the log has detections to track; its report is ``Finished``; it
    leaves other channels, and the process that it runs in, as they were.

    Parameters
    ----------
    function : callable
        The function of the entry point.
    log : path
        A log of one camera with what it is made of; it is copied.
    name : str, optional
        The name of the entry point; by default that of the function.
    **options
        Its options.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    path = present(log)
    with _part_of_run("finisher", function, name) as parts, TemporaryDirectory() as folder:
        copy = Path(shutil.copy(path, Path(folder, "log.mcap")))
        before = _channels(copy)
        made = _finished(parts, copy, options)
        if not made.channels:
            own = [topic for topic in before if topic.endswith(f"/{name or function.__name__}")]
            has = f"; {own[0]} is there already: give a log without it" if own else ""
            raise LawError(f"conforms: it makes nothing of this log with these options{has}")
        if changed := [topic for topic, channel in _channels(copy).items() if before.get(topic, channel) != channel]:
            raise LawError(f"conforms: it changes {changed[0]}")
        for again in (options, {}):
            if topics := _finished(parts, copy, again).channels:
                raise LawError(f"again: it makes {topics[0]} again, which is up to date, with the options {again}")
        with suppress(McaptrackError):  # without detections
            track(copy, tracker="ocsort", force=True)
        _finished(parts, copy, {})
        with logs.read(copy) as opened:
            if late := [topic for topic in made.channels if is_stale(opened, topic)]:
                raise LawError(
                    f"again: {late[0]} is not made again where tracks have changed, by a run without options"
                )


def _finished(parts: PartsOfRun, path: Path, options: Mapping[str, Any]) -> RunResult:
    with law("declares"), collected() as said:
        finishing = parts.finishers(options, False)
    if said:
        raise LawError(f"declares: {said[0].message}")
    with law("conforms"):
        return work(Where(path, None, None, None, False, False), lambda *_: [], no_progress, finishing=finishing)


def _channels(path: Path) -> dict[str, Any]:
    """The number and the fingerprint of the messages of each channel, by topic."""
    with logs.read(path) as opened:
        return {topic: (channel.messages, opened.fingerprint(topic)) for topic, channel in opened.channels.items()}


def check_scene_maker(function: Callable[..., Any], log: PathLike, **options: Any) -> None:
    """Check a maker of scenes against the laws that hold for every one.

    The laws: its function is declared, and says what each of its options means; it returns a ``SceneMaker``, which
    joins cameras of this log, and gives names of cameras alone; the scene has detections, which say that they are
    fused, and of which cameras; the same cameras give the same scene, which is not made again while it is up to date;
    it leaves the log, and the process that it runs in, as they were.

    Parameters
    ----------
    function : callable
        The function of the entry point.
    log : path
        A log of several cameras that it can join, with their detections.
    **options
        Its options.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    with (
        unchanged(log, "the log") as path,
        _part_of_run("scene", function, "") as parts,
        TemporaryDirectory() as folder,
    ):
        made = []
        for number in range(2):
            output = Path(folder, f"{number}.mcap")
            with law("conforms"), logs.read(path) as opened:
                scenes = Scenes(parts.scene_makers(options))
                every = [each.prefix[1:] for each in cameras(opened) if each.prefix not in scenes_of(opened)]
                names, why = scenes.joinable(opened, every)
                if not names or not {*names} <= {*every}:
                    raise LawError(f"conforms: of the cameras {every} it joins {names}: {scenes.off or why}")
                write_scene(opened, _SCENE, partial(scenes.join, opened, names), no_progress, output)
            made.append(_channels(output))
        with logs.read(output) as opened:
            how = provenance_of(opened, detections_topic(_SCENE))
            if how is None or how.transform != FUSE or how.parameters.get("cameras") != names:
                raise LawError(f"conforms: the detections of the scene are not {FUSE}d of the cameras {names}: {how}")
            if again := scenes.join_again(opened, _SCENE, False, False, print, no_progress):
                raise LawError(f"again: it makes {next(iter(again))} again, which is up to date")
        if made[0] != made[1]:
            raise LawError("pure: the same cameras give another scene when they are joined again")


def check_report_section(function: Callable[..., Any], log: PathLike) -> None:
    """Check a section of the report against the laws that hold for every one.

    The laws: it gives a ``ReportSection`` of texts, with data that can be JSON, or None, but not of all cameras of this
    log; the same log gives the same section, and is not changed; a log without channels gives None; it leaves the
    process that it runs in as it was.

    Parameters
    ----------
    function : callable
        The function of the entry point.
    log : path
        A log with what it is about.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    entry = function_entry("report_section", function)

    def sections(of: Path) -> list[Any]:
        with law("conforms"), logs.read(of) as opened:
            prefixes = [camera.prefix for camera in cameras(opened)] or ["/camera"]
            return [section_of(entry, opened, prefix, _NAMES) for prefix in prefixes]

    with same_process(entry.name), unchanged(log, "the log") as path:
        first = sections(path)
        if not any(first):
            raise LawError("conforms: it says nothing of this log")
        if json.dumps(plain(sections(path))) != json.dumps(plain(first)):
            raise LawError("pure: the same log gives another section when it is read again")
        with without_channels() as empty:
            is_said = any(sections(empty))
        if is_said:
            raise LawError("empties: a log without channels has a section")


def check_doctor_lines(function: Callable[[], Mapping[str, str]]) -> None:
    """Check lines of ``doctor`` against the laws that hold for all.

    The laws: the function gives texts by their headings, as a dictionary, each in one line; it leaves the process that
    it runs in as it was.

    Parameters
    ----------
    function : callable
        The function of the entry point.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.testing import check_doctor_lines
    >>> check_doctor_lines(lambda: {"my camera": "connected"})
    """
    entry = function_entry("doctor_line", function)
    with same_process(entry.name), law("conforms"):
        lines = answer_of(entry, dict, "it", function)
    if not lines:
        raise LawError("conforms: it gives no lines")
    for line in lines.items():
        if not all(isinstance(text, str) and text and text.isprintable() for text in line):
            raise LawError(f"conforms: a heading and its text are not a line of text each: {line!r:.80}")


def check_name(name: str, value: Any) -> None:
    """Check a name in Python, such as a class of results, against the laws that hold for every one.

    The laws: it is a name of Python that ``mcaptrack`` doesn't have; what it names is a class or function with a
    docstring, and annotations that can be read, which other processes find in its module.

    Parameters
    ----------
    name : str
        The name of the entry point.
    value : class or function
        What it names.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from fractions import Fraction
    >>> from mcaptrack.testing import check_name
    >>> check_name("Fraction", Fraction)
    """
    if not name.isidentifier() or name.startswith("_") or keyword.iskeyword(name):
        raise LawError(f"declares: {name!r} is no public name of Python")
    if name in _MODULES or find_spec(f"mcaptrack.{name}"):
        raise LawError(f"declares: mcaptrack has the name {name} already")
    if not callable(value) or not hasattr(value, "__qualname__"):
        raise LawError(f"declares: {name} is no class or function but of type {type(value).__name__}")
    if not value.__doc__:
        raise LawError(f"declares: {name} has no docstring")
    try:
        get_type_hints(value)
        pickle.dumps(value)
    except Exception as error:
        raise LawError(f"declares: {name} can't be read or found by others: {error}") from None


@contextmanager
def without_channels() -> Iterator[Path]:
    """A log without channels."""
    with TemporaryDirectory() as folder:
        with logs.create(empty := Path(folder, "empty.mcap")):
            pass
        yield empty


@contextmanager
def _part_of_run(kind: Kind, function: Callable[..., Any], name: str) -> Iterator[PartsOfRun]:
    """A part of ``run``, of which the declaration is checked; what this block changes in the process is a LawError."""
    entry = function_entry(kind, function, name)
    _check_declaration(function, entry.name, [FORCE])
    with same_process(entry.name):
        parts = PartsOfRun([entry])
        parts.options(())
        if parts.faults:
            raise LawError(f"declares: {parts.faults[0]}")
        yield parts


def function_entry(kind: Kind, function: Callable[..., Any], name: str = "") -> Entry:
    """An entry for a function, by default of its own name."""
    return Entry(name or function.__name__, kind, function, function.__module__, "", "")
