"""Events in plain words, as messages for a viewer's panel of logs: a person jumps from one to the next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from typing import Any, Final

from mcaptrack import foxglove
from mcaptrack.clock import NS_PER_S
from mcaptrack.schema import EventKind, Frame

#: Below the topic of events: the same in words.
SUFFIX: Final = "/view/log"
LEVELS: Final = {
    EventKind.BIRTH: "INFO",
    EventKind.END: "INFO",
    EventKind.MISS: "WARNING",
    EventKind.FALSE_TRACK: "WARNING",
    EventKind.JOINED: "WARNING",
    EventKind.PARTED: "WARNING",
    EventKind.SWITCH: "ERROR",
}


def log_messages(events: Sequence[Frame], tracks_topic: str, start_ns: int) -> Iterator[tuple[int, int, bytes]]:
    """A foxglove.Log message (time, frame, payload) for each event; seconds in the words count from ``start_ns``."""
    for frame in events:
        for row in frame.rows:
            words = describe(row, (frame.t_ns - start_ns) / NS_PER_S)
            level = LEVELS[EventKind(int(row["kind"]))]
            yield frame.t_ns, frame.index, foxglove.pack_log(frame.t_ns, level, tracks_topic, words)


def describe(event: Any, at_s: float) -> str:
    """One row of events in plain words: who, what, when and where."""
    track, before = f"track {event['track_id']}", int(event["previous_id"])
    person, source = f"person {event['truth_id']}", int(event["source_id"])
    lasts = float(event["duration_s"])
    here = f"at {at_s:.2f} s{_place(event)}"
    match EventKind(int(event["kind"])):
        case EventKind.BIRTH:
            return f"{track} begins {here}"
        case EventKind.END:
            return f"{track} ends {here}, after {lasts:.1f} s"
        case EventKind.SWITCH:
            return f"{person}: track {before} became {track} {here}{_unseen(lasts)}"
        case EventKind.MISS:
            return f"{person} is missed for {_span(event)} {here}"
        case EventKind.FALSE_TRACK:
            return f"{track} is nobody for {_span(event)} {here}"
        case EventKind.JOINED:
            return f"{track}: sources {before} and {source} joined {here}{_unseen(lasts)}"
        case EventKind.PARTED:
            return f"{track}: source {source}, until then track {before}, parted {here}"


def _span(event: Any) -> str:
    frames = int(event["frames"])
    return f"{event['duration_s']:.1f} s ({frames} frame{'s' if frames > 1 else ''})"


def _unseen(seconds: float) -> str:
    return f", {seconds:.1f} s unseen" if seconds >= 0.05 else ""


def _place(event: Any) -> str:
    for x, y, unit in (("x_m", "y_m", "m"), ("x_px", "y_px", "px")):
        if not isnan(event[x]) and not isnan(event[y]):
            digits = 1 if unit == "m" else 0
            return f", ({event[x]:.{digits}f}, {event[y]:.{digits}f}) {unit}"
    return ""
