"""What a transform or a predictor of another package does wrong is said in one line that names it, and nothing is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.predictors import CheckedPredictor, entry_of
from mcaptrack.registry import Entry
from mcaptrack.schema import BOX_PX, DETECTIONS, PLACE_M, TRACKS, Frame
from mcaptrack.transforms.guarded import guarded

ROWS = TRACKS.rows(
    track_id=[4, 2], x_px=[1, 2], y_px=[1, 2], w_px=[3, 3], h_px=[5, 5], x_m=[0, 1], y_m=[0, 1], score=[0, 1],
    observed=[True, False], source_id=[-1, -1],
)  # fmt: skip
GIVEN = [Frame(10 * number, number, DETECTIONS.empty()) for number in range(4)]
#: Makes the frames of a result from a frame that was given.
Answer = Callable[[Frame], Iterable[Any]]


def answers(answer: Answer, kind: str = "tracker", given: Iterable[Frame] = GIVEN) -> list[tuple[Frame, ...]]:
    """What the guard lets through of a transform that gives these answers."""

    @dataclass(frozen=True)
    class Made:
        reads: ClassVar = DETECTIONS
        writes: ClassVar = {"": TRACKS}
        latency_s: ClassVar = {"": 0.0}

        def __call__(self, frames: Iterable[Frame]) -> Iterator[Any]:
            for frame in frames:
                yield from answer(frame)

    return list(guarded(Entry("mine", kind, Made, __name__, "pack", "1"), Made(), given))


def one(**changes: Any) -> Answer:
    return lambda frame: [(frame._replace(**{"rows": ROWS, **changes}),)]


def changed(**columns: Any) -> np.ndarray:
    rows = ROWS.copy()
    for name, values in columns.items():
        rows[name] = values
    return rows


def test_what_is_right_passes_as_it_is():
    for answer, kind, given in (
        (one(), "tracker", GIVEN),
        (one(), "tracker", [GIVEN[0]] * 2),  # frames may share a time and a number
        (one(rows=changed(w_px=[0, 0])), "tracker", GIVEN),
        *((one(rows=changed(**{name: [np.nan, 1] for name in columns})), "tracker", GIVEN) for columns in (BOX_PX, PLACE_M)),
        (lambda frame: [(Frame(np.int64(frame.t_ns), np.uint32(frame.index), ROWS),)], "tracker", GIVEN),
        (lambda frame: one(t_ns=frame.t_ns + 1)(frame) * 2, "retracker", GIVEN),
    ):  # fmt: skip
        with collected() as warnings:
            made = [frame for (frame,) in answers(answer, kind, given)]
        wanted = [frame for old in given for (frame,) in answer(old)]
        assert [(type(f.t_ns), f.t_ns, type(f.index), f.index) for f in made] == [
            (int, f.t_ns, int, f.index) for f in wanted
        ]
        assert [str(frame.rows.tolist()) for frame in made] == [str(frame.rows.tolist()) for frame in wanted]
        assert not warnings


@pytest.mark.parametrize(
    "rows",
    [
        ROWS[list(reversed(ROWS.dtype.names))],
        ROWS.astype([(name, ">i8" if name in ("track_id", "source_id") else ROWS.dtype[name]) for name in ROWS.dtype.names]),
        ROWS.view(np.recarray),
        np.repeat(ROWS, 2)[::2],
    ],
    ids=["other order", "other byte order", "recarray", "strides"],
)  # fmt: skip
def test_rows_in_any_layout_become_rows_of_the_schema(rows):
    made = answers(one(rows=rows))
    assert {frame.rows.dtype for (frame,) in made} == {TRACKS.dtype}
    assert str(TRACKS.joined([frame.rows for (frame,) in made]).tolist()) == str(ROWS.tolist() * 4)


def test_a_buffer_that_is_used_again_does_not_change_earlier_frames():
    buffer = ROWS[:1].copy()

    def answer(frame: Frame) -> Iterator[tuple[Frame]]:
        buffer["track_id"] = frame.index
        yield (frame._replace(rows=buffer),)

    assert [frame.rows["track_id"].tolist() for (frame,) in answers(answer)] == [[0], [1], [2], [3]]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (one(t_ns=-1), "gave frame 0 of -1 ns at frame 0 (0 ns); a log holds no such time or number"),
        (one(t_ns=2**63), "gave frame 0 of 9223372036854775808 ns at frame 0 (0 ns); a log holds no such"),
        (one(index=-1), "gave frame -1 of 0 ns at frame 0 (0 ns); a log holds no such"),
        (one(index=2**32), "gave frame 4294967296 of 0 ns at frame 0 (0 ns); a log holds no such"),
        (one(t_ns=0.0), "gave a frame at frame 0 (0 ns) with a t_ns or index that is no whole number"),
        (one(t_ns=5), "gave frame 0 of 5 ns at frame 0 (0 ns), which is not in its input"),
        (one(index=3), "gave frame 3 of 0 ns at frame 0 (0 ns), which is not in its input"),
        (lambda frame: [*one()(frame), *one()(frame)], "gave frame 0 of 0 ns at frame 0 (0 ns), which is not in its input or was given before"),
        (lambda frame: [(frame, frame)], "gave a tuple of Frame, Frame at frame 0 (0 ns); it has to yield a tuple with a Frame"),
        (lambda frame: [()], "gave a tuple of nothing at"),
        (lambda frame: [((0, 0, ROWS),)], "gave a tuple of tuple at"),
        (one(rows=DETECTIONS.empty(1)), "that are wrong: mcaptrack.Tracks has the columns"),
        (one(rows=None), "gave rows at frame 0 (0 ns) that are a NoneType, no NumPy array"),
        (one(rows=ROWS.reshape(1, -1)), "needs a structured array (N,), not an array of shape (1, 2) with columns"),
        (one(rows=np.zeros((2, 6))), "needs a structured array (N,), not an array of shape (2, 6) without columns"),
        (one(rows=changed(track_id=[7, 7])), "that are wrong: in row 1 track_id 7 stands in 2 rows of one frame; a track has one"),
        (one(rows=changed(track_id=[7, -1])), "that are wrong: in row 1 track_id is -1; ids are not below 0"),
        (one(rows=changed(w_px=[3, -2])), "in row 1 w_px is -2; sizes are not below 0"),
        (one(rows=changed(h_px=[-0.5, 2])), "in row 0 h_px is -0.5; sizes are not below 0"),
        (one(rows=changed(y_m=[0, np.inf])), "in row 1 y_m is infinite"),
        (one(rows=changed(y_m=[0, np.nan])), "in row 1 there is only a part of x_m, y_m"),
        (one(rows=changed(h_px=[np.nan, 1])), "in row 0 there is only a part of x_px, y_px, w_px, h_px"),
        (one(rows=changed(**{name: [1, np.nan] for name in BOX_PX + PLACE_M})), "in row 1 there is neither a box nor"),
    ],
)  # fmt: skip
def test_what_can_not_be_is_refused_with_its_place(answer, said):
    with pytest.raises(McaptrackError) as refused:
        answers(answer)
    assert str(refused.value).startswith("tracker mine (pack 1) gave ")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("scores", "said"),
    [([0, 1], ""), ([np.nan, np.nan], ""), ([-0.5, np.nan], "from -0.5 to 1"), ([0.5, 90], "from 0 to 90")],
)
def test_scores_that_trackers_cannot_use_are_said_once(scores, said):
    with collected() as warnings:
        answers(one(rows=changed(score=scores)))
    expected = (
        f"tracker mine (pack 1) gave scores {said}; likelihoods are from 0 to 1, and tracking maps others to them"
    )
    assert [(warning.code, warning.message) for warning in warnings] == ([("scores", expected)] if said else [])


@pytest.mark.parametrize(("width", "is_said"), [(0.5, True), (0.6, False)])
def test_boxes_in_shares_of_the_picture_are_said_once(width, is_said):
    rows = changed(x_px=[0.1, 0.5], y_px=[0.1, 0.2], w_px=[0.2, width], h_px=[0.2, 0.4])
    with collected() as warnings:
        answers(one(rows=rows), "detector")
    said = "detector mine (pack 1) gave boxes that all lie within one pixel; they are in pixels, not in shares of a picture"
    assert [(warning.code, warning.message) for warning in warnings] == [("units", said)] * is_said


def test_frames_that_are_left_out_are_counted():
    with collected() as warnings:
        assert len(answers(lambda frame: one()(frame) if frame.index % 2 else [])) == 2
    (warning,) = warnings
    assert warning.code == "left-out"
    assert "tracker mine (pack 1) gave no frame for 2 of 4; " in warning.message


def test_times_do_not_go_back():
    with pytest.raises(McaptrackError, match=r"gave a frame of 990 ns at frame 1 \(10 ns\), after one of 1000 ns"):
        answers(lambda frame: one(t_ns=1000 - frame.t_ns)(frame), "retracker")


def test_a_transform_that_is_no_generator_is_named():
    def raising(frame: Frame) -> Iterator[Any]:
        raise StopIteration

    with pytest.raises(
        McaptrackError, match=r"failed at frame 0 \(0 ns\): RuntimeError: generator raised StopIteration"
    ):
        answers(raising)
    nothing = type("Nothing", (), {"writes": {"": TRACKS}, "__call__": lambda self, frames: None})()
    with pytest.raises(
        McaptrackError, match="failed before the first frame: TypeError: 'NoneType' object is not iterable"
    ):
        list(guarded(Entry("mine", "tracker", type(nothing), __name__, "", ""), nothing, GIVEN))


class Unprintable(Exception):
    def __str__(self) -> str:
        raise ValueError("no words")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SystemExit(0), "failed at frame 0 (0 ns): SystemExit: 0 (test_guarded.py, line"),
        (SystemExit(2), "failed at frame 0 (0 ns): SystemExit: 2"),
        (SystemExit("bye"), "failed at frame 0 (0 ns): SystemExit: bye"),
        (GeneratorExit(), "failed at frame 0 (0 ns): GeneratorExit"),
        (MemoryError(), "failed at frame 0 (0 ns): MemoryError"),
        (Unprintable(), "failed at frame 0 (0 ns): Unprintable"),
        (McaptrackError("no plane"), "tracker mine (pack 1): no plane"),
    ],
    ids=repr,
)
def test_whatever_it_raises_is_a_fault_of_the_transform(error, said):
    def answer(frame: Frame) -> Iterator[Any]:
        raise error
        yield

    with pytest.raises(McaptrackError) as refused:
        answers(answer)
    assert said in str(refused.value)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(143)], ids=repr)
def test_interruptions_pass(error):
    def answer(frame: Frame) -> Iterator[Any]:
        raise error
        yield

    with pytest.raises(type(error)):
        answers(answer)


def test_an_error_of_the_input_is_not_blamed_on_the_transform():
    def broken() -> Iterator[Frame]:
        yield GIVEN[0]
        raise OSError("disk")

    with pytest.raises(OSError, match=r"^disk$"):
        answers(one(), given=broken())


class Own:
    steps, step_s, past = 2, 0.5, 1
    result: ClassVar[Any] = None

    def __init__(self, steps: int, step_s: float) -> None:
        if isinstance(self.result, SystemExit):
            raise self.result

    def predict(self, xy_m: np.ndarray, valid: np.ndarray) -> Any:
        if isinstance(self.result, BaseException):
            raise self.result
        return self.result


class NeedsFile(Own):
    def __init__(self, steps: int, step_s: float, file: str) -> None: ...


def test_a_class_that_needs_a_file_is_told_how_to_get_one():
    with pytest.raises(McaptrackError, match="needs a file; only one with an entry point takes one, as in NAME:FILE"):
        entry_of(f"{__name__}:NeedsFile")


MEAN, COV = np.zeros((1, 2, 2)), np.tile(np.eye(2), (1, 2, 1, 1))


def predicted(**attributes: Any) -> Any:
    cls = type("Own", (Own,), attributes)
    checked = CheckedPredictor.of(Entry("own", "predictor", cls, __name__, "", ""), {"steps": 2, "step_s": 0.5})
    return checked.predict(np.zeros((1, 1, 2)), np.ones((1, 1), bool))


@pytest.mark.parametrize("kind", ["f4", "f8", "i2"])
def test_a_forecast_may_be_of_any_numbers(kind):
    mean, cov = (array.astype(kind) for array in (MEAN, COV))
    mean.flags.writeable = False
    found = predicted(result=(mean, cov.tolist()))
    assert (found.mean.dtype, found.cov.dtype) == (np.float64, np.float64)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"result": MEAN}, "gave a ndarray; predict has to return mean and covariance"),
        ({"result": {"mean": MEAN, "cov": COV}}, "gave a dict; predict has to return"),
        ({"result": (MEAN, COV, 1)}, "gave a tuple; predict has to return"),
        ({"result": None}, "gave a NoneType; predict"),
        ({"result": (MEAN + 1j, COV)}, "gave what can't be read as numbers: TypeError: an array of complex128"),
        ({"result": (MEAN.astype(str), COV)}, "gave what can't be read as numbers: TypeError: an array of <U32"),
        ({"result": ([[1], [2, 3]], COV)}, "gave what can't be read as numbers: ValueError"),
        ({"result": (MEAN, COV * np.nan)}, "gave numbers that are not finite"),
        ({"result": (MEAN, COV - 1)}, "gave covariances that are not symmetric with variances above 0"),
        ({"result": (MEAN + 2e15, COV)}, "gave numbers beyond 1e+15 (metres, and their squares)"),
        ({"result": (MEAN, COV * 1e300)}, "gave numbers beyond 1e+15"),
        ({"result": KeyError("x")}, "failed on 1 track: KeyError: 'x'"),
        ({"result": SystemExit(0)}, "could not be made with steps, step_s: SystemExit: 0"),
        ({"past": 10**9}, "has steps=2, step_s=0.5, past=1000000000; all have to be above 0, steps and past at most 10000"),
        ({"steps": 10**9}, "steps and past at most 10000"),
        ({"step_s": float("nan")}, "has steps=2, step_s=nan, past=1; all"),
        ({"step_s": 0.0}, "has steps=2, step_s=0, past=1; all"),
        ({"step_s": float("inf")}, "has steps=2, step_s=inf, past=1; all"),
        ({"steps": 0}, "has steps=0, step_s=0.5, past=1; all have to be above 0"),
        ({"past": 0}, "has steps=2, step_s=0.5, past=0; all have to be above 0"),
        ({"past": 10_001}, "past=10001; all have to be above 0, steps and past at most 10000"),
        ({"steps": 10_001}, "steps=10001, step_s=0.5, past=1; all have to be above 0, steps and past at most 10000"),
        ({"past": "two"}, "needs the numbers steps, step_s and past: ValueError"),
        ({"predict": None}, "has no method predict"),
        ({"__init__": lambda self, steps: None}, "could not be made with steps, step_s: TypeError"),
    ],
)  # fmt: skip
def test_a_predictor_that_goes_wrong_is_named(attributes, said):
    with pytest.raises(McaptrackError) as refused:
        predicted(**attributes)
    assert str(refused.value).startswith("predictor own ")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_predictor_may_look_at_and_give_ten_thousand_positions():
    cls = type("Own", (Own,), {"past": 10_000, "steps": 10_000})
    checked = CheckedPredictor.of(Entry("own", "predictor", cls, __name__, "", ""), {"steps": 2, "step_s": 0.5})
    assert (checked.steps, checked.past) == (10_000, 10_000)
    nothing = checked.predict(np.empty((0, 1, 2)), np.empty((0, 1), bool))
    assert (nothing.mean.shape, nothing.cov.shape) == ((0, 10_000, 2), (0, 10_000, 2, 2))


@dataclass(frozen=True)
class Twice:
    """Counts its frames before it answers any."""

    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": float("inf")}
    passes: ClassVar = 2

    def __call__(self, frames: Iterable[Frame]) -> Iterator[Any]:
        assert type(self) is Once or iter(frames) is not frames  # how a transform knows that it can read them again
        count = sum(1 for _ in frames)
        for number, frame in enumerate(frames):
            yield (frame._replace(rows=ROWS[: 2 * number // count]),)


class Once(Twice):
    """The same, and says nothing of it."""

    passes: ClassVar = 1


def test_frames_are_read_twice_by_a_transform_that_says_so():
    with collected() as warnings:
        made = [
            list(guarded(Entry("mine", "tracker", kind, __name__, "pack", "1"), kind(), GIVEN))
            for kind in (Twice, Once)
        ]
    assert [len(frame.rows) for (frame,) in made[0]] == [0, 0, 1, 1]
    assert made[1] == []
    assert [warning.code for warning in warnings] == ["left-out"]
