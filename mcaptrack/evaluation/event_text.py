"""Events as text, for the log panel of viewers.

Rows that describe one thing become one message: a track that never matches a person, a person and a track that lose
each other. Events shorter than a second have the level DEBUG.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from typing import Any, Final, Literal

from mcaptrack import foxglove
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import EventKind, Frame

Level = Literal["DEBUG", "INFO", "WARNING", "ERROR"]

#: The suffix of the channel with these messages, after the topic of events.
SUFFIX: Final = "/view/log"
_LEVELS: Final[dict[EventKind, Level]] = {
    EventKind.BIRTH: "INFO",
    EventKind.END: "INFO",
    EventKind.MISS: "WARNING",
    EventKind.FALSE_TRACK: "WARNING",
    EventKind.SWITCH: "ERROR",
    EventKind.JOINED: "WARNING",
    EventKind.PARTED: "WARNING",
}
_BRIEF_S: Final = 1.0


def log_messages(
    events: Sequence[Frame], tracks_topic: str, start_ns: int, frame_interval_s: float
) -> Iterator[tuple[int, int, bytes]]:
    """foxglove.Log messages (time, frame, payload) of all events.

    Times in the text count from ``start_ns``; ``frame_interval_s`` is the usual time between two compared frames.
    """
    all_events = [(frame.t_ns, row) for frame in events for row in frame.rows]
    groups = _EventGroups(all_events)
    for frame in events:
        for row in frame.rows:
            where = f"at {(frame.t_ns - start_ns) / NS_PER_S:.2f} s{_place(row)}"
            found = groups.text_of(frame.t_ns, row, where, frame_interval_s)
            if found is not None:
                level, text = found
                yield frame.t_ns, frame.index, foxglove.pack_log(frame.t_ns, level, tracks_topic, text)


class _EventGroups:
    """Finds rows of events that describe the same thing."""

    def __init__(self, all_events: Sequence[tuple[int, Any]]) -> None:
        of_kind: dict[int, list[tuple[int, Any]]] = {kind: [] for kind in EventKind}
        for t_ns, row in all_events:
            of_kind[int(row["kind"])].append((t_ns, row))
        #: The duration of the tracks that ended.
        self._life_s = {int(row["track_id"]): float(row["duration_s"]) for _, row in of_kind[EventKind.END]}
        sizes = {int(row["track_id"]): int(row["frames"]) for _, row in of_kind[EventKind.END]}
        false, missed = of_kind[EventKind.FALSE_TRACK], of_kind[EventKind.MISS]
        #: Tracks without a match in all of their frames.
        self._unmatched = {int(row["track_id"]) for _, row in false if sizes.get(int(row["track_id"])) == row["frames"]}
        misses = {(t_ns, int(row["truth_id"]), int(row["previous_id"])) for t_ns, row in missed}
        lost = {(t_ns, int(row["previous_id"]), int(row["track_id"])): float(row["duration_s"]) for t_ns, row in false}
        #: Time, person and track where a pair loses each other, and how long the track stays without a match.
        self._apart_s = {key: seconds for key, seconds in lost.items() if key in misses}
        joins = {
            (t_ns, int(row["previous_id"]), int(row["source_id"])): int(row["track_id"])
            for t_ns, row in of_kind[EventKind.JOINED]
        }
        #: Time and sources before and after of tracks that exchanged sources, and the other track.
        self._swapped = {
            (t_ns, before, after): joins[t_ns, after, before]
            for t_ns, before, after in joins
            if (t_ns, after, before) in joins
        }

    def text_of(self, t_ns: int, row: Any, where: str, frame_interval_s: float) -> tuple[Level, str] | None:
        """Level and text of an event; None if the text of another event includes it."""
        kind, track, before = EventKind(int(row["kind"])), int(row["track_id"]), int(row["previous_id"])
        is_unmatched = track in self._unmatched
        if kind in (EventKind.BIRTH, EventKind.END):
            life_s = self._life_s.get(track, _BRIEF_S)
            if is_unmatched or (kind is EventKind.END and life_s < _BRIEF_S):
                return None
            if life_s < _BRIEF_S:
                return "DEBUG", f"track {track} exists for {_seconds(life_s)} {where}"
        text, lasts = describe(row, where, frame_interval_s), float(row["duration_s"])
        if kind is EventKind.FALSE_TRACK:
            if (t_ns, before, track) in self._apart_s:
                return None
            if is_unmatched:
                text = f"track {track} matches no person while it exists, {_span(row, frame_interval_s)} {where}"
        elif kind is EventKind.MISS:
            person = int(row["truth_id"])
            track_s = self._apart_s.get((t_ns, person, before))
            if track_s is not None:
                text = f"person {person} and track {before} are apart {_span(row, frame_interval_s)} {where}"
                lasts = max(lasts, track_s)
        elif kind is EventKind.JOINED:
            source = int(row["source_id"])
            other = self._swapped.get((t_ns, before, source))
            if other is not None and other < track:
                return None
            if other is not None:
                text = f"tracks {track} and {other}: the tracker swapped its {before} and {source} {where}"
        is_brief = kind in (EventKind.MISS, EventKind.FALSE_TRACK) and lasts < _BRIEF_S
        return "DEBUG" if is_brief else _LEVELS[kind], text


def describe(event: Any, where: str, frame_interval_s: float) -> str:
    """One row of events as text; ``frame_interval_s`` is the usual time between two frames."""
    track, before = f"track {event['track_id']}", int(event["previous_id"])
    person, source = f"person {event['truth_id']}", int(event["source_id"])
    lasts = float(event["duration_s"])
    match EventKind(int(event["kind"])):
        case EventKind.BIRTH:
            return f"{track} begins {where}"
        case EventKind.END:
            return f"{track} ends {where}, after {_seconds(lasts)}"
        case EventKind.SWITCH:
            return f"{person}: track {before} became {track} {where}{_unseen(lasts)}"
        case EventKind.MISS:
            had = f", last tracked as {before}" if before >= 0 else ""
            return f"{person} is missed {_span(event, frame_interval_s)} {where}{had}"
        case EventKind.FALSE_TRACK:
            was = f", before it was person {before}" if before >= 0 else ""
            return f"{track} matches no person {_span(event, frame_interval_s)} {where}{was}"
        case EventKind.JOINED:
            return f"{track} joins the tracker's {before} and {source} {where}{_unseen(lasts)}"
        case EventKind.PARTED:
            return f"{track} takes over the tracker's {source}, which was track {before}, {where}"


def _span(event: Any, frame_interval_s: float) -> str:
    """The duration, and the number of frames if it is not all frames of that time."""
    frames, lasts = int(event["frames"]), float(event["duration_s"])
    total = round(lasts / frame_interval_s) if frame_interval_s else frames
    return f"in {frames} of {total} frames over {_seconds(lasts)}" if total > frames else f"for {_seconds(lasts)}"


def _unseen(seconds: float) -> str:
    return f", {_seconds(seconds)} unseen" if seconds > 0 else ""


def _seconds(seconds: float) -> str:
    return f"{seconds:.{1 if seconds >= 0.1 else 2}f} s"


def _place(event: Any) -> str:
    for x, y, unit in (("x_m", "y_m", "m"), ("x_px", "y_px", "px")):
        if not isnan(event[x]) and not isnan(event[y]):
            digits = 1 if unit == "m" else 0
            return f", ({event[x]:.{digits}f}, {event[y]:.{digits}f}) {unit}"
    return ""
