"""Events as text, for the log panel of viewers.

Rows that describe one thing become one message: a track that never matches a person, a person and a track that lose
each other. Events shorter than a second have the level DEBUG.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from mcaptrack import foxglove
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import TRACKS, EventKind, Frame
from mcaptrack.schema.classes import UNKNOWN, class_name, is_person, majority
from mcaptrack.schema.framing import join_frames

__all__ = ["PEOPLE", "SUFFIX", "describe", "nouns_of"]

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
_PERSON, _OBJECT = "person", "object"


class Nouns(NamedTuple):
    """Nouns for objects of the ground truth and for tracks, by id; ``usual`` is that of all others."""

    ground_truth: Mapping[int, str] = {}
    tracks: Mapping[int, str] = {}
    usual: str = _PERSON


#: The nouns where all objects are people.
PEOPLE: Final = Nouns()


def nouns_of(
    ground_truth: Sequence[Frame], tracks: Sequence[Frame], classes: tuple[Mapping[int, str], Mapping[int, str]]
) -> Nouns:
    """The nouns for objects: names of their classes, where any is no person. ``classes`` as in `find_events`.

    ``ground_truth`` and ``tracks`` are frames of rows; what is no person in them has another noun.
    """
    sides = [_class_names(frames, names) for frames, names in zip((ground_truth, tracks), classes, strict=True)]
    names = {name for side in sides for name in side.values()}
    if names <= {_PERSON, _OBJECT}:
        return PEOPLE
    return Nouns(sides[0], sides[1], _OBJECT)


def _class_names(frames: Sequence[Frame], names: Mapping[int, str]) -> dict[int, str]:
    """The name of the class of each id."""
    joined = join_frames(TRACKS, frames)
    ids, which = np.unique(joined.rows["track_id"], return_inverse=True)
    numbers = majority(which, joined.rows["class_id"], len(ids))
    nouns = {number: _noun(number, names) for number in np.unique(numbers).tolist()}
    return {track: nouns[number] for track, number in zip(ids.tolist(), numbers.tolist(), strict=True)}


def _noun(number: int, names: Mapping[int, str]) -> str:
    name = class_name(number, names)
    return _PERSON if is_person(name) else _OBJECT if number == UNKNOWN and number not in names else name


def log_messages(
    events: Sequence[Frame], tracks_topic: str, start_ns: int, frame_interval_s: float, nouns: Nouns = PEOPLE
) -> Iterator[tuple[int, int, bytes]]:
    """foxglove.Log messages (time, frame, payload) of all events.

    Times in the text count from ``start_ns``; ``frame_interval_s`` is the usual time between two compared frames;
    ``nouns`` are those for objects.
    """
    all_events = [(frame.t_ns, row) for frame in events for row in frame.rows]
    groups = _EventGroups(all_events, nouns)
    for frame in events:
        for row in frame.rows:
            where = f"at {(frame.t_ns - start_ns) / NS_PER_S:.2f} s{_place(row)}"
            message = groups.text_of(frame.t_ns, row, where, frame_interval_s)
            if message is not None:
                level, text = message
                yield frame.t_ns, frame.index, foxglove.pack_log(frame.t_ns, level, tracks_topic, text)


class _EventGroups:
    """Finds rows of events that describe the same thing."""

    def __init__(self, all_events: Sequence[tuple[int, Any]], nouns: Nouns) -> None:
        self._nouns = nouns
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
        text, lasts = describe(row, where, frame_interval_s, self._nouns), float(row["duration_s"])
        if kind is EventKind.FALSE_TRACK:
            if (t_ns, before, track) in self._apart_s:
                return None
            if is_unmatched:
                noun = self._nouns.tracks.get(track, self._nouns.usual)
                text = f"track {track} matches no {noun} while it exists, {_span(row, frame_interval_s)} {where}"
        elif kind is EventKind.MISS:
            person = int(row["truth_id"])
            track_s = self._apart_s.get((t_ns, person, before))
            if track_s is not None:
                noun = self._nouns.ground_truth.get(person, self._nouns.usual)
                text = f"{noun} {person} and track {before} are apart {_span(row, frame_interval_s)} {where}"
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


def describe(event: Any, where: str, frame_interval_s: float, nouns: Nouns = PEOPLE) -> str:
    """One row of events as text; ``frame_interval_s`` is the usual time between two frames.

    ``where`` is the place and the time as the end of a clause, and ``nouns`` are those for objects.
    """
    track, before = f"track {event['track_id']}", int(event["previous_id"])
    truth_id, source = int(event["truth_id"]), int(event["source_id"])
    person = f"{nouns.ground_truth.get(truth_id, nouns.usual)} {truth_id}"
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
            was = f", before it was {nouns.ground_truth.get(before, nouns.usual)} {before}" if before >= 0 else ""
            noun = nouns.tracks.get(int(event["track_id"]), nouns.usual)
            return f"{track} matches no {noun} {_span(event, frame_interval_s)} {where}{was}"
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
