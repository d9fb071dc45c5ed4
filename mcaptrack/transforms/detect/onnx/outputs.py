"""Read the outputs of networks: the boxes of each family of detectors, or why the outputs can't mean that.

Letters: B pictures, N places on grids, Q queries, C classes, K boxes that are likely enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats
from mcaptrack.transforms.detect.onnx.nms import Boxes, Size

Outputs = Mapping[str, NDArray[Any]]

#: A box with such a score is evidence that a network was read as it was trained: a wrong reading gives lower ones.
SURE: Final = 0.4
#: Strides of grids: of YOLO and NanoDet, and of NanoDet-Plus.
STRIDES: Final = (8, 16, 32)
PLUS: Final = (8, 16, 32, 64)
#: NanoDet gives each side's distance as likelihoods of 0 to 7 strides.
_BINS: Final = 8
SIDES: Final = 4 * _BINS
#: YOLO before anchors were given up has so many boxes at each place.
ANCHORS: Final = 3
#: Log sizes are smaller than this.
_MOST_LOG: Final = 15.0
#: No sure box of a network with inputs of 32 pixels and more is so small, and none in shares so large.
_SHARES: Final = 2.0
#: Columns that are so correlated with the places on grids are the places of boxes.
_FOLLOWS: Final = 0.9


class MisreadError(ValueError):
    """The outputs can't mean what they were read as; the text says why."""


@lru_cache(maxsize=8)
def grid(size: Size, strides: tuple[int, ...] = STRIDES) -> tuple[Floats, Floats]:
    """The numbers (N, 2) of the cells of grids, row by row, and the stride (N,) of each."""
    places, steps = [], []
    for stride in strides:
        columns, rows = -(-size[0] // stride), -(-size[1] // stride)
        y, x = np.divmod(np.arange(columns * rows), columns)
        places.append(np.stack([x, y], axis=1))
        steps.append(np.full(columns * rows, stride))
    return np.concatenate(places).astype(np.float64), np.concatenate(steps).astype(np.float64)


def cells(size: Size, strides: tuple[int, ...] = STRIDES) -> int:
    """The number of places of grids."""
    return len(grid(size, strides)[1])


@lru_cache(maxsize=8)
def _corners(size: Size, anchors: int) -> Floats:
    """The top left corners (N, 2) of cells in pixels, repeated for the ``anchors`` of each stride."""
    numbers, stride = grid(size)
    parts = [np.tile((numbers * stride[:, None])[stride == step], (anchors, 1)) for step in STRIDES]
    return np.concatenate(parts)


def _kind_of_places(boxes: NDArray[Any], size: Size, anchors: int = 1) -> Literal["offsets", "pixels"]:
    """Whether boxes (N, 4) of all places are centres and sizes in pixels, or offsets within cells.

    Raises MisreadError if they are something else that follows the grid.
    """
    places = _corners(size, anchors)
    follow = [_follows(boxes[:, k], places[:, k % 2]) for k in range(4)]
    if min(follow[:2]) < _FOLLOWS:
        return "offsets"
    if min(follow) >= _FOLLOWS:
        raise MisreadError("boxes are given by their corners, and centre and size are expected")
    if np.ptp(boxes[:, 0]) < np.ptp(places[:, 0]) / 4:
        raise MisreadError("boxes are given as shares of the input, and pixels are expected")
    return "pixels"


def _follows(values: NDArray[Any], places: Floats) -> float:
    """The correlation of numbers with places, up to 1."""
    mine, other = values - values.mean(dtype=np.float64), places - places.mean()
    norm = float(np.sqrt((mine**2).sum() * (other**2).sum()))
    return float(mine @ other) / norm if norm > 0 else 0.0


def _boxes(xyxy: Floats, scores: Floats, labels: NDArray[Any], least: float) -> Boxes:
    """Boxes that are likely enough. Raises MisreadError for what can't be scores, corners in pixels, or classes."""
    likelihoods(scores)
    likely = scores >= least
    xyxy, labels = xyxy[likely].astype(np.float64), labels[likely]
    scores = np.clip(scores[likely].astype(np.float64), 0, 1)
    sure = scores >= SURE
    if sure.any():
        if np.abs(xyxy[sure]).max() <= _SHARES:
            raise MisreadError("boxes are given as shares of the input, and pixels are expected")
        if (xyxy[sure, 2:] < xyxy[sure, :2]).any(axis=1).mean() > 0.5:
            raise MisreadError("boxes end before they begin, so that they are not given by their corners")
        if (labels[sure] != np.rint(labels[sure])).any():
            raise MisreadError("classes are not whole numbers")
    return Boxes(xyxy, scores, labels.astype(np.int64))


def likelihoods(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers that are likelihoods. Raises MisreadError for others."""
    if values.size and not (values.min() > -1e-3 and values.max() < 1 + 1e-3):
        raise MisreadError("scores are no likelihoods from 0 to 1")
    return values


def _sigmoid(logits: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -60, 60))))


def _from_centres(boxes: Floats) -> Floats:
    """Centre and size -> corners; (K, 4)."""
    half = boxes[:, 2:4] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def _best(scores: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The greatest of scores (K, C) in each row, and its class."""
    label = scores.argmax(axis=1)
    return scores[np.arange(len(scores)), label], label


def _only(outputs: Outputs) -> NDArray[Any]:
    return next(iter(outputs.values()))


def read_yolox(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    """Offsets and log sizes on grids, or centres and sizes in pixels; objectness, and classes."""
    places, stride = grid(size)
    out = []
    for output in _only(outputs):
        is_decoded = _kind_of_places(output[:, :4], size) == "pixels"  # exported with --decode_in_inference
        likely = np.flatnonzero(likelihoods(output[:, 4:])[:, 0] >= least)
        rows = output[likely].astype(np.float64)
        score, label = _best(rows[:, 5:])
        boxes = rows[:, :4]
        if not is_decoded:
            steps = stride[likely, None]
            high = np.exp(np.minimum(rows[:, 2:4], _MOST_LOG)) * steps
            boxes = np.concatenate([(rows[:, :2] + places[likely]) * steps, high], axis=1)
        out.append(_boxes(_from_centres(boxes), rows[:, 4] * score, label, least))
    return out


def nanodet_parts(outputs: Outputs, size: Size) -> tuple[NDArray[Any], NDArray[Any], tuple[int, ...]] | None:
    """Classes (B, N, C), distances (B, N, 32) and strides, if the outputs are those of NanoDet."""
    arrays = list(outputs.values())
    if any(array.ndim != 3 or array.dtype.kind != "f" for array in arrays):
        return None
    if len(arrays) > 1:
        sides = [array for name, array in outputs.items() if array.shape[2] == SIDES and "cls" not in name]
        kinds = [array for array in arrays if not any(array is side for side in sides)]
        pairs = [sorted(some, key=lambda array: -array.shape[1]) for some in (kinds, sides)]
        if [a.shape[1] for a in pairs[0]] != [a.shape[1] for a in pairs[1]] or len({a.shape[2] for a in kinds}) != 1:
            return None
        joined = np.concatenate([np.concatenate(some, axis=1) for some in pairs], axis=2)
    else:
        joined = arrays[0]
    strides = next((s for s in (STRIDES, PLUS) if joined.shape[1] == cells(size, s)), None)
    if strides is None or joined.shape[2] <= SIDES:
        return None
    return joined[..., :-SIDES], joined[..., -SIDES:], strides


def read_nanodet(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    """Classes, and distances of the four sides as softmax over bins."""
    parts = nanodet_parts(outputs, size)
    if parts is None:
        raise MisreadError("outputs have other shapes than at first")
    kinds, sides, strides = parts
    places, stride = grid(size, strides)
    offset = 0.0 if strides is PLUS else 0.5  # as each version trained its centres
    out = []
    for scores, distances in zip(kinds, sides, strict=True):
        likely = np.flatnonzero(likelihoods(scores).max(axis=1) >= least)
        score, label = _best(scores[likely].astype(np.float64))
        bins = np.exp(np.minimum(distances[likely].astype(np.float64).reshape(-1, 4, _BINS), 80))
        reach = (bins @ np.arange(_BINS)) / bins.sum(axis=2) * stride[likely, None]
        centre = (places[likely] + offset) * stride[likely, None]
        xyxy = np.concatenate([centre - reach[:, :2], centre + reach[:, 2:]], axis=1)
        out.append(_boxes(xyxy, score, label, least))
    return out


def detr_parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Labels (B, Q), boxes (B, Q, 4) and scores (B, Q): by name, or else by shape and kind."""
    if {"labels", "boxes", "scores"} <= set(outputs):
        parts = [outputs[name] for name in ("labels", "boxes", "scores")]
    elif len(outputs) == 3:
        arrays = list(outputs.values())
        kinds = [(array.ndim, array.dtype.kind) for array in arrays]
        if sorted(kinds) != [(2, "f"), (2, "i"), (3, "f")]:
            return None
        parts = [arrays[kinds.index(kind)] for kind in ((2, "i"), (3, "f"), (2, "f"))]
    else:
        return None
    labels, boxes, scores = parts
    fits = labels.ndim == scores.ndim == 2 and boxes.ndim == 3 and boxes.shape[2] == 4
    return (labels, boxes, scores) if fits and boxes.shape[:2] == labels.shape == scores.shape else None


def read_detr(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    """Labels, boxes and scores; or logits and centres, as transformers exports the same networks."""
    parts = detr_parts(outputs)
    if parts is None:
        return read_rfdetr(outputs, size, least)
    return [_boxes(boxes, scores, labels, least) for labels, boxes, scores in zip(*parts, strict=True)]


def rfdetr_parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Boxes (B, Q, 4) and logits (B, Q, C): by name, or else by shape where that tells them apart."""
    if any(array.ndim != 3 or array.dtype.kind != "f" for array in outputs.values()) or len(outputs) != 2:
        return None
    for first, second in (("dets", "labels"), ("pred_boxes", "logits")):
        if {first, second} <= set(outputs):
            boxes, logits = outputs[first], outputs[second]
            break
    else:
        ordered = sorted(outputs.values(), key=lambda array: array.shape[2] != 4)
        boxes, logits = ordered
        if logits.shape[2] == 4:
            return None
    return (boxes, logits) if boxes.shape[2] == 4 and boxes.shape[:2] == logits.shape[:2] else None


def read_rfdetr(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    """Centres and sizes as shares of the input, and logits."""
    parts = rfdetr_parts(outputs)
    if parts is None:
        raise MisreadError("outputs have other shapes than at first")
    out = []
    for boxes, logits in zip(*parts, strict=True):
        if logits.size and logits.min() >= 0 and logits.max() <= 1:
            raise MisreadError("scores are likelihoods from 0 to 1, and logits are expected")
        value, label = _best(logits.astype(np.float64))
        score = _sigmoid(value)
        if np.abs(boxes[score >= SURE]).max(initial=0) > _SHARES:
            raise MisreadError("boxes are given in pixels, and shares of the input are expected")
        out.append(_boxes(_from_centres(boxes.astype(np.float64)) * np.tile(size, 2), score, label, least))
    return out


Kind = Literal["columns", "rows", "anchors", "boxes"]


def ultralytics_kind(outputs: Outputs, size: Size) -> Kind | None:
    """The arrangement of boxes in a single output: a column, a row or three rows for each place, or boxes alone."""
    shape = _only(outputs).shape
    if len(outputs) != 1 or len(shape) != 3:
        return None
    count = cells(size)
    if shape[2] == count and shape[1] > 4:
        return "columns"
    if shape[1] == ANCHORS * count and shape[2] > 5:
        return "anchors"
    if shape[1] == count and shape[2] > 4:
        return "rows"
    return "boxes" if shape[2] == 6 else None


def read_ultralytics(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    """Centres, sizes and scores of all places, perhaps with objectness; or corners, scores and classes of boxes."""
    kind, out = ultralytics_kind(outputs, size), []
    for output in _only(outputs):
        if kind == "boxes":
            out.append(_boxes(output[:, :4], output[:, 4], output[:, 5], least))
            continue
        rows = output.T if kind == "columns" else output
        if _kind_of_places(rows[:, :4], size, ANCHORS if kind == "anchors" else 1) != "pixels":
            raise MisreadError("boxes are not centres in pixels at the places of a grid")
        scores = likelihoods(rows[:, 4:])
        likely = np.flatnonzero((scores[:, 0] if kind == "anchors" else scores.max(axis=1)) >= least)
        rows, scores = rows[likely].astype(np.float64), scores[likely].astype(np.float64)
        score, label = _best(scores[:, 1:] if kind == "anchors" else scores)
        score = score * scores[:, 0] if kind == "anchors" else score
        out.append(_boxes(_from_centres(rows), score, label, least))
    return out
