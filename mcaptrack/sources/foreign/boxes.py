"""Boxes of other software in a log: which channels have them, and those in pictures as rows of detections.

A channel is read by the reader of its type that a package brings, as a drawing, or by the fields of its messages.
``choosing`` says what a user wants otherwise: paths of fields, and names of classes.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import log
from mcaptrack.contracts import is_in_space
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.arrays import Floats, Ints, joined
from mcaptrack.geometry.boxes import outside
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.registry import BUILT_IN, Entry, blamed, find, others
from mcaptrack.registry.guard import Guard
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.classes import COCO, PERSON, UNKNOWN, ClassMap, is_person
from mcaptrack.schema.names import plain_name, shared_parts
from mcaptrack.schema.provenance import Provenance, boxes_of, input_of
from mcaptrack.sources.foreign.decoding import decoder_with_errors, integer, number, text
from mcaptrack.sources.foreign.fields import (
    NO_BOXES,
    NO_THINGS,
    PEOPLE,
    THINGS,
    Boxes2d,
    FieldReader,
    FieldShape,
    Message3d,
    Seen3d,
    ThingFields,
    check_boxes,
    head_of,
    identity,
    mapped,
    parse_map,
    recognised,
    shape_of_message,
    shape_of_type,
)
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.foreign.known_types import KNOWN, Known
from mcaptrack.sources.foreign.things import Path, Things, read_channel

_KIND: Final = "message_reader"
#: What is read, in messages.
BOXES_READ: Final = (
    "vision_msgs/Detection2DArray",
    "vision_msgs/Detection3DArray",
    "messages of boxes or positions by their fields",
)
#: Messages of a channel in which boxes are looked for; if these have none, longer ones in so many bytes are tried.
_TRIED: Final = 50
_SEARCHED_BYTES: Final = 50_000_000
_LISTED: Final = 8
_WHOLE_NUMBER: Final = re.compile(r"[0-9]{1,10}")
_NAME: Final = re.compile(r"[^\W\d_]")
#: The maximum number of class names of a channel.
_MAX_NAMES: Final = 1024
_LAST_ID: Final = 2**32 - 1 - _MAX_NAMES
_SHOWN: Final = 12
_PERSON: Final = "person"


# What a user chooses


class BoxesChoice(NamedTuple):
    """A choice of how boxes of other software are read: the channel that is named, paths of its fields as ``map=`` has
    them, and the text of a class map; "" for what isn't chosen.
    """

    topic: str = ""
    fields: str = ""
    class_map: str = ""


_CHOICE: ContextVar[BoxesChoice] = ContextVar("choice of boxes", default=BoxesChoice())  # noqa: B039  # it is immutable


@contextmanager
def choosing(topic: str | None, fields: str | None, class_map: str | None) -> Iterator[None]:
    """Read boxes of other software in this way. Raises McaptrackError for paths and class maps that are none."""
    if fields and not topic:
        raise McaptrackError("`map=` says how the messages of one channel are read; name it with `topic=`")
    if fields:
        parse_map(fields)
    chosen = BoxesChoice(topic or "", fields or "", str(ClassMap.parse(class_map)) if class_map is not None else "")
    token = _CHOICE.set(chosen)
    try:
        yield
    finally:
        _CHOICE.reset(token)


def choice_for(opened: log.Log, topic: str) -> BoxesChoice:
    """The way a channel is to be read: as is chosen now, or else as what was made of it was read."""
    now = _CHOICE.get()
    before = next((facts for facts in _facts_before(opened, topic) if facts), {})
    return BoxesChoice(
        now.topic if now.topic == topic else "",
        (now.fields if now.topic == topic else "") or before.get("map", ""),
        now.class_map or before.get("class_map", ""),
    )


def is_chosen_otherwise(opened: log.Log, topic: str) -> bool:
    """Whether boxes of other software were read in another way than is chosen now."""
    if not any(_CHOICE.get()[1:]) or topic not in opened.channels or reading_of(opened, topic) is None:
        return False
    choice = choice_for(opened, topic)[1:]
    return any((facts.get("map", ""), facts.get("class_map", "")) != choice for facts in _facts_before(opened, topic))


def _facts_before(opened: log.Log, topic: str) -> list[Mapping[str, str]]:
    """The record of how a channel was read, by each channel that was made of it."""
    return _facts_by_source(opened).get(topic, [])


@log.kept
def _facts_by_source(opened: log.Log) -> dict[str, list[Mapping[str, str]]]:
    out: dict[str, list[Mapping[str, str]]] = {}
    for channel in opened.channels.values():
        if source := input_of(channel.metadata):
            out.setdefault(source, []).append(boxes_of(channel.metadata))
    return out


# How a channel is read


class Reading(NamedTuple):
    """The way the messages of a channel are read.

    Attributes
    ----------
    in_space : bool
        Whether boxes are in metres.
    read : callable
        From messages to ``Boxes2d``, or of boxes in space to ``Seen3d``.
    fields : ThingFields or None
        What its fields are; None for drawings, and readers of packages.
    paths : sequence of tuple of str
        The fields that are read, if messages can be read as columns.
    is_certain : bool
        Whether it holds boxes of what moves, or only may.
    class_name : str
        The class of what states none, by the name of the channel; "" if it doesn't say.
    known : Known or None
        What is known of its type.
    """

    in_space: bool
    read: Callable[[Things], Any]
    fields: ThingFields | None = None
    paths: Sequence[Path] = ()
    is_certain: bool = True
    class_name: str = ""
    known: Known | None = None


def reading_of(opened: log.Log, topic: str) -> Reading | None:
    """The way a channel is read; None if its messages hold neither boxes nor positions.

    A warning names a package with its reader that can't be imported. Raises McaptrackError for paths of a user that its
    type doesn't have.
    """
    return _reading(opened, topic, choice_for(opened, topic))


@log.kept
def _reading(opened: log.Log, topic: str, choice: BoxesChoice) -> Reading | None:
    channel = opened.channel(topic)
    is_ours = channel.schema is not None or Provenance.from_metadata(channel.metadata)  # views are drawings, too
    if is_ours or not (channel.schema_name or channel.message_encoding == MessageEncoding.JSON):
        return None
    kind, words = message_type_of(opened, channel.topic), re.findall("[a-z]+", channel.topic.lower())
    person = _PERSON if any(PEOPLE.fullmatch(word) for word in words) else ""
    name = plain_name(kind.name)
    try:
        if not choice.fields and (special := _special(name)):
            if name in BUILT_IN[_KIND]:
                drawn = _samples(opened, channel.topic, _single(special.read), is_enough=_has_boxes)
                return _of_drawings(special, drawn, words, person)
            return special
    except McaptrackError as error:
        warn(f"{error}; messages of {channel.topic} are not read", "other")
        return None
    if NO_THINGS.fullmatch(name) and not choice.fields:
        return None
    try:
        shape = shape_of_type(kind)
        if shape is None:
            read = _samples(opened, channel.topic, is_enough=_has_things)
            shape = shape_of_message(read[-_TRIED:])._replace(count=None)
        reader = fields_reader(name, shape, choice.fields)
    except McaptrackError as error:
        if choice.fields:
            raise McaptrackError(f"{opened.path}: {channel.topic}: {error}") from None
        return None  # a type that can't be decoded
    if reader is None:
        return None
    if reader.fields.in_picture and reader.in_space:  # of both the one that is filled in
        samples = _samples(opened, channel.topic, _single(reader.in_frame), is_enough=_has_boxes)
        centres = [seen.boxes.centre for seen in samples if len(seen.boxes.centre)]
        reader.in_space = not centres or bool(np.concatenate(centres).any())
    known = KNOWN.get(name)
    is_certain = known is not None or reader.fields.is_certain or bool(choice.fields or person)
    return Reading(reader.in_space, reader.read, reader.fields, reader.paths, is_certain, person, known)


def _of_drawings(special: Reading, messages: Sequence[Seen3d], words: Sequence[str], person: str) -> Reading | None:
    """The way drawings are read; None if there is no box among the first ones.

    What is round may be a mark of anything, where nothing names it.
    """
    drawn = [seen.boxes for seen in messages if len(seen.boxes.message)]
    is_certain = any(boxes.has_heading.any() for boxes in drawn) or any(THINGS.fullmatch(word) for word in words)
    is_certain |= any(is_person(name) for boxes in drawn for name in boxes.class_name)
    return special._replace(is_certain=is_certain, class_name=person) if drawn else None


def _single(read: Callable[[Things], Any]) -> Callable[[Any], Any]:
    """A function that reads one decoded message."""
    return lambda message: read(Things([message]))


def _samples(
    opened: log.Log,
    topic: str,
    convert: Callable[[Any], Any] = lambda message: message,
    most: int = _TRIED,
    is_enough: Callable[[Any], bool] = lambda _: True,
) -> list[Any]:
    """The first messages of a channel, converted, without those that can't be read.

    If none of them is enough, as where a scene is empty at first, longer ones of those after them follow, up to one
    that is.
    """
    out, longest, size, has_enough = list[Any](), 0, 0, False
    try:
        decode = decoder_with_errors(message_type_of(opened, topic), convert)
        for number, message in enumerate(opened.timed(topic)):
            length, is_first = len(message.payload), number < most
            size += length
            if not is_first and (has_enough or size > _SEARCHED_BYTES):
                break
            if is_first or length > longest:
                with suppress(McaptrackError):  # reading the channel says why
                    out.append(decode(message.payload))
                    longest, has_enough = max(longest, length), has_enough or is_enough(out[-1])
    except McaptrackError:
        pass  # of a type that can't be decoded at all
    return out


def _has_boxes(seen: Seen3d) -> bool:
    return len(seen.boxes.message) > 0


def _has_things(message: Any) -> bool:
    """Whether a message of JSON has things in its lists, or no list at all."""
    shape = shape_of_message(message)
    inside = [inner for _, inner in shape.fields]
    inside += [below for inner in inside if inner.is_struct for _, below in inner.fields]
    kinds = {inner.kind for inner in inside if inner.count is not None} - {"number", "text"}
    return not kinds or "struct" in kinds


@lru_cache(maxsize=256)
def fields_reader(name: str, shape: FieldShape, chosen: str = "") -> FieldReader | None:
    """The reader of a type by its fields: those that a user chose, those of ``known_types``, and by their names.

    None if there are neither boxes nor positions. Raises McaptrackError for chosen paths that the type doesn't have.
    """
    known = KNOWN.get(name, Known())
    fields = recognised(shape, name)
    if fields is not None and known.fields:
        paths = {key: path for key, path in parse_map(known.fields).items() if shape.at((*fields.things, *path))}
        fields = mapped(shape, name, paths) if paths else fields
    if fields is not None and known.classes and not fields.names:
        fields = replace(fields, names=dict(enumerate(known.classes.split(","))))
    if chosen:
        fields = mapped(shape, name, parse_map(chosen))
    return None if fields is None else FieldReader(fields, None if chosen else known.adjust, known.also)


def is_drawing(type_name: str) -> bool:
    """Whether messages of a type draw things, of which some are boxes."""
    return plain_name(type_name) in BUILT_IN[_KIND]


def _special(name: str) -> Reading | None:
    """The way messages of a type are read if not by their fields: drawings, and types that a package reads.

    Raises McaptrackError if the reader of a package can't be imported. Packages that aren't needed are not imported.
    """
    if name in BUILT_IN[_KIND]:
        drawn: Callable[[Any], Message3d] = find(_KIND, name).cls
        return Reading(True, lambda messages: drawn(messages.single).columns())
    other = "" if name in KNOWN else next((other for other in others(_KIND) if plain_name(other) == name), "")
    return _of_package(find(_KIND, other)) if other else None


@lru_cache(maxsize=64)
def _of_package(entry: Entry) -> Reading:
    reader, guard = entry.made("read"), Guard(str(entry))
    in_space = is_in_space(entry, reader)

    def read(messages: Things) -> Boxes2d | Seen3d:
        with blamed(entry, "failed", guard):
            boxes = list(reader.read(messages.single))
        return checked_boxes_3d(entry, messages.single, boxes) if in_space else checked_boxes(entry, boxes)

    return Reading(in_space, read)


def checked_boxes(entry: Entry, boxes: list[Any]) -> Boxes2d:
    """The boxes in a picture that a reader gave for a message. Raises McaptrackError for what is none."""
    with blamed(entry, "gave what is no Box"):
        rows = [(float(x), float(y), float(w), float(h), number(score)) for x, y, w, h, score, _ in boxes]
        columns = np.array(rows, np.float64).reshape(-1, 5)
        check_boxes(columns[:, :4])
        names = np.array([text(name) for *_, name in boxes], object)
    return Boxes2d(np.zeros(len(boxes), np.int64), columns[:, :4], columns[:, 4], names)


def checked_boxes_3d(entry: Entry, message: Any, boxes: list[Any]) -> Seen3d:
    """The boxes in space that a reader gave, with the header of their message, if it has one."""
    stamp_ns, frame_id = 0, ""
    with suppress(AttributeError, ValueError):
        stamp_ns, frame_id = head_of(message)
    with blamed(entry, "gave what is no Box3d"):
        stated = [
            box._replace(
                stamp_ns=integer(box.stamp_ns) or stamp_ns, frame_id=text(box.frame_id) or frame_id,
                class_name=text(box.class_name), source_id=identity(box.source_id),
            )
            for box in boxes
        ]  # fmt: skip
        seen = Message3d(stamp_ns, stated).columns()
        centre, turn, size = seen.boxes.centre, seen.boxes.orientation, seen.boxes.size
        if not (np.isfinite(centre).all() and np.isfinite(turn).all()) or (size < 0).any():
            raise ValueError("a box can't be so: places and turns are finite, and no size is negative")
    return seen


# Which channels have boxes


def holds_boxes(opened: log.Log, topic: str, in_space: bool | None = None) -> bool:
    """Whether a channel has boxes of other software: in pictures, or in space, or of either kind.

    Positions that may be of anything count where a user names their channel, or has named it before.
    """
    reading = reading_of(opened, topic)
    if reading is None or in_space not in (None, reading.in_space):
        return False
    return reading.is_certain or bool(choice_for(opened, topic).topic or _facts_before(opened, topic))


def uncertain_boxes(opened: log.Log) -> dict[str, str]:
    """The channels that may hold positions of people, or of anything, by topic: the type of their messages."""
    return {
        topic: channel.schema_name
        for topic, channel in sorted(opened.channels.items())
        if channel.messages and (reading := reading_of(opened, topic)) and not reading.is_certain
    }


# Classes


class ClassesRead(NamedTuple):
    """The classes of the boxes of a channel.

    ``ids`` (N,) are numbers: those of classes that are numbers stay, people are 1, and other names have numbers after
    the largest, in alphabetical order, so that they don't depend on the order of messages. ``names`` are the names by
    number, of people only where all have one name other than "person". ``remarks`` say what was assumed, and
    ``source`` where names are from.
    """

    ids: Ints
    names: dict[int, str]
    remarks: list[str]
    source: str


def read_classes(
    texts: Sequence[str], class_map: str = "", has_coco: bool = False, has_zero: bool = False
) -> ClassesRead:
    """The classes of boxes from the texts that messages state (N,), "" where they state none.

    ``class_map`` is the text of a class map. With ``has_coco`` numbers are those of COCO, from 0 on; with ``has_zero``
    0 is a class and not a missing one, so that numbers up to 79 with a 0 among them are those of COCO.
    """
    own = dict.fromkeys(texts)
    own.pop("", None)
    numbers = sorted({int(name) for name in own if _WHOLE_NUMBER.fullmatch(name)})
    source = "numbers" if len(numbers) == len(own) else "names"
    is_coco = not class_map and source == "numbers" and bool(numbers) and numbers[-1] < len(COCO)
    is_coco = is_coco and (has_coco or (has_zero and numbers[0] == 0))
    remarks = []
    if class_map or is_coco:
        names = ClassMap.parse(class_map or "coco")
        source = f"class map {names}" if class_map else "COCO's numbers"
        named = {text: names.name(text) or (f"class {text}" if _WHOLE_NUMBER.fullmatch(text) else text) for text in own}
        if missing := [str(number) for number in numbers if names.name(number) is None]:
            remarks.append(f"are numbers that are not in the class map: {list_names(missing, _LISTED)}")
        if is_coco:
            listed = list_names([f"{number} is {COCO[number]}" for number in numbers], _LISTED)
            remarks.append(f"are numbers: those of COCO are taken ({listed}); `class_map=` names others")
    else:
        named = {text: text for text in own}
    ids, by_id = _numbered(named)
    new = [f"{number} is {name!r}" for number, name in by_id.items() if number != PERSON]
    if new and not is_coco:
        remarks.append(f"are names; in class_id 1 is a person, {', '.join(new[:_SHOWN])}")
    nameless = {ids[text] for text in own} - set(by_id) - {UNKNOWN}
    nameless -= {PERSON} if any(is_person(name) for name in named.values()) else set()
    if nameless or (has_zero and numbers[:1] == [0] and not (class_map or is_coco)):
        listed = list_names([*map(str, numbers)], _LISTED)
        how = "1 counts as people, and others move as objects of unknown class do; `class_map=` names them"
        remarks.append(f"are numbers without names ({listed}): {how}")
    return ClassesRead(np.array([ids.get(text, UNKNOWN) for text in texts], np.int64), by_id, remarks, source)


def _numbered(named: Mapping[str, str]) -> tuple[dict[str, int], dict[int, str]]:
    """The number of each class by what messages call it, and the names by number."""
    ids, people, others_named = dict[str, int](), set[str](), dict[str, None]()
    for own, name in named.items():
        if is_person(name):
            ids[own] = PERSON
            people.add(name)
        elif _WHOLE_NUMBER.fullmatch(name):
            ids[own] = int(name) if int(name) <= _LAST_ID else UNKNOWN
        elif _NAME.search(name) and (name in others_named or len(others_named) < _MAX_NAMES):
            others_named[name] = None
    first = max([PERSON, *ids.values()]) + 1
    numbers = {name: first + order for order, name in enumerate(sorted(others_named))}
    ids |= {own: numbers.get(name, UNKNOWN) for own, name in named.items() if own not in ids}
    of_people = {PERSON: min(people)} if len(people) == 1 and people != {_PERSON} else {}
    return ids, of_people | {number: name for name, number in numbers.items()}


# Boxes in pictures


class NamedFrames(NamedTuple):
    """Frames of a channel, the names of their classes by class id, the frame that their metres are in, or "", and how
    boxes of other software were read.
    """

    frames: Sequence[Frame]
    classes: dict[int, str]
    frame_id: str = ""
    facts: Mapping[str, str] = {}


def named_boxes(opened: log.Log, topic: str, reading: Reading) -> NamedFrames:
    """The boxes in pictures of another detector, one frame for each message, with the names of their classes.

    Boxes with the stamp of a picture are at the log time of this picture, others at their own. Boxes in shares of the
    picture are scaled to its size. What is assumed is said.
    """
    where, choice = f"{opened.path}: {topic}", choice_for(opened, topic)
    log_ns, parts, unread = read_channel(
        opened, topic, lambda messages: (picture_stamps(messages), reading.read(messages)), reading.paths
    )
    unread.warn("it counts as empty")
    stamp_ns = np.zeros(len(log_ns), np.int64)
    for which, (stamps_ns, _) in parts:
        stamp_ns[which] = stamps_ns
    boxes = joined([NO_BOXES, *(seen._replace(message=which[seen.message]) for which, (_, seen) in parts)])
    t_ns, pictures, clock = _times_of_pictures(opened, topic, log_ns.tolist(), stamp_ns.tolist())
    classes = classes_of(opened, topic, reading, [name or reading.class_name for name in boxes.class_name])
    size = _size_stated(choice) or picture_size_near(opened, topic, pictures)
    scale = scale_boxes(where, boxes.sides, size)
    rows = DETECTIONS.rows(
        class_id=classes.ids,
        score=boxes.score,
        **dict(zip(("x_px", "y_px", "w_px", "h_px"), boxes.sides.T, strict=True)),
    )
    ends = np.searchsorted(boxes.message, np.arange(len(log_ns) + 1))
    order = np.argsort(t_ns, kind="stable").tolist()
    frames = [Frame(t_ns[at], index, rows[ends[at] : ends[at + 1]]) for index, at in enumerate(order)]
    return NamedFrames(
        frames, classes.names, "", facts_of(choice, reading, clock=clock, classes=classes.source, scale=scale)
    )


def classes_of(opened: log.Log, topic: str, reading: Reading, texts: Sequence[str]) -> ClassesRead:
    """The classes of the boxes of a channel, from their texts (N,); warnings say what is assumed."""
    has_zero = reading.fields is not None and reading.fields.has_zero
    class_map = choice_for(opened, topic).class_map
    classes = read_classes(texts, class_map, reading.known is not None and reading.known.has_coco, has_zero)
    for remark in classes.remarks:
        warn(f"{opened.path}: classes of {topic} {remark}", "classes")
    if not any(texts) or (reading.fields is not None and "class" not in reading.fields.paths):
        by = "type" if reading.fields is not None and reading.fields.class_name else "channel"
        return classes._replace(source=f"the name of the {by}" if any(texts) else "none")
    return classes


def facts_of(choice: BoxesChoice, reading: Reading, **facts: str) -> dict[str, str]:
    """The record of how a channel was read, with what was chosen."""
    chosen = {"fields": str(reading.fields or ""), "map": choice.fields, "class_map": choice.class_map}
    return {key: value for key, value in (facts | chosen).items() if value}


def scale_boxes(where: str, boxes: Floats, size: tuple[int, int] | None) -> str:
    """Scale boxes (N, 4) that are in shares of a picture to its size, in place; returns their scale.

    Warns of boxes outside of their pictures. Raises McaptrackError for shares of a picture of unknown size.
    """
    ends = boxes[:, :2] + boxes[:, 2:]
    if not len(boxes):
        return ""
    if ends.max() <= 1 + _MARGIN and boxes[:, :2].min() >= -_MARGIN and boxes[:, 2:].any():
        if size is None:
            raise McaptrackError(
                f"{where}: boxes are from 0 to 1, shares of a picture of unknown size: say it with "
                "`map='picture=1280x720'`, or add the pictures"
            )
        boxes *= [*size, *size]
        warn(
            f"{where}: boxes are from 0 to 1: they are taken as shares of pictures of {size[0]} x {size[1]} px", "units"
        )
        return f"shares of {size[0]}x{size[1]}"
    if size is not None:
        count = int(np.logical_or(*outside(boxes, np.array(size, float))).sum())
        if count > len(boxes) * _MARGIN:
            text = f"{count:,} of {len(boxes):,} boxes, or more than half of each, lie outside of the pictures"
            warn(f"{where}: {text} of {size[0]} x {size[1]} px: they may be of pictures of another size", "outside")
    return "pixels"


#: Boxes may reach a little outside of the picture: by this share of it; as many may reach farther.
_MARGIN: Final = 0.1


def _size_stated(choice: BoxesChoice) -> tuple[int, int] | None:
    stated = parse_map(choice.fields).get("picture") if choice.fields else None
    width, height = stated[0].split("x") if stated else ("0", "0")
    return (int(width), int(height)) if stated else None


def picture_size_near(opened: log.Log, topic: str, pictures: str = "") -> tuple[int, int] | None:
    """Width and height of the pictures that boxes are about; of others near their topic, or of a calibration there."""
    from mcaptrack.sources.calibrations import holds_calibrations
    from mcaptrack.sources.pictures import picture_size

    for name in [*([pictures] if pictures else ()), *_pictures_near(opened, topic)]:
        if size := picture_size(opened, name):
            return size
    calibrations = [channel.topic for channel in opened.channels.values() if holds_calibrations(channel)]
    for name in sorted(calibrations, key=lambda other: (-shared_parts(other, topic), other)):
        for size in _samples(opened, name, lambda message: (int(message.width), int(message.height)), 1):
            if all(size):
                return size  # type: ignore[no-any-return]
    return None


def _pictures_near(opened: log.Log, topic: str) -> list[str]:
    from mcaptrack.sources.foreign.picture_messages import holds_pictures

    topics = [channel.topic for channel in opened.channels.values() if holds_pictures(channel) and channel.messages]
    return sorted(topics, key=lambda other: (-shared_parts(other, topic), other))


def picture_stamps(messages: Things) -> Ints:
    """The stamps in ns of the pictures that messages are about (M,): of their ``image_header`` (darknet), or their own;
    0 where there is none.
    """
    paths = (("image_header", "stamp"), ("timestamp",), ("header", "stamp"))
    with suppress(AttributeError, TypeError, ValueError):
        return next(
            (messages.stamps(path) for path in paths if messages.has(path[:1])), np.zeros(len(messages), np.int64)
        )
    return np.zeros(len(messages), np.int64)


def _times_of_pictures(
    opened: log.Log, topic: str, log_ns: Sequence[int], stamps_ns: Sequence[int]
) -> tuple[Sequence[int], str, str]:
    """The log times of the pictures that boxes are about, by their stamps (0 where there is none), the channel of these
    pictures, and the clock.

    Their own log times if no channel has such pictures. A picture that was not recorded is as late as the others.
    """
    from mcaptrack.sources.foreign.picture_messages import stamps

    if all(stamp in (0, at_ns) for stamp, at_ns in zip(stamps_ns, log_ns, strict=True)):
        return log_ns, "", "log times"
    for pictures in _pictures_near(opened, topic):
        try:
            shown_ns = opened.times(pictures)
            is_made = Provenance.from_metadata(opened.channel(pictures).metadata)
            taken_ns = shown_ns if is_made else stamps(opened, pictures)
        except McaptrackError:
            continue  # pictures that can't be read have no stamps
        at = dict(zip(reversed(taken_ns.tolist()), reversed(shown_ns.tolist()), strict=True))
        if 2 * sum(stamp in at for stamp in stamps_ns if stamp) > len(stamps_ns):
            late_ns = int(np.median(shown_ns - taken_ns))
            pairs = zip(stamps_ns, log_ns, strict=True)
            t_ns = [at.get(stamp, max(stamp + late_ns, 0)) if stamp else own for stamp, own in pairs]
            return t_ns, pictures, f"stamps of the pictures of {pictures}"
    late_s = np.median([(own - stamp) / NS_PER_S for stamp, own in zip(stamps_ns, log_ns, strict=True) if stamp])
    said = f"boxes are taken at their log times, {late_s:.3g} s after their stamps, which no picture has"
    warn(f"{opened.path}: {topic}: {said}", "clock")
    return log_ns, "", "log times"
