"""check_transform names the law that a transform breaks, and where."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from mcaptrack import schema_of
from mcaptrack.schema import DETECTIONS, SIGHTINGS, TRACKS, VIDEO, Frame
from mcaptrack.testing import LawError, check_transform, sample_frames


@dataclass(frozen=True, kw_only=True)
class Numbered:
    """A tracker that gives each box an id of its own, and breaks the law that it is told to."""

    breaks: str = ""
    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    seen: ClassVar[list[int]] = []

    @property
    def latency_s(self) -> dict[str, float]:
        return {"": 0.0}

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame]]:
        frames, count = list(frames) if self.breaks in ("causal", "late", "spawn") else frames, 0
        if self.breaks == "shared":
            self.seen.clear()
        if self.breaks == "spawn" and not frames:
            yield (Frame(0, 0, TRACKS.empty()),)
        for frame in frames:
            if self.breaks == "skip" and not len(frame.rows):
                continue
            if self.breaks == "input" and len(frame.rows):
                frame.rows["score"] = 0.5
            given = frame.rows if self.breaks == "order" else np.sort(frame.rows, order=["x_px", "y_px"])
            ids = count + np.arange(len(given), dtype=np.int64)
            count += len(given)
            if self.breaks == "merge" and (np.diff(frame.rows["x_px"]) < 0).any():
                ids = np.arange(len(given), dtype=np.int64)
            if self.breaks in ("state", "shared"):
                self.seen.append(1)
                ids += len(self.seen)
            if self.breaks == "order" and len(given):
                given = given.copy()
                given["score"][0] = 0.25
            rows = TRACKS.rows(
                track_id=ids,
                **{name: given[name] for name in ("x_px", "y_px", "w_px", "h_px", "score")},
                observed=np.ones(len(given), bool),
                source_id=np.full(
                    len(given),
                    len(frames) if self.breaks == "causal" or (self.breaks == "late" and frame.index > 9) else -1,
                ),
            )
            if self.breaks == "ghost" and not len(rows):
                rows = TRACKS.empty(1)
            if self.breaks == "schema":
                rows = rows[["track_id"]]
            if self.breaks == "id" and len(rows):
                rows["track_id"] = 1
            if self.breaks == "size" and len(rows):
                rows["h_px"] = -1
            t_ns = 0 if self.breaks == "time" else frame.t_ns
            result = (Frame(t_ns, 0 if self.breaks == "index" else frame.index, rows),)
            yield {"tuple": result * 2, "bare": (rows,)}.get(self.breaks, result)


def test_a_transform_that_keeps_all_laws_passes():
    check_transform(Numbered())
    check_transform(Numbered(), [frame for frame in sample_frames(DETECTIONS, 5) if len(frame.rows)])


@pytest.mark.parametrize(
    ("breaks", "words"),
    [
        ("schema", "conforms: tracker Numbered gave rows at frame 0 .* mcaptrack.Tracks has the columns"),
        ("time", "conforms: tracker Numbered gave frame 0 of 0 ns at frame 0 .* which is not in its input"),
        ("id", "conforms: tracker Numbered gave rows at frame .* track_id 1 stands in . rows of one frame"),
        ("size", "conforms: tracker Numbered gave rows at frame .* in row 0 h_px is -1"),
        ("index", "conforms: tracker Numbered gave frame 0 of .* which is not in its input"),
        ("tuple", "conforms: tracker Numbered gave a tuple of Frame, Frame at frame 0"),
        ("bare", "conforms: tracker Numbered gave a tuple of ndarray at frame 0"),
        ("state", "pure: the second run differs from the first in result 0 at"),
        ("shared", "pure: the second run differs from the first in result . at"),
        ("late", "causal: output '', frame 1. at .* depends on frames after number 14"),
        ("spawn", "empties: no frames give frames"),
        ("input", "pure: it changes its input, first in frame 0 at"),
        ("causal", "causal: output '', frame 0 at .* depends on frames after number 0"),
        ("order", "order-blind: output '', frame . at .* depends on the order of rows"),
        ("ghost", "empties: output '', frame 0 at .* has rows, though its input has none"),
        ("skip", "empties: frames without rows give no frames"),
    ],
)
def test_a_broken_law_is_named_with_its_place(breaks, words):
    with pytest.raises(LawError, match=words):
        check_transform(Numbered(breaks=breaks))


@dataclass(frozen=True)
class Alike:
    """A row for each track, the same for all but the id; or, as it is told, one that has the id as a number."""

    counts: bool = False
    reads: ClassVar = TRACKS
    writes: ClassVar = {"": schema_of("Alike", [("track_id", "i8"), ("near", "i4")])}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            ids = frame.rows["track_id"]
            yield (frame._replace(rows=self.writes[""].rows(track_id=ids, near=ids if self.counts else 0 * ids)),)


def test_rows_that_are_alike_may_change_places_when_rows_are_shuffled():
    check_transform(Alike())


def test_numbers_that_are_made_of_the_names_of_tracks_are_noticed():
    with pytest.raises(LawError, match=r"order-blind: output '', frame 0 at 0 ns depends on the ids of tracks"):
        check_transform(Alike(counts=True))


@dataclass(frozen=True)
class Passed:
    """A re-tracker that passes tracks on, moved in time or multiplied."""

    delay_ns: int = 0
    columns: tuple[str, ...] = ()
    times: float = 1.0
    reads: ClassVar = TRACKS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": float("inf")}

    def __call__(self, frames):
        for frame in frames:
            rows = frame.rows.copy()
            for name in self.columns:
                rows[name] *= self.times
            yield (frame._replace(t_ns=frame.t_ns + self.delay_ns, rows=rows),)


def test_a_re_tracker_gives_tracks_where_and_when_it_read_them():
    check_transform(Passed(columns=("x_m", "y_m", "x_px"), times=1.01))
    for broken, said in (
        (Passed(delay_ns=1), "output '', frame 39 at 15600000001 ns is outside of its input, 0 to 15600000000 ns"),
        (Passed(columns=("x_m", "y_m"), times=1000.0), r"rows are usually [\d.e+]+ m from those that it reads"),
        (Passed(columns=("x_m", "y_m"), times=3.28), r"rows are usually [\d.]+ m from"),
        (Passed(columns=("x_px", "y_px", "w_px"), times=0.001), r"rows are usually \d+ px from"),
    ):
        with pytest.raises(LawError, match=f"conforms: {said}"):
            check_transform(broken)


@dataclass(frozen=True)
class Apart:
    """A detection of each sighting, numbered from ``first`` on."""

    first: int = 0
    reads: ClassVar = SIGHTINGS
    writes: ClassVar = {"": DETECTIONS, "sightings": SIGHTINGS}
    latency_s: ClassVar = {"": 0.0, "sightings": 0.0}

    def __call__(self, frames):
        results = []
        for frame in frames:
            rows = np.sort(frame.rows, order=["camera", "box_row"])
            rows["detection"] = self.first + np.arange(len(rows))
            places = DETECTIONS.rows(x_m=rows["x_m"], y_m=rows["y_m"], class_id=[1] * len(rows))
            results.append((frame._replace(rows=places), frame._replace(rows=rows)))
        return results


def test_sightings_of_a_detection_that_is_not_there_are_noticed():
    check_transform(Apart())  # it returns a list, which a run takes, too
    with pytest.raises(LawError, match=r"fuser Apart gave sightings .* of detection (\d+); it gave \1, from 0 on"):
        check_transform(Apart(1))


def test_two_ids_that_become_one_when_rows_are_shuffled_are_noticed():
    frames = [frame._replace(rows=np.sort(frame.rows, order=["x_px", "y_px"])) for frame in sample_frames(DETECTIONS)]
    with pytest.raises(LawError, match=r"order-blind: output '', frame .* depends on the order"):
        check_transform(Numbered(breaks="merge"), frames)


def test_declarations_and_parameters_are_checked():
    class NotData:
        reads, writes, latency_s = DETECTIONS, {"": TRACKS}, {"": 0.0}

    @dataclass
    class Thawed(NotData):
        pass

    @dataclass(frozen=True)
    class NoLatency(NotData):
        latency_s: ClassVar = {}

    @dataclass(frozen=True)
    class Timeless:
        reads: ClassVar = DETECTIONS
        writes: ClassVar = {"": TRACKS}

    @dataclass(frozen=True)
    class Early(Timeless):
        latency_s: ClassVar = {"": -1}

    @dataclass(frozen=True)
    class Never(Timeless):
        latency_s: ClassVar = {"": float("nan")}

    @dataclass(frozen=True, kw_only=True)
    class Unkept(Numbered):
        how: float = 1.0

        def __post_init__(self) -> None:
            object.__setattr__(self, "how", self.how + 1)

    for transform, words in (
        (NotData(), "declares: NotData is no dataclass"),
        (Numbered, "declares: Numbered is a class; give a transform, as in Numbered()"),
        (Timeless(), "declares: Timeless.latency_s is no Mapping"),
        (Early(), "declares: Early.latency_s of '' is -1; it is 0 or more, in seconds"),
        (Never(), "declares: Never.latency_s of '' is nan; it is 0 or more, in seconds"),
        (Thawed(), "declares: Thawed is not frozen"),
        (NoLatency(), "declares: NoLatency.latency_s is of [], writes is of ['']"),
        (Unkept(), "provenance: how is 3.0 when it was kept"),
    ):
        with pytest.raises(LawError, match=re.escape(words)):
            check_transform(transform)


def test_samples_are_what_their_schemas_say():
    for schema in (DETECTIONS, TRACKS):
        frames = sample_frames(schema)
        assert sum(len(schema.check(frame.rows)) for frame in frames) > 60
        assert sample_frames(schema, 1)[0].rows.tobytes() != frames[0].rows.tobytes()
    assert {frame.rows.dtype for frame in sample_frames(VIDEO)} == {np.dtype(np.uint8)}
    with pytest.raises(LawError, match="no frames"):
        check_transform(Numbered(), [])
