"""Layouts: what families of detectors want as input, and what their outputs mean.

Each follows the exporter of its family:

* ``yolox``: Megvii YOLOX from 0.1.1 on. Pixels as they are (BGR, 0 to 255), at the top left, padded with 114. One
  output (B, N, 5 + C): offsets and log sizes on grids of strides 8, 16 and 32, objectness, and classes.
* ``yolox-legacy``: YOLOX before 0.1.1. The same outputs; RGB, with ImageNet's mean and standard deviation.
* ``nanodet``: NanoDet and NanoDet-Plus. BGR with mean and standard deviation, in the centre. Classes, and distances of
  the four sides as softmax over 8 bins: in one output (B, N, C + 32), or two for each stride.
* ``rtdetr``, ``dfine``: a second input ``orig_target_sizes``; ``labels``, ``boxes`` and ``scores`` (B, Q). RGB, 0 to 1,
  stretched.
* ``rfdetr``: ``dets`` (B, Q, 4) as parts of the picture, and ``labels`` (B, Q, C), logits. RGB, ImageNet's mean and
  standard deviation, stretched.
* ``ultralytics``: one output (B, 4 + C, N) or (B, 3 N, 5 + C) in pixels, or (B, Q, 6) after suppression. RGB, 0 to 1,
  in the centre, padded with 114.

Letters: B pictures, N places on grids, Q queries, C classes, K boxes that are likely enough.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.transforms.detect.onnx.nms import Boxes
from mcaptrack.transforms.detect.onnx.placing import Fit, Size

LayoutName = Literal["yolox", "yolox-legacy", "nanodet", "rtdetr", "dfine", "rfdetr", "ultralytics"]
Outputs = Mapping[str, NDArray[Any]]

_YOLOX: Final = (8, 16, 32)
_PLUS: Final = (8, 16, 32, 64)
#: NanoDet gives each side's distance as likelihoods of 0 to 7 strides.
_BINS: Final = 8
_SIDES: Final = 4 * _BINS
_COCO: Final = 80
#: Offsets and log sizes are smaller than this, and boxes in pixels are not.
_DECODED: Final = 30.0


class ScoreError(ValueError):
    """Likelihoods lie outside of 0 to 1: the outputs mean something else."""


@dataclass(frozen=True)
class NetworkSignature:
    """The known facts of a network: its inputs, the outputs of a trial (B = 1), the size it ran with, its metadata."""

    inputs: tuple[str, ...]
    outputs: Outputs
    size: Size
    has_names: bool = False

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of the outputs."""
        return [array.shape for array in self.outputs.values()]


@dataclass(frozen=True)
class Layout:
    """A layout: how the input is prepared (``value = (pixel / divide - mean) / deviation``), and outputs are read."""

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

    def blob(self, canvas: Image) -> NDArray[np.float32]:
        """The values (3, height, width) of an input picture (height, width, 3) in BGR."""
        import cv2

        mean = tuple(value * self.divide for value in self.mean)
        swap = self.order == "rgb"
        # The mean is subtracted in the order of the result; the stubs of OpenCV 4 and 5 differ.
        made: Any = cv2.dnn.blobFromImage(canvas, 1 / self.divide, mean=mean, swapRB=swap)
        out = np.asarray(made[0], np.float32)
        if self.deviation != (1.0, 1.0, 1.0):
            out /= np.array(self.deviation, np.float32)[:, None, None]
        return out


@lru_cache(maxsize=8)
def _grid(size: Size, strides: tuple[int, ...]) -> tuple[Floats, Floats]:
    """The numbers (N, 2) of the cells of grids, row by row, and the stride (N,) of each."""
    places, steps = [], []
    for stride in strides:
        columns, rows = -(-size[0] // stride), -(-size[1] // stride)
        y, x = np.divmod(np.arange(columns * rows), columns)
        places.append(np.stack([x, y], axis=1))
        steps.append(np.full(columns * rows, stride))
    return np.concatenate(places).astype(np.float64), np.concatenate(steps).astype(np.float64)


def _cells(size: Size, strides: tuple[int, ...]) -> int:
    return len(_grid(size, strides)[1])


def _boxes(xyxy: Floats, scores: Floats, labels: NDArray[Any], least: float) -> Boxes:
    """Boxes that are likely enough. Raises ScoreError for scores that are no likelihoods."""
    if len(scores) and not (scores.min() > -1e-3 and scores.max() < 1 + 1e-3):
        raise ScoreError
    likely = scores >= least
    scores = np.clip(scores[likely].astype(np.float64), 0, 1)
    return Boxes(xyxy[likely].astype(np.float64), scores, labels[likely].astype(np.int64))


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


def _fits_yolox(seen: NetworkSignature) -> bool:
    shapes = seen.shapes
    if len(seen.inputs) != 1 or len(shapes) != 1 or len(shapes[0]) != 3 or seen.has_names:
        return False
    return shapes[0][1] == _cells(seen.size, _YOLOX) and shapes[0][2] > 5 and shapes[0][2] - _SIDES != _COCO


def _read_yolox(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    grid, stride = _grid(size, _YOLOX)
    out = []
    for one in _only(outputs):
        likely = np.flatnonzero(one[:, 4] >= least)
        rows, places, steps = one[likely].astype(np.float64), grid[likely], stride[likely, None]
        score, label = _best(rows[:, 5:])
        if len(rows) and rows[:, :4].max() > _DECODED:  # exported with --decode_in_inference
            boxes = rows[:, :4]
        else:
            high = np.exp(np.minimum(rows[:, 2:4], _DECODED / 2)) * steps
            boxes = np.concatenate([(rows[:, :2] + places) * steps, high], axis=1)
        out.append(_boxes(_from_centres(boxes), _likelihoods(rows[:, 4]) * _likelihoods(score), label, least))
    return out


def _likelihoods(values: Floats) -> Floats:
    if len(values) and not (values.min() > -1e-3 and values.max() < 1 + 1e-3):
        raise ScoreError
    return values


def _nanodet_parts(outputs: Outputs, size: Size) -> tuple[NDArray[Any], NDArray[Any], tuple[int, ...]] | None:
    """Classes (B, N, C), distances (B, N, 32) and strides, if the outputs are those of NanoDet."""
    arrays = list(outputs.values())
    if any(array.ndim != 3 or array.dtype.kind != "f" for array in arrays):
        return None
    if len(arrays) > 1:
        sides = [array for name, array in outputs.items() if array.shape[2] == _SIDES and "cls" not in name]
        kinds = [array for array in arrays if not any(array is one for one in sides)]
        pairs = [sorted(some, key=lambda array: -array.shape[1]) for some in (kinds, sides)]
        if [a.shape[1] for a in pairs[0]] != [a.shape[1] for a in pairs[1]] or len({a.shape[2] for a in kinds}) != 1:
            return None
        joined = np.concatenate([np.concatenate(some, axis=1) for some in pairs], axis=2)
    else:
        joined = arrays[0]
    strides = next((s for s in (_YOLOX, _PLUS) if joined.shape[1] == _cells(size, s)), None)
    if strides is None or joined.shape[2] <= _SIDES:
        return None
    return joined[..., :-_SIDES], joined[..., -_SIDES:], strides


def _fits_nanodet(seen: NetworkSignature) -> bool:
    if len(seen.inputs) != 1 or seen.has_names:
        return False
    parts = _nanodet_parts(seen.outputs, seen.size)
    return parts is not None and not (len(seen.outputs) == 1 and parts[0].shape[2] + _SIDES - 5 == _COCO)


def _read_nanodet(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    parts = _nanodet_parts(outputs, size)
    if parts is None:
        raise ScoreError
    kinds, sides, strides = parts
    grid, stride = _grid(size, strides)
    offset = 0.0 if strides is _PLUS else 0.5  # as each version trained its centres
    out = []
    for scores, distances in zip(kinds, sides, strict=True):
        likely = np.flatnonzero(scores.max(axis=1) >= least)
        score, label = _best(scores[likely].astype(np.float64))
        bins = np.exp(np.minimum(distances[likely].astype(np.float64).reshape(-1, 4, _BINS), 80))
        reach = (bins @ np.arange(_BINS)) / bins.sum(axis=2) * stride[likely, None]
        centre = (grid[likely] + offset) * stride[likely, None]
        xyxy = np.concatenate([centre - reach[:, :2], centre + reach[:, 2:]], axis=1)
        out.append(_boxes(xyxy, score, label, least))
    return out


def _detr_parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Labels (B, Q), boxes (B, Q, 4) and scores (B, Q): by name, or else by shape and kind."""
    if {"labels", "boxes", "scores"} <= set(outputs):
        found = [outputs[name] for name in ("labels", "boxes", "scores")]
    elif len(outputs) == 3:
        arrays = list(outputs.values())
        kinds = [(array.ndim, array.dtype.kind) for array in arrays]
        if sorted(kinds) != [(2, "f"), (2, "i"), (3, "f")]:
            return None
        found = [arrays[kinds.index(kind)] for kind in ((2, "i"), (3, "f"), (2, "f"))]
    else:
        return None
    labels, boxes, scores = found
    fits = labels.ndim == scores.ndim == 2 and boxes.ndim == 3 and boxes.shape[2] == 4
    return (labels, boxes, scores) if fits and boxes.shape[:2] == labels.shape == scores.shape else None


def _read_detr(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    parts = _detr_parts(outputs)
    if parts is None:
        raise ScoreError
    return [_boxes(boxes, scores, labels, least) for labels, boxes, scores in zip(*parts, strict=True)]


def _rfdetr_parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Boxes (B, Q, 4) and logits (B, Q, C): by name, or else by shape where that tells them apart."""
    if any(array.ndim != 3 or array.dtype.kind != "f" for array in outputs.values()) or len(outputs) != 2:
        return None
    if {"dets", "labels"} <= set(outputs):
        boxes, logits = outputs["dets"], outputs["labels"]
    else:
        ordered = sorted(outputs.values(), key=lambda array: array.shape[2] != 4)
        boxes, logits = ordered
        if logits.shape[2] == 4:
            return None
    return (boxes, logits) if boxes.shape[2] == 4 and boxes.shape[:2] == logits.shape[:2] else None


def _read_rfdetr(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    parts = _rfdetr_parts(outputs)
    if parts is None:
        raise ScoreError
    out = []
    for boxes, logits in zip(*parts, strict=True):
        value, label = _best(logits.astype(np.float64))
        pixels = _from_centres(boxes.astype(np.float64)) * np.tile(size, 2)
        out.append(_boxes(pixels, 1 / (1 + np.exp(-np.clip(value, -60, 60))), label, least))
    return out


def _ultralytics_kind(outputs: Outputs, size: Size) -> Literal["grid", "anchors", "boxes"] | None:
    shape = next(iter(outputs.values())).shape
    if len(outputs) != 1 or len(shape) != 3:
        return None
    cells = _cells(size, _YOLOX)
    if shape[2] == cells and shape[1] > 4:
        return "grid"
    if shape[1] == 3 * cells and shape[2] > 5:
        return "anchors"
    return "boxes" if shape[2] == 6 and shape[1] not in (cells, 3 * cells) else None


def _read_ultralytics(outputs: Outputs, size: Size, least: float) -> list[Boxes]:
    kind, out = _ultralytics_kind(outputs, size), []
    for one in _only(outputs):
        if kind == "boxes":
            out.append(_boxes(one[:, :4], one[:, 4], one[:, 5], least))
            continue
        rows = one if kind == "anchors" else one.T
        likely = np.flatnonzero((rows[:, 4] if kind == "anchors" else rows[:, 4:].max(axis=1)) >= least)
        rows = rows[likely].astype(np.float64)
        score, label = _best(_likelihoods(rows[:, 5:] if kind == "anchors" else rows[:, 4:]))
        if kind == "anchors":
            score = score * _likelihoods(rows[:, 4])
        out.append(_boxes(_from_centres(rows), score, label, least))
    return out


#: ImageNet's mean and standard deviation, of red, green and blue from 0 to 1.
_IMAGENET: Final[dict[str, Any]] = {
    "divide": 255.0,
    "mean": (0.485, 0.456, 0.406),
    "deviation": (0.229, 0.224, 0.225),
}


def _fits_detr(seen: NetworkSignature) -> bool:
    return "orig_target_sizes" in seen.inputs and _detr_parts(seen.outputs) is not None


def _fits_rfdetr(seen: NetworkSignature) -> bool:
    return len(seen.inputs) == 1 and _rfdetr_parts(seen.outputs) is not None


def _fits_ultralytics(seen: NetworkSignature) -> bool:
    return len(seen.inputs) == 1 and _ultralytics_kind(seen.outputs, seen.size) is not None


_LAYOUTS: Final = (
    Layout("yolox", "bgr", "corner", _fits_yolox, _read_yolox),
    Layout("yolox-legacy", "rgb", "corner", _fits_yolox, _read_yolox, **_IMAGENET),
    Layout(
        "nanodet",
        "bgr",
        "centre",
        _fits_nanodet,
        _read_nanodet,
        mean=(103.53, 116.28, 123.675),
        deviation=(57.375, 57.12, 58.395),
        pad=0,
    ),
    Layout("rtdetr", "rgb", "stretch", _fits_detr, _read_detr, divide=255.0, suppresses=True),
    Layout("dfine", "rgb", "stretch", _fits_detr, _read_detr, divide=255.0, suppresses=True),
    Layout("rfdetr", "rgb", "stretch", _fits_rfdetr, _read_rfdetr, suppresses=True, **_IMAGENET),
    Layout("ultralytics", "rgb", "centre", _fits_ultralytics, _read_ultralytics, divide=255.0),
)
#: All layouts by name.
LAYOUTS: Final[Mapping[str, Layout]] = MappingProxyType({layout.name: layout for layout in _LAYOUTS})


def possible(seen: NetworkSignature) -> list[Layout]:
    """The layouts that the inputs and outputs of a network fit; D-FINE is read as RT-DETR, which is the same."""
    return [layout for layout in _LAYOUTS if layout.name != "dfine" and layout.fits(seen)]


def class_count(layout: Layout, seen: NetworkSignature) -> int | None:
    """The number of classes of a network; None where its outputs don't say."""
    shape = seen.shapes[0]
    if layout.name == "nanodet":
        parts = _nanodet_parts(seen.outputs, seen.size)
        return parts[0].shape[2] if parts else None
    if layout.name == "rfdetr":
        found = _rfdetr_parts(seen.outputs)
        return found[1].shape[2] if found else None
    if layout.name in ("yolox", "yolox-legacy"):
        return shape[2] - 5
    if layout.name == "ultralytics":
        kind = _ultralytics_kind(seen.outputs, seen.size)
        return {"grid": shape[1] - 4, "anchors": shape[2] - 5}.get(kind or "")
    return None
