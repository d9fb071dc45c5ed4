"""Files of bdd."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import mcaptrack
from tests.label_cases import Row, Writer, as_json, by_frame, corners


def bdd(rows: Sequence[Row]) -> Any:
    frames = []
    for frame, mine in by_frame(rows).items():
        labels = [
            {"id": row.id, "category": row.kind, "score": row.score,
             "box2d": dict(zip(("x1", "y1", "x2", "y2"), corners(row), strict=True))}
            for row in mine
        ]  # fmt: skip
        frames.append({"name": f"v-{frame + 1:07}.jpg", "videoName": "v", "frameIndex": frame, "labels": labels})
    return frames


WRITERS = {
    "bdd": Writer(as_json(bdd), first="listed"),
}


def test_a_video_of_several_is_chosen_while_a_log_is_made(tmp_path):
    label = {"id": "1", "category": "person", "box2d": {"x1": 1, "y1": 1, "x2": 20, "y2": 40}}
    frames = [
        {"name": f"{name}-{number}.jpg", "videoName": name, "frameIndex": number, "labels": [label]}
        for name, count in (("a", 3), ("b", 5))
        for number in range(count)
    ]
    (tmp_path / "a.json").write_text(json.dumps(frames))
    out = mcaptrack.ingest(tmp_path / "a.json", tmp_path / "a.mcap", role="truth", fps=10, scene="b")
    assert out.messages == {"/camera/truth": 5}
