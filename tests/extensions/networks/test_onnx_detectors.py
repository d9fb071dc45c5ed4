"""Learned detectors: tiny networks of each layout find blue blocks, and files that are no detectors are refused."""

from __future__ import annotations

import hashlib
import sys
import weakref
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mcaptrack
from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks.detector import COCO, OnnxDetector, names_of, numbers_of, wanted
from mcaptrack.extensions.networks.layouts import LAYOUTS
from mcaptrack.extensions.networks.pictures import DetectorNetwork
from mcaptrack.schema import Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.testing import check_transform
from mcaptrack.transforms import STAGES
from tests.commands import call, done
from tests.extensions.networks import onnx_graphs
from tests.extensions.networks.onnx_graphs import (
    INPUTS,
    INT64,
    REACH,
    blue_blocks,
    detector,
    giving,
    model,
    node,
    tensor,
    value,
)
from tests.tiers import thorough

SIZE = (160, 128)
#: A picture as large as the input, with a block on a cell of the grid; and the box of the block.
BLOCK = (64, 32, 32, 32)
PICTURE = blue_blocks(SIZE, BLOCK)


pytestmark = pytest.mark.usefixtures("networks_here")


@pytest.fixture
def network(tmp_path):
    def write(layout="yolox", data=None, name="network.onnx", **options) -> Path:
        path = tmp_path / name
        path.write_bytes(detector(layout, **options) if data is None else data)
        return path

    return write


def boxes(found_by: OnnxDetector, *images: np.ndarray) -> list[list[tuple[float, ...]]]:
    """What is found in pictures: left, top, width, height."""
    frames = [Frame(10**8 * number, number, image) for number, image in enumerate(images)]
    rows = [frame.rows for (frame,) in found_by(frames)]
    return [[tuple(float(row[name]) for name in ("x_px", "y_px", "w_px", "h_px")) for row in some] for some in rows]


def facts(found_by: OnnxDetector) -> dict[str, str]:
    return dict(found_by.model_card().facts)


def refused(found_by: OnnxDetector, *images: np.ndarray) -> str:
    with pytest.raises(McaptrackError) as error:
        boxes(found_by, *(images or (PICTURE,)))
    assert "\n" not in str(error.value)
    return str(error.value)


class TestLayouts:
    @pytest.mark.parametrize("layout", INPUTS)
    @pytest.mark.parametrize("is_named", [True, False])
    def test_boxes_are_those_known_by_hand_whether_the_layout_is_named_or_told(self, network, layout, is_named):
        size = (512, 384) if layout == "nanodet" else SIZE
        found_by = OnnxDetector(file=str(network(layout, size=size)), layout=layout if is_named else "auto")
        x, y, w, h = (224, 160, 32, 32) if layout == "nanodet" else BLOCK
        if layout == "nanodet":  # distances from the centre of the cell
            left, top, right, bottom = (32 * reach for reach in REACH)
            expected = (x + 16 - left, y + 16 - top, left + right, top + bottom)
        else:
            expected = (x, y, w, h)
        assert boxes(found_by, blue_blocks(size, (x, y, w, h))) == [[pytest.approx(expected, abs=1e-3)]]
        assert facts(found_by) == {"layout": layout, "input_size": f"{size[0]}x{size[1]}"}

    @pytest.mark.parametrize(
        ("layout", "picture", "block"),
        [  # a third of the picture, 64 x 128, at the top left: the block is a cell of the second column and row
            ("yolox", (192, 384), (96, 96, 96, 96)),
            ("yolox-legacy", (192, 384), (96, 96, 96, 96)),
            # a third of it in the centre, 48 pixels from the left: a cell of the third column
            ("ultralytics", (192, 384), (48, 96, 96, 96)),
            # stretched: half its width and a third of its height
            ("rtdetr", (320, 384), (128, 96, 64, 96)),
            ("rfdetr", (320, 384), (128, 96, 64, 96)),
        ],
    )
    def test_a_larger_picture_of_other_proportions_gives_boxes_in_its_own_pixels(self, network, layout, picture, block):
        found_by = OnnxDetector(file=str(network(layout)), layout=layout)
        assert boxes(found_by, blue_blocks(picture, block)) == [[pytest.approx(block, abs=1e-3)]]

    def test_nanodet_has_pictures_in_the_centre(self, network):
        found_by = OnnxDetector(file=str(network("nanodet", size=(512, 384))))
        left, top, right, bottom = (96 * reach for reach in REACH)
        expected = (288 + 48 - left, 480 + 48 - top, left + right, top + bottom)
        picture = blue_blocks((768, 1152), (288, 480, 96, 96))  # a third of it, 128 pixels from the left
        assert boxes(found_by, picture) == [[pytest.approx(expected, abs=1e-3)]]

    def test_scores_are_likelihoods_of_the_best_class(self, network):
        ((frame,),) = OnnxDetector(file=str(network("rfdetr", classes=91)), classes="all")([Frame(0, 0, PICTURE)])
        assert frame.rows["score"] == pytest.approx(1 / (1 + np.exp(-onnx_graphs.LOGIT)), abs=1e-6)
        ((frame,),) = OnnxDetector(file=str(network("yolox")))([Frame(0, 0, PICTURE)])
        assert frame.rows["score"] == pytest.approx(onnx_graphs.SCORE, abs=1e-4)
        assert frame.rows["class_id"].tolist() == [1]

    def test_an_end_to_end_export_of_six_columns_is_read(self, network):
        rows = [[64, 32, 96, 64, 0.9, 0], [64, 32, 97, 64, 0.8, 0], [0, 0, 9, 9, 0.05, 0], [5, 5, 9, 9, 0.7, 2]]
        found_by = OnnxDetector(file=str(network(data=giving({"output0": np.array([rows])}))), classes="all")
        assert boxes(found_by, PICTURE) == [[(5, 5, 4, 4), (64, 32, 32, 32)]]
        assert boxes(replace(found_by, max_iou=1.0), PICTURE) == [[(5, 5, 4, 4), (64, 32, 33, 32), (64, 32, 32, 32)]]

    @pytest.mark.parametrize("layout", ["rtdetr", "dfine", "rfdetr"])
    def test_networks_that_find_each_object_once_keep_boxes_that_overlap(self, network, layout):
        """Two people, one behind the other, in shares of the picture by their centres or in its pixels."""
        places, extents = [[0.5, 0.5, 0.25, 0.5], [0.5, 0.5, 0.25, 0.45]], [[60, 32, 100, 96], [60, 35.2, 100, 92.8]]
        if layout == "rfdetr":
            data = giving({"dets": [places], "labels": [[[2.0, -9.0]] * 2]})
        else:
            sizes = [value("orig_target_sizes", [1, 2], INT64)]
            data = giving({"boxes": [extents], "scores": [[0.9, 0.8]], "labels": [[0, 0]]}, inputs=sizes)
        found_by = OnnxDetector(file=str(network(data=data)), layout=layout, classes="all")
        wanted = [(x1, y1, x2 - x1, y2 - y1) for x1, y1, x2, y2 in extents]
        assert sorted(boxes(found_by, PICTURE)[0]) == [pytest.approx(one, abs=1e-3) for one in wanted]

    @pytest.mark.parametrize("layout", [*INPUTS, "dfine"])
    def test_pixels_become_what_the_authors_of_a_layout_trained_with(self, layout):
        order, divide, mean, deviation = INPUTS["rtdetr" if layout == "dfine" else layout]
        image = np.random.default_rng(1).integers(0, 256, (6, 8, 3)).astype(np.uint8)
        channels = image if order == "bgr" else image[..., ::-1]
        wanted = (channels / divide - np.array(mean)) / np.array(deviation)
        np.testing.assert_allclose(LAYOUTS[layout].blob(image), wanted.transpose(2, 0, 1), rtol=1e-5, atol=1e-5)

    def test_classes_and_distances_in_outputs_of_their_own_are_put_together(self, network):
        picture = blue_blocks((512, 384), (224, 160, 32, 32))
        whole, split = (network("nanodet", size=(512, 384), is_split=one, name=f"{one}.onnx") for one in (False, True))
        found = boxes(OnnxDetector(file=str(split)), picture)
        assert len(found[0]) == 1
        assert found == boxes(OnnxDetector(file=str(whole)), picture)


class TestConvention:
    def test_what_tells_two_layouts_apart_may_come_late(self, network):
        grey = blue_blocks(SIZE)
        for layout in ("yolox", "yolox-legacy"):
            found_by = OnnxDetector(file=str(network(layout)))
            assert [len(some) for some in boxes(found_by, grey, grey, PICTURE, grey)] == [0, 0, 1, 0]
            assert facts(found_by)["layout"] == layout

    def test_pictures_are_not_kept_until_the_layout_is_told(self, network, monkeypatch):
        monkeypatch.setattr("mcaptrack.extensions.networks.detector.workers", lambda: 2)
        seen, most = [], []

        def frames():
            for number in range(40):
                image = blue_blocks(SIZE)
                seen.append(weakref.ref(image))
                yield Frame(number, number, image)
                del image
                most.append(sum(one() is not None for one in seen))

        assert len(list(OnnxDetector(file=str(network()))(frames()))) == 40
        assert max(most) < 12

    @pytest.mark.parametrize(("file", "layout"), [("yolox", "yolox-legacy"), ("yolox-legacy", "yolox")])
    def test_a_wrong_layout_that_finds_nothing_is_refused_with_the_one_that_does(self, network, file, layout):
        path = network(file)
        words = refused(OnnxDetector(file=str(path), layout=layout), blue_blocks(SIZE), PICTURE, PICTURE)
        assert words.startswith(
            f"{path}, read as {layout}, finds nothing in 3 pictures, and read as {file} finds 1 boxes"
        )
        assert words.endswith(f"choose `layout={file!r}`")

    def test_a_layout_that_does_not_fit_is_refused_with_those_that_do(self, network):
        words = refused(OnnxDetector(file=str(network()), layout="rtdetr"))
        assert "gives output 1 x 420 x 85" in words
        assert words.endswith("that fits yolox, yolox-legacy")


PICTURES = [1, 3, 128, 160]
ROWS = (1, 420, 85)


def constant(shape: tuple[int, ...] = ROWS, number: float = 0.0, inputs: Sequence[bytes] = ()) -> bytes:
    """A network that gives the same number everywhere; ``inputs`` are others than pictures alone."""
    values = {"rows": tensor(np.full(shape, number), "rows")}
    given = inputs or [value("x", PICTURES)]
    return model([node("Identity", ["rows"], ["output"])], given, [value("output", None)], values)


OTHERS = {
    "a classifier": (constant((1, 1000)), "as no detector of a known layout does"),
    "no picture": (constant(inputs=[value("x", [1, 8, 2])]), "is no detector of pictures: it takes x 1 x 8 x 2"),
    "four channels": (constant(inputs=[value("x", [1, 4, 128, 160])]), "it needs pictures B x 3 x H x W"),
    "bytes": (constant(inputs=[value("x", PICTURES, 2)]), "it needs pictures B x 3 x H x W of floats"),
    "another input": (constant(inputs=[value("x", PICTURES), value("scale", [1, 2])]), "an input scale is not known"),
    "four pictures": (constant((4, 420, 85), inputs=[value("x", [4, 3, 128, 160])]), "takes 4 pictures at a time"),
    "not a number": (constant(number=float("nan")), "not finite at 0 ns (frame 0)"),
    "infinite": (constant(number=float("inf")), "not finite at 0 ns (frame 0)"),
    "text": (b"no network at all", "is no ONNX file, or is damaged or incomplete"),
    "nothing": (b"", "is no ONNX file"),
    "an unknown node": (
        model([node("Dream", ["x"], ["output"])], [value("x", [1, 3, 128, 160])], [value("output", None)]),
        "can't be run by ONNX Runtime",
    ),
}


class TestRefused:
    @pytest.mark.parametrize("what", OTHERS)
    def test_what_is_no_detector_is_refused_in_one_line(self, network, what):
        data, words = OTHERS[what]
        path = network(data=data)
        line = refused(OnnxDetector(file=str(path)))
        assert line.startswith(str(path))
        assert words in line

    def test_a_file_that_ends_early_is_refused_wherever_it_ends(self, network):
        whole = detector("yolox")
        for share in (0.1, 0.5, 0.9, 0.999):
            path = network(data=whole[: int(share * len(whole))])
            assert str(path) in refused(OnnxDetector(file=str(path)))

    def test_no_file_and_no_runtime_say_what_to_do(self, network, tmp_path, monkeypatch):
        assert refused(OnnxDetector()) == "detector onnx needs a file, as in onnx:FILE"
        assert "does not exist" in refused(OnnxDetector(file=str(tmp_path / "none.onnx")))
        assert refused(OnnxDetector(file=str(tmp_path))).endswith(f"{tmp_path} is a folder; give the name of a file")
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        assert "pip install 'mcaptrack[onnx]'" in refused(OnnxDetector(file=str(network())))

    def test_limits_of_memory_hold_for_files_and_for_inputs(self, network):
        path = network(data=detector("yolox") + bytes(10_000_001))
        assert "holds 11 MB; a network may take 10 MB" in refused(OnnxDetector(file=str(path), max_memory_mb=10))
        found_by = OnnxDetector(file=str(network(is_open=True)), input_size="89984x89984")
        assert "an input of 89984x89984 alone takes 97,165 MB" in refused(found_by)

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"tiles": "3"}, "tiles takes columns x rows"),
            ({"tiles": "9x9"}, "64 at most"),
            ({"tiles": "0x1"}, "tiles takes columns x rows"),
            ({"input_size": "large"}, "input_size takes width x height"),
            ({"input_size": "-3x4"}, "input_size takes width x height"),
        ],
    )
    def test_sizes_and_tiles_are_two_numbers(self, options, words):
        with pytest.raises(McaptrackError, match=words):
            OnnxDetector(**options)

    def test_a_gpu_that_is_not_there_is_refused_or_said(self, network, monkeypatch):
        found_by = OnnxDetector(file=str(network()), device="cuda")
        assert "ONNX Runtime has no CUDA here, only" in refused(found_by)
        import onnxruntime

        monkeypatch.setattr(
            onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
        )
        own = onnxruntime.InferenceSession
        without = SimpleNamespace(
            InferenceSession=lambda data, options, providers: own(data, options, providers=providers[1:])
        )
        monkeypatch.setattr(onnxruntime, "InferenceSession", without.InferenceSession)
        assert "can't be run on CUDA here" in refused(found_by)
        with notices.collected() as said:
            assert len(boxes(replace(found_by, device="auto"), PICTURE)[0]) == 1
        assert [notice.code for notice in said] == ["device"]


class TestSizes:
    def test_a_network_of_a_fixed_size_runs_at_others_as_one_of_any_size_does(self, network):
        picture = blue_blocks((320, 192), (256, 128, 32, 32), (32, 32, 32, 32))
        for layout in ("yolox", "nanodet"):
            fixed = OnnxDetector(file=str(network(layout)), layout=layout, input_size="320x192")
            free = OnnxDetector(file=str(network(layout, is_open=True)), layout=layout, input_size="320x192")
            assert boxes(fixed, picture) == boxes(free, picture)
            assert len(boxes(free, picture)[0]) == 2
            assert facts(fixed)["input_size"] == "320x192"

    def test_a_network_that_can_not_take_another_size_is_refused(self, network):
        path = network("ultralytics")
        words = refused(OnnxDetector(file=str(path), input_size="320x192"))
        assert words == (
            f"{path} is made for pictures of 160x128 and can't take 320x192; leave `input_size=` out, or export it again "
            "for that size"
        )
        assert "multiples of 32, as in 320x192" in refused(OnnxDetector(file=str(network()), input_size="310x190"))
        assert "choose one with `input_size='WxH'`" in refused(OnnxDetector(file=str(network(is_open=True))))

    @pytest.mark.parametrize(
        ("picture", "expected"),
        [
            ((480, 360), "960x736"), ((1280, 720), "1280x736"), ((1920, 1080), "1344x768"), ((100, 50), "224x128"),
            ((960, 800), "960x800"),
        ],
    )  # fmt: skip
    def test_the_size_of_the_picture_is_rounded_up_and_kept_within_limits(self, picture, expected):
        from mcaptrack.extensions.networks.detector import size_for

        assert "x".join(map(str, size_for(*picture))) == expected


class TestClasses:
    def test_names_are_those_of_the_file_or_of_coco(self):
        assert names_of({0: "hat"}, 80) == {0: "hat"}
        assert names_of({}, 80)[2] == "car"
        of_91 = names_of({}, 91)
        assert [of_91[at] for at in (1, 3, 13, 90)] == ["person", "car", "stop sign", "toothbrush"]
        assert len(of_91) == 80
        assert names_of({}, 1) == {0: "person"}
        assert names_of({}, 3) == {0: "0", 1: "1", 2: "2"}

    def test_a_person_is_1_and_every_class_has_a_number_of_its_own(self):
        for names in (
            names_of({}, 80),
            names_of({}, 91),
            {0: "car", 1: "Pedestrian", 2: "dog"},
            {0: "a", 5: "person"},
            {3: "x"},
        ):
            numbers = numbers_of(names)
            assert len(set(numbers.values())) == len(names)
            assert 0 not in numbers.values()
            people = [number for index, number in numbers.items() if names[index].lower() in ("person", "pedestrian")]
            assert set(people) <= {1}
        assert numbers_of(names_of({}, 80)) == {index: index + 1 for index in range(80)}
        assert numbers_of(names_of({}, 91))[2] == 2

    def test_classes_are_chosen_by_name_or_index(self):
        names = dict(enumerate(COCO))
        assert wanted(names, "bicycle, person,7", "x") == [0, 1, 7]
        assert wanted(names, "all", "x") == list(range(80))
        assert wanted({0: "car", 1: "pedestrian"}, "person", "x") == [1]
        with pytest.raises(
            McaptrackError, match=r"^x has no class 'persn'; did you mean person\? `classes=` takes person, bicycle"
        ):
            wanted(names, "persn", "x")

    def test_names_in_the_metadata_of_the_file_reach_rows_and_the_channel(self, network, log, tmp_path):
        path = network("ultralytics", classes=2, metadata={"names": "{0: 'hat', 1: 'person'}", "stride": "32"})
        done("detect", log, "--detector", f"onnx:{path}", "--classes", "hat", "--to", "/camera/hats", "--quiet")
        with mcaptrack.open(log) as opened:
            assert set(opened.array("detections", "/camera/hats")["class_id"].tolist()) == {2}
        assert Provenance.from_metadata(metadata_of(log, "/camera/hats")).classes == {"2": "hat"}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A log of six pictures with a blue block that moves."""
    import cv2

    folder = tmp_path_factory.mktemp("recorded")
    (folder / "pictures").mkdir()
    for number in range(6):
        cv2.imwrite(str(folder / "pictures" / f"{number}.png"), blue_blocks(SIZE, (32 * (number % 3), 32, 32, 32)))
    mcaptrack.ingest(folder / "pictures", output=folder / "log.mcap", fps=10)
    return folder / "log.mcap"


@pytest.fixture
def log(recorded, tmp_path) -> Path:
    path = tmp_path / "log.mcap"
    path.write_bytes(recorded.read_bytes())
    return path


def metadata_of(path: Path, topic: str) -> dict[str, str]:
    from mcaptrack import log as logs

    with logs.read(path) as opened:
        return dict(opened.channel(topic).metadata)


class TestInLogs:
    def test_the_channel_says_which_network_made_it_and_how(self, network, log):
        path = network()
        done("detect", log, "--detector", f"onnx:{path}", "--set", "layout=yolox", "--min-score", "0.3", "--quiet")
        made = Provenance.from_metadata(metadata_of(log, "/camera/detections"))
        assert made.parameters["detector"] == "onnx"
        assert made.parameters["file"] == str(path)
        assert made.weights_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert made.model == {"layout": "yolox", "input_size": "160x128"}
        assert made.classes == {"1": "person"}
        with mcaptrack.open(log) as opened:
            assert opened.array("detections")["x_px"] == pytest.approx([0, 32, 64] * 2, abs=0.5)

    def test_run_takes_it_and_makes_again_what_it_made_with_the_same_weights_only(self, network, log):
        path = network()
        done("run", log, "--detector", f"onnx:{path}", "--no-tables", "--quiet")
        assert call("run", log, "--no-tables").err.count("nothing to do") == 1
        path.write_bytes(detector("yolox", metadata={"made": "again"}))
        outcome = call("run", log, "--force", "--no-tables")
        assert outcome.code == 0
        assert f"onnx:{path} holds other weights than those it was made with" in outcome.err
        done("run", log, "--detector", f"onnx:{path}", "--force", "--no-tables", "--quiet")
        assert "other weights" not in call("run", log, "--force", "--no-tables").err

    @thorough
    def test_another_file_is_another_detector(self, network, log):
        first, second = network(name="a.onnx"), network("ultralytics", name="b.onnx")
        done("run", log, "--detector", f"onnx:{first}", "--no-tables", "--quiet")
        outcome = call("run", log, "--detector", f"onnx:{second}", "--no-tables")
        assert "/camera/detections was made by another detector: running detect again" in outcome.err

    def test_a_file_that_is_not_there_is_refused_before_a_plan_is_said(self, log, tmp_path):
        err = call("run", log, "--detector", f"onnx:{tmp_path / 'none.onnx'}").err
        assert err.startswith(f"mcaptrack: detector onnx: {tmp_path / 'none.onnx'} does not exist")
        assert err.count("\n") == 1
        assert call("run", log, "--detector", "onnx").err == "mcaptrack: detector onnx needs a file, as in onnx:FILE\n"

    def test_names_and_files_that_do_not_go_together_are_refused(self, log):
        assert "detector knn takes no file" in call("detect", log, "--detector", "knn:file").err
        assert "are two files; give one" in call("detect", log, "--detector", "onnx:a", "--file", "b").err
        err = call("detect", log, "--set", "layout=yolox").err
        assert (
            err == "mcaptrack: --set layout is an option of onnx, yolox-nano, yolox-s and yolox-tiny, not of median\n"
        )


def test_the_laws_of_transforms_hold(network):
    check_transform(OnnxDetector(file=str(network(size=(64, 64))), classes="all"))


def test_pictures_beside_one_another_come_in_order_and_give_the_same(network, monkeypatch):
    pictures = [blue_blocks(SIZE, (32 * (number % 5), 32, 32, 32)) for number in range(12)]
    found_by = OnnxDetector(file=str(network()))
    alone = boxes(found_by, *pictures)
    monkeypatch.setattr("mcaptrack.extensions.networks.detector.workers", lambda: 5)
    assert (
        boxes(found_by, *pictures)
        == alone
        == [[pytest.approx((32 * (n % 5), 32, 32, 32), abs=1e-3)] for n in range(12)]
    )


def test_several_pictures_at_a_time_give_what_one_at_a_time_gives(network, monkeypatch):
    path = network("ultralytics", name="open.onnx", data=batched())
    pictures = [blue_blocks(SIZE, (32 * (number % 5), 32, 32, 32)) for number in range(7)]
    alone = boxes(OnnxDetector(file=str(path)), *pictures)
    made = DetectorNetwork.__init__

    def init(self, *words):
        made(self, *words)
        self.batch = 3

    monkeypatch.setattr(DetectorNetwork, "__init__", init)
    assert boxes(OnnxDetector(file=str(path)), *pictures) == alone
    assert boxes(OnnxDetector(file=str(path), tiles="2x1"), *pictures) != alone


def batched() -> bytes:
    """A YOLOX that takes any number of pictures."""
    nodes, constants = onnx_graphs.heads("yolox", [0.5, 0.5, 0, 0, "score", 1, *[0.1] * 79], (8, 16, 32), [None] * 3)
    constants |= {f"s{stride}": tensor([0, 85, -1], f"s{stride}", INT64) for stride in (8, 16, 32)}
    nodes.append(node("Transpose", ["all"], ["output"], perm=[0, 2, 1]))
    return model(nodes, [value("x", ["n", 3, 128, 160])], [value("output", None)], constants)


#: For each option a value, and what a picture with two blocks that overlap gives without and with it: scores by box.
EFFECTS = {"min_score": 0.95, "classes": "car", "input_size": "320x256", "tiles": "2x2", "overlap": 0.5}


@pytest.mark.parametrize("option", EFFECTS)
def test_every_option_changes_what_is_found(network, option):
    small = blue_blocks((320, 256), (64, 64, 32, 32), (200, 120, 16, 16))  # half a cell, a quarter of one
    found_by = OnnxDetector(file=str(network()), layout="yolox", **({"tiles": "2x2"} if option == "overlap" else {}))
    assert boxes(found_by, small) != boxes(replace(found_by, **{option: EFFECTS[option]}), small)


def test_every_option_is_tested_here():
    elsewhere = {"file", "layout", "max_iou", "device", "max_memory_mb"}
    assert set(EFFECTS) | elsewhere == {option.name for option in fields(OnnxDetector)}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"min_score": 0.25}, "the network finds no person with a score of at least 0.25"),
        ({"classes": "ALL"}, "the network finds nothing with a score of at least 0.1"),
    ],
)
def test_why_nothing_came_of_it(options, reason):
    assert OnnxDetector(**options).why_empty([], []) == reason


def test_on_the_ground_the_tracker_that_suits_it_compares_metres():
    suited = OnnxDetector.suits["tracker"]
    assert STAGES["track"].make(suited.name, **suited.on_ground).cost == "metres"
