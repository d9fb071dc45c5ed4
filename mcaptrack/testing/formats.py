"""The laws that hold for every label format, reader of messages, recording format and exporter."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack.api.exporting import exporter_for, write_by
from mcaptrack.api.options import PathLike
from mcaptrack.api.reading import LogReader
from mcaptrack.api.reading import open as open_log
from mcaptrack.choices import Role
from mcaptrack.contracts import (
    Exporter,
    LabelFormat,
    MessageReader,
    ReadingNotes,
    RecordingFormat,
    RecordingReader,
    is_in_space,
)
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import Entry, Kind, blamed, in_words, of_type
from mcaptrack.sources.box_files import boxes_topic, read_boxes
from mcaptrack.sources.foreign.boxes import checked_boxes, checked_boxes_3d
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.of_packages import FormatOfPackage
from mcaptrack.sources.ingest.labels.reading import read_by
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.table import COLUMNS, Asked
from mcaptrack.sources.ingest.recording import RecordingOfPackage, compare_counts
from mcaptrack.testing.transforms import LawError, content_of, law, same_process, unchanged

#: What a label format may raise for a file that isn't of it.
_REFUSALS: Final = (McaptrackError, ValueError)
#: What takes the place of a number, a text or a null in a damaged file.
_ODD: Final = (
    b"null",
    b"[]",
    b"{}",
    b"-1",
    b"1e999",
    b"NaN",
    b'""',
    b"true",
    b"9" * 400,
    b"\xff",
    b"\0",
    b'"x"',
    b"1e18",
)
#: How many damaged files are made, the last of them with one of these.
_DAMAGED: Final = 16
_NOISE: Final = bytes(np.random.default_rng(0).integers(0, 256, 4096, np.uint8))
#: What labels may be read as.
_ROLES: Final[tuple[Role | None, ...]] = ("detections", "truth", None)


def check_label_format(label_format: LabelFormat | Format, path: PathLike) -> None:
    """Check a label format against the laws that hold for every one.

    The laws: it declares what the contract asks for; its boxes are labels; the same file gives the same boxes, also
    after another one, and is not changed; it recognises its file if it recognises any, but no noise, and looks at any
    other file without an error; an empty file, and one that is cut off or damaged, gives boxes that are labels, or
    raises McaptrackError or ValueError; it leaves the process that it runs in as it was. ``check_exporter`` compares
    what is written with what such a format reads.

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
    made, name = _made_format(label_format)
    with same_process(name), unchanged(path, "its file") as file, TemporaryDirectory() as folder:
        with law("conforms"):
            boxes = _labels(made, file)
        others = []
        for what, other in _damaged(file, Path(folder)):
            for role in _ROLES:
                with _refusing(what):
                    _labels(made, other, role)
            others.append(other)
        with law("pure"):
            if _labels(made, file) != boxes:
                raise LawError("pure: the same file gives other boxes when it is read again")
        with law("recognises"):
            answers = [made.recognises(LabelFile(each)) for each in (file, *others, file)]
            other = Path(folder, "other.strange")
            other.write_bytes(_NOISE)
            takes_any = made.recognises(LabelFile(other))
        if isinstance(made, FormatOfPackage) and made.recognises_any and not (answers[0] and answers[-1]):
            raise LawError(f"recognises: it doesn't recognise {file}")
        if takes_any:
            raise LawError(f"recognises: it takes a file of noise, {other.name}, for one of its own")


def _made_format(label_format: LabelFormat | Format) -> tuple[Format, str]:
    """A format as labels are read by it, and its name; one of mcaptrack's own is one already."""
    if isinstance(label_format, Format):
        return label_format, label_format.name
    entry = object_entry("label_format", label_format, "read")
    with law("declares"):
        return FormatOfPackage(entry, label_format), entry.name


def _labels(made: Format, path: Path, role: Role | None = "detections") -> list[Any]:
    """The boxes of a file as labels, as values that can be compared."""
    rows = read_by(made, LabelFile(path), Asked(made.name, role))
    columns = [getattr(rows, name) for name in COLUMNS]
    return [None if column is None else np.asarray(column).tobytes() for column in (*columns, rows.labelled)]


@contextmanager
def _refusing(what: str) -> Iterator[None]:
    """A block that may refuse a file: by McaptrackError, or, in the code of a package, by ValueError."""
    try:
        yield
    except Exception as error:
        raised = error.__cause__ or error if isinstance(error, McaptrackError) else error
        if not isinstance(raised, _REFUSALS):
            text = f"{type(raised).__name__}: {raised}; raise McaptrackError or ValueError"
            raise LawError(f"damaged: {what} raises {text}") from None
        if "\n" in str(error):
            raise LawError(f"damaged: {what} is refused in several lines: {error}") from None


def _damaged(path: Path, folder: Path) -> Iterator[tuple[str, Path]]:
    """Files like this one, or folders of which one file is, but damaged, and what each is."""
    dice = np.random.default_rng(0)
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for number in range(_DAMAGED):
        file = files[number % len(files)]
        data = file.read_bytes()
        at = int(dice.integers(len(data) or 1))
        spots = list(re.finditer(rb'-?\d+\.?\d*|"[^"]*"|null', data))
        spot, odd = (spots[at % len(spots)].span() if spots else (at, at + 1)), _ODD[number % len(_ODD)]
        what, changed = {
            0: ("an empty file", b""),
            1: ("a file of noise", _NOISE),
            2: ("a file without its end", data[: len(data) * 2 // 3]),
        }.get(number, (f"a file with {odd[:9]!r} at {spot[0]}", data[: spot[0]] + odd + data[spot[1] :]))
        other = folder / str(number) / path.name
        other.parent.mkdir()
        shutil.copytree(path, other) if path.is_dir() else other.touch()
        (other / file.relative_to(path)).write_bytes(changed)
        yield what, other


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
    entry = object_entry("message_reader", reader, "read")
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


def check_recording_format(recording_format: RecordingFormat, path: PathLike) -> None:
    """Check a recording format against the laws that hold for every one.

    The laws: it recognises its file or folder in words, and looks at any other without an error; it has channels, and
    messages of these that fit into a log, as many as it declares; the same recording gives the same messages, also
    after another one, and from the beginning whenever they are asked for; what is cut off or damaged gives messages,
    fewer with a line in ``lost``, or raises McaptrackError or ValueError; it leaves its file, and the process that it
    runs in, as they were.

    Parameters
    ----------
    recording_format : RecordingFormat
        The format.
    path : path
        A file of the format, or a folder, with messages.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    entry = object_entry("recording", recording_format, "open")
    object_entry("recording", recording_format, "recognises")
    with same_process(entry.name), unchanged(path, "its file") as file, TemporaryDirectory() as folder:
        _check_description(entry, recording_format, file)
        with law("conforms"):
            first = _messages(entry, recording_format, file)
        if not first:
            raise LawError("conforms: it has no messages; give a recording with some")
        for what, other in _damaged(file, Path(folder)):
            with law("recognises"), blamed(entry, f"failed to look at {what}"):
                is_read = bool(recording_format.recognises(other))
            if is_read:
                with _refusing(what):
                    _messages(entry, recording_format, other)
        with law("pure"):
            if _messages(entry, recording_format, file) != first:
                raise LawError("pure: the same recording gives other messages when it is read again")
        _check_description(entry, recording_format, file)


def _check_description(entry: Entry, recording_format: RecordingFormat, path: Path) -> None:
    with law("recognises"), blamed(entry, f"failed to look at {path}"):
        described = recording_format.recognises(path)
    if not described or not isinstance(described, str):
        raise LawError(f"recognises: it says {described!r} of {path}, and not in words what it is")


def _messages(entry: Entry, recording_format: RecordingFormat, path: Path) -> list[Any]:
    """All messages of a recording, each with what tells its channel from others."""
    with blamed(entry, f"can't read {path}"):
        opened = recording_format.open(path)
    recording = RecordingOfPackage(entry, of_type(entry, opened, RecordingReader, "open"), path)
    with closing(recording):
        passes = []
        for _ in range(2):
            notes = ReadingNotes()
            messages = list(recording.messages(notes))
            compare_counts(recording, path, Counter(message.channel for message in messages), notes.lost)
            passes.append([(repr(message.channel), *message[1:]) for message in messages])
    if passes[0] != passes[1]:
        raise LawError("pure: its messages don't begin again when they are asked for again")
    return passes[0]


def check_exporter(
    exporter: Exporter, log: PathLike, label_format: LabelFormat | Format | None = None, topic: str | None = None
) -> None:
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
    label_format : LabelFormat, optional
        A format that reads the file again: it has to give the boxes of the channel ``topic``, with the same frames,
        tracks and, to 1e-6 px, the same boxes.
    topic : str, optional
        A channel of tracks with boxes in pictures.

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
    entry = object_entry("exporter", exporter, "write")
    with law("declares"):
        by = exporter_for(entry, exporter)

    def written(path: Path, file: Path) -> tuple[dict[str, int], Any]:
        file.parent.mkdir()
        with LogReader(path) as recording:
            rows = write_by(by, recording, file, {"topic": topic} if topic else {})
        if beside := [other.name for other in file.parent.iterdir() if other != file]:
            raise LawError(f"conforms: it writes {beside[0]}, too; it has to write the path that it gets alone")
        return rows, content_of(file)

    with same_process(entry.name), unchanged(log, "the log") as source, TemporaryDirectory() as folder:
        places = [Path(folder, name, f"{name}{by.end}") for name in ("a", "other", "empty")]
        with law("conforms"):
            first, again = (written(source, place) for place in places[:2])
        if first != again:
            raise LawError("pure: the same log gives other bytes when it is written again, under another name")
        if label_format is not None:
            _check_read_again(label_format, places[0], source, topic)
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


def _check_read_again(label_format: LabelFormat | Format, file: Path, source: Path, topic: str | None) -> None:
    """Compare the boxes in a file with those of the log that it was written from."""
    made, name = _made_format(label_format)
    with law("again"), logs.read(source) as opened:
        wanted = read_boxes(opened, boxes_topic(opened, topic))
        table = read_by(made, LabelFile(file), Asked(name, "tracks", classes=WantedClasses("all")))
    if len(table.frame) != len(wanted.frame) or table.boxes_px is None:
        raise LawError(f"again: {name} reads {len(table.frame)} boxes of the {len(wanted.frame)} that were written")
    columns = [(table.frame, table.id, table.boxes_px), (wanted.frame, wanted.id, wanted.boxes)]
    orders = [np.lexsort((*boxes.T.round(3), frame)) for frame, _, boxes in columns]
    (frame, track, boxes), wrote = ([c[order] for c in each] for each, order in zip(columns, orders, strict=True))
    pairs = {*zip(track.tolist(), wrote[1].tolist(), strict=True)}
    are_same = {
        "frames": bool((np.diff(frame - wrote[0]) == 0).all()),
        "tracks": len(pairs) == len({own for own, _ in pairs}) == len({own for _, own in pairs}),
        "boxes": np.allclose(boxes, wrote[2], rtol=0, atol=1e-6),
    }
    if others := [what for what, is_same in are_same.items() if not is_same]:
        raise LawError(f"again: {name} reads other {' and '.join(others)} than were written")


def object_entry(kind: Kind, made: Any, method: str) -> Entry:
    """An entry for the object of a class, which has this method. Raises LawError for others."""
    if isinstance(made, type):
        raise LawError(f"declares: {made.__name__} is a class; give an object, as in {made.__name__}()")
    cls = type(made)
    if not callable(getattr(made, method, None)):
        raise LawError(f"declares: {cls.__name__} has no method {method}, so it is no {in_words(kind)}")
    return Entry(cls.__name__, kind, cls, cls.__module__, "", "")
