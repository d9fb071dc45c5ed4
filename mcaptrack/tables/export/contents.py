"""The contents of a log as tables, built on demand, with digests that tell when they change."""

from __future__ import annotations

import hashlib
import json
import os
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import __version__, evaluation, log, tables
from mcaptrack.errors import McaptrackError, offer
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M
from mcaptrack.files import place_of
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.location import Location, shortened
from mcaptrack.log.messages import Payloads
from mcaptrack.schema import DETECTIONS, SCHEMAS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import FrameColumns, collect
from mcaptrack.schema.framing import unique_values
from mcaptrack.schema.provenance import Provenance, input_of
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import Camera, cameras, provenance_of
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.foreign.flatten import column_reader, flattener, message_type_of, payload_decoder
from mcaptrack.tables import TABLES, Pointers, TablePieces, TrackNames
from mcaptrack.tables.fields import SCORES

#: Tables about the places of messages, or about the whole log.
_OF_THE_WHOLE: Final = ("frames", "channels", "warnings", "recordings")


# Names of logs and channels as names of folders: they can't leave the folder, and do not collide.


#: Longer names are cut, with a digest of the whole name; file systems allow 255 bytes.
_MAX_BYTES: Final = 200


#: Words that readers of partitions do not take for text.
_NO_TEXT: Final = ("nan", "inf", "infinity", "true", "false", "null", "none")


def recording_name(path: Location) -> str:
    """The name of a log for a path and a partition: without slashes, equals signs and leading dots.

    Names that readers would take for numbers or dates (0001 would become 1) get "log-" before them.
    """
    name = shortened(re.sub(r"[^\w.\-]+", "_", path.stem).lstrip(".") or "log", _MAX_BYTES)
    is_text = re.search(r"[^\W\d_]", name) and not re.fullmatch(r"[-\d._]*e[-\d]+", name, re.IGNORECASE)
    return name if is_text and name.lower().lstrip("-") not in _NO_TEXT else f"log-{name}"


def recording_key(name: str) -> str:
    """The name of a recording without capitals and composed letters, which some file systems don't tell apart."""
    return unicodedata.normalize("NFC", name).casefold()


def file_name(path: Location) -> str:
    """The name of a file as text; bytes that are not UTF-8 are escaped, because tables hold only text."""
    return os.fsencode(path.name).decode("utf-8", "backslashreplace")


def topic_folder(topic: str) -> str:
    """The folder of a channel's table: /imu/data -> imu.data; other signs as %XX, so that no two channels share one."""
    body = topic.removeprefix("/")
    parts = (
        "".join(c if c.isascii() and (c.isalnum() or c in "_-") else _escaped(c) for c in p) for p in body.split("/")
    )
    name = ".".join(parts)
    name = name or "%2F" * len(topic)
    return shortened(name if topic.startswith("/") and name.strip(".") else "~" + name, _MAX_BYTES)


def _escaped(character: str) -> str:
    return "".join(f"%{byte:02X}" for byte in character.encode("utf-8", "surrogatepass"))


# The columns of ``recordings`` about a log as a whole, so that one table compares thousands of logs.


#: The tracks that stand for a camera, below its name: the first that there are.
_BEST: Final = ("retracks", "retracks/online", "tracks")
#: The rules by which they are scored, the first that gave a score.
RULES: Final = (("metres", GATE_M), ("iou", 0.5))
RULES_3D: Final = (("metres", GATE_3D_M), *RULES)


def location_of(path: Location) -> str:
    """Where a log is, as the ledger of many logs names it: its path without links, or its URL."""
    return os.fsencode(str(place_of(path))).decode("utf-8", "backslashreplace")


def best_tracks(camera: Camera, topics: Iterable[str]) -> str | None:
    """The topic of the tracks that stand for a camera; None if it has none."""
    available = set(topics)
    return next((name for below in _BEST if (name := f"{camera.prefix}/{below}") in available), None)


class LogWarning(NamedTuple):
    """A warning about results in a log: the channel, the name of its camera ("" for none), code and message."""

    topic: str
    camera: str
    code: str
    message: str


def warnings_of(topic: str, camera: str, how: Provenance) -> Iterator[LogWarning]:
    """The warnings that a channel carries, and those that follow from its parameters."""
    yield from (LogWarning(topic, camera, code, message) for code, message in how.warnings)
    if done := how.held_back:
        message = f"tracks were {done}: the ground plane was not measured, and the camera looks along the ground"
        yield LogWarning(topic, camera, "held-back", message)


def in_one_row(warnings: Sequence[LogWarning]) -> dict[str, Any]:
    """The columns of ``recordings`` about warnings."""
    said = dict.fromkeys((warning.code, warning.message) for warning in warnings)
    texts = [{"code": code, "message": message} for code, message in said]
    return {
        "warnings": len(texts),
        "warning_texts": json.dumps(texts, ensure_ascii=False) if texts else None,
    }


def worst_score(topics: Sequence[str], scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The scores of the camera with the lowest IDF1, of the tracks in ``topics``; empty without ground truth."""
    headlines = [row for topic in topics if (row := _headline([score for score in scores if score["topic"] == topic]))]
    if not headlines:
        return {}
    worst = min(headlines, key=lambda row: row["IDF1"])
    return {"scored": worst["topic"]} | {name: worst[name] for name in ("similarity", "gate", *SCORES)}


def _headline(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The row of one channel of tracks by which it is compared; None if it has no score."""
    together = [row for row in rows if row.get("class") is None]
    rules = RULES_3D if any(row.get("AMOTA") is not None for row in together) else RULES
    by_rule = {(row["similarity"], row["gate"]): row for row in together}
    return next((by_rule[rule] for rule in rules if rule in by_rule), None)


class MessagesPart(NamedTuple):
    """The messages and fields of a channel of other software that its table holds.

    ``blobs``: also fields of any number of bytes. ``columns`` are paths of fields, as in ``angular_velocity.z``, or of
    messages in which all fields are wanted; all if there are none. Messages are from ``start_ns`` to before ``end_ns``.
    """

    blobs: bool = False
    columns: tuple[str, ...] = ()
    start_ns: int | None = None
    end_ns: int | None = None

    def wants(self, path: tuple[str, ...]) -> bool:
        """Whether a field is wanted, or a field within it."""
        return not self.columns or any(_agree(path, column) for column in self.columns)

    def unknown(self, paths: Collection[tuple[str, ...]]) -> str:
        """The first column that is no field, and of which no field is a part; "" if there is none."""
        unknown = (
            column
            for column in self.columns
            if not any(_agree(path, column) and len(path) > column.count(".") for path in paths)
        )
        return next(unknown, "")


class Timing(NamedTuple):
    """The times of messages: the number of those before, and theirs; times of the first and the last in ns, the largest
    gap, and the rate by the usual step. None where there are too few.
    """

    first: int
    messages: int
    first_t_ns: int | None
    last_t_ns: int | None
    largest_gap_s: float | None
    rate_hz: float | None


#: All messages, and all fields but bytes.
WHOLE: Final = MessagesPart()


def _agree(path: Sequence[str], column: str) -> bool:
    """Whether a field is the one that is named, within it, or around it; durations may be named as their columns."""
    names = column.split(".")
    return all(name in (field, f"{field}_ns") for field, name in zip(path, names, strict=False))


class LogTables:
    """The tables of a log. Rows are read once and kept as columns, because several tables are made of them."""

    def __init__(self, opened: log.Log, boxes: BoxesRead | None = None) -> None:
        self.opened = opened
        self._boxes_read = boxes or BoxesRead()
        self.recording = recording_name(opened.path)
        self._kept: dict[str, FrameColumns] = {}
        self._class_names: dict[str, dict[int, str]] = {}
        self._timings: dict[tuple[str, int | None, int | None], Timing] = {}
        #: Notes about tables, by name.
        self.notes: dict[str, str] = {}

    def table(self, name: str) -> Any:
        """One of ``TABLES`` as Arrow, without the column ``recording``."""
        pieces = self.pieces(name)
        return pieces.table() if isinstance(pieces, TablePieces) else pieces

    def pieces(self, name: str) -> Any:
        """As ``table``, but a table with many rows comes as ``TablePieces``, which are made while they are read."""
        table = TABLES[name]
        if table.rows_of is not None:
            return self._rows(table.rows_of, self.topics(name))
        makers: Mapping[str, Callable[[], Any]] = {
            "frames": self._places,
            "track_summary": lambda: tables.summary_table(
                {topic: self._frames(topic) for topic in self.topics("tracks")}, self._class_names
            ),
            "metrics": lambda: tables.records_table(table, sorted(self._scores, key=_order_of_scores)),
            "channels": lambda: tables.records_table(
                table, [_channel(channel, self._cameras) for _, channel in sorted(self.opened.channels.items())]
            ),
            "warnings": lambda: tables.records_table(
                table, [warning._asdict() | {"camera": warning.camera or None} for warning in self._warnings]
            ),
            "recordings": lambda: tables.records_table(table, [self._recording()]),
        }
        return makers[name]()

    def _rows(self, schema: Schema, topics: Sequence[str]) -> TablePieces:
        """The rows of channels of a schema, with the names of their classes, tracks and zones."""
        table, channels = tables.table_of(schema), {topic: self._frames(topic) for topic in topics}
        of_tracks = {topic: self._track_names(topic) for topic in channels} if table.is_of_tracks() else {}
        coded = {topic: self._code_names(topic) for topic in channels} if table.code else {}
        return tables.rows_in_pieces(schema, channels, self._class_names, of_tracks, coded)

    def own_topics(self) -> list[str]:
        """The channels with rows of a user's own schemas: none of ``TABLES`` has them."""
        schemas = {channel.topic: channel.schema for channel in self.opened.channels.values()}
        return sorted(topic for topic, schema in schemas.items() if schema and schema.name not in SCHEMAS)

    def other_topics(self) -> list[str]:
        """The channels with messages of other software: no rows, and no views of rows."""
        channels = [channel for channel in self.opened.channels.values() if channel.schema is None]
        hows = {channel.topic: Provenance.from_metadata(channel.metadata) for channel in channels}
        return sorted(topic for topic, how in hows.items() if how is None or how.transform != "view")

    def topics(self, name: str) -> list[str]:
        """The channels from which a table is made, in order."""
        if name in ("channels", "warnings", "recordings"):
            return sorted(self.opened.channels)
        if name == "frames":
            pictures = {c.topic for c in self.opened.channels.values() if foreign.holds_pictures(c)}
            of_rows = (self.topics(table.name) for table in TABLES.values() if table.rows_of is not None)
            return sorted(pictures.union(self.own_topics(), *of_rows))
        if name == "track_summary":
            return self.topics("tracks")
        if name == "metrics":
            return sorted({topic for camera in self._labelled() for topic in self._scored(camera)})
        schema = TABLES[name].rows_of
        if schema is None:
            raise KeyError(name)
        ours = log.topics_with_schema(self.opened, [schema.name])
        found_topics = [channel.topic for channel in ours if channel.holds(schema)]
        if schema is DETECTIONS:
            found_topics += [topic for topic in self.opened.channels if foreign.holds_boxes(self.opened, topic)]
        return sorted(found_topics)

    def source(self, name: str) -> str:
        """A digest of the input of a table, which changes when the table may change. Reads no messages."""
        whole = name in _OF_THE_WHOLE
        of = [self.opened.fingerprint()] if whole else [self.opened.fingerprint(topic) for topic in self.topics(name)]
        files = [file_name(part.path) for part in self.opened.parts]
        where = [location_of(self.opened.path)] if name == "recordings" else []
        return _digest([name, __version__, self.recording, files, of, *where])

    def lineage(self, name: str) -> str:
        """The provenance of the channels of a table, back to recorded channels, as JSON."""
        out: dict[str, Any] = {}
        todo = [] if name in _OF_THE_WHOLE else list(self.topics(name))
        while todo:
            topic = todo.pop()
            channel = self.opened.channels.get(topic)
            how = Provenance.from_metadata(channel.metadata) if channel and topic not in out else None
            if how and how.transform != "view":
                out[topic] = {"transform": how.transform, "input": how.input, "parameters": how.parameters}
                out[topic] |= {"plugins": _plugins(how)} if how.plugins else {}
                todo.append(how.input)
        return json.dumps(out, sort_keys=True, separators=(",", ":"))

    # Foreign channels

    def messages_digest(self, topic: str, part: MessagesPart) -> str:
        """A digest of the input of ``messages`` of a topic."""
        # The table has the places of messages, so it changes when they move.
        where = hashlib.sha256(self.opened.chunk_offsets(topic).tobytes()).hexdigest()
        file = file_name(self.opened.part(topic).path)
        return _digest([topic, __version__, self.recording, file, self.opened.fingerprint(topic), where, *part])

    def messages(self, topic: str, part: MessagesPart = WHOLE) -> Any:
        """The messages of any channel as a flat table; as ``message_pieces``."""
        return self.message_pieces(topic, part)[0].table()

    def message_pieces(self, topic: str, part: MessagesPart = WHOLE) -> tuple[TablePieces, list[str]]:
        """The rows of a channel, or the messages of any other as a flat table; in pieces, and the fields left out.

        Raises McaptrackError, with topic and time, if its messages can't be read; a warning names a few that can't be.
        """
        schema = self.opened.channel(topic).schema
        if schema is not None:
            if part[1:] != WHOLE[1:]:
                raise McaptrackError(
                    f"{self.opened.path}: {topic} has rows; columns and times are chosen of channels of other software"
                )
            return self._rows(schema, [topic]), []
        messages = self.typed_messages(topic, part)
        table = tables.typed_table(messages) if messages else self._inferred(topic, part)
        if messages is None:
            self._refuse_unknown(topic, part, [*table.fields, *table.left_out])
        return table.pieces, [".".join(path) for path in table.left_out]

    def typed_messages(self, topic: str, part: MessagesPart) -> tables.TypedMessages | None:
        """The messages of a channel, if they can be read as columns; otherwise, and for rows, None.

        Raises McaptrackError for columns that it does not have.
        """
        from mcaptrack.columns import Unsupported

        if self.opened.channel(topic).schema is not None:
            return None
        try:
            reader = payload_decoder(self.opened, topic, lambda kind: column_reader(kind, part.wants, part.blobs))
        except Unsupported:
            return None
        messages = tables.TypedMessages(self._source(topic, part), reader)
        self._refuse_unknown(topic, part, [*messages.types, *messages.left_out])
        return messages

    def _inferred(self, topic: str, part: MessagesPart) -> tables.MessagesTable:
        return tables.inferred_table(self._source(topic, part), part.wants, part.blobs)

    def _refuse_unknown(self, topic: str, part: MessagesPart, fields: Collection[tuple[str, ...]]) -> None:
        """Raise McaptrackError for a column that a channel does not have."""
        if column := part.unknown(fields):
            messages = self.typed_messages(topic, WHOLE)
            everything = list(messages.types) if messages else self._inferred(topic, WHOLE).fields
            names = [".".join(path) for path in everything]
            raise McaptrackError(f"{self.opened.path}: {topic} has no field {column}; {offer(column, names)}")

    def _source(self, topic: str, part: MessagesPart) -> tables.MessageSource:
        """The messages of a channel of other software that a table holds. Raises McaptrackError for bad times."""
        span, timing = (part.start_ns, part.end_ns), self.timing(topic, part)

        def payloads(lose: Callable[[int, str], None]) -> Iterator[Payloads]:
            batches = self.opened.payloads_of([topic], *span, lambda _, count, why: lose(count, why))
            return (batch for _, batch in batches)

        return tables.MessageSource(
            topic,
            message_type_of(self.opened, topic).name,
            file_name(self.opened.part(topic).path),
            timing.first,
            timing.messages,
            f"{self.opened.path}: {topic}",
            payloads,
            payload_decoder(self.opened, topic, flattener),
        )

    def timing(self, topic: str, part: MessagesPart) -> Timing:
        """The times of the messages of a channel that a table holds. Raises McaptrackError for bad times."""
        key = (topic, part.start_ns, part.end_ns)
        if key not in self._timings:
            times = self.opened.times(topic)
            first = 0 if part.start_ns is None else int(np.searchsorted(times, part.start_ns))
            last = len(times) if part.end_ns is None else int(np.searchsorted(times, part.end_ns))
            times = times[first:last]
            steps_ns = np.diff(times)
            usual_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0
            self._timings[key] = Timing(
                first,
                len(times),
                int(times[0]) if len(times) else None,
                int(times[-1]) if len(times) else None,
                float(steps_ns.max()) / NS_PER_S if len(steps_ns) else None,
                NS_PER_S / usual_ns if usual_ns else None,
            )
        return self._timings[key]

    def manifest(self, topic: str, part: MessagesPart) -> dict[str, Any]:
        """The type of a channel, and the times of the messages in its table."""
        channel = self.opened.channel(topic)
        timing: dict[str, Any] = dict.fromkeys(Timing._fields) | {"messages": channel.messages}
        with suppress(McaptrackError):  # messages later than 2262, or of several types
            timing = self.timing(topic, part)._asdict()
        del timing["first"]
        return {
            "topic": topic,
            "schema": channel.schema_name or None,
            "encoding": channel.message_encoding or None,
            **timing,
            "columns": list(part.columns) or None,
        }

    # Parts of tables

    def _places(self) -> TablePieces:
        """The places of messages, channel by channel."""
        topics = self.topics("frames")
        names = [*topics, *(file_name(part.path) for part in self.opened.parts)]

        def pieces() -> Iterator[Any]:
            return (tables.frames_table(topic, self._pointers(topic), names) for topic in topics)

        return TablePieces(TABLES["frames"].arrow, sum(self.opened.channel(topic).messages for topic in topics), pieces)

    def _frames(self, topic: str) -> FrameColumns:
        if topic not in self._kept:
            if foreign.holds_boxes(self.opened, topic):
                self._kept[topic] = self._boxes(topic)
                return self._kept[topic]
            schema = self.opened.channel(topic).schema
            if schema is None:
                raise KeyError(topic)
            self._kept[topic] = self.opened.frame_columns(topic, schema)
            self._class_names[topic] = class_names(self.opened.channel(topic).metadata)
        return self._kept[topic]

    def _boxes(self, topic: str) -> FrameColumns:
        """Foreign boxes; none, and a note, if they can't be read: the other tables don't depend on them."""
        try:
            frames, self._class_names[topic], *_ = self._boxes_read.read(self.opened, topic)
        except McaptrackError as error:
            self._note("detections", f"{error}; no boxes of {topic} are in the table")
            times = enumerate(self.opened.times(topic).tolist())
            return collect(DETECTIONS, (Frame(t_ns, number, DETECTIONS.empty()) for number, t_ns in times))
        return collect(DETECTIONS, frames)

    def _track_names(self, topic: str) -> TrackNames:
        """The names of the classes of the tracks, and of the ground truth, that the rows of a channel are about."""
        how = provenance_of(self.opened, topic)
        base = topic
        for beside in ("/events", "/errors", "/decisions", "/appearance", "/worlds"):
            base = base.removesuffix(beside)
        if how and how.zones:
            base = how.input
        beside = base.removesuffix("/predictions")
        near = (base,) if base == beside else (f"{beside}/online", beside, input_of(self.opened.channel(base).metadata))
        track_topics = set(self.topics("tracks"))
        tracks = next((near_topic for near_topic in near if near_topic in track_topics), "")
        truth = next((reference for reference in how.references if reference in track_topics), "") if how else ""

        def names(of: str) -> dict[int, str]:
            return tables.names_by_track(self._frames(of), self._class_names.get(of, {})) if of else {}

        return TrackNames(names(tracks), names(truth), tracks)

    def _code_names(self, topic: str) -> dict[int, str]:
        """The names, by number, of the zones or of the cameras that the rows of a channel are about."""
        how = provenance_of(self.opened, topic)
        if how is None:
            return {}
        named_cameras = how.parameters.get("cameras")
        zones = {int(number): name for number, name in how.zones.items() if number.isdecimal()}
        return zones or dict(enumerate(map(str, named_cameras if isinstance(named_cameras, list) else ())))

    def _note(self, name: str, note: str) -> None:
        self.notes[name] = "; ".join([*filter(None, [self.notes.get(name)]), note])

    def _pointers(self, topic: str) -> Pointers:
        places = self.opened.places(topic)
        file = file_name(self.opened.part(topic).path)
        frame, rows = np.arange(len(places.t_ns)), np.full(len(places.t_ns), -1)
        # Rows of 3D boxes are at their stamps: several messages may be one frame.
        is_read = foreign.holds_pictures(self.opened.channel(topic)) or foreign.holds_boxes(self.opened, topic, True)
        has_rows = not is_read
        if has_rows:
            frames = self._frames(topic)
            frame, rows = frames.numbers, np.diff(frames.ends)
        return Pointers(file, places.t_ns, frame, rows, places.chunk_offset, places.offset)

    def _labelled(self) -> list[Camera]:
        """The cameras with ground truth."""
        tracks = self.topics("tracks")
        return [camera for camera in cameras(self.opened) if camera.truth in tracks]

    def _scored(self, camera: Camera) -> list[str]:
        names = (*evaluation.SCORED, evaluation.FULL, *evaluation.FORECASTS)
        candidates = [camera.truth, *(f"{camera.prefix}/{name}" for name in names)]
        return [topic for topic in candidates if topic in self.opened.channels]

    @cached_property
    def _scores(self) -> list[dict[str, Any]]:
        return list(self._scored_rows())

    def _scored_rows(self) -> Iterator[dict[str, Any]]:
        for camera in self._labelled():
            try:
                sequence = evaluation.sequence_of_log(self.opened, camera.prefix, ())
                outcome = evaluation.evaluate([sequence], evaluation.EvaluateOptions())
            except McaptrackError as error:  # nothing can be compared
                self._note("metrics", str(error))
                continue
            for result in outcome.results:
                row = result.to_json()
                forecasts = row.pop("displacement", {})
                row |= {f"class_mean_{name}": value for name, value in row.pop("class_means", {}).items()}
                yield row | forecasts | {"topic": result.tracks, "truth": camera.truth}

    @cached_property
    def _cameras(self) -> dict[str, str]:
        """The name of the camera of each channel that belongs to one."""
        return {topic: camera.prefix[1:] for camera in cameras(self.opened) for topic in camera.topics}

    @cached_property
    def _warnings(self) -> list[LogWarning]:
        """All warnings about results, those of each channel first."""
        found = [
            warning
            for topic in sorted(self.opened.channels)
            if (how := provenance_of(self.opened, topic))
            for warning in warnings_of(topic, self._cameras.get(topic, ""), how)
        ]
        found += (warning for camera in cameras(self.opened) for warning in self._warnings_of_camera(camera))
        first = {warning[1:]: warning for warning in reversed(found)}
        return sorted(first.values())

    def _warnings_of_camera(self, camera: Camera) -> Iterator[LogWarning]:
        """Warn of a ground plane that was not measured, and of scores that re-tracking made worse."""
        name = camera.prefix[1:]
        planes = self._frames(camera.ground_plane).rows() if camera.ground_plane in self.topics("ground_planes") else ()
        origins = {_origin_of_plane(row) for row in planes}
        if origins == {"estimated"}:
            message = "no ground plane is known; one was estimated from boxes of people"
            yield LogWarning(camera.ground_plane, name, "estimated-ground-plane", message)
        elif origins and "given" not in origins:
            message = "no ground plane is known; the scale was guessed from the heights of boxes"
            yield LogWarning(camera.ground_plane, name, "assumed-ground-plane", message)
        before, after = (
            _headline([row for row in self._scores if row["topic"] == f"{camera.prefix}/{below}"])
            for below in ("samples", "retracks")
        )
        if before and after and after["IDF1"] < before["IDF1"]:
            message = (
                f"re-tracking made it worse: IDF1 {before['IDF1']:.1%} before, {after['IDF1']:.1%} after, against "
                f"{after['truth']}"
            )
            yield LogWarning(str(after["topic"]), name, "worse", message)

    def _recording(self) -> dict[str, Any]:
        opened = self.opened
        messages = sum(sum(part.index.counts.values()) for part in opened.parts)
        rows = [row for topic in self.topics("ground_planes") for row in self._frames(topic).rows()]
        planes = {_origin_of_plane(row) for row in rows}
        sources = {
            channel.topic: dict(provenance.parameters)
            for channel in opened.channels.values()
            if (provenance := Provenance.from_metadata(channel.metadata)) and provenance.transform == "ingest"
        }
        span: tuple[int | None, int | None] = (opened.start_ns, opened.end_ns) if messages else (None, None)
        if messages and opened.end_ns > LAST_NS:
            self._note("recordings", "messages are later than the year 2262, which tables can't hold")
            span = (opened.start_ns if opened.start_ns <= LAST_NS else None, None)
        return {
            "file": file_name(opened.path),
            "start_t": span[0],
            "end_t": span[1],
            "start_t_ns": span[0],
            "end_t_ns": span[1],
            "duration_s": (opened.end_ns - opened.start_ns) / 1e9 if messages else 0.0,
            "messages": messages,
            "size_bytes": sum(part.size for part in opened.parts),
            "digest": opened.fingerprint(),
            "results_file": file_name(opened.results.path) if opened.results else None,
            "ground_plane": None if not planes else planes.pop() if len(planes) == 1 else "mixed",
            "source": json.dumps(sources, sort_keys=True, separators=(",", ":")) if sources else None,
            "mcaptrack_version": __version__,
            **self._as_a_whole(),
        }

    def _as_a_whole(self) -> dict[str, Any]:
        """The columns that tell a log from thousands of others."""
        topics = self.topics("tracks")
        best = [topic for camera in cameras(self.opened) if (topic := best_tracks(camera, topics))]
        track_ids = (unique_values(TRACKS, self._frames(topic), "track_id") for topic in best)
        versions = {how.version for topic in self.opened.channels if (how := provenance_of(self.opened, topic))}
        return {
            "location": location_of(self.opened.path),
            "cameras": len(cameras(self.opened)),
            "tracks": sum(map(len, track_ids)) if best else None,
            **worst_score(best, self._scores),
            **in_one_row(self._warnings),
            "versions": ", ".join(sorted(versions)) or None,
        }


def _origin_of_plane(row: np.void) -> str:
    """Where a ground plane is from; one that isn't measured is estimated if it has a perspective, else a scale."""
    if not row["assumed"]:
        return "given"
    return "estimated" if row["h20"] or row["h21"] else "assumed"


def _order_of_scores(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return (*(row[name] for name in TABLES["metrics"].order), row["class"] or "")


def _plugins(how: Provenance) -> dict[str, dict[str, str]]:
    """The classes of other packages that made a channel: of its transform, and of its predictor."""
    return {part: plugin._asdict() for part, plugin in how.plugins.items()}


def _channel(channel: log.Channel, named_cameras: Mapping[str, str]) -> dict[str, object]:
    how = Provenance.from_metadata(channel.metadata)
    out: dict[str, object] = {
        "topic": channel.topic,
        "schema": channel.schema_name or None,
        "messages": channel.messages,
        "encoding": channel.message_encoding or None,
        "camera": named_cameras.get(channel.topic),
    }
    if how:
        names = ("transform", "input", "version", "digest", "input_digest", "weights_sha256", "frame_id")
        out |= {name: getattr(how, name) or None for name in names}
        out["parameters"] = json.dumps(how.parameters, sort_keys=True, separators=(",", ":"))
        out["compared_with"] = json.dumps(dict(how.references), sort_keys=True) if how.references else None
        out["plugins"] = json.dumps(_plugins(how), sort_keys=True) if how.plugins else None
    return out


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
