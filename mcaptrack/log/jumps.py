"""Jumps of the clock of a log: long times without a message of any channel, found by the index.

Letters: S spans of times, J jumps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.clocks import JUMP_S, NS_PER_S, seconds_to_ns
from mcaptrack.log.chunks import Entries, read_index_entries

if TYPE_CHECKING:
    from mcaptrack.log.reader import Log

_JUMP_NS: Final = seconds_to_ns(JUMP_S)
#: A log with more jumps than one in so many messages is slow, as a time lapse is: its clock doesn't jump.
_MESSAGES_EACH: Final = 10
#: Units of long times in seconds, the longest first.
_UNITS: Final = ((365.25 * 86_400, "years"), (86_400.0, "days"), (3_600.0, "hours"), (60.0, "minutes"))


class ClockJump(NamedTuple):
    """A time without messages: those of the last message before it and of the first one after it, in nanoseconds."""

    before_ns: int
    after_ns: int


Span = tuple[int, int]


def spans_of(span: Span, entries: Mapping[int, Entries]) -> list[Span]:
    """The spans of the messages of a chunk, none of which contains a jump."""
    if span[1] - span[0] <= _JUMP_NS or not entries:
        return [span]
    t_ns = np.unique(np.concatenate([listed[:, 0] for listed in entries.values()]))
    cuts = np.flatnonzero(np.diff(t_ns) > _JUMP_NS)
    return list(zip(t_ns[[0, *(cuts + 1)]].tolist(), t_ns[[*cuts, -1]].tolist(), strict=True))


def joined(one: Span, two: Span) -> Span | None:
    """The span of both; None if there is a jump between them."""
    both = min(one[0], two[0]), max(one[1], two[1])
    return both if max(one[0], two[0]) - min(one[1], two[1]) <= _JUMP_NS else None


def jumps_between(spans: Iterable[Span], messages: int) -> list[ClockJump]:
    """The jumps (J) between spans (S) of the messages of a log, in any order."""
    jumps: list[ClockJump] = []
    last_ns: int | None = None
    for first, last in sorted(spans):
        if last_ns is not None and first - last_ns > _JUMP_NS:
            jumps.append(ClockJump(last_ns, first))
        last_ns = last if last_ns is None else max(last_ns, last)
    return jumps if len(jumps) * _MESSAGES_EACH <= messages else []


def clock_jumps(opened: Log) -> list[ClockJump]:
    """The jumps of the clock of a log in the order of time. Raises McaptrackError if its index is damaged."""
    with opened.snapshot.reporting_damage():
        spans = [span for part in opened.parts for span in _spans(part)]
    return jumps_between(spans, sum(sum(part.index.counts.values()) for part in opened.parts))


def jumps_text(jumps: list[ClockJump], start_ns: int) -> str:
    """The jumps as a clause: how long the longest is, and when it begins in the log; "" if there are none."""
    if not jumps:
        return ""
    longest = max(jumps, key=lambda jump: jump.after_ns - jump.before_ns)
    after_s = (longest.before_ns - start_ns) / NS_PER_S
    words = f"there is no message for {_long((longest.after_ns - longest.before_ns) / NS_PER_S)} after {after_s:.3f} s"
    if len(jumps) > 1:
        words += f", the longest of {len(jumps)} gaps of more than {JUMP_S:g} s"
    return words


def _long(seconds: float) -> str:
    size, name = next((unit for unit in _UNITS if seconds >= unit[0]), (1.0, "s"))
    return f"{seconds / size:.1f} {name}"


def _spans(part: Log) -> Iterator[Span]:
    index = part.index
    for chunk in index.chunks:
        span, entries = (chunk.start_ns, chunk.end_ns), dict[int, Entries]()
        if span[1] - span[0] > _JUMP_NS:
            for channel, at in chunk.message_index_offsets.items():
                listed = read_index_entries(part.snapshot.source, at, channel) if at else None
                entries[channel] = index.entries[chunk.offset][channel] if listed is None else listed
            entries = {channel: listed for channel, listed in entries.items() if len(listed)}
        if chunk.message_index_offsets:
            yield from spans_of(span, entries)
    loose = {channel: listed for channel, listed in index.loose.items() if len(listed)}
    if loose:
        edges = [int(edge) for listed in loose.values() for edge in (listed[:, 0].min(), listed[:, 0].max())]
        yield from spans_of((min(edges), max(edges)), loose)
