"""COCO: annotations (images, annotations, categories), and results (image_id, category_id, bbox, score).

What is written has one video, as in CocoVID of MMTracking: images have ``video_id`` and ``frame_id`` (from 0),
annotations ``instance_id``, ``track_id`` as in TAO, and ``attributes`` with ``track_id`` and ``occluded`` as in CVAT.

Letters: N rows, F frames.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, as_float, frame_numbers, is_number
from mcaptrack.extensions.exchange.masks import box_of_mask
from mcaptrack.files import visible
from mcaptrack.schema.classes import UNKNOWN
from mcaptrack.sources.box_files import BoxFile, ExportedBoxes
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_CLASS, NOTHING, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_NAME, MAX_NAMES, FrameNames, is_count

#: The largest number of other files beside results in which their images are looked up.
_MAX_BESIDE: Final = 16
#: Keys of the track id of an annotation, of the frame of an image, and of its video; the first ones are written.
_TRACK_IDS: Final = ("track_id", "instance_id", "tracker_id")
_FRAMES: Final = ("frame_id", "frame_index", "mot_frame_id")
_VIDEOS: Final = ("video_id", "vid_id")
#: The attribute that is false for a box that was filled in.
_OBSERVED: Final = "observed"
_BY_LIST: Final = "the list `images`"
_BY: Final = {"names": "the numbers in file_name", "order": _BY_LIST}
#: Keys with which annotations begin.
_BEGIN: Final = tuple(
    f'"{key}"'.encode() for key in ("images", "annotations", "categories", "info", "licenses", "videos")
)


class Coco(Format):
    """Annotations or results, as the content tells."""

    title = "COCO"
    row = "JSON with `images`, `annotations` and `categories`; or results: `image_id`, `category_id`, `bbox`, `score`"
    rank = -1

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON has the keys of annotations or of results."""
        keys = file.keys
        if isinstance(file.json if keys else [], dict):
            return isinstance(file.json.get("annotations"), list)
        return "image_id" in keys and bool({"bbox", "segmentation"} & set(keys))

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        path, content = file.path, file.json if file.is_json else {}
        if content == []:
            raise McaptrackError(f"{path} holds no boxes")
        if not self.recognises(file):
            raise McaptrackError(f"{path} is neither annotations (images, annotations, categories) nor results of COCO")
        if isinstance(content, list):
            return _results(path, content)
        return _annotations(path, content)


class _Rows(GatheredRows):
    """Rows of entries; the ``noun`` names one of them in messages."""

    def __init__(self, path: Path, noun: str) -> None:
        super().__init__(LabelFacts(path, region="iscrowd"), noun)
        self.around = Counter[str]()

    def add_entry(self, number: int, entry: Any, frame_of: Callable[[Any], float]) -> None:
        """Add an annotation or a result. Raises McaptrackError if something is missing or of the wrong type."""
        if not isinstance(entry, dict):
            raise self.refuse(number, "is not an object")
        box = entry.get("bbox")
        if box is None or box == []:
            box = self._around(number, entry.get("segmentation"))
        if not isinstance(box, list) or len(box) != 4 or not all(map(is_number, box)):
            raise self.refuse(number, "has no bbox of 4 numbers: left, top, width, height")
        inner = entry.get("attributes")
        track = next((d[key] for d in (entry, inner) if isinstance(d, dict) for key in _TRACK_IDS if key in d), None)
        category, crowd = _whole_of_text(entry.get("category_id")), entry.get("iscrowd", 0)
        kind = self.number(number, category, "category_id", NO_CLASS)
        is_crowd = crowd is True or self.number(number, None if crowd is False else crowd, "iscrowd", 0) != 0
        try:
            frame = frame_of(entry.get("image_id"))
        except (ValueError, KeyError, TypeError) as error:
            text = str(error).strip('"')
            raise self.refuse(number, f"has a wrong image_id: {text}" if "column" in text else text) from None
        is_seen = not (isinstance(inner, dict) and inner.get(_OBSERVED) is False)
        self.add(
            number, frame, [*map(as_float, box)], track, None, entry.get("score"), kind=kind, observed=is_seen,
            aside=REGION if is_crowd else NOTHING,
        )  # fmt: skip

    def _around(self, number: int, outline: Any) -> list[float] | None:
        """The box around polygons, [x, y, x, y, ...] each; None without any."""
        if isinstance(outline, dict):
            self.around["masks"] += 1
            try:
                return box_of_mask(outline)
            except (KeyError, TypeError, ValueError) as error:
                raise self.refuse(number, f"has no bbox, and a mask that can't be read: {error}") from None
        parts = [part for part in outline if isinstance(part, list)] if isinstance(outline, list) else []
        points = [value for part in parts for value in part[: len(part) // 2 * 2]]
        if not points or not all(map(is_number, points)):
            return None
        self.around["polygons"] += 1
        x, y = ([*map(as_float, points[axis::2])] for axis in (0, 1))
        return [min(x), min(y), max(x) - min(x), max(y) - min(y)]

    def table(self) -> BoxTable:
        """All rows."""
        table = super().table()
        for what, count in sorted(self.around.items(), reverse=True):
            table.remark(f": {count} boxes are those around {what}, which have no bbox")
        return table


def _whole_of_text(value: Any) -> Any:
    """Return the whole number that a text holds; anything else as it is."""
    return int(value) if isinstance(value, str) and is_count(value, 15) else value


def _results(path: Path, content: list[Any]) -> BoxTable:
    """Results: a list of image_id, category_id, bbox, score.

    Annotations beside them tell the frames of images; without these the number of an image is that of its frame.
    """
    rows, names = _Rows(path, "result"), FrameNames()
    ids = {_key(entry.get("image_id")) for entry in content if isinstance(entry, dict)}
    beside, doubt = _images_beside(path, ids)

    def frame_of(image: Any) -> float:
        if beside is not None:
            return beside.by_id[_key(image)]
        if isinstance(image, str):
            return names.number(image)
        if not is_number(image):
            raise ValueError("has no image_id")
        return as_float(image)

    for number, entry in enumerate(content):
        rows.add_entry(number, entry, frame_of)
    out = rows.table()
    if beside is not None:
        beside.describe(out, str(beside.path))
        out.remark(f": the frames of image_id are those of the images in {beside.path}")
        return out
    if doubt:
        out.find(doubt, "clock")
    out.remark(": the number in image_id is taken as the frame")
    return out


def _images_beside(path: Path, ids: set[str]) -> tuple[_Images | None, str]:
    """The images in annotations of the same folder, if these name all of ``ids``; and what is doubtful about that."""
    files = [LabelFile(other) for other in visible(path.parent.iterdir()) if other.suffix == ".json" and other != path]
    files = [file for file in files if file.head[:1] == b"{" and any(key in file.head for key in _BEGIN)][:_MAX_BESIDE]
    every = list[_Images]()
    for file in files:
        try:
            images = _Images.of(file.path, file.json)
        except McaptrackError:
            continue  # a file of something else
        if ids <= images.by_id.keys():
            every.append(images)
    if any(images.by_id[image] != every[0].by_id[image] for images in every for image in ids):
        names = " and ".join(images.path.name for images in every[:2])
        return None, f": {names} beside it name its images differently, and neither is used"
    return (every[0], "") if every else (None, "")


def _annotations(path: Path, content: Mapping[str, Any]) -> BoxTable:
    """Annotations: images, annotations and categories."""
    images, entries = _Images.of(path, content), content["annotations"]
    rows = _Rows(path, "annotation")

    def frame_of(image: Any) -> float:
        if _key(image) not in images.by_id:
            raise ValueError(f"is of image {image!r:.40}, which isn't among the images")
        return images.by_id[_key(image)]

    for number, entry in enumerate(entries):
        rows.add_entry(number, entry, frame_of)
    out = rows.table()
    images.describe(out, "file")
    is_labelled = np.array([image.get("is_labeled") is not False for image in images.entries], bool)  # PoseTrack
    numbers = np.array([*images.by_id.values()], np.int64)
    out.facts.labelled, out.facts.states_labelled = np.unique(numbers[is_labelled]), True
    out.remark(f": {len(numbers)} images, in order of {images.order}")
    if not is_labelled.all():
        out.remark(f": {int((~is_labelled).sum())} images are not labelled (is_labeled)")
    return out


class _Images(NamedTuple):
    """The images of annotations: their entries, the frame of each id, what the frames are from, and class names."""

    path: Path
    entries: list[dict[str, Any]]
    by_id: dict[str, int]
    order: str
    names: dict[int, str] | None

    @classmethod
    def of(cls, path: Path, content: Mapping[str, Any]) -> _Images:
        """Read them. Raises McaptrackError if they are no images of one video."""
        images = content.get("images")
        if not isinstance(images, list) or not all(isinstance(image, dict) and "id" in image for image in images):
            raise McaptrackError(f"{path}: `images` is not a list of objects with an id each")
        ids = [_key(image["id"]) for image in images]
        if len(set(ids)) < len(ids):
            twice = Counter(ids).most_common(1)[0][0]
            raise McaptrackError(f"{path}: {twice} is the id of several images")
        videos = {_key(image[key]) for image in images for key in _VIDEOS if key in image}
        if len(videos) > 1:
            raise McaptrackError(f"{path} holds {len(videos)} videos (video_id); give one file for each of them")
        frames, by = frame_numbers([image.get("file_name") for image in images], images, _FRAMES)
        by_id = dict(zip(ids, frames, strict=True))
        return cls(path, images, by_id, _BY.get(by, by), _categories(path, content.get("categories")))

    def describe(self, table: BoxTable, named_by: str) -> None:
        """Set the facts that a table has from them: its first frame, sizes of pictures and names of classes."""
        facts, frames = table.facts, self.by_id.values()
        facts.first_frame = min(frames, default=0)
        facts.is_first_assumed, facts.is_in_order = facts.first_frame > 0, self.order == _BY_LIST
        sizes = {
            frame: (as_float(image["width"]), as_float(image["height"]))
            for frame, image in zip(frames, self.entries, strict=True)
            if is_number(image.get("width")) and is_number(image.get("height"))
        }
        facts.measure(sizes, len(self.entries))
        facts.names, facts.named_by = self.names, named_by if self.names else ""
        if self.order == _BY_LIST and len(self.entries) > 1:
            text = ": its images have neither frame_id nor names with numbers of one sequence; the order in `images`"
            table.find(f"{text} is taken as that of the pictures", "clock")


def _key(value: Any) -> str:
    """The id of an image or a video as text; 1.0, as pandas writes it, is 1."""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)[:MAX_NAME]


def _categories(path: Path, categories: Any) -> dict[int, str] | None:
    """Class names by number; None if there are none."""
    if not isinstance(categories, list) or not categories:
        return None
    if len(categories) > MAX_NAMES:
        raise McaptrackError(f"{path} has {len(categories)} categories; at most {MAX_NAMES} are read")
    out: dict[int, str] = {}
    for number, entry in enumerate(categories):
        key, name = (_whole_of_text(entry.get("id")), entry.get("name")) if isinstance(entry, dict) else (None, None)
        if not isinstance(key, int) or not 0 <= key < 2**31 or not isinstance(name, str) or isinstance(key, bool):
            raise McaptrackError(f"{path}: category {number} has no whole number as its id, or no name")
        if key in out:
            raise McaptrackError(f"{path}: {key} is the id of several categories, {out[key]} and {name[:MAX_NAME]}")
        out[key] = " ".join(name.split())[:MAX_NAME]
    return out


# Annotations of a channel.


#: Entries that are encoded together, and the number of the video.
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
        names = {number: "unknown" if number == UNKNOWN else name for number, name in boxes.classes.items()}
        categories = [{"id": number, "name": name, "supercategory": ""} for number, name in names.items()]
        yield b', "categories": ' + _bytes(categories)
        yield b', "images": [\n'
        yield from _list(_images(boxes, size))
        yield b'\n], "annotations": [\n'
        yield from _list(_entries(boxes))
        yield b"\n]}\n"


def _images(boxes: ExportedBoxes, size: dict[str, int]) -> Iterator[dict[str, Any]]:
    """All frames, and frame 0 in any case: readers take the first image for the first picture."""
    frames, times = boxes.frames.tolist(), boxes.t_ns.tolist()
    begin = [] if frames[0] == 0 else [(0, None)]
    for frame, t_ns in (*begin, *zip(frames, times, strict=True)):
        image = {"id": frame + 1, _VIDEOS[0]: _VIDEO, _FRAMES[0]: frame, "file_name": f"frame_{frame:06d}.jpg", **size}
        yield image if t_ns is None else image | {"timestamp_ns": t_ns}


def _entries(boxes: ExportedBoxes) -> Iterator[dict[str, Any]]:
    columns = (boxes.frame.tolist(), boxes.id.tolist(), boxes.boxes.tolist(), boxes.class_id.tolist())
    scores, observed = boxes.score, boxes.observed.tolist()
    for row, (frame, track, box, kind) in enumerate(zip(*columns, strict=True)):
        out: dict[str, Any] = {
            "id": row + 1,
            "image_id": frame + 1,
            _VIDEOS[0]: _VIDEO,
            "category_id": kind,
            "bbox": box,
            "area": box[2] * box[3],
            "iscrowd": 0,
        }
        if np.isfinite(scores[row]):
            out["score"] = float(str(scores[row]))
        if boxes.has_ids:
            attributes = {"occluded": not observed[row], _TRACK_IDS[0]: track, _OBSERVED: observed[row]}
            out |= {_TRACK_IDS[1]: track, _TRACK_IDS[0]: track, "attributes": attributes}
        yield out


def _bytes(value: Any) -> bytes:
    return json.dumps(value).encode("utf-8")


def _list(entries: Iterator[dict[str, Any]]) -> Iterator[bytes]:
    """Entries of a JSON list, one a line."""
    before = b""
    while some := list(islice(entries, _ENTRIES)):
        yield before + b",\n".join(map(_bytes, some))
        before = b",\n"
