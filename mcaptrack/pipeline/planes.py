"""Read the ground planes of a camera, or make one from its boxes: an estimated plane, or a guessed scale."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import LEAST_DEPTH, PERSON_HEIGHT_M, GroundPlane, Planes, assumed_plane, ground_depth
from mcaptrack.geometry.plane_from_boxes import plane_from_boxes
from mcaptrack.pipeline import motion
from mcaptrack.pipeline.visible import picture_size
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import GROUND_PLANE, TRACKS, Frame, Rows
from mcaptrack.schema.classes import PEOPLE, PERSON
from mcaptrack.schema.ground_plane import plane_to_rows, rows_to_plane
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import camera_at, lineage, provenance_of

_ASSUME, _ESTIMATE = "assume-ground-plane", "estimate-ground-plane"
#: A plane is estimated from boxes of at most so many frames.
_MOST_FRAMES: Final = 5000


class PlaneChoice(NamedTuple):
    """The way to make a plane where none is given: whether it is estimated, and the mean height of people in metres.

    None stands for what the plane of the log was made with, or else for the default.
    """

    estimate: bool | None = None
    person_height_m: float | None = None

    def settled(self, made: Provenance | None) -> tuple[bool, float]:
        """The choice where a plane was made before, or not."""
        before = made.parameters if made and made.transform in (_ASSUME, _ESTIMATE) else {}
        height_m = before.get("person_height_m")
        height_m = float(height_m) if isinstance(height_m, int | float) and height_m > 0 else PERSON_HEIGHT_M
        estimate = before.get("fit_plane") is not False if self.estimate is None else self.estimate
        return estimate, float(self.person_height_m or height_m)

    def is_another(self, made: Provenance | None) -> bool:
        """Whether a plane that was made before would be made in another way now."""
        if made is None or made.transform not in (_ASSUME, _ESTIMATE):
            return False
        is_untried = made.transform == _ASSUME and not {"refused", "fit_plane"} & made.parameters.keys()
        return (bool(self.estimate) and is_untried) or self.settled(made) != AS_BEFORE.settled(made)


#: The choice of a user who makes none.
AS_BEFORE: Final[PlaneChoice] = PlaneChoice()


def read_planes(opened: log.Log, prefix: str) -> Planes | None:
    """Return the ground planes of a camera, each with its start time in ns; None if the log has none."""
    topic = camera_at(opened, prefix).ground_plane
    if topic not in opened.channels:
        return None
    frames = opened.frames(topic, GROUND_PLANE)
    return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in frames] or None


def planes_to_json(planes: Planes) -> list[Any]:
    """Convert ground planes to the JSON values that the parameters of a channel contain."""
    kept: list[Any] = json.loads(json.dumps([(t_ns, asdict(plane)) for t_ns, plane in planes]))
    return kept


def is_plane_due(opened: log.Log, prefix: str, source: str, choice: PlaneChoice) -> bool:
    """Return whether the camera's plane was made from these boxes, and would be made in another way now."""
    made = provenance_of(opened, camera_at(opened, prefix).ground_plane)
    return made is not None and made.input == source and choice.is_another(made)


def make_plane(
    opened: log.Log,
    prefix: str,
    frames: Sequence[Frame],
    source: tuple[str, str],
    made: Mapping[str, Made],
    choice: PlaneChoice = AS_BEFORE,
) -> tuple[Planes | None, Made | None]:
    """Make a ground plane from boxes, and its channel: an estimated plane, or a scale if boxes don't give one.

    ``source`` is the topic of the boxes and the digest of its messages, ``made`` the channels that jobs before made.
    Both results are None if no frame has boxes in pixels.
    """
    columns = ["x_px", "y_px", "w_px", "h_px"]
    boxes = np.concatenate([columns_to_boxes(frame.rows[columns]) for frame in frames]) if frames else np.empty((0, 4))
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    if not len(boxes):
        return None, None  # without boxes in pixels there is nothing to convert to metres
    estimate, person_m = choice.settled(provenance_of(opened, camera_at(opened, prefix).ground_plane))
    parameters: dict[str, Any] = {} if person_m == PERSON_HEIGHT_M else {"person_height_m": person_m}
    width, height = (int((boxes[:, at] + boxes[:, at + 2]).max().round()) for at in (0, 1))
    plane: GroundPlane | None = None
    if not estimate:
        parameters["fit_plane"] = False
    elif why_not := _why_not(opened, prefix, source[0], made):
        if why_not != _BY_MOTION or choice.estimate:
            parameters["refused"] = why_not
    else:
        size = _picture_size(opened, prefix, source[0], made) or (width, height)
        try:
            fit = plane_from_boxes(*_people(opened, frames, source[0], made), *size, person_m)
            plane, parameters = fit.plane, {"person_height_m": person_m, "fit": fit.to_json()}
        except McaptrackError as error:
            parameters["refused"] = str(error)
    transform = _ASSUME if plane is None else _ESTIMATE
    plane = plane or assumed_plane(boxes[:, 3], width, height, person_m)
    start = frames[0].t_ns
    channel = Made.of(GROUND_PLANE, [Frame(start, 0, plane_to_rows(plane))], Provenance(transform, parameters, *source))
    return [(start, plane)], channel


_BY_MOTION: Final = "boxes of a motion detector have shadows, and several people in one"


def _why_not(opened: log.Log, prefix: str, source: str, made: Mapping[str, Made]) -> str:
    """Return why no plane can be estimated from these boxes, as a clause; "" if it can be tried."""
    if any(motion.detects_motion(one) for _, one in _chain(opened, source, made)):
        return _BY_MOTION
    return "the camera moves" if motion.moves(opened, prefix, made) else ""


def _chain(opened: log.Log, topic: str, made: Mapping[str, Made]) -> list[tuple[str, Provenance | None]]:
    """Return a channel, its input, the input of that and so on, each with its provenance, also of this run."""
    return list(lineage(opened, topic, {name: one.provenance for name, one in made.items()}))


def _picture_size(opened: log.Log, prefix: str, source: str, made: Mapping[str, Made]) -> tuple[int, int] | None:
    """Return width and height of the pictures that boxes were found in, or of their camera; None if there are none."""
    first = _chain(opened, source, made)[-1][0]
    channel = opened.channels.get(first)
    topic = first if channel and foreign.holds_pictures(channel) else camera_at(opened, prefix).pictures
    return picture_size(opened, topic)


def _people(
    opened: log.Log, frames: Sequence[Frame], source: str, made: Mapping[str, Made]
) -> tuple[Floats, Ints, Floats]:
    """Return boxes of people, the number of the frame of each, and their scores; of some frames of a long log."""
    frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
    names = next((one.classes for _, one in _chain(opened, source, made) if one and one.classes), {})
    wanted = [int(number) for number, name in names.items() if name.lower() in PEOPLE and number.isdecimal()]
    rows: Rows = np.concatenate([frame.rows for frame in frames])
    number = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    if "class_id" in (rows.dtype.names or ()):
        wanted = wanted or [PERSON]
        is_person = np.isin(rows["class_id"], wanted)
        if is_person.any():
            rows, number = rows[is_person], number[is_person]
    return columns_to_boxes(rows), number, rows["score"].astype(np.float64)


def fit_of(made: Provenance | None) -> dict[str, float] | None:
    """Return how well an estimated plane fits (``PlaneFit.to_json``), from its provenance; None for other planes."""
    fit = made.parameters.get("fit") if made and made.transform == _ESTIMATE else None
    return fit if isinstance(fit, dict) else None


def plane_in_words(planes: Planes, made: Provenance | None) -> str:
    """Return what a plane that was made from boxes is, for a warning: where it is from, and how good it is."""
    give = f"Give one with {call('ingest', 'INPUT', ground_plane='HOMOGRAPHY')}"
    _, person_m = AS_BEFORE.settled(made)
    if fit := fit_of(made):
        words = f"one was estimated from {fit_in_words(fit)}, with people {person_m:g} m high"
        return f"no ground plane is known: {words}. {give}"
    metres = 1 / planes[0][1].homography[0]
    refused = made.parameters.get("refused", "") if made else ""
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
    boxes = columns_to_boxes(TRACKS.joined([frame.rows for frame in frames]))
    return ground_depth(boxes[np.isfinite(boxes).all(axis=1)]) < LEAST_DEPTH
