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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from itertools import combinations, islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.clocks import parse_ns
from mcaptrack.log.records import Damaged
from mcaptrack.notices import Progress, warn
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
from mcaptrack.sources.pictures import Pictures

# Parts of channels: digests of a log that was cut out of a longer one name the whole channels, and which part it is.
#
# Parts of a channel are told from the whole, and can be joined again. What is up to date stays so, since the digests of
# all channels get the same limits: DIGEST@START-END, from a time until before another, in ns.


#: From a time until before another, in ns.
_Span = tuple[int, int]
_NO_END: Final = 2**64
_ALL: Final = (0, _NO_END)


def _span_of(start_ns: str, end_ns: str) -> _Span:
    """The span with these limits as texts; "" for none."""
    return parse_ns(start_ns) or 0, parse_ns(end_ns) or _NO_END


def _limits_of(span: _Span) -> tuple[str, str]:
    """The limits of a span as texts; "" for none."""
    return str(span[0] or ""), "" if span[1] == _NO_END else str(span[1])


def _within(span: _Span, other: _Span) -> _Span:
    """The span that is in both."""
    return max(span[0], other[0]), min(span[1], other[1])


def _joined(spans: Iterable[_Span]) -> _Span:
    """The span from the first start to the last end."""
    starts, ends = zip(*spans, strict=True)
    return min(starts), max(ends)


def _read_digest(digest: str) -> tuple[str, _Span]:
    """The digest of a whole channel, and which part of it a digest names."""
    whole, _, limits = digest.partition("@")
    start_ns, _, end_ns = limits.partition("-")
    return whole, _span_of(start_ns, end_ns)


def _part_digest(whole: str, span: _Span) -> str:
    """The digest of a part of a channel; "" if that of the whole isn't known."""
    return f"{whole}@{'-'.join(_limits_of(span))}" if whole and span != _ALL else whole


#: The metadata record of a log that was cut out of a longer one: ``start_ns`` and ``end_ns``, as far as it is shorter.
CUT: Final = "mcaptrack.cut"
_NAMES: Final = ("start_ns", "end_ns")
#: Schemas of messages of which each holds until the next one, and is all that is to be seen.
_HELD: Final = (*CALIBRATIONS_READ, GROUND_PLANE.name, "nav_msgs/OccupancyGrid", "foxglove.Grid", "foxglove.GeoJSON")
_SCENE: Final = "foxglove.SceneUpdate"
#: So many messages before the start are searched for a key picture, transforms that hold, and latched messages of
#: several publishers.
_SEARCHED: Final = 2000
#: In the profiles of publishers, as rosbag2 writes them (in numbers before Iron): those that are latched, and how many.
_LATCHING: Final = re.compile(r"durability:\s*(?:1\b|transient_local)")
_DEPTH: Final = re.compile(r"depth:\s*(\d{1,6})")


class CutReport(NamedTuple):
    """The result of ``cut``: messages, topics, how many messages of each are from before the start; and losses."""

    messages: int
    topics: tuple[str, ...]
    earlier: Mapping[str, int]
    lost: tuple[str, ...]


#: A message from before the start: topic, number of the channel in the new log, message.
_Held = tuple[str, int, log.Message]


class _Member(NamedTuple):
    """A channel of a log: the number of the log, its file, and how mcaptrack made the channel, if it did."""

    number: int
    part: log.Log
    channel: log.Channel
    origin: Provenance | None


def cut(
    logs: Sequence[log.Log],
    output: Path,
    topics: Collection[str],
    span: tuple[int | None, int | None] = (None, None),
    progress: Progress = lambda *_: None,
) -> CutReport:
    """Write the messages of topics of logs in a half-open span of times to a new log.

    Raises McaptrackError if a log can't be read, or changes meanwhile.
    """
    work = _Cut(logs, topics, (span[0] or 0, _NO_END if span[1] is None else span[1]))
    is_same = len({log.header(opened)[0] for opened in logs}) == 1
    with log.create(output, header=bytes(logs[0].snapshot.record(len(log.MAGIC))) if is_same else None) as writer:
        return work.write(writer, progress)


class _Cut:
    """The channels of the new log, each with those that it is made of."""

    def __init__(self, logs: Sequence[log.Log], topics: Collection[str], span: _Span) -> None:
        self._logs, self._span, self._lost = logs, span, list[str]()
        self._held_ns = 0  # the time at which messages from before the start are written
        #: The part that is taken of each log, without limits that leave nothing out; and the part of a longer log that
        #: it is already.
        self._taken, self._earlier = list[_Span](), list[_Span]()
        for opened in logs:
            start_ns, end_ns = span
            self._taken.append(
                (start_ns * (start_ns > opened.start_ns), end_ns if end_ns <= opened.end_ns else _NO_END)
            )
            cut = opened.metadata(CUT) or {}
            self._earlier.append(_span_of(*(cut.get(name, "") for name in _NAMES)))
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
                    how = Provenance.from_metadata(channel.metadata)
                    recorded = None if how else frozenset(channel.metadata.items())
                    key = (channel.topic, fields, channel.message_encoding, recorded)
                    repeats[key] += 1  # each publisher may have a channel
                    member = _Member(number, part, channel, how)
                    self._channels.setdefault((*key, repeats[key]), []).append(member)

    def write(self, writer: log.LogWriter, progress: Progress) -> CutReport:
        """Write the new log."""
        parts = {part: log.Part(part, {}, {}) for opened in self._logs for part in opened.parts}
        earlier = self._add_channels(writer, parts)
        writer.write_description(*writer.channels)
        copied: set[bytes] = set()
        for part in parts:
            for record in log.private_records(part):
                writer.write(record)
            log.copy_attachments_and_metadata(part, writer, without=[CUT], copied=copied)
        limits = _limits_of(_joined(map(_within, self._earlier, self._taken)))
        if any(limits):
            writer.add_metadata(CUT, {name: text for name, text in zip(_NAMES, limits, strict=True) if text})
        for _, new, message in sorted(earlier, key=lambda held: held[2].t_ns):
            writer.add_message(new, self._held_ns, message.sequence, message.payload, message.publish_ns)
        writer.close_chunks()
        lost = log.copy_messages(writer, [part for part in parts.values() if part.ids], self._span[1], progress)
        counts, topics = Counter(topic for topic, *_ in earlier), {key[0] for key in self._channels}
        return CutReport(sum(writer.counts.values()), tuple(sorted(topics)), counts, (*self._lost, *lost))

    def _add_channels(self, writer: log.LogWriter, parts: Mapping[log.Log, log.Part]) -> list[_Held]:
        """Add the channels to the new log, and their numbers to the parts that they are copied from.

        Returns the messages from before the start that hold there, with topic and channel.
        """
        held = [self._from_before(members) for members in self._channels.values()]
        self._held_ns = max(min((start_ns for start_ns, _ in held), default=0) - 1, 0)
        earlier, mixed = list[_Held](), set[str]()
        for (key, members), (start_ns, before) in zip(self._channels.items(), held, strict=True):
            (topic, schema, encoding, *_), first = key, members[0]
            wanted = (first.channel.id, first.part.index.channels[first.channel.id].schema_id)
            new = writer.add_channel(topic, schema, encoding, self._metadata(members), another=True, ids=wanted)
            earlier += ((topic, new, message) for message in before)
            spans = []
            for member, own_start in zip(members, self._own_starts(members), strict=True):
                if own_start < _NO_END:  # else another log has all of it
                    parts[member.part].ids[member.channel.id] = new
                    parts[member.part].since_ns[member.channel.id] = max(start_ns, own_start)
                    opened = self._logs[member.number]
                    spans.append((max(opened.start_ns, own_start), opened.end_ns))
            mixed |= {topic for pair in combinations(spans, 2) if max(a for a, _ in pair) <= min(b for _, b in pair)}
        if mixed:
            text = "from the same time in several logs: their messages alternate"
            warn(f"{len(self._logs)} logs have {list_names(sorted(mixed))} {text}", "other")
        return earlier

    def _own_starts(self, members: Sequence[_Member]) -> list[int]:
        """From when on the messages of each log count: what logs have that are parts of one is taken once."""
        digests = [_read_digest(it.origin.digest or it.origin.input_digest if it.origin else "") for it in members]
        if digests[0][0] and len({whole for whole, _ in digests}) == 1:
            starts, until = [0] * len(members), 0
            for place in sorted(range(len(members)), key=lambda place: digests[place][1]):
                starts[place], until = until, max(until, digests[place][1][1])
            return starts
        spans = [self._earlier[member.number] for member in members]
        cuts = [span for span in spans if span != _ALL]  # another one has what was kept from before the start
        return [start * any(cut[0] < start <= cut[1] for cut in cuts) for start, _ in spans]

    def _metadata(self, members: Sequence[_Member]) -> Mapping[str, str]:
        """The metadata of a channel: those of the first, where digests have the limits of what is left.

        Since all digests get the limits, what was out of date stays so, and what wasn't doesn't become so.
        """
        first, origins = members[0].channel.metadata, [member.origin for member in members if member.origin]
        if len(origins) < len(members):
            return first
        how, made_from = origins[0], [origin.made_from() for origin in origins]
        planes = {"ground_planes": self._planes(members, origins)} if "ground_planes" in how.parameters else {}
        digests = {name: self._digest(members, [names.get(name, "") for names in made_from]) for name in made_from[0]}
        now = replace(
            how,
            parameters={**how.parameters, **planes},
            digest=self._digest(members, [origin.digest for origin in origins]),
            input_digest=digests[how.input],
            references={name: digests[name] for name in how.references},
        )
        before = how.to_metadata()
        return first if now == how else {k: v for k, v in first.items() if k not in before} | now.to_metadata()

    def _digest(self, members: Sequence[_Member], digests: Sequence[str]) -> str:
        """The digest of what is left of a channel that these logs have with these digests."""
        wholes, spans = zip(*map(_read_digest, digests), strict=True)
        left = [_within(span, self._taken[member.number]) for span, member in zip(spans, members, strict=True)]
        if len({*wholes}) == 1:
            return _part_digest(wholes[0], _joined(left))
        return sha256("".join(map(_part_digest, wholes, left)).encode()).hexdigest()

    def _planes(self, members: Sequence[_Member], origins: Sequence[Provenance]) -> list[Any]:
        """The ground planes that a channel should name, if those that it names are those of its logs."""
        planes: dict[int, Any] = {}
        for member, own_start, how in zip(members, self._own_starts(members), origins, strict=True):
            opened = self._logs[member.number]
            of_camera = read_planes(opened, name_above(chain_of(opened, member.channel.topic)[-1])) or ()
            named: list[Any] = how.parameters["ground_planes"]
            if planes_to_json(of_camera) != named:
                return named
            planes |= {t_ns: plane for t_ns, plane in of_camera if t_ns >= own_start}
        start_ns, end_ns = self._span
        left = {self._held_ns if t_ns < start_ns else t_ns: planes[t_ns] for t_ns in sorted(planes) if t_ns < end_ns}
        return planes_to_json([*left.items()])

    # From before the start

    def _from_before(self, members: Sequence[_Member]) -> tuple[int, list[log.Message]]:
        """The time of the first message of a channel to take, and messages from before the start that hold there."""
        start_ns = self._span[0]
        if not start_ns:
            return 0, []
        opened, topic = self._logs[members[0].number], members[0].channel.topic
        channel, latest = opened.channel(topic), dict[object, log.Message]()
        kind = plain_name(channel.schema_name)
        if foreign.holds_pictures(channel):
            return self._first_picture_ns(members, start_ns), []
        searched = max(_latched(member.channel.metadata) for member in members)
        key: Callable[[bytes], object] = bytes
        if kind in TRANSFORMS_READ:
            searched = sys.maxsize if topic.endswith(LATCHED) else _SEARCHED
            key = _decoder(opened, topic, edges_of)
        elif kind in (*_HELD, _SCENE):
            searched = searched or 1
        for message in islice(self._before(members, start_ns), searched):
            latest.setdefault(key(message.payload), message)
        if kind == _SCENE:
            is_lasting = _decoder(opened, topic, lambda message: any(map(_is_lasting, message.entities)))
            latest = {at: message for at, message in latest.items() if is_lasting(message.payload)}
        return start_ns, [*latest.values()][::-1]

    def _before(self, members: Sequence[_Member], start_ns: int) -> Iterator[log.Message]:
        """The messages of a channel before a time, the latest first."""

        def of(member: _Member, own_start: int) -> Iterator[log.Message]:
            try:
                for message in member.part.snapshot.messages.before(member.channel.id, start_ns):
                    if message.t_ns >= own_start:
                        yield message
            except Damaged as error:
                where = f"{member.part.path}: {error}"
                self._lost.append(f"{where}; messages of {member.channel.topic} from before the start are left out")

        return heapq.merge(*map(of, members, self._own_starts(members)), key=lambda message: message.t_ns, reverse=True)

    def _first_picture_ns(self, members: Sequence[_Member], start_ns: int) -> int:
        """The time of the picture that decoding of the first one after the start begins with."""
        first_ns = [start_ns]
        for member in members:
            with suppress(McaptrackError):  # copying says so, or viewers
                first_ns.append(Pictures(self._logs[member.number], member.channel.topic).entry_ns(start_ns))
        return min(first_ns)


def _conflicts(logs: Sequence[log.Log], topics: Collection[str]) -> set[str]:
    """The channels of results that several logs have of their own, and what was made from them, with a warning."""
    origins: dict[str, list[Provenance]] = {}
    for opened in logs:
        for topic in opened.channels.keys() & {*topics}:
            if (how := provenance_of(opened, topic)) and how.transform != INGEST:
                origins.setdefault(topic, []).append(how)
    out: set[str] = set()
    more = {topic for topic, those in origins.items() if len({_read_digest(how.digest)[0] for how in those}) > 1}
    while not more <= out:
        out |= more
        more = {topic for topic, those in origins.items() if any(not out.isdisjoint(how.made_from()) for how in those)}
    if out:
        text = "are left out: each log has its own, with its own ids; run the new log to make those of all"
        warn(f"results of {len(logs)} logs in {list_names(sorted(out))} {text}", "left-out")
    return out


def needed(opened: log.Log, topics: Collection[str]) -> set[str]:
    """Return topics with those that tell whether results in them are up to date: what they were compared with, and the
    ground planes; of rows only, without pictures.
    """
    out, todo = set[str](), [*topics]
    while todo:
        topic = todo.pop()
        channel = opened.channels.get(topic)
        if topic in out or channel is None or not (channel.schema or topic in topics):
            continue
        out.add(topic)
        how = Provenance.from_metadata(channel.metadata)
        todo += how.references if how else ()
        if how and "ground_planes" in how.parameters:
            todo.append(camera_at(opened, name_above(chain_of(opened, topic)[-1])).ground_plane)
    return {*topics} | out


def _decoder(opened: log.Log, topic: str, convert: Callable[[Any], object]) -> Callable[[bytes], object]:
    """A function that decodes messages of a channel; of those that can't be decoded it returns the bytes."""
    with suppress(McaptrackError):
        decode = decoder_with_errors(message_type_of(opened, topic), convert)

        def decoded(payload: bytes) -> object:
            with suppress(McaptrackError):
                return decode(payload)
            return payload

        return decoded
    return bytes


def _is_lasting(entity: Any) -> bool:
    """Whether an entity of a scene stays until it is replaced."""
    names = ("seconds", "nanos", "sec", "nsec", "nanosec", "secs", "nsecs")
    return not any(getattr(entity.lifetime, name, 0) for name in names)


def _latched(metadata: Mapping[str, str]) -> int:
    """The most messages that a late subscriber gets: the last ones; 0 if the channel isn't latched."""
    profiles = metadata.get("offered_qos_profiles", "")
    publishers = len(_LATCHING.findall(profiles)) + (metadata.get("latching") == "1")
    is_every = publishers > 1 or re.search(r"history:\s*(2\b|keep_all)", profiles)
    depth = _SEARCHED if is_every else max(1, *map(int, _DEPTH.findall(profiles)), 1)
    return min(depth, _SEARCHED) if publishers else 0
