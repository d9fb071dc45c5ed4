"""Where tracks of boxes in space begin and end, on scenes in numbers."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.schema import TRACKS, Frame, framing
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms.to_video_rate import mended_ends, to_video_rate


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
        3: (9, 31),
        5: (0, 59),
        1: (2, 3),
        9: (19, 24),
    }
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
