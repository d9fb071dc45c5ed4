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
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Image
from mcaptrack.transforms.detect.onnx import outputs as read
from mcaptrack.transforms.detect.onnx.nms import Boxes, Fit, Size
from mcaptrack.transforms.detect.onnx.outputs import Outputs

LayoutName = Literal["yolox", "yolox-legacy", "nanodet", "rtdetr", "dfine", "rfdetr", "ultralytics"]

#: Where names don't say how many classes there are, this number tells YOLOX, NanoDet and Ultralytics apart.
_COCO: Final = 80
#: Columns before those of classes: a box and its objectness.
_BOX, _OBJECT = 4, 5


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
    if len(seen.inputs) != 1 or len(seen.shapes) != 1 or len(shape) != 3 or shape[1] != read.cells(seen.size):
        return 0
    count = max(0, shape[2] - before)
    if seen.names:
        return count if count == seen.names else 0
    others = {_OBJECT, _BOX, read.SIDES} - {before}
    return 0 if any(shape[2] - other == _COCO for other in others) else count


def _fits_yolox(seen: NetworkSignature) -> bool:
    return _columns(seen, _OBJECT) > 0


def _fits_nanodet(seen: NetworkSignature) -> bool:
    parts = read.nanodet_parts(seen.outputs, seen.size) if len(seen.inputs) == 1 else None
    if parts is None or parts[2] is read.PLUS or len(seen.outputs) > 1:
        return parts is not None and seen.names in (0, parts[0].shape[2])
    return _columns(seen, read.SIDES) > 0


def _fits_detr(seen: NetworkSignature) -> bool:
    if "orig_target_sizes" in seen.inputs:
        return read.detr_parts(seen.outputs) is not None
    return "logits" in seen.outputs and _fits_rfdetr(seen)


def _fits_rfdetr(seen: NetworkSignature) -> bool:
    return len(seen.inputs) == 1 and read.rfdetr_parts(seen.outputs) is not None


def _fits_ultralytics(seen: NetworkSignature) -> bool:
    kind = read.ultralytics_kind(seen.outputs, seen.size) if len(seen.inputs) == 1 else None
    if kind == "rows":
        return _columns(seen, _BOX) > 0
    return kind is not None and seen.names in (0, _ultralytics_count(kind, seen.shapes[0]) or seen.names)


def _ultralytics_count(kind: read.Kind, shape: tuple[int, ...]) -> int | None:
    return {"columns": shape[1] - _BOX, "rows": shape[2] - _BOX, "anchors": shape[2] - _OBJECT}.get(kind)


#: ImageNet's mean and standard deviation, of red, green and blue from 0 to 1.
_IMAGENET: Final[dict[str, Any]] = {"divide": 255.0, "mean": (0.485, 0.456, 0.406), "deviation": (0.229, 0.224, 0.225)}
_DETR: Final[dict[str, Any]] = {
    "divide": 255.0,
    "suppresses": True,
    "is_recognised": lambda seen: "orig_target_sizes" in seen.inputs,
}

_LAYOUTS: Final = (
    Layout("yolox", "bgr", "corner", _fits_yolox, read.read_yolox),
    Layout("yolox-legacy", "rgb", "corner", _fits_yolox, read.read_yolox, **_IMAGENET),
    Layout(
        "nanodet",
        "bgr",
        "centre",
        _fits_nanodet,
        read.read_nanodet,
        mean=(103.53, 116.28, 123.675),
        deviation=(57.375, 57.12, 58.395),
        pad=0,
    ),
    Layout("rtdetr", "rgb", "stretch", _fits_detr, read.read_detr, **_DETR),
    Layout("dfine", "rgb", "stretch", _fits_detr, read.read_detr, **_DETR),
    Layout(
        "rfdetr",
        "rgb",
        "stretch",
        _fits_rfdetr,
        read.read_rfdetr,
        suppresses=True,
        is_recognised=lambda seen: {"dets", "labels"} <= set(seen.outputs),
        **_IMAGENET,
    ),
    Layout("ultralytics", "rgb", "centre", _fits_ultralytics, read.read_ultralytics, divide=255.0),
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
        parts = read.nanodet_parts(seen.outputs, seen.size)
        return parts[0].shape[2] if parts else None
    if layout.name in ("yolox", "yolox-legacy"):
        return seen.shapes[0][2] - _OBJECT
    if layout.name == "ultralytics":
        kind = read.ultralytics_kind(seen.outputs, seen.size)
        return _ultralytics_count(kind, seen.shapes[0]) if kind else None
    arrays = read.rfdetr_parts(seen.outputs)
    return arrays[1].shape[2] if arrays else None
