"""Which parts of each picture to hide: all boxes of people that a log has, and where people must be in between.

Boxes in space are projected into the pictures of calibrated cameras. Boxes grow with the time since a person was seen.

Letters: N boxes, M pictures.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.foxglove import Cuboids
from mcaptrack.foxglove.views import MovingCamera
from mcaptrack.foxglove.views.projected import corners
from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.pinhole import project
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.classes import PEOPLE, UNKNOWN, class_name, class_names
from mcaptrack.schema.framing import frame_times, joined_parts
from mcaptrack.schema.provenance import frame_id_of
from mcaptrack.schema.resampling import interval_ns
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import moving_camera
from mcaptrack.sources.cameras import Camera
from mcaptrack.sources.fixed_frame import named_detections

#: Detections count for this many pictures before and after their own.
_NEAR_PICTURES: Final = 2.5
_NEAR_S: Final = 0.25
#: Margins at each side: shares of width and height, at least some pixels; and the growth, in widths, for each second
#: without a row.
_MARGIN: Final = (0.2, 0.1)


# The pixels that hide a person: a mosaic that is too coarse to be undone.
#
# A cell is at least a quarter as large as the person, so that a face is smaller than a cell, and its colour is
# rounded to one of eight levels, so that pictures that follow each other don't give more detail together. Cells
# stay where they are in the picture.
#
# Letters: N boxes, H rows, W columns.


#: The least size of a cell in px, and its least share of the longer side of a box.
_MOSAIC_LEAST_PX: Final = 8
_SHARE: Final = 0.25
#: Colours are multiples of this, in the middle of their step.
_STEP: Final = 32


def hide(image: Image, boxes: Floats) -> tuple[Image, Bools]:
    """Hide the inside of boxes.

    Parameters
    ----------
    image : (H, W, 3) of uint8
        Blue, green, red. It is not changed.
    boxes : (N, 4)
        Left, top, width and height in px. Parts outside of the picture have no effect.

    Returns
    -------
    image : (H, W, 3) of uint8
    mask : (H, W) of bool
        Which pixels are hidden. All others are those of the given picture.
    """
    import cv2

    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.bool_)
    out = image.copy()
    left, top = np.floor(boxes[:, :2]).T.clip(0, [[width], [height]]).astype(np.int64)
    right, bottom = np.ceil(boxes[:, :2] + boxes[:, 2:]).T.clip(0, [[width], [height]]).astype(np.int64)
    longer = np.maximum(boxes[:, 2:].max(axis=1, initial=0) * _SHARE, _MOSAIC_LEAST_PX)
    power = np.ceil(np.log2(longer) - 1e-9).astype(np.int64)
    for level in np.unique(power).tolist():  # where boxes overlap, larger cells hide smaller ones
        own = np.flatnonzero((power == level) & (right > left) & (bottom > top))
        if not len(own):
            continue
        cell = 1 << level
        inside = np.zeros((height, width), np.bool_)
        for number in own.tolist():
            inside[top[number] : bottom[number], left[number] : right[number]] = True
        x, y = int(left[own].min()) // cell * cell, int(top[own].min()) // cell * cell
        part = image[y : int(bottom[own].max()), x : int(right[own].max())]
        rows, columns = -(-part.shape[0] // cell), -(-part.shape[1] // cell)
        more = (rows * cell - part.shape[0], columns * cell - part.shape[1])
        whole = cv2.copyMakeBorder(part, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE)
        small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
        rough = (np.asarray(small, np.uint8) // _STEP * _STEP + _STEP // 2).repeat(cell, axis=0).repeat(cell, axis=1)
        end = np.s_[y : y + part.shape[0], x : x + part.shape[1]]
        out[end][inside[end]] = rough[: part.shape[0], : part.shape[1]][inside[end]]
        mask |= inside
    return out, mask


_LEAST_PX: Final = 4.0
_GROWTH_PER_S: Final = 0.5
#: Pictures without a frame of boxes within this time were not looked at.
_LOOKED_S: Final = 1.0
#: Boxes are computed for this many pictures at once.
_BLOCK: Final = 512


# People in 3D boxes, as they are seen in the pictures of a calibrated camera that may move.
#
# Letters: N boxes, M pictures, P points of a box.


#: The state of a 3D box.
_STATE: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")
#: Boxes are cut off so far before the camera, and each edge is so many points.
_NEAR_M: Final = 0.1
_POINTS: Final = 6
#: Points beyond the edge of the lens are at most so far outside.
_FAR_PX: Final = 1e6
#: Detections in space count for this time before and after their own.
_NEAR_NS: Final = 250_000_000


# Pieces of tracks between two times: where a person is, or must be, at any time in between.
#
# A person who is missed for a moment is still there. So tracks are interpolated over their gaps, and continued
# before their first and after their last row, along their motion.
#
# Letters: N rows, S pieces, D numbers of a state (a box in a picture, or in space), M times.


#: Tracks are interpolated over gaps of this length, and continued for this long at either end.
MAX_GAP_S: Final = 5.0
_AHEAD_S: Final = 1.0
#: The motion at an end of a track is that of this time.
_MOTION_S: Final = 0.5


class Pieces(NamedTuple):
    """Pieces of tracks between two times (S,), with the states (S, D) at both, and whether there was a row at each."""

    first_ns: Ints
    last_ns: Ints
    first: Floats
    last: Floats
    is_row: tuple[Bools, Bools]

    def at(self, at_ns: Ints) -> tuple[Ints, Floats, Floats]:
        """The states at rising times (M,): the index of the time of each, (N, D), and for how long nothing was seen, s.

        They are in the order of the pieces.
        """
        if not len(at_ns):
            return np.empty(0, np.int64), self.first[:0], np.empty(0)
        near = (self.first_ns <= at_ns[-1]) & (self.last_ns >= at_ns[0])
        begin, end, start, stop = self.first_ns[near], self.last_ns[near], self.first[near], self.last[near]
        low, high = np.searchsorted(at_ns, begin, "left"), np.searchsorted(at_ns, end, "right")
        of, place = group_index(high - low), ragged_range(low, high - low)
        t_ns = at_ns[place]
        share = (t_ns - begin[of]) / np.maximum(end - begin, 1)[of]
        states = start[of] + share[:, None] * (stop - start)[of]
        since = np.where(self.is_row[0][near][of], t_ns - begin[of], np.inf)
        until = np.where(self.is_row[1][near][of], end[of] - t_ns, np.inf)
        return place, states, np.minimum(since, until) / NS_PER_S


def joined(parts: Sequence[Pieces], width: int) -> Pieces:
    """Join pieces; ``width`` is the number of values of a state."""
    if not parts:
        none, no = np.empty(0, np.int64), np.empty(0, np.bool_)
        return Pieces(none, none, np.empty((0, width)), np.empty((0, width)), (no, no))
    rows = tuple(np.concatenate([part.is_row[n] for part in parts]) for n in range(2))
    first, last, start, stop = (np.concatenate([part[n] for part in parts]) for n in range(4))
    return Pieces(first, last, start, stop, (rows[0], rows[1]))


def around(t_ns: Ints, states: Floats, near_ns: int) -> Pieces:
    """Detections as pieces around their times."""
    halves = [(t_ns - near_ns, t_ns, False, True), (t_ns, t_ns + near_ns, True, False)]
    parts = [
        Pieces(first, last, states, states, (np.full(len(t_ns), sign), np.full(len(t_ns), other)))
        for first, last, sign, other in halves
    ]
    return joined(parts, states.shape[1])


def linked(t_ns: Ints, track_id: Ints, states: Floats, places: Floats) -> Pieces:
    """Tracks as pieces between consecutive rows, with one before the first row of each and one after the last.

    ``places`` (N, P) are what moves beyond the ends, the first numbers of the states; the others stay as they are.
    """
    order = np.lexsort((t_ns, track_id))
    t_ns, track_id, states, places = t_ns[order], track_id[order], states[order], places[order]
    starts = run_starts(track_id, times=t_ns, max_gap=seconds_to_ns(MAX_GAP_S))
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    inner = np.flatnonzero(~run_ends(starts))
    yes = np.ones(len(inner), np.bool_)
    between = Pieces(t_ns[inner], t_ns[inner + 1], states[inner], states[inner + 1], (yes, yes))
    run = np.cumsum(starts) - 1
    motion_ns, ahead_ns = seconds_to_ns(_MOTION_S), seconds_to_ns(_AHEAD_S)
    # The row that is half a second after the first one of its track, and the one that is half a second before the last.
    later = np.minimum(_first_at(run, t_ns, first, t_ns[first] + motion_ns), last)
    earlier = np.maximum(_first_at(run, t_ns, last, t_ns[last] - motion_ns), first)
    before, after = states[first].copy(), states[last].copy()
    before[:, : places.shape[1]] -= _motion(t_ns, places, first, later) * _AHEAD_S
    after[:, : places.shape[1]] += _motion(t_ns, places, earlier, last) * _AHEAD_S
    no, yes = np.zeros(len(first), np.bool_), np.ones(len(first), np.bool_)
    ends = [
        Pieces(t_ns[first] - ahead_ns, t_ns[first], before, states[first], (no, yes)),
        Pieces(t_ns[last], t_ns[last] + ahead_ns, states[last], after, (yes, no)),
    ]
    return joined([between, *ends], states.shape[1])


def _first_at(run: Ints, t_ns: Ints, rows: Ints, wanted_ns: Ints) -> Ints:
    """For some rows, the index of the first row of the same run at a time or later; the one after the run if none."""
    if not len(rows):
        return rows
    base = int(t_ns.min())
    length = int(t_ns.max()) - base + seconds_to_ns(MAX_GAP_S)
    keys = run.astype(np.float64) * length + (t_ns - base)
    rows_found = np.searchsorted(keys, run[rows].astype(np.float64) * length + (wanted_ns - base))
    return rows_found.astype(np.int64)


def _motion(t_ns: Ints, places: Floats, first: Ints, other: Ints) -> Floats:
    """The motion of places (N, P) between two rows, by second."""
    passed = np.maximum(t_ns[other] - t_ns[first], 1)[:, None] / NS_PER_S
    out: Floats = (places[other] - places[first]) / passed
    out[other == first] = 0
    return out


# Which classes of objects show people: they are hidden with the object.
#
# Letters: N rows.


#: Words for people in names of classes of data sets, as in "human.pedestrian.police_officer" or "Person_sitting".
_WORDS: Final = frozenset(
    {*PEOPLE, "persons", "pedestrians", "rider", "riders", "cyclist", "bicyclist", "motorcyclist", "adult", "child"}
    | {"man", "woman", "face", "head", "worker", "officer", "wheelchair", "stroller", "passenger", "driver"}
)
_LETTERS: Final = re.compile(r"[a-z]+")


def shows_people(name: str) -> bool:
    """Return whether objects of a class of this name are people, or carry them in view.

    Examples
    --------
    >>> [shows_people(name) for name in ("person", "human.pedestrian.adult", "BICYCLIST", "bicycle", "carriage")]
    [True, True, True, False, False]
    """
    return not _WORDS.isdisjoint(_LETTERS.findall(name.casefold()))


def people_among(class_id: NDArray[Any], names: Mapping[int, str]) -> Bools:
    """Which rows (N,) are people, or of unknown class."""
    numbers = class_id.astype(np.int64)
    wanted = [kind for kind in np.unique(numbers).tolist() if kind == UNKNOWN or shows_people(class_name(kind, names))]
    return np.asarray(np.isin(numbers, wanted), np.bool_)


class SeenInSpace(NamedTuple):
    """People in 3D boxes that a camera sees: their pieces, the times of the boxes, and the camera."""

    topic: str
    pieces: Pieces
    frame_ns: Ints
    camera: MovingCamera

    def between(self, first: int, last: int) -> tuple[Ints, Floats, Floats]:
        """The boxes in the pictures ``first`` to before ``last``: their pictures (N,) from 0, the boxes (N, 4), and for
        how long a person was not seen (N,), in s.
        """
        picture, states, unseen_s = self.pieces.at(self.camera.at_ns[first:last])
        boxes = outlines(states, picture + first, self.camera)
        seen = np.isfinite(boxes).all(axis=1)
        return picture[seen], boxes[seen], unseen_s[seen]

    def unknown(self) -> Bools:
        """Which pictures (M,) can't have boxes, because it is not known where the camera was."""
        return np.asarray(~np.isfinite(self.camera.rotation).all(axis=(1, 2)), np.bool_)


def people_in_space(opened: log.Log, pictures: str, problems: list[str]) -> list[SeenInSpace]:
    """The people in all 3D boxes of a log, in the pictures of a channel; ``problems`` gets what is in the way."""
    out: list[SeenInSpace] = []
    cameras: dict[str, MovingCamera | None] = {}
    for topic in sorted(opened.channels):
        try:
            boxes_read = _read(opened, topic)
        except DamagedError:
            raise
        except McaptrackError as error:
            problems.append(f"{topic}: {error}")
            continue
        if boxes_read is None:
            continue
        pieces, frame_ns, frame_id = boxes_read
        if frame_id not in cameras:
            try:
                cameras[frame_id] = moving_camera(opened, pictures, frame_id)
            except McaptrackError as error:
                cameras[frame_id] = None
                problems.append(f"{topic} can't be placed in {pictures}: {error}")
        camera = cameras[frame_id]
        if camera is not None:
            out.append(SeenInSpace(topic, pieces, frame_ns, camera))
    return out


def _read(opened: log.Log, topic: str) -> tuple[Pieces, Ints, str] | None:
    """The people in a channel of 3D boxes, the times of its frames and its frame of reference; None for others."""
    channel = opened.channels[topic]
    schema: Schema | None = next((candidate for candidate in (TRACKS, DETECTIONS) if channel.holds(candidate)), None)
    frames: Sequence[Frame]
    if schema is not None:
        frame_id = frame_id_of(channel.metadata)
        if not frame_id:
            return None
        frames, names = opened.frame_columns(topic, schema), class_names(channel.metadata)
    elif foreign.holds_boxes(opened, topic, in_space=True):
        named = named_detections(opened, topic)
        schema, frames, frame_id, names = DETECTIONS, named.frames, named.frame_id, named.classes
    else:
        return None
    t_ns, number, state = _of_people(schema, frames, names, _states, len(_STATE))
    if not len(t_ns):
        return None
    pieces = linked(t_ns, number, state, state[:, :3]) if schema is TRACKS else around(t_ns, state, _NEAR_NS)
    return pieces, frame_times(frames), frame_id


def _states(rows: Rows) -> Floats:
    """The states (N, 7) of 3D boxes. Those without a heading may stand in any direction."""
    state = np.stack([rows[name].astype(np.float64) for name in _STATE], axis=-1)
    turned = np.isfinite(state[:, 6])
    state[~turned, 3:5] = state[~turned, 3:5].max(axis=1, keepdims=True, initial=0)
    state[~turned, 6] = 0
    return state


def _of_people(
    schema: Schema, frames: Sequence[Frame], names: Mapping[int, str], state_of: Callable[[Rows], Floats], width: int
) -> tuple[Ints, Ints, Floats]:
    """The times (N,), track ids (0 for detections) and states (N, ``width``) of people; rows without one are left out.

    ``state_of`` returns the states of rows, not finite where there is none.
    """
    parts: list[tuple[Ints, Ints, Floats]] = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, width)))]
    for _, _, part in joined_parts(schema, frames):
        state = state_of(part.rows)
        usable = np.isfinite(state).all(axis=1) & people_among(part.rows["class_id"], names)
        number = part.rows["track_id"] if schema is TRACKS else np.zeros(len(state), np.int64)
        parts.append((part.row_ns[usable], number[usable].astype(np.int64), state[usable]))
    t_ns, number, states = (np.concatenate([part[n] for part in parts]) for n in range(3))
    return t_ns, number, states


def outlines(states: Floats, picture: Ints, camera: MovingCamera) -> Floats:
    """The boxes (N, 4) in pictures around 3D boxes (N, 7), each in one of the pictures (N,); NaN where none is seen."""
    box = corners(Cuboids(states[:, :3], states[:, 3:6], states[:, 6]))
    at = np.einsum("nij,npj->npi", camera.rotation[picture], box) + camera.translation[picture][:, None]
    # Points along the lines between all corners: those behind the camera would be mirrored, and lenses bend lines.
    pairs = np.array(np.triu_indices(box.shape[1], 1)).T
    share = np.linspace(0, 1, _POINTS)[:, None]
    ends = at[:, pairs]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = ends[..., 2]
        cut = np.clip((_NEAR_M - depth) / (depth[..., ::-1] - depth), 0, 1)
        ends = np.where((depth < _NEAR_M)[..., None], ends + cut[..., None] * (ends[..., ::-1, :] - ends), ends)
        points = (ends[:, :, None, 0] * (1 - share) + ends[:, :, None, 1] * share).reshape(len(states), -1, 3)
        is_ahead = points[..., 2] > _NEAR_M * (1 - 1e-9)
    px = np.full((*points.shape[:2], 2), np.nan)
    for number in np.unique(camera.lens[picture]).tolist():
        lens, mine = camera.lenses[number], camera.lens[picture] == number
        flat = points[mine].reshape(-1, 3)
        flat_px = project(flat, lens, np.eye(3), np.zeros(3))[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            straight = flat[:, :2] / flat[:, 2:] * lens.focal_px + lens.centre_px
        beyond = np.isnan(flat_px).any(axis=1)
        flat_px[beyond] = straight[beyond].clip(-_FAR_PX, _FAR_PX)
        px[mine] = flat_px.reshape(px[mine].shape)
    px[~is_ahead] = np.nan
    low, high = np.fmin.reduce(px, axis=1), np.fmax.reduce(px, axis=1)
    size = np.array([camera.width_px, camera.height_px], np.float64)
    with np.errstate(invalid="ignore"):
        is_inside = ((high > 0) & (low < size)).all(axis=1)
    return np.where(is_inside[:, None], np.concatenate([low, high - low], axis=1), np.nan)


class HiddenPeople:
    """The boxes to hide in the pictures of a channel, from all detections, tracks and labels of its cameras, and from
    all boxes in space.

    Attributes
    ----------
    topics : tuple of str
        The channels of boxes.
    frame_ns : (F,) of int64
        Times of frames of boxes, also of empty ones, sorted.
    problems : tuple of str
        Boxes in space that can't be placed in these pictures, and why.
    """

    def __init__(self, opened: log.Log, of_pictures: Sequence[Camera], pictures: str) -> None:
        self._at_ns = opened.times(pictures)
        near_ns = round(min(_NEAR_PICTURES * interval_ns(self._at_ns), seconds_to_ns(_NEAR_S)))
        pieces, topics, looked = [], [], [np.empty(0, np.int64)]
        wanted = {topic for camera in of_pictures for topic in (*camera.topics, camera.truth, camera.boxes or "")}
        for topic in sorted(wanted & set(opened.channels)):
            boxes_read = _people(opened, topic)
            if boxes_read is not None:
                schema, frame_ns, t_ns, track_id, boxes = boxes_read
                pieces.append(_linked(t_ns, track_id, boxes) if schema is TRACKS else around(t_ns, boxes, near_ns))
                topics.append(topic)
                looked.append(frame_ns)
        problems: list[str] = []
        self._in_space = people_in_space(opened, pictures, problems)
        self.problems = tuple(problems)
        self.topics = tuple(sorted({*topics, *(seen.topic for seen in self._in_space)}))
        self.frame_ns = np.unique(np.concatenate([*looked, *(seen.frame_ns for seen in self._in_space)]))
        self._pieces = joined(pieces, 4)
        self._block: tuple[int, list[Floats]] = (-1, [])

    def unseen(self) -> int:
        """The number of pictures without a frame of boxes near their time: no detector saw them."""
        if not len(self.frame_ns):
            return len(self._at_ns)
        after = np.searchsorted(self.frame_ns, self._at_ns)
        near = np.stack([np.maximum(after - 1, 0), np.minimum(after, len(self.frame_ns) - 1)])
        apart_ns = np.abs(self.frame_ns[near] - self._at_ns).min(axis=0)
        return int((apart_ns > seconds_to_ns(_LOOKED_S)).sum())

    def unplaced(self) -> int:
        """The number of pictures into which boxes in space can't be projected: where the camera was is not known."""
        return max((int(seen.unknown().sum()) for seen in self._in_space), default=0)

    def at(self, number: int) -> Floats:
        """The boxes (N, 4) to hide in a picture, with their margins; quick for pictures in order."""
        block = number // _BLOCK
        if self._block[0] != block:
            self._block = block, self.between(block * _BLOCK, (block + 1) * _BLOCK)
        return self._block[1][number % _BLOCK]

    def between(self, first: int, last: int) -> list[Floats]:
        """The boxes (N, 4) to hide in each of the pictures ``first`` to before ``last``, with their margins."""
        at_ns = self._at_ns[first:last]
        parts = [self._pieces.at(at_ns), *(seen.between(first, last) for seen in self._in_space)]
        picture, boxes, unseen_s = (np.concatenate([part[n] for part in parts]) for n in range(3))
        order = np.argsort(picture, kind="stable")
        boxes = _with_margins(boxes, unseen_s)[order]
        bounds = np.searchsorted(picture[order], np.arange(len(at_ns) + 1))
        return [boxes[a:b] for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)]


def _people(opened: log.Log, topic: str) -> tuple[Schema, Ints, Ints, Ints, Floats] | None:
    """The boxes of people in a channel: schema, times of its frames, and times, track ids and boxes of the rows.

    None for other channels, and for those without boxes in pixels.
    """
    channel = opened.channels[topic]
    names = class_names(channel.metadata)
    frames: Sequence[Frame]
    schema = next((candidate for candidate in (TRACKS, DETECTIONS) if channel.holds(candidate)), None)
    if schema is not None:
        frames = opened.frame_columns(topic, schema)
    elif foreign.holds_boxes(opened, topic, in_space=False):
        schema, named = DETECTIONS, named_detections(opened, topic)
        frames, names = named.frames, names | named.classes
    else:
        return None
    t_ns, number, boxes = _of_people(schema, frames, names, _boxes, 4)
    if not len(t_ns) and not _has_pixels(schema, frames):
        return None
    return schema, frame_times(frames), t_ns, number, boxes


def _boxes(rows: Rows) -> Floats:
    """The boxes (N, 4) of rows in pixels, NaN where they have no extent."""
    boxes = columns_to_boxes(rows)
    boxes[~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return boxes


def _has_pixels(schema: Schema, frames: Sequence[Frame]) -> bool:
    """Whether any row has a box in pixels, or there are no rows at all: nothing was found in the pictures."""
    parts = [columns_to_boxes(part.rows) for _, _, part in joined_parts(schema, frames)]
    return not sum(map(len, parts)) or any(bool(np.isfinite(boxes).all(axis=1).any()) for boxes in parts)


def _linked(t_ns: Ints, track_id: Ints, boxes: Floats) -> Pieces:
    """Tracks as pieces; beyond their ends, boxes move with their middles and keep their size."""
    return linked(t_ns, track_id, boxes, boxes[:, :2] + boxes[:, 2:] / 2)


def _with_margins(boxes: Floats, unseen_s: Floats) -> Floats:
    """Boxes (N, 4) that reach beyond the given ones, more so the longer nothing was seen."""
    growth = _GROWTH_PER_S * np.minimum(unseen_s, MAX_GAP_S)[:, None] * boxes[:, 2:3]
    margin = np.maximum(boxes[:, 2:] * _MARGIN, _LEAST_PX) + growth
    return np.concatenate([boxes[:, :2] - margin, boxes[:, 2:] + 2 * margin], axis=1)
