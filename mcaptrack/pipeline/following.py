"""Continue the ids of one recording in the next one: of the same camera, when a recording was split into several logs.

Stages that track people begin with the last seconds of the log before, as if both were one, and what they make of these
is left out. There the same people have ids in both logs, by which those of the second one are renumbered.

Letters: N rows, T tracks of the log before, U tracks of this one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import Job, read_named_frames
from mcaptrack.pipeline.staleness import digest_of, is_stale, read_planes
from mcaptrack.schema import APPEARANCE, DECISIONS, DETECTIONS, PREDICTIONS, TRACKS, VIDEO, WORLDS, Frame, Rows, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_times, unique_values
from mcaptrack.sources.cameras import camera_at, cameras, provenance_of
from mcaptrack.sources.pictures import picture_size
from mcaptrack.transforms import STAGES

#: How much of the log before they begin with, and the longest gap over which people can be the same.
LEAD_S, BRIDGED_S = 30.0, 10.0
#: People of the log before count as being in the picture at the cut if they were there so many seconds before its end.
_AT_CUT_S: Final = 1.0
#: Boxes of two logs at one time are of one person if their middles are so near, in heights, or in metres without boxes.
_NEAR_HEIGHTS, _NEAR_M = 0.35, 0.5
#: Votes of a frame count half if it is so many seconds before the cut.
_HALF_S: Final = 1.0
#: The vote of a re-tracked id that begins with a track that had one in the log before: it counts where no place does.
_OF_SOURCE: Final = 1e-12
#: The digest of the channel that ids go on from, and the largest id so far, in the provenance.
AFTER, LAST_ID = "after", "last_id"


@dataclass
class Continued:
    """The outcome of continuing a log: the log before, the gap in seconds, and people at the cut by topic.

    ``at_cut`` counts the ids in the last second of the log before, ``kept`` those of them that this log has, too.
    """

    log: str
    gap_s: float
    at_cut: dict[str, int] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)

    @classmethod
    def joined(cls, each: Sequence[Continued]) -> Continued:
        """Return the outcomes of several cameras as one, with the longest of their gaps."""
        out = cls(each[0].log, max(camera.gap_s for camera in each))
        for camera in each:
            out.at_cut |= camera.at_cut
            out.kept |= camera.kept
        return out

    def to_json(self) -> dict[str, Any]:
        """Return it as values of JSON."""
        return {"log": self.log, "gap_s": round(self.gap_s, 6), "at_cut": self.at_cut, "kept": self.kept}

    def words(self) -> list[str]:
        """Return it as lines of text."""
        lines = [
            f"{topic} goes on from {self.log}: {self.kept[topic]} of {count} people at the cut keep their ids"
            for topic, count in self.at_cut.items()
        ]
        return lines or [f"ids go on from {self.log}, as before"]


def begins_here(before: log.Log, opened: log.Log, prefix: str) -> str:
    """Return why a camera continues no ids, if the log before has other cameras of this log but not this one; or ""."""
    before_cameras, here = ({camera.prefix for camera in cameras(each)} for each in (before, opened))
    if prefix in before_cameras or not before_cameras & here:
        return ""
    return f"{before.path} has no camera {prefix[1:]}: its ids begin with {opened.path}"


class Before:
    """The log before another one: its last seconds, and its ids.

    Raises McaptrackError if ``opened`` doesn't follow it: if they overlap, or are of other cameras.
    """

    def __init__(self, before: log.Log, opened: log.Log, prefix: str) -> None:
        self._log, self._prefix = before, prefix
        self.tracks = f"{prefix}/{STAGES['track'].output_topic}"
        self._check_camera(opened)
        times, start_ns = before.times(self.tracks), _start_ns(opened, prefix)
        self._end_ns, self.start_ns = int(times[-1]), start_ns
        self._period_ns = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        self._check_times(opened, int(times[0]))
        self.result = Continued(str(before.path), (start_ns - self._end_ns) / NS_PER_S)
        self.is_bridged = self.result.gap_s <= BRIDGED_S
        if not self.is_bridged:
            warn(
                f"{opened.path} begins {self.result.gap_s:,.1f} s after the end of {before.path}, as if a recording in "
                f"between were missing: no id is taken over, and new ones go on after those before (at most "
                f"{BRIDGED_S:g} s are bridged)",
                "clock",
            )
        #: The time in ns at which the lead begins.
        self.lead_ns = self._first_of_lead()

    def _check_camera(self, opened: log.Log) -> None:
        before, prefix = self._log, self._prefix
        names = [camera.prefix[1:] for camera in cameras(before)]
        if prefix[1:] not in names:
            raise McaptrackError(
                f"{opened.path} is of the camera {prefix[1:]}, and {before.path} is of "
                f"{', '.join(sorted(names)) or 'none'}; ids go on from one recording of a camera to the next"
            )
        again = call("run", before.path)
        if not _is_tracked(before, self.tracks) or not before.channels[self.tracks].messages:
            raise McaptrackError(f"{before.path} has no tracks that ids could go on from; {again} makes them")
        if is_stale(before, self.tracks):
            raise McaptrackError(f"{before.path}: {self.tracks} is out of date; {again} brings it up to date")
        if self.tracks in opened.channels and not _is_tracked(opened, self.tracks):
            raise McaptrackError(
                f"{opened.path}: {self.tracks} wasn't made by `track`, so that its ids stay as they are"
            )
        sizes = [picture_size(each, camera_at(each, prefix).pictures) for each in (before, opened)]
        if None not in sizes and sizes[0] != sizes[1]:
            text = " and ".join("{} x {}".format(*size) for size in sizes if size)
            raise McaptrackError(
                f"{before.path} and {opened.path} have pictures of {text} pixels; they are not of one camera"
            )

    def _check_times(self, opened: log.Log, first_ns: int) -> None:
        before, start_ns, end_ns = self._log, self.start_ns, self._end_ns
        if start_ns > end_ns:
            return
        said = f"{opened.path} begins at {start_ns / NS_PER_S:.3f} s, and {before.path}"
        clock = "; if the times are wrong, ingest each with its `start_time=`" if start_ns == first_ns else ""
        if start_ns <= first_ns:
            raise McaptrackError(
                f"{said}, which is to be the one before, at {first_ns / NS_PER_S:.3f} s: name recordings in the order "
                f"of their times{clock}"
            )
        raise McaptrackError(
            f"{said} ends at {end_ns / NS_PER_S:.3f} s: they overlap by {(end_ns - start_ns) / NS_PER_S:.3f} s, and "
            "ids go on only from one recording to the next"
        )

    def _first_of_lead(self) -> int:
        """The time in ns at which the lead begins: that of a sample, so that samples go on at the same intervals."""
        wanted = max(self._end_ns - round(LEAD_S * NS_PER_S), 0)
        samples = f"{self._prefix}/{STAGES['sample'].output_topic}"
        ticks = self._log.times(samples) if samples in self._log.channels else np.empty(0, np.int64)
        later = ticks[ticks >= wanted]
        return int(later[0]) if len(later) else wanted

    def _has_tracks(self, topic: str) -> bool:
        return self._log.holds(topic, TRACKS) and self._log.channels[topic].messages > 0

    def renewed(self, opened: log.Log) -> set[str]:
        """Return the channels with ids that don't continue those of the log before, and have to be made again."""
        provenance = provenance_of(opened, self.tracks)
        is_new = provenance is not None and provenance.continued.get(AFTER) != digest_of(self._log, self.tracks)
        return {self.tracks} if is_new else set()

    def lead(self, job: Job, own: Sequence[Frame], planes: Planes) -> list[Frame]:
        """The last frames of the input of a job in the log before, in metres of ``planes``.

        Their numbers are those before the frames of this log, ``own``.
        """
        provenance = provenance_of(self._log, job.target)
        source = provenance.input if provenance and provenance.transform == job.stage else job.source
        if not _is_led(job) or not self.is_bridged or source not in self._log.channels:
            return []
        input_frames = read_named_frames(self._log, source, job.transform.reads, job.frame_id).frames
        low = int(np.searchsorted(frame_times(input_frames), self.lead_ns))
        frames = input_frames[low:]
        if job.transform.reads is TRACKS and _differ(read_planes(self._log, self._prefix), planes):
            frames = [frame._replace(rows=_in_planes(frame, planes)) for frame in frames]
        missing = round(self.result.gap_s * NS_PER_S / self._period_ns) if self._period_ns else 1
        shift = (own[0].index if own else 0) - max(missing, 1) - (frames[-1].index if frames else 0)
        return [frame._replace(index=frame.index + shift) for frame in frames]

    def own(self, job: Job, outputs: Sequence[Sequence[Frame]]) -> tuple[list[Sequence[Frame]], dict[str, str]]:
        """Return the outputs of a job without the lead, with continued ids, and facts about that for the provenance."""
        if not _is_led(job):
            return [*outputs], {}
        schemas, topics = list(job.transform.writes.values()), list(job.outputs())
        if not _gives_ids(job) or not self._has_tracks(job.target):
            return [self._kept(schema, output, None) for schema, output in zip(schemas, outputs, strict=True)], {}
        last_id = self._last_id(job)
        maps: dict[str, dict[int, int]] = {}
        for topic, schema, frames in zip(topics, schemas, outputs, strict=True):
            if schema is TRACKS:
                maps[topic] = self._same(topic, frames)
        of_predictions = maps.get(f"{job.target}/online", maps.get(job.target, {}))
        out: list[Sequence[Frame]] = []
        largest = last_id
        for topic, schema, frames in zip(topics, schemas, outputs, strict=True):
            if schema not in (TRACKS, PREDICTIONS, DECISIONS, APPEARANCE, WORLDS):
                out.append(self._kept(schema, frames, None))
                continue
            of_main = maps.get(job.target, {})
            same = maps.get(topic, of_main if schema in (DECISIONS, APPEARANCE, WORLDS) else of_predictions)
            kept = self._kept(schema, frames, partial(_renumbered, same=same, last_id=last_id))
            largest = max(largest, int(unique_values(schema, kept, "track_id").max(initial=0)))
            out.append(kept)
        self._count(job.target, out[0])
        return out, {AFTER: digest_of(self._log, job.target), LAST_ID: str(largest)}

    def _last_id(self, job: Job) -> int:
        """Return the largest id in the log before, and in all logs that it continues."""
        provenance = provenance_of(self._log, job.target)
        last_id = provenance.continued.get(LAST_ID, "") if provenance else ""
        largest = int(last_id) if last_id.isascii() and last_id.isdigit() and len(last_id) < 19 else 0
        for topic, schema in job.outputs().items():
            if schema is TRACKS and self._has_tracks(topic):
                ids = unique_values(TRACKS, self._log.frame_columns(topic, TRACKS), "track_id")
                largest = max(largest, int(ids.max(initial=0)))
        return largest

    def _same(self, topic: str, frames: Sequence[Frame]) -> dict[int, int]:
        """Return the ids of tracks in the log before, by the ids of the same tracks in this log."""
        if not self.is_bridged or not self._has_tracks(topic):
            return {}
        before = self._log.frame_columns(topic, TRACKS)
        low = int(np.searchsorted(frame_times(before), self.lead_ns))
        rows_at = {frame.t_ns: frame.rows for frame in before[low:]}
        end_ns = self.start_ns + round(_AT_CUT_S * NS_PER_S)
        near = list(takewhile(lambda frame: frame.t_ns < end_ns, frames))
        votes: defaultdict[tuple[int, int], float] = defaultdict(float)
        for frame in near:
            if frame.t_ns < self.start_ns and frame.t_ns in rows_at:
                weight = 0.5 ** ((self.start_ns - frame.t_ns) / NS_PER_S / _HALF_S)
                for pair in _pairs(frame.rows, rows_at[frame.t_ns]):
                    votes[pair] += weight
        if topic != self.tracks:
            rows_after = (frame.rows for frame in near if frame.t_ns >= self.start_ns)
            for pair in _of_one_source(rows_at.values(), rows_after):
                votes[pair] += _OF_SOURCE
        return _elected(votes)

    def _kept(self, schema: Schema, frames: Sequence[Frame], number: Callable[[Ints], Ints] | None) -> Sequence[Frame]:
        """Return the frames of this log without those of the lead; ``number`` returns the new ids of rows."""
        collector = FrameCollector(schema)
        for frame in frames:
            if frame.t_ns < self.start_ns:
                continue
            rows = frame.rows
            if number is not None and len(rows):
                rows = rows.copy()
                rows["track_id"] = number(rows["track_id"])
            collector.append(frame._replace(rows=rows))
        return collector.done()

    def _count(self, topic: str, frames: Sequence[Frame]) -> None:
        """Count the ids at the cut, and those of them that go on."""
        before = self._log.frame_columns(topic, TRACKS)
        low = int(np.searchsorted(frame_times(before), self._end_ns - round(_AT_CUT_S * NS_PER_S)))
        ids_at_cut = set(np.unique(before.rows(low)["track_id"]).tolist())
        self.result.at_cut[topic] = len(ids_at_cut)
        self.result.kept[topic] = len(ids_at_cut & set(unique_values(TRACKS, frames, "track_id").tolist()))


def _is_led(job: Job) -> bool:
    """Return whether a job begins with the last seconds of the log before: if it reads rows, and not pictures."""
    return job.transform.reads is not VIDEO


def _gives_ids(job: Job) -> bool:
    """Return whether the output of a job has ids of its own."""
    return job.transform.reads is DETECTIONS or STAGES[job.stage].repairs_tracks


def _is_tracked(opened: log.Log, topic: str) -> bool:
    """Return whether a stage made the tracks in a channel of detections."""
    provenance = provenance_of(opened, topic)
    stage = STAGES.get(provenance.transform) if provenance else None
    return stage is not None and stage.reads is DETECTIONS


def _start_ns(opened: log.Log, prefix: str) -> int:
    """The time in ns at which a camera begins: that of its first picture, or of its first detections."""
    camera = camera_at(opened, prefix)
    for topic in (camera.pictures, f"{prefix}/{STAGES['detect'].output_topic}", camera.boxes):
        if topic and topic in opened.channels and opened.channels[topic].messages:
            return int(opened.times(topic)[0])
    raise McaptrackError(f"{opened.path} has no pictures and no detections of {prefix[1:]} that could be tracked")


def warn_unfollowed(opened: log.Log, job: Job) -> None:
    """Warn that ids which continued those of another log begin at 1 again, because this run names no log before."""
    provenance = provenance_of(opened, job.target)
    if _gives_ids(job) and provenance is not None and provenance.continued:
        warn(
            f"{job.target} went on from another log, and its ids are made without it now; name both, in order, with "
            "`follows=` to go on again",
            "other-settings",
        )


def _renumbered(ids: Ints, same: Mapping[int, int], last_id: int) -> Ints:
    """Ids (N,): those of the log before for tracks that go on, and others after ``last_id``."""
    out = np.where(ids < 0, ids, ids + last_id)
    for mine, theirs in same.items():
        out[ids == mine] = theirs
    return out


def _elected(votes: Mapping[tuple[int, int], float]) -> dict[int, int]:
    """Return pairs of ids with the most votes first, each id once."""
    out: dict[int, int] = {}
    for (mine, theirs), _ in sorted(votes.items(), key=lambda vote: (-vote[1], vote[0])):
        if mine not in out and theirs not in out.values():
            out[mine] = theirs
    return out


def _of_one_source(before: Iterable[Rows], after: Iterable[Rows]) -> Iterator[tuple[int, int]]:
    """Ids of re-tracked tracks after the cut, each with the id before it of the track that it begins with."""
    last: dict[int, int] = {}
    for rows in before:
        last |= dict(zip(rows["source_id"].tolist(), rows["track_id"].tolist(), strict=True))
    begun: set[int] = set()
    for rows in after:
        for source, track_id in zip(rows["source_id"].tolist(), rows["track_id"].tolist(), strict=True):
            if source >= 0 and source in last and track_id not in begun:
                yield track_id, last[source]
            begun.add(track_id)


def _pairs(mine: Rows, theirs: Rows) -> list[tuple[int, int]]:
    """Pairs of ids of rows at one time that are at the same place: each is the nearest of the other."""
    if not len(mine) or not len(theirs):
        return []
    away = _distances(mine, theirs)
    nearest = away.argmin(axis=1)
    is_pair = (away.min(axis=1) <= 1.0) & (away.argmin(axis=0)[nearest] == np.arange(len(mine)))
    pairs = zip(mine["track_id"][is_pair].tolist(), theirs["track_id"][nearest[is_pair]].tolist(), strict=True)
    return [*pairs]


def _distances(mine: Rows, theirs: Rows) -> Floats:
    """Distances (T, U) between rows, divided by the largest at which two rows can be of one person."""
    boxes, others = columns_to_boxes(mine), columns_to_boxes(theirs)
    middle, other = (box[:, :2] + box[:, 2:] / 2 for box in (boxes, others))
    apart = np.hypot(*(middle[:, None] - other).transpose(2, 0, 1))
    away = apart / np.maximum(_NEAR_HEIGHTS * others[:, 3], 1e-9)
    on_ground = [np.stack([rows["x_m"], rows["y_m"]], axis=-1) for rows in (mine, theirs)]
    metres = np.hypot(*(on_ground[0][:, None] - on_ground[1]).transpose(2, 0, 1)) / _NEAR_M
    out: Floats = np.nan_to_num(np.where(np.isfinite(away), away, metres), nan=np.inf)
    return out


def _differ(before: Planes | None, planes: Planes) -> bool:
    return [plane for _, plane in before or ()] != [plane for _, plane in planes]


def _in_planes(frame: Frame, planes: Planes) -> Rows:
    """Return the rows of a frame; those with boxes get their positions by ``planes``."""
    plane, boxes = plane_at(planes, frame.t_ns), columns_to_boxes(frame.rows)
    at = np.flatnonzero(np.isfinite(boxes).all(axis=1))
    if plane is None or not len(at):
        return frame.rows
    rows = frame.rows.copy()
    rows["x_m"][at], rows["y_m"][at] = plane.boxes_to_metres(boxes[at]).T
    on_ground: Rows = rows[np.isfinite(rows["x_m"])]
    return on_ground
