"""Addresses that open logs in web viewers."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final, NamedTuple
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.evaluation.event_text import PEOPLE, Nouns, describe, nouns_of
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import COUNTS, EVENT_KINDS, EVENTS, TRACKS, EventKind
from mcaptrack.schema.classes import class_names, is_person
from mcaptrack.schema.framing import frame_times, join_frames, row_ends
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import members_of, scenes_of
from mcaptrack.sources.video import is_video_codec

LICHTBLICK: Final = "https://lichtblick-suite.github.io/lichtblick/"
FOXGLOVE: Final = "https://app.foxglove.dev/"


def viewer_links(
    logs: Sequence[str], layout: str | None, lichtblick: str = LICHTBLICK, at_ns: int | None = None
) -> dict[str, str]:
    """Addresses that open logs in Lichtblick, with a layout, and in Foxglove, where layouts are imported by hand.

    Viewers seek to the log time ``at_ns``, if it is given and a calendar has it.
    """
    sources = [("ds", "remote-file"), *(("ds.url", address) for address in logs)]
    when = utc_text(at_ns) if at_ns is not None else None
    time = [("time", when)] if when else []
    with_layout = [*sources, ("layoutUrl", layout)] if layout else sources
    return {
        "Lichtblick": f"{lichtblick.rstrip('/')}/?{urlencode([*with_layout, *time])}",
        "Foxglove": f"{FOXGLOVE}~/view?{urlencode([*sources, *time])}",
    }


def utc_text(t_ns: int) -> str | None:
    """A time in ns since 1970 as RFC 3339 has it; None for years beyond 9999.

    Examples
    --------
    >>> utc_text(34_000_000_001)
    '1970-01-01T00:00:34.000000001Z'
    """
    seconds, rest = divmod(t_ns, NS_PER_S)
    try:
        whole = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError, ValueError):
        return None
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"


# Moments of a log that are worth a look: identity switches and repairs, and when there is something to see at all.


#: The kinds of events that change identities.
KINDS: Final = (EventKind.SWITCH, EventKind.JOINED, EventKind.PARTED)
#: Viewers open so long before an event, or before the time without detections that it ended, so that it is seen when
#: they play.
LEAD_S: Final = 1.0
#: The layout that shows the tracks before and after a repair.
EVENT_LAYOUT: Final = "comparing"
#: The tracks that viewers show first, below the name of a camera; the first that has events or people is opened.
_BEST: Final = ("retracks", "tracks")
_NO_TRACKS: Final = (np.empty(0, np.int64), np.empty(0, np.int64))


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
        The address that opens the log in Lichtblick, a second before the track was lost; "" until the log is served.
    unseen_s : float
        The time without detections before it.

    """

    event: int
    t_ns: int
    topic: str
    kind: str
    text: str
    link: str = ""
    unseen_s: float = 0.0

    def opens_ns(self, start_ns: int) -> int:
        """Return the log time in ns at which viewers open, in a log with this start."""
        return max(self.t_ns - round((LEAD_S + self.unseen_s) * NS_PER_S), start_ns)


def find_moments(opened: log.Log) -> list[LinkedEvent]:
    """Return the identity switches and repairs in the channels of events of a log, in the order of time.

    Cameras that were fused to a scene are left out: viewers show the ids of the scene on their pictures. So are
    channels that can't be read, with a warning.
    """
    moments: list[LinkedEvent] = []
    fused = tuple(f"{member}/" for scene in scenes_of(opened) for member in members_of(opened, scene))
    for topic, channel in sorted(opened.channels.items()):
        if not channel.holds(EVENTS) or topic.startswith(fused):
            continue
        provenance = Provenance.from_metadata(channel.metadata)
        tracks = provenance.input if provenance else topic.removesuffix("/events")
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
            kind, unseen_s = EVENT_KINDS[EventKind(int(row["kind"]))], float(np.nan_to_num(row["duration_s"]))
            moments.append(LinkedEvent(0, t_ns, tracks, kind, text, unseen_s=unseen_s))
    moments.sort(key=lambda moment: (moment.t_ns, moment.topic))
    return [moment._replace(event=number) for number, moment in enumerate(moments, 1)]


def event_of(opened: log.Log, events: Sequence[LinkedEvent], number: int) -> LinkedEvent:
    """Return an event of a log by its number, from 1. Raises McaptrackError if there is none."""
    if number > len(events):
        all_events = f"the events 1 to {len(events)}" if events else "no identity switches and repairs"
        raise McaptrackError(f"{opened.path} has {all_events}, not event {number}")
    return events[number - 1]


def best_tracks(moments: Sequence[LinkedEvent]) -> str:
    """Return the tracks with events that viewers show first; "" without any."""
    topics = sorted({moment.topic for moment in moments})
    return next((topic for name in _BEST for topic in topics if topic.endswith(f"/{name}")), "")


def _nouns(opened: log.Log, topic: str) -> Nouns:
    """Return the nouns for tracked objects; their rows are read only if a class is no person."""
    if not opened.holds(topic, TRACKS):
        return PEOPLE
    names = class_names(opened.channels[topic].metadata)
    if all(is_person(name) for name in names.values()):
        return PEOPLE
    return nouns_of((), opened.frame_columns(topic, TRACKS), ({}, names))


def opening_moment(opened: log.Log, moments: Sequence[LinkedEvent]) -> tuple[int, str]:
    """Return the log time in ns at which viewers open, and why, as text.

    It is before the first event of the tracks that layouts show; without any, the first time with at least
    half as many of them as there are at most; without any tracks, the start of the log.
    """
    best = best_tracks(moments)
    first = next((moment for moment in moments if moment.topic == best), None)
    if first is not None:
        return first.opens_ns(opened.start_ns), f"before event {first.event} ({first.text})"
    for name in _BEST:
        for topic in sorted(opened.channels):
            t_ns, tracked = _tracks_over_time(opened, topic) if topic.endswith(f"/{name}") else _NO_TRACKS
            if tracked.any():
                at = int(np.argmax(2 * tracked >= tracked.max()))
                return int(t_ns[at]), f"where there are {tracked[at]} of at most {tracked.max()} tracks"
    if moments:
        return moments[0].opens_ns(opened.start_ns), f"before event 1 ({moments[0].text})"
    return opened.start_ns, "its start: nothing is tracked in it yet"


def _tracks_over_time(opened: log.Log, topic: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return times in ns and the number of tracks at each: as they were counted, or else of the tracks themselves."""
    if opened.holds(f"{topic}/counts", COUNTS):
        joined = join_frames(COUNTS, opened.frame_columns(f"{topic}/counts", COUNTS))
        return joined.row_ns, joined.rows["tracked"].astype(np.int64)
    if not opened.holds(topic, TRACKS):
        return _NO_TRACKS
    frames = opened.frame_columns(topic, TRACKS)
    return frame_times(frames), np.diff(row_ends(frames))


def seconds_of(opened: log.Log, t_ns: int) -> float:
    """Return a log time as seconds since the start of the log."""
    return (t_ns - opened.start_ns) / NS_PER_S


def video_formats(opened: log.Log) -> dict[str, str]:
    """Return the channels of pictures that depend on earlier ones, with their codecs, by topic."""
    formats = {}
    for topic, channel in sorted(opened.channels.items()):
        if not foreign.holds_pictures(channel) or not channel.messages:
            continue
        try:
            first = next(picture for _, picture in foreign.pictures(opened, topic) if not picture.error)
        except (McaptrackError, StopIteration):
            continue  # viewers say so themselves
        if is_video_codec(first.format):
            formats[topic] = first.format
    return formats
