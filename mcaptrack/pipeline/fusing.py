"""Fuse the detections of the cameras of a log: gather what they see at one time, and run a fuser on it.

Letters: C cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import is_assumed
from mcaptrack.notices import collected, warn
from mcaptrack.pipeline.checks import describe_origin, may_replace, read_named_frames
from mcaptrack.pipeline.planes import read_planes
from mcaptrack.pipeline.run import Report, outdated_by
from mcaptrack.pipeline.staleness import is_stale
from mcaptrack.pipeline.write import Made, digest_of, write
from mcaptrack.schema import BOX_PX, DETECTIONS, SIGHTINGS, Frame, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.provenance import FUSE, Provenance, frame_id_of
from mcaptrack.sources.cameras import Camera, cameras, provenance_of, scenes_of
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.fuse import CameraView, FootFuser, Offset, Shared, compare

#: The frame of the metres, if the ground planes name none.
_FRAME: Final = "map"
#: Pictures of other cameras count up to this share of the time between those of the slowest camera away from it.
_WITHIN: Final = 0.5
_MOST_WITHIN_S: Final = 0.5
#: How far people walk, in metres per second: what a box of another time says less precisely.
_PACE_M_PER_S: Final = 1.0
#: Cameras are compared by at most so many frames.
_COMPARED: Final = 3000
#: Offsets of a camera that are named: in metres, and in seconds.
_FAR_M, _LATE_S = 0.3, 0.12
#: Fewer comparisons say nothing about a camera.
_LEAST: Final = 50


class _Source(NamedTuple):
    """The detections of a camera."""

    topic: str
    frames: Sequence[Frame]
    t_ns: Ints  # (frames,) with the offset of its clock taken off
    view: CameraView


class Gathered:
    """The boxes of all cameras at the times of the slowest one, as frames of sightings; read at each iteration."""

    def __init__(self, sources: Sequence[_Source], fuser: FootFuser) -> None:
        self._sources, self._noise, self._noise_m = sources, fuser.noise, fuser.noise_m
        self.at = min(sources, key=lambda one: len(one.frames) / max(float(np.ptp(one.t_ns)), 1.0))
        step_s = float(np.median(np.diff(self.at.t_ns))) / NS_PER_S if len(self.at.t_ns) > 1 else _MOST_WITHIN_S
        self._within_ns = round(min(_WITHIN * step_s, _MOST_WITHIN_S) * NS_PER_S)
        #: Frames before time 0, where the clock of the slowest camera is late by more than the beginning of the log.
        self.left_out = int(np.searchsorted(self.at.t_ns, 0))

    def __len__(self) -> int:
        return len(self.at.t_ns) - self.left_out

    def __iter__(self) -> Iterator[Frame]:
        nearest = [_nearest(one.t_ns, self.at.t_ns) for one in self._sources]
        for number, t_ns in enumerate(self.at.t_ns.tolist()):
            if number < self.left_out:
                continue
            parts = []
            for camera, source in enumerate(self._sources):
                index = int(nearest[camera][number])
                away_ns = int(source.t_ns[index]) - t_ns
                if abs(away_ns) <= self._within_ns:
                    parts.append(self._seen(camera, source, source.frames[index], away_ns / NS_PER_S))
            rows = SIGHTINGS.joined(parts) if parts else SIGHTINGS.empty()
            yield Frame(t_ns, self.at.frames[number].index, rows)

    def _seen(self, camera: int, source: _Source, frame: Frame, away_s: float) -> Any:
        """The sightings of one camera."""
        rows, noise_m = frame.rows, float(np.hypot(self._noise_m, _PACE_M_PER_S * away_s))
        xy_m, cov = source.view.places(columns_to_boxes(rows), frame.t_ns, self._noise, noise_m)
        at = np.flatnonzero(np.isfinite(xy_m[:, 0]))
        out = SIGHTINGS.empty(len(at))
        out["camera"], out["picture_ns"], out["box_row"] = camera, frame.t_ns, at
        out["x_m"], out["y_m"] = xy_m[at].T
        out["cov_xx_m2"], out["cov_xy_m2"], out["cov_yy_m2"] = cov[at].T
        out["score"], out["class_id"] = rows["score"][at], rows["class_id"][at]
        return out


def _nearest(t_ns: Ints, at_ns: Ints) -> Ints:
    """The index of the time in ``t_ns`` that is nearest to each of ``at_ns``; the earlier one of two."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, max(len(t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(t_ns) - 1)
    out: Ints = np.where(at_ns - t_ns[before] <= t_ns[after] - at_ns, before, after)
    return out


def fuse_cameras(
    opened: log.Log,
    names: Sequence[str],
    scene: str,
    fuser: FootFuser,
    clock_offset_s: Mapping[str, float],
    output: Path | None,
    progress: Callable[[str, int, int], None],
    is_asked: bool = True,
) -> tuple[str, Report]:
    """Fuse the detections of cameras, and write them below the name of the scene.

    Parameters
    ----------
    opened : Log
    names : sequence of str
        The cameras; without any, all that have detections and a ground plane.
    scene : str
        The name below which results are written, as if it were a camera.
    fuser : FootFuser
    clock_offset_s : mapping of str to float
        How much later than the others the times of a camera are; others are estimated.
    output : Path or None
        Write to this copy instead.
    progress : callable
        Called as ``progress(stage, done, total)``.
    is_asked : bool
        Whether the user asked for it: otherwise cameras that don't see the same people are refused.

    Returns
    -------
    prefix : str
        The name of the scene, as that of a camera.
    Report

    Raises
    ------
    McaptrackError
        If there is nothing to fuse, or if a channel that others recorded would be replaced; without ``is_asked`` also
        if the cameras don't agree.
    """
    prefix = "/" + scene.strip("/")
    for topic in _topics(prefix):
        if not may_replace(opened, topic, FUSE):
            raise McaptrackError(
                f"{opened.path}: {topic} {describe_origin(opened, topic)}; give the scene another name with `to=`"
            )
    with collected() as warnings:
        out = _fuse(opened, names, prefix, fuser, clock_offset_s, progress, is_asked)
    report = Report(stages=[FUSE], layouts=write(opened, prefix, out, (), {}, output), warnings=list(warnings))
    for topic, channel in out.items():
        report.count(topic, channel)
    report.stale = outdated_by(opened, {topic: channel.provenance.digest for topic, channel in out.items()})
    return prefix, report


def fuse_again(
    opened: log.Log,
    prefix: str,
    force: bool,
    say: Callable[[str], None],
    progress: Callable[[str, int, int], None],
    adds: bool = False,
) -> dict[str, Made]:
    """Make the scene below ``prefix`` again if it is out of date, or with ``force``; {} if there is none to make.

    The cameras and parameters are those that it was made with; so are offsets of clocks that were given. With ``adds``
    it is also made again if cameras can be fused now that it lacks, unless its cameras were chosen. Raises
    McaptrackError as ``fuse_cameras`` does.
    """
    target = next(iter(_topics(prefix)))
    made = provenance_of(opened, target)
    if made is None or made.transform != FUSE:
        return {}
    names = [str(name) for name in made.parameters["cameras"]]
    is_open = adds and not made.parameters.get("cameras_given")
    more = [name for name in fusable(opened, (), prefix)[0] if name not in names] if is_open else []
    if not (force or more or is_stale(opened, target)):
        return {}
    offset_s = dict(zip(names, made.parameters["clock_offset_s"], strict=True))
    given = {name: float(offset_s[name]) for name in made.parameters.get("clock_offsets_given", ())}
    options = {one.name: made.parameters[one.name] for one in fields(FootFuser) if one.name in made.parameters}
    why = f"was made without {', '.join(more)}" if more else "was made from earlier detections or ground planes"
    names = sorted((*names, *more)) if more else names
    say(f"{target} {why}: fusing {', '.join(names)} again, as before")
    is_chosen = bool(made.parameters.get("cameras_given"))
    return _fuse(opened, names, prefix, FootFuser(**options), given, progress, is_asked=is_chosen, is_again=True)


def fusable(opened: log.Log, names: Sequence[str] = (), scene: str = "/world") -> tuple[list[str], str]:
    """Return the names of the cameras that can be fused, of these or of all, and why there is nothing to fuse.

    There is if two cameras have detections and a measured ground plane, in the same frame.
    """
    scenes = {scene, *scenes_of(opened)}
    ours = [one for one in cameras(opened) if one.prefix not in scenes and (not names or _has_name(one, names))]
    lacks = {one: _lack(opened, one) for one in ours}
    able = [one for one, why in lacks.items() if not why]
    listed = [one.prefix[1:] for one in able]
    frames = {name: _frame_of(opened, one) for name, one in zip(listed, able, strict=True)}
    if len(able) < 2:
        why = "; ".join(f"{one.prefix[1:]} {reason}" for one, reason in lacks.items() if reason)
        return [], f"only {listed[0]} can be fused, since {why}" if able else why
    if len(set(frames.values())) > 1:
        return [], f"their ground planes are in different frames, {_in_words(frames)}"
    return listed, ""


def _has_name(camera: Camera, names: Sequence[str]) -> bool:
    return any(name.strip("/") in names for name in camera.names)


def _frame_of(opened: log.Log, camera: Camera) -> str:
    """The frame of the metres of a camera's ground plane."""
    return frame_id_of(opened.channels[camera.ground_plane].metadata) or _FRAME


def _in_words(frames: Mapping[str, str]) -> str:
    return ", ".join(f"{name} in {frame}" for name, frame in frames.items())


def _topics(prefix: str) -> dict[str, Schema]:
    """The schemas of the channels of a scene, the main one first."""
    target = f"{prefix}/{STAGES['detect'].output_topic}"
    return {target: DETECTIONS, f"{target}/sightings": SIGHTINGS}


def _fuse(
    opened: log.Log,
    names: Sequence[str],
    prefix: str,
    fuser: FootFuser,
    clock_offset_s: Mapping[str, float],
    progress: Callable[[str, int, int], None],
    is_asked: bool = True,
    is_again: bool = False,
) -> dict[str, Made]:
    """Fuse cameras as ``fuse_cameras`` does, and return the channels by topic."""
    topics = _topics(prefix)
    target = next(iter(topics))
    with collected() as warnings:
        chosen = _chosen(opened, names, prefix)
        sources, references, classes, frame_id = _sources(opened, chosen, clock_offset_s)
        gathered, fuser, offsets, offset_s, shared = _compared(sources, fuser, clock_offset_s)
        if shared.are_strangers and not is_asked and not is_again:
            raise McaptrackError(f"{shared}; `mcaptrack.fuse` fuses them nevertheless")
        collectors = [FrameCollector(schema) for schema in topics.values()]
        for count, made in enumerate(fuser(gathered), start=1):
            progress(FUSE, count, len(gathered))
            for frame, collector in zip(made, collectors, strict=True):
                collector.append(frame)
        if shared.are_strangers:
            warn(str(shared), "cameras-disagree")
        _say(fuser.views, offsets, offset_s, clock_offset_s)
        if gathered.left_out:
            warn(
                f"{gathered.left_out} frames of {gathered.at.view.name} are left out: they are before time 0, as its "
                "clock is late",
                "left-out",
            )
    for notice in warnings:
        warn(notice.message, notice.code)
    parameters = {
        **{one.name: getattr(fuser, one.name) for one in fields(fuser) if not one.metadata.get("context")},
        "fuser": "feet",
        "cameras": [view.name for view in fuser.views],
        "clock_offset_s": [offset_s[view.name] for view in fuser.views],
        "clock_offsets_given": sorted(clock_offset_s),
        **({"cameras_given": True} if names and is_asked else {}),
        "detects": [[round(rate, 4) for rate in view.detects] for view in fuser.views],
        "false_share": [round(view.false_share, 4) for view in fuser.views],
    }
    how = Provenance(
        FUSE,
        parameters,
        references=references,
        classes=classes,
        frame_id=frame_id,
        warnings=[(notice.code, notice.message) for notice in warnings],
    )
    out: dict[str, Made] = {}
    for (topic, schema), collector in zip(topics.items(), collectors, strict=True):
        if first := out.get(target):  # the second one belongs to the scene, too, and not to a camera of its own
            how = replace(how, input=target, input_digest=first.provenance.digest)
        out[topic] = Made.of(schema, collector.done(), how)
    return out


def _chosen(opened: log.Log, names: Sequence[str], scene: str) -> list[Camera]:
    """The cameras to fuse. Raises McaptrackError if one is not there, or lacks something."""
    known = {name.strip("/"): camera for camera in cameras(opened) for name in camera.names if camera.prefix != scene}
    for name in names:
        if name.strip("/") not in known:
            raise McaptrackError(f"{opened.path} has no camera {name}; it has {', '.join(sorted(known)) or 'none'}")
    wanted = [known[name.strip("/")] for name in names] if names else list(dict.fromkeys(known.values()))
    lacks = {camera.prefix[1:]: why for camera in wanted if (why := _lack(opened, camera))}
    if names and lacks:
        raise McaptrackError(f"{opened.path}: {next(iter(lacks))} {next(iter(lacks.values()))}")
    chosen = [camera for camera in dict.fromkeys(wanted) if camera.prefix[1:] not in lacks]
    if not chosen:
        why = "; ".join(f"{name} {why}" for name, why in lacks.items()) or "it has no camera"
        raise McaptrackError(f"{opened.path} has no detections to fuse: {why}")
    for name, why in lacks.items():
        warn(f"{name} is left out: it {why}", "left-out")
    return chosen


def _lack(opened: log.Log, camera: Camera) -> str:
    """The reason why a camera can't be fused, and a remedy; "" if it can."""
    planes = read_planes(opened, camera.prefix)
    if _detections(opened, camera) is None:
        again = call("detect", opened.path, camera=camera.prefix[1:])
        return f"has no detections; {again} makes them"
    if not planes:
        return "has no ground plane; ingest what it recorded with `ground_plane=`"
    if is_assumed(planes):
        return "has a ground plane that was estimated, in metres of its own; the cameras need measured ones"
    return ""


def _detections(opened: log.Log, camera: Camera) -> str | None:
    usual = f"{camera.prefix}/{STAGES['detect'].output_topic}"
    return usual if usual in opened.channels else camera.boxes


def _sources(
    opened: log.Log, chosen: Sequence[Camera], clock_offset_s: Mapping[str, float]
) -> tuple[list[_Source], dict[str, str], dict[str, str], str]:
    """The detections of the cameras; the digests of what they were read from; the classes, and the frame of metres."""
    names = [camera.prefix[1:] for camera in chosen]
    for name in clock_offset_s:
        if name not in names:
            raise McaptrackError(f"`clock_offset_s=` has {name}, which is not fused; {', '.join(names)} are")
    sources: list[_Source] = []
    references: dict[str, str] = {}
    classes: dict[str, str] = {}
    frames_of: dict[str, str] = {}
    for camera in chosen:
        name, topic = camera.prefix[1:], _detections(opened, camera)
        assert topic is not None
        found = read_named_frames(opened, topic, DETECTIONS)
        if not len(found.frames):
            warn(f"{name} is left out: {topic} has no messages", "left-out")
            continue
        references |= {topic: digest_of(opened, topic), camera.ground_plane: digest_of(opened, camera.ground_plane)}
        for number, word in found.classes.items():
            if classes.setdefault(str(number), word) != word:
                raise McaptrackError(
                    f"{opened.path}: class {number} is {classes[str(number)]} in one camera and {word} in {topic}; "
                    "detect them by the same detector"
                )
        frames_of[name] = _frame_of(opened, camera)
        view = CameraView(name=name, planes=tuple(read_planes(opened, camera.prefix) or ()))
        boxes = [columns_to_boxes(frame.rows) for frame in islice(iter(found.frames), _COMPARED)]
        joined = np.concatenate([part for part in boxes if len(part)] or [np.empty((0, len(BOX_PX)))])
        view = view.with_heights(joined[np.isfinite(joined).all(axis=1)])
        t_ns = frame_times(found.frames)
        offset_ns = round(clock_offset_s.get(name, 0.0) * NS_PER_S)
        sources.append(_Source(topic, found.frames, t_ns - offset_ns, view))
    if not sources:
        raise McaptrackError(f"{opened.path} has no detections to fuse: all channels are empty")
    if len(set(frames_of.values())) > 1:
        raise McaptrackError(f"{opened.path}: the ground planes are in different frames: {_in_words(frames_of)}")
    return sources, references, classes, next(iter(frames_of.values()))


def _compared(
    sources: list[_Source], fuser: FootFuser, given: Mapping[str, float]
) -> tuple[Gathered, FootFuser, tuple[Offset, ...], dict[str, float], Shared]:
    """Estimate how well the cameras agree, and the offsets of clocks that are not given."""
    offset_s = {one.view.name: given.get(one.view.name, 0.0) for one in sources}
    for _ in range(3):
        gathered = Gathered(sources, fuser)
        fuser = replace(fuser, views=tuple(one.view for one in sources))
        every = max(len(gathered) // _COMPARED, 1)
        part = (frame for number, frame in enumerate(gathered) if number // 2 % every == 0)
        taken_ns = [round(offset_s[one.view.name] * NS_PER_S) for one in sources]
        views, offsets, shared = compare(part, fuser, taken_ns)
        late = {
            view.name: round(offset.late_s, 3)
            for view, offset in zip(views, offsets, strict=True)
            if np.isfinite(offset.late_s)
        }
        worst = max(late, key=lambda name: abs(late[name]), default="")
        if not worst or worst in given or abs(late[worst]) < _LATE_S:
            break
        # One camera at a time, the worst first, because those that are right look late beside it.
        offset_s[worst] = round(offset_s[worst] + late[worst], 3)
        shift_ns = round(late[worst] * NS_PER_S)
        sources = [one._replace(t_ns=one.t_ns - shift_ns) if one.view.name == worst else one for one in sources]
    return gathered, replace(fuser, views=views), offsets, offset_s, shared


def _say(
    views: Sequence[CameraView],
    offsets: Sequence[Offset],
    offset_s: Mapping[str, float],
    given: Mapping[str, float],
) -> None:
    """Warn of cameras that disagree with the others."""
    for view, offset in zip(views, offsets, strict=True):
        name, taken_s = view.name, offset_s[view.name]
        if offset.compared >= _LEAST and offset.distance_m > _FAR_M:
            warn(
                f"{name}: feet stand {offset.distance_m:.2f} m from where the other cameras see them (median of "
                f"{offset.compared}); its ground plane, or theirs, is not right",
                "cameras-disagree",
            )
        if taken_s and name not in given:
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
                "compare it with the others",
                "other",
            )
