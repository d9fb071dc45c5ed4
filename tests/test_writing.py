"""Rows of a user (arrays, tables, supervision.Detections) become channels that stages take as input."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, Frame
from tests.worlds import write_clip

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


def walk(frames: int = 30) -> list[Frame]:
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


def table(**columns: object) -> np.ndarray:
    """Two boxes, at 0 and at 5 ns, with other columns, or other values."""
    usual = {"t_ns": [0, 5], "x_px": [1.0, 2.0], "y_px": [1.0, 2.0], "w_px": [4.0, 4.0], "h_px": [8.0, 8.0]}
    arrays = {name: np.array(values) for name, values in (usual | columns).items()}
    out = np.empty(2, [(name, values.dtype) for name, values in arrays.items()])
    for name, values in arrays.items():
        out[name] = values
    return out


class TestDetections:
    def test_both_formats_of_boxes_mean_the_same(self):
        corners = mcaptrack.detections([[10, 20, 30, 60]], t_ns=5, box_format="xyxy")
        sizes = mcaptrack.detections(np.array([[10, 20, 20, 40]]), t_ns=5, box_format="xywh")
        assert corners.rows.tobytes() == sizes.rows.tobytes()
        assert [corners.rows[name].item() for name in ("x_px", "y_px", "w_px", "h_px")] == [10, 20, 20, 40]
        assert np.isnan(corners.rows["score"]).all()

    def test_supervision_is_taken_as_it_is(self, made):
        found = made(np.array([[10.0, 20, 30, 60]]), confidence=np.array([0.5]), class_id=np.array([3]))
        (row,) = mcaptrack.detections(found, t_ns=5).rows
        assert (row["w_px"], row["h_px"], row["score"], row["class_id"]) == (20, 40, 0.5, 3)
        assert len(mcaptrack.detections(made.empty()).rows) == 0
        (bare, _) = mcaptrack.detections(made(BOXES)).rows
        assert (np.isnan(bare["score"]), bare["class_id"]) == (True, 0)

    def test_class_names_decide_which_class_is_a_person(self, made):
        """A model of COCO has a person as class 0 and a bicycle as class 1."""
        names = np.array(["person", "bicycle"])
        found = made(BOXES, class_id=np.array([0, 1]), data={"class_name": names})
        with pytest.warns(mcaptrack.McaptrackWarning, match="in class_id 1 is a person, other numbers are 2 higher"):
            assert mcaptrack.detections(found).rows["class_id"].tolist() == [1, 3]
        found = made(BOXES[:1], class_id=np.array([0]), data={"class_name": names[:1]})
        assert mcaptrack.detections(found).rows["class_id"].tolist() == [1]

    def test_masks_are_left_out_with_a_warning(self, made):
        found = made(BOXES, mask=np.zeros((2, 8, 8), bool))
        with pytest.warns(mcaptrack.McaptrackWarning, match="masks of supervision.Detections are left out"):
            assert len(mcaptrack.detections(found).rows) == 2

    def test_boxes_of_another_package_are_refused(self):
        with pytest.raises(McaptrackError, match="SimpleNamespace has no confidence, unlike"):
            mcaptrack.detections(SimpleNamespace(xyxy=BOXES, conf=SCORES))

    def test_what_does_not_fit_is_refused_in_a_line(self):
        box, nan = [[1, 2, 3, 4]], np.nan
        masked = np.ma.masked_equal([[1, 2, 9, 4]], 9)
        for boxes, more, words in (
            (box, {"box_format": None}, "say what the columns of boxes are"),
            ([1, 2, 3, 4], {}, r"shape \(N, 4\), not \(4,\)"),
            ([[30, 2, 3, 4]], {"box_format": "xyxy"}, "box 0 has a negative size"),
            ([[1, 2, nan, 4]], {"t_ns": 9}, "box 0 has numbers that are missing or infinite"),
            ([[1, 2, np.inf, 4]], {}, "box 0 has numbers that are missing or infinite"),
            (masked, {}, "box 0 has numbers that are missing"),
            (box, {"scores": [1, 2]}, r"1 boxes need `scores=` of shape \(1,\), not \(2,\)"),
            ([[1, 2, 3, 4], [1, 2, 3]], {}, r"boxes are numbers of shape \(N, 4\): "),
            (["abcd"], {}, "could not convert string to float"),
            (box, {"scores": ["high"]}, "`scores=` needs numbers"),
            (box, {"classes": ["person"]}, "`classes=` needs whole numbers"),
            (box, {"classes": [1.5]}, "`classes=` needs whole numbers"),
            (box, {"classes": np.ma.masked_equal([9], 9)}, "`classes=` needs whole numbers"),
            (np.ones((1, 4)) * 1j, {}, "boxes are numbers .* there are complex numbers"),
            (box, {"scores": np.ones(1) * 1j}, "there are complex numbers"),
            ([], {"t_ns": 1.5}, r"`t_ns=` needs whole nanoseconds.* not 1.5 \(float\)"),
            ([], {"t_ns": "2026-05-01"}, "`t_ns=` needs whole nanoseconds"),
            ([], {"t_ns": -1}, "from 0 to 9223372036854775807, not -1"),
            ([], {"t_ns": 2**63}, "from 0 to 9223372036854775807"),
            ([], {"index": 2**32}, "`index=` needs the whole number of a picture, from 0 to .*, not 4294967296"),
            ([], {"index": "x"}, "`index=` needs the whole number of a picture"),
        ):
            with pytest.raises(McaptrackError, match=words):
                mcaptrack.detections(boxes, **({"box_format": "xywh"} | more))

    def test_times_of_numpy_and_classes_as_floats_are_taken(self):
        time = np.datetime64(1_700_000_000_000_000_001, "ns")
        frame = mcaptrack.detections(np.ones((1, 4), np.float16), None, np.ones(1, np.float32), time, box_format="xywh")
        assert (frame.t_ns, frame.rows["class_id"].tolist()) == (1_700_000_000_000_000_001, [1])


class TestWriting:
    def test_supervision_detections_round_trip(self, tmp_path, made):
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

    def test_tracks_without_boxes_have_none_in_supervision(self, tmp_path, made):
        rows = np.array([(0, 1, 2.0, 3.0)], [("t_ns", int), ("track_id", int), ("x_m", float), ("y_m", float)])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/own/tracks", rows)
            ((t_ns, found),) = opened.supervision("/own/tracks")
        assert (t_ns, len(found.xyxy)) == (0, 0)

    def test_unconfirmed_tracks_are_left_out_with_a_warning(self, tmp_path, made):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            with pytest.warns(mcaptrack.McaptrackWarning, match="boxes without a tracker id"):
                opened.write("tracks", {0: made(BOXES, tracker_id=np.array([-1, 4]))})
            assert opened.array("tracks")["track_id"].tolist() == [4]

    def test_supervision_without_a_time_or_an_id_is_refused_in_a_line(self, tmp_path, made):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for rows, words in (
                (made(BOXES), "have no time; give them by time"),
                ([made(BOXES)], "or a time in nanoseconds with supervision.Detections, not Detections"),
                ({5: made(BOXES)}, "the detections at 5 ns have no tracker ids"),
            ):
                with pytest.raises(McaptrackError, match=words) as refused:
                    opened.write("tracks", rows)
                assert "\n" not in str(refused.value)

    UNFIT = {
        "/camera/detections": [
            ([1, 2], "each frame is one of `mcaptrack.detections`, .* not 1 .int."),
            ({"t_ns": [0]}, "not a mapping of columns; columns are given as"),
            (np.zeros((3, 4)), r"an array \(3, 4\) of float64 is no table"),
            (np.zeros(2, [("x_px", float)]), "no column t_ns"),
            (np.zeros(2, [("t_ns", int), ("left", float)]), "has no column left; it has"),
            (5, "not 5 .int."),
            ([*walk(2), *walk(1)], "two frames are at 0 ns; each picture has a time of its own"),
            ([walk(1)[0]._replace(t_ns=0.5)], "needs whole nanoseconds"),
            ([walk(1)[0]._replace(rows=None)], "rows of a frame are a structured array"),
            (table(t_ns=[0.0, 0.1]), "the column t_ns needs whole nanoseconds.* not float64"),
            (table(t_ns=[-1, 5]), "from 0 to .*, not -1"),
            (table(frame=[-2, 5]), "the column frame holds numbers of pictures"),
            (table(x_px=[0, np.inf]), "the frame at 5 ns: in row 0 x_px is infinite"),
            (table(w_px=[1, -1]), "the frame at 5 ns: in row 0 w_px is -1; sizes are"),
            (table(h_px=[1, -1]), "the frame at 5 ns: in row 0 h_px is -1; sizes are"),
            (table(topic=["/a", "/b"]), "rows of 2 topics: /a, /b; .* select one topic"),
            (table(recording=["a", "b"]), "rows of 2 recordings"),
            (table()["x_px"], "an array .* is no table"),
            (table().reshape(1, 2), "an array .* is no table"),
        ],
        "/camera/tracks": [
            (table(t_ns=[5, 5], track_id=[1, 1]), "in row 1 track_id 1 stands in 2 rows of one frame"),
            (table(track_id=[1, -1]), "at 5 ns: in row 0 track_id is -1; ids are"),
            (table(track_id=[1, 2], x_m=[1, 2]), "in row 0 there is only a part of x_m, y_m"),
            (table(track_id=[1, 2], w_px=[1, np.nan]), "at 5 ns: in row 0 there is only a part of x_px, y_px, w_px, h_px"),
            (table(track_id=[1, 2], **dict.fromkeys(("y_px", "w_px", "h_px"), [np.nan] * 2)), "in row 0 there is only a part of x_px"),
            (np.array([(0, 1)], [("t_ns", int), ("track_id", int)]), "in row 0 there is neither a box nor a position"),
        ],
        **dict.fromkeys(("/camera/", "/camera//detections", "/camera/\n/detections"), (([], "is no topic"),)),
        5: [([], "a topic is text")],
        "/" + "x" * 2000: [([], "is longer than 1024 bytes")],
        "/camera/video": [(walk(2), "/camera/video is a name of what stages make or of pictures")],
        **dict.fromkeys(
            ("/camera/ground_plane", "/camera/retracks/online", "/camera/tracks/view/image", "/camera/tracks/events"),
            (([], "is a name of what stages make"),),
        ),
        "/camera/other": [([], "whether these are detections or tracks")],
    }  # fmt: skip

    def test_rows_that_do_not_fit_change_nothing(self, tmp_path):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            before = path.read_bytes()
            for topic, cases in self.UNFIT.items():
                for rows, words in cases:
                    with pytest.raises(McaptrackError, match=words):
                        opened.write(topic, rows)
                    assert path.read_bytes() == before

    @pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow", "duckdb"])
    def test_tables_of_any_library_give_the_same_rows(self, tmp_path, library):
        rows = table(t_ns=[7, 5], score=[np.nan, 0.5])
        columns = {name: rows[name] for name in rows.dtype.names}
        module = pytest.importorskip(library)
        if library == "pandas":
            given = module.DataFrame(columns, index=["b", "a"])  # an index that is no column
        elif library == "polars":
            given = module.DataFrame(columns)
        else:
            given = pa.table(columns)
        if library == "duckdb":
            given = module.sql("select t_ns, x_px, y_px, w_px, h_px::decimal(9, 2) as h_px, score from given")
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            assert opened.write("/own/detections", given) == 2
            found = opened.array("detections", "/own/detections")
        assert [tuple(found[name]) for name in ("t_ns", "x_px", "score")][:2] == [(5, 7), (2.0, 1.0)]
        np.testing.assert_array_equal(found["score"], [0.5, np.nan])

    def test_timestamps_are_times_and_frames_of_one_time_are_told_by_their_number(self, tmp_path):
        rows = table(t_ns=np.array([1, 1], "datetime64[us]"), frame=[4, 3])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            assert opened.write("/own/detections", rows) == 2
            found = opened.array("detections", "/own/detections")
        assert [found[name].tolist() for name in ("t_ns", "frame", "x_px")] == [[1000, 1000], [3, 4], [2.0, 1.0]]

    def test_what_is_out_of_date_then_is_said(self, tmp_path):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            opened.write("/camera/detections", walk())
        mcaptrack.track(path)
        with (
            mcaptrack.open(path) as opened,
            pytest.warns(
                mcaptrack.McaptrackWarning, match="/camera/tracks is out of date, because its input was replaced"
            ),
        ):
            opened.write("/camera/detections", walk(20), replace=True)
        assert "/camera/tracks" in [one.topic for one in mcaptrack.info(path).channels if one.stale]

    def test_a_channel_is_only_replaced_by_one_of_its_kind(self, tmp_path):
        path = tmp_path / "a.mcap"
        write_clip(tmp_path / "clip.mp4", frames=10)
        mcaptrack.ingest(tmp_path / "clip.mp4", path)
        with mcaptrack.open(path) as opened:
            opened.write("/own/things", walk())
            before = path.read_bytes()
            with pytest.raises(
                McaptrackError, match=r"which holds mcaptrack.Detections and is not replaced by mcaptra"
            ):
                opened.write("/own/things", table(track_id=[1, 2]), replace=True)
            for topic in opened.topics:
                if topic != "/own/things":
                    with pytest.raises(McaptrackError):
                        opened.write(topic, walk(), replace=True)
        assert path.read_bytes() == before

    def test_rows_get_the_pictures_that_are_shown_then_and_places_on_the_ground(self, tmp_path):
        path, plane = tmp_path / "a.mcap", tmp_path / "plane.txt"
        write_clip(tmp_path / "clip.mp4", frames=10)
        plane.write_text("0.1 0 0\n0 0.1 0\n0 0 1")
        mcaptrack.ingest(tmp_path / "clip.mp4", path, ground_plane=plane, start_time=1)
        with mcaptrack.open(path) as opened:
            t_ns = [picture.t_ns for picture in opened.frames()]
            times = [0, t_ns[0], t_ns[3] - 1, t_ns[3], t_ns[9] + SECOND]
            frames = [mcaptrack.detections([], t_ns=t, box_format="xyxy") for t in times]
            opened.write("/camera/detections", frames)
            with log.read(path) as raw:
                assert [frame.index for frame in raw.frames("/camera/detections", DETECTIONS)] == [0, 0, 2, 3, 9]
            opened.write("tracks", table(track_id=[4, 4], x_m=[np.nan, 7.0], y_m=[np.nan, 8.0], frame=[2, np.nan]))
            rows = opened.array("tracks", "/camera/tracks")
        assert (tmp_path / "a.layout.json").exists()
        # The middle of the lower edge of (1, 1, 4, 8) is (3, 9) px.
        np.testing.assert_allclose([rows["x_m"], rows["y_m"]], [[0.3, 7.0], [0.9, 8.0]])
        assert (rows["observed"].tolist(), rows["source_id"].tolist()) == ([True, True], [-1, -1])
        assert rows["frame"].tolist() == [2, 0]

    def test_scores_beyond_one_are_said(self, tmp_path):
        with (
            mcaptrack.open(tmp_path / "a.mcap", create=True) as opened,
            pytest.warns(mcaptrack.McaptrackWarning, match="scores are from 2 to 95; likelihoods"),
        ):
            opened.write("/own/detections", table(score=[2.0, 95.0]))
