"""The checks of every source of labels, and assumptions where it doesn't say: one list, for all formats.

A check refuses rows that can't be labels (``McaptrackError`` with the place of the row), or adds a finding to the
table: a text with a code, which becomes a warning. Checks look at the rows of a source as they are
read, and at those that were kept for a role.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import ORIENTED_COLUMNS as COLUMNS_3D
from mcaptrack.geometry.boxes import outside, wrapped
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.sources.ingest.labels.table import MAX_FRAME, NO_CLASS, NO_ID, Asked, BoxTable

Check = Callable[[BoxTable, Asked], None]

#: The name of the column of frames in messages.
_FRAME: Final = "the frame (a count of pictures, no time)"
#: Integers from here on are not exact as float64.
_EXACT: Final = 2**53
#: Coordinates, in pixels or metres, and scores can't be larger.
_MAX_PLACE: Final = 1e8
_MAX_SCORE: Final = 1e9
_MAX_CLASS: Final = 2**31 - 1
#: Boxes that are cut off at the edge of the picture reach a little beyond its whole size.
_MOST_SHARE: Final = 2.0
#: So many boxes are seldom shorter than this in pictures.
_LEAST_PX: Final = 6.0
_MANY_BOXES: Final = 20
#: Lengths are metres if the median lies between these.
_LEAST_LENGTH_M, _MOST_LENGTH_M = 0.05, 60.0
#: Headings are radians if none is larger than two turns.
_MOST_HEADING: Final = 4 * np.pi
#: Objects that are faster than this, in m/s, should move along their heading.
_MOVING_M_PER_S: Final = 1.0
_MANY_MOVING: Final = 20
_ALONG: Final = np.pi / 4
#: Positions that spread this much along z, and this little along y or x, in m, may have another vertical axis.
_WIDE_M, _FLAT_M = 20.0, 3.0
#: Positions of people that a camera sees don't spread more, in m, from the first to the last hundredth of them.
_MOST_SPREAD_M: Final = 200.0
#: Nor do those of objects without sizes in recordings, as far as they are metres.
_WIDEST_M: Final = 2000.0
_SIZE: Final = slice(3, 6)
#: Mixes the bits of columns.
_ODD: Final = np.uint64(0x9E3779B97F4A7C15)


def _whole(table: BoxTable, values: NDArray[Any], what: str, least: int, most: int = _EXACT - 1) -> Ints:
    if values.dtype.kind == "f":
        wrong = ~((values == np.rint(values)) & (values >= least) & (values <= most))
    else:
        wrong = (values < least) | (values > most)
    table.refuse(wrong, lambda row: f"{what} has to be a whole number from {least} to {most}, not {values[row]:g}")
    return values.astype(np.int64)


def check_rows(table: BoxTable, _: Asked) -> None:
    """There are rows; the numbers of frames, tracks and classes are whole, and scores are no larger than any can be."""
    if not len(table.frame):
        raise McaptrackError(f"{table.path} holds no boxes")
    if table.facts.is_timed:
        wrong = (table.frame < 0) | (table.frame > LAST_NS)
        table.refuse(wrong, lambda row: "times have to lie between 1970 and 2262")
    else:
        table.frame = _whole(table, table.frame, _FRAME, 0, MAX_FRAME)
    table.id = _whole(table, table.id, "the id", NO_ID)
    table.class_id = _whole(table, table.class_id, "the class", NO_CLASS, _MAX_CLASS)
    score = table.score
    table.refuse(np.abs(score) > _MAX_SCORE, lambda row: f"a score can't be {score[row]:g}")


def _check_places(table: BoxTable, places: Floats, what: str = "a coordinate", unit: str = "") -> None:
    largest = np.abs(places).max(axis=1, initial=0)
    text = f"at most {_MAX_PLACE:g}{unit}"
    table.refuse(largest > _MAX_PLACE, lambda row: f"{what} can't be {largest[row]:g}; {text}")


def check_boxes(table: BoxTable, _: Asked) -> None:
    """Boxes in pictures are finite, and none has a negative size."""
    boxes = table.boxes_px
    if boxes is None:
        return
    table.refuse(~np.isfinite(boxes).all(axis=1), lambda _: "a number of the box is missing or not finite")
    _check_places(table, boxes)
    table.refuse(
        (boxes[:, 2:] < 0).any(axis=1), lambda row: f"a box can't be {boxes[row, 2]:g} wide and {boxes[row, 3]:g} high"
    )


def check_positions(table: BoxTable, _: Asked) -> None:
    """Positions are finite, and don't spread wider than a camera sees people: pixels do, taken as metres."""
    xy_m = table.xy_m
    if xy_m is None:
        return
    table.refuse(~np.isfinite(xy_m).all(axis=1), lambda _: "a number is not finite")
    _check_places(table, xy_m, "a position")
    spread = float(np.ptp(np.percentile(xy_m, [1, 99], axis=0), axis=0).max())
    if spread > _MOST_SPREAD_M:
        table.find(
            ": positions spread over {most:.0f} m, as pixels or millimetres do; they have to be metres",
            "units",
            most=spread,
        )


def check_boxes_3d(table: BoxTable, _: Asked) -> None:
    """Boxes in space have numbers, or lack them all alike; sizes are in metres, and headings in radians."""
    boxes = table.boxes_m
    if boxes is None:
        return
    table.refuse(~np.isfinite(boxes[:, :2]).all(axis=1), lambda _: "x or y of the box is missing or not finite")
    is_odd = ~np.isfinite(boxes) & ~np.isnan(boxes).all(axis=0)

    def odd(row: int) -> str:
        names = ", ".join(name for name, odd in zip(COLUMNS_3D, is_odd[row].tolist(), strict=True) if odd)
        return f"a number of the box is missing or not finite ({names}), which other boxes have"

    table.refuse(is_odd.any(axis=1), odd)
    _check_places(table, np.nan_to_num(boxes[:, :3]), unit=" m")
    table.refuse((boxes[:, _SIZE] < 0).any(axis=1), lambda row: f"a size can't be {np.nanmin(boxes[row, _SIZE]):g}")
    sizes = boxes[:, _SIZE]  # of some formats without heights
    length = sizes[:, np.isfinite(sizes).all(axis=0)].max(axis=1, initial=-np.inf)
    usual = float(np.median(length)) if np.isfinite(length).all() else 1.0
    if not _LEAST_LENGTH_M <= usual <= _MOST_LENGTH_M:
        text = f"{table.path}: the median length of its boxes is {usual:g}; sizes have to be in metres"
        raise McaptrackError(f"{text}, as positions have, not in centimetres or millimetres")
    table.refuse(
        np.abs(boxes[:, 6]) > _MOST_HEADING,
        lambda row: (
            f"a heading of {boxes[row, 6]:g} is not in radians; if it is in degrees, name its column with "
            "`columns='heading_deg=NAME'`"
        ),
    )
    boxes[:, 6] = wrapped(boxes[:, 6])
    x, y, z = (float(np.ptp(np.percentile(part, [5, 95]))) for part in boxes[:, :3].T)
    if not np.isfinite(length).all() and max(x, y) > _WIDEST_M:
        table.find(f": positions spread over {max(x, y):.0f} m, as millimetres do; they have to be metres", "units")
    if z > _WIDE_M and min(x, y) < _FLAT_M:
        text = f": positions spread over {z:.0f} m along z, and {min(x, y):.1f} m along {'x' if x < y else 'y'}"
        table.find(f"{text}; z has to be the vertical axis", "units")
    across, moving = _moving_across(table, boxes)
    if moving >= _MANY_MOVING and across > moving / 2:
        text = f": {across} of {moving} boxes of moving objects move across their heading"
        table.find(f"{text}; the axes, the zero of the heading, or length and width may differ", "units")


def _moving_across(table: BoxTable, boxes: Floats) -> tuple[int, int]:
    """The number of rows that move more across than along their heading, and that of all moving ones."""
    if not table.facts.is_timed or not table.has_ids:
        return 0, 0
    order = np.lexsort((table.frame, table.id))
    same = np.diff(table.id[order]) == 0
    seconds = np.diff(table.frame[order]) / NS_PER_S
    step = np.diff(boxes[order, :2], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        is_moving = same & (np.hypot(*step.T) / seconds > _MOVING_M_PER_S)
    turn = np.arctan2(step[:, 1], step[:, 0]) - boxes[order[:-1], 6]
    away = np.abs(np.remainder(turn[is_moving] + np.pi / 2, np.pi) - np.pi / 2)  # either way along the heading
    return int((away > _ALONG).sum()), int(np.isfinite(away).sum())


def check_shares(table: BoxTable, _: Asked) -> None:
    """Boxes of fractions up to the whole size of a picture are shares of it, no pixels; small ones may be metres."""
    facts, boxes = table.facts, table.boxes_px
    if boxes is None:
        return
    parts = np.abs(np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1))  # centres and sizes
    largest = parts.max(axis=1, initial=0)
    if facts.is_normalised:
        table.refuse(
            largest > _MOST_SHARE,
            lambda row: (
                f"{largest[row]:g} is no share of the picture's size, as its boxes are; "
                "boxes in pixels are read as a table (`label_format='csv'`)"
            ),
        )
    elif facts.is_normalised is None and (np.abs(boxes) <= _MOST_SHARE).all() and (boxes != np.rint(boxes)).any():
        facts.is_normalised = True
        text = f": no number of a box is above {_MOST_SHARE:g}, so they are taken as shares of the picture's size"
        table.find(text, "units")
    elif facts.is_normalised is None and (boxes != np.rint(boxes)).any():
        usual_px = float(np.median(boxes[:, 2:].max(axis=1)))
        if usual_px < _LEAST_PX and len(boxes) >= _MANY_BOXES:
            text = (
                ": boxes are taken as pixels, and their usual length is {most:.2g}, as of metres; if they are, name the"
            )
            table.find(f"{text} columns with `columns='x_m=NAME,y_m=NAME'`", "units", most=usual_px)


def check_scores(table: BoxTable, _: Asked) -> None:
    """Scores lie between 0 and 1."""
    for wrong, where in (
        (table.score > 1, "above 1 (up to {most:g})"),
        (table.score < 0, "below 0 (down to {most:g})"),
    ):
        if wrong.any():
            most = float(max(table.score[wrong], key=abs))
            table.find(
                f": of {{rows}} scores {{0}} {where}; they stay as they are", "scores", int(wrong.sum()), most=most
            )


def check_repeated(table: BoxTable, _: Asked) -> None:
    """No box is there twice, with the same frame, class and track."""
    parts = [part for part in (table.boxes_px, table.xy_m, table.boxes_m) if part is not None]
    columns = [table.frame, table.id, table.class_id, *(column for part in parts for column in part.T)]
    mixed = np.zeros(len(table.frame), np.uint64)
    for column in columns:  # rows that differ here do differ; the others are compared
        bits = np.ascontiguousarray(column, np.float64).view(np.uint64)
        mixed = (mixed ^ bits ^ (bits >> np.uint64(31))) * _ODD
        mixed ^= mixed >> np.uint64(29)
    order = np.argsort(mixed)
    same = mixed[order[1:]] == mixed[order[:-1]]
    if not same.any():
        return
    alike = np.union1d(order[1:][same], order[:-1][same])
    rows = np.nan_to_num(np.column_stack([np.asarray(column)[alike] for column in columns]), nan=np.inf)
    if repeated := len(rows) - len(np.unique(rows, axis=0)):
        text = ": {0} of {rows} boxes are there before, with the same frame and class; they stay as they are"
        table.find(text, "repeated", repeated)


def check_first_frame(table: BoxTable, asked: Asked) -> None:
    """The number of the first picture is known, or assumed: 0 or 1, unless frames begin with 0."""
    facts = table.facts
    if facts.is_timed or facts.times_s is not None:
        return
    if asked.first_frame is not None:
        facts.first_frame, facts.is_first_assumed = asked.first_frame, False
    if facts.first_frame is None:
        least = int(min(facts.labelled.min(initial=MAX_FRAME), table.frame.min()))
        facts.first_frame = min(least, 1)
        facts.is_first_assumed = least > 0
        if least > 0:
            text = f": frames begin with {least}; frame {facts.first_frame} is assumed to be the first"
            table.find(f"{text} picture, `first_frame=` sets the number", "clock")


def check_labelled(table: BoxTable, _: Asked) -> None:
    """All frames with boxes are labelled."""
    labelled = table.facts.labelled
    if not np.isfinite(labelled).all() or (labelled != np.rint(labelled)).any():
        raise McaptrackError(f"{table.path}: {_FRAME} has to be a whole number, in all rows")
    table.facts.labelled = np.union1d(labelled.astype(np.int64), table.frame)


def check_size(table: BoxTable, _: Asked) -> None:
    """Boxes lie inside of pictures of the size that the source states."""
    facts, boxes = table.facts, table.boxes_px
    if boxes is None or facts.is_normalised:
        return
    if facts.sizes is not None:
        nowhere = (np.inf, np.inf)
        size = np.array([facts.sizes.get(frame, nowhere) for frame in table.frame.tolist()], float).reshape(-1, 2)
        find_outside(table, size)
    elif facts.size is not None:
        find_outside(table, np.array(facts.size, float))


def find_outside(table: BoxTable, size: Floats) -> None:
    """Warn of boxes that lie outside of pictures of this size (2,) or these sizes (N, 2)."""
    low, high = table.extent.low, table.extent.high
    if (low >= 0).all() and (high <= size).all():
        return
    for part in table.parts:
        rows = part()
        assert rows.boxes_px is not None
        beyond, half = outside(rows.boxes_px, size)
        for mask, how in ((beyond, ""), (half, " by more than half")):
            if mask.any():
                text = f": of {{rows}} boxes {{0}} lie outside of their pictures{how}; they stay as they are"
                table.find(text, "outside", int(mask.sum()))


def check_ids(table: BoxTable, _: Asked) -> None:
    """Tracks and ground truth have ids, each once in a frame."""
    if table.role == "detections":
        return
    if not table.has_ids:
        raise McaptrackError(f"{table.path} has no ids (all are -1); {table.role} need ids")
    order = np.lexsort((table.id, table.frame))
    frame, track_id = table.frame[order], table.id[order]
    again = np.flatnonzero((frame[1:] == frame[:-1]) & (track_id[1:] == track_id[:-1])) + 1
    if len(again):
        row = int(order[again[0]])
        when = "at one time" if table.facts.is_timed else f"in frame {table.frame[row]}"
        raise McaptrackError(f"{table.at(row)}: id {table.id[row]} appears twice {when}")
    if table.in_space and len(np.unique(track_id)) == len(track_id) and len(np.unique(frame)) > 1:
        raise McaptrackError(f"{table.path}: every row has another id, so that these number rows, not tracks")


#: The checks of all rows that a source has, in this order; and of those that were kept for a role.
OF_SOURCE: Final[Mapping[str, Check]] = {
    "rows": check_rows,
    "boxes": check_boxes,
    "positions": check_positions,
    "boxes in space": check_boxes_3d,
    "shares": check_shares,
    "scores": check_scores,
    "repeated": check_repeated,
    "labelled": check_labelled,
    "first frame": check_first_frame,
    "size": check_size,
}
OF_ROLE: Final[Mapping[str, Check]] = {"ids": check_ids}


def check(table: BoxTable, asked: Asked, checks: Mapping[str, Check] = OF_SOURCE) -> None:
    """Make the checks of a list. Raises McaptrackError for rows that can't be labels."""
    for judge in checks.values():
        judge(table, asked)
