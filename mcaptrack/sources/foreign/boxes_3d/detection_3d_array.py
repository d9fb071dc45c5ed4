"""vision_msgs/Detection3DArray, in its forms before ROS 2 Humble and since."""

from __future__ import annotations

from math import isfinite, nan
from typing import Any

from mcaptrack.sources.foreign.boxes_3d.box import Box3d, Message3d, head_of, number, own_head, part, quaternion, vector


def boxes_of(message: Any) -> Message3d:
    """The boxes of a message."""
    head = head_of(message)
    return Message3d(*head, [_box(detection, head) for detection in message.detections])


def _pose(centre: Any, results: Any) -> Any:
    """The pose of a box; that of its first result where only this one is filled in."""
    stated = [result.pose.pose for result in results if part(part(result, "pose"), "pose") is not None]
    is_unset = not any(vector(centre.position)) and bool(stated) and any(vector(stated[0].position))
    return stated[0] if is_unset else centre


def _box(detection: Any, around: tuple[int, str]) -> Box3d:
    # Before Humble a result is its own hypothesis, with ``id`` in the place of ``class_id``.
    guesses = [getattr(result, "hypothesis", result) for result in detection.results]
    scored = [(number(guess.score), guess) for guess in guesses]
    finite = [(score, guess) for score, guess in scored if isfinite(score)]
    score, best = max(finite or scored, key=lambda pair: pair[0], default=(nan, None))
    class_name = None if best is None else best.class_id if hasattr(best, "class_id") else best.id
    pose = _pose(detection.bbox.center, detection.results)
    return Box3d(
        *own_head(detection, around),
        vector(pose.position),
        quaternion(part(pose, "orientation")),
        vector(detection.bbox.size),
        "" if class_name is None else str(class_name).strip(),
        score if finite else nan,
        part(detection, "id") or part(detection, "tracking_id") or None,
    )
