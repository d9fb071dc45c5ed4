"""Fuse the detections of the cameras of a log: gather what they see at one time, and run a fuser on it.

Letters: C cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.extensions.cameras.feet import LEAST_COMPARED, CameraView, FootFuser, Joined, Offset, Shared, compare
from mcaptrack.extensions.cameras.scenes import FUSION, fuser_of
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import is_assumed, runs_of_planes
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.location import Location
from mcaptrack.notices import Progress, Say, collected, warn
from mcaptrack.pipeline.checks import cameras_named, describe_origin, may_replace, read_named_frames
from mcaptrack.pipeline.rebuild import plugins_of
from mcaptrack.pipeline.several import split_by_lack
from mcaptrack.pipeline.staleness import digest_of, is_stale, read_planes
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import DETECTIONS, SIGHTINGS, Frame, Rows, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_times, nearest_times, split_rows
from mcaptrack.schema.provenance import FUSE, Provenance, frame_id_of
from mcaptrack.sources.cameras import Camera, cameras, detections_of, detections_topic, provenance_of, scenes_of
from mcaptrack.transforms import Transform
from mcaptrack.transforms.guarded import guarded


def fuse_again(
    opened: log.Log,
    prefix: str,
    force: bool,
    say: Say,
    progress: Progress,
    adds: bool = False,
    fuser: Transform | None = None,
) -> dict[str, Made] | None:
    """Make the scene below ``prefix`` again if it is out of date, or with ``force``.

    Returns {} if there is nothing to do, and None if no fuser made it. The cameras and parameters are those that it was
    made with; so are offsets of clocks that were given. With ``adds`` it is also made again if cameras can be fused now
    that it lacks, unless its cameras were chosen; so it is by ``fuser``, if that is another one than before. Raises
    McaptrackError as ``fuse_cameras`` does, and if the fuser that made it is not installed.
    """
    target = next(iter(_topics(prefix)))
    provenance = provenance_of(opened, target)
    if provenance is None or FUSION.kind not in provenance.parameters:
        return None
    parameters = provenance.parameters
    names, is_chosen = list(map(str, parameters["cameras"])), bool(parameters.get("cameras_given"))
    more = sorted({*fusable(opened, (), prefix)[0]} - {*names}) if adds and not is_chosen else []
    wanted, other, why_not = _fuser_again(provenance, fuser, force)
    if not (other or more or force or is_stale(opened, target)):
        return {}
    if wanted is None:
        raise McaptrackError(f"{opened.path}: {target} can't be made again: {why_not}")
    why = f"was made without {', '.join(more)}" if more else "was made from earlier detections or ground planes"
    how = "as before"
    if other:
        why, how = other, f"by the {FUSION.entry(type(wanted))}"
    offset_s = dict(zip(names, parameters["clock_offset_s"], strict=True))
    given_offset_s = {name: float(offset_s[name]) for name in parameters.get("clock_offsets_given", ())}
    names = sorted((*names, *more)) if more else names
    say(f"{target} {why}: fusing {', '.join(names)} again, {how}")
    return fuse_cameras(opened, names, prefix, wanted, given_offset_s, progress, is_chosen, takes_strangers=True)


def _fuser_again(
    provenance: Provenance, named: Transform | None, force: bool
) -> tuple[Transform | None, str, McaptrackError | None]:
    """The fuser to make a scene again with, what to say if it is another than before, and why there is none."""
    before, why_not = fuser_of(provenance, named)
    if named is None:
        return before, "", why_not
    if before is not None and FUSION.choice(before) == FUSION.choice(named):
        return named if force else before, "", None
    return named, f"was made by {'another fuser' if before is None else f'the {FUSION.entry(type(before))}'}", None


# Gather the boxes of the cameras of a log at one time, and compare the cameras.
#
# Letters: C cameras.


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
        nearest = [nearest_times(source.t_ns, self.at.t_ns) for source in self._sources]
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


def frame_of_plane(opened: log.Log, camera: Camera) -> str:
    """The frame of the metres of a camera's ground plane."""
    return frame_id_of(opened.channels[camera.ground_plane].metadata) or _FRAME


def frames_in_words(frames: Mapping[str, str]) -> str:
    """Describe the frames of reference of cameras, by name."""
    return ", ".join(f"{name} in {frame}" for name, frame in frames.items())


class Detected(NamedTuple):
    """The detections of cameras; the digests of what they were read from; the classes, and the frame of metres."""

    sources: list[Source]
    references: dict[str, str]
    classes: dict[str, str]
    frame_id: str


def read_sources(opened: log.Log, chosen: Sequence[Camera], clock_offset_s: Mapping[str, float]) -> Detected:
    """Read the detections of the cameras."""
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
        sources.append(Source(topic, named_frames.frames, frame_times(named_frames.frames), view))
    if not sources:
        raise McaptrackError(f"{opened.path} has no detections to fuse: all channels are empty")
    if len(set(frames_of.values())) > 1:
        raise McaptrackError(f"{opened.path}: the ground planes are in different frames: {frames_in_words(frames_of)}")
    return Detected(set_back(sources, clock_offset_s), references, classes, next(iter(frames_of.values())))


class Compared(NamedTuple):
    """Cameras as they agree: what they see at one time, a fuser that knows them, and what was found about each."""

    gathered: Gathered
    fuser: FootFuser
    offsets: tuple[Offset, ...]
    offset_s: dict[str, float]
    shared: Shared


def set_back(sources: Sequence[Source], late_s: Mapping[str, float]) -> list[Source]:
    """Take from the times of cameras how late they are."""
    late_ns = [round(late_s.get(source.view.name, 0.0) * NS_PER_S) for source in sources]
    return [source._replace(t_ns=source.t_ns - late) for source, late in zip(sources, late_ns, strict=True)]


def compared_cameras(sources: list[Source], fuser: FootFuser, given_offset_s: Mapping[str, float]) -> Compared:
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
        sources = set_back(sources, {worst: late[worst]})
    return Compared(gathered, replace(fuser, views=views), offsets, offset_s, shared)


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
        if offset.compared >= LEAST_COMPARED and offset.distance_m > _FAR_M:
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
        if len(views) > 1 and offset.compared < LEAST_COMPARED:
            warn(
                f"{name}: only {offset.compared} of its boxes are near people seen by two other cameras, too few to "
                f"compare it with the others{farther}",
                "other",
            )


def fusable(opened: log.Log, names: Sequence[str] = (), scene: str = "/world") -> tuple[list[str], str]:
    """Return the names of the cameras that can be fused, of these or of all, and why others, or all, can't be.

    They can if two cameras have detections and a measured ground plane, in the same frame.
    """
    able, lacks = _able(opened, sorted(names), scene)
    frames = {camera.prefix[1:]: frame_of_plane(opened, camera) for camera in able}
    why = "; ".join(f"{name} {reason}" for name, reason in lacks.items())
    if len(frames) < 2:
        only = f"only {next(iter(frames))} can be fused" if frames else ""
        return [], ", since ".join(filter(None, (only, why))) or "it has no camera"
    if len(set(frames.values())) > 1:
        return [], f"their ground planes are in different frames, {frames_in_words(frames)}"
    return [*frames], why


def _able(opened: log.Log, names: Sequence[str], scene: str) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras that can be fused, of these or of all, and why others can't be, by name."""
    scenes = {scene, *scenes_of(opened)}
    ours = [camera for camera in cameras(opened) if camera.prefix not in scenes]
    return split_by_lack(cameras_named(opened, names, ours) if names else ours, partial(_lack, opened))


def _topics(prefix: str) -> dict[str, Schema]:
    """The schemas of the channels of a scene, the main one first."""
    target = detections_topic(prefix)
    return {target: DETECTIONS, f"{target}/sightings": SIGHTINGS}


def fuse_cameras(
    opened: log.Log,
    names: Sequence[str],
    prefix: str,
    fuser: Transform,
    clock_offset_s: Mapping[str, float],
    progress: Progress,
    is_chosen: bool,
    takes_strangers: bool,
) -> dict[str, Made]:
    """Fuse the detections of cameras.

    Parameters
    ----------
    opened : Log
    names : sequence of str
        The cameras; without any, all that have detections and a ground plane.
    prefix : str
        The name of the scene, as that of a camera.
    fuser : Transform
        As of ``FUSION``.
    clock_offset_s : mapping of str to float
        How much later than the others the times of a camera are; others are estimated.
    progress : callable
        Called as ``progress(stage, done, total)``.
    is_chosen, takes_strangers : bool
        Whether the user named the cameras; and whether they are fused even if they don't see the same people.

    Returns
    -------
    dict of str to Made
        The channels by topic.

    Raises
    ------
    McaptrackError
        If there is nothing to fuse, or if a channel that others recorded would be replaced; without
        ``takes_strangers`` also if the cameras don't agree.
    """
    for topic in _topics(prefix):
        if not may_replace(opened, topic, FUSE):
            raise McaptrackError(
                f"{opened.path}: {topic} {describe_origin(opened, topic)}; give the scene another name with `to=`"
            )
    with collected() as warnings:
        detected = read_sources(opened, _chosen(opened, names, prefix), clock_offset_s)
        compared = compared_cameras(detected.sources, _feet_of(fuser), clock_offset_s)
        gathered, views, offset_s = compared.gathered, compared.fuser.views, compared.offset_s
        if compared.shared.are_strangers and not takes_strangers:
            raise McaptrackError(f"{compared.shared}; `mcaptrack.fuse` fuses them nevertheless")
        fuser = _with_views(fuser, compared.fuser)
        detections, sightings = _results(fuser, compared, progress)
        if compared.shared.are_strangers:
            warn(str(compared.shared), "cameras-disagree")
        warn_disagreeing(opened.path, views, compared.offsets, offset_s, clock_offset_s)
        if gathered.left_out:
            warn(
                f"{gathered.left_out} frames of {gathered.at.view.name} are left out: they are before time 0, as its "
                "clock is late",
                "left-out",
            )
    parameters = {
        **{field.name: getattr(fuser, field.name) for field in fields(fuser) if not field.metadata.get("context")},
        "fuser": FUSION.entry(type(fuser)).name,
        "cameras": [view.name for view in views],
        "clock_offset_s": [offset_s[view.name] for view in views],
        "clock_offsets_given": sorted(clock_offset_s),
        **({"cameras_given": True} if is_chosen else {}),
        "detects": [[round(rate, 4) for rate in view.detects] for view in views],
        "false_share": [round(view.false_share, 4) for view in views],
    }
    how = Provenance(
        FUSE,
        parameters,
        references=detected.references,
        classes=detected.classes,
        frame_id=detected.frame_id,
        plugins=plugins_of(FUSION, fuser),
        warnings=[(notice.code, notice.message) for notice in warnings],
    )
    target, below = _topics(prefix)
    scene = Made.of(DETECTIONS, detections, how)
    # The sightings belong to the scene, too, and not to a camera of their own.
    of_scene = replace(how, input=target, input_digest=scene.provenance.digest)
    return {target: scene, below: Made.of(SIGHTINGS, sightings, of_scene)}


def _results(fuser: Transform, compared: Compared, progress: Progress) -> list[Sequence[Frame]]:
    """Run the fuser; return the frames of detections, and those of the sightings that they are made of."""
    collectors = {"": FrameCollector(DETECTIONS), "sightings": FrameCollector(SIGHTINGS)}
    gathered = compared.gathered
    results: Iterator[tuple[Frame, ...]]
    if type(fuser) is FootFuser:
        results = compared.fuser.fused(gathered.joined(compared.fuser))
    else:
        results = guarded(FUSION.entry(type(fuser)), fuser, gathered)
    for count, result in enumerate(results, start=1):
        progress(FUSE, count, len(gathered))
        by_suffix = dict(zip(fuser.writes, result, strict=True))
        for suffix, collector in collectors.items():
            collector.append(by_suffix[suffix])
    return [collector.done() for collector in collectors.values()]


def _feet_of(fuser: Transform) -> FootFuser:
    """Return the fuser by which cameras are compared: a ``FootFuser`` itself, else the usual one with its noise."""
    if isinstance(fuser, FootFuser):
        return fuser
    return FootFuser(**{name: getattr(fuser, name) for name in ("noise", "noise_m") if hasattr(fuser, name)})


def _with_views(fuser: Transform, feet: FootFuser) -> Transform:
    """A fuser with the views of the cameras, if it has a field for them."""
    if isinstance(fuser, FootFuser):
        return feet
    names = {field.name for field in fields(fuser) if field.metadata.get("context")}
    return replace(fuser, views=feet.views) if "views" in names else fuser


def _chosen(opened: log.Log, names: Sequence[str], scene: str) -> list[Camera]:
    """The cameras to fuse. Raises McaptrackError if one is not there, or lacks something."""
    chosen, lacks = _able(opened, names, scene)
    for name, why in lacks.items() if names else ():
        raise McaptrackError(f"{opened.path}: {name} {why}")
    if not chosen:
        why = "; ".join(f"{name} {why}" for name, why in lacks.items()) or "it has no camera"
        raise McaptrackError(f"{opened.path} has no detections to fuse: {why}")
    for name, why in lacks.items():
        warn(f"{name} is left out: it {why}", "left-out")
    return chosen


def _lack(opened: log.Log, camera: Camera) -> str:
    """The reason why a camera can't be fused, and a remedy; "" if it can."""
    planes = read_planes(opened, camera.prefix)
    if detections_of(opened, camera) is None:
        again = call("detect", opened.path, camera=camera.prefix[1:])
        return f"has no detections; {again} makes them"
    if not planes:
        return "has no ground plane; ingest what it recorded with `ground_plane=`"
    if is_assumed(planes):
        return "has a ground plane that was estimated, in metres of its own; the cameras need measured ones"
    return ""
