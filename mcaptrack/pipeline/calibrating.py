"""Correct the ground planes of cameras by the people that they see together, and write the corrected ones into the log.

The plane that was given stays as it is, in its own channel. The corrected one stands below it, and is used instead
(``sources.cameras``) until the given one is replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove import views
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ground_correction import Feet
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import describe_origin, may_replace
from mcaptrack.pipeline.fusing import fusable
from mcaptrack.pipeline.gathering import Gathered, Source, compared_cameras, read_sources
from mcaptrack.pipeline.refining import Refined, Refiner, Watched
from mcaptrack.pipeline.write import Made, digest_of
from mcaptrack.schema import GROUND_PLANE, Frame
from mcaptrack.schema.ground_plane import plane_to_rows
from mcaptrack.schema.provenance import REFINE, Provenance, frame_id_of
from mcaptrack.sources.camera_motion import planes_in
from mcaptrack.sources.cameras import Camera, camera_at, given_plane, provenance_of, refined_plane, scenes_of
from mcaptrack.sources.cameras import cameras as cameras_of
from mcaptrack.sources.ingest.sidecar import check_topics, encoding_for
from mcaptrack.transforms.fuse import FootFuser

#: Cameras are compared by at most so many frames.
_COMPARED: Final = 200
#: The end of the reason why cameras can't be compared, if there is but one.
_SINCE: Final = "since "
#: The reason why a reference stays as it is.
REFERENCE: Final = "it is the reference"
#: How often clocks and planes are estimated in turn.
_TURNS: Final = 2


def calibrate_cameras(
    opened: log.Log,
    names: Sequence[str],
    reference: Sequence[str],
    clock_offset_s: Mapping[str, float],
    progress: Callable[[int, int], None],
) -> tuple[list[Refined], dict[str, float], dict[str, GroundPlane]]:
    """Compare cameras, and return what was found about each, their clocks' offsets, and planes that are corrected.

    Parameters
    ----------
    opened : Log
    names : sequence of str
        The cameras; without any, all that have detections and a measured ground plane.
    reference : sequence of str
        Cameras that are right; without any, what most cameras agree on is.
    clock_offset_s : mapping of str to float
        How much later than the others the times of a camera are; others are estimated.
    progress : callable
        Called as ``progress(done, total)``.

    Raises
    ------
    McaptrackError
        If there are fewer than two cameras to compare, or if two are and none is a reference.
    """
    compared, names_of = _compared(opened, names)
    reference = [names_of.get(name.strip("/"), name.strip("/")) for name in reference]
    chosen = [camera.prefix[1:] for camera in compared]
    for name in reference:
        if name not in chosen:
            raise McaptrackError(f"`reference=` has {name}, which is not compared; {', '.join(chosen)} are")
    for name in clock_offset_s:
        if name not in chosen:
            raise McaptrackError(f"`clock_offset_s=` has {name}, which is not compared; {', '.join(chosen)} are")
    sources, _, _, _ = read_sources(opened, compared, clock_offset_s)
    cameras = {camera.prefix[1:]: camera for camera in compared}
    sources = [_given(opened, source, cameras[source.view.name], reference) for source in sources]
    chosen = [source.view.name for source in sources]  # without those that have no messages, which was said
    if len(chosen) < 2:
        raise McaptrackError(f"{opened.path}: only {chosen[0]} has boxes; two cameras are compared at least")
    if lacking := sorted(set(reference) - set(chosen)):
        raise McaptrackError(f"`reference=` has {', '.join(lacking)} without any box; {', '.join(chosen)} have some")
    if len(chosen) < 3 and not reference:
        raise McaptrackError(
            f"{opened.path}: of two cameras, {' and '.join(chosen)}, the log doesn't say which is right; name that one "
            "with `reference=`"
        )
    held = {
        source.view.name: _why_held(opened, cameras[source.view.name], source.view.planes, reference)
        for source in sources
    }
    return _in_turns(sources, held, frozenset(reference), clock_offset_s, progress)


def _compared(opened: log.Log, names: Sequence[str]) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras to compare, and for each name of a camera the one that results use."""
    scenes = scenes_of(opened)
    names_of = {
        name.strip("/"): camera.prefix[1:]
        for camera in cameras_of(opened)
        if camera.prefix not in scenes
        for name in camera.names
    }
    for name in names:
        if name.strip("/") not in names_of:
            raise McaptrackError(f"{opened.path} has no camera {name}; it has {', '.join(sorted(names_of)) or 'none'}")
    wanted = [names_of[name.strip("/")] for name in names]
    if len(set(wanted)) == 1:
        raise McaptrackError(
            f"`cameras=` has {wanted[0]} alone; two cameras with detections and measured ground planes are compared at "
            "least"
        )
    chosen, why = fusable(opened, wanted)
    if not chosen:
        if not why or why.endswith(_SINCE):
            why = f"it has {', '.join(sorted(set(names_of.values()))) or 'no camera'} alone"
        raise McaptrackError(
            f"{opened.path}: two cameras with detections and measured ground planes are compared at least: {why}"
        )
    if why and names:
        raise McaptrackError(f"{opened.path}: {why}; leave that out of `cameras=`")
    if why:
        warn(f"left out: {why}", "left-out")
    return [camera_at(opened, f"/{name}") for name in chosen], names_of


def _given(opened: log.Log, source: Source, camera: Camera, reference: Sequence[str]) -> Source:
    """A camera with the plane that was given, not with the one that was corrected before, unless it is a reference."""
    topic = given_plane(camera)
    if source.view.name in reference or topic == camera.ground_plane:
        return source
    planes = tuple(planes_in(opened, topic))
    return source._replace(view=replace(source.view, planes=planes))


def _why_held(opened: log.Log, camera: Camera, planes: Planes, reference: Sequence[str]) -> str:
    """The reason why a plane stays as it is; "" if it may be corrected."""
    if camera.prefix[1:] in reference:
        return REFERENCE
    provenance = provenance_of(opened, given_plane(camera))
    if provenance is not None and provenance.transform not in ("ingest",):
        return "its plane follows from the transforms of the recording, which stay as they are"
    if len(planes) > 1:
        return "its ground plane changes over time"
    return ""


def _in_turns(
    sources: list[Source],
    held: Mapping[str, str],
    reference: frozenset[str],
    given_offset_s: Mapping[str, float],
    progress: Callable[[int, int], None],
) -> tuple[list[Refined], dict[str, float], dict[str, GroundPlane]]:
    """Correct planes, estimate the offsets of clocks with them, and correct them again at the right times."""
    fuser = FootFuser()
    offset_s = {source.view.name: given_offset_s.get(source.view.name, 0.0) for source in sources}
    refined: list[Refined] = []
    planes = {source.view.name: source.view.planes[0][1] for source in sources}
    for turn in range(_TURNS):
        gathered = Gathered(sources, fuser)

        def report(done: int, total: int, turn: int = turn) -> None:
            progress(turn * total + done, _TURNS * total)

        refined = _refiner(gathered, sources, held, reference, fuser, report).refine()
        planes = {camera.name: corrected(camera, sources) for camera in refined}
        right = [
            source._replace(view=replace(source.view, planes=((source.view.planes[0][0], planes[source.view.name]),)))
            if len(source.view.planes) == 1
            else source
            for source in sources
        ]
        if turn == _TURNS - 1:
            break
        _, _, _, late_s, _ = compared_cameras(right, fuser, given_offset_s)
        late = {name: seconds for name, seconds in late_s.items() if name not in given_offset_s and seconds}
        if not late:
            progress(1, 1)
            break
        offset_s |= late
        sources = [
            source._replace(t_ns=source.t_ns - round(late.get(source.view.name, 0.0) * NS_PER_S)) for source in sources
        ]
    return refined, offset_s, {camera.name: planes[camera.name] for camera in refined if camera.model}


def corrected(camera: Refined, sources: Sequence[Source]) -> GroundPlane:
    """The plane of a camera with its correction."""
    plane = next(source.view.planes[0][1] for source in sources if source.view.name == camera.name)
    if not camera.model:
        return plane
    matrix = camera.matrix @ plane.matrix
    if plane.lens is None:
        # Any scale is the same plane; that of the one before is kept, so that numbers stay comparable.
        matrix *= np.linalg.norm(plane.matrix) / np.linalg.norm(matrix)
    return replace(plane, homography=tuple(matrix.ravel().tolist()))


def _refiner(
    gathered: Gathered,
    sources: Sequence[Source],
    held: Mapping[str, str],
    reference: frozenset[str],
    fuser: FootFuser,
    progress: Callable[[int, int], None],
) -> Refiner:
    """Gather the feet that each camera sees at the times of the slowest one, for a ``Refiner``."""
    every = -(-len(gathered) // _COMPARED)
    frames = [frame for number, frame in enumerate(gathered) if number % every == 0]
    size = [len(frame.rows) for frame in frames]
    rows = np.concatenate([frame.rows for frame in frames])
    number = np.repeat(np.arange(len(frames)), size)
    cameras = []
    for index, source in enumerate(sources):
        mine = np.flatnonzero(rows["camera"] == index)
        part = rows[mine]
        xy_m = np.stack([part["x_m"], part["y_m"]], axis=-1)
        cov = np.stack([part[name] for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")], axis=-1)
        feet = Feet(xy_m, cov, number[mine])
        view = source.view
        cameras.append(Watched(view.name, feet, part["class_id"].astype(np.int64), view.planes[0][1], held[view.name]))
    seconds = float(np.ptp([frame.t_ns for frame in frames])) / NS_PER_S if len(frames) > 1 else 1.0
    reach = (fuser.max_sigma, fuser.max_distance_m)
    return Refiner(cameras, len(frames), len(frames) / max(seconds, 1e-9), reference, reach, progress)


@dataclass(frozen=True)
class CorrectedPlanes:
    """The changes of a log that calibrating makes.

    Attributes
    ----------
    topics : dict of str to str
        The topics of corrected planes by camera.
    new : dict of str to Made
        The planes that the log does not have yet, by topic.
    unchanged : tuple of str
        Cameras with a corrected plane that the log has already.
    dropped : tuple of str
        Topics of corrections that no longer hold.
    """

    topics: Mapping[str, str]
    new: Mapping[str, Made]
    unchanged: tuple[str, ...]
    dropped: tuple[str, ...]


def changes_of(opened: log.Log, refined: Sequence[Refined], planes: Mapping[str, GroundPlane]) -> CorrectedPlanes:
    """Return the corrected planes to write, and those to drop.

    Raises McaptrackError if other software recorded a channel with the name of a corrected plane.
    """
    cameras = {camera.name: camera_at(opened, f"/{camera.name}") for camera in refined}
    topics = {camera.name: refined_plane(cameras[camera.name]) for camera in refined if camera.model}
    for topic in topics.values():
        if not may_replace(opened, topic, REFINE):
            raise McaptrackError(f"{opened.path}: {topic} {describe_origin(opened, topic)}, and is not replaced")
    results: dict[str, Made] = {}
    compared = sorted(camera.name for camera in refined if camera.before is not None)
    for camera in refined:
        if not camera.model:
            continue
        base, topic = given_plane(cameras[camera.name]), topics[camera.name]
        before = opened.frames(base, GROUND_PLANE)[0]
        parameters = {**as_json(camera), "compared_with": [name for name in compared if name != camera.name]}
        frame_id = frame_id_of(opened.channels[base].metadata)
        how = Provenance(REFINE, parameters, base, digest_of(opened, base), frame_id=frame_id)
        frame = Frame(before.t_ns, before.index, plane_to_rows(planes[camera.name]))
        results[topic] = Made.of(GROUND_PLANE, [frame], how)
    dropped = [
        topic
        for camera in refined
        if not camera.model
        and camera.before is not None
        and camera.why != REFERENCE
        and (topic := refined_plane(cameras[camera.name])) in opened.channels
        and may_replace(opened, topic, REFINE)
    ]
    unchanged = tuple(name for name, topic in topics.items() if _is_there(opened, topic, results[topic]))
    new = {topic: results[topic] for name, topic in topics.items() if name not in unchanged}
    return CorrectedPlanes(topics, new, unchanged, tuple(dropped))


def write_changes(opened: log.Log, changes: CorrectedPlanes, output: Path | None) -> bool:
    """Write corrected planes into the log, or into a copy, and drop those that no longer hold; return if it changed."""
    is_changed = bool(changes.new or changes.dropped)
    if is_changed or output is not None:
        outlines = {plane.provenance.input + views.SCENE_SUFFIX for plane in changes.new.values()}
        drop = {*changes.new, *changes.dropped, *(outline for outline in outlines if outline in opened.channels)}
        encoding = encoding_for(opened)
        check_topics({*changes.new}, encoding)
        with log.extend(opened, output, drop=drop) as writer:
            for topic, plane in changes.new.items():
                channel = writer.add_channel(topic, plane.record_in(encoding), encoding, plane.provenance.to_metadata())
                for message in plane.messages_in(encoding):
                    writer.add_message(channel, *message)
    return is_changed


def _is_there(opened: log.Log, topic: str, channel: Made) -> bool:
    provenance = provenance_of(opened, topic)
    return provenance is not None and provenance.to_metadata() == channel.provenance.to_metadata()


def as_json(camera: Refined) -> dict[str, Any]:
    """Return what was found about a camera as values of JSON."""

    def residual(distances: Any) -> dict[str, Any] | None:
        if distances is None:
            return None
        median, p90 = (None if np.isnan(value) else round(value, 4) for value in distances[:2])
        return {"median_m": median, "p90_m": p90, "pairs": distances.pairs}

    return {
        "correction": camera.model or None,
        "matrix": [round(value, 12) for value in camera.matrix.ravel().tolist()] if camera.model else None,
        "moved_m": round(camera.moved_m, 4),
        "before": residual(camera.before),
        "after": residual(camera.after),
    }
