"""Cut logs: which channels the new log has, what it needs from before its start, and what holds for cut results.

A moment of a log is not complete by its messages alone. A viewer that opens the whole log there has maps, transforms
and calibrations that were published once, long before: the last of each is written again just before all others.
It also decodes video from the key picture before: pictures from that one on are kept, at their own times.
"""

from __future__ import annotations

import heapq
import re
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.clocks import parse_ns
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.log.records import Damaged
from mcaptrack.notices import warn
from mcaptrack.pipeline.staleness import planes_to_json, read_planes
from mcaptrack.schema import GROUND_PLANE
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import CALIBRATIONS_READ
from mcaptrack.sources.cameras import camera_at, chain_of, name_above, provenance_of
from mcaptrack.sources.fixed_frame import LATCHED, TRANSFORMS_READ, edges_of
from mcaptrack.sources.foreign.decoding import decoder_with_errors
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.video import is_video_codec, read_head

Progress = Callable[[str, int, int], None]
Span = tuple[int | None, int | None]

#: The metadata record of a log that was cut out of a longer one: ``start_ns`` and ``end_ns``, as far as it is shorter.
CUT: Final = "mcaptrack.cut"
#: Schemas of messages of which each holds until the next one, and is all that is to be seen.
_HELD: Final = (*CALIBRATIONS_READ, GROUND_PLANE.name, "nav_msgs/OccupancyGrid", "foxglove.Grid", "foxglove.GeoJSON")
_SCENE: Final = "foxglove.SceneUpdate"
#: So many messages before the start are searched for a key picture, transforms that hold, and latched messages of
#: several publishers.
_SEARCHED: Final = 2000
#: In the profiles of publishers, as rosbag2 writes them (in numbers before Iron): those that are latched, and how many.
_LATCHING: Final = re.compile(r"durability:\s*(?:1\b|transient_local)")
_DEPTH: Final = re.compile(r"depth:\s*(\d{1,6})")


@dataclass
class CutReport:
    """The result of ``cut``: messages, topics, how many messages of each are from before the start; and losses."""

    messages: int = 0
    topics: tuple[str, ...] = ()
    earlier: dict[str, int] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)


class _Member(NamedTuple):
    """A channel of a log: the number of the log, and its file."""

    number: int
    part: log.Log
    channel: log.Channel


class _Piece(NamedTuple):
    """A part of a channel: the digest of the whole, and from when and before when it is, if that is shorter."""

    digest: str
    start_ns: int | None = None
    end_ns: int | None = None

    @classmethod
    def of(cls, cut: Mapping[str, str], span: Span, digest: str = "") -> _Piece:
        """The part of an earlier cut within a span."""
        before = (parse_ns(cut.get("start_ns", "")), parse_ns(cut.get("end_ns", "")))
        starts, ends = ([t for t in pair if t is not None] for pair in zip(before, span, strict=True))
        return cls(cut.get("digest", digest), max(starts, default=None), min(ends, default=None))

    def holds(self, t_ns: int) -> bool:
        """Whether a time is within it."""
        is_after = self.start_ns is None or t_ns >= self.start_ns
        return is_after and (self.end_ns is None or t_ns < self.end_ns)

    @property
    def texts(self) -> dict[str, str]:
        """Its limits as metadata."""
        return {name: str(t_ns) for name in ("start_ns", "end_ns") if (t_ns := getattr(self, name)) is not None}

    def described(self) -> tuple[str, dict[str, str]]:
        """The digest of the messages that are left, and ``Provenance.cut``."""
        if not self.texts or not self.digest:
            return self.digest, self.texts
        cut = {"digest": self.digest, **self.texts}
        return sha256(repr(sorted(cut.items())).encode()).hexdigest(), cut


def _joined(pieces: Collection[_Piece]) -> _Piece | None:
    """The pieces as one, if they are of the same whole and without a gap between them."""
    in_order = sorted(pieces, key=lambda piece: -1 if piece.start_ns is None else piece.start_ns)
    digests = {piece.digest for piece in in_order}
    until = in_order[0].end_ns
    for piece in in_order[1:]:
        if until is not None and piece.start_ns is not None and piece.start_ns > until:
            return None
        until = None if until is None or piece.end_ns is None else max(until, piece.end_ns)
    return _Piece(digests.pop(), in_order[0].start_ns, until) if len(digests) == 1 else None


def cut(
    logs: Sequence[log.Log],
    output: Path,
    topics: Collection[str],
    span: Span = (None, None),
    progress: Progress = lambda *_: None,
) -> CutReport:
    """Write the messages of topics of logs in a half-open span of times to a new log.

    Raises McaptrackError if a log can't be read, or changes meanwhile.
    """
    work = _Cut(logs, topics, span)
    headers = {log.header(opened)[0] for opened in logs}
    is_one = len(logs) == 1 and logs[0].results is None
    header = bytes(logs[0].snapshot.record(len(log.MAGIC))) if is_one else None
    with log.create(output, headers.pop() if len(headers) == 1 else "", header=header) as writer:
        return work.write(writer, progress)


class _Cut:
    """The channels of the new log, each with those that it is made of."""

    def __init__(self, logs: Sequence[log.Log], topics: Collection[str], span: Span) -> None:
        self._logs, self._span, self._lost = logs, span, list[str]()
        self._held_ns = 0  # the time at which messages from before the start are written
        #: The part that is taken of each log, without limits that leave nothing out.
        self._spans: list[Span] = []
        for opened in logs:
            start_ns, end_ns = span
            is_late = start_ns is not None and start_ns > opened.start_ns
            is_early = end_ns is not None and end_ns <= opened.end_ns
            self._spans.append((start_ns if is_late else None, end_ns if is_early else None))
        cuts = [opened.metadata(CUT) for opened in logs]
        self._is_cut = [cut is not None for cut in cuts]
        self._pieces = [_Piece.of(cut or {}, part) for cut, part in zip(cuts, self._spans, strict=True)]
        topics = {*topics} - _conflicts(logs, topics)
        self._channels: dict[tuple[Any, ...], list[_Member]] = {}
        for number, opened in enumerate(logs):
            repeats: Counter[tuple[Any, ...]] = Counter()
            for part in opened.parts:
                for channel in part.recorded:
                    if channel.topic not in topics or opened.part(channel.topic) is not part:
                        continue
                    schema = part.index.schemas.get(part.index.channels[channel.id].schema_id)
                    fields = (schema.name, schema.encoding, bytes(schema.data)) if schema else ("", "", b"")
                    key = (channel.topic, fields, channel.message_encoding)
                    repeats[key] += 1  # each publisher may have a channel
                    member = _Member(number, part, channel)
                    self._channels.setdefault((*key, repeats[key]), []).append(member)
        self._logs_of: dict[str, set[int]] = {}
        for (topic, *_), members in self._channels.items():
            self._logs_of.setdefault(topic, set()).update(member.number for member in members)

    def write(self, writer: log.LogWriter, progress: Progress) -> CutReport:
        """Write the new log."""
        self._warn()
        report = CutReport(topics=tuple(sorted(self._logs_of)))
        ids: dict[log.Log, dict[int, int]] = {part: {} for opened in self._logs for part in opened.parts}
        since: dict[log.Log, dict[int, int]] = {part: {} for part in ids}
        earlier: list[tuple[int, log.Message]] = []
        held = [self._from_before(key[0], members) for key, members in self._channels.items()]
        self._held_ns = max(min((since_ns for since_ns, _ in held), default=0) - 1, 0)
        for ((topic, schema, encoding, _), members), (start_ns, before) in zip(
            self._channels.items(), held, strict=True
        ):
            first = members[0].channel.id
            metadata = self._metadata(topic, members)
            wanted = (first, members[0].part.index.channels[first].schema_id)
            new = writer.add_channel(topic, schema, encoding, metadata, another=True, ids=wanted)
            earlier += ((new, message) for message in before)
            report.earlier[topic] = report.earlier.get(topic, 0) + len(before)
            for member in members:
                ids[member.part][member.channel.id] = new
                own = self._own_start(member, members)
                since[member.part][member.channel.id] = max(start_ns, own)
        report.earlier = {topic: count for topic, count in report.earlier.items() if count}
        writer.write_description(*writer.channels)
        copied: set[bytes] = set()
        for part in ids:
            unknown = [*log.private_records(part)]
            for record in unknown:
                writer.write(record)
            if unknown:
                text = f"{len(unknown)} records of kinds that MCAP doesn't define are copied as they are"
                warn(f"{part.path}: {text}", "other")
            log.copy_attachments_and_metadata(part, writer, without=[CUT], copied=copied)
        if (whole := _joined(self._pieces)) and whole.texts:
            writer.add_metadata(CUT, whole.texts)
        for new, message in sorted(earlier, key=lambda pair: pair[1].t_ns):
            writer.add_message(new, self._held_ns, message.sequence, message.payload, message.publish_ns)
        writer.close_chunks()
        parts = [log.Part(part, ids[part], since[part]) for part in ids if ids[part]]
        report.lost = self._lost + log.copy_messages(writer, parts, self._span[1], progress)
        report.messages = sum(writer.counts.values())
        return report

    def _own_start(self, member: _Member, members: Sequence[_Member]) -> int:
        """The start of a log that was cut, if another one has what it kept from before: the first message to take."""
        piece = self._pieces[member.number]
        if not self._is_cut[member.number] or piece.start_ns is None:
            return 0
        others = {other.number for other in members if other.number != member.number and self._is_cut[other.number]}
        return piece.start_ns if any(self._pieces[number].holds(piece.start_ns - 1) for number in others) else 0

    def _metadata(self, topic: str, members: Sequence[_Member]) -> Mapping[str, str]:
        """The metadata of a channel: those of the first, with digests that hold for what is left of results.

        What was out of date stays so, and what wasn't doesn't become so.
        """
        first = members[0].channel.metadata
        origins = [how for member in members if (how := Provenance.from_metadata(member.channel.metadata))]
        if len(origins) < len(members):
            return first
        how = origins[0]
        digest, cut = self._digest(topic)
        made_from = {name: self._digest_then(name, members, origins) for name in how.made_from()}
        parameters = dict(how.parameters)
        if "ground_planes" in parameters:
            parameters["ground_planes"] = self._planes_then(topic, members, origins)
        now = replace(
            how,
            parameters=parameters,
            digest=digest,
            cut=cut,
            input_digest=made_from[how.input],
            references={name: made_from[name] for name in how.references},
        )
        before = how.to_metadata()
        return first if now == how else {k: v for k, v in first.items() if k not in before} | now.to_metadata()

    def _digest(self, topic: str) -> tuple[str, dict[str, str]]:
        """The digest of what is left of a channel of results, and ``Provenance.cut``."""
        pieces = [
            _Piece.of(how.cut, self._spans[number], how.digest)
            for number in sorted(self._logs_of[topic])
            if (how := provenance_of(self._logs[number], topic))  # None: its messages have another schema
        ]
        whole = _joined(pieces)
        if whole is None:
            return sha256("".join(piece.described()[0] for piece in pieces).encode()).hexdigest(), {}
        return whole.described()

    def _digest_then(self, name: str, members: Sequence[_Member], origins: Sequence[Provenance]) -> str:
        """The digest that a channel should name of one that it was made from: the new one, if it was up to date."""
        before = origins[0].made_from()[name]
        if not self._logs_of.get(name, {-1}) <= {member.number for member in members}:
            return before
        for member, origin in zip(members, origins, strict=True):
            how = provenance_of(self._logs[member.number], name)
            if how is None or how.digest != origin.made_from().get(name):
                return before
        return self._digest(name)[0]

    def _planes_then(self, topic: str, members: Sequence[_Member], origins: Sequence[Provenance]) -> list[Any]:
        """The ground planes that a channel should name, if those that it names are those of its logs."""
        planes: dict[int, GroundPlane] = {}
        for member, origin in zip(members, origins, strict=True):
            opened = self._logs[member.number]
            of_camera = read_planes(opened, name_above(chain_of(opened, topic)[-1])) or ()
            before: list[Any] = origin.parameters["ground_planes"]
            if planes_to_json(of_camera) != before:
                return before
            own_start = self._own_start(member, members)
            planes |= {t_ns: plane for t_ns, plane in of_camera if t_ns >= own_start}
        start_ns, end_ns = self._span
        earlier = [plane for t_ns, plane in sorted(planes.items()) if start_ns is not None and t_ns < start_ns][-1:]
        piece = _Piece("", start_ns, end_ns)
        kept = [(t_ns, plane) for t_ns, plane in sorted(planes.items()) if piece.holds(t_ns)]
        return planes_to_json([(self._held_ns, plane) for plane in earlier] + kept)

    # From before the start

    def _from_before(self, topic: str, members: Sequence[_Member]) -> tuple[int, list[log.Message]]:
        """The time of the first message of a channel to take, and messages from before the start that hold there."""
        start_ns = self._span[0]
        if start_ns is None:
            return 0, []
        opened = self._logs[members[0].number]
        channel, latest = opened.channel(topic), dict[object, log.Message]()
        kind = plain_name(channel.schema_name)
        before = self._before(members, start_ns)
        if foreign.holds_pictures(channel):
            return self._first_picture_ns(opened, topic, members, start_ns), []
        searched = max(_latched(member.channel.metadata) for member in members)
        key: Callable[[bytes], object] = bytes
        if kind in TRANSFORMS_READ:
            searched = sys.maxsize if topic.endswith(LATCHED) else _SEARCHED
            key = _decoder(opened, topic, edges_of)
        elif kind in (*_HELD, _SCENE):
            searched = searched or 1
        for message in islice(before, searched):
            latest.setdefault(key(message.payload), message)
        if kind == _SCENE:
            is_lasting = _decoder(opened, topic, lambda message: any(map(_is_lasting, message.entities)))
            latest = {at: message for at, message in latest.items() if is_lasting(message.payload)}
        return start_ns, [*latest.values()][::-1]

    def _before(self, members: Sequence[_Member], start_ns: int) -> Iterator[log.Message]:
        """The messages of a channel before a time, the latest first."""

        def of(member: _Member) -> Iterator[log.Message]:
            own_start = self._own_start(member, members)
            try:
                for message in member.part.snapshot.messages.before(member.channel.id, start_ns):
                    if message.t_ns >= own_start:
                        yield message
            except Damaged as error:
                where = f"{member.part.path}: {error}"
                self._lost.append(f"{where}; messages of {member.channel.topic} from before the start are left out")

        return heapq.merge(*map(of, members), key=lambda message: message.t_ns, reverse=True)

    def _first_picture_ns(self, opened: log.Log, topic: str, members: Sequence[_Member], start_ns: int) -> int:
        """The time of the picture that decoding of the first one after the start begins with."""
        try:
            read = foreign.picture_reader(opened, topic)
            streams = (m.part.snapshot.messages.by_time([m.channel.id], (start_ns, self._span[1])) for m in members)
            first = [*islice(heapq.merge(*streams, key=lambda message: message.t_ns), 1)]
        except McaptrackError:  # copying says so, or viewers
            return start_ns
        is_key = False
        for message in islice(chain(first, self._before(members, start_ns)), _SEARCHED if first else 0):
            try:
                picture = read(message)
            except McaptrackError:
                continue
            if not is_video_codec(picture.format):
                return start_ns
            head = read_head(picture.format, picture.data)
            is_key |= head.is_key
            if is_key and head.has_parameter_sets:
                return min(message.t_ns, start_ns)
        if first:
            text = "there is no key picture before the start: the first pictures can't be decoded"
            warn(f"{opened.path}: {topic}: {text}", "pictures")
        return start_ns

    def _warn(self) -> None:
        """Warn of channels of several logs that may not fit."""
        schemas: dict[str, set[tuple[Any, ...]]] = {}
        differing, mixed = [], []
        for (topic, *layout, repeat), members in self._channels.items():
            if repeat == 1:
                schemas.setdefault(topic, set()).add(tuple(layout))
            plain = {tuple(sorted(member.channel.metadata.items())) for member in members}
            differing += [topic] if len(plain) > 1 and not Provenance.from_metadata(members[0].channel.metadata) else []
            spans = sorted(self._times_of(number) for number in {member.number for member in members})
            mixed += [topic] if any(later[0] < before[1] for before, later in pairwise(spans)) else []
        several = [topic for topic, layouts in schemas.items() if len(layouts) > 1]
        where = f"{len(self._logs)} logs"
        for topics, text in (
            (several, "in messages of several layouts: they stay in channels of their own"),
            (differing, "with other metadata in each log: those of the first are taken"),
            (mixed, "from the same time in several logs: their messages alternate"),
        ):
            if topics and len(self._logs) > 1:
                warn(f"{where} have {list_names(sorted({*topics}))} {text}", "other")

    def _times_of(self, number: int) -> tuple[int, int]:
        """The time of the first message of a log that counts, and the end."""
        opened, piece = self._logs[number], self._pieces[number]
        start_ns = piece.start_ns if self._is_cut[number] and piece.start_ns is not None else opened.start_ns
        return start_ns, opened.end_ns + 1


def _conflicts(logs: Sequence[log.Log], topics: Collection[str]) -> set[str]:
    """The channels of results that several logs have of their own, and what was made from them, with a warning."""
    origins: dict[str, list[Provenance]] = {}
    for opened in logs:
        for topic in opened.channels.keys() & {*topics}:
            if (how := provenance_of(opened, topic)) and how.transform != INGEST:
                origins.setdefault(topic, []).append(how)
    out: set[str] = set()
    more = {topic for topic, those in origins.items() if len({how.cut.get("digest", how.digest) for how in those}) > 1}
    while more:
        out |= more
        more = {
            topic
            for topic, those in origins.items()
            if topic not in out and any(not out.isdisjoint(how.made_from()) for how in those)
        }
    if out:
        text = "are left out: each log has its own, with its own ids; `mcaptrack run` makes those of all"
        warn(f"results of {len(logs)} logs in {list_names(sorted(out))} {text}", "left-out")
    return out


def needed(opened: log.Log, topics: Collection[str]) -> set[str]:
    """Return topics with those that tell whether results in them are up to date: what they were compared with, and the
    ground planes; of rows only, without pictures.
    """
    out, new = {*topics}, {*topics}
    while new:
        names: set[str] = set()
        for topic in new:
            how = provenance_of(opened, topic)
            names |= {*how.references} if how else set()
            if how and "ground_planes" in how.parameters:
                names.add(camera_at(opened, name_above(chain_of(opened, topic)[-1])).ground_plane)
        new = {name for name in names - out if name in opened.channels and opened.channels[name].schema is not None}
        out |= new
    return out


def _decoder(opened: log.Log, topic: str, convert: Callable[[Any], object]) -> Callable[[bytes], object]:
    """A function that decodes messages of a channel; of those that can't be decoded it returns the bytes."""
    try:
        decode = decoder_with_errors(message_type_of(opened, topic), convert)
    except McaptrackError:
        return bytes

    def decoded(payload: bytes) -> object:
        try:
            return decode(payload)
        except McaptrackError:
            return payload

    return decoded


def _is_lasting(entity: Any) -> bool:
    """Whether an entity of a scene stays until it is replaced."""
    names = ("seconds", "nanos", "sec", "nsec", "nanosec", "secs", "nsecs")
    return not any(getattr(entity.lifetime, name, 0) for name in names)


def _latched(metadata: Mapping[str, str]) -> int:
    """The most messages that a late subscriber gets: the last ones; 0 if the channel isn't latched."""
    profiles = metadata.get("offered_qos_profiles", "")
    publishers = len(_LATCHING.findall(profiles)) + (metadata.get("latching") == "1")
    if publishers > 1 or "keep_all" in profiles:
        return _SEARCHED
    return min(max(1, *map(int, _DEPTH.findall(profiles)), 1), _SEARCHED) if publishers else 0
