"""Boxes as annotations of COCO, with tracks as in CocoVID.

``videos`` has one entry. Images have ``video_id`` and ``frame_id`` (from 0), annotations ``instance_id`` as in CocoVID
of MMTracking, ``track_id`` as in TAO, and ``attributes`` with ``track_id`` and ``occluded`` as in files of CVAT.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from typing import Any, Final

import numpy as np

from mcaptrack.schema.classes import UNKNOWN
from mcaptrack.tables.box_files import BoxFile, ExportedBoxes

_ENTRIES: Final = 1024
_VIDEO: Final = 1


class CocoFile(BoxFile):
    """A JSON object with videos, images, annotations and categories."""

    title, end, holds = "COCO", ".coco.json", frozenset({"scores", "observed"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the object in parts."""
        size = {} if boxes.size is None else {"width": boxes.size[0], "height": boxes.size[1]}
        name = boxes.topic.strip("/")
        yield b'{"info": ' + _bytes({"description": f"boxes of {name}", "frames": "frame_id counts pictures from 0"})
        yield b', "videos": ' + _bytes([{"id": _VIDEO, "name": name, **size}])
        yield b', "categories": ' + _bytes([_category(number, name) for number, name in boxes.classes.items()])
        yield b', "images": [\n'
        yield from _list(_images(boxes, size))
        yield b'\n], "annotations": [\n'
        yield from _list(_annotations(boxes))
        yield b"\n]}\n"


def _category(number: int, name: str) -> dict[str, Any]:
    return {"id": number, "name": "unknown" if number == UNKNOWN else name, "supercategory": ""}


def _images(boxes: ExportedBoxes, size: dict[str, int]) -> Iterator[dict[str, Any]]:
    """All frames, and frame 0 in any case: readers take the first image for the first picture."""
    frames, times = boxes.frames.tolist(), boxes.t_ns.tolist()
    begin = [] if frames[0] == 0 else [(0, None)]
    for frame, t_ns in (*begin, *zip(frames, times, strict=True)):
        image = {"id": frame + 1, "video_id": _VIDEO, "frame_id": frame, "file_name": f"frame_{frame:06d}.jpg", **size}
        yield image if t_ns is None else image | {"timestamp_ns": t_ns}


def _annotations(boxes: ExportedBoxes) -> Iterator[dict[str, Any]]:
    columns = (boxes.frame.tolist(), boxes.id.tolist(), boxes.boxes.tolist(), boxes.class_id.tolist())
    scores, observed = boxes.score, boxes.observed.tolist()
    for row, (frame, track, box, kind) in enumerate(zip(*columns, strict=True)):
        out: dict[str, Any] = {
            "id": row + 1,
            "image_id": frame + 1,
            "video_id": _VIDEO,
            "category_id": kind,
            "bbox": box,
            "area": box[2] * box[3],
            "iscrowd": 0,
        }
        if np.isfinite(scores[row]):
            out["score"] = float(str(scores[row]))
        if boxes.has_ids:
            attributes = {"occluded": not observed[row], "track_id": track, "observed": observed[row]}
            out |= {"instance_id": track, "track_id": track, "attributes": attributes}
        yield out


def _bytes(value: Any) -> bytes:
    return json.dumps(value).encode("utf-8")


def _list(entries: Iterator[dict[str, Any]]) -> Iterator[bytes]:
    """Entries of a JSON list, one a line."""
    before = b""
    while some := list(islice(entries, _ENTRIES)):
        yield before + b",\n".join(map(_bytes, some))
        before = b",\n"
