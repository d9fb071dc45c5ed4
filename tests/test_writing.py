"""Own rows in a log: arrays, tables and supervision.Detections become channels that stages go on from."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.provenance import Provenance

SECOND = 10**9


@dataclass
class Detections:
    """What supervision.Detections has, as far as it is read."""

    xyxy: np.ndarray
    mask: np.ndarray | None = None
    confidence: np.ndarray | None = None
    class_id: np.ndarray | None = None
    tracker_id: np.ndarray | None = None
    data: dict[str, object] = field(default_factory=dict)

    def __iter__(self) -> Iterator[tuple]:
        """Yield what the real one does: box, mask, confidence, class, tracker id and data of each."""
        columns = (self.mask, self.confidence, self.class_id, self.tracker_id)
        for n, box in enumerate(self.xyxy):
            rest = [None if column is None else column[n] for column in columns]
            yield box, *rest, {name: values[n] for name, values in self.data.items()}

    def __len__(self) -> int:
        return len(self.xyxy)

    @classmethod
    def empty(cls) -> Detections:
        """Return what a model gives for a picture without objects."""
        return cls(np.empty((0, 4), np.float32), confidence=np.empty(0, np.float32), class_id=np.empty(0, int))


@pytest.fixture(params=["stand-in", "real"])
def made(request, monkeypatch) -> type:
    """The class supervision.Detections: a stand-in, and the real one where it is installed."""
    if request.param == "real":
        return pytest.importorskip("supervision", reason="supervision isn't installed").Detections
    module = ModuleType("supervision")
    module.Detections = Detections
    monkeypatch.setitem(sys.modules, "supervision", module)
    return Detections


BOXES = np.array([[10.0, 20, 30, 60], [50, 20, 80, 60]], np.float32)
SCORES = np.array([0.5, 0.75], np.float32)


def walk(frames: int = 30) -> list[mcaptrack.Notice]:
    """Two boxes that move apart, 10 pictures a second."""
    return [
        mcaptrack.detections(
            [[100 + n, 50, 120 + n, 110], [300 - n, 60, 320 - n, 120]],
            [0.9, 0.8],
            [1, 1],
            n * SECOND // 10,
            box_format="xyxy",
        )
        for n in range(frames)
    ]


class TestDetections:
    def test_both_formats_of_boxes_mean_the_same(self):
        corners = mcaptrack.detections([[10, 20, 30, 60]], t_ns=5, box_format="xyxy")
        sizes = mcaptrack.detections(np.array([[10, 20, 20, 40]]), t_ns=5, box_format="xywh")
        assert corners.rows.tobytes() == sizes.rows.tobytes()
        assert [corners.rows[name].item() for name in ("x_px", "y_px", "w_px", "h_px")] == [10, 20, 20, 40]
        assert np.isnan(corners.rows["score"]).all()

    def test_a_picture_without_detections_is_a_frame(self):
        frame = mcaptrack.detections([], t_ns=7, box_format="xywh")
        assert (frame.t_ns, len(frame.rows), frame.rows.dtype) == (7, 0, DETECTIONS.dtype)

    def test_supervision_is_taken_as_it_is(self, made):
        found = made(np.array([[10.0, 20, 30, 60]]), confidence=np.array([0.5]), class_id=np.array([3]))
        (row,) = mcaptrack.detections(found, t_ns=5).rows
        assert (row["w_px"], row["h_px"], row["score"], row["class_id"]) == (20, 40, 0.5, 3)
        assert len(mcaptrack.detections(made.empty()).rows) == 0
        (bare, _) = mcaptrack.detections(made(BOXES)).rows
        assert (np.isnan(bare["score"]), bare["class_id"]) == (True, 0)

    def test_names_of_classes_say_what_is_a_person(self, made):
        """A model of COCO has a person as class 0 and a bicycle as class 1."""
        names = np.array(["person", "bicycle"])
        found = made(BOXES, class_id=np.array([0, 1]), data={"class_name": names})
        with pytest.warns(mcaptrack.McaptrackWarning, match="in class_id 1 is a person, other numbers are 2 higher"):
            assert mcaptrack.detections(found).rows["class_id"].tolist() == [1, 3]
        found = made(BOXES[:1], class_id=np.array([0]), data={"class_name": names[:1]})
        assert mcaptrack.detections(found).rows["class_id"].tolist() == [1]

    def test_masks_are_left_out_and_said(self, made):
        found = made(BOXES, mask=np.zeros((2, 8, 8), bool))
        with pytest.warns(mcaptrack.McaptrackWarning, match="masks of supervision.Detections are left out"):
            assert len(mcaptrack.detections(found).rows) == 2

    def test_boxes_of_another_package_are_refused(self):
        with pytest.raises(McaptrackError, match="SimpleNamespace has no confidence, unlike"):
            mcaptrack.detections(SimpleNamespace(xyxy=BOXES, conf=SCORES))

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"boxes": [[1, 2, 3, 4]]}, "say what the columns of boxes are"),
            ({"boxes": [1, 2, 3, 4], "box_format": "xyxy"}, r"shape \(N, 4\), not \(4,\)"),
            ({"boxes": [[30, 2, 3, 4]], "box_format": "xyxy"}, "box 0 has a negative size"),
            ({"boxes": [[1, 2, np.nan, 4]], "box_format": "xywh", "t_ns": 9}, "rows at 9 ns: .*w_px is required"),
            ({"boxes": [[1, 2, 3, 4]], "scores": [1, 2], "box_format": "xywh"}, "columns of one length"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, given, words):
        with pytest.raises(McaptrackError, match=words):
            mcaptrack.detections(**given)


class TestWriting:
    def test_own_detections_are_tracked_as_any_others(self, tmp_path):
        path = tmp_path / "own.mcap"
        with mcaptrack.open(path, create=True) as opened:
            assert opened.write("/camera/detections", walk()) == 30
            assert opened.array("detections")["x_px"].shape == (60,)
        result = mcaptrack.track(path)
        assert (result.stages, result.tracks["/camera/tracks"]) == (("track",), 2)
        assert mcaptrack.run(path, tables=False).summary.tracks == 2
        made = {channel.topic: channel.transform for channel in mcaptrack.info(path).channels}
        assert (made["/camera/detections"], made["/camera/tracks"]) == ("ingest", "track")
        assert mcaptrack.check(path).findings == ()

    def test_frames_arrays_and_tables_give_the_same_channel(self, tmp_path):
        payloads = set()
        for form in ("frames", "array", "table"):
            path = tmp_path / f"{form}.mcap"
            with mcaptrack.open(path, create=True) as opened:
                opened.write("/camera/detections", walk())
                rows = {"frames": walk(), "array": opened.array("detections"), "table": opened.table("detections")}[
                    form
                ]
                assert opened.write("/camera/detections", rows, replace=True) == 30
            with log.read(path) as opened:
                assert [frame.index for frame in opened.frames("/camera/detections", DETECTIONS)] == list(range(30))
                payloads.add(Provenance.from_metadata(opened.channel("/camera/detections").metadata).digest)
        assert len(payloads) == 1

    def test_supervision_goes_in_and_comes_out(self, tmp_path, made):
        tracked = made(BOXES, confidence=SCORES, tracker_id=np.array([7, 9]))
        given = {0: tracked, SECOND: made.empty(), 2 * SECOND: tracked}
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for topic in ("tracks", "/camera/mine"):  # the name of the first says what it holds
                assert opened.write(topic, given) == 3
                out = dict(opened.supervision(topic))
                assert list(out) == list(given)
                assert [len(found) for found in out.values()] == [2, 0, 2]
                for t_ns in (0, 2 * SECOND):
                    np.testing.assert_array_equal(out[t_ns].xyxy, BOXES)
                    assert (out[t_ns].tracker_id.tolist(), out[t_ns].confidence.tolist()) == ([7, 9], [0.5, 0.75])
            opened.write("detections", {0: made(BOXES, class_id=np.array([1, 3])), SECOND: made.empty()})
            ((_, first), (_, second)) = opened.supervision("detections")
            assert (first.class_id.tolist(), len(second)) == ([1, 3], 0)
            assert np.isnan(first.confidence).all()
            if hasattr(made, "merge"):
                assert len(made.merge([found for _, found in opened.supervision("tracks")])) == 4

    def test_tracks_that_are_not_confirmed_yet_are_left_out_and_said(self, tmp_path, made):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            with pytest.warns(mcaptrack.McaptrackWarning, match="boxes without a tracker id"):
                opened.write("tracks", {0: made(BOXES, tracker_id=np.array([-1, 4]))})
            assert opened.array("tracks")["track_id"].tolist() == [4]

    def test_supervision_without_a_time_or_an_id_is_refused_in_a_line(self, tmp_path, made):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for rows, words in (
                (made(BOXES), "have no time; give them by time"),
                ([made(BOXES)], "each frame is a Frame, or a time in nanoseconds with"),
                ({5: made(BOXES)}, "the detections at 5 ns have no tracker ids"),
            ):
                with pytest.raises(McaptrackError, match=words) as refused:
                    opened.write("tracks", rows)
                assert "\n" not in str(refused.value)

    def test_what_is_there_stays_unless_it_is_to_be_replaced(self, tmp_path):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            opened.write("/camera/detections", walk())
            before = path.read_bytes()
            with pytest.raises(McaptrackError, match="has /camera/detections already; `replace=True` replaces it"):
                opened.write("/camera/detections", walk(3))
            assert path.read_bytes() == before
            opened.write("/camera/detections", walk(3), replace=True)
            assert len(opened.array("detections")) == 6
        with pytest.raises(McaptrackError, match="exists"):
            mcaptrack.open(path, create=True)

    @pytest.mark.parametrize(
        ("topic", "rows", "words"),
        [
            ("/camera/detections", [1, 2], "each frame is a Frame"),
            ("/camera/detections", np.zeros((3, 4)), "an array without named columns"),
            ("/camera/detections", np.zeros(2, [("x_px", float)]), "no column t_ns"),
            ("/camera/detections", np.zeros(2, [("t_ns", int), ("left", float)]), "has no column left; it has"),
            ("/camera/detections", 5, "not int"),
            ("/camera/", [], "is no topic"),
            ("/camera/other", [], "whether these are detections or tracks"),
        ],
    )
    def test_rows_that_do_not_fit_change_nothing(self, tmp_path, topic, rows, words):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            before = path.read_bytes()
            with pytest.raises(McaptrackError, match=words):
                opened.write(topic, rows)
        assert path.read_bytes() == before
