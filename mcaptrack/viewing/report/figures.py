"""The values of the sections with pictures: tracks on a map of the scene, and events of identities."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import command
from mcaptrack.foxglove.palette import COUNT as COLOURS
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.report.charts import time_ticks
from mcaptrack.viewing.report.contents import LogReport, TrackSet, plane_of
from mcaptrack.viewing.report.formatting import clock, counted, number, short
from mcaptrack.viewing.report.headline import rule_text
from mcaptrack.viewing.report.identity_events import BARS, SIDE_PX, ChannelEvents, IdentityEvent, Thumbnail
from mcaptrack.viewing.report.scene_map import (
    TrackPath,
    ground_map,
    ground_paths,
    ground_span,
    heat_map,
    picture_map,
    pixel_paths,
)

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
                _map(tracks, paths, picture_map(paths, report.background, report.start_s)) for tracks, paths in drawn
            ]
            return {"missing": "", "maps": maps, "jpeg": report.background.jpeg, "plans": _plans(sets)}
        why = "No track has a place in the picture"
    else:
        why = report.missing.get("pictures", "There are no pictures")
    drawn = _with_paths(sets, [ground_paths(tracks.frames) for tracks in sets])
    if not drawn:
        return {"missing": _NO_GROUND, "maps": [], "plans": []}
    span = ground_span([path.points for _, paths in drawn for path in paths])
    maps = [_map(tracks, paths, ground_map(paths, span, report.start_s)) for tracks, paths in drawn]
    return {"missing": f"{why}; here is the ground instead.", "maps": maps, "jpeg": b"", "plans": []}


def _plans(sets: Sequence[TrackSet]) -> list[dict[str, Any]]:
    """Plans of the ground in metres: of re-tracked people, or of tracks, and of the ground truth."""
    chosen = {"truth" if tracks.role == "truth" else "tracks": tracks for tracks in sets}
    drawn = _with_paths([*chosen.values()], [ground_paths(tracks.frames) for tracks in chosen.values()])
    span = ground_span([path.points for _, paths in drawn for path in paths])
    return [_map(tracks, paths, ground_map(paths, span, 0.0)) for tracks, paths in drawn]


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


def _map(tracks: TrackSet, paths: Sequence[TrackPath], values: dict[str, Any]) -> dict[str, Any]:
    return values | {"name": short(tracks.name), "role": tracks.role, "count": counted(len(paths), "track")}


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
            _event(doubt.event, doubt.text(), report) | {"is_wrong": doubt.is_right is False} for doubt in report.doubts
        ],
        "have_odds": any(doubt.probability is not None for doubt in report.doubts),
        "doubtful_tracks": [
            {"text": doubtful_track.text("person" if report.has_only_people else "object"), "t_ns": doubtful_track.t_ns}
            | {"clock": clock((doubtful_track.t_ns - report.start_ns) / NS_PER_S), "is_wrong": False, "thumbnails": []}
            for doubtful_track in report.doubtful_tracks
        ],
        "view": command("view", Path(report.file)),
    }


def _event(event: IdentityEvent, text: str, report: LogReport) -> dict[str, Any]:
    """An event with its time for a viewer: in ns since 1970, and in seconds of the log."""
    seconds = (event.t_ns - report.start_ns) / NS_PER_S
    return {
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
        "ticks": [
            (f"{100 * tick / span:.2f}%", clock(tick, span), "end" if tick > 0.97 * span else "mid" if tick else "")
            for tick in time_ticks(span).tolist()
        ],
    }


def _highlights(channel: ChannelEvents, shown: Sequence[IdentityEvent], report: LogReport) -> dict[str, Any]:
    rest = len(channel.events) - len(shown)
    most = "the most important event" if len(shown) == 1 else f"the {len(shown)} most important events"
    has_pictures = any(event.before or event.after for event in shown)
    why = report.missing.get("pictures", "The events have no place in the picture")
    return {
        "title": f"{short(_set_of(report, channel).name)}: {most}" + (f", and {number(rest)} more" if rest else ""),
        "missing": "" if has_pictures else f"{why}; they are listed without.",
        "events": [_event(event, f"{event.text[:1].upper()}{event.text[1:]}.", report) for event in shown],
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
