"""Rows of re-tracked tracks between samples, and where smoothing moves them, beside a slow interpolation."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import TRACKS, Frame, framing
from mcaptrack.transforms.retrack.assignments import LogSamples
from mcaptrack.transforms.retrack.offline import TrackRows, move_rows, moved_to, rows_by_step
from tests.worlds import ns

LINEAR = ("x_px", "y_px", "w_px", "h_px", "score", "x_m", "y_m", "z_m", "vx_m_per_s")
#: Of 10 and of 20 px to a metre, the second from the third second on.
PLANES = tuple((ns(t), GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 640, 480)) for t, s in ((0, 0.1), (3, 0.05)))


class Scene:
    """Samples of six input ids in twelve frames at steps that rise by one or two, and assignments of some to tracks."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.steps = np.cumsum(rng.integers(1, 3, 12)).tolist()
        self.samples, self.rows, places = LogSamples(), [], []
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
            self.samples.add(Frame(ns(step / 2.5), step, rows))
            for one in rng.permutation(count)[: rng.integers(0, 4)]:
                track = int(rng.integers(1, 5))
                self.assigned.setdefault(track, {}).setdefault(step, len(places) + int(one))
            places += [*rows]
        self.rows = places
        pairs = [
            (track, step, row) for track, own in sorted(self.assigned.items()) for step, row in sorted(own.items())
        ]
        track, step, row = np.array(pairs).T
        self.track_rows = TrackRows.of(step, track, row)

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
    found = list(rows_by_step(scene.track_rows, scene.samples, None, range(scene.steps[-1] + 1)))
    assert len(found) == scene.steps[-1] + 1
    assert sum(map(len, found)) == sum(map(len, wanted.values()))
    for step, rows in enumerate(found):
        for row, one in zip(rows, wanted.get(step, []), strict=True):
            for name, value in one.items():
                assert row[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    between = scene.track_rows.between(scene.samples.column("x_m"))
    order = np.lexsort((scene.track_rows.track, scene.track_rows.step))
    np.testing.assert_allclose(between[order], [one["x_m"] for step in sorted(wanted) for one in wanted[step]])
    some = scene.track_rows.take(slice(2, 6))
    for part, whole in zip(some, scene.track_rows, strict=True):
        assert part.tolist() == whole[2:6].tolist()
    is_sample = scene.track_rows.is_sample[order].tolist()
    assert is_sample == [one["source_id"] >= 0 for step in sorted(wanted) for one in wanted[step]]


@pytest.mark.parametrize("planes", [PLANES, ()])
def test_boxes_move_with_their_positions_where_there_is_a_plane(planes: tuple):
    """By a metre along x and two along y, which are 10 and 20 px, and from the third second on 20 and 40 px."""
    scene = Scene(9)
    rows, wanted = scene.track_rows, scene.slowly()
    at = np.stack([rows.between(scene.samples.column(name)) for name in ("x_m", "y_m")], axis=-1)
    moved = moved_to(at + [1.0, 2.0], rows, scene.samples, planes, np.array([ns(one / 2.5) for one in rows.step]))
    assert (moved.shift_px is None) == (not planes)
    for step, some in enumerate(rows_by_step(rows, scene.samples, moved, range(scene.steps[-1] + 1))):
        px = (0 if not planes else 10 if step / 2.5 < 3 else 20) * np.array([1, 2])
        for row, one in zip(some, wanted.get(step, []), strict=True):
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
