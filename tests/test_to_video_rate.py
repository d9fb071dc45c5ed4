"""Re-tracked names at the video's rate, on scenes in words."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest

from mcaptrack.geometry.arrays import taken
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import TRACKS, Frame, framing
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms.retrack.offline import TrackRows, rows_by_step
from mcaptrack.transforms.retrack.passes import column
from mcaptrack.transforms.to_video_rate import linked_tracks, mended_ends, move_rows, to_video_rate
from tests.worlds import ns


def boxes(people: dict[int, float]):
    """Rows of tracks at 10 Hz: boxes of 10 x 30 px, 20 px to a metre, no metres yet."""
    x = np.array(list(people.values()), float)
    return TRACKS.rows(
        track_id=list(people),
        x_px=x * 20 - 5,
        y_px=np.full(len(x), 100.0),
        w_px=np.full(len(x), 10.0),
        h_px=np.full(len(x), 30.0),
        observed=np.ones(len(x), bool),
        source_id=np.full(len(x), -1),
    )


def named(people: dict[int, tuple[int, float]]):
    """Re-tracked rows: who, from which track, where."""
    source, x = np.array(list(people.values()), float).reshape(-1, 2).T
    rows = boxes(dict(zip(people, x, strict=True)))
    rows["x_m"], rows["y_m"], rows["source_id"] = x, 0.0, source
    rows["observed"] = source >= 0
    return rows


def full(tracks, retracks):
    frames = to_video_rate(
        [Frame(ns(n / 10), n, boxes(people)) for n, people in enumerate(tracks)],
        [Frame(ns(0.4 * n), 4 * n, named(people)) for n, people in enumerate(retracks)],
        (),
    )
    return [
        {int(r["track_id"]): (int(r["source_id"]), round(float(r["x_px"] + 5) / 20, 6)) for r in f.rows} for f in frames
    ]


def test_the_first_number_of_a_track_is_zero():
    out = full([{0: 0.1 * n} for n in range(9)], [{0: (0, 0.4 * n)} for n in range(3)])
    assert out == [{0: (0, round(0.1 * n, 6))} for n in range(9)]


def test_without_re_tracked_tracks_every_frame_is_there_without_rows():
    assert full([{7: 0.0}] * 4, [{}]) == [{}] * 4
    assert list(to_video_rate([], [], ())) == []
    tracks = [Frame(ns(n / 10), n, boxes({7: 0.1 * n})) for n in range(3)]
    found = [(one.t_ns, one.index, len(one.rows)) for one in to_video_rate(tracks, [], ())]
    assert found == [(0, 0, 0), (ns(0.1), 1, 0), (ns(0.2), 2, 0)]
    # one sample says nothing about other times, not even those of the nanosecond beside it
    near = [tracks[0], *(tracks[0]._replace(t_ns=t_ns, index=t_ns) for t_ns in (1, 2))]
    found = to_video_rate(near, [Frame(0, 0, named({1: (7, 0.0)}))], ())
    assert [one.rows["track_id"].tolist() for one in found] == [[1], [1], []]


def test_boxes_have_metres_by_the_plane_of_their_time():
    """Beyond the last sample boxes are those of the tracker; half a metre to a pixel at first, then 2 m."""
    half, two = (GroundPlane((scale, 0, 0, 0, scale, 0, 0, 0, 1), 640, 480) for scale in (0.5, 2.0))
    planes = ((0, half), (ns(0.4), two))
    tracks = [Frame(ns(n / 10), n, boxes({7: 0.1 * n, 8: 1.0})) for n in range(9)]
    samples = [Frame(0, 0, named({1: (7, 0.0)})), Frame(ns(0.4), 4, named({2: (8, 1.0)}))]
    rows = [{int(r["track_id"]): r for r in frame.rows} for frame in to_video_rate(tracks, samples, planes)]
    assert [sorted(some) for some in rows] == [[1, 2]] * 7 + [[2]] * 2  # up to 1.5 times the 0.4 s between samples
    for n in range(1, 7):
        scale = 0.5 if n < 4 else 2.0
        at = rows[n][1]
        assert (at["x_m"], at["y_m"]) == (pytest.approx(scale * 2 * n), scale * 130)
    for n in (1, 2, 3, 5, 8):
        scale = 0.5 if n < 4 else 2.0
        assert (rows[n][2]["x_m"], rows[n][2]["y_m"]) == (scale * 20, scale * 130)
    assert (rows[0][1]["x_m"], rows[4][2]["x_m"]) == (0.0, 1.0)  # those of the samples
    for frame, before in zip(linked_tracks(tracks, (), planes), tracks, strict=True):
        scale = 0.5 if frame.index < 4 else 2.0
        assert frame.rows["source_id"].tolist() == frame.rows["track_id"].tolist() == [7, 8]
        np.testing.assert_allclose(frame.rows["x_m"], [scale * 2 * frame.index, scale * 20])
        np.testing.assert_array_equal(frame.rows["y_m"], scale * 130)
        assert np.isnan(before.rows["x_m"]).all()
    known = linked_tracks(samples, (), planes)[1].rows
    assert (known["x_m"].tolist(), known["y_m"].tolist()) == ([1.0], [0.0])
    assert np.isnan(linked_tracks(tracks, (), ())[0].rows["x_m"]).all()


class TestRowByRow:
    """Both functions beside their definitions, read row by row, on random tracks; also a few rows at a time."""

    @staticmethod
    def tracks(rng: np.random.Generator) -> list[Frame]:
        """Four tracks at 10 Hz with gaps, numbered from 12; the last begins late."""
        frames = []
        for n in range(40):
            there = {i: 10.0 * i + 0.1 * n + rng.random() for i in (15, 12, 14, 13) if rng.random() < 0.7}
            rows = boxes({i: x for i, x in there.items() if i != 15 or n > 20})
            rows["class_id"], rows["score"] = 1, rng.random(len(rows)).round(2)
            frames.append(Frame(ns(n / 10) + 5, n + 100, rows))
        return frames

    @staticmethod
    def samples(rng: np.random.Generator) -> list[Frame]:
        """Ids from 30 on, each of a random track or of none, in three of four samples."""
        out = []
        for n in range(10):
            sources = rng.permutation([12, 13, 14, 15, -1])
            some = {30 + k: (int(source), 5.0 * k + n) for k, source in enumerate(sources[:4]) if rng.random() < 0.75}
            rows = named(some)
            rows["class_id"] = rows["track_id"] % 3 + n // 5
            out.append(Frame(ns(0.4 * n) + 5, n, rows))
        return out

    @staticmethod
    def named_slowly(tracks: list[Frame], samples: list[Frame]) -> list[dict[int, tuple]]:
        reach_ns, out = ns(0.6), []
        first_class = {}
        for sample in reversed(samples):
            first_class |= dict(zip(sample.rows["track_id"].tolist(), sample.rows["class_id"].tolist(), strict=True))
        for t_ns, _, rows in tracks:
            best: dict[int, tuple[int, np.void]] = {}
            for row in rows:
                own = [
                    (abs(sample.t_ns - t_ns), sample.t_ns, int(one["track_id"]))
                    for sample in samples
                    for one in sample.rows
                    if one["source_id"] == row["track_id"]
                ]
                away, _, who = min(own, default=(reach_ns + 1, 0, 0))
                if away <= reach_ns and away < best.get(who, (reach_ns + 1,))[0]:
                    best[who] = away, row
            here = {who: (float(row["x_px"]), int(row["track_id"]), True) for who, (_, row) in best.items()}
            for who in {one for sample in samples for one in sample.rows["track_id"].tolist()} - set(here):
                x = at_time(samples, who, t_ns, reach_ns)
                if x is not None:
                    here[who] = x, -1, False
            out.append({who: (*here[who], first_class[who]) for who in sorted(here)})
        return out

    @staticmethod
    def linked_slowly(tracks: list[Frame], roots: dict[int, int]) -> list[dict[int, tuple]]:
        spans: dict[int, list[int]] = {}
        for frame in tracks:
            for one in frame.rows["track_id"].tolist():
                spans.setdefault(one, []).append(frame.t_ns)
        parts: dict[int, list[tuple[int, int]]] = {}
        for one, times in sorted(spans.items(), key=lambda pair: pair[1]):
            parts.setdefault(roots.get(one, one), []).append((times[0], times[-1]))
        linked = {root: both for root, both in parts.items() if len(both) > 1}
        gap_ns = max([b[0] - a[1] for both in linked.values() for a, b in itertools.pairwise(both)] + [0])
        out: list[dict[int, tuple]] = []
        for frame in tracks:
            here = {} if linked else dict.fromkeys(frame.rows["track_id"].tolist())
            for row in sorted(frame.rows, key=lambda row: spans[row["track_id"]][0], reverse=True):
                here[roots.get(int(row["track_id"]), int(row["track_id"]))] = row
            out.append({who: (float(row["x_px"]), int(row["track_id"]), True) for who, row in here.items()})
        kept = [
            Frame(frame.t_ns, frame.index, boxes({who: (x + 5) / 20 for who, (x, *_) in here.items()}))
            for frame, here in zip(tracks, out, strict=True)
        ]
        for frame, here in zip(tracks, out, strict=True):
            for who in set(linked) - set(here):
                x = at_time(kept, who, frame.t_ns, gap_ns)
                if x is not None:
                    here[who] = x, -1, False
        return [dict(sorted(here.items())) for here in out] if linked else out

    @staticmethod
    def assert_same(found: list[Frame], wanted: list[dict[int, tuple]], tracks: list[Frame]) -> None:
        assert [(frame.t_ns, frame.index) for frame in found] == [(frame.t_ns, frame.index) for frame in tracks]
        for frame, rows in zip(found, wanted, strict=True):
            assert frame.rows["track_id"].tolist() == list(rows)
            x, source, observed, *others = zip(*rows.values(), strict=True) if rows else ([], [], [])
            np.testing.assert_allclose(frame.rows["x_px"], x, atol=1e-6)
            assert frame.rows["source_id"].tolist() == list(source)
            assert frame.rows["observed"].tolist() == list(observed)
            for classes in others:
                assert frame.rows["class_id"].tolist() == list(classes)

    @pytest.mark.parametrize("part_rows", [1 << 16, 9])
    def test_ids_are_those_of_the_nearest_sample(self, part_rows: int, monkeypatch):
        monkeypatch.setattr(framing, "PART_ROWS", part_rows)
        for seed in range(4):
            rng = np.random.default_rng(seed)
            tracks, samples = self.tracks(rng), self.samples(rng)
            self.assert_same(to_video_rate(tracks, samples, ()), self.named_slowly(tracks, samples), tracks)

    @pytest.mark.parametrize("part_rows", [1 << 16, 9])
    def test_linked_tracks_are_whole_and_keep_their_boxes(self, part_rows: int, monkeypatch):
        monkeypatch.setattr(framing, "PART_ROWS", part_rows)
        for seed in range(4):
            rng = np.random.default_rng(seed)
            spans = {11: (2, 9), 12: (0, 8), 13: (12 + seed, 20), 14: (5, 30), 15: (18, 39), 16: (33, 38)}
            tracks = []
            for n in range(40):
                here = [
                    i for i, (low, high) in spans.items() if n in (low, high) or (low < n < high and n % 7 != i % 7)
                ]
                tracks.append(
                    Frame(ns(n / 10) + 5, n, boxes({i: 10.0 * i + rng.random() for i in rng.permutation(here)}))
                )
            roots = {12: 12, 13: 12, 15: 12, 14: 14, 16: 14} if seed < 3 else {12: 12, 14: 14}
            samples = [Frame(ns(0.4) * n, n, named({who: (one, 0.0)})) for n, (one, who) in enumerate(roots.items())]
            samples.append(Frame(ns(9.0), 9, named({40: (-1, 0.0)})))
            self.assert_same(linked_tracks(tracks, samples, ()), self.linked_slowly(tracks, roots), tracks)


def at_time(frames: list[Frame], who: int, t_ns: int, most_ns: int) -> float | None:
    """The place of a track at a time, between two of its rows that are near enough to each other."""
    own = [(frame.t_ns, float(row["x_px"])) for frame in frames for row in frame.rows if row["track_id"] == who]
    for (low, start), (high, end) in zip(own, [*own[1:], own[-1]] if own else [], strict=True):
        if t_ns == low or (low < t_ns < high and high - low <= most_ns):
            return start + (t_ns - low) / max(high - low, 1) * (end - start)
    return None


# Where tracks of boxes in space begin and end, on scenes in numbers


def moving(spans: dict[int, set[int]], count: int = 60, rate_hz: float = 10.0, **others: float) -> list[Frame]:
    """Frames with tracks that go 3 m/s north and 4 m/s east from (id, 0), each detected in some of the frames."""
    frames = []
    for n in range(count):
        known = [one for one, found in spans.items() if min(found) <= n <= max(found)]
        t = n / rate_hz
        rows = TRACKS.rows(
            track_id=known,
            x_m=[one + 3 * t for one in known],
            y_m=[4 * t] * len(known),
            vx_m_per_s=[3.0] * len(known),
            vy_m_per_s=[4.0] * len(known),
            observed=[n in spans[one] for one in known],
            source_id=known,
        )
        for name, value in ({"length_m": 4.0} | others).items():
            rows[name] = value
        frames.append(Frame(round(t * 1e9), n, rows))
    return frames


def spans_of(frames) -> dict[int, list[int]]:
    out: dict[int, list[int]] = {}
    for n, frame in enumerate(frames):
        for one in frame.rows["track_id"].tolist():
            out.setdefault(one, []).append(n)
    return out


@pytest.mark.parametrize("part_rows", [1 << 16, 5])
def test_tracks_have_a_row_before_the_first_and_one_after_the_last(part_rows: int, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    seen = {3: set(range(10, 31)), 5: set(range(60)), 1: set(range(2, 4)), 9: set(range(20, 24))}
    frames = moving(seen)
    out = mended_ends(collect(TRACKS, frames))
    spans = spans_of(out)
    assert {one: (found[0], found[-1]) for one, found in spans.items()} == {
        3: (9, 31), 5: (0, 59), 1: (2, 3), 9: (19, 24),
    }  # fmt: skip
    assert all(len(found) == found[-1] - found[0] + 1 for found in spans.values())
    for n, (frame, before) in enumerate(zip(out, frames, strict=True)):
        assert (frame.t_ns, frame.index) == (before.t_ns, before.index)
        assert frame.rows["track_id"].tolist() == sorted(frame.rows["track_id"].tolist())
        for row in frame.rows:
            one = int(row["track_id"])
            assert (row["x_m"], row["y_m"]) == pytest.approx((one + 0.3 * n, 0.4 * n), abs=1e-5)
            assert row["observed"] == (n in seen[one])
            assert row["source_id"] == (one if n in seen[one] else -1)


@pytest.mark.parametrize("part_rows", [1 << 16, 3])
@pytest.mark.parametrize(
    ("found", "rate_hz", "last"),
    [
        ({*range(10), 21}, 10.0, 10),  # a lone box after 1.2 s: the track ends before it
        ({*range(10), 17}, 10.0, 18),  # after 0.8 s it is one more
        ({*range(10), 21, 22}, 10.0, 23),  # two are no chance
        ({*range(10), 21, 33}, 10.0, 10),  # two that are both alone are
        ({*range(10), 21, 22, 40}, 10.0, 23),
        ({*range(10), 13}, 2.0, 14),  # 2 s, but only three frames without a box
        ({*range(10), 22}, 20.0, 23),  # 12 frames, but 0.65 s
        ({0, 30}, 10.0, 0),  # too few rows are left to say how it moves on
    ],
)
def test_a_lone_box_after_a_long_gap_does_not_continue_a_track(
    found: set[int], rate_hz: float, last: int, part_rows: int, monkeypatch
):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    frames = moving({4: found, 8: set(range(60))}, rate_hz=rate_hz)
    spans = spans_of(mended_ends(collect(TRACKS, frames)))
    assert spans == {4: list(range(last + 1)), 8: list(range(60))}


def test_tracks_are_not_moved_on_over_gaps_of_the_log():
    frames = moving({4: set(range(10, 20)), 6: set(range(60))}, 60)
    paused = [frame._replace(t_ns=frame.t_ns + (200_000_000 if n >= 10 else 0)) for n, frame in enumerate(frames)]
    assert spans_of(mended_ends(collect(TRACKS, paused)))[4] == list(range(10, 21))
    seldom = moving({4: set(range(10, 20))}, 60, rate_hz=1.0)
    assert spans_of(mended_ends(collect(TRACKS, seldom)))[4] == list(range(10, 20))


def test_only_tracks_of_boxes_in_space_are_mended():
    seen = {4: set(range(10, 31))}
    frames = moving(seen)
    samples = [frame._replace(rows=frame.rows.copy()) for frame in frames[::4]]
    assert spans_of(to_video_rate(frames, samples, ()))[4] == list(range(9, 32))
    for others in ({"w_px": 10.0}, {"vx_m_per_s": np.nan}, {"length_m": np.nan}):
        assert spans_of(to_video_rate(moving(seen, **others), samples, ()))[4] == list(range(10, 31)), others


# Rows between samples, and where smoothing moves them, beside a slow interpolation


LINEAR = ("x_px", "y_px", "w_px", "h_px", "score", "x_m", "y_m", "z_m", "vx_m_per_s")
#: Of 10 and of 20 px to a metre, the second from the third second on.
PLANES = tuple((ns(t), GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 640, 480)) for t, s in ((0, 0.1), (3, 0.05)))


class Scene:
    """Samples of six input ids in twelve frames at steps that rise by one or two, and assignments of some to tracks."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.steps = np.cumsum(rng.integers(1, 3, 12)).tolist()
        frames, places = [], []
        self.assigned: dict[int, dict[int, int]] = {}  # the sample at each step of each track
        for step in self.steps:
            ids = rng.permutation(6)[: rng.integers(2, 7)]
            count = len(ids)
            rows = TRACKS.rows(
                track_id=ids + 40, class_id=rng.integers(1, 3, count), observed=rng.random(count) < 0.8,
                source_id=[-1] * count, heading_rad=rng.uniform(-np.pi, np.pi, count), length_m=[4.0] * count,
                width_m=[2.0] * count, height_m=[1.5] * count, vy_m_per_s=[0.0] * count,
                **{name: rng.uniform(1, 90, count) for name in LINEAR},
            )  # fmt: skip
            frames.append(Frame(ns(step / 2.5), step, rows))
            for one in rng.permutation(count)[: rng.integers(0, 4)]:
                track = int(rng.integers(1, 5))
                self.assigned.setdefault(track, {}).setdefault(step, len(places) + int(one))
            places += [*rows]
        self.samples, self.rows = collect(TRACKS, frames), places
        pairs = [
            (track, step, row) for track, own in sorted(self.assigned.items()) for step, row in sorted(own.items())
        ]
        track, step, row = np.array(pairs).T
        self.track_rows = TrackRows.of(step, track, row)

    def by_step(self, xy_m: np.ndarray | None, planes: tuple) -> list:
        """The rows at each step, moved to these positions, if any."""
        steps = np.arange(self.steps[-1] + 1)
        return list(rows_by_step(self.track_rows, self.samples, xy_m, planes, steps, ns(1) * steps * 2 // 5))

    def slowly(self) -> dict[int, list[dict[str, float]]]:
        """The rows at each step, by rising ids."""
        out: dict[int, list[dict[str, float]]] = {}
        for track, own in sorted(self.assigned.items()):
            made = []
            for step in range(min(own), max(own) + 1):
                low = max(at for at in own if at <= step)
                high = min(at for at in own if at >= step)
                one, other = self.rows[own[low]], self.rows[own[high]]
                share = (step - low) / max(high - low, 1)
                row = {name: one[name] + share * (other[name] - one[name]) for name in LINEAR}
                turn = (other["heading_rad"] - one["heading_rad"] + np.pi) % (2 * np.pi) - np.pi
                row["heading_rad"] = (one["heading_rad"] + share * turn + np.pi) % (2 * np.pi) - np.pi
                is_sample = low == high
                row |= {"track_id": track, "source_id": one["track_id"] if is_sample else -1}
                row |= {"observed": bool(one["observed"] and is_sample), "class_id": one["class_id"]}
                made.append((step, row))
            classes = Counter(int(row["class_id"]) for _, row in made)
            most = max(classes.values())
            usual = next(int(row["class_id"]) for _, row in made if classes[int(row["class_id"])] == most)
            for step, row in made:
                out.setdefault(step, []).append(row | {"class_id": usual})
        return out


@pytest.mark.parametrize("part_rows", [1 << 16, 5])
@pytest.mark.parametrize("seed", range(4))
def test_rows_between_samples_are_interpolated(seed: int, part_rows: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    scene = Scene(seed)
    wanted = scene.slowly()
    found = scene.by_step(None, PLANES)
    assert len(found) == scene.steps[-1] + 1
    assert sum(map(len, found)) == sum(map(len, wanted.values()))
    for step, rows in enumerate(found):
        for row, one in zip(rows, wanted.get(step, []), strict=True):
            for name, value in one.items():
                assert row[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    between = scene.track_rows.between(column(scene.samples, "x_m"))
    order = np.lexsort((scene.track_rows.track, scene.track_rows.step))
    np.testing.assert_allclose(between[order], [one["x_m"] for step in sorted(wanted) for one in wanted[step]])
    some = taken(scene.track_rows, slice(2, 6))
    for part, whole in zip(some, scene.track_rows, strict=True):
        assert part.tolist() == whole[2:6].tolist()
    is_sample = scene.track_rows.is_sample[order].tolist()
    assert is_sample == [one["source_id"] >= 0 for step in sorted(wanted) for one in wanted[step]]


@pytest.mark.parametrize("planes", [PLANES, ()])
def test_boxes_of_rows_between_samples_move_with_their_positions_where_there_is_a_plane(planes: tuple):
    """By a metre along x and two along y, which are 10 and 20 px, and from the third second on 20 and 40 px."""
    scene = Scene(9)
    rows, wanted = scene.track_rows, scene.slowly()
    at = np.stack([rows.between(column(scene.samples, name)) for name in ("x_m", "y_m")], axis=-1)
    for step, some in enumerate(scene.by_step(at + [1.0, 2.0], planes)):
        for row, one in zip(some, wanted.get(step, []), strict=True):
            stays = not planes or row["source_id"] >= 0
            px = (0 if stays else 10 if step / 2.5 < 3 else 20) * np.array([1, 2])
            assert (row["x_m"], row["y_m"]) == pytest.approx((one["x_m"] + 1, one["y_m"] + 2))
            assert (row["x_px"], row["y_px"]) == pytest.approx((one["x_px"] + px[0], one["y_px"] + px[1]))
            assert (row["w_px"], row["h_px"]) == pytest.approx((one["w_px"], one["h_px"]))
    some = np.array(scene.rows[:6], TRACKS.dtype)
    t_ns = np.array([ns(t) for t in (0, 1, 2.9, 3, 4, 50)])
    there = move_rows(some, np.stack([some["x_m"], some["y_m"]], axis=1) + [1.0, 2.0], planes, t_ns)
    scale = np.array([10, 10, 10, 20, 20, 20]) if planes else np.zeros(6)
    np.testing.assert_allclose(there["x_px"] - some["x_px"], scale, atol=1e-4)
    np.testing.assert_allclose(there["y_px"] - some["y_px"], 2 * scale, atol=1e-4)
    np.testing.assert_allclose(there["y_m"] - some["y_m"], 2.0)
