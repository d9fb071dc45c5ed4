"""The values of the sections with pictures: tracks on a map of the scene, and events of identities."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import command
from mcaptrack.evaluation.people import PersonScores
from mcaptrack.extensions.report.contents import LogReport, TrackSet, plane_of
from mcaptrack.extensions.report.headline import rule_text
from mcaptrack.extensions.report.identity_events import BARS, SIDE_PX, ChannelEvents, IdentityEvent, Thumbnail
from mcaptrack.extensions.report.scene_map import (
    TrackPath,
    ground_map,
    ground_paths,
    ground_span,
    heat_map,
    picture_map,
    pixel_paths,
)
from mcaptrack.extensions.report.statistics import rows_by_track
from mcaptrack.foxglove.palette import COUNT as COLOURS
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import run_starts
from mcaptrack.schema import EventKind, Frame
from mcaptrack.schema.framing import frame_times, row_ends
from mcaptrack.viewing.charts import POINTS, Axis, Line, figure, round_most, timeline_chart
from mcaptrack.viewing.formatting import clock, counted, number, short, tick_marks

#: The time in the text of an event.
_WHEN: Final = re.compile(r",? at [0-9]+\.[0-9] s\b")
_NO_GROUND = (
    "Tracks can't be drawn: there is no picture, and without a ground plane positions on the ground are not known."
)


def scene_map(report: LogReport) -> dict[str, Any]:
    """Tracks over the picture, or on the ground."""
    sets = [report.track_sets[role] for role in ("tracks", "offline", "truth") if role in report.track_sets]
    sets = [tracks for tracks in sets if any(len(frame.rows) for frame in tracks.frames)]
    if not sets:
        return {"missing": "There are no tracks to draw.", "maps": [], "plans": []}
    if report.background is not None:
        plane = plane_of(report)
        drawn = _with_paths(sets, [pixel_paths(tracks.frames, plane) for tracks in sets])
        if drawn:
            maps = [
                _map(report, tracks, paths, picture_map(paths, report.background, report.start_s))
                for tracks, paths in drawn
            ]
            return {"missing": "", "maps": maps, "jpeg": report.background.jpeg, "plans": _plans(report, sets)}
        why = "No track has a place in the picture"
    else:
        why = report.missing.get("pictures", "There are no pictures")
    drawn = _with_paths(sets, [ground_paths(tracks.frames) for tracks in sets])
    if not drawn:
        return {"missing": _NO_GROUND, "maps": [], "plans": []}
    span = ground_span([path.points for _, paths in drawn for path in paths])
    maps = [_map(report, tracks, paths, ground_map(paths, span, report.start_s)) for tracks, paths in drawn]
    return {"missing": f"{why}; here is the ground instead.", "maps": maps, "jpeg": b"", "plans": []}


def _plans(report: LogReport, sets: Sequence[TrackSet]) -> list[dict[str, Any]]:
    """Plans of the ground in metres: of re-tracked people, or of tracks, and of the ground truth."""
    chosen = {"truth" if tracks.role == "truth" else "tracks": tracks for tracks in sets}
    drawn = _with_paths([*chosen.values()], [ground_paths(tracks.frames) for tracks in chosen.values()])
    span = ground_span([path.points for _, paths in drawn for path in paths])
    return [_map(report, tracks, paths, ground_map(paths, span, 0.0)) for tracks, paths in drawn]


def heat(report: LogReport) -> dict[str, Any] | None:
    """The map of where people spent their time: re-tracked people, or tracks; None without positions in metres."""
    for role in ("offline", "online", "samples", "tracks"):
        tracks = report.track_sets.get(role)
        if tracks is None or not any(len(frame.rows) for frame in tracks.frames):
            continue
        if (values := heat_map(tracks.frames)) is not None:
            return values | {"name": short(tracks.name), "role": tracks.role, "note": report.metres_note}
    return None


def _with_paths(sets: Sequence[TrackSet], paths: Sequence[list[TrackPath]]) -> list[tuple[TrackSet, list[TrackPath]]]:
    return [(tracks, own) for tracks, own in zip(sets, paths, strict=True) if own]


def _map(report: LogReport, tracks: TrackSet, paths: Sequence[TrackPath], values: dict[str, Any]) -> dict[str, Any]:
    joined = _joined(report)
    for path in values["tracks"]:
        path["key"] = "" if path["id"] is None else _keys(tracks.role, path["id"], joined)
    return values | {"name": short(tracks.name), "role": tracks.role, "count": counted(len(paths), "track")}


# Elements of one track have a key in common: the page lights all of them where one is clicked.


#: The roles of tracks that have the ids of the tracker.
_TRACKER: Final = ("tracks", "samples")
#: The largest number of rows of the table of tracks; those that last longest.
_MOST_ROWS: Final = 200


def track_key(role: str, identity: int) -> str:
    """The key of a track. Samples of tracks have the same ids."""
    return f"{'tracks' if role in _TRACKER else role}-{identity}"


def _keys(role: str, identity: int, joined: Mapping[int, Sequence[str]]) -> str:
    """The key of a track, and those of the re-tracked tracks that it is part of."""
    return " ".join([track_key(role, identity), *(joined.get(identity, ()) if role in _TRACKER else ())])


def _joined(report: LogReport) -> dict[int, list[str]]:
    """The keys of the re-tracked tracks that a track of the tracker is part of, by its id."""
    role = report.compared_roles[1]
    if role not in report.track_sets:
        return {}
    rows, _ = rows_by_track(report.track_sets[role].frames)
    rows = rows[rows["observed"] & (rows["source_id"] >= 0)]
    out: dict[int, list[str]] = {}
    for track, source in np.unique(np.stack([rows["track_id"], rows["source_id"]], axis=-1), axis=0).tolist():
        out.setdefault(int(source), []).append(track_key(role, int(track)))
    return out


def track_table(report: LogReport) -> dict[str, Any] | None:
    """The table of the re-tracked tracks, or those of the tracker; None without any."""
    for role, listed in report.data["track_list"].items():
        shown = sorted(listed, key=lambda track: -track["seconds"])[:_MOST_ROWS]
        if shown:
            return {
                "name": short(report.track_sets[role].name),
                "role": role,
                "left_out": len(listed) - len(shown),
                "rows": [
                    track | {"key": track_key(role, track["id"])}
                    for track in sorted(shown, key=lambda track: (track["from_s"], track["id"]))
                ],
            }
    return None


def identity_events(report: LogReport) -> dict[str, Any]:
    """Timelines of identity switches or repairs, the most important ones, and the least certain repairs."""
    has_rule = any(channel.rule for channel in report.channel_events)
    pairs = list(zip(report.channel_events, report.highlights, strict=True))
    return {
        "has_channels": bool(pairs),
        "has_ground_truth": has_rule,
        "timelines": [_timeline(channel, shown, report) for channel, shown in pairs],
        "highlights": [_highlights(channel, shown, report) for channel, shown in pairs if channel.events],
        "doubts": [
            _event(doubt.event, doubt.text(), report, report.compared_roles[1]) | {"is_wrong": doubt.is_right is False}
            for doubt in report.doubts
        ],
        "have_odds": any(doubt.probability is not None for doubt in report.doubts),
        "doubtful_tracks": [
            {"text": doubtful_track.text("a person" if report.has_only_people else "an object")}
            | {"t_ns": doubtful_track.t_ns, "clock": clock((doubtful_track.t_ns - report.start_ns) / NS_PER_S)}
            | {"is_wrong": False, "thumbnails": [], "key": track_key("tracks", int(doubtful_track.row["source_id"]))}
            for doubtful_track in report.doubtful_tracks
        ],
        "view": command("view", Path(report.file)),
    }


def _event(event: IdentityEvent, text: str, report: LogReport, role: str) -> dict[str, Any]:
    """An event with its time for a viewer: in ns since 1970, and in seconds of the log; ``role`` is of its tracks."""
    seconds = (event.t_ns - report.start_ns) / NS_PER_S
    is_join = int(event.row["kind"]) == EventKind.JOINED
    others = [(role, "track_id"), ("tracks" if is_join else role, "previous_id")]
    others += [("tracks", "source_id")] if is_join else []
    return {
        "key": " ".join(track_key(kind, int(event.row[column])) for kind, column in others if event.row[column] >= 0),
        "text": _WHEN.sub("", text, count=1),  # the time stands before the text
        "is_wrong": False,
        "t_ns": event.t_ns,
        "clock": clock(seconds),
        "thumbnails": [
            _thumbnail(image, when) for image, when in ((event.before, "before"), (event.after, "after")) if image
        ],
    }


def _set_of(report: LogReport, channel: ChannelEvents) -> TrackSet:
    return next(track_set for track_set in report.track_sets.values() if track_set.topic == channel.topic)


def _title(channel: ChannelEvents, name: str) -> str:
    if channel.rule:
        return f"{name}: {counted(len(channel.events), 'identity switch', 'identity switches')}"
    return f"{name}: {counted(len(channel.events), 'repair')}" if channel.events else name


def _timeline(channel: ChannelEvents, shown: Sequence[IdentityEvent], report: LogReport) -> dict[str, Any]:
    tracks, span = _set_of(report, channel), channel.span_s
    most = max([1, *channel.births, *channel.ends])
    places = [f"{100 * (event.t_ns - report.start_ns) / NS_PER_S / span:.1f}%" for event in channel.events]
    chosen = {id(event) for event in shown}
    bars = enumerate(zip(channel.births, channel.ends, strict=True))
    return {
        "title": _title(channel, short(tracks.name)),
        "role": tracks.role,
        "rule": rule_text(*channel.rule) if channel.rule else "",
        "span": clock(span),
        "bars": [(f"{100 * k / BARS:.2f}%", 18 * born / most, 12 * ended / most) for k, (born, ended) in bars],
        "bar_width": f"{80 / BARS:.2f}%",
        "most": most,
        "bin": number(span / BARS, 2, "s"),
        "marks": list(dict.fromkeys(places)),
        "highlights": [(x, e.text) for e, x in zip(channel.events, places, strict=True) if id(e) in chosen],
        "ticks": tick_marks(span),
    }


def _highlights(channel: ChannelEvents, shown: Sequence[IdentityEvent], report: LogReport) -> dict[str, Any]:
    rest = len(channel.events) - len(shown)
    most = "the most important event" if len(shown) == 1 else f"the {len(shown)} most important events"
    has_pictures = any(event.before or event.after for event in shown)
    why = report.missing.get("pictures", "The events have no place in the picture")
    role = _set_of(report, channel).role
    return {
        "title": f"{short(_set_of(report, channel).name)}: {most}" + (f", and {number(rest)} more" if rest else ""),
        "missing": "" if has_pictures else f"{why}; they are listed without.",
        "events": [_event(event, f"{event.text[:1].upper()}{event.text[1:]}.", report, role) for event in shown],
    }


def _thumbnail(thumbnail: Thumbnail, when: str) -> dict[str, Any]:
    at = number(thumbnail.at_s, 1, "s")
    values = {"jpeg": thumbnail.jpeg, "side": SIDE_PX, "when": f"{when} {at}", "title": f"{when}, at {at}", "box": None}
    if thumbnail.box is None:
        return values
    x, y, w, h = (f"{value:.1f}" for value in thumbnail.box.xywh)
    box = {"x": x, "y": y, "w": w, "h": h, "label": thumbnail.box.label, "colour": thumbnail.box.identity % COLOURS}
    box |= {"label_x": f"{max(thumbnail.box.xywh[0], 2):.1f}", "label_y": f"{max(thumbnail.box.xywh[1] - 4, 14):.1f}"}
    return values | {"title": f"{when}, at {at}: track {thumbnail.box.label}", "box": box}


# The identities of people over time, a bar for each of them coloured by ids of tracks; and how many there were.
#
# Letters: P rows of one person.


#: The largest number of people that get a bar; those who stay longest.
_MOST: Final = 40
#: Pauses up to this many intervals between rows are part of a bar.
_PAUSE: Final = 1.6
#: Pieces are at least this part of the width, in percent, and those with ids printed in them this part.
_LEAST, _WIDE = 0.15, 4.5


class IdentitySpan(NamedTuple):
    """A time in which a person has one id: seconds since the start of the log."""

    identity: int
    first_s: float
    last_s: float


def pieces(identity: Ints, t_ns: Ints, start_ns: int, interval_ns: float) -> list[IdentitySpan]:
    """The times with one id (P,), of rows at rising times (P,) that are usually ``interval_ns`` apart.

    A piece lasts until the next row is due, so that a single row is as long as an interval.
    """
    if not len(identity):
        return []
    first = np.flatnonzero(run_starts(identity, times=t_ns, max_gap=round(_PAUSE * interval_ns)))
    last = np.append(first[1:], len(identity)) - 1
    begin = (t_ns[first] - start_ns) / NS_PER_S
    due = np.append(t_ns[1:], np.iinfo(np.int64).max)[last]
    end = (np.minimum(t_ns[last] + round(interval_ns), due) - start_ns) / NS_PER_S
    return [IdentitySpan(*span) for span in zip(identity[first].tolist(), begin.tolist(), end.tolist(), strict=True)]


def identity_timeline(report: LogReport) -> dict[str, Any]:
    """The values of the section."""
    span_s = max((report.end_ns - report.start_ns) / NS_PER_S, 1e-9)
    scored = [(report.track_sets[role], report.people[role]) for role in report.compared_roles if role in report.people]
    rows = _of_people(report, [(side.role, people) for side, people in scored]) if scored else _of_tracks(report)
    kept = sorted(sorted(rows, key=lambda row: -row["seconds"])[:_MOST], key=lambda row: row["begins"])
    headline, joined = report.headline, _joined(report)
    return {
        "rows": [{**row, "lanes": [_lane(lane, span_s, joined) for lane in row["lanes"]]} for row in kept],
        "left_out": len(rows) - len(kept),
        "has_truth": bool(scored),
        "lanes": [
            {"name": short(side.name), "role": side.role, "switches": _switches(people)} for side, people in scored
        ],
        "rule": rule_text(*headline.rule) if headline else "",
        "span": clock(span_s),
        "ticks": tick_marks(span_s),
    }


def _switches(people: PersonScores) -> str:
    return counted(int(people.switches.sum()), "identity switch", "identity switches")


def _of_people(report: LogReport, sides: Sequence[tuple[str, PersonScores]]) -> list[dict[str, Any]]:
    """A row for each true person, with a lane for each kind of tracks."""
    truth, t_ns = rows_by_track(report.track_sets["truth"].frames)
    interval_ns = _interval_ns(np.unique(t_ns))
    out = []
    for person, low, high in _groups(truth["track_id"]):
        whole = np.full(high - low, person, np.int64)
        lanes = [("truth", pieces(whole, t_ns[low:high], report.start_ns, interval_ns))]
        for role, side in sides:
            low_match, high_match = np.searchsorted(side.person, [person, person + 1])
            own = slice(int(low_match), int(high_match))
            step_ns = _interval_ns(side.frame_ns)
            lanes.append((role, pieces(side.track[own], side.t_ns[own], report.start_ns, step_ns)))
        out.append(_row(person, lanes))
    return out


def _of_tracks(report: LogReport) -> list[dict[str, Any]]:
    """A row for each re-tracked track, with the tracker's ids along it; without re-tracking, for each track."""
    role = next((role for role in reversed(report.compared_roles) if role in report.track_sets), "")
    if not role:
        return []
    rows, t_ns = rows_by_track(report.track_sets[role].frames)
    interval_ns = _interval_ns(frame_times(report.track_sets[role].frames))
    sources = rows["source_id"].astype(np.int64)
    return [
        _row(
            track,
            [("tracks", pieces(_known(sources[low:high], track), t_ns[low:high], report.start_ns, interval_ns))],
        )
        for track, low, high in _groups(rows["track_id"])
    ]


def _known(source: Ints, track: int) -> Ints:
    """The ids of the tracker (P,): rows without one, which are interpolated, have that of the row before, or the first.

    A track without any has its own id.
    """
    with_id = np.flatnonzero(source >= 0)
    if not len(with_id):
        return np.full(len(source), track)
    return source[with_id[np.maximum(np.searchsorted(with_id, np.arange(len(source)), "right") - 1, 0)]]


def _row(identity: int, lanes: list[tuple[str, list[IdentitySpan]]]) -> dict[str, Any]:
    whole = lanes[0][1]
    seconds = sum(piece.last_s - piece.first_s for piece in whole)
    return {"name": str(identity), "seconds": seconds, "begins": whole[0].first_s if whole else 0.0, "lanes": lanes}


def _groups(ids: Any) -> Iterator[tuple[int, int, int]]:
    """Each id of sorted rows, and its first row and the row after its last."""
    unique, first = np.unique(ids, return_index=True)
    yield from zip(unique.tolist(), first.tolist(), np.append(first, len(ids))[1:].tolist(), strict=True)


def _interval_ns(t_ns: Ints) -> float:
    """The usual time between frames."""
    return float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else NS_PER_S / 10


def _lane(lane: tuple[str, list[IdentitySpan]], span_s: float, joined: Mapping[int, Sequence[str]]) -> dict[str, Any]:
    """A lane as coordinates in percent; pieces that are too short to be seen are drawn a little longer.

    ``joined`` are the keys of the re-tracked tracks that a track of the tracker is part of.
    """
    role, spans = lane
    out = []
    for piece in spans:
        left = 100 * piece.first_s / span_s
        width = max(100 * (piece.last_s - piece.first_s) / span_s, _LEAST)
        seconds = f"{number(piece.first_s, 1)} to {number(piece.last_s, 1, 's')}"
        out.append(
            {
                "x": f"{left:.2f}%",
                "width": f"{width:.2f}%",
                "colour": piece.identity % COLOURS,
                "key": _keys(role, piece.identity, joined),
                "title": f"{piece.identity}: {seconds}",
                "label": str(piece.identity) if width >= _WIDE else "",
                "label_x": f"{left + 0.4:.2f}%",
            }
        )
    return {"kind": "truth" if role == "truth" else "ids", "pieces": out}


def people_over_time(report: LogReport) -> dict[str, Any] | None:
    """The chart of how many people there are; None without any tracks."""
    roles = [*filter(None, report.compared_roles), "truth"]
    sets = [report.track_sets[role] for role in roles if role in report.track_sets]
    span_s = max((report.end_ns - report.start_ns) / NS_PER_S, 1e-9)
    lines = []
    for tracks in sets:
        at_s, count = counts_over_time(tracks.frames, report.start_ns, span_s)
        if len(at_s):
            lines.append(Line(short(tracks.name), tracks.role, at_s, count, dashed=tracks.role == "truth"))
    if not lines:
        return None
    noun = "people" if report.has_only_people else "objects"
    most = round_most((line.y for line in lines), whole=True)
    axes = Axis("seconds since the start", span_s), Axis(noun, most, whole=True)
    title = f"{noun} over time".capitalize()
    return figure(timeline_chart(title, lines, *axes, tick_marks(span_s)), f"{title}.", mean_numbers(lines, "seconds"))


def mean_numbers(lines: Sequence[Line], unit: str) -> str:
    """Mean numbers over the time that all lines cover: ground truth may begin later or end earlier than tracks."""
    low, high = max(float(line.x[0]) for line in lines), min(float(line.x[-1]) for line in lines)
    inside = [line.y[(low <= line.x) & (line.x <= high)] for line in lines]
    if not all(map(len, inside)):
        inside, when = [line.y for line in lines], ", each while it is there"
    else:
        least = 0.02 * (high - low)
        is_whole = all(low - line.x[0] <= least and line.x[-1] - high <= least for line in lines)
        when = "" if is_whole else f", from {number(low, 1)} to {number(high, 1)} {unit}"
    means = ", ".join(f"{line.name} {number(float(y.mean()), 1)}" for line, y in zip(lines, inside, strict=True))
    return f"On average{when}: {means}."


def counts_over_time(frames: Sequence[Frame], start_ns: int, span_s: float) -> tuple[Floats, Floats]:
    """Times in s and mean numbers of rows: of each frame, or of as many equal times as a line has points."""
    t_s = (frame_times(frames) - start_ns) / NS_PER_S
    count = np.diff(row_ends(frames)).astype(np.float64)
    if len(t_s) <= POINTS:
        return t_s, count
    edges = np.linspace(0, span_s, POINTS + 1)
    place = np.clip(np.searchsorted(edges, t_s, "right") - 1, 0, POINTS - 1)
    number_of = np.bincount(place, minlength=POINTS)
    mean = np.bincount(place, count, minlength=POINTS) / np.maximum(number_of, 1)
    return ((edges[:-1] + edges[1:]) / 2)[number_of > 0], mean[number_of > 0]
