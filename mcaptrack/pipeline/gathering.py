"""Gather the boxes of the cameras of a log at one time, and compare the cameras.

Letters: C cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import runs_of_planes
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.location import Location
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import read_named_frames
from mcaptrack.pipeline.planes import read_planes
from mcaptrack.pipeline.write import digest_of
from mcaptrack.schema import DETECTIONS, SIGHTINGS, Frame, Rows
from mcaptrack.schema.framing import frame_times, split_rows
from mcaptrack.schema.provenance import frame_id_of
from mcaptrack.sources.cameras import Camera, detections_of
from mcaptrack.transforms.fuse import CameraView, FootFuser, Joined, Offset, Shared, compare

#: The frame of the metres, if the ground planes name none.
_FRAME: Final = "map"
#: Pictures of other cameras count up to this share of the time between those of the slowest camera away from it.
_WITHIN: Final = 0.5
_MOST_WITHIN_S: Final = 0.5
#: Frames are gathered so many at once: for few boxes, calls take longer than computing.
_TOGETHER: Final = 64
#: Sightings that are kept with their groups, so that they are joined once for comparing cameras and for fusing.
_KEPT_BYTES: Final = 2**25
#: How far people walk, in metres per second: what a box of another time says less precisely.
_PACE_M_PER_S: Final = 1.0
#: Cameras are compared by at most so many frames.
_COMPARED: Final = 3000
#: Offsets of a camera that are named: in metres, and in seconds.
_FAR_M, _LATE_S = 0.25, 0.12
#: Fewer comparisons say nothing about a camera.
_LEAST: Final = 50


class Source(NamedTuple):
    """The detections of a camera."""

    topic: str
    frames: Sequence[Frame]
    t_ns: Ints  # (frames,) with the offset of its clock taken off
    view: CameraView


class Gathered:
    """The boxes of all cameras at the times of the slowest one, as frames of sightings; read at each iteration."""

    def __init__(self, sources: Sequence[Source], fuser: FootFuser) -> None:
        self._sources, self._noise, self._noise_m = sources, fuser.noise, fuser.noise_m
        self.at = min(sources, key=lambda source: len(source.frames) / max(float(np.ptp(source.t_ns)), 1.0))
        step_s = float(np.median(np.diff(self.at.t_ns))) / NS_PER_S if len(self.at.t_ns) > 1 else _MOST_WITHIN_S
        self._within_ns = round(min(_WITHIN * step_s, _MOST_WITHIN_S) * NS_PER_S)
        #: Frames before time 0, where the clock of the slowest camera is late by more than the beginning of the log.
        self.left_out = int(np.searchsorted(self.at.t_ns, 0))
        self._joined: list[Joined] = []

    def __len__(self) -> int:
        return len(self.at.t_ns) - self.left_out

    def __iter__(self) -> Iterator[Frame]:
        return self._from(self.left_out)

    def joined(self, fuser: FootFuser, keeps: bool = False) -> Iterator[Joined]:
        """The same frames with their boxes joined; with ``keeps`` the first ones are kept for the next time."""
        yield from self._joined
        taken = sum(len(block.frames) for block in self._joined)
        room = _KEPT_BYTES - sum(block.rows.nbytes for block in self._joined)
        for block in fuser.joined(self._from(self.left_out + taken)):
            room -= block.rows.nbytes
            if keeps and room >= 0:
                self._joined.append(block)
            yield block

    def _from(self, begin: int) -> Iterator[Frame]:
        nearest = [_nearest(source.t_ns, self.at.t_ns) for source in self._sources]
        for first in range(begin, len(self.at.t_ns), _TOGETHER):
            yield from self._frames(range(first, min(first + _TOGETHER, len(self.at.t_ns))), nearest)

    def _frames(self, numbers: range, nearest: Sequence[Ints]) -> list[Frame]:
        """The frames of these numbers; ``nearest`` are the frames of each camera at all times."""
        times = self.at.t_ns[numbers.start : numbers.stop]
        parts, counts = [], []
        for camera, source in enumerate(self._sources):
            index = nearest[camera][numbers.start : numbers.stop]
            away_ns = source.t_ns[index] - times
            near = np.abs(away_ns) <= self._within_ns
            frames = [source.frames[number] for number in index[near].tolist()]
            rows, frame = self._seen(camera, source, frames, away_ns[near] / NS_PER_S)
            parts.append(rows)
            counts.append(np.flatnonzero(near)[frame])
        rows, frame = SIGHTINGS.joined(parts), np.concatenate(counts)
        rows = rows[np.argsort(frame, kind="stable")]
        ends = np.cumsum(np.bincount(frame, minlength=len(times)))
        return split_rows(times.tolist(), [self.at.frames[number].index for number in numbers], rows, ends)

    def _seen(self, camera: int, source: Source, frames: Sequence[Frame], away_s: Floats) -> tuple[Rows, Ints]:
        """The sightings of a camera in its frames, each so far away in time, and the frame of each."""
        if not frames:
            return SIGHTINGS.empty(), np.empty(0, np.int64)
        counts = [len(frame.rows) for frame in frames]
        frame, rows = group_index(counts), DETECTIONS.joined([frame.rows for frame in frames])
        noise_m, xywh = np.hypot(self._noise_m, _PACE_M_PER_S * away_s)[frame], columns_to_boxes(rows)
        times, ends = np.array([frame.t_ns for frame in frames]), np.cumsum(counts).tolist()
        places = [
            source.view.places(xywh[part], int(times[low]), self._noise, noise_m[part])
            for low, high in runs_of_planes(source.view.planes, times.tolist())
            for part in [slice(ends[low] - counts[low], ends[high - 1])]
        ]
        xy_m, cov = (np.concatenate(columns) for columns in zip(*places, strict=True))
        at = np.flatnonzero(np.isfinite(xy_m[:, 0]))
        out = SIGHTINGS.empty(len(at))
        out["camera"], out["picture_ns"], out["box_row"] = camera, times[frame[at]], ragged_range(0, counts)[at]
        out["x_m"], out["y_m"] = xy_m[at].T
        out["cov_xx_m2"], out["cov_xy_m2"], out["cov_yy_m2"] = cov[at].T
        out["score"], out["class_id"] = rows["score"][at], rows["class_id"][at]
        return out, frame[at]


def _nearest(t_ns: Ints, at_ns: Ints) -> Ints:
    """The index of the time in ``t_ns`` that is nearest to each of ``at_ns``; the earlier one of two."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, max(len(t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(t_ns) - 1)
    out: Ints = np.where(at_ns - t_ns[before] <= t_ns[after] - at_ns, before, after)
    return out


def frame_of_plane(opened: log.Log, camera: Camera) -> str:
    """The frame of the metres of a camera's ground plane."""
    return frame_id_of(opened.channels[camera.ground_plane].metadata) or _FRAME


def frames_in_words(frames: Mapping[str, str]) -> str:
    """Describe the frames of reference of cameras, by name."""
    return ", ".join(f"{name} in {frame}" for name, frame in frames.items())


def read_sources(
    opened: log.Log, chosen: Sequence[Camera], clock_offset_s: Mapping[str, float]
) -> tuple[list[Source], dict[str, str], dict[str, str], str]:
    """The detections of the cameras; the digests of what they were read from; the classes, and the frame of metres."""
    names = [camera.prefix[1:] for camera in chosen]
    for name in clock_offset_s:
        if name not in names:
            raise McaptrackError(f"`clock_offset_s=` has {name}, which is not fused; {', '.join(names)} are")
    sources: list[Source] = []
    references: dict[str, str] = {}
    classes: dict[str, str] = {}
    frames_of: dict[str, str] = {}
    for camera in chosen:
        name, topic = camera.prefix[1:], detections_of(opened, camera)
        assert topic is not None
        named_frames = read_named_frames(opened, topic, DETECTIONS)
        if not len(named_frames.frames):
            warn(f"{name} is left out: {topic} has no messages", "left-out")
            continue
        references |= {topic: digest_of(opened, topic), camera.ground_plane: digest_of(opened, camera.ground_plane)}
        for number, word in named_frames.classes.items():
            if classes.setdefault(str(number), word) != word:
                raise McaptrackError(
                    f"{opened.path}: class {number} is {classes[str(number)]} in one camera and {word} in {topic}; "
                    "detect them by the same detector"
                )
        frames_of[name] = frame_of_plane(opened, camera)
        view = CameraView(name=name, planes=tuple(read_planes(opened, camera.prefix) or ()))
        view = view.with_heights_in(named_frames.frames)
        t_ns = frame_times(named_frames.frames)
        offset_ns = round(clock_offset_s.get(name, 0.0) * NS_PER_S)
        sources.append(Source(topic, named_frames.frames, t_ns - offset_ns, view))
    if not sources:
        raise McaptrackError(f"{opened.path} has no detections to fuse: all channels are empty")
    if len(set(frames_of.values())) > 1:
        raise McaptrackError(f"{opened.path}: the ground planes are in different frames: {frames_in_words(frames_of)}")
    return sources, references, classes, next(iter(frames_of.values()))


def compared_cameras(
    sources: list[Source], fuser: FootFuser, given_offset_s: Mapping[str, float]
) -> tuple[Gathered, FootFuser, tuple[Offset, ...], dict[str, float], Shared]:
    """Estimate how well the cameras agree, and the offsets of clocks that are not given."""
    offset_s = {source.view.name: given_offset_s.get(source.view.name, 0.0) for source in sources}
    for _ in range(3):
        gathered = Gathered(sources, fuser)
        fuser = replace(fuser, views=tuple(source.view for source in sources))
        every = max(len(gathered) // _COMPARED, 1)
        part = (frame for number, frame in enumerate(gathered) if number // 2 % every == 0)
        blocks = gathered.joined(fuser, keeps=True) if every == 1 else fuser.joined(part)
        taken_ns = [round(offset_s[source.view.name] * NS_PER_S) for source in sources]
        views, offsets, shared = compare(blocks, fuser.views, taken_ns)
        late = {
            view.name: round(offset.late_s, 3)
            for view, offset in zip(views, offsets, strict=True)
            if np.isfinite(offset.late_s)
        }
        worst = max(late, key=lambda name: abs(late[name]), default="")
        if not worst or worst in given_offset_s or abs(late[worst]) < _LATE_S:
            break
        # One camera at a time, the worst first, because those that are right look late beside it.
        offset_s[worst] = round(offset_s[worst] + late[worst], 3)
        shift_ns = round(late[worst] * NS_PER_S)
        sources = [
            source._replace(t_ns=source.t_ns - shift_ns) if source.view.name == worst else source for source in sources
        ]
    return gathered, replace(fuser, views=views), offsets, offset_s, shared


def warn_disagreeing(
    path: Location,
    views: Sequence[CameraView],
    offsets: Sequence[Offset],
    offset_s: Mapping[str, float],
    given_offset_s: Mapping[str, float],
) -> None:
    """Warn of cameras that disagree with the others; ``path`` is that of the log."""
    correct = call("calibrate", path)
    farther = f"; {call('calibrate', path, dry_run=True)} finds planes that are farther off" if len(views) > 2 else ""
    for view, offset in zip(views, offsets, strict=True):
        name, taken_s = view.name, offset_s[view.name]
        if offset.compared >= _LEAST and offset.distance_m > _FAR_M:
            warn(
                f"{name}: feet stand {offset.distance_m:.2f} m from where the other cameras see them (median of "
                f"{offset.compared}); its ground plane, or theirs, is not right; {correct} corrects it",
                "cameras-disagree",
            )
        if taken_s and name not in given_offset_s:
            warn(
                f"{name}: its times are {abs(taken_s):.2f} s {'late' if taken_s > 0 else 'early'}, as people who walk "
                f"show; this is taken off (`clock_offset_s=` sets it, with 0 for none)",
                "clock",
            )
        elif offset.late_s > _LATE_S or offset.late_s < -_LATE_S:
            warn(
                f"{name}: its times seem {abs(offset.late_s):.2f} s {'late' if offset.late_s > 0 else 'early'}, as "
                "people who walk show",
                "clock",
            )
        if len(views) > 1 and offset.compared < _LEAST:
            warn(
                f"{name}: only {offset.compared} of its boxes are near people seen by two other cameras, too few to "
                f"compare it with the others{farther}",
                "other",
            )
