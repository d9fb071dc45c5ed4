"""Labels of people who are close to each other can all be read, and don't jump to and fro."""

from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import label_places
from mcaptrack.schema import TRACKS, Frame
from tests.worlds import ns

FULL = "/camera/retracks/full"


def drawn(topic: str, paths: dict[int, np.ndarray], fps: float = 10.0) -> list[dict[str, tuple[float, float]]]:
    """The places of labels in each picture; ``paths`` are boxes (T, 4) by id, NaN where nobody is."""
    count = len(next(iter(paths.values())))
    at = np.array([ns(n / fps) for n in range(count)], np.int64)
    frames = []
    for n in range(count):
        there = {one: path[n] for one, path in sorted(paths.items()) if np.isfinite(path[n]).all()}
        place = dict(
            zip(("x_px", "y_px", "w_px", "h_px"), np.array(list(there.values())).reshape(-1, 4).T, strict=True)
        )
        some = {"observed": np.ones(len(there), bool), "source_id": [-1] * len(there)}
        frames.append(Frame(int(at[n]), n, TRACKS.rows(track_id=list(there), **place, **some)))
    found = [
        ImageAnnotations.FromString(one) for _, _, one in views.Drawing(topic, TRACKS, frames, ()).on_pictures(at, at)
    ]
    return [{text.text: (text.position.x, text.position.y) for text in one.texts} for one in found]


def standing(x: float, y: float, count: int = 1) -> np.ndarray:
    return np.tile([x, y, 30.0, 80.0], (count, 1))


@pytest.mark.parametrize(("topic", "sign"), [(FULL, -1), ("/camera/tracks", 1), ("/camera/truth", 1)])
def test_the_label_of_the_higher_id_moves_by_a_line_and_the_lower_one_stays(topic, sign):
    alone = [drawn(topic, {one: standing(*at)})[0][str(one)] for one, at in ((3, (100, 100)), (8, (104, 104)))]
    both = drawn(topic, {3: standing(100, 100), 8: standing(104, 104)})[0]
    assert both["3"] == alone[0]
    assert both["8"][0] == alone[1][0]
    assert sign * (both["8"][1] - both["3"][1]) == pytest.approx(1.5 * 12, abs=0.25)
    apart = drawn(topic, {3: standing(100, 100), 8: standing(160, 104)})[0]
    assert apart["8"] == drawn(topic, {8: standing(160, 104)})[0]["8"]


def test_labels_at_one_place_stand_in_the_order_of_their_ids():
    found = drawn(FULL, {one: standing(100, 200) for one in (2, 4, 6)})[0]
    assert [found[name][1] for name in ("2", "4", "6")] == [200.0, 182.0, 164.0]


def test_labels_of_a_crowd_do_not_overlap_but_where_they_would_be_far_from_their_boxes():
    rng = np.random.default_rng(5)
    paths = {n + 1: standing(*rng.uniform((100, 100), (500, 260)), 1) for n in range(30)}
    found = drawn(FULL, paths)[0]

    def overlaps(places):
        boxes = [(x, y - 12, x + 8 * len(name), y) for name, (x, y) in places.items()]
        pairs = [(a, b) for n, a in enumerate(boxes) for b in boxes[:n]]
        return sum(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for a, b in pairs)

    assert overlaps({str(one): (path[0, 0], path[0, 1]) for one, path in paths.items()}) >= 4
    assert overlaps(found) == 0
    same = drawn(FULL, {n + 1: standing(100, 100) for n in range(12)})[0]
    assert all(abs(y - 100) <= 4 * 1.5 * 12 for _, y in same.values())


def test_a_label_that_moved_away_stays_there_while_boxes_tremble_and_comes_back():
    """Two labels meet in every third picture only; half a second after they last did, in picture 18, the higher one
    begins to come back, and a second after it is in its place.
    """
    count = 40
    one, other = standing(100, 100, count), standing(100, 100, count)
    other[:, 0] = np.where((np.arange(count) % 3 == 0) & (np.arange(count) < 20), 105, 112)
    high = [places["12"][1] for places in drawn(FULL, {5: one, 12: other})]
    assert set(high[:24]) == {82.0}
    assert set(high[28:]) == {100.0}
    assert 3 < np.diff(high[23:29]).min() < np.diff(high[23:29]).max() < 4


def test_places_depend_on_the_past_alone_and_not_on_what_is_drawn_at_once(monkeypatch):
    rng = np.random.default_rng(2)
    paths = {n + 1: standing(0, 0, 60) + np.cumsum(rng.normal(0, 6, (60, 4)) * [1, 1, 0, 0], axis=0) for n in range(8)}
    for path in paths.values():
        path[:, :2] += 100
        path[rng.random(60) < 0.2] = np.nan
    whole = drawn(FULL, paths)
    assert drawn(FULL, {one: path[:35] for one, path in paths.items()}) == whole[:35]
    monkeypatch.setattr("mcaptrack.foxglove.views.image.BATCH", 16)
    monkeypatch.setattr("mcaptrack.foxglove.views.people._PART_ROWS", 64)
    assert drawn(FULL, paths) == whole
    moved = sum(abs(y - paths[int(name)][n, 1]) > 5 for n, one in enumerate(whole) for name, (_, y) in one.items())
    assert moved > 10


def test_the_extent_of_labels_follows_from_their_characters():
    found = label_places.extents(np.array([7, 12345]), 12.0)
    assert found.tolist() == [[9.0, 18.0], [45.0, 18.0]]
