"""Re-tracking without metres: tracks keep their ids and are linked over gaps in the picture, in heights of their boxes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import combine, score, summary
from mcaptrack.geometry.plane import assumed_plane
from mcaptrack.pipeline.planes import is_poor
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import PROFILES, Retrack, Sample
from mcaptrack.transforms.retrack.in_pictures import link_in_picture
from mcaptrack.transforms.to_video_rate import linked_tracks, steady_s
from tests.worlds import assert_same_rows, ns

#: Foot (x, y) and height of a box, in px.
Box = tuple[float, float, float]
PICTURES = Retrack(poor_scale=True)
DATA = Path(os.environ.get("MCAPTRACK_DATA", "/nonexistent")) / "mot15"


def frame(number: int, boxes: dict[int, Box], rate_hz: float = 2.5) -> Frame:
    ids, rows = np.array(list(boxes), int), np.array(list(boxes.values()), float).reshape(-1, 3)
    x, y, h = rows.T
    content = TRACKS.rows(
        track_id=ids, x_px=x - 0.2 * h, y_px=y - h, w_px=0.4 * h, h_px=h, x_m=x / 100, y_m=-y / 100,
        observed=np.ones(len(ids), bool), source_id=ids,
    )  # fmt: skip
    return Frame(ns(number / rate_hz), number, content)


def walking(number: int, tall: float, speed: float = 0.6, at: tuple[float, float] = (300.0, 400.0)) -> Box:
    """A person who walks across, at a speed in heights a second."""
    return at[0] + speed * tall * 0.4 * number, at[1], tall


def linked(frames: list[Frame], retrack: Retrack = PICTURES) -> list[Frame]:
    return [result[0] for result in retrack(frames)]


def ids_of(frames: list[Frame]) -> set[int]:
    return {one for frame in frames for one in frame.rows["track_id"].tolist()}


def with_gap(tall: float, gap: range, then: float | None = None, aside: float = 0.0) -> list[Frame]:
    """A person as track 1, missed in the gap, and then as track 2, as tall as ``then`` and ``aside`` heights lower."""

    def boxes(n: int) -> dict[int, Box]:
        x, y, _ = walking(n, tall)
        return {} if n in gap else {1: (x, y, tall)} if n < gap.start else {2: (x, y + aside * tall, then or tall)}

    return [frame(n, boxes(n)) for n in range(20)]


def crowd(rng: np.random.Generator, count: int = 12, steps: int = 40) -> list[Frame]:
    """People of all sizes who are missed now and then, sometimes with a new id after it."""
    tall = rng.uniform(30, 200, count)
    place, speed = rng.uniform(0, 800, (count, 2)), rng.normal(0, 0.4, (count, 2))
    name, hidden, top = list(range(count)), np.zeros(count, int), count
    frames = []
    for n in range(steps):
        boxes = {}
        for k in range(count):
            if hidden[k] == 0 and rng.random() < 0.1:
                hidden[k] = rng.integers(1, 6)
                if rng.random() < 0.7:
                    name[k], top = top, top + 1
            hidden[k] = max(hidden[k] - 1, 0)
            if not hidden[k]:
                x, y = place[k] + speed[k] * tall[k] * 0.4 * n + rng.normal(0, 0.03 * tall[k], 2)
                boxes[name[k]] = (x, y, tall[k] * np.exp(rng.normal(0, 0.03)))
        frames.append(frame(n, boxes))
    return frames


@pytest.mark.parametrize("seed", range(4))
def test_tracks_are_only_cut_at_gaps_and_joined(seed):
    """No row is lost or moved; what is added lies in gaps; an id is at one place of a frame."""
    frames = crowd(np.random.default_rng(seed))
    found = linked(frames)
    last: dict[int, tuple[int, int]] = {}  # of each input track its id after linking, and when it was seen last
    for before, after in zip(frames, found, strict=True):
        assert len(np.unique(after.rows["track_id"])) == len(after.rows)
        own = after.rows[after.rows["source_id"] >= 0]
        assert sorted(own["source_id"].tolist()) == sorted(before.rows["track_id"].tolist())
        for row in own:
            track, seen = last.get(int(row["source_id"]), (row["track_id"], 0))
            assert row["track_id"] == track or seen < before.index - 1
            last[int(row["source_id"])] = int(row["track_id"]), before.index
            same = before.rows[before.rows["track_id"] == row["source_id"]]
            assert [row[name] for name in ("x_px", "h_px", "x_m")] == [
                same[0][name] for name in ("x_px", "h_px", "x_m")
            ]
        assert not after.rows[after.rows["source_id"] < 0]["observed"].any()
    assert len(ids_of(found)) < len(ids_of(frames))


@pytest.mark.parametrize(
    "retrack",
    [replace(PICTURES, link_s=0.0), *(replace(PROFILES[name], poor_scale=True) for name in ("paper", "authors"))],
    ids=["not linked", "paper", "authors"],
)
def test_other_methods_pass_tracks_on_as_they_are(retrack):
    frames = with_gap(100.0, range(8, 10))
    for one, before in zip(linked(frames, retrack), frames, strict=True):
        assert_same_rows(one.rows, before.rows)


def test_classes_are_not_joined_unless_asked():
    frames = with_gap(100.0, range(8, 10))
    for one in frames[10:]:
        one.rows["class_id"] = 2
    assert len(ids_of(linked(frames))) == 2
    assert len(ids_of(linked(frames, replace(PICTURES, across_classes=True)))) == 1


def test_at_the_rate_of_the_video_gaps_are_filled_and_short_tracks_come_out():
    """Ten pictures a second: track 1 to 0.9 s, track 2 from 1.4 s, which continues it; track 3 lasts 0.2 s."""

    def boxes(n: int) -> dict[int, Box]:
        x = 10.0 * n
        return ({1: (x, 300, 90)} if n < 10 else {2: (x, 300, 90)} if n >= 14 else {}) | (
            {3: (900, 300, 90)} if n in (5, 6) else {}
        )

    tracks = [frame(n, boxes(n), 10.0) for n in range(30)]
    samples = [frame for (frame,) in Sample(start_ns=0)(tracks)]
    full = linked_tracks(tracks, linked(samples), ())
    assert [one.t_ns for one in full] == [one.t_ns for one in tracks]
    for n, one in enumerate(full):
        assert one.rows["track_id"].tolist() == ([1, 3] if n in (5, 6) else [1])
        row = one.rows[0]
        assert row["x_px"] == pytest.approx(10.0 * n - 18)
        assert (row["observed"], row["source_id"]) == ((True, 1 if n < 10 else 2) if not 10 <= n < 14 else (False, -1))


def test_of_two_boxes_with_one_id_that_of_the_earlier_track_stays():
    tracks = [
        frame(n, ({1: (100, 300, 90)} if n < 12 else {}) | ({2: (103, 300, 90)} if n >= 10 else {}), 10.0)
        for n in range(20)
    ]
    retracks = [frame(n, {1: (100, 300, 90)}) for n in range(5)]
    for one in retracks[3:]:
        one.rows["source_id"] = 2
    full = linked_tracks(tracks, retracks, ())
    assert [one.rows["source_id"].tolist() for one in full] == [[1]] * 12 + [[2]] * 8
    assert ids_of(list(full)) == {1}


def read(path: Path, fps: float, count: int) -> list[Frame]:
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    rows = rows[(rows[:, 6] != 0) & (rows[:, 5] > 0)]
    out = []
    for n in range(count):
        own = rows[rows[:, 0] == n + 1]
        x, y, w, h = own[:, 2:6].T
        ids = own[:, 1].astype(int)
        content = TRACKS.rows(
            track_id=ids, x_px=x, y_px=y, w_px=w, h_px=h, observed=np.ones(len(ids), bool), source_id=ids
        )
        out.append(Frame(ns(n / fps), n, content))
    return out


@pytest.mark.skipif(not DATA.is_dir(), reason="MCAPTRACK_DATA has no mot15")
def test_cameras_at_the_height_of_people_gain_and_none_loses():
    """SORT's tracks of five sequences of the MOTChallenge, by boxes at an overlap of 0.5."""
    before, after = [], []
    for name in ("ADL-Rundle-6", "ETH-Sunnyday", "KITTI-17", "TUD-Campus", "TUD-Stadtmitte"):
        info = dict(line.split("=") for line in (DATA / name / "seqinfo.ini").read_text().splitlines() if "=" in line)
        fps, count = float(info["frameRate"]), int(info["seqLength"])
        tracks, truth = (read(DATA / name / part, fps, count) for part in ("reference/sort.txt", "gt/gt.txt"))
        assert is_poor(tracks)
        plane = assumed_plane(np.concatenate([one.rows["h_px"] for one in tracks]), 640, 480)
        samples = [one for (one,) in Sample(start_ns=0, ground_planes=((0, plane),))(tracks)]
        retrack = replace(PICTURES, boxes=collect(TRACKS, tracks))
        full = linked_tracks(tracks, linked(samples, retrack), ((0, plane),), retrack.filled_s)
        before.append(score(make_matchup(truth, tracks, "iou", 0.5), "trackeval"))
        after.append(score(make_matchup(truth, full, "iou", 0.5), "trackeval"))
        had, has = summary(before[-1]), summary(after[-1])
        assert has["IDF1"] > had["IDF1"], name
        assert has["MOTA"] > had["MOTA"], name
    had, has = summary(combine(before)), summary(combine(after))
    assert has["IDF1"] > had["IDF1"] + 0.025


def ids_in_picture(frames: list[Frame], max_gap_s: float, least: float, *options: object) -> set[int]:
    rows = link_in_picture(collect(TRACKS, frames), max_gap_s, least, False, *options).frames
    return ids_of(list(rows))


@pytest.mark.parametrize("tall", [40.0, 200.0])
def test_links_are_less_likely_the_less_both_sides_fit(tall):
    """One person goes on in time, as tall, and where expected; sizes are in heights of the box."""

    def least_likely(frames: list[Frame]) -> float:
        asked = 1 / (1 + np.exp(-np.linspace(-8, 8, 33)))
        return max((least for least in asked.tolist() if len(ids_in_picture(frames, 4.0, least)) == 1), default=0.0)

    best = least_likely(with_gap(tall, range(8, 10)))
    assert best > 0.5
    assert best > least_likely(with_gap(tall, range(8, 14)))
    assert best > least_likely(with_gap(tall, range(8, 10), then=1.5 * tall))
    assert (
        best
        > least_likely(with_gap(tall, range(8, 10), aside=0.5))
        > least_likely(with_gap(tall, range(8, 10), aside=1.5))
    )


def test_a_track_is_cut_where_another_one_goes_on_there():
    """The tracker continues track 1 with somebody much smaller far away, and begins track 2 where the person is."""

    def boxes(n: int) -> dict[int, Box]:
        own = walking(n, 100.0)
        return {1: own} if n < 8 else {} if n < 10 else {1: (900.0, 200.0, 30.0), 2: own}

    frames = [frame(n, boxes(n)) for n in range(20)]
    found = linked(frames)
    assert [one.rows["track_id"].tolist() for one in found] == [[1]] * 10 + [[1, 3]] * 10
    assert [one.rows["source_id"].tolist() for one in found] == [[1]] * 8 + [[-1]] * 2 + [[2, 1]] * 10


def test_at_the_rate_of_the_video_pieces_without_a_sample_count_too():
    """With boxes of the video beside samples, gaps between samples are seen."""

    def boxes(n: int) -> dict[int, Box]:
        x = 10.0 * n
        return {1: (x, 300, 90)} if n < 17 else {2: (x, 300, 90)} if n >= 22 else {}

    tracks = [frame(n, boxes(n), 10.0) for n in range(40)]
    samples = [frame for (frame,) in Sample(start_ns=0)(tracks)]
    full = linked_tracks(tracks, linked(samples, replace(PICTURES, boxes=collect(TRACKS, tracks))), (), 4.0)
    assert [one.rows["track_id"].tolist() for one in full] == [[1]] * 40
    assert [one.rows["observed"].tolist() for one in full] == [[not 17 <= n < 22] for n in range(40)]


def test_gaps_are_filled_only_as_long_as_a_straight_line_is_right():
    """Of people who walk straight on all gaps are filled, of those who turn every second short ones."""

    def turning(n: int) -> float:
        return 100.0 * float(np.sin(2 * np.pi * n / 20))

    straight = [frame(n, {1: (10.0 * n, 300, 90)}, 10.0) for n in range(100)]
    zigzag = [frame(n, {1: (300 + turning(n), 300, 90)}, 10.0) for n in range(100)]
    assert steady_s(straight, 4.0) == 4.0
    assert steady_s(zigzag, 4.0) < 1.0
    assert steady_s([], 4.0) == 4.0


def test_gaps_are_filled_where_nine_in_ten_walk_straight():
    """Of people a hundred heights apart some turn every second: of 0.5 s and more a straight line is wrong for these."""

    def boxes(n: int, people: int) -> dict[int, Box]:
        turned = 100.0 * float(np.sin(2 * np.pi * n / 10))
        return {k: (9e3 * k + (turned if k == 0 else 10.0 * n), 300, 90) for k in range(people)}

    for people, is_filled in ((5, False), (30, True)):
        longest_s = steady_s([frame(n, boxes(n, people), 10.0) for n in range(100)], 4.0)
        assert (longest_s == 4.0) == is_filled, people


def test_the_longest_gaps_are_linked_and_no_longer_ones():
    for missed, joined in ((10, True), (11, False)):  # 4.0 and 4.4 s between the samples before and after
        frames = with_gap(100.0, range(4, 3 + missed))
        assert (ids_in_picture(frames, 4.0, 1e-9) == {1}) == joined
        assert ids_in_picture(frames, (missed - 1) * 0.4, 1e-9) == {1, 2}
        assert (ids_of(linked(frames, replace(PICTURES, link_confidence=0.01))) == {1}) == joined


def test_tracks_of_people_who_said_so_are_neither_cut_nor_joined():
    frames = with_gap(100.0, range(8, 10))
    for fixed, count in (((), 1), ((1,), 1), ((2,), 1), ((1, 2), 2)):
        assert len(ids_in_picture(frames, 4.0, 0.5, fixed)) == count
    assert ids_in_picture([], 4.0, 0.5) == set()
    apart = [
        frame(n, {1: walking(n, 100.0)} if n < 8 else {1: (900.0, 200.0, 30.0)} if n > 9 else {}) for n in range(20)
    ]
    assert ids_in_picture(apart, 4.0, 0.5) == {1, 2}
    assert ids_in_picture(apart, 4.0, 0.5, (1,)) == {1}


def test_a_track_of_three_parts_has_one_id_also_in_its_gaps_and_rows_are_in_order_of_ids():
    """Somebody else is there all the time, and a row without a box."""
    nowhere = TRACKS.rows(track_id=[7], x_m=[1.0], y_m=[1.0], observed=[True], source_id=[7])

    def boxes(n: int) -> dict[int, Box]:
        own = {} if n in (6, 7, 13, 14) else {9 if n < 6 else 2 if n < 13 else 3: walking(n, 100.0)}
        return dict(sorted((own | {4: (100.0, 900.0, 100.0)}).items()))

    frames = [frame(n, boxes(n)) for n in range(20)]
    both = [np.concatenate([one.rows, nowhere]) for one in frames]
    frames = [one._replace(rows=rows[np.argsort(rows["track_id"])]) for one, rows in zip(frames, both, strict=True)]
    for n, one in enumerate(linked(frames)):
        rows = one.rows
        assert rows["track_id"].tolist() == [4, 7, 9]
        assert rows["x_px"][2] == pytest.approx(walking(n, 100.0)[0] - 20)
        source = -1 if n in (6, 7, 13, 14) else 9 if n < 6 else 2 if n < 13 else 3
        assert rows["source_id"].tolist() == [4, 7, source]
        assert rows["observed"].tolist() == [True, True, source > 0]
