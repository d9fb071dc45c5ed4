"""Fuse the detections of the cameras of a log: gather what they see at one time, and run a fuser on it.

Letters: C cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.plane import is_assumed
from mcaptrack.notices import collected, warn
from mcaptrack.pipeline.checks import describe_origin, may_replace
from mcaptrack.pipeline.gathering import (
    compared_cameras,
    frame_of_plane,
    frames_in_words,
    read_sources,
    warn_disagreeing,
)
from mcaptrack.pipeline.plan import is_stale
from mcaptrack.pipeline.planes import read_planes
from mcaptrack.pipeline.rebuild import fuser_of, plugins_of
from mcaptrack.pipeline.run import Report, outdated_by
from mcaptrack.pipeline.write import Made, write
from mcaptrack.schema import DETECTIONS, SIGHTINGS, Frame, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.provenance import FUSE, Provenance
from mcaptrack.sources.cameras import Camera, cameras, detections_of, provenance_of, scenes_of
from mcaptrack.transforms import FUSION, STAGES, Transform
from mcaptrack.transforms.fuse import FootFuser
from mcaptrack.transforms.guarded import guarded


def fuse_cameras(
    opened: log.Log,
    names: Sequence[str],
    scene: str,
    fuser: Transform,
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
    fuser : Transform
        As of the stage ``FUSION``.
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
    write(opened, prefix, out, (), {}, output)
    report = Report(stages=[FUSE], is_written=True, warnings=list(warnings))
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
    fuser: Transform | None = None,
) -> dict[str, Made]:
    """Make the scene below ``prefix`` again if it is out of date, or with ``force``; {} if there is none to make.

    The cameras and parameters are those that it was made with; so are offsets of clocks that were given. With ``adds``
    it is also made again if cameras can be fused now that it lacks, unless its cameras were chosen; so it is by
    ``fuser``, if that is another one than before. Raises McaptrackError as ``fuse_cameras`` does, and if the fuser that
    made it is not installed.
    """
    target = next(iter(_topics(prefix)))
    provenance = provenance_of(opened, target)
    if provenance is None or provenance.transform != FUSE:
        return {}
    names = [str(name) for name in provenance.parameters["cameras"]]
    is_open = adds and not provenance.parameters.get("cameras_given")
    more = [name for name in fusable(opened, (), prefix)[0] if name not in names] if is_open else []
    before, why_not = fuser_of(provenance, fuser)
    is_other = fuser is not None and (before is None or FUSION.choice(before) != FUSION.choice(fuser))
    if not (force or more or is_other or is_stale(opened, target)):
        return {}
    wanted = fuser if fuser is not None and (is_other or force) else before
    if wanted is None:
        raise McaptrackError(f"{opened.path}: {target} can't be made again: {why_not}")
    offset_s = dict(zip(names, provenance.parameters["clock_offset_s"], strict=True))
    given_offset_s = {name: float(offset_s[name]) for name in provenance.parameters.get("clock_offsets_given", ())}
    why = f"was made by the {FUSION.entry(type(before))}" if is_other and before else "was made by another fuser"
    if not is_other:
        why = f"was made without {', '.join(more)}" if more else "was made from earlier detections or ground planes"
    names = sorted((*names, *more)) if more else names
    how = f"by the {FUSION.entry(type(wanted))}" if is_other else "as before"
    say(f"{target} {why}: fusing {', '.join(names)} again, {how}")
    is_chosen = bool(provenance.parameters.get("cameras_given"))
    return _fuse(opened, names, prefix, wanted, given_offset_s, progress, is_asked=is_chosen, is_again=True)


def fusable(opened: log.Log, names: Sequence[str] = (), scene: str = "/world") -> tuple[list[str], str]:
    """Return the names of the cameras that can be fused, of these or of all, and why others, or all, can't be.

    They can if two cameras have detections and a measured ground plane, in the same frame.
    """
    scenes = {scene, *scenes_of(opened)}
    ours = [
        camera for camera in cameras(opened) if camera.prefix not in scenes and (not names or _has_name(camera, names))
    ]
    lacks = {our: _lack(opened, our) for our in ours}
    able = [camera for camera, why in lacks.items() if not why]
    listed = [camera.prefix[1:] for camera in able]
    frames = {name: frame_of_plane(opened, camera) for name, camera in zip(listed, able, strict=True)}
    if len(able) < 2:
        why = "; ".join(f"{camera.prefix[1:]} {reason}" for camera, reason in lacks.items() if reason)
        return [], f"only {listed[0]} can be fused, since {why}" if able else why
    if len(set(frames.values())) > 1:
        return [], f"their ground planes are in different frames, {frames_in_words(frames)}"
    return listed, "; ".join(f"{camera.prefix[1:]} {why}" for camera, why in lacks.items() if why)


def _has_name(camera: Camera, names: Sequence[str]) -> bool:
    return any(name.strip("/") in names for name in camera.names)


def _topics(prefix: str) -> dict[str, Schema]:
    """The schemas of the channels of a scene, the main one first."""
    target = f"{prefix}/{STAGES['detect'].output_topic}"
    return {target: DETECTIONS, f"{target}/sightings": SIGHTINGS}


def _fuse(
    opened: log.Log,
    names: Sequence[str],
    prefix: str,
    fuser: Transform,
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
        sources, references, classes, frame_id = read_sources(opened, chosen, clock_offset_s)
        gathered, feet, offsets, offset_s, shared = compared_cameras(sources, _feet_of(fuser), clock_offset_s)
        fuser = _with_views(fuser, feet)
        if shared.are_strangers and not is_asked and not is_again:
            raise McaptrackError(f"{shared}; `mcaptrack.fuse` fuses them nevertheless")
        collectors = [FrameCollector(schema) for schema in topics.values()]
        results: Iterator[tuple[Frame, ...]]
        if FUSION.is_built_in(type(fuser)):
            results = feet.fused(gathered.joined(feet))
        else:
            results = guarded(FUSION.entry(type(fuser)), fuser, gathered)
        for count, result in enumerate(results, start=1):
            progress(FUSE, count, len(gathered))
            by_suffix = dict(zip(fuser.writes, result, strict=True))
            for suffix, collector in zip(("", "sightings"), collectors, strict=True):
                collector.append(by_suffix[suffix])
        if shared.are_strangers:
            warn(str(shared), "cameras-disagree")
        warn_disagreeing(opened.path, feet.views, offsets, offset_s, clock_offset_s)
        if gathered.left_out:
            warn(
                f"{gathered.left_out} frames of {gathered.at.view.name} are left out: they are before time 0, as its "
                "clock is late",
                "left-out",
            )
    for notice in warnings:
        warn(notice.message, notice.code)
    own = {field.name: getattr(fuser, field.name) for field in fields(fuser) if not field.metadata.get("context")}
    parameters = {
        **own,
        "fuser": FUSION.entry(type(fuser)).name,
        "cameras": [view.name for view in feet.views],
        "clock_offset_s": [offset_s[view.name] for view in feet.views],
        "clock_offsets_given": sorted(clock_offset_s),
        **({"cameras_given": True} if names and is_asked else {}),
        "detects": [[round(rate, 4) for rate in view.detects] for view in feet.views],
        "false_share": [round(view.false_share, 4) for view in feet.views],
    }
    how = Provenance(
        FUSE,
        parameters,
        references=references,
        classes=classes,
        frame_id=frame_id,
        plugins=plugins_of(FUSION, fuser),
        warnings=[(notice.code, notice.message) for notice in warnings],
    )
    out: dict[str, Made] = {}
    for (topic, schema), collector in zip(topics.items(), collectors, strict=True):
        if first := out.get(target):  # the second one belongs to the scene, too, and not to a camera of its own
            how = replace(how, input=target, input_digest=first.provenance.digest)
        out[topic] = Made.of(schema, collector.done(), how)
    return out


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
    by_name = {name.strip("/"): camera for camera in cameras(opened) for name in camera.names if camera.prefix != scene}
    for name in names:
        if name.strip("/") not in by_name:
            raise McaptrackError(f"{opened.path} has no camera {name}; it has {', '.join(sorted(by_name)) or 'none'}")
    wanted = [by_name[name.strip("/")] for name in names] if names else list(dict.fromkeys(by_name.values()))
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
    if detections_of(opened, camera) is None:
        again = call("detect", opened.path, camera=camera.prefix[1:])
        return f"has no detections; {again} makes them"
    if not planes:
        return "has no ground plane; ingest what it recorded with `ground_plane=`"
    if is_assumed(planes):
        return "has a ground plane that was estimated, in metres of its own; the cameras need measured ones"
    return ""
