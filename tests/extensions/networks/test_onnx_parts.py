"""Parts of learned detectors: places on grids, which outputs are of which family, and the graph of another size."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks import graph, layouts
from mcaptrack.extensions.networks.detector import Contest, refuse_if_misread
from mcaptrack.extensions.networks.layouts import LAYOUTS, MisreadError
from mcaptrack.extensions.networks.nms import Boxes, join_tiles, place, suppress, tiles_of
from tests.extensions.networks.onnx_graphs import FLOAT, INT64, model, node, tensor, value

WIDE, HIGH = 96, 68  # the height fits no stride
SIZE = (WIDE, HIGH)


def places(*strides: int) -> list[tuple[int, int, int]]:
    """Column, row and stride of all cells, by hand."""
    return [
        (column, row, stride)
        for stride in strides
        for row in range(math.ceil(HIGH / stride))
        for column in range(math.ceil(WIDE / stride))
    ]


@pytest.mark.parametrize(("strides", "offset"), [((8, 16, 32), 0.5), ((8, 16, 32, 64), 0.0)])
def test_a_box_of_nanodet_reaches_from_its_cell(strides, offset):
    """In each grid, with distances of which each side's bins are sure of one number, or torn between two."""
    cells = places(*strides)
    for number in (0, 5, len(cells) - 3, *(cells.index((1, 0, stride)) for stride in strides)):
        rows = np.zeros((1, len(cells), 2 + 32))
        rows[0, :, 2:] = np.tile([9, *[0] * 7], 4)
        sides = (1, 0, 7, 3.5)
        bins = np.full((4, 8), -50.0)
        for side, reach in enumerate(sides):
            bins[side, [math.floor(reach), math.ceil(reach)]] = 4
        rows[0, number, 2:] = bins.ravel()
        rows[0, number, 1] = 0.75
        (found,) = layouts.read_nanodet({"out": rows}, SIZE, 0.3)
        column, row, stride = cells[number]
        x, y = (column + offset) * stride, (row + offset) * stride
        wanted = [x - stride, y, x + 7 * stride, y + 3.5 * stride]
        np.testing.assert_allclose(found.xyxy, [wanted], atol=1e-9)
        assert (found.score.tolist(), found.label.tolist()) == ([0.75], [1])


def test_a_box_of_yolox_lies_in_its_cell():
    cells = places(8, 16, 32)
    rows = np.zeros((1, len(cells), 7))
    for number, score in ((0, 0.5), (9, 0.19), (30, 0.25), (len(cells) - 1, 1.0)):
        rows[0, number] = 0.25, 0.75, math.log(2), 0, score, 0.5, 0.9
    (found,) = layouts.read_yolox({"out": rows}, SIZE, 0.2)
    for box, number in zip(found.xyxy, (0, 30, len(cells) - 1), strict=True):
        column, row, stride = cells[number]
        x, y = (column + 0.25) * stride, (row + 0.75) * stride
        np.testing.assert_allclose(box, [x - stride, y - stride / 2, x + stride, y + stride / 2])
    np.testing.assert_allclose(found.score, [0.45, 0.225, 0.9])
    assert found.label.tolist() == [1, 1, 1]
    rows[0, 0, 2] = 80
    (found,) = layouts.read_yolox({"out": rows}, SIZE, 0.25)
    assert found.xyxy[0, 2] - found.xyxy[0, 0] == pytest.approx(8 * math.exp(15))


def array(*shape: int, kind: str = "f4") -> np.ndarray:
    return np.zeros(shape, kind)


DETR = {"labels": array(2, 5, kind="i8"), "boxes": array(2, 5, 4), "scores": array(2, 5)}


@pytest.mark.parametrize(
    ("given", "fits"),
    [
        (DETR, True),
        (DETR | {"labels": array(2, 5)}, True),
        (DETR | {"more": array(1)}, True),
        (DETR | {"boxes": array(2, 5, 6)}, False),
        (DETR | {"boxes": array(2, 4, 4)}, False),
        (DETR | {"boxes": array(2, 5)}, False),
        (DETR | {"scores": array(2, 6)}, False),
        (DETR | {"labels": array(3, 5)}, False),
        ({name: one[0] for name, one in DETR.items()}, False),
        (DETR | {"scores": array(2, 5, 4), "labels": array(2, 5, 4)}, False),
        ({"a": DETR["scores"], "b": DETR["boxes"], "c": DETR["labels"]}, True),
        ({"a": DETR["scores"], "b": DETR["boxes"], "c": array(2, 5)}, False),
        ({"a": DETR["scores"], "b": array(2, 5, 4, kind="i8"), "c": DETR["labels"]}, False),
        ({"a": DETR["scores"], "b": DETR["boxes"]}, False),
        ({"a": DETR["scores"], "b": DETR["boxes"], "c": DETR["labels"], "d": array(1)}, False),
    ],
)
def test_outputs_of_detr_have_these_shapes(given, fits):
    found = layouts.detr_parts(given)
    assert (found is not None) == fits
    if found is not None:
        labels, boxes, scores = found
        assert (labels.shape, boxes.shape, scores.shape) == ((2, 5), (2, 5, 4), (2, 5))
        assert labels.dtype.kind == "i" or "labels" in given


@pytest.mark.parametrize(
    ("given", "boxes"),
    [
        ({"dets": array(1, 7, 4), "labels": array(1, 7, 9)}, "dets"),
        ({"logits": array(1, 7, 4), "pred_boxes": array(1, 7, 4)}, "pred_boxes"),
        ({"a": array(1, 7, 9), "b": array(1, 7, 4)}, "b"),
        ({"a": array(1, 7, 4), "b": array(1, 7, 4)}, ""),
        ({"a": array(1, 7, 5), "b": array(1, 7, 9)}, ""),
        ({"dets": array(1, 7, 4), "labels": array(1, 8, 9)}, ""),
        ({"dets": array(1, 7, 5), "labels": array(1, 7, 9)}, ""),
        ({"dets": array(7, 4), "labels": array(1, 7, 9)}, ""),
        ({"dets": array(1, 7, 4), "labels": array(1, 7, 9, kind="i4")}, ""),
        ({"dets": array(1, 7, 4)}, ""),
        ({"dets": array(1, 7, 4), "labels": array(1, 7, 9), "masks": array(1, 7, 3)}, ""),
    ],
)
def test_outputs_of_rfdetr_have_these_shapes(given, boxes):
    found = layouts.rfdetr_parts(given)
    assert (found is not None) == bool(boxes)
    assert not boxes or found[0] is given[boxes]


COUNT = len(places(8, 16, 32))


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((1, 5, COUNT), "columns"), ((1, 84, COUNT), "columns"), ((1, 4, COUNT), None), ((1, 3 * COUNT, 6), "anchors"),
        ((1, 3 * COUNT, 5), None), ((1, COUNT, 5), "rows"), ((1, COUNT, 4), None), ((1, COUNT, 6), "rows"),
        ((1, 300, 6), "boxes"), ((1, 300, 7), None), ((300, 6), None),
    ],
)  # fmt: skip
def test_the_shape_of_one_output_tells_how_boxes_are_arranged(shape, kind):
    assert layouts.ultralytics_kind({"out": array(*shape)}, SIZE) == kind
    assert layouts.ultralytics_kind({"out": array(*shape), "more": array(1)}, SIZE) is None


# The graph


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("{0: 'person', 2: 'car'}", {0: "person", 2: "car"}),
        ("['a', 'b']", {0: "a", 1: "b"}),
        ("('a', 'b')", {0: "a", 1: "b"}),
        ("{0: 'a', 1: 5}", {}),
        ("{-1: 'a'}", {}),
        ("{True: 'a'}", {}),
        ("{'0': 'a'}", {}),
        ("'text'", {}),
        ("{0: 'a'", {}),
        ("print()", {}),
        ("", {}),
        (str(["x" * 99_996]), {0: "x" * 99_996}),
        (str(["x" * 99_997]), {}),
    ],
)
def test_names_of_classes_are_a_list_or_a_map_from_whole_numbers(text, names):
    data = model([node("Identity", ["x"], ["y"])], [], [], metadata={"stride": "32", "names": text})
    assert graph.class_names(graph.parse(data)) == names
    assert graph.class_names(graph.parse(model([node("Identity", ["x"], ["y"])], [], []))) == {}


def test_the_size_of_an_input_is_its_last_two_numbers():
    data = model(
        [node("Identity", ["x"], ["y"])],
        [value("size", [1, 2]), value("x", [1, 3, 128, 160]), value("z", [1, 3, "h", 160])],
        [],
    )
    parsed = graph.parse(data)
    assert [graph.input_size(parsed, name) for name in ("x", "z", "none")] == [(160, 128), (160, None), (None, None)]


@pytest.mark.parametrize("data", [b"", b"\x08\x08", b"text", model([], [], [])])
def test_what_has_no_nodes_is_no_network(data):
    with pytest.raises(graph.NotOnnxError):
        graph.parse(data)


def constants(data: bytes) -> dict[str, list[int]]:
    found = graph._constants(graph.parse(data))
    return {name: np.frombuffer(one.raw_data, "<i8").tolist() for name, one in found.items() if one.data_type == INT64}


def test_all_numbers_that_follow_from_the_size_are_changed_and_no_others():
    """From 160x128 to 320x192: grids of each stride, their cells, and the cells of three and of four grids together."""
    old, new = (160, 128), (320, 192)
    steps = (4, 8, 16, 32, 64)
    cells = {s: ((old[0] // s) * (old[1] // s), (new[0] // s) * (new[1] // s)) for s in steps}
    joined = [tuple(sum(cells[s][k] for s in some) for k in (0, 1)) for some in (steps[1:4], steps[1:5])]
    tensors, nodes, wanted = {}, [], {}
    for number, (before, after) in enumerate([*cells.values(), *joined, (77, 77)]):
        name = f"shape{number}"
        tensors[name], wanted[name] = tensor([1, -1, before], name, INT64), [1, -1, after]
        nodes.append(node("Reshape", ["x", name], [f"r{number}"]))
    for s in steps:
        name = f"size{s}"
        tensors[name] = tensor([1, 8, old[1] // s, old[0] // s], name, INT64)
        wanted[name] = [1, 8, new[1] // s, new[0] // s]
        nodes.append(node("Resize", ["x", "", "", name], [f"z{s}"]))
    tensors["turned"] = tensor([1, 8, 20, 16], "turned", INT64)  # of height 128 is 16, not 20
    wanted["turned"] = [1, 8, 20, 16]
    nodes.append(node("Resize", ["x", "", "", "turned"], ["zt"]))
    held = tensor([1, 255, 320], "", INT64)
    nodes += [node("Constant", [], ["held"], value=held), node("Reshape", ["x", "held"], ["rh"])]
    wanted["held"] = [1, 255, (new[0] // 8) * (new[1] // 8)]
    tensors["axes"], wanted["axes"] = tensor([320, 80], "axes", INT64), [320, 80]
    nodes.append(node("Slice", ["x", "axes", "axes", "axes"], ["s"]))
    tensors["scale"] = tensor([320.0, 80.0], "scale", FLOAT)
    nodes.append(node("Reshape", ["x", "scale"], ["odd"]))
    data = model(nodes, [value("other", [1, 2]), value("x", [1, 3, 128, 160])], [value("r0", [1, 5, 320])], tensors)
    made = graph.resized(data, "x", old, new)
    assert constants(made) == wanted
    parsed = graph.parse(made)
    assert graph.input_size(parsed, "x") == new
    assert [dim.dim_value for dim in parsed.graph.input[0].type.tensor_type.shape.dim] == [1, 2]
    assert not parsed.graph.output[0].type.tensor_type.HasField("shape")
    assert [one.op_type for one in parsed.graph.node] == [one.op_type for one in graph.parse(data).graph.node]
    scale = graph._constants(parsed)["scale"]
    assert np.frombuffer(scale.raw_data, "<f4").tolist() == [320, 80]


class TestContest:
    """Which of two layouts is meant, by the sums of their high scores in pictures."""

    @staticmethod
    def found(*scores: float) -> Boxes:
        return Boxes(np.zeros((len(scores), 4)), np.array(scores), np.zeros(len(scores), np.int64))

    def contest(self, *names: str) -> Contest:
        return Contest(Path("net.onnx"), [LAYOUTS[name] for name in names])

    def left(self, contest: Contest) -> list[str]:
        return [layout.name for layout in contest.layouts]

    @pytest.mark.parametrize(
        ("one", "other", "left"),
        [
            ((0.8,), (0.41,), ["yolox", "rtdetr"]),
            ((0.8,), (0.4,), ["yolox"]),  # twice as much
            ((0.41,), (0.9,), ["rtdetr"]),
            ((0.8, 0.39), (0.4, 0.39, 0.39), ["yolox"]),  # low scores don't count
            ((0.39,), (), ["yolox", "rtdetr"]),
            ((0.4,), (0.39,), ["yolox"]),
            ((), (), ["yolox", "rtdetr"]),
        ],
    )
    def test_one_is_meant_that_has_twice_the_evidence_of_the_other(self, one, other, left):
        contest = self.contest("yolox", "rtdetr")
        contest.see({"yolox": self.found(*one), "rtdetr": self.found(*other)})
        assert self.left(contest) == left
        assert contest.is_settled == (len(left) == 1)

    def test_evidence_is_summed_over_pictures(self):
        contest = self.contest("yolox", "rtdetr", "rfdetr")
        for scores, settled in (((0.9, 0.5, 0.9), False), ((0.9, 0.45, 0.41), False), ((0.9, 0.4, 0.0), True)):
            names = ("yolox", "rtdetr", "rfdetr")
            contest.see({name: self.found(score) for name, score in zip(names, scores, strict=True)})
            assert contest.is_settled == settled
        assert self.left(contest) == ["yolox"]
        contest.see({})  # nothing is asked any more

    def test_what_cannot_be_told_in_25_pictures_from_the_first_box_on_is_refused(self):
        contest = self.contest("yolox", "rtdetr")
        for _ in range(30):
            contest.see({"yolox": self.found(), "rtdetr": self.found()})
        for number in range(24):
            scores = (0.9,) if number % 2 == 0 else ()
            contest.see({"yolox": self.found(*scores), "rtdetr": self.found(*scores)})
        with pytest.raises(McaptrackError, match="much the same read as yolox and rtdetr; choose"):
            contest.see({"yolox": self.found(0.9), "rtdetr": self.found(0.9)})

    def test_a_layout_that_cannot_be_meant_is_out(self):
        contest = self.contest("yolox", "rtdetr")
        contest.see({"yolox": self.found(), "rtdetr": MisreadError("no boxes")})
        assert self.left(contest) == ["yolox"]
        contest = self.contest("yolox", "rtdetr")
        with pytest.raises(McaptrackError, match="fits no layout: read as yolox, one; read as rtdetr, two"):
            contest.see({"yolox": MisreadError("one"), "rtdetr": MisreadError("two")})

    def test_at_the_end_the_first_is_taken_if_nothing_was_seen_and_refused_otherwise(self):
        contest = self.contest("rtdetr", "yolox")
        contest.see({"yolox": self.found(), "rtdetr": self.found(0.3)})
        contest.end()
        assert self.left(contest) == ["rtdetr"]
        contest = self.contest("rtdetr", "yolox")
        contest.see({"yolox": self.found(0.9), "rtdetr": self.found(0.8)})
        with pytest.raises(McaptrackError, match="much the same read as rtdetr and yolox"):
            contest.end()

    @pytest.mark.parametrize("is_chosen", [True, False])
    def test_a_network_that_another_layout_would_read_is_refused(self, is_chosen):
        found = {
            "rtdetr": [MisreadError("x"), self.found(0.3)],
            "rfdetr": [self.found(0.9, 0.4, 0.3), self.found(0.5), self.found()],
        }
        words = "read as yolox, finds nothing in 7 pictures, and read as rfdetr finds 3 boxes in 2 of 3; choose "
        with pytest.raises(McaptrackError, match=words + ("`layout='rfdetr'`" if is_chosen else "with `layout=`")):
            refuse_if_misread(Path("net.onnx"), LAYOUTS["yolox"], 7, found, is_chosen)
        refuse_if_misread(Path("net.onnx"), LAYOUTS["yolox"], 7, {"rtdetr": found["rtdetr"]}, is_chosen)


# Pictures in the input of a network and boxes back, tiles and their seams, and suppression: against slow references


SEEDS = st.integers(0, 2**32 - 1)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    wide, high = (min(a[k + 2], b[k + 2]) - max(a[k], b[k]) for k in (0, 1))
    inner = max(wide, 0) * max(high, 0)
    return inner / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inner)


def greedy(boxes: Boxes, most: float) -> list[int]:
    """The textbook's suppression, one box after the other; the indices of those that are kept."""
    left = sorted(range(len(boxes.score)), key=lambda n: (-boxes.score[n], boxes.xyxy[n, 1], boxes.xyxy[n, 0]))
    kept = []
    while left:
        best = left.pop(0)
        kept.append(best)
        left = [
            n for n in left if boxes.label[n] != boxes.label[best] or overlap(boxes.xyxy[n], boxes.xyxy[best]) <= most
        ]
    return kept


def some_boxes(rng: np.random.Generator, count: int, classes: int = 2) -> Boxes:
    low = rng.uniform(0, 100, (count, 2))
    size = rng.uniform(5, 60, (count, 2))
    return Boxes(np.hstack([low, low + size]), rng.uniform(0, 1, count).round(2), rng.integers(0, classes, count))


@given(seed=SEEDS, count=st.integers(0, 60), most=st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_suppression_keeps_what_the_textbook_keeps(seed, count, most):
    boxes = some_boxes(np.random.default_rng(seed), count)
    assert suppress(boxes, most).xyxy.tolist() == boxes.xyxy[greedy(boxes, most)].tolist()


def bilinear(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture at another size: between the four nearest pixels, whose centres are at halves."""
    out = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            y = min(max((row + 0.5) * image.shape[0] / height - 0.5, 0), image.shape[0] - 1)
            x = min(max((column + 0.5) * image.shape[1] / width - 0.5, 0), image.shape[1] - 1)
            y0, x0 = int(y), int(x)
            y1, x1 = min(y0 + 1, image.shape[0] - 1), min(x0 + 1, image.shape[1] - 1)
            top = image[y0, x0] * (1 - x + x0) + image[y0, x1] * (x - x0)
            low = image[y1, x0] * (1 - x + x0) + image[y1, x1] * (x - x0)
            out[row, column] = top * (1 - y + y0) + low * (y - y0)
    return out


@given(seed=SEEDS, fit=st.sampled_from(["corner", "centre", "stretch"]), data=st.data())
@settings(max_examples=25, deadline=None)
def test_a_picture_fills_the_input_or_keeps_its_proportions(seed, fit, data):
    wide, high, w, h = (data.draw(st.integers(8, 40)) for _ in range(4))
    x1, y1 = data.draw(st.integers(0, 5)), data.draw(st.integers(0, 5))
    image = np.random.default_rng(seed).integers(0, 256, (h + y1, w + x1, 3)).astype(np.uint8)
    canvas, placement = place(image, (x1, y1, x1 + w, y1 + h), (wide, high), fit, 114)
    ratio = min(wide / w, high / h)
    inner = (wide, high) if fit == "stretch" else (max(1, round(w * ratio)), max(1, round(h * ratio)))
    left, top = ((wide - inner[0]) // 2, (high - inner[1]) // 2) if fit == "centre" else (0, 0)
    expected = np.full((high, wide, 3), 114.0)
    expected[top : top + inner[1], left : left + inner[0]] = bilinear(image[y1:, x1:].astype(float), *inner)
    assert canvas.shape == expected.shape
    assert np.abs(canvas - expected).max() <= 1.5
    corners = np.array([[left, top, left + inner[0], top + inner[1]]], float)
    np.testing.assert_allclose(placement.to_picture(corners), [[x1, y1, x1 + w, y1 + h]], atol=1e-9)


@given(
    width=st.integers(20, 400),
    height=st.integers(20, 400),
    columns=st.integers(1, 5),
    rows=st.integers(1, 5),
    overlap=st.floats(0, 0.5),
)
@settings(max_examples=60, deadline=None)
def test_tiles_cover_the_picture_and_share_what_they_should(width, height, columns, rows, overlap):
    tiles = tiles_of(width, height, columns, rows, overlap)
    assert len(tiles) == columns * rows
    covered = np.zeros((height, width), bool)
    for x1, y1, x2, y2 in tiles:
        assert 0 <= x1 < x2 <= width
        assert 0 <= y1 < y2 <= height
        covered[y1:y2, x1:x2] = True
    assert covered.all()
    assert len({(x2 - x1, y2 - y1) for x1, y1, x2, y2 in tiles}) == 1
    for (_, _, x2, _), (x1, _, _, _) in pairwise(tiles[:columns]):
        assert x2 - x1 >= overlap * (tiles[0][2] - tiles[0][0]) - 1


#: Two tiles of a picture of 180 x 100, which share 80 to 100.
LEFT, RIGHT = (0, 0, 100, 100), (80, 0, 180, 100)


def joined(left: list[tuple], right: list[tuple], labels: tuple[int, int] = (0, 0)) -> list[list[float]]:
    parts = [
        Boxes(
            np.array([one[:4] for one in some], float).reshape(-1, 4),
            np.array([one[4] for one in some]),
            np.full(len(some), label),
        )
        for some, label in zip((left, right), labels, strict=True)
    ]
    found = join_tiles(parts, [LEFT, RIGHT], 0.6)
    return [[*box, score] for box, score in zip(found.xyxy.tolist(), found.score.tolist(), strict=True)]


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        # whole in both tiles: once
        ([(86, 10, 94, 40, 0.8)], [(86, 10, 94, 41, 0.7)], [[86, 10, 94, 40, 0.8]]),
        # cut off by the left tile's edge, whole in the right one: the whole one, with the better score
        ([(88, 10, 100, 40, 0.9)], [(88, 10, 118, 40, 0.6)], [[88, 10, 118, 40, 0.9]]),
        # wider than what the tiles share, cut off in both: one box of both parts
        ([(60, 10, 100, 40, 0.6)], [(80, 11, 130, 41, 0.7)], [[60, 10, 130, 41, 0.7]]),
        # two people at the seam, of whom one stands above the other: both
        ([(70, 10, 100, 40, 0.6)], [(80, 50, 110, 80, 0.7)], [[80, 50, 110, 80, 0.7], [70, 10, 100, 40, 0.6]]),
        # two people side by side, whole in one tile each: both
        ([(60, 10, 79, 40, 0.6)], [(101, 10, 120, 40, 0.7)], [[101, 10, 120, 40, 0.7], [60, 10, 79, 40, 0.6]]),
        # cut off at the edge of the picture, which is no seam
        ([(0, 10, 20, 40, 0.6)], [(160, 10, 180, 40, 0.7)], [[160, 10, 180, 40, 0.7], [0, 10, 20, 40, 0.6]]),
        ([], [(150, 10, 160, 40, 0.7)], [[150, 10, 160, 40, 0.7]]),
        ([], [], []),
    ],
)
def test_boxes_of_tiles_are_joined_across_the_seam(left, right, expected):
    assert joined(left, right) == expected


def test_boxes_of_two_classes_are_never_joined():
    assert len(joined([(60, 10, 100, 40, 0.6)], [(80, 11, 130, 41, 0.7)], (0, 1))) == 2


def seen_in_tiles(people: np.ndarray, tiles: list[tuple[int, int, int, int]]) -> list[Boxes]:
    """What a perfect detector finds in each tile: the visible part of each person of whom a third or more is there."""
    parts = []
    for tile in tiles:
        xyxy = np.hstack([np.maximum(people[:, :2], tile[:2]), np.minimum(people[:, 2:], tile[2:])])
        visible = np.prod(np.maximum(xyxy[:, 2:] - xyxy[:, :2], 0), axis=1) / np.prod(
            people[:, 2:] - people[:, :2], axis=1
        )
        some = visible >= 0.35
        parts.append(Boxes(xyxy[some], 0.4 + visible[some] / 2, np.zeros(some.sum(), int)))
    return parts


def crowd(rng: np.random.Generator, size: tuple[int, int], most_iou: float) -> np.ndarray:
    """People anywhere in a picture, who overlap one another by ``most_iou`` at most."""
    people: list[np.ndarray] = []
    for _ in range(40):
        wide = rng.uniform(25, 90)
        shape = np.array([wide, wide * rng.uniform(2, 3)])
        low = rng.uniform(0, np.array(size) - shape)
        box = np.concatenate([low, low + shape])
        if all(overlap(box, other) <= most_iou for other in people):
            people.append(box)
    return np.array(people)


def lost_and_added(people: np.ndarray, found: np.ndarray) -> tuple[int, int]:
    """How many people have no box, and how many boxes are no person or a second one."""
    same = np.array([[overlap(one, box) > 0.8 for box in found] for one in people])
    return int((~same.any(axis=1)).sum()), len(found) - int(same.any(axis=1).sum())


@given(seed=SEEDS, grid=st.sampled_from([(3, 2), (2, 3), (1, 4)]), overlap_of_tiles=st.sampled_from([0.1, 0.2, 0.4]))
@settings(max_examples=20, deadline=None)
def test_people_apart_from_one_another_have_one_box_each_wherever_seams_are(seed, grid, overlap_of_tiles):
    people = crowd(np.random.default_rng(seed), (1400, 1000), 0.0)
    tiles = tiles_of(1400, 1000, *grid, overlap_of_tiles)
    assert lost_and_added(people, join_tiles(seen_in_tiles(people, tiles), tiles, 0.45).xyxy) == (0, 0)


def test_people_who_hide_one_another_at_a_seam_are_kept():
    tiles = tiles_of(1400, 1000, 3, 2, 0.2)
    scenes = [crowd(np.random.default_rng(seed), (1400, 1000), 0.4) for seed in range(8)]
    counts = [lost_and_added(people, join_tiles(seen_in_tiles(people, tiles), tiles, 0.45).xyxy) for people in scenes]
    assert sum(map(len, scenes)) > 200
    assert np.sum(counts, axis=0).tolist() == [0, 0]
