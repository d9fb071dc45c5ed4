"""Tracks that people have corrected: they come into the log, it is said what they changed, and re-tracking keeps them."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.corrections import Changes, compare
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.sources.corrections import fixed_ids, with_corrections, without_filled
from mcaptrack.transforms import Retrack
from mcaptrack.transforms.retrack.decisions import fix_tracks
from tests.test_offline_reference import tracks_of as assigned

STEP_NS = 400_000_000


def frame(number: int, boxes: dict[int, tuple[float, float]]) -> Frame:
    """A frame of tracks: boxes of 10 x 20 px at these places by id, which are metres, too."""
    places = np.array(list(boxes.values()), float).reshape(-1, 2)
    rows = TRACKS.rows(
        track_id=list(boxes), x_px=places[:, 0] * 10, y_px=places[:, 1] * 10, w_px=np.full(len(boxes), 10.0),
        h_px=np.full(len(boxes), 20.0), x_m=places[:, 0], y_m=places[:, 1], observed=np.ones(len(boxes), bool),
        source_id=np.full(len(boxes), -1),
    )  # fmt: skip
    return Frame(number * STEP_NS, number, rows)


def ids(frames) -> list[list[int]]:
    return [one.rows["track_id"].tolist() for one in frames]


class TestFixTracks:
    def test_a_track_that_was_cut_is_one_again_with_what_came_before_and_after(self):
        step = np.arange(8)
        source = np.array([1, 1, 9, 9, 9, 9, 2, 2])
        track = np.array([5, 5, 5, 5, 6, 6, 6, 6])
        assert fix_tracks(assigned(step, track, source), [9]).track.tolist() == [5] * 8

    def test_all_else_stays_as_it_is(self):
        step, source = np.array([0, 0, 1, 1]), np.array([1, 2, 1, 2])
        track = np.array([5, 6, 5, 6])
        assert fix_tracks(assigned(step, track, source), []).track is track
        assert fix_tracks(assigned(step, track, source), [7]).track is track

    @settings(max_examples=40, deadline=None)
    @given(st.data())
    def test_whatever_was_assigned_a_fixed_id_has_one_track_and_shares_it_with_no_other(self, data):
        pairs = data.draw(st.sets(st.tuples(st.integers(0, 7), st.integers(0, 4)), min_size=1))
        step, source = (np.array(one) for one in zip(*sorted(pairs), strict=True))
        # a track has one sample a step
        track = np.array([(s * 3 + data.draw(st.integers(0, 2))) % 7 for s in source])
        _, first = np.unique(np.stack([step, track]), axis=1, return_index=True)
        step, source, track = step[first], source[first], track[first]
        fixed = data.draw(st.sets(st.integers(0, 4)))
        found = fix_tracks(assigned(step, track, source), fixed).track
        owners = {one: set(found[source == one].tolist()) for one in fixed if (source == one).any()}
        assert all(len(tracks) == 1 for tracks in owners.values())
        assert len({next(iter(tracks)) for tracks in owners.values()}) == len(owners)
        assert len(np.unique(np.stack([step, found]), axis=1).T) == len(step)  # still one sample a step


class TestWithCorrections:
    def test_corrections_take_the_place_of_tracks_in_the_times_that_they_cover(self):
        tracks = [frame(k, {3: (k, 0), 4: (k, 9)}) for k in range(6)]
        corrected = [frame(2, {4: (2, 1)}), frame(3, {}), frame(4, {4: (4, 1), 7: (4, 5)})]
        assert fixed_ids(tracks, corrected) == (5, 6)
        both = with_corrections(tracks, corrected)
        assert ids(both) == [[3, 4], [3, 4], [5], [], [5, 6], [3, 4]]
        assert both[2].rows["y_px"].tolist() == [10]

    def test_between_pictures_of_a_task_with_a_step_boxes_are_interpolated(self):
        tracks = [frame(k, {3: (k, 0), 4: (k, 9)}) for k in range(12)]
        corrected = [frame(k, {7: (k, 1), **({8: (k, 5)} if k < 6 else {})}) for k in (2, 5, 8)]
        both = with_corrections(tracks, corrected)
        assert ids(both) == [[3, 4]] * 2 + [[5, 6]] * 4 + [[5]] * 3 + [[3, 4]] * 3
        np.testing.assert_allclose([one.rows["x_px"][0] for one in both[2:9]], np.arange(2, 9) * 10.0)
        assert all(one.rows["observed"].all() for one in both)

    def test_after_a_long_break_the_tracks_are_those_of_the_tracker(self):
        tracks = [frame(k, {3: (k, 0)}) for k in range(12)]
        both = with_corrections(tracks, [frame(k, {7: (k, 1)}) for k in (0, 1, 2, 9, 10)])
        assert ids(both) == [[4]] * 3 + [[3]] * 6 + [[4]] * 2 + [[3]]

    def test_nobody_is_put_where_a_person_said_that_there_is_none(self):
        rows = frame(1, {5: (1, 0), 6: (1, 9)})
        rows.rows["source_id"] = [-1, 4]
        frames = [rows._replace(t_ns=k * STEP_NS, index=k) for k in range(4)]
        assert ids(without_filled(frames, [frame(1, {}), frame(2, {})])) == [[5, 6], [6], [6], [5, 6]]
        assert ids(without_filled(frames, [])) == [[5, 6]] * 4

    @settings(max_examples=15, deadline=None)
    @given(st.sets(st.integers(0, 8)), st.sets(st.integers(0, 8)))
    def test_every_time_is_there_once_in_order(self, those, others):
        tracks = [frame(k, {1: (k, 0)}) for k in sorted(those)]
        corrected = [frame(k, {1: (k, 5)}) for k in sorted(others)]
        found = with_corrections(tracks, corrected)
        assert [one.index for one in found] == sorted(those | others)
        ours = [one.index for one in found if one.rows["y_px"].tolist() == [50]]
        assert set(others) <= set(ours)
        assert all(min(others) <= one <= max(others) for one in ours)


class TestRetrack:
    def test_ids_that_a_person_gave_are_neither_cut_nor_joined(self):
        """One walks on under one id, which plain re-tracking cuts where she jumps; two others are one, if it decides."""
        walk = {k: (k * 0.5 + (30 if k >= 12 else 0), 0.0) for k in range(24)}
        follow = {k: (20 + k * 0.5, 20.0) for k in range(24)}
        frames = [frame(k, {1: walk[k], (2 if k < 12 else 3): follow[k]}) for k in range(24)]
        plain = [rows.rows for rows, *_ in Retrack()(frames)]
        fixed = [rows.rows for rows, *_ in Retrack(fixed_ids=(1, 2, 3))(frames)]

        def tracks_of(found, source):
            return {int(one["track_id"]) for rows in found for one in rows if one["source_id"] == source}

        assert len(tracks_of(plain, 1)) == 2
        assert tracks_of(plain, 2) == tracks_of(plain, 3)
        assert [len(tracks_of(fixed, source)) for source in (1, 2, 3)] == [1, 1, 1]
        assert len(set.union(*(tracks_of(fixed, source) for source in (1, 2, 3)))) == 3


class TestCompare:
    def test_what_was_changed_is_counted(self):
        before = [frame(k, {1: (k, 0), 2: (k, 9), 3: (k, 30)}) for k in range(6)]
        # 1 and, from frame 3 on, 2 are one; 2 is moved in one frame; 3 is removed; 9 is new
        after = [
            frame(k, {1: (k, 0) if k < 3 else (k, 9), **({2: (k + 0.3 * (k == 1), 9)} if k < 3 else {}), 9: (k, 60)})
            for k in range(5)
        ]
        found, _ = compare("/camera/tracks", before, after)
        assert (found.frames, found.same, found.moved, found.added, found.removed) == (5, 7, 1, 5, 7)
        assert (found.joined, found.split) == ({1: [1, 2]}, {2: [1, 2]})
        assert (found.new_tracks, found.removed_tracks) == ([9], [3])
        assert "tracks 1, 2 joined to 1, track 2 split into 1, 2, new tracks 9, tracks 3 removed" in found.words

    def test_another_class_is_said_by_its_name_and_a_box_that_was_moved_far_keeps_its_id(self):
        before = [frame(k, {1: (k, 0), 2: (k, 9)}) for k in range(4)]
        after = [frame(k, {1: (k, 0), 2: (k + 40, 9)}) for k in range(4)]
        for one in before:
            one.rows["class_id"] = 1
        for one in after:
            one.rows["class_id"] = [3, 1]
        found, kept = compare("/camera/tracks", before, after, {1: "pedestrian"}, {1: "person", 3: "car"})
        assert (found.same, found.moved, found.added, found.removed, kept) == (4, 4, 0, 0, 8)
        assert found.relabelled == {1: ("person", "car")}
        assert found.words.endswith("4 moved, track 1 from person to car")


def test_corrections_need_a_log_and_ids(template, tmp_path):
    (tmp_path / "a.txt").write_text("1,1,2,3,4,5,1,1,1\n")
    (tmp_path / "b.txt").write_text("1,-1,2,3,4,5,1,1,1\n")
    path = shutil.copy(template, tmp_path / "a.mcap")
    with pytest.raises(McaptrackError, match=r"corrections are of tracks in a log; name it with `into=`"):
        mcaptrack.ingest(tmp_path / "a.txt", tmp_path / "b.mcap", role="corrections")
    with pytest.raises(McaptrackError, match="corrections need ids"):
        mcaptrack.ingest(tmp_path / "b.txt", role="corrections", into=path)


def words_of(**values: object) -> str:
    none = {"same": 9, "moved": 0, "added": 0, "removed": 0, "joined": {}, "split": {}, "new_tracks": []}
    changes = Changes(of="/a", frames=3, **(none | {"removed_tracks": [], "relabelled": {}} | values))  # type: ignore[arg-type]
    return changes.words.removeprefix("of /a, in 3 frames: 9 boxes as they were")


def test_what_changed_is_said_and_nothing_else_and_of_many_things_five_and_how_many_more():
    assert words_of() == ""
    assert words_of(moved=1, removed=2) == ", 1 moved, 2 removed"
    assert words_of(added=3) == ", 3 added"
    assert words_of(new_tracks=[1, 2, 3, 4, 5]) == ", new tracks 1, 2, 3, 4, 5"
    assert words_of(new_tracks=[*range(6)]) == ", new tracks 0, 1, 2, 3, 4 and 1 more"
    assert words_of(removed_tracks=[*range(8)]) == ", tracks 0, 1, 2, 3, 4 and 3 more removed"
    relabelled = {3: ("car", "bus"), 4: ("van", "bus"), 7: ("car", "bus")}
    assert words_of(relabelled=relabelled) == ", tracks 3, 7 from car to bus, track 4 from van to bus"
    for count, end in ((5, "from 4 to x"), (6, "1 more changes of class")):
        assert words_of(relabelled={k: (str(k), "x") for k in range(count)}).endswith(end)
    for joined, split, more in ((5, 5, 0), (6, 5, 1), (5, 7, 2), (7, 8, 5), (0, 6, 1)):
        both = {"joined": {k: [k, 90 + k] for k in range(joined)}, "split": {k: [k, 70 + k] for k in range(split)}}
        words = words_of(**both)
        assert words.count(" joined to ") == min(joined, 5)
        assert words.count(" split into ") == min(split, 5)
        assert (f", {more} more joined or split" in words) == ("more joined or split" in words) == (more > 0)


class TestPairs:
    @pytest.mark.parametrize(
        ("column", "by_px", "same"), [("x", 2.0, 1), ("x", 2.01, 0), ("y", 2.0, 1), ("y", -2.01, 0), ("w", 3.0, 0)]
    )
    def test_boxes_are_moved_if_a_corner_is_beyond_two_pixels(self, column, by_px, same):
        before, after = ([frame(k, {1: (10, 10)}) for k in range(3)] for _ in range(2))
        for one in after:
            one.rows[f"{column}_px"] += by_px
        found, kept = compare("/a", before, after)
        assert (found.same, found.moved, found.added, found.removed, kept) == (3 * same, 3 - 3 * same, 0, 0, 3)

    @pytest.mark.parametrize(("boxes", "joined"), [(1, {}), (2, {5: [1, 2]})])
    def test_a_single_box_joins_nothing(self, boxes, joined):
        before = [frame(k, {1: (10, 10)} if k >= boxes else {2: (10, 10)}) for k in range(6)]
        after = [frame(k, {5: (10, 10)}) for k in range(6)]
        found, kept = compare("/a", before, after)
        assert (found.joined, found.new_tracks, found.removed_tracks, kept) == (joined, [], [], 0)

    @pytest.mark.parametrize(("apart", "same"), [(5.3, True), (5.5, False)])
    def test_boxes_of_other_ids_are_the_same_object_from_an_overlap_of_three_tenths(self, apart, same):
        """Boxes of 10 px that are d px apart have an overlap of (10 - d) / (10 + d)."""
        before, after = [frame(0, {1: (10, 10)})], [frame(0, {2: (10 + apart / 10, 10)})]
        found, _ = compare("/a", before, after)
        assert (found.moved, found.added, found.removed) == ((1, 0, 0) if same else (0, 1, 1))

    def test_of_two_alike_the_box_with_the_same_id_is_preferred_by_a_tenth(self):
        """Overlaps of 7/13 = 0.54 with the own id at 3 px, and of 0.6 (2.5 px) or 0.74 (1.5 px) with another one."""
        before = [frame(0, {1: (10, 10)})]
        for near, own in ((0.25, True), (0.15, False)):
            after = [frame(0, {1: (10.3, 10), 2: (10 - near, 10)})]
            found, kept = compare("/a", before, after)
            assert (found.new_tracks, kept) == (([2], 1) if own else ([1], 0))

    def test_frames_that_one_side_lacks_and_rows_without_a_box_are_not_compared(self):
        before = [frame(k, {1: (k, 0), 2: (k, 9)}) for k in (1, 2, 4, 5)]
        after = [frame(k, {1: (k, 0), 2: (k, 9)}) for k in (0, 2, 3, 5, 6)]
        after[1].rows["x_px"][1] = np.nan
        found, kept = compare("/a", before, after)
        assert (found.frames, found.same, found.removed, found.added, kept) == (2, 3, 1, 0, 3)
        assert compare("/a", [], after)[0].frames == compare("/a", before, [])[0].frames == 0
