"""Events in plain words, as messages for a viewer's panel of logs: a person jumps from one to the next.

What several rows say of one thing is one message: a track that is nobody from its beginning to its end, a person and
a track that lose each other. What lasts less than a second is for those who look closely (level DEBUG).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from typing import Any, Final, Literal

from mcaptrack import foxglove
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import EventKind, Frame

Level = Literal["DEBUG", "INFO", "WARNING", "ERROR"]

#: Below the topic of events: the same in words.
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
    events: Sequence[Frame], tracks_topic: str, start_ns: int, usual_s: float
) -> Iterator[tuple[int, int, bytes]]:
    """foxglove.Log messages (time, frame, payload) of all events.

    Seconds in the words count from ``start_ns``; ``usual_s`` is what lies between two frames that were compared.
    """
    happened = [(frame.t_ns, row) for frame in events for row in frame.rows]
    together = _Together(happened)
    for frame in events:
        for row in frame.rows:
            where = f"at {(frame.t_ns - start_ns) / NS_PER_S:.2f} s{_place(row)}"
            said = together.say(frame.t_ns, row, where, usual_s)
            if said is not None:
                level, words = said
                yield frame.t_ns, frame.index, foxglove.pack_log(frame.t_ns, level, tracks_topic, words)


class _Together:
    """Which of the events, with their times, say the same of one thing."""

    def __init__(self, happened: Sequence[tuple[int, Any]]) -> None:
        of_kind: dict[int, list[tuple[int, Any]]] = {kind: [] for kind in EventKind}
        for t_ns, row in happened:
            of_kind[int(row["kind"])].append((t_ns, row))
        #: How long tracks were there, of those that ended.
        self._life_s = {int(row["track_id"]): float(row["duration_s"]) for _, row in of_kind[EventKind.END]}
        sizes = {int(row["track_id"]): int(row["frames"]) for _, row in of_kind[EventKind.END]}
        false, missed = of_kind[EventKind.FALSE_TRACK], of_kind[EventKind.MISS]
        #: Tracks that were nobody in all of their frames.
        self._ghosts = {int(row["track_id"]) for _, row in false if sizes.get(int(row["track_id"])) == row["frames"]}
        misses = {(t_ns, int(row["truth_id"]), int(row["previous_id"])) for t_ns, row in missed}
        lost = {(t_ns, int(row["previous_id"]), int(row["track_id"])): float(row["duration_s"]) for t_ns, row in false}
        #: Time, person and track of those that lost each other, and how long the track is nobody.
        self._apart_s = {key: seconds for key, seconds in lost.items() if key in misses}
        joins = {
            (t_ns, int(row["previous_id"]), int(row["source_id"])): int(row["track_id"])
            for t_ns, row in of_kind[EventKind.JOINED]
        }
        #: Time, and sources before and after, of tracks that exchanged these with another track, and which that is.
        self._swapped = {
            (t_ns, before, after): joins[t_ns, after, before]
            for t_ns, before, after in joins
            if (t_ns, after, before) in joins
        }

    def say(self, t_ns: int, row: Any, where: str, usual_s: float) -> tuple[Level, str] | None:
        """Level and words of an event; None where those of another say it."""
        kind, track, before = EventKind(int(row["kind"])), int(row["track_id"]), int(row["previous_id"])
        is_ghost = track in self._ghosts
        if kind in (EventKind.BIRTH, EventKind.END):
            life_s = self._life_s.get(track, _BRIEF_S)
            if is_ghost or (kind is EventKind.END and life_s < _BRIEF_S):
                return None
            if life_s < _BRIEF_S:
                return "DEBUG", f"track {track} is there for {_seconds(life_s)} {where}"
        words, lasts = describe(row, where, usual_s), float(row["duration_s"])
        if kind is EventKind.FALSE_TRACK:
            if (t_ns, before, track) in self._apart_s:
                return None
            if is_ghost:
                words = f"track {track} is nobody while it lasts, {_span(row, usual_s)} {where}"
        elif kind is EventKind.MISS:
            person = int(row["truth_id"])
            track_s = self._apart_s.get((t_ns, person, before))
            if track_s is not None:
                words = f"person {person} and track {before} are apart {_span(row, usual_s)} {where}"
                lasts = max(lasts, track_s)
        elif kind is EventKind.JOINED:
            source = int(row["source_id"])
            other = self._swapped.get((t_ns, before, source))
            if other is not None and other < track:
                return None
            if other is not None:
                words = f"tracks {track} and {other}: the tracker swapped its {before} and {source} {where}"
        is_brief = kind in (EventKind.MISS, EventKind.FALSE_TRACK) and lasts < _BRIEF_S
        return "DEBUG" if is_brief else _LEVELS[kind], words


def describe(event: Any, where: str, usual_s: float) -> str:
    """One row of events in plain words; ``usual_s`` is what lies between two frames."""
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
            had = f", track {before} had them" if before >= 0 else ""
            return f"{person} is missed {_span(event, usual_s)} {where}{had}"
        case EventKind.FALSE_TRACK:
            was = f", it was person {before}" if before >= 0 else ""
            return f"{track} is nobody {_span(event, usual_s)} {where}{was}"
        case EventKind.JOINED:
            return f"{track} joins the tracker's {before} and {source} {where}{_unseen(lasts)}"
        case EventKind.PARTED:
            return f"{track} takes over the tracker's {source}, which was track {before}, {where}"


def _span(event: Any, usual_s: float) -> str:
    """How long, and in how many frames where not in all of them."""
    frames, lasts = int(event["frames"]), float(event["duration_s"])
    total = round(lasts / usual_s) if usual_s else frames
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
