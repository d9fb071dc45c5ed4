"""Messages with one box each, or several messages of one sweep, become frames."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.contracts import Box3d
from mcaptrack.sources.fixed_frame import Recorded3d
from mcaptrack.sources.foreign.fields import Message3d
from tests.box_reading import recorded

START_NS, MS = 1_700_000_000_000_000_000, 1_000_000
OBJECTS, SWEEPS, PERIOD_MS = 12, 20, 100
RNG = np.random.default_rng(5)
PLACES = RNG.uniform(-40, 40, (OBJECTS, 2))
SPEEDS = RNG.normal(0, 4, (OBJECTS, 2))


def scattered(stamp_ms, late_ms=lambda sweep, number: 40.0, objects: int = OBJECTS, missed: float = 0.1) -> Recorded3d:
    """Objects that move, a message for each of them in each sweep, ``stamp_ms`` after the beginning of the sweep."""
    rng, messages = np.random.default_rng(6), []
    for sweep in range(SWEEPS):
        for number in range(objects):
            if rng.random() < missed:
                continue
            after_ms = stamp_ms(rng, number)
            stamp_ns = START_NS + round((PERIOD_MS * sweep + after_ms) * MS)
            x, y = PLACES[number] + SPEEDS[number] * (PERIOD_MS * sweep + after_ms) / 1000
            box = Box3d(stamp_ns, "lidar", (x, y, 0.0), (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.5), "car", 0.5, number)
            log_ns = START_NS + round((PERIOD_MS * sweep + late_ms(sweep, number)) * MS)
            messages.append((log_ns, Message3d(stamp_ns, [box])))
    return recorded(sorted(messages, key=lambda one: one[0]))


@pytest.mark.parametrize(
    ("stamp_ms", "late_ms"),
    [
        (lambda rng, number: 2.0 * number, lambda sweep, number: 40 + number),
        (lambda rng, number: rng.uniform(0, 15), lambda sweep, number: 40.0),
        (lambda rng, number: 5.0 * number, lambda sweep, number: 70.0),
        # The stamps of a lidar that turns have no gaps, but the messages are written in a burst.
        (lambda rng, number: rng.uniform(0, 99), lambda sweep, number: 140 + 0.2 * number),
    ],
    ids=["steps", "noise", "most of a turn", "bursts"],
)
def test_a_message_for_each_object_with_its_own_stamp_is_gathered_to_sweeps(stamp_ms, late_ms):
    found = scattered(stamp_ms, late_ms)
    starts, frame, words = found.frames()
    assert f"gathered to {SWEEPS} frames" in words
    assert len(starts) == SWEEPS
    assert (np.diff(starts) > 0).all()
    sweep = ((found.stamp_ns - START_NS) // (PERIOD_MS * MS)).tolist()
    assert frame.tolist() == sweep
    for number in range(SWEEPS):  # the time is one of a box
        assert starts[number] in found.stamp_ns[frame == number]


@pytest.mark.parametrize(
    ("stamp_ms", "objects"),
    [
        (lambda rng, number: 0.0, OBJECTS),  # one stamp: a frame without a word
        (lambda rng, number: 0.0, 1),
        (lambda rng, number: rng.uniform(0, 40), 1),  # one object: each message is a frame
    ],
)
def test_frames_that_are_known_are_not_gathered(stamp_ms, objects):
    found = scattered(stamp_ms, objects=objects)
    starts, _, words = found.frames()
    assert words == ""
    assert len(starts) == len(np.unique(found.stamp_ns))


def test_an_object_that_is_seen_twice_at_a_time_is_no_sweep():
    """Pairs of frames with a pause between pairs: objects are in both frames of a pair."""
    messages = []
    for frame in range(40):
        stamp_ns = START_NS + (200 * (frame // 2) + 40 * (frame % 2)) * MS
        boxes = []
        for place, speed in zip(PLACES, SPEEDS, strict=True):
            x, y = place + speed * (stamp_ns - START_NS) / 1e9
            boxes.append(Box3d(stamp_ns, "lidar", (x, y, 0.0), (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.5), "car", 0.5))
        messages.append((stamp_ns, Message3d(stamp_ns, boxes)))
    starts, _, words = recorded(messages).frames()
    assert (len(starts), words) == (40, "")


def test_boxes_without_a_sign_of_sweeps_are_frames_of_their_own_aloud():
    def written(sweep: int, number: int) -> float:
        return 140 + 99 * number / OBJECTS

    found = scattered(lambda rng, number: 99 * number / OBJECTS, written, missed=0.0)
    starts, _, words = found.frames()
    assert len(starts) == SWEEPS * OBJECTS
    assert words == "messages have one box each, and their times don't show which are of one sweep: each is a frame"
