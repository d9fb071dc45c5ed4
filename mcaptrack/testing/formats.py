"""The laws that hold for every label format, reader of messages, exporter and command."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from mcaptrack.api.common import as_path
from mcaptrack.api.declared import Argument, PythonOnly, about, arguments_of, hints_of, options_of, words_of
from mcaptrack.api.exporting import exporter_for, write_by
from mcaptrack.api.options import PathLike
from mcaptrack.api.reading import LogReader
from mcaptrack.api.recording import open as open_log
from mcaptrack.contracts import Exporter, LabelFormat, MessageReader, is_in_space
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.registry import Entry, Kind, in_words
from mcaptrack.sources.foreign.boxes import checked_boxes, checked_boxes_3d
from mcaptrack.sources.ingest.labels.format import LabelFile
from mcaptrack.sources.ingest.labels.of_packages import FormatOfPackage
from mcaptrack.sources.ingest.labels.reading import read_by
from mcaptrack.sources.ingest.labels.table import COLUMNS, Asked
from mcaptrack.testing.transforms import LawError, law, same_process

#: What a label format may raise for a file that isn't of it.
_REFUSALS: Final = (McaptrackError, ValueError)
#: What a command may return, beside nothing and dataclasses.
_PRINTED: Final = (str, int, float, dict, list, tuple, np.ndarray, np.generic)


def check_label_format(label_format: LabelFormat, path: PathLike) -> None:
    """Check a label format against the laws that hold for every one.

    The laws: it declares what the contract asks for; its boxes are labels; the same file gives the same boxes, also
    after another one, and is not changed; it recognises its file if it recognises any, and looks at any other file
    without an error; an empty file, and one that is cut off or damaged, gives boxes that are labels, or raises
    McaptrackError or ValueError; it leaves the process that it runs in as it was.

    Parameters
    ----------
    label_format : LabelFormat
        The format.
    path : path
        A file of the format, or a folder, with boxes.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from pathlib import Path
    >>> from mcaptrack.contracts import LabelBoxes
    >>> from mcaptrack.testing import check_label_format
    >>> class Corners:
    ...     def read(self, path):
    ...         rows = [[float(part) for part in line.split()] for line in path.read_text().splitlines()]
    ...         rows = np.reshape(rows, (-1, 5))
    ...         return LabelBoxes(frame=rows[:, 0], boxes=rows[:, 1:])
    >>> _ = Path("a.corners").write_text("0 10 20 30 60")
    >>> check_label_format(Corners(), "a.corners")
    """
    entry = _entry("label_format", label_format, "read")
    with law("declares"):
        is_in_space(entry, label_format)
    made = FormatOfPackage(entry, label_format)
    file = as_path(path).absolute()
    with same_process(entry.name), TemporaryDirectory() as folder:
        before = _content(file)
        boxes = _labels(made, file, "conforms")
        others = _damaged(file, Path(folder)) if file.is_file() else []
        for what, other in others:
            try:
                label_format.read(other)
            except _REFUSALS:
                continue
            except Exception as error:
                raise LawError(
                    f"damaged: {what} raises {type(error).__name__}: {error}; raise McaptrackError or ValueError"
                ) from None
        if _labels(made, file, "pure") != boxes:
            raise LawError("pure: the same file gives other boxes when it is read again")
        _check_recognition(made, file, [other for _, other in others])
        if _content(file) != before:
            raise LawError("pure: it changes its file")


def _labels(made: FormatOfPackage, path: Path, name: str) -> list[Any]:
    """The boxes of a file as labels, as values that can be compared; ``name`` is that of the law that they keep."""
    with law(name), collected():
        rows = read_by(made, LabelFile(path), Asked(made.entry.name, "detections"))
    columns = [getattr(rows, name) for name in COLUMNS]
    return [None if column is None else np.asarray(column).tobytes() for column in (*columns, rows.labelled)]


def _damaged(path: Path, folder: Path) -> list[tuple[str, Path]]:
    """Files like this one, but damaged, and what each is."""
    data = path.read_bytes()
    noise = bytes(np.random.default_rng(0).integers(0, 256, 4096, np.uint8))
    forms = {"an empty file": b"", "a file of noise": noise, "a file without its end": data[: len(data) * 2 // 3]}
    for place in range(1, 4):
        at = len(data) * place // 4
        forms[f"a file with another byte at {at}"] = data[:at] + b"\xff" + data[at + 1 :]
    out = []
    for number, (what, changed) in enumerate(forms.items()):
        out.append((what, folder / f"{number}{path.suffix}"))
        out[-1][1].write_bytes(changed)
    return out


def _check_recognition(made: FormatOfPackage, path: Path, others: Iterable[Path]) -> None:
    if not made.recognises_any:
        return
    with law("recognises"):
        answers = [made.recognises(LabelFile(file)) for file in (path, *others, path)]
    if not (answers[0] and answers[-1]):
        raise LawError(f"recognises: it doesn't recognise {path}")


def check_message_reader(reader: MessageReader, messages: Sequence[Any]) -> None:
    """Check a reader of messages against the laws that hold for every one.

    The laws: it declares what the contract asks for; its boxes can be detections; the same message gives the same
    boxes, whatever was read before, and is not changed; a message without fields has no boxes; it leaves the process
    that it runs in as it was.

    Parameters
    ----------
    reader : MessageReader
        The reader.
    messages : sequence
        Some messages as they are decoded: with their fields as attributes; or dicts, as those in JSON are.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.contracts import Box
    >>> from mcaptrack.testing import check_message_reader
    >>> class Things:
    ...     def read(self, message):
    ...         return [Box(thing.x, thing.y, thing.w, thing.h) for thing in message.things]
    >>> check_message_reader(Things(), [{"things": [{"x": 1, "y": 2, "w": 3, "h": 4}]}])
    """
    entry = _entry("message_reader", reader, "read")
    with law("declares"):
        in_space = is_in_space(entry, reader)
    decoded = [_decoded(message) if isinstance(message, dict) else message for message in messages]
    if not decoded:
        raise LawError("there are no messages to check the reader with")

    def boxes(message: Any) -> list[Any]:
        try:
            given = list(reader.read(message))
        except Exception as error:
            raise LawError(f"conforms: it raises {type(error).__name__}: {error}") from None
        with law("conforms"):
            return [checked_boxes_3d(entry, message, given).boxes if in_space else checked_boxes(entry, given)]

    with same_process(entry.name):
        kept = deepcopy(decoded)
        first = [repr(boxes(message)) for message in decoded]
        if [repr(boxes(message)) for message in reversed(decoded)] != first[::-1]:
            raise LawError("pure: a message gives other boxes when others were read before it")
        if repr(decoded) != repr(kept):
            raise LawError("pure: it changes its messages")
        try:
            count = len(list(reader.read(SimpleNamespace())))
        except Exception:  # as any message that isn't of its type
            count = 0
        if count:
            raise LawError(f"empties: a message without fields has {count} boxes")


def _decoded(message: dict[str, Any]) -> Any:
    return json.loads(json.dumps(message), object_hook=lambda fields: SimpleNamespace(**fields))


def check_exporter(exporter: Exporter, log: PathLike) -> None:
    r"""Check an exporter against the laws that hold for every one.

    The laws: it declares what the contract asks for, makes the path that it gets and no other, and returns its numbers
    of rows; the same log gives the same bytes, whatever the path is called, and is not changed; a log without channels
    gives a file, or McaptrackError; it leaves the process that it runs in as it was.

    Parameters
    ----------
    exporter : Exporter
        The exporter.
    log : path
        A log with what it writes.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.testing import check_exporter
    >>> class Topics:
    ...     end = ".topics.txt"
    ...     def write(self, recording, path):
    ...         path.write_text("\n".join(recording.topics))
    ...         return {"topics": len(recording.topics)}
    >>> check_exporter(Topics(), "log.mcap")
    """
    entry = _entry("exporter", exporter, "write")
    with law("declares"):
        by = exporter_for(entry, exporter)
    source = as_path(log).absolute()

    def written(path: Path, file: Path) -> tuple[dict[str, int], Any]:
        file.parent.mkdir()
        with LogReader(path) as recording:
            rows = write_by(by, recording, file, {})
        if beside := [other.name for other in file.parent.iterdir() if other != file]:
            raise LawError(f"conforms: it writes {beside[0]}, too; it has to write the path that it gets alone")
        return rows, _content(file)

    with same_process(entry.name), TemporaryDirectory() as folder, collected():
        before = _content(source)
        places = [Path(folder, name, f"{name}{by.end}") for name in ("a", "other", "empty")]
        with law("conforms"):
            first, again = (written(source, place) for place in places[:2])
        if first != again:
            raise LawError("pure: the same log gives other bytes when it is written again, under another name")
        if _content(source) != before:
            raise LawError("pure: it changes the log")
        with open_log(Path(folder, "empty.mcap"), create=True) as empty:
            places[2].parent.mkdir()
            try:
                exporter.write(empty, places[2])
            except McaptrackError:
                pass
            except Exception as error:
                raise LawError(
                    f"empties: a log without channels raises {type(error).__name__}: {error}; raise McaptrackError"
                ) from None


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
    with same_process(name), collected():
        result = function(*arguments, **options)
    if not (result is None or isinstance(result, _PRINTED) or hasattr(result, "__dataclass_fields__")):
        raise LawError(f"conforms: {name} returns a {type(result).__name__}, which can't be printed")


def _check_declaration(function: Callable[..., Any], name: str) -> None:
    """Check what a command says of itself: its help, and the types and the meaning of its parameters."""
    if not hasattr(function, "most_used"):
        raise LawError(f"declares: {name} is not declared; put @declared() of mcaptrack.api.declared above it")
    try:
        parameters, placed = options_of(function), arguments_of(function)
    except Exception as error:
        raise LawError(f"declares: {name} has types that a command line can't say ({error!r})") from None
    if not words_of(function).text:
        raise LawError(f"declares: {name} has no docstring, which is the help of its command")
    silent = [parameter.name for parameter in parameters if not parameter.help]
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


def _entry(kind: Kind, made: Any, method: str) -> Entry:
    if isinstance(made, type):
        raise LawError(f"declares: {made.__name__} is a class; give an object, as in {made.__name__}()")
    cls = type(made)
    if not callable(getattr(made, method, None)):
        raise LawError(f"declares: {cls.__name__} has no method {method}, so it is no {in_words(kind)}")
    return Entry(cls.__name__, kind, cls, cls.__module__, "", "")


def _content(path: Path) -> Any:
    """All bytes of a file or folder."""
    if path.is_dir():
        return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    return path.read_bytes()
