"""Re-tracked names at the video's rate, on scenes in words."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms.to_video_rate import linked_tracks, to_video_rate
from tests.commands import printed
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


def test_every_box_gets_the_name_that_its_track_has():
    out = full([{7: 0.1 * n} for n in range(9)], [{1: (7, 0.4 * n)} for n in range(3)])
    assert out == [{1: (7, round(0.1 * n, 6))} for n in range(9)]


def test_the_first_number_of_a_track_is_zero():
    out = full([{0: 0.1 * n} for n in range(9)], [{0: (0, 0.4 * n)} for n in range(3)])
    assert out == [{0: (0, round(0.1 * n, 6))} for n in range(9)]


def test_rows_without_a_box_have_no_source_and_were_not_observed():
    tracks = [Frame(ns(n / 10), n, boxes({7: 0.1 * n} if n not in (1, 2) else {})) for n in range(9)]
    samples = [Frame(ns(0.4 * n), 4 * n, named({1: (7, 0.4 * n)})) for n in range(3)]
    rows = np.concatenate([frame.rows for frame in to_video_rate(tracks, samples, ())])
    assert rows["source_id"].tolist() == [7, -1, -1, *[7] * 6]
    assert rows["observed"].tolist() == [True, False, False, *[True] * 6]
    nothing = [Frame(0, 0, named({1: (-1, 0.0)}))]
    assert [len(frame.rows) for frame in to_video_rate(tracks[:1], nothing, ())] == [1]


def test_a_track_that_is_two_people_changes_its_name_half_way_between_the_ticks():
    out = full([{7: 0.1 * n} for n in range(9)], [{1: (7, 0.0)}, {2: (7, 0.4)}, {2: (7, 0.8)}])
    assert [[who for who, (source, _) in f.items() if source == 7] for f in out] == [[1]] * 3 + [[2]] * 6


def test_two_tracks_that_are_one_person_have_one_name_and_the_hole_between_them_is_filled():
    tracks = [{7: 0.1 * n} if n <= 5 else {8: 0.1 * n} if n >= 10 else {} for n in range(17)]
    out = full(tracks, [{1: (7, 0.0)}, {1: (7, 0.4)}, {1: (-1, 0.8)}, {1: (8, 1.2)}, {1: (8, 1.6)}])
    assert [set(f) for f in out] == [{1}] * 17
    assert [f[1][0] for f in out] == [7] * 6 + [-1] * 4 + [8] * 7
    np.testing.assert_allclose([f[1][1] for f in out], 0.1 * np.arange(17), atol=1e-6)


def test_boxes_of_a_false_track_are_left_out():
    out = full([{7: 0.1 * n, 9: 5.0} for n in range(9)], [{1: (7, 0.4 * n)} for n in range(3)])
    assert all(set(f) == {1} for f in out)


def test_without_re_tracked_tracks_every_frame_is_there_without_rows():
    assert full([{7: 0.0}] * 4, [{}]) == [{}] * 4
    assert list(to_video_rate([], [], ())) == []


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_no_id_is_at_two_places_and_no_box_has_two_ids(seed):
    rng = np.random.default_rng(seed)
    tracks = [{int(i): float(i) for i in range(5) if rng.random() < 0.7} for _ in range(20)]
    retracks = []
    for _ in range(5):
        sources = rng.permutation(5)[: rng.integers(0, 6)]
        retracks.append({int(10 + rng.permutation(5)[k]) + 10 * k: (int(s), float(s)) for k, s in enumerate(sources)})
    frames = [Frame(ns(n / 10), n, boxes(people)) for n, people in enumerate(tracks)]
    out = to_video_rate(frames, [Frame(ns(0.4 * n), n, named(people)) for n, people in enumerate(retracks)], ())
    for before, after in zip(frames, out, strict=True):
        who, source = after.rows["track_id"].tolist(), after.rows["source_id"]
        assert len(set(who)) == len(who)
        used = source[source >= 0].tolist()
        assert len(set(used)) == len(used)
        assert set(used) <= set(before.rows["track_id"].tolist())


def test_a_log_gets_them_beside_the_others(tmp_path):
    rows = "".join(f"{frame},1,{10 + frame},20,10,30,1,-1,-1,-1\n" for frame in range(1, 41))
    (tmp_path / "t.txt").write_text(rows)
    printed("ingest", tmp_path / "t.txt", "--as", "tracks", "--fps", 10, "-o", tmp_path / "l.mcap")
    printed("retrack", tmp_path / "l.mcap")
    (result,) = json.loads(printed("info", tmp_path / "l.mcap", "--json")[0])["results"]
    channels = {channel["topic"]: channel for channel in result["channels"]}
    assert channels["/camera/retracks/full"]["messages"] == channels["/camera/tracks"]["messages"] == 40
    assert not channels["/camera/retracks/full"]["stale"]


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


def test_of_two_boxes_with_one_id_the_nearer_to_its_sample_is_taken():
    tracks = [{7: 0.1 * n, 8: 0.1 * n + 0.05} for n in range(5)]
    out = full(tracks, [{1: (7, 0.0)}, {1: (8, 0.4)}])
    assert [frame[1][0] for frame in out] == [7, 7, out[2][1][0], 8, 8]
    assert [len(frame) for frame in out] == [1] * 5
