"""Identity switches and repairs: when, and what the pictures showed then.

Letters: R events.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.event_text import describe
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import EVENT_KINDS, EventKind, Frame, Rows
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing.report.measures import by_track, usual_s

#: Thumbnails are squares of so many pixels, and so many times as large as a person.
SIDE_PX: Final = 168
_ROOM: Final = 2.4
_LEAST_PX: Final = 40
_QUALITY: Final = 74
#: How many bars show where tracks begin and end.
BARS: Final = 72


class Box(NamedTuple):
    """A box in a thumbnail, (x, y, w, h) in its pixels, and whose it is."""

    xywh: tuple[float, float, float, float]
    identity: int
    label: int


class Shot(NamedTuple):
    """A piece of a picture in JPEG, at a second of the log, and what is marked in it."""

    jpeg: bytes
    at_s: float
    box: Box | None


@dataclass
class Moment:
    """Something that happened to an identity; ``weight_s`` is for how long what was before and after it lasted."""

    t_ns: int
    row: Any
    weight_s: float
    words: str
    before: Shot | None = None
    after: Shot | None = None


@dataclass
class Story:
    """What happened to the tracks of one channel, from ``start_ns`` to ``end_ns``.

    ``kinds`` are those that ``moments`` are of: switches where the truth says which these are, otherwise repairs.
    """

    topic: str
    moments: list[Moment]
    kinds: tuple[EventKind, ...]
    counts: dict[str, int]
    births: list[int]
    ends: list[int]
    rule: MatchRule | None
    span_s: float

    def to_json(self) -> dict[str, Any]:
        """As it stands in the report's data."""
        return {
            "topic": self.topic,
            "similarity": self.rule[0] if self.rule else None,
            "gate": self.rule[1] if self.rule else None,
            "counts": self.counts,
            "births": self.births,
            "ends": self.ends,
            "bin_s": self.span_s / BARS,
            "moments": [
                {
                    "t_ns": moment.t_ns,
                    "kind": EVENT_KINDS[EventKind(int(moment.row["kind"]))],
                    **{name: int(moment.row[name]) for name in ("truth_id", "previous_id", "track_id", "source_id")},
                    **{name: float(moment.row[name]) for name in ("x_m", "y_m", "x_px", "y_px", "duration_s")},
                }
                for moment in self.moments
            ],
        }


def tell(
    topic: str,
    events: Sequence[Frame],
    rule: MatchRule | None,
    tracks: Sequence[Frame],
    truth: Sequence[Frame] | None,
    span_ns: tuple[int, int],
) -> Story:
    """The story of a channel of tracks from its events."""
    start_ns, end_ns = span_ns
    happened = [(frame.t_ns, row) for frame in events for row in frame.rows]
    t_ns = np.array([at for at, _ in happened], np.int64)
    kind = np.array([int(row["kind"]) for _, row in happened], np.int64)
    kinds = (EventKind.SWITCH,) if rule else (EventKind.JOINED, EventKind.PARTED)
    usual = usual_s(tracks)
    moments = [
        Moment(at, row, 0.0, describe(row, f"at {(at - start_ns) / NS_PER_S:.1f} s", usual))
        for at, row in happened
        if int(row["kind"]) in kinds
    ]
    _weigh(moments, truth if rule and truth else tracks, "truth_id" if rule else "track_id")
    span_s = max(end_ns - start_ns, 1) / NS_PER_S
    edges = start_ns + np.linspace(0, max(end_ns - start_ns, 1), BARS + 1)
    births, ends = (np.histogram(t_ns[kind == k], edges)[0].tolist() for k in (EventKind.BIRTH, EventKind.END))
    counts = {words: int((kind == k).sum()) for k, words in EVENT_KINDS.items()}
    return Story(topic, moments, kinds, counts, births, ends, rule, span_s)


def _weigh(moments: Sequence[Moment], frames: Sequence[Frame], column: str) -> None:
    """How much each moment matters: the shorter of how long it was well before, and was another way after."""
    rows, t_ns = by_track(frames)
    ids = rows["track_id"]
    by_who: dict[int, list[Moment]] = {}
    for moment in moments:
        by_who.setdefault(int(moment.row[column]), []).append(moment)
    for who, members in by_who.items():
        low, high = np.searchsorted(ids, who, "left"), np.searchsorted(ids, who, "right")
        if low == high:
            continue
        bounds = [int(t_ns[low]), *(moment.t_ns for moment in members), int(t_ns[high - 1])]
        for k, moment in enumerate(members, 1):
            unseen_s = float(np.nan_to_num(moment.row["duration_s"]))
            before_s = (bounds[k] - bounds[k - 1]) / NS_PER_S - unseen_s
            moment.weight_s = max(min(before_s, (bounds[k + 1] - bounds[k]) / NS_PER_S), 0.0)


def most_important(stories: Sequence[Story], most: int) -> list[list[Moment]]:
    """The moments of each story that matter most, in order of time: ``most`` together, as many of each as can be."""
    ranked = [sorted(story.moments, key=lambda m: (-m.weight_s, m.t_ns)) for story in stories]
    shares = [0] * len(ranked)
    while sum(shares) < most and any(share < len(part) for share, part in zip(shares, ranked, strict=True)):
        open_ones = [k for k, part in enumerate(ranked) if shares[k] < len(part)]
        shares[min(open_ones, key=lambda k: shares[k])] += 1
    return [sorted(part[:share], key=lambda m: m.t_ns) for part, share in zip(ranked, shares, strict=True)]


def photograph(moments: Sequence[Moment], tracks: Sequence[Frame], pictures: Pictures, start_ns: int) -> None:
    """Give moments their thumbnails: the last picture before with who was there, and the one in which it happened.

    Moments without a place in the picture get none. Raises McaptrackError for pictures that are damaged.
    """
    rows, t_ns = by_track(tracks)
    wanted: dict[int, list[tuple[Moment, bool, Any, Floats]]] = {}
    for moment in moments:
        event = moment.row
        is_join = int(event["kind"]) == EventKind.JOINED
        # Seconds are rounded: a microsecond earlier is still after the frame before.
        unseen_ns = seconds_to_ns(float(np.nan_to_num(event["duration_s"]))) + 1000
        old = _row_at(rows, t_ns, int(event["track_id" if is_join else "previous_id"]), moment.t_ns - unseen_ns)
        new = _row_at(rows, t_ns, int(event["track_id"]), moment.t_ns)
        region = _region([found[1] for found in (old, new) if found], event)
        if region is None or not len(pictures.t_ns):
            continue
        usual_ns = seconds_to_ns(usual_s(tracks))
        before_ns = old[0] if old else moment.t_ns - usual_ns
        for at_ns, found, is_after in ((before_ns, old, False), (moment.t_ns, new, True)):
            number = max(int(np.searchsorted(pictures.t_ns, at_ns, "right")) - 1, 0)
            wanted.setdefault(number, []).append((moment, is_after, found[1] if found else None, region))
    for frame in pictures.frames(wanted):
        image = np.asarray(frame.rows, np.uint8)
        for moment, is_after, row, region in wanted[frame.index]:
            shot = _cut(image, region, (frame.t_ns - start_ns) / NS_PER_S, row, _label(moment.row, is_after))
            if is_after:
                moment.after = shot
            else:
                moment.before = shot


def _label(event: Any, is_after: bool) -> int:
    """Whose id stands at the box: the tracker's where re-tracking joined or parted, otherwise the track's."""
    if not is_after:
        return int(event["previous_id"])
    return int(event["source_id" if int(event["kind"]) == EventKind.JOINED else "track_id"])


def _row_at(rows: Rows, t_ns: Ints, who: int, until_ns: int) -> tuple[int, Any] | None:
    """Time and row of a track's last row up to a time; rows are by track and time."""
    low, high = np.searchsorted(rows["track_id"], who, "left"), np.searchsorted(rows["track_id"], who, "right")
    at = int(low + np.searchsorted(t_ns[low:high], until_ns, "right")) - 1
    return (int(t_ns[at]), rows[at]) if at >= low else None


def _region(rows: Sequence[Any], event: Any) -> Floats | None:
    """The square (x, y, side) around what happened, in pixels; None if nobody knows where that was."""
    boxes = np.array([[row["x_px"], row["y_px"], row["w_px"], row["h_px"]] for row in rows], float).reshape(-1, 4)
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    place = np.array([event["x_px"], event["y_px"]], float)
    corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
    if np.isfinite(place).all():
        corners = np.concatenate([corners, place[None]])
    if not len(corners):
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    person = float(boxes[:, 3].max()) if len(boxes) else _LEAST_PX / _ROOM
    side = max(_ROOM * person, float((high - low).max()) * 1.2, _LEAST_PX)
    return np.array([*((low + high - side) / 2), side])


def _cut(image: NDArray[np.uint8], region: Floats, at_s: float, row: Any, label: int) -> Shot | None:
    """The square of a picture, moved inside where it reaches out; None if it lies outside."""
    import cv2

    height, width = image.shape[:2]
    side = int(min(region[2], width, height))
    x, y = (int(np.clip(at, 0, most - side)) for at, most in zip(region[:2], (width, height), strict=True))
    piece = image[y : y + side, x : x + side]
    if side < 2:
        return None
    smooth = cv2.INTER_AREA if side > SIDE_PX else cv2.INTER_CUBIC
    small = np.asarray(cv2.resize(piece, (SIDE_PX, SIDE_PX), interpolation=smooth), np.uint8)
    box = None
    if row is not None and np.isfinite([row["x_px"], row["y_px"], row["w_px"], row["h_px"]]).all():
        scale = SIDE_PX / side
        left, top = (float(row["x_px"]) - x) * scale, (float(row["y_px"]) - y) * scale
        xywh = (left, top, float(row["w_px"]) * scale, float(row["h_px"]) * scale)
        box = Box(xywh, int(row["track_id"]), label)
    return Shot(encode_image(small, "jpeg", _QUALITY), at_s, box)
