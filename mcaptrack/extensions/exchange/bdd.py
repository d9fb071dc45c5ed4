"""BDD100K, and other files of Scalabel: frames with labels, each with a category and ``box2d`` of x1, y1, x2, y2."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, chosen_part, frame_numbers
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NOTHING, REGION, Asked, BoxTable, LabelFacts

_CORNERS: Final = ("x1", "y1", "x2", "y2")
_INDEXES: Final = ("frameIndex", "frame_index", "index")
_VIDEOS: Final = ("videoName", "video_name", "video")


class Bdd(Format):
    """Labels of the frames of a video."""

    title = "BDD100K"
    row = "JSON of frames with `name`, `labels`: `id`, `category`, `box2d` of `x1`, `y1`, `x2`, `y2`"
    takes = ("scene",)

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON is a list of frames with labels, or an object with one."""
        frames = _frames(file) if file.keys else []
        return bool(frames) and isinstance(frames[0], dict) and {"name", "labels"} <= frames[0].keys()

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file; shapes that are no boxes are left out."""
        if not self.recognises(file):
            raise McaptrackError(f"{file.path} is no JSON of frames with a name and labels, as BDD100K has")
        frames, facts = _of_video(file, asked.scene), LabelFacts(file.path, states_labelled=True)
        names = [str(frame.get("name", "")).rpartition("-")[2] for frame in frames]
        numbers, _ = frame_numbers(names, frames, _INDEXES)
        facts.labelled, facts.region = np.array(sorted(numbers), np.int64), "crowd"
        facts.first_frame, facts.is_first_assumed = min(numbers), min(numbers) > 0
        rows, others = GatheredRows(facts, "label"), 0
        for number, frame in zip(numbers, frames, strict=True):
            labels = frame["labels"] if isinstance(frame.get("labels"), list) else []
            for order, label in enumerate(labels):
                place = f"{order} of frame {number}"
                if not isinstance(label, dict):
                    raise rows.refuse(place, "is no object")
                if not isinstance(label.get("box2d"), dict):
                    others += 1
                    continue
                left, top, right, bottom = rows.numbers(place, label["box2d"], _CORNERS)
                attributes = label.get("attributes")
                is_crowd = isinstance(attributes, dict) and bool(attributes.get("crowd", attributes.get("Crowd")))
                rows.add(
                    place, number, (left, top, right - left, bottom - top), label.get("id"), label.get("category"),
                    label.get("score"), aside=REGION if is_crowd else NOTHING,
                )  # fmt: skip
        table = rows.table()
        if others:
            table.left_out = f"{others} labels without a box"
        return table


def _frames(file: LabelFile) -> list[Any]:
    content = file.json.get("frames") if isinstance(file.json, dict) else file.json
    return content if isinstance(content, list) else []


def _of_video(file: LabelFile, wanted: str | None) -> list[dict[str, Any]]:
    """The frames of a video. Raises McaptrackError if there are several, and none is chosen."""
    videos: dict[str, list[dict[str, Any]]] = {}
    for frame in (frame for frame in _frames(file) if isinstance(frame, dict)):
        videos.setdefault(str(next((frame[key] for key in _VIDEOS if frame.get(key)), "")), []).append(frame)
    return chosen_part(file.path, videos, wanted, "video")
