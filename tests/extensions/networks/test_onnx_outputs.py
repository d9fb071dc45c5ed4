"""Outputs of networks in other conventions: each is read as what it is, or refused with the reason, by every layout."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks import layouts
from mcaptrack.extensions.networks.detector import OnnxDetector
from mcaptrack.schema import Frame
from tests.extensions.networks.onnx_graphs import INT64, cells, giving, value

SIZE = (160, 128)
WIDE = np.tile(SIZE, 2)
#: All places of grids as centre and size; two of them hold an object, with these scores and classes.
PLACES = np.concatenate([cells(SIZE, stride) for stride in (8, 16, 32)])
OBJECTS = {100: (0.9, 0), 411: (0.8, 2)}
#: Left, top, width, height and class id of the two, in reading order.
EXPECTED = [(0, 40, 8, 8, 1), (32, 64, 32, 32, 3)]
SIZES = [value("orig_target_sizes", [1, 2], INT64)]
SOME = PLACES[list(OBJECTS)]
CORNERS = np.hstack([SOME[:, :2] - SOME[:, 2:] / 2, SOME[:, :2] + SOME[:, 2:] / 2])
LABELS, SCORES = np.array([[0, 2]]), np.array([[0.9, 0.8]])
PICTURE = np.full((SIZE[1], SIZE[0], 3), 114, np.uint8)


def grid(classes: int = 80, has_objectness: bool = False, **changes: Any) -> np.ndarray:
    """Rows (1, N, 4 + C) of an export with a grid: centre, size, perhaps objectness, and classes."""
    scores = np.zeros((len(PLACES), classes))
    for place, (score, label) in OBJECTS.items():
        scores[place, min(label, classes - 1)] = score
    objectness = [(scores.max(axis=1, keepdims=True) > 0).astype(float)] if has_objectness else []
    columns = {"boxes": PLACES, "objectness": np.hstack([*objectness, np.empty((len(PLACES), 0))]), "scores": scores}
    return np.hstack(list((columns | changes).values()))[None]


def suppressed(boxes: np.ndarray = CORNERS, labels: Any = (0, 2)) -> np.ndarray:
    """Rows (1, 300, 6) of an export with suppression; what is left of 300 is zeros."""
    out = np.zeros((1, 300, 6))
    out[0, :2] = np.column_stack([boxes, SCORES[0], labels])
    return out


def logits(classes: int = 80) -> np.ndarray:
    out = np.full((1, 2, classes), -6.0)
    out[0, [0, 1], [0, 2]] = 2.0, 1.5
    return out


def transposed(rows: np.ndarray) -> np.ndarray:
    return rows.transpose(0, 2, 1)


def anchors() -> np.ndarray:
    """YOLO with three boxes at each place, which are one after the other for each stride; the first of each is used."""
    rows, parts, start = grid(has_objectness=True)[0], [], 0
    for stride in (8, 16, 32):
        count = (SIZE[0] // stride) * (SIZE[1] // stride)
        some = rows[start : start + count]
        parts += [some, *[np.hstack([some[:, :4], np.zeros((count, 81))])] * 2]
        start += count
    return np.concatenate(parts)[None]


ODD = grid(boxes=PLACES / WIDE)
READ = {
    "columns": ("ultralytics", giving({"output0": transposed(grid())})),
    "rows": ("ultralytics", giving({"output0": grid()})),
    "columns, 7 classes": ("ultralytics", giving({"output0": transposed(grid(7))})),
    "rows with names": ("ultralytics", giving({"output0": grid(7)}, metadata={"names": str(list("abcdefg"))})),
    "anchors": ("ultralytics", giving({"output0": anchors()})),
    "suppressed": ("ultralytics", giving({"output0": suppressed()})),
    "open batch": ("ultralytics", giving({"output0": suppressed()}, shape=["n", 3, 128, 160])),
    "labels first": ("rtdetr", giving({"labels": LABELS, "boxes": CORNERS[None], "scores": SCORES}, inputs=SIZES)),
    "scores first": ("rtdetr", giving({"scores": SCORES, "boxes": CORNERS[None], "labels": LABELS}, inputs=SIZES)),
    "other names": ("rtdetr", giving({"a": SCORES, "b": LABELS, "c": CORNERS[None]}, inputs=SIZES)),
    "labels as floats": (
        "rtdetr",
        giving({"labels": LABELS.astype(float), "boxes": CORNERS[None], "scores": SCORES}, inputs=SIZES),
    ),
    "size as floats": (
        "rtdetr",
        giving(
            {"labels": LABELS, "boxes": CORNERS[None], "scores": SCORES}, inputs=[value("orig_target_sizes", [1, 2])]
        ),
    ),
    "dets first": ("rfdetr", giving({"dets": (SOME / WIDE)[None], "labels": logits()})),
    "dets second": ("rfdetr", giving({"labels": logits(), "dets": (SOME / WIDE)[None]})),
    "as many classes as sides": ("rfdetr", giving({"labels": logits(4), "dets": (SOME / WIDE)[None]})),
    "yolox in pixels": ("yolox", giving({"output": grid(has_objectness=True)})),
    "yolox with names": (
        "yolox",
        giving({"output": grid(7, has_objectness=True)}, metadata={"names": str(dict(enumerate("abcdefg")))}),
    ),
}
REFUSED = {
    "shares in columns": (ODD.transpose(0, 2, 1), "boxes are given as shares of the input, and pixels are expected"),
    "corners in columns": (
        transposed(grid(boxes=np.hstack([PLACES[:, :2] - PLACES[:, 2:] / 2, PLACES[:, :2] + PLACES[:, 2:] / 2]))),
        "boxes are given by their corners",
    ),
    "logits": (transposed(grid(scores=np.where(grid()[0, :, 4:] > 0, 0.7, -5.0))), "no likelihoods from 0 to 1"),
    "no places": (transposed(grid(boxes=PLACES[::-1])), "boxes are not centres in pixels at the places of a grid"),
    "shares": (suppressed(CORNERS / WIDE), "boxes are given as shares of the input"),
    "centre and size": (suppressed(SOME), "boxes end before they begin"),
    "score and class exchanged": (suppressed()[..., [0, 1, 2, 3, 5, 4]], "no likelihoods from 0 to 1"),
    "fractions of classes": (suppressed(labels=[0.5, 2]), "classes are not whole numbers"),
}


pytestmark = pytest.mark.usefixtures("networks_here")


def detect(data: bytes, folder: Any, **options: Any) -> tuple[list[tuple[int, ...]], str]:
    """What is found in a picture, and the layout."""
    path = folder / "network.onnx"
    path.write_bytes(data)
    found_by = OnnxDetector(file=str(path), **{"classes": "all", **options})
    ((frame,),) = found_by([Frame(0, 0, PICTURE)])
    rows = [tuple(round(float(row[name])) for name in ("x_px", "y_px", "w_px", "h_px")) for row in frame.rows]
    return [(*row, int(kind)) for row, kind in zip(rows, frame.rows["class_id"], strict=True)], (
        found_by.model_card().facts["layout"]
    )


def refused(data: bytes, folder: Any, **options: Any) -> str:
    with pytest.raises(McaptrackError) as error:
        detect(data, folder, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("case", READ)
@pytest.mark.parametrize("is_named", [True, False])
def test_every_convention_that_is_known_gives_the_same_boxes(case, is_named, tmp_path):
    layout, data = READ[case]
    if layout == "yolox" and not is_named:  # the legacy one finds the same whatever the picture
        assert refused(data, tmp_path).endswith(
            "finds much the same read as yolox and yolox-legacy; choose with `layout=`"
        )
        return
    boxes, taken = detect(data, tmp_path, layout=layout if is_named else "auto")
    assert taken == layout
    assert [box[:4] for box in boxes] == [box[:4] for box in EXPECTED]
    assert len({box[4] for box in boxes}) == 2


def test_rows_of_a_single_class_are_read(tmp_path):
    scores = grid()[0, :, 4:].max(axis=1, keepdims=True)
    data = giving({"output0": grid(1, scores=scores)}, metadata={"names": "['person']"})
    boxes, taken = detect(data, tmp_path)
    assert (taken, [box[:4] for box in boxes]) == ("ultralytics", [box[:4] for box in EXPECTED])


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.parametrize("layout", ["auto", "ultralytics"])
def test_conventions_that_are_not_known_are_refused_with_the_reason(case, layout, tmp_path):
    output, words = REFUSED[case]
    assert words in refused(giving({"output0": output}), tmp_path, layout=layout)


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ({"dets": SOME[None], "labels": logits()}, "boxes are given in pixels, and shares of the input are expected"),
        ({"dets": (SOME / WIDE)[None], "labels": 1 / (1 + np.exp(-logits()))}, "likelihoods from 0 to 1, and logits"),
        ({"output": grid(has_objectness=True, boxes=PLACES / WIDE)}, "boxes are given as shares of the input"),
        ({"output": grid(scores=np.full((420, 80), -2.0), has_objectness=True)}, "no likelihoods from 0 to 1"),
    ],
)
def test_other_layouts_are_refused_for_the_same_reasons(outputs, words, tmp_path):
    assert words in refused(giving(outputs), tmp_path)


def test_boxes_of_rtdetr_in_shares_are_refused_without_naming_what_is_the_same(tmp_path):
    data = giving({"labels": LABELS, "boxes": (CORNERS / WIDE)[None], "scores": SCORES}, inputs=SIZES)
    assert refused(data, tmp_path).endswith("pixels are expected; no other layout fits it")


def test_what_transformers_exports_has_to_be_chosen(tmp_path):
    data = giving({"logits": logits(), "pred_boxes": (SOME / WIDE)[None]})
    assert "its layout may be one of rtdetr, dfine, rfdetr: choose with `layout=`" in refused(data, tmp_path)
    for layout in ("rtdetr", "dfine", "rfdetr"):
        assert detect(data, tmp_path, layout=layout) == (EXPECTED, layout)


@pytest.mark.parametrize(
    ("columns", "names"),
    [(4 + 1 + 51, 1), (4 + 15 + 1, 15), (4 + 2, 3)],  # poses, turned boxes, and other names
)
def test_a_number_of_classes_other_than_that_of_names_is_refused(columns, names, tmp_path):
    output = transposed(np.hstack([PLACES, np.full((len(PLACES), columns - 4), 0.3)])[None])
    data = giving({"output0": output}, metadata={"names": str({k: f"class {k}" for k in range(names)})})
    assert f"with {names} names of classes, as no detector of a known layout does" in refused(data, tmp_path)


def test_small_boxes_of_a_graph_that_gives_pixels_are_not_decoded_again(tmp_path):
    rows = grid(has_objectness=True)
    rows[..., 4:] = 0
    rows[0, 0, 4:6] = 1.0
    assert detect(giving({"output": rows}), tmp_path, layout="yolox")[0] == [(0, 0, 8, 8, 1)]


@pytest.mark.parametrize("labels", [[[0, 200]], [[0, -1]]])
def test_boxes_of_classes_without_a_name_are_counted(labels, tmp_path):
    data = giving({"labels": np.array(labels), "boxes": CORNERS[None], "scores": SCORES}, inputs=SIZES)
    with notices.collected() as said:
        assert detect(data, tmp_path, classes="person")[0] == EXPECTED[:1]
    assert [notice.code for notice in said] == ["classes"]
    assert f"1 boxes are of classes ({labels[0][1]}) without a name among the 80 of COCO" in said[0].message


def test_two_classes_of_one_name_are_both_detected(tmp_path):
    data = giving({"output0": transposed(grid(2))}, metadata={"names": "['person', 'person']"})
    assert detect(data, tmp_path, classes="Person,")[0] == [(*box[:4], 1) for box in EXPECTED]


def test_classes_that_name_nothing_are_refused_and_all_may_be_written_large(tmp_path):
    data = giving({"output0": suppressed()})
    assert "`classes=` names none" in refused(data, tmp_path, classes=" , ")
    assert detect(data, tmp_path, classes=" ALL ")[0] == EXPECTED


@pytest.mark.parametrize("shape", [(1, 128, 160, 3), ("n", "h", "w", 3)])
def test_channels_last_are_refused(shape, tmp_path):
    data = giving({"output0": suppressed()}, shape=shape)
    assert "it needs pictures B x 3 x H x W" in refused(data, tmp_path, input_size="160x128")


@pytest.mark.parametrize(
    ("read", "given"),
    [
        ("ultralytics", {"o": grid(3, scores=np.eye(len(PLACES))[:, [100]] / 2)}),
        ("ultralytics", {"o": suppressed()[:, :1] * [1, 1, 1, 1, 0.5 / 0.9, 1]}),
        ("yolox", {"o": grid(3, scores=np.eye(len(PLACES))[:, [100, 100]] * [0.5, 1])}),
        ("detr", {"labels": LABELS[:, :1], "boxes": CORNERS[None, :1], "scores": np.array([[0.5]])}),
        ("rfdetr", {"dets": (SOME / WIDE)[None, :1], "labels": np.array([[[0.0, -9.0]]])}),
    ],
)
def test_a_score_at_the_bound_is_enough_and_one_below_it_is_not(read, given):
    reader = getattr(layouts, f"read_{read}")
    for least, count in ((0.5, 1), (0.5 + 1e-6, 0)):
        (found,) = reader(given, SIZE, least)
        assert (len(found.xyxy), found.score.tolist()) == (count, [0.5] * count)
        if count:
            np.testing.assert_allclose(found.xyxy[0], CORNERS[0])


def test_a_score_of_nanodet_at_the_bound_is_enough():
    rows = np.zeros((1, len(PLACES), 2 + 32))
    rows[0, 3, 1] = 0.5
    assert [len(layouts.read_nanodet({"o": rows}, SIZE, least)[0].xyxy) for least in (0.5, 0.500001)] == [1, 0]


@pytest.mark.parametrize(("value", "fits"), [(-0.0009, True), (1.0009, True), (-0.001, False), (1.001, False)])
def test_likelihoods_may_be_rounded(value: float, fits: bool):
    if fits:
        assert layouts.likelihoods(np.array([0.5, value])).tolist() == [0.5, value]
        (found,) = layouts.read_detr(
            {"labels": LABELS, "boxes": CORNERS[None], "scores": np.array([[value, 0.9]])}, SIZE, -1
        )
        assert found.score[0] == float(value > 0)
        return
    with pytest.raises(layouts.MisreadError, match="no likelihoods"):
        layouts.likelihoods(np.array([0.5, value]))


@pytest.mark.parametrize(
    ("boxes", "labels", "words"),
    [
        ([[0, 0, 2, 2]], [1], "shares of the input"),
        ([[0, 0, 2, 2.001]], [1], ""),
        ([[9, 9, 5, 20], [9, 9, 20, 20]], [1, 1], ""),  # one of two may be odd
        ([[9, 9, 5, 20], [9, 9, 20, 5], [9, 9, 20, 20]], [1, 1, 1], "end before they begin"),
        ([[9, 9, 9, 9]], [1], ""),  # without a size
        ([[9, 9, 20, 20], [9, 9, 20, 20]], [1, 1.5], "not whole numbers"),
    ],
)
@pytest.mark.parametrize("score", [0.4, 0.39])
def test_only_sure_boxes_are_evidence(boxes, labels, words, score):
    given = {
        "labels": np.array([labels], float),
        "boxes": np.array([boxes], float),
        "scores": np.full((1, len(boxes)), score),
    }
    if words and score == 0.4:
        with pytest.raises(layouts.MisreadError, match=words):
            layouts.read_detr(given, SIZE, 0.1)
    else:
        assert len(layouts.read_detr(given, SIZE, 0.1)[0].xyxy) == len(boxes)
