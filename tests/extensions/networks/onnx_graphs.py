"""Tiny detectors in ONNX format, one for each layout, that find blue blocks: each cell of 32 pixels that is blue.

The files are encoded here, by the numbers of fields and types in onnx.proto.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

FLOAT, INT64 = 1, 7
#: The score of a cell that is as blue as can be, and its logit for networks that give logits.
SCORE, LOGIT = 0.9, 2.0
#: How each layout's input follows from pixels: its channels, what pixels are divided by, mean, and deviation.
INPUTS = {
    "yolox": ("bgr", 1, (0, 0, 0), (1, 1, 1)),
    "yolox-legacy": ("rgb", 255, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "nanodet": ("bgr", 1, (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)),
    "rtdetr": ("rgb", 255, (0, 0, 0), (1, 1, 1)),
    "rfdetr": ("rgb", 255, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "ultralytics": ("rgb", 255, (0, 0, 0), (1, 1, 1)),
}


def varint(number: int) -> bytes:
    out = bytearray()
    number &= (1 << 64) - 1
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


class Graph(bytes):
    """An encoded graph, as an attribute."""


class Sparse(bytes):
    """An encoded sparse tensor, as an attribute."""


def tensor(values: object, name: str = "", kind: int = FLOAT) -> bytes:
    array = np.asarray(values, "<f4" if kind == FLOAT else "<i8")
    dims = b"".join(field(1, size) for size in array.shape)
    return dims + field(2, kind) + field(8, name) + field(9, array.tobytes())


def node(op: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: object) -> bytes:
    """A node; an attribute is a whole number, a list of them, or an encoded tensor, graph or sparse tensor."""
    out = b"".join(field(1, name) for name in inputs) + b"".join(field(2, name) for name in outputs) + field(4, op)
    for name, value in attributes.items():
        if isinstance(value, int):
            part = field(3, value) + field(20, 2)
        elif isinstance(value, Graph):
            part = field(6, value) + field(20, 5)
        elif isinstance(value, Sparse):
            part = field(22, value) + field(20, 11)
        elif isinstance(value, bytes):
            part = field(5, value) + field(20, 4)
        else:
            part = b"".join(field(8, one) for one in value) + field(20, 7)
        out += field(5, field(1, name) + part)
    return out


def value(name: str, shape: Sequence[int | str] | None, kind: int = FLOAT) -> bytes:
    """An input or output: its name, shape (texts are open dimensions) and type."""
    dims = b"".join(field(1, field(1, one) if isinstance(one, int) else field(2, one)) for one in shape or ())
    return field(1, name) + field(2, field(1, field(1, kind) + (field(2, dims) if shape is not None else b"")))


def graph(
    nodes: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes], constants: Mapping[str, bytes] = {}
) -> Graph:
    encoded = b"".join(field(1, one) for one in nodes) + field(2, "graph")
    encoded += b"".join(field(5, one) for one in constants.values())
    return Graph(encoded + b"".join(field(11, one) for one in inputs) + b"".join(field(12, one) for one in outputs))


def model(
    nodes: Sequence[bytes],
    inputs: Sequence[bytes],
    outputs: Sequence[bytes],
    constants: Mapping[str, bytes] = {},
    metadata: Mapping[str, str] = {},
) -> bytes:
    pairs = b"".join(field(14, field(1, key) + field(2, text)) for key, text in metadata.items())
    return field(1, 8) + field(7, graph(nodes, inputs, outputs, constants)) + field(8, field(2, 13)) + pairs


def giving(
    outputs: Mapping[str, object],
    *,
    inputs: Sequence[bytes] = (),
    shape: Sequence[int | str] = (1, 3, 128, 160),
    metadata: Mapping[str, str] = {},
) -> bytes:
    """A network that gives the same ``outputs`` for every picture; ``inputs`` are those beside the picture."""
    arrays = {name: np.asarray(array) for name, array in outputs.items()}
    kinds = {name: FLOAT if array.dtype.kind == "f" else INT64 for name, array in arrays.items()}
    return model(
        [node("Identity", [f"{name} as it is"], [name]) for name in arrays],
        [value("images", shape), *inputs],
        [value(name, None, kinds[name]) for name in arrays],
        {name: tensor(array, f"{name} as it is", kinds[name]) for name, array in arrays.items()},
        metadata,
    )


def blueness(layout: str, blue: float, grey: float = 0.0) -> tuple[np.ndarray, float]:
    """Weights of the three channels of a layout's input, and a bias: ``blue`` for pure blue, ``grey`` for any grey."""
    order, divide, mean, deviation = INPUTS[layout]
    per_pixel = np.array([1.0, 0.0, -1.0] if order == "bgr" else [-1.0, 0.0, 1.0]) * (blue - grey) / 255
    weights = per_pixel * divide * np.array(deviation, float)
    return weights, float(per_pixel @ np.array(mean, float) * divide + grey)


def heads(layout: str, channels: Sequence[float | str], strides: Sequence[int], counts: Sequence[int | None]):
    """Nodes and constants that make (1, N, channels) of the input "x", on grids of these strides.

    A channel is constant, or with a text of (score) the blueness of cells of 32 pixels. ``counts`` are the numbers of
    cells as constants of Reshape; None computes them.
    """
    nodes, constants, parts = [], {}, []
    weights, bias = blueness(layout, SCORE)
    for stride, count in zip(strides, counts, strict=True):
        kernel = np.zeros((len(channels), 3, stride, stride))
        biases = np.zeros(len(channels))
        for number, channel in enumerate(channels):
            if isinstance(channel, str):
                kernel[number] = (weights / stride**2)[:, None, None] if stride == 32 else 0
                biases[number] = bias if stride == 32 else 0
            else:
                biases[number] = channel
        constants |= {f"w{stride}": tensor(kernel, f"w{stride}"), f"b{stride}": tensor(biases, f"b{stride}")}
        constants[f"s{stride}"] = tensor([1, len(channels), -1 if count is None else count], f"s{stride}", INT64)
        nodes += [
            node("Conv", ["x", f"w{stride}", f"b{stride}"], [f"c{stride}"], strides=[stride, stride]),
            node("Clip", [f"c{stride}", "zero", "one"], [f"k{stride}"]),
            node("Reshape", [f"k{stride}", f"s{stride}"], [f"r{stride}"]),
        ]
        parts.append(f"r{stride}")
    constants |= {"zero": tensor(0.0, "zero"), "one": tensor(1.0, "one")}
    return [*nodes, node("Concat", parts, ["all"], axis=2)], constants


#: Logits of the bins of left, top, right and bottom, and by hand the distances in strides that they stand for.
BINS = [[1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0], [0] * 8, [0, 0, 0, 0, 0, 0, 0, 1]]
REACH = [28 / (np.e + 7), (np.e + 27) / (np.e + 7), 28 / 8, (7 * np.e + 21) / (np.e + 7)]


def detector(
    layout: str,
    size: tuple[int, int] = (160, 128),
    *,
    classes: int = 80,
    is_open: bool = False,
    strides: Sequence[int] | None = None,
    metadata: Mapping[str, str] = {},
    is_split: bool = False,
) -> bytes:
    """A network of this layout for pictures of ``size`` (width, height), or of any if ``is_open``.

    With ``is_split`` NanoDet has outputs of its own for classes and distances of each stride.
    """
    width, height = size
    shape = [1, 3, "h", "w"] if is_open else [1, 3, height, width]
    steps = list(strides or (8, 16, 32))
    counts = [None if is_open else width // s * (height // s) for s in steps]
    if layout in ("yolox", "yolox-legacy"):
        # A centre in the middle of its cell, and a size of e to the 0: the cell itself.
        nodes, constants = heads(layout, [0.5, 0.5, 0, 0, "score", 1, *[0.1] * (classes - 1)], steps, counts)
        nodes.append(node("Transpose", ["all"], ["output"], perm=[0, 2, 1]))
        return model(nodes, [value("x", shape)], [value("output", None)], constants, metadata)
    if layout == "nanodet":
        bins = [one for side in BINS for one in side]
        nodes, constants = heads(layout, ["score", *[0.0] * (classes - 1), *bins], steps, counts)
        nodes.append(node("Transpose", ["all"], ["output"], perm=[0, 2, 1]))
        outputs, start = ["output"], 0
        if is_split:
            outputs, constants["axes"] = [], tensor([1, 2], "axes", INT64)
            for step, count in zip(steps, counts, strict=True):
                for name, low, high in (("dis", classes, classes + 32), ("cls", 0, classes)):
                    outputs.append(f"{name}{step}")
                    ends = ((f"{name}{step}a", [start, low]), (f"{name}{step}b", [start + count, high]))
                    constants |= {key: tensor(end, key, INT64) for key, end in ends}
                    nodes.append(node("Slice", ["output", *(key for key, _ in ends), "axes"], [outputs[-1]]))
                start += count
        return model(nodes, [value("x", shape)], [value(one, None) for one in outputs], constants, metadata)
    if layout == "ultralytics":
        nodes, constants = heads(layout, ["score", *[0.0] * (classes - 1)], steps, counts)
        every = np.concatenate([cells(size, step) for step in steps])
        constants["boxes"] = tensor(every.T[None], "boxes")
        nodes.append(node("Concat", ["boxes", "all"], ["output0"], axis=1))
        return model(nodes, [value("x", shape)], [value("output0", None)], constants, metadata)
    weights, bias = blueness(layout, *((LOGIT, -6.0) if layout == "rfdetr" else (SCORE, 0.0)))
    places = cells(size, 32) / np.tile(size, 2)
    constants = {
        "w": tensor(np.broadcast_to((weights / 32**2)[None, :, None, None], (1, 3, 32, 32)), "w"),
        "b": tensor([bias], "b"),
    }
    nodes = [node("Conv", ["x", "w", "b"], ["c"], strides=[32, 32])]
    if layout == "rfdetr":
        constants |= {
            "s": tensor([1, len(places), 1], "s", INT64),
            "places": tensor(places[None], "places"),
            "rest": tensor(np.full((1, len(places), classes - 1), -9.0), "rest"),
        }
        nodes += [
            node("Reshape", ["c", "s"], ["first"]),
            node("Concat", ["first", "rest"], ["labels"], axis=2),
            node("Identity", ["places"], ["dets"]),
        ]
        return model(nodes, [value("x", shape)], [value("dets", None), value("labels", None)], constants, metadata)
    corners = np.concatenate([places[:, :2] - places[:, 2:] / 2, places[:, :2] + places[:, 2:] / 2], axis=1)
    constants |= {
        "s": tensor([1, len(places)], "s", INT64),
        "corners": tensor(corners[None], "corners"),
        "kinds": tensor(np.zeros((1, len(places))), "kinds", INT64),
        "axis": tensor([1], "axis", INT64),
    }
    nodes += [
        node("Reshape", ["c", "s"], ["scores"]), node("Cast", ["orig_target_sizes"], ["wide"], to=FLOAT),
        node("Concat", ["wide", "wide"], ["twice"], axis=1), node("Unsqueeze", ["twice", "axis"], ["factors"]),
        node("Mul", ["corners", "factors"], ["boxes"]), node("Identity", ["kinds"], ["labels"]),
    ]  # fmt: skip
    given = [value("x", shape), value("orig_target_sizes", [1, 2], INT64)]
    return model(nodes, given, [value("labels", None, INT64), value("boxes", None), value("scores", None)], constants)


def cells(size: tuple[int, int], stride: int) -> np.ndarray:
    """Centres and sizes (N, 4) of the cells of a grid, row by row, in pixels."""
    places = [(x, y) for y in range(0, size[1], stride) for x in range(0, size[0], stride)]
    return np.array([(x + stride / 2, y + stride / 2, stride, stride) for x, y in places], float)


def blue_blocks(size: tuple[int, int], *blocks: tuple[int, int, int, int]) -> np.ndarray:
    """A grey picture with blue blocks (x, y, width, height)."""
    image = np.full((size[1], size[0], 3), 114, np.uint8)
    for x, y, w, h in blocks:
        image[y : y + h, x : x + w] = (255, 0, 0)
    return image
