"""Moments of a log that are worth a look: identity switches and repairs, and when there is something to see at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.evaluation.event_text import PEOPLE, Nouns, describe, nouns_of
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import COUNTS, EVENT_KINDS, EVENTS, TRACKS, EventKind
from mcaptrack.schema.classes import class_names, is_person
from mcaptrack.schema.framing import join_frames
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.video import is_video_codec

#: The kinds of events that change identities.
KINDS: Final = (EventKind.SWITCH, EventKind.JOINED, EventKind.PARTED)
#: Viewers open so long before an event, so that it is seen when they play.
LEAD_S: Final = 1.0
#: The tracks that viewers show first, below the name of a camera; the first that has events or people is opened.
_BEST: Final = ("retracks", "tracks")


class LinkedEvent(NamedTuple):
    """An identity switch or a repair, and the address that opens it.

    Attributes
    ----------
    event : int
        Its number in the log, from 1, in the order of time.
    t_ns : int
        Log time.
    topic : str
        The tracks that it happened to.
    kind : str
        "identity switch", "joined" or "parted".
    text : str
        What happened, and when in seconds of the log.
    link : str
        The address that opens the log in Lichtblick, a second before; "" until the log is served.

    """

    event: int
    t_ns: int
    topic: str
    kind: str
    text: str
    link: str = ""


def find_moments(opened: log.Log) -> list[LinkedEvent]:
    """Return the identity switches and repairs in the channels of events of a log, in the order of time.

    Channels that can't be read are left out, with a warning.
    """
    found: list[tuple[int, str, str, str]] = []
    for topic, channel in sorted(opened.channels.items()):
        if not channel.holds(EVENTS):
            continue
        made = Provenance.from_metadata(channel.metadata)
        tracks = made.input if made else topic.removesuffix("/events")
        try:
            joined = join_frames(EVENTS, opened.frame_columns(topic, EVENTS))
            nouns = _nouns(opened, tracks)
        except DamagedError:
            raise
        except McaptrackError as error:
            warn(f"{opened.path}: no links to the events of {tracks}: {error}", "left-out")
            continue
        for at in np.flatnonzero(np.isin(joined.rows["kind"], KINDS)).tolist():
            row = joined.rows[at]
            t_ns = int(joined.row_ns[at])
            text = describe(row, f"at {seconds_of(opened, t_ns):.1f} s", 0.0, nouns)
            found.append((t_ns, tracks, EVENT_KINDS[EventKind(int(row["kind"]))], text))
    found.sort(key=lambda one: (one[0], one[1]))
    return [LinkedEvent(number, *one) for number, one in enumerate(found, 1)]


def _nouns(opened: log.Log, topic: str) -> Nouns:
    """Return the nouns for tracked objects; their rows are read only if a class is no person."""
    channel = opened.channels.get(topic)
    if channel is None or not channel.holds(TRACKS):
        return PEOPLE
    names = class_names(channel.metadata)
    if all(is_person(name) for name in names.values()):
        return PEOPLE
    return nouns_of((), opened.frame_columns(topic, TRACKS), ({}, names))


def opening_moment(opened: log.Log, moments: Sequence[LinkedEvent]) -> tuple[int, str]:
    """Return the log time in ns at which viewers open, and why, as text.

    It is a second before the first event of the tracks that layouts show; without any, the first time with at least
    half as many of them as there are at most; without any tracks, the start of the log.
    """
    for name in _BEST:
        first = next((one for one in moments if one.topic.endswith(f"/{name}")), None)
        if first is not None:
            return before(first.t_ns, opened.start_ns), f"a second before event {first.event} ({first.text})"
    for name in _BEST:
        for topic, channel in sorted(opened.channels.items()):
            if topic.endswith(f"/{name}/counts") and channel.holds(COUNTS):
                joined = join_frames(COUNTS, opened.frame_columns(topic, COUNTS))
                tracked = joined.rows["tracked"].astype(np.int64)
                if tracked.any():
                    at = int(np.argmax(2 * tracked >= tracked.max()))
                    return int(joined.row_ns[at]), f"where there are {tracked[at]} of at most {tracked.max()} tracks"
    if moments:
        return before(moments[0].t_ns, opened.start_ns), f"a second before event 1 ({moments[0].text})"
    return opened.start_ns, "its start: nothing is tracked in it yet"


def seconds_of(opened: log.Log, t_ns: int) -> float:
    """Return a log time as seconds since the start of the log."""
    return (t_ns - opened.start_ns) / NS_PER_S


def before(t_ns: int, start_ns: int) -> int:
    """Return the log time in ns at which viewers open to show an event, in a log with this start."""
    return max(t_ns - round(LEAD_S * NS_PER_S), start_ns)


def video_formats(opened: log.Log) -> dict[str, str]:
    """Return the channels of pictures that depend on earlier ones, with their codecs, by topic."""
    found = {}
    for topic, channel in sorted(opened.channels.items()):
        if not foreign.holds_pictures(channel) or not channel.messages:
            continue
        try:
            _, first = next(iter(foreign.pictures(opened, topic)))
        except (McaptrackError, StopIteration):
            continue  # viewers say so themselves
        if is_video_codec(first.format):
            found[topic] = first.format
    return found
