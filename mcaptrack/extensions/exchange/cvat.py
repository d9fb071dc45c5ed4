"""Annotations of CVAT: "CVAT for video 1.1" (and 1.0), and "CVAT for images 1.1", as XML or in CVAT's zip files.

A track of a video is a list of boxes. Between two of them that are not next to each other the box is interpolated
linearly, as CVAT shows it, in the frames that the task has; after a box that is ``outside`` there is none until the
next one. CVAT gives tracks new numbers whenever it writes them, and none in annotations of images, so an attribute
``track_id`` of a box, if there is one, names the track instead.

XML may be hostile: document types and entities are refused, depth and sizes are limited.

Tracks are written as CVAT takes them for a task with the same pictures, with all boxes. Those that CVAT can interpolate
between others are no keyframes, so that a person who moves a box moves its neighbours, too. Letters: N rows, F frames.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.files import reading
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.sources.box_files import BoxFile, ExportedBoxes
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_ID, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_ROWS, ClassNames, is_count
from mcaptrack.sources.ingest.plain_yaml import XmlReader

_MAX_BYTES: Final = 512 * 2**20
#: Frames in one file, also those that are interpolated.
_MAX_FRAMES: Final = 10_000_000
#: Files of CVAT have a depth of 8.
_MAX_DEPTH: Final = 32
_MAX_TEXT: Final = 65536
_BLOCK: Final = 2**16
#: The element of a track.
_TRACK: Final = "track"
#: The attribute that keeps the id of a track: CVAT gives tracks new numbers.
TRACK_ID: Final = "track_id"
#: The corners of a box: left, top, right, bottom.
_CORNERS: Final = ("xtl", "ytl", "xbr", "ybr")
#: Shapes of CVAT that are no boxes.
_OTHER_SHAPES: Final = ("polygon", "polyline", "points", "point", "cuboid", "ellipse", "mask", "skeleton", "tag")
#: Numbers of a row: frame, left, top, width, height, track, label, whether it is occluded, line.
_COLUMNS: Final = 9
_ID: Final = 5


@dataclass
class _Track:
    """A track while it is read: its number, its label, and the last box (frame, left, top, right, bottom)."""

    number: int
    label: int
    line: int
    last: tuple[float, ...] | None = None
    is_outside: bool = False
    is_occluded: bool = False
    stated: str = ""
    is_renamed: bool = False


# The XML of annotations of CVAT: a file, or one in a zip file, at its top or in a folder.
#
# Nothing is extracted: a member of a zip file is read as a stream, whatever its name is.


_ZIP: Final = b"PK\x03\x04"
#: A zip file without members.
_EMPTY_ZIP: Final = b"PK\x05\x06"
_MEMBER: Final = "annotations.xml"
_WORKBOOK: Final = "xl/workbook.xml"
_SHOWN: Final = 5


@contextmanager
def opened_xml(path: Path) -> Iterator[IO[bytes]]:
    """The XML of a file or of a zip file. Raises McaptrackError if it can't be read, or if there is none or several."""
    with reading(path) as stream:
        is_packed = stream.read(4) in (_ZIP, _EMPTY_ZIP)
        stream.seek(0)
        if not is_packed:
            yield stream
            return
        try:
            with zipfile.ZipFile(stream) as archive, archive.open(_member(path, archive.namelist())) as member:
                yield member
        except (zipfile.BadZipFile, zlib.error, KeyError, NotImplementedError, RuntimeError, EOFError) as error:
            raise McaptrackError(f"{path} is a zip file with an {_MEMBER} that can't be read: {error}") from None


def _member(path: Path, names: list[str]) -> str:
    """The name of the only member with annotations. Raises McaptrackError if there is none, or if there are several."""
    members = [name for name in names if name.replace("\\", "/").rsplit("/", 1)[-1] == _MEMBER]
    if len(members) == 1:
        return members[0]
    if members:
        raise McaptrackError(f"{path} holds {len(members)} of {_MEMBER}; give each as a file ({_listed(members)})")
    if _WORKBOOK in names:
        raise McaptrackError(
            f"{path} is a workbook of Excel; save its sheet as CSV or Parquet, which are read as labels"
        )
    content = f"it holds {_listed(names)}" if names else "it is empty"
    raise McaptrackError(f"{path} is a zip file without the {_MEMBER} of CVAT: {content}; unpack other formats")


#: What else XML begins with: what it is, and how it becomes something that is read.
_OTHER_XML: Final = {
    "fcd-export": ", of SUMO: its tool xml2csv.py makes CSV of it, which is read",
    "sequence": ", of UA-DETRAC: write its boxes as MOTChallenge or CSV (frame,id,left,top,width,height)",
}


def _listed(names: list[str]) -> str:
    return list_names([name[:60] for name in names], _SHOWN)


@dataclass
class _Parser(XmlReader):
    """The content of a file, as far as it was read. ``meta`` are the texts of the description of the task, by name."""

    writer = "CVAT"

    path: Path
    values: array[float] = field(default_factory=lambda: array("d"))
    labels: ClassNames = field(default_factory=ClassNames)
    meta: dict[str, str] = field(default_factory=dict)
    others: Counter[str] = field(default_factory=Counter)
    tracks: list[_Track] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    images: dict[int, tuple[str, str]] = field(default_factory=dict)
    rotated: int = 0
    interpolated: int = 0
    task: str | None = None
    unread: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._track: _Track | None = None
        self._image: int | None = None
        self._text: list[str] | None = None
        self._attribute = ""
        self._steps: tuple[int, int, int] | None = None
        super().__init__(self.path)

    def pieces(self) -> Iterator[bytes]:
        """The XML of the file, in blocks. Raises McaptrackError if there is too much."""
        size = 0
        with opened_xml(self.path) as stream:
            while block := stream.read(_BLOCK):
                size += len(block)
                if size > _MAX_BYTES:
                    self.fail(f"there are more than {_MAX_BYTES} bytes of XML; give it in parts")
                yield block

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.names.append(name)
        if len(self.names) > _MAX_DEPTH:
            self.fail("nested deeper than annotations of CVAT are")
        if len(self.names) == 1 and name != "annotations":
            read = "of XML, <annotations> of CVAT and <annotation> of Pascal VOC or LabelMe are read"
            self.fail(f"XML that begins with <{name[:40]}>{_OTHER_XML.get(name, '')}; {read}")
        if "meta" in self.names[:2]:
            self._text = []
        elif name == _TRACK and len(self.names) == 2:
            self._check_task(attributes)
            line = self.line
            number = len(self.tracks) if "id" not in attributes else self._whole(attributes["id"], "the id of a track")
            self._track = _Track(number, self._label(attributes), line)
        elif name == "image" and len(self.names) == 2:
            self._check_task(attributes)
            id_text = attributes.get("id", str(len(self.images)))  # those of other writers lack it: they are in order
            self._image = self._whole(id_text, "the id of an image")
            if self._image in self.images:
                self.fail(f"image {self._image} is there before; give one file for each task")
            self.images[self._image] = (attributes.get("width", ""), attributes.get("height", ""))
        elif name == "box" and self._track is not None:
            self._add_to_track(self._track, attributes)
        elif name == "box" and self._image is not None:
            self._add(
                self._image, self._corners(attributes), NO_ID, self._label(attributes), _is(attributes, "occluded")
            )
        elif name in _OTHER_SHAPES:
            self.others[name] += 1
        elif name == "attribute":
            self._attribute, self._text = attributes.get("name", ""), []

    def end(self, name: str) -> None:
        text = "".join(self._text or ()).strip()
        if "meta" in self.names[:2] and text and len(self.names) <= 4:
            self.meta.setdefault(name, text)
        elif name == "attribute" and self._attribute == TRACK_ID and self.names[-2:-1] == ["box"]:
            self._take_id(text[:40])
        elif name == _TRACK and self._track is not None:
            self.tracks.append(self._track)
            if len(self.tracks) > MAX_ROWS:
                self.fail(f"more than {MAX_ROWS} tracks; give it in parts")
            self._track = None
        elif name == "image":
            self._image = None
        self._text = None
        self.names.pop()

    def text(self, text: str) -> None:
        if self._text is not None:
            self._text.append(text[:_MAX_TEXT])
            if len(self._text) > _MAX_TEXT:
                self.fail("a text is longer than those of CVAT are")

    def _check_task(self, attributes: dict[str, str]) -> None:
        """Fail at the second task of a file of a whole project: frames of all tasks are counted from 0."""
        task = attributes.get("task_id")
        if task is not None and self.task not in (None, task):
            self.fail(f"tasks {self.task} and {task:.20} of a project; export each task, and give one file for each")
        self.task = self.task or task

    def _take_id(self, text: str) -> None:
        """Take the attribute ``track_id`` of a box."""
        if not text:
            return
        if not is_count(text, 15):
            self.unread[text] += 1
        elif self._track is not None:
            self._track.is_renamed |= self._track.stated not in ("", text)
            self._track.stated = self._track.stated or text
        elif self._image is not None:
            self.values[_ID - _COLUMNS] = int(text)

    def _label(self, attributes: dict[str, str]) -> int:
        try:
            return self.labels.number(attributes.get("label", ""))
        except ValueError as error:
            self.fail(str(error))

    def _whole(self, text: str, what: str) -> int:
        if not is_count(text, 15):
            self.fail(f"{what} is a whole number from 0 on, not {text[:40]!r}")
        return int(text)

    def _corners(self, attributes: dict[str, str]) -> tuple[float, ...]:
        try:
            corners = tuple(float(attributes[name]) for name in _CORNERS)
        except KeyError as error:
            self.fail(f"a box without {error}")
        except ValueError:
            self.fail(f"a box with corners that aren't numbers: {str(attributes)[:80]}")
        self.rotated += attributes.get("rotation", "0.0").strip("0.") != ""
        return corners

    def _add(self, frame: int, corners: tuple[float, ...], track: int, label: int, is_occluded: bool) -> None:
        left, top, right, bottom = corners
        line = self.line
        self.values.extend((frame, left, top, right - left, bottom - top, track, label, is_occluded, line))
        if len(self.values) > MAX_ROWS * _COLUMNS:
            self.fail(f"more than {MAX_ROWS} boxes, interpolated ones among them; give it in parts")

    def _add_to_track(self, track: _Track, attributes: dict[str, str]) -> None:
        """Add a box, and those between it and the one before."""
        frame, corners = self._whole(attributes.get("frame", ""), "the frame of a box"), self._corners(attributes)
        own = len(self.tracks)
        if track.last is not None:
            before, *start = track.last
            if frame <= before:
                self.fail(f"the frame of a box is {frame}, and that of the box before is {before:.0f}")
            if not track.is_outside and frame - before > _MAX_FRAMES:
                self.fail(f"{frame - before - 1:.0f} boxes would be interpolated; at most {_MAX_FRAMES} are")
            for between in self._between(int(before), frame) if not track.is_outside else ():
                share = (between - before) / (frame - before)
                box = tuple(a + share * (b - a) for a, b in zip(start, corners, strict=True))
                self._add(between, box, own, track.label, track.is_occluded)
                self.interpolated += 1
        track.last = (frame, *corners)
        track.is_outside, track.is_occluded = _is(attributes, "outside"), _is(attributes, "occluded")
        if not track.is_outside:
            self._add(frame, corners, own, track.label, track.is_occluded)

    def _between(self, before: int, frame: int) -> range:
        """The frames of the task between two that have a box."""
        if frame == before + 1:
            return range(0)
        self._steps = self._steps or self.span()
        first, _, every = self._steps
        is_of_task = (before - first) % every == 0 == (frame - first) % every
        return range(before + every, frame, every) if is_of_task else range(before + 1, frame)

    def span(self) -> tuple[int, int, int]:
        """The first and the last frame of the task and the step between them, by its description; -1: not known."""
        meta = {name: int(text) for name, text in self.meta.items() if is_count(text, 9)}
        first = meta.get("start_frame", 0)
        key, _, step = self.meta.get("frame_filter", "").partition("=")
        every = int(step) if key.strip() == "step" and is_count(step.strip(), 9) and int(step) else 1
        last = meta.get("stop_frame", first + (meta.get("size", 0) - 1) * every if "size" in meta else -1)
        return first, last, every


def _is(attributes: dict[str, str], name: str) -> bool:
    return attributes.get(name, "").lower() in ("1", "true")


class Cvat(Format):
    """Annotations for video and for images."""

    title = "CVAT"
    row = "XML of CVAT for video or for images, or a zip file with it"

    def recognises(self, file: LabelFile) -> bool:
        """Whether a file is a zip file, or XML of CVAT, of a tool that it is often taken for, or without a root."""
        is_named = file.root in ("annotations", *_OTHER_XML)
        return is_named or file.head.startswith((_ZIP, _EMPTY_ZIP) if file.root else (_ZIP, _EMPTY_ZIP, b"<"))

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        path, parser = file.path, _Parser(file.path)
        if not self.recognises(file):
            raise McaptrackError(f"{path} is neither XML nor a zip file with annotations.xml, as CVAT writes them")
        parser.parse(parser.pieces())
        if parser.tracks and parser.images:
            raise McaptrackError(f"{path} holds both tracks and images; CVAT writes one of them")
        if not parser.values:
            others = _counted(parser.others)
            raise McaptrackError(f"{path} holds no boxes{f', only {others}' if others else ''}")
        return _table(path, parser)


def _table(path: Path, parser: _Parser) -> BoxTable:
    values: Floats = np.frombuffer(parser.values, np.float64).reshape(-1, _COLUMNS)
    facts = LabelFacts(path, first_frame=0, size=_size(*map(parser.meta.get, ("width", "height"))))
    facts.name(parser.labels.names)
    sizes = {frame: size for frame, texts in parser.images.items() if (size := _size(*texts)) is not None}
    facts.measure(sizes, len(parser.images))
    facts.labelled, facts.states_labelled, doubt = _frames(parser, values[:, 0])
    rows = BoxTable(
        facts=facts, at=lambda row: f"{path}:{values[row, 8]:.0f}", frame=values[:, 0], id=values[:, _ID],
        boxes_px=values[:, 1:5], score=np.full(len(values), np.nan), class_id=values[:, 6], observed=values[:, 7] == 0,
    )  # fmt: skip
    if doubt:
        rows.find(f": {doubt}", "clock")
    if parser.tracks:
        own = values[:, _ID].astype(int)
        ids, facts.made_ids, remarks = _ids(path, parser.tracks, np.bincount(own, minlength=len(parser.tracks)))
        rows.id = ids[own].astype(float)
        rows.remarks += remarks
    if parser.unread:
        shown = ", ".join(repr(text) for text in list(parser.unread)[:3])
        unread = f": {parser.unread.total()} boxes have a track_id that is not a whole number ({shown})"
        rows.find(f"{unread}; these are not read")
    if parser.interpolated:
        rows.remark(f": {parser.interpolated} boxes are interpolated between others of their tracks")
    if parser.rotated:
        rows.find(f": {parser.rotated} boxes are rotated, and taken without their rotation")
    if left := _counted(parser.others):
        rows.find(f" also holds {left}; they are left out, because they are no boxes", "left-out")
    return rows


def _size(width: str | None, height: str | None) -> tuple[int, int] | None:
    """Width and height of pictures; None if they aren't stated."""
    width, height = width or "", height or ""
    return (int(width), int(height)) if is_count(width, 6) and is_count(height, 6) and int(width) else None


def _counted(others: Counter[str]) -> str:
    return ", ".join(f"{count} of <{name}>" for name, count in others.most_common())


def _frames(parser: _Parser, frame: Floats) -> tuple[Ints, bool, str]:
    """The frames (F,) that were annotated, whether the file states them, and what is odd: those of the images or the
    task, or up to the last box.
    """
    if parser.images:
        return np.array(sorted(parser.images), np.int64), True, ""
    first, last, every = parser.span()
    if not first <= last < first + _MAX_FRAMES:
        return np.arange(int(frame.min()), int(min(frame.max(), frame.min() + _MAX_FRAMES)) + 1), False, ""
    frames = np.arange(first, last + 1, every)
    others = ~np.isin(frame, frames)
    if not others.any():
        return frames, True, ""
    listed = f"frames {first} to {last}" + (f" in steps of {every}" if every > 1 else "")
    text = (
        f"{int(others.sum())} boxes are in frames that its task doesn't have ({listed}), as in {frame[others][0]:.0f}"
    )
    return (
        np.unique(frame.astype(np.int64)),
        False,
        f"{text}; frames are taken as they are, and only those with boxes count",
    )


def _ids(path: Path, tracks: list[_Track], counts: Any) -> tuple[Ints, Ints | None, list[str]]:
    """The id of each track, those that are new, and remarks: the id that its attribute states, or its number.

    Of several tracks that state one id, as after a track was split, the one with most boxes keeps it. The others, and
    tracks that were drawn by hand beside those that state an id, get new ids.
    """
    stated = [int(t.stated) if t.stated else None for t in tracks]
    renamed = sum(track.is_renamed for track in tracks)
    remarks = [f"{path}: {renamed} tracks change their track_id; the first of each is taken"] if renamed else []
    ids = np.full(len(tracks), -1, np.int64)
    if not any(number is not None for number in stated):
        numbers = np.array([track.number for track in tracks], np.int64)
        if len(np.unique(numbers)) == len(numbers):
            return numbers, None, remarks
        remarks.append(f"{path}: ids of tracks occur twice; its tracks are counted from 0")
        return np.arange(len(tracks)), None, remarks
    taken: set[int] = set()
    split: Counter[int] = Counter()
    for at in np.argsort(-counts, kind="stable").tolist():
        number = stated[at]
        if number is None or number in taken:
            split.update([number] if number is not None else [])
            continue
        taken.add(number)
        ids[at] = number
    new = np.flatnonzero(ids < 0)
    ids[new] = max(taken) + 1 + np.arange(len(new))
    if split:
        shown = list_names([*map(str, sorted(split))], 8)
        remarks.append(f"{path}: several tracks state one track_id ({shown}): {split.total()} of them get new ids")
    drawn = sum(number is None for number in stated)
    if drawn:
        remarks.append(f"{path}: {drawn} tracks state no track_id and get new ids")
    return ids, ids[new] if len(new) else None, remarks


# Tracks of a channel.


#: Corners of boxes that are no keyframes are at most this far from where CVAT interpolates them.
KEYFRAME_PX: Final = 1.0
#: Characters that XML can't hold.
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_COLOURS: Final = ("#fa3253", "#3d3df5", "#33ddff", "#ffcc33", "#b83df5", "#24b353", "#ff6a4d", "#8c78f0")


class CvatFile(BoxFile):
    """The file, track by track; a box without an id is a track of one frame."""

    title, end, holds = "CVAT", ".cvat.xml", frozenset({"observed"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield head, tracks and end."""
        yield _head(boxes).encode("utf-8")
        names = {number: _plain(name) for number, name in boxes.classes.items()}
        order = np.lexsort((boxes.frame, boxes.id)) if boxes.has_ids else np.arange(len(boxes.id))
        key = boxes.id[order] if boxes.has_ids else order
        starts = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
        for number, rows in enumerate(np.split(order, starts[1:])):
            yield _track_of(boxes, number, rows, names).encode("utf-8")
        yield b"</annotations>\n"

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say how many boxes get the label of their track."""
        return (describe_classes(boxes),)


def describe_classes(boxes: ExportedBoxes) -> str:
    """Say how many boxes get the label of their track in place of their own class; "" if none do."""
    if not boxes.has_ids:
        return ""
    pairs, counts = np.unique([boxes.id, boxes.class_id], axis=1, return_counts=True)
    _, first = np.unique(pairs[0], return_index=True)
    others = len(boxes.id) - int(np.maximum.reduceat(counts, first).sum())
    return f"a track has one label in CVAT: {others:,} boxes get that of their track" if others else ""


def _head(boxes: ExportedBoxes) -> str:
    """The beginning, as in CVAT's own files: the labels, and the number and size of pictures."""
    from xml.sax.saxutils import escape  # with the modules of the network that it imports

    width, height = boxes.size or np.ceil((boxes.boxes[:, :2] + boxes.boxes[:, 2:]).max(axis=0)).astype(int).tolist()
    labels = "".join(
        f"""
        <label>
          <name>{escape(_plain(name))}</name>
          <color>{_COLOURS[number % len(_COLOURS)]}</color>
          <type>any</type>
          <attributes>{_ATTRIBUTE if boxes.has_ids else ""}</attributes>
        </label>"""
        for number, name in enumerate(boxes.classes.values())
    )
    return f"""<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta>
    <task>
      <name>{escape(_plain(boxes.topic))}</name>
      <size>{boxes.last_frame + 1}</size>
      <mode>interpolation</mode>
      <overlap>0</overlap>
      <start_frame>0</start_frame>
      <stop_frame>{boxes.last_frame}</stop_frame>
      <frame_filter></frame_filter>
      <labels>{labels}
      </labels>
      <original_size>
        <width>{width}</width>
        <height>{height}</height>
      </original_size>
    </task>
  </meta>
"""


_ATTRIBUTE: Final = f"""
            <attribute>
              <name>{TRACK_ID}</name>
              <mutable>False</mutable>
              <input_type>text</input_type>
              <default_value></default_value>
              <values></values>
            </attribute>
          """


def _track_of(boxes: ExportedBoxes, number: int, rows: Ints, names: dict[int, str]) -> str:
    from xml.sax.saxutils import quoteattr

    frame, box, occluded = boxes.frame[rows], boxes.boxes[rows], ~boxes.observed[rows]
    corners = np.concatenate([box[:, :2], box[:, :2] + box[:, 2:]], axis=1)
    kinds, counts = np.unique(boxes.class_id[rows], return_counts=True)
    label = names[int(kinds[counts.argmax()])]
    place = np.searchsorted(boxes.frames, frame)
    is_gap = np.diff(place) > 1
    key = keyframes(frame, corners, occluded, is_gap)
    own = f'<attribute name="{TRACK_ID}">{int(boxes.id[rows[0]])}</attribute>' if boxes.has_ids else ""
    lines = [f'  <track id="{number}" label={quoteattr(label)} source="auto">\n']
    # A track ends after the last box before a gap, and at its own end unless that is the end of the pictures.
    ends = np.append(is_gap, frame[-1] < boxes.last_frame).tolist()
    following = np.append(boxes.frames, 0)[place + 1].tolist()
    columns = (frame.tolist(), corners.tolist(), occluded.tolist(), key.tolist(), ends, following)
    for at, corner, is_hidden, is_key, is_end, after in zip(*columns, strict=True):
        lines.append(_box(at, corner, is_hidden, is_key, False, own))
        if is_end:
            lines.append(_box(after, corner, is_hidden, True, True, own))
    return "".join((*lines, "  </track>\n"))


def _box(frame: int, corner: list[float], is_occluded: bool, is_key: bool, is_outside: bool, own: str) -> str:
    places = " ".join(f'{name}="{number!r}"' for name, number in zip(_CORNERS, corner, strict=True))
    return (
        f'    <box frame="{frame}" keyframe="{is_key:d}" outside="{is_outside:d}" occluded="{is_occluded:d}" '
        f'{places} z_order="0">{own}</box>\n'
    )


def keyframes(frame: Ints, corners: Floats, occluded: Bools, is_gap: Bools) -> Bools:
    """Mask the boxes (N,) of a track that linear interpolation needs: the others are within ``KEYFRAME_PX`` of it.

    ``frame`` (N,) rises; ``corners`` (N, 4) are in px; ``is_gap`` (N - 1,) is true between boxes that are not to be
    joined. The first and the last box of each run without gaps are keyframes, and so are those where ``occluded`` (N,)
    changes. Between these, the box that is farthest from the line
    is one, and so on (Ramer, 1972; Douglas and Peucker, 1973).
    """
    changes = np.diff(occluded.astype(int)) != 0
    key = np.zeros(len(frame), bool)
    key[0] = key[-1] = True
    key[:-1] |= is_gap
    key[1:] |= is_gap | changes
    fixed = np.flatnonzero(key)
    waiting = list(zip(fixed[:-1].tolist(), fixed[1:].tolist(), strict=True))
    while waiting:
        low, high = waiting.pop()
        if high - low < 2:
            continue
        share = (frame[low + 1 : high] - frame[low])[:, None] / (frame[high] - frame[low])
        line = corners[low] + share * (corners[high] - corners[low])
        off = np.abs(corners[low + 1 : high] - line).max(axis=1)
        worst = int(off.argmax())
        if off[worst] > KEYFRAME_PX:
            middle = low + 1 + worst
            key[middle] = True
            waiting += [(low, middle), (middle, high)]
    return key


def _plain(text: str) -> str:
    """A text without characters that XML can't hold."""
    return _NOT_XML.sub("?", text)
