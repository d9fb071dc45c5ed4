"""Layouts: what families of detectors want as input, and what their outputs mean.

Each follows the exporter of its family:

* ``yolox``: Megvii YOLOX from 0.1.1 on. Pixels as they are (BGR, 0 to 255), at the top left, padded with 114. One
  output (B, N, 5 + C): offsets and log sizes on grids of strides 8, 16 and 32, objectness, and classes.
* ``yolox-legacy``: YOLOX before 0.1.1. The same outputs; RGB, with ImageNet's mean and standard deviation.
* ``nanodet``: NanoDet and NanoDet-Plus. BGR with mean and standard deviation, in the centre. Classes, and distances of
  the four sides as softmax over 8 bins: in one output (B, N, C + 32), or two for each stride.
* ``rtdetr``, ``dfine``: a second input ``orig_target_sizes``; ``labels``, ``boxes`` and ``scores`` (B, Q). RGB, 0 to 1,
  stretched. Exported by transformers: ``logits`` (B, Q, C) and ``pred_boxes`` (B, Q, 4).
* ``rfdetr``: ``dets`` (B, Q, 4) as parts of the picture, and ``labels`` (B, Q, C), logits. RGB, ImageNet's mean and
  standard deviation, stretched.
* ``ultralytics``: one output (B, 4 + C, N), (B, N, 4 + C) or (B, 3 N, 5 + C) in pixels, or (B, Q, 6) after
  suppression. RGB, 0 to 1, in the centre, padded with 114.

Letters: B pictures, N places on grids, Q queries, C classes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.extensions.networks.nms import Boxes, Fit, Size
from mcaptrack.geometry.arrays import Floats, Image

LayoutName = Literal["yolox", "yolox-legacy", "nanodet", "rtdetr", "dfine", "rfdetr", "ultralytics"]

#: Where names don't say how many classes there are, this number tells YOLOX, NanoDet and Ultralytics apart.
_COCO: Final = 80
#: Columns before those of classes: a box and its objectness.
_BOX, _OBJECT = 4, 5


# Read the outputs of networks: the boxes of each family of detectors, or why the outputs can't mean that.
#
# Letters: B pictures, N places on grids, Q queries, C classes, K boxes that are likely enough.


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


@dataclass(frozen=True)
class NetworkSignature:
    """The known facts of a network: its inputs, the outputs of a trial (B = 1), the size it ran with, and the
    number of names of classes in its file.
    """

    inputs: tuple[str, ...]
    outputs: Outputs
    size: Size
    names: int = 0

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of the outputs."""
        return [array.shape for array in self.outputs.values()]


@dataclass(frozen=True)
class Layout:
    """A layout: how the input is prepared (``value = (pixel / divide - mean) / deviation``), and outputs are read.

    ``fits`` says whether a network can have it; ``is_recognised`` whether names and shapes say so on their own.
    """

    name: LayoutName
    order: Literal["bgr", "rgb"]
    fit: Fit
    fits: Callable[[NetworkSignature], bool]
    read: Callable[[Outputs, Size, float], list[Boxes]]
    divide: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    deviation: tuple[float, float, float] = (1.0, 1.0, 1.0)
    pad: int = 114
    suppresses: bool = False  # its outputs need no suppression
    is_recognised: Callable[[NetworkSignature], bool] = lambda _: True

    def blob(self, canvas: Image) -> NDArray[np.float32]:
        """The values (3, height, width) of an input picture (height, width, 3) in BGR."""
        import cv2

        mean = tuple(value * self.divide for value in self.mean)
        swap = self.order == "rgb"
        # The mean is subtracted in the order of the result; the stubs of OpenCV 4 and 5 differ.
        blob: Any = cv2.dnn.blobFromImage(canvas, 1 / self.divide, mean=mean, swapRB=swap)
        out = np.asarray(blob[0], np.float32)
        if self.deviation != (1.0, 1.0, 1.0):
            out /= np.array(self.deviation, np.float32)[:, None, None]
        return out


def _columns(seen: NetworkSignature, before: int) -> int:
    """The number of classes of a single output (B, N, ``before`` + C); 0 if it isn't one, or names say otherwise."""
    shape = seen.shapes[0]
    if len(seen.inputs) != 1 or len(seen.shapes) != 1 or len(shape) != 3 or shape[1] != cells(seen.size):
        return 0
    count = max(0, shape[2] - before)
    if seen.names:
        return count if count == seen.names else 0
    others = {_OBJECT, _BOX, SIDES} - {before}
    return 0 if any(shape[2] - other == _COCO for other in others) else count


def _fits_yolox(seen: NetworkSignature) -> bool:
    return _columns(seen, _OBJECT) > 0


def _fits_nanodet(seen: NetworkSignature) -> bool:
    parts = nanodet_parts(seen.outputs, seen.size) if len(seen.inputs) == 1 else None
    if parts is None or parts[2] is PLUS or len(seen.outputs) > 1:
        return parts is not None and seen.names in (0, parts[0].shape[2])
    return _columns(seen, SIDES) > 0


def _fits_detr(seen: NetworkSignature) -> bool:
    if "orig_target_sizes" in seen.inputs:
        return detr_parts(seen.outputs) is not None
    return "logits" in seen.outputs and _fits_rfdetr(seen)


def _fits_rfdetr(seen: NetworkSignature) -> bool:
    return len(seen.inputs) == 1 and rfdetr_parts(seen.outputs) is not None


def _fits_ultralytics(seen: NetworkSignature) -> bool:
    kind = ultralytics_kind(seen.outputs, seen.size) if len(seen.inputs) == 1 else None
    if kind == "rows":
        return _columns(seen, _BOX) > 0
    return kind is not None and seen.names in (0, _ultralytics_count(kind, seen.shapes[0]) or seen.names)


def _ultralytics_count(kind: Kind, shape: tuple[int, ...]) -> int | None:
    return {"columns": shape[1] - _BOX, "rows": shape[2] - _BOX, "anchors": shape[2] - _OBJECT}.get(kind)


#: ImageNet's mean and standard deviation, of red, green and blue from 0 to 1.
_IMAGENET: Final[dict[str, Any]] = {"divide": 255.0, "mean": (0.485, 0.456, 0.406), "deviation": (0.229, 0.224, 0.225)}
_DETR: Final[dict[str, Any]] = {
    "divide": 255.0,
    "suppresses": True,
    "is_recognised": lambda seen: "orig_target_sizes" in seen.inputs,
}

_LAYOUTS: Final = (
    Layout("yolox", "bgr", "corner", _fits_yolox, read_yolox),
    Layout("yolox-legacy", "rgb", "corner", _fits_yolox, read_yolox, **_IMAGENET),
    Layout(
        "nanodet",
        "bgr",
        "centre",
        _fits_nanodet,
        read_nanodet,
        mean=(103.53, 116.28, 123.675),
        deviation=(57.375, 57.12, 58.395),
        pad=0,
    ),
    Layout("rtdetr", "rgb", "stretch", _fits_detr, read_detr, **_DETR),
    Layout("dfine", "rgb", "stretch", _fits_detr, read_detr, **_DETR),
    Layout(
        "rfdetr",
        "rgb",
        "stretch",
        _fits_rfdetr,
        read_rfdetr,
        suppresses=True,
        is_recognised=lambda seen: {"dets", "labels"} <= set(seen.outputs),
        **_IMAGENET,
    ),
    Layout("ultralytics", "rgb", "centre", _fits_ultralytics, read_ultralytics, divide=255.0),
)
#: All layouts by name.
LAYOUTS: Final[Mapping[str, Layout]] = MappingProxyType({layout.name: layout for layout in _LAYOUTS})


def possible(seen: NetworkSignature) -> list[Layout]:
    """The layouts that the inputs and outputs of a network fit."""
    return [layout for layout in _LAYOUTS if layout.fits(seen)]


def recognised(seen: NetworkSignature) -> list[Layout]:
    """The layouts that names and shapes tell on their own; D-FINE is read as RT-DETR, which is the same."""
    return [layout for layout in possible(seen) if layout.name != "dfine" and layout.is_recognised(seen)]


def class_count(layout: Layout, seen: NetworkSignature) -> int | None:
    """The number of classes of a network; None where its outputs don't say."""
    if layout.name == "nanodet":
        parts = nanodet_parts(seen.outputs, seen.size)
        return parts[0].shape[2] if parts else None
    if layout.name in ("yolox", "yolox-legacy"):
        return seen.shapes[0][2] - _OBJECT
    if layout.name == "ultralytics":
        kind = ultralytics_kind(seen.outputs, seen.size)
        return _ultralytics_count(kind, seen.shapes[0]) if kind else None
    arrays = rfdetr_parts(seen.outputs)
    return arrays[1].shape[2] if arrays else None
