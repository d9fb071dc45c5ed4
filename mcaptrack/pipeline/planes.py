"""Read the ground planes of a camera, or make them: from its calibration and transforms, or from its boxes.

Boxes give an estimated plane, or a guessed scale.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes, share_inside
from mcaptrack.geometry.plane import (
    LEAST_DEPTH,
    PERSON_HEIGHT_M,
    GroundPlane,
    Planes,
    assumed_plane,
    ground_depth,
    is_assumed,
)
from mcaptrack.geometry.plane_from_boxes import PlaneFit, plane_from_boxes
from mcaptrack.notices import warn
from mcaptrack.pipeline import motion
from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.staleness import digest_of, planes_to_json
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.as_rows import plane_to_rows
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person
from mcaptrack.schema.framing import JoinedFrames, filtered_rows, has_any, join_frames, joined_parts, thinned
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import holds_calibrations, see_ground
from mcaptrack.sources.cameras import camera_at, lineage, provenance_of
from mcaptrack.sources.pictures import picture_size
from mcaptrack.transforms import STAGES, Transform

_ASSUME, _ESTIMATE, _CALIBRATE = "assume-ground-plane", "estimate-ground-plane", "calibrate-ground-plane"
_MADE: Final = (_ASSUME, _ESTIMATE, _CALIBRATE)
#: A plane is estimated from boxes of at most so many frames.
_MOST_FRAMES: Final = 5000
#: Scales are guessed from about so many boxes at most.
_MOST_BOXES: Final = 500_000
_BOX_COLUMNS: Final = ["x_px", "y_px", "w_px", "h_px", "score", "class_id"]


class PlaneChoice(NamedTuple):
    """The way to make a plane where none is given: whether it is estimated, and the mean height of people in metres.

    Of a calibrated camera: the frame of the metres, and the frame with the ground as z = 0. None stands for what the
    plane of the log was made with, or else for the default.
    """

    estimate: bool | None = None
    person_height_m: float | None = None
    frame: str | None = None
    ground_frame: str | None = None

    def settled(self, provenance: Provenance | None) -> tuple[bool, float]:
        """Return the choice, with what is left open as in ``provenance``, or else the default."""
        before = provenance.parameters if provenance and provenance.transform in (_ASSUME, _ESTIMATE) else {}
        height_m = before.get("person_height_m")
        height_m = float(height_m) if isinstance(height_m, int | float) and height_m > 0 else PERSON_HEIGHT_M
        estimate = before.get("fit_plane") is not False if self.estimate is None else self.estimate
        return estimate, float(self.person_height_m or height_m)

    def is_another(self, provenance: Provenance | None) -> bool:
        """Whether a plane that was made before would be made in another way now."""
        if provenance is not None and provenance.transform == _CALIBRATE:
            return self.frames(provenance) != AS_BEFORE.frames(provenance)
        if provenance is None or provenance.transform not in (_ASSUME, _ESTIMATE):
            return False
        is_untried = provenance.transform == _ASSUME and not {"refused", "fit_plane"} & provenance.parameters.keys()
        return (bool(self.estimate) and is_untried) or self.settled(provenance) != AS_BEFORE.settled(provenance)

    def frames(self, provenance: Provenance | None) -> tuple[str, str]:
        """Return the frames of the metres and of the ground, as chosen or as in ``provenance``; "": the default."""
        before = provenance.parameters if provenance and provenance.transform == _CALIBRATE else {}
        frame = before.get("frame", "") if self.frame is None else self.frame
        ground_frame = before.get("ground_frame", "") if self.ground_frame is None else self.ground_frame
        return str(frame), str(ground_frame)


#: The choice of a user who makes none.
AS_BEFORE: Final[PlaneChoice] = PlaneChoice()


def is_plane_due(opened: log.Log, prefix: str, source: str, choice: PlaneChoice) -> bool:
    """Return whether the camera's plane was made from these boxes, or calibrated, and would be made otherwise now."""
    provenance = provenance_of(opened, camera_at(opened, prefix).ground_plane)
    if provenance is None or (provenance.input != source and provenance.transform != _CALIBRATE):
        return False
    is_untried = _UNCALIBRATED not in provenance.parameters or any(choice.frames(provenance))
    is_new = provenance.transform in (_ASSUME, _ESTIMATE) and is_untried and _is_calibrated(opened)
    is_new = is_new or _is_recalibrated(opened, prefix, provenance)
    return choice.is_another(provenance) or is_new


def warn_unused(opened: log.Log, prefix: str, choice: PlaneChoice) -> None:
    """Warn of choices that change nothing, because the plane is given, or the camera isn't calibrated."""
    is_given = _is_given(opened, camera_at(opened, prefix).ground_plane)
    if choice.estimate and is_given:
        warn("a ground plane is given, so that none is estimated", "option-not-used")
    if choice.ground_frame and (is_given or not _is_calibrated(opened)):
        why = "a ground plane is given" if is_given else "the log has no calibration of a camera"
        warn(f"`ground_frame=` changes nothing here: {why}", "option-not-used")


#: The parameter of a plane that says why it doesn't follow from a calibration that the log has.
_UNCALIBRATED: Final = "uncalibrated"


def _is_given(opened: log.Log, topic: str) -> bool:
    provenance = provenance_of(opened, topic)
    return topic in opened.channels and (provenance is None or provenance.transform not in _MADE)


def _is_calibrated(opened: log.Log) -> bool:
    return any(map(holds_calibrations, opened.channels.values()))


def _is_recalibrated(opened: log.Log, prefix: str, how: Provenance | None) -> bool:
    """Return whether a calibration was ingested for a camera after its planes were made from a calibration."""
    topic = f"{prefix}/calibration"
    provenance = provenance_of(opened, topic)
    if how is None or how.transform != _CALIBRATE or provenance is None or provenance.transform != INGEST:
        return False
    return how.input != topic or how.input_digest != digest_of(opened, topic)


def calibrated_planes(opened: log.Log, prefix: str, choice: PlaneChoice) -> tuple[Planes | None, Made | None, str]:
    """Return the ground planes that follow from a camera's calibration and the transforms, and their channel.

    Both are None if a plane is given, if these planes are in the log already, or if the log has no calibration. The
    last result is why no plane follows from a calibration that is there; a warning says it, too.
    """
    camera = camera_at(opened, prefix)
    before = provenance_of(opened, camera.ground_plane)
    is_made = before is not None and before.transform == _CALIBRATE and not choice.is_another(before)
    is_made = is_made and not _is_recalibrated(opened, camera.prefix, before)
    if _is_given(opened, camera.ground_plane) or is_made or not _is_calibrated(opened):
        return None, None, ""
    frame, ground_frame = choice.frames(before)
    try:
        seen = see_ground(opened, camera, frame, ground_frame)
    except McaptrackError as error:
        if frame or ground_frame:
            raise
        warn(f"{opened.path}: no ground plane follows from the calibration of {prefix}: {error}", "transforms")
        return None, None, str(error)
    if seen is None:
        return None, None, ""
    parameters = {"frame": frame, "ground_frame": ground_frame, "ground": seen.ground_frame}
    how = Provenance(_CALIBRATE, parameters, seen.topic, digest_of(opened, seen.topic), frame_id=seen.frame)
    frames = [Frame(t_ns, number, plane_to_rows(plane)) for number, (t_ns, plane) in enumerate(seen.planes)]
    return seen.planes, Made.of(GROUND_PLANE, frames, how), ""


def make_plane(
    state: RunState, frames: Sequence[Frame], source: tuple[str, str], choice: PlaneChoice, uncalibrated: str
) -> tuple[Planes | None, Made | None]:
    """Make a ground plane from boxes, and its channel: an estimated plane, or a scale if boxes don't give one.

    ``source`` is the topic of the boxes and the digest of its messages. ``uncalibrated`` says why the plane doesn't
    follow from a calibration. Both results are None if no frame has boxes in pixels.
    """
    made_by = {name: made.provenance for name, made in state.results.items()}
    chain = list(lineage(state.opened, source[0], made_by))
    frames = thinned(frames, _MOST_BOXES)
    seen = _Boxes.of(frames, [how.classes for _, how in chain if how])
    if not len(seen.xywh):
        return None, None  # without boxes in pixels there is nothing to convert to metres
    camera = camera_at(state.opened, state.prefix)
    estimate, person_m = choice.settled(provenance_of(state.opened, camera.ground_plane))
    parameters: dict[str, Any] = {} if person_m == PERSON_HEIGHT_M else {"person_height_m": person_m}
    ends = seen.xywh[:, :2] + seen.xywh[:, 2:]
    width, height = (int(end) for end in np.clip(ends.max(axis=0).round(), 1, np.iinfo(np.uint32).max))
    plane: GroundPlane | None = None
    if not estimate:
        parameters["fit_plane"] = False
    elif why_not := _why_not(state, chain):
        if why_not != _BY_MOTION or choice.estimate:
            parameters["refused"] = why_not
    else:
        try:
            size = _size_of_pictures(state, chain[-1][0]) or (width, height)
            fit = seen.fit(len(frames), size, person_m)
            plane, parameters = fit.plane, {"person_height_m": person_m, "fit": fit.to_json()}
        except McaptrackError as error:
            parameters["refused"] = str(error)
    if uncalibrated:
        parameters[_UNCALIBRATED] = uncalibrated
    transform = _ESTIMATE
    if plane is None:
        plane, transform = assumed_plane(seen.heights(), width, height, person_m), _ASSUME
    start = frames[0].t_ns
    made = Made.of(GROUND_PLANE, [Frame(start, 0, plane_to_rows(plane))], Provenance(transform, parameters, *source))
    return [(start, plane)], made


def _size_of_pictures(state: RunState, topic: str) -> PictureSize:
    """Return the size of the pictures that boxes were found in, or of those of the camera; None if it isn't known."""
    channel = state.opened.channels.get(topic)
    is_of_pictures = channel is not None and foreign.holds_pictures(channel)
    return picture_size(state.opened, topic if is_of_pictures else camera_at(state.opened, state.prefix).pictures)


class _Boxes(NamedTuple):
    """Boxes (N, 4) in pixels, the number of the frame of each, its score, and whether it is of a person."""

    xywh: Floats
    number: Ints
    score: Floats
    are_people: Bools

    @classmethod
    def of(cls, frames: Sequence[Frame], classes: Sequence[Mapping[str, str]]) -> _Boxes:
        """Return the boxes of rows in pixels.

        ``classes`` are the names of classes by number, where channels name them: the first that do count. Boxes of
        unknown classes are of people if no box is said to be.
        """
        names = next(filter(None, classes), {})
        rows: Rows = np.concatenate([frame.rows[_BOX_COLUMNS] for frame in frames]) if frames else DETECTIONS.empty()
        number = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
        kept = np.isfinite(columns_to_boxes(rows)).all(axis=1)
        rows, number = rows[kept], number[kept]
        wanted = [int(kind) for kind, name in names.items() if is_person(name) and kind.isdecimal()] or [PERSON]
        are_people = np.isin(rows["class_id"], wanted)
        if not are_people.any():
            are_people = rows["class_id"] == UNKNOWN
        return cls(columns_to_boxes(rows), number, rows["score"].astype(np.float64), are_people)

    def fit(self, frames: int, size: tuple[int, int], person_m: float) -> PlaneFit:
        """Estimate a plane from people in some of the frames. Raises McaptrackError if they don't give one."""
        if not self.are_people.any():
            raise McaptrackError("none of them is of a person")
        some = self.are_people & (self.number % -(-frames // _MOST_FRAMES) == 0)
        return plane_from_boxes(self.xywh[some], self.number[some], self.score[some], *size, person_m)

    def heights(self) -> Floats:
        """Return the heights of people, or of all boxes if none is of a person."""
        return self.xywh[self.are_people if self.are_people.any() else slice(None), 3]


def planes_for(
    state: RunState,
    job: Job,
    frames: Sequence[Frame],
    source: tuple[str, str],
    planes: Planes | None,
    choice: PlaneChoice,
) -> tuple[Planes | None, str]:
    """Return the ground planes for a job that reads these frames, and their frame; new ones become a channel.

    ``planes`` are those so far. New detections give a new plane; one that was measured is kept. ``source`` is as in
    ``make_plane``.
    """
    opened, prefix, results, _ = state
    topic, stage, uncalibrated = camera_at(opened, prefix).ground_plane, STAGES[job.stage], ""
    channel: Made | None = None
    uses_planes = "ground_planes" in {f.name for f in fields(job.transform)} and _has_pixels(frames)
    if uses_planes and topic not in results:
        calibrated, channel, uncalibrated = calibrated_planes(opened, prefix, choice)
        planes = calibrated or planes
    is_usual = job.target == f"{prefix}/{stage.output_topic}"
    is_new = job.transform.reads is DETECTIONS or is_plane_due(opened, prefix, job.source, choice)
    if (is_assumed(planes) and is_usual and is_new) or (planes is None and "scale" in stage.before):
        planes, channel = make_plane(state, frames, source, choice, uncalibrated)
    if channel:
        results[topic] = channel
    how = state.provenance(topic) if uses_planes else None
    return planes, how.frame_id if how else ""


def _has_pixels(frames: Sequence[Frame]) -> bool:
    """Return whether rows have boxes in pixels."""
    return any("x_px" in (frame.rows.dtype.names or ()) and np.isfinite(frame.rows["x_px"]).any() for frame in frames)


def recorded_planes(transform: Transform) -> dict[str, Any]:
    """Return the ground planes of a transform as the parameters of a channel contain them, if it has any."""
    planes = getattr(transform, "ground_planes", None)
    return {} if planes is None else {"ground_planes": planes_to_json(planes)}


_BY_MOTION: Final = "boxes of a motion detector have shadows, and several people in one"


def _why_not(state: RunState, chain: Sequence[tuple[str, Provenance | None]]) -> str:
    """Return why no plane can be estimated from boxes with these inputs, as a clause; "" if it can be tried."""
    if any(motion.detects_motion(provenance) for _, provenance in chain):
        return _BY_MOTION
    return "the camera moves" if motion.moves(state) else ""


# Leave out interpolated and coasting rows of people who are outside of the picture.
#
# A track goes on while its person is occluded; its rows are then where the person is expected. Outside of the picture
# people come and go unseen, so such rows would be guesses.


#: Width and height of pictures in pixels; None where they aren't known.
PictureSize = tuple[int, int] | None
#: Channels by topic: the schema and the frames of each.
Channels = Mapping[str, tuple[Schema, Sequence[Frame]]]

#: A person is outside of the picture if a smaller share of the box is inside.
_LEAST_INSIDE: Final = 0.5
#: Boxes are taken to be in pixels of the pictures if no more than this share of those that were detected is outside:
#: other software may have seen larger pictures than those in the log.
_MOST_OUTSIDE: Final = 0.05


def without_unseen(channels: Channels, picture_size: Callable[[], PictureSize]) -> Channels:
    """Return the outputs of a stage without rows that are not observed and lie outside of the picture.

    ``picture_size`` is called if there are rows that are not observed. Predictions go with their rows of online tracks.
    A warning counts the rows.
    """
    out = dict(channels)
    for topic, (schema, frames) in channels.items():
        unseen = _find_unseen(frames, picture_size) if schema is TRACKS else None
        if unseen is None:
            continue
        is_seen, count = unseen
        rows = "predicted row" if count == 1 else "predicted rows"
        warn(f"{topic}: left out {count:,} {rows} outside of the picture, where nothing can be detected", "left-out")
        stem, _, name = topic.rpartition("/")
        predictions = f"{stem}/predictions"
        if name == "online" and predictions in channels:
            gone: set[tuple[int, int]] = set()
            for _, _, joined in joined_parts(schema, frames):
                is_gone = ~is_seen(joined)
                gone.update(key for key, is_this in zip(_keys(joined), is_gone.tolist(), strict=True) if is_this)
            forecasts = filtered_rows(
                PREDICTIONS,
                channels[predictions][1],
                lambda joined: np.array([key not in gone for key in _keys(joined)], bool),  # noqa: B023
            )
            out[predictions] = PREDICTIONS, forecasts
        out[topic] = schema, filtered_rows(TRACKS, frames, is_seen)
    return out


def _find_unseen(
    frames: Sequence[Frame], picture_size: Callable[[], PictureSize]
) -> tuple[Callable[[JoinedFrames], Bools], int] | None:
    """Return a function that masks rows that are observed or inside of the picture, and the number of the others.

    None if there are no others.
    """

    def may_be_unseen(rows: Rows) -> Bools:
        return np.asarray(~rows["observed"] & np.isfinite(columns_to_boxes(rows)).all(axis=1))

    if not has_any(TRACKS, frames, may_be_unseen) or (size := picture_size()) is None:
        return None

    def is_outside(rows: Rows) -> Bools:  # false without a box
        return np.asarray(share_inside(columns_to_boxes(rows), *size) < _LEAST_INSIDE)

    outside = observed = unseen = 0
    for _, _, joined in joined_parts(TRACKS, frames):
        outer, seen = is_outside(joined.rows), joined.rows["observed"]
        outside, observed = outside + int((outer & seen).sum()), observed + int(seen.sum())
        unseen += int((outer & ~seen).sum())
    if not unseen or outside > _MOST_OUTSIDE * observed:
        return None
    return lambda joined: np.asarray(~is_outside(joined.rows) | joined.rows["observed"]), unseen


def _keys(joined: JoinedFrames) -> Iterator[tuple[int, int]]:
    """The time and the id of each row."""
    return zip(joined.row_ns.tolist(), joined.rows["track_id"].tolist(), strict=True)


def fit_of(provenance: Provenance | None) -> dict[str, float] | None:
    """Return how well an estimated plane fits (``PlaneFit.to_json``), from its provenance; None for other planes."""
    fit = provenance.parameters.get("fit") if provenance and provenance.transform == _ESTIMATE else None
    return fit if isinstance(fit, dict) else None


def plane_in_words(planes: Planes, provenance: Provenance | None) -> str:
    """Return what a plane that was made from boxes is, for a warning: where it is from, and how good it is."""
    give = f"Give one with {call('ingest', 'INPUT', ground_plane='HOMOGRAPHY')}"
    _, person_m = AS_BEFORE.settled(provenance)
    if fit := fit_of(provenance):
        text = f"one was estimated from {fit_in_words(fit)}, with people {person_m:g} m high"
        return f"no ground plane is known: {text}. {give}"
    metres = 1 / planes[0][1].homography[0]
    refused = provenance.parameters.get("refused", "") if provenance else ""
    why = f", and boxes don't tell it ({refused})" if refused else ""
    return (
        f"no ground plane is known{why}: taking {metres:.3g} px for a metre, since people are {person_m:g} m high; "
        f"distances, speeds and re-tracking go by it. {give}"
    )


def fit_in_words(fit: Mapping[str, Any]) -> str:
    """Return how well an estimated plane fits, from ``PlaneFit.to_json``."""

    def number(name: str) -> float:
        value = fit.get(name)
        return float(value) if isinstance(value, int | float) else float("nan")

    pitch = number("pitch_deg")
    looks = f"looking {'down' if pitch >= 0 else 'up'} by {abs(pitch):.0f} degrees"
    return (
        f"{number('boxes'):,.0f} boxes {number('nearest_m'):.0f} to {number('farthest_m'):.0f} m away (camera "
        f"{number('camera_height_m'):.1f} m high, {looks}; heights fit within {number('residual'):.0%}, metres along "
        f"the view are uncertain by {number('depth_sd'):.0%})"
    )


def is_poor(frames: Sequence[Frame]) -> bool:
    """Return whether the size of boxes varies too much over the picture for one scale."""
    boxes = columns_to_boxes(join_frames(TRACKS, thinned(frames, _MOST_BOXES)).rows)
    return ground_depth(boxes[np.isfinite(boxes).all(axis=1)]) < LEAST_DEPTH
