"""COCO: annotations (images, annotations, categories), and results (image_id, category_id, bbox, score).

Letters: N rows, F frames.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.masks import box_of_mask
from mcaptrack.sources.ingest.labels.table import NO_CLASS, NO_ID, NOTHING, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import FrameNames, TrackIds, as_float, is_count, is_number, numbers_of_names

_MAX_ROWS: Final = 10_000_000
_MAX_CLASSES: Final = 65536
_MAX_NAME: Final = 256
#: Keys of the track id of an annotation, and of the frame of an image.
_TRACK_IDS: Final = ("track_id", "instance_id", "tracker_id")
_FRAMES: Final = ("frame_id", "frame_index", "mot_frame_id")
_VIDEOS: Final = ("video_id", "vid_id")
_BY_LIST: Final = "the list `images`"
#: Numbers of a row: frame, left, top, width, height, score, category, id, whether it is a crowd, and was filled in.
_COLUMNS: Final = 10


class Coco(Format):
    """Annotations or results, as the content tells."""

    title = "COCO"
    row = "JSON with `images`, `annotations` and `categories`; or results: `image_id`, `category_id`, `bbox`, `score`"

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
        table = _annotations(path, content)
        table.facts.names = _categories(path, content.get("categories"))
        table.facts.named_by = "file" if table.facts.names else ""
        return table


class _Rows:
    """The numbers of boxes; ``kind`` names one of them in messages."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind, self._values = path, kind, array("d")
        self._texts = TrackIds()
        self.outlined, self.masks = 0, 0

    def add(self, number: int, entry: Any, frame_of: Callable[[Any], float]) -> None:
        """Add an annotation or a result. Raises McaptrackError if something is missing or of the wrong type."""
        if not isinstance(entry, dict):
            self.refuse(number, "is not an object")
        box = entry.get("bbox")
        if box is None or box == []:
            box = self._around(number, entry.get("segmentation"))
        if not isinstance(box, list) or len(box) != 4 or not all(map(is_number, box)):
            self.refuse(number, "has no bbox of 4 numbers: left, top, width, height")
        inner = entry.get("attributes")
        track_id = next((d[key] for d in (entry, inner) if isinstance(d, dict) for key in _TRACK_IDS if key in d), None)
        category_id = _whole_of_text(entry.get("category_id"))
        track_id = _whole_of_text(track_id)
        if isinstance(track_id, str) and track_id:
            track_id = self._texts.number(track_id[:_MAX_NAME])
        values = [entry.get("score"), category_id, track_id, entry.get("iscrowd", 0)]
        for value, key in zip(values, ("score", "category_id", "track_id", "iscrowd"), strict=True):
            if value is not None and not isinstance(value, bool) and not is_number(value):
                self.refuse(number, f"has a {key} that isn't a number, {value!r:.40}")
        score, category, track_id, crowd = values
        try:
            frame = frame_of(entry.get("image_id"))
        except (ValueError, KeyError, TypeError) as error:
            text = str(error).strip('"')
            self.refuse(number, f"has a wrong image_id: {text}" if "column" in text else text)
        unseen = isinstance(inner, dict) and inner.get("observed") is False
        numbers = (_float(score, math.nan), _float(category, NO_CLASS), _float(track_id, NO_ID))
        self._values.extend((frame, *map(_float, box), *numbers, bool(crowd), unseen))

    def _around(self, number: int, outline: Any) -> list[float] | None:
        """The box around polygons, [x, y, x, y, ...] each; None without any."""
        if isinstance(outline, dict):
            self.masks += 1
            try:
                return box_of_mask(outline)
            except (KeyError, TypeError, ValueError) as error:
                self.refuse(number, f"has no bbox, and a mask that can't be read: {error}")
        flat = [part for part in outline if isinstance(part, list)] if isinstance(outline, list) else []
        points = [value for part in flat for value in part[: len(part) // 2 * 2]]
        if not points or not all(map(is_number, points)):
            return None
        self.outlined += 1
        x, y = ([_float(value) for part in flat for value in part[axis : len(part) // 2 * 2 : 2]] for axis in (0, 1))
        return [min(x), min(y), max(x) - min(x), max(y) - min(y)]

    def refuse(self, number: int, problem: str) -> NoReturn:
        raise McaptrackError(f"{self.at(number)} {problem}")

    def at(self, number: int) -> str:
        return f"{self._path}: {self._kind} {number}"

    def done(self) -> BoxTable:
        """All rows."""
        values: Floats = np.frombuffer(self._values, np.float64).reshape(-1, _COLUMNS)
        frame, score, number, track_id, crowd, unseen = (values[:, at] for at in (0, 5, 6, 7, 8, 9))
        track_id, said = self._texts.of(self._path, track_id)
        rows = BoxTable(
            facts=LabelFacts(self._path, "coco", region="iscrowd"), at=self.at, frame=frame, id=track_id,
            boxes_px=values[:, 1:5], score=score, class_id=number, observed=unseen == 0, remarks=said,
            aside=np.where(crowd != 0, REGION, NOTHING) if crowd.any() else None,
        )  # fmt: skip
        if self.outlined:
            rows.remark(f": {self.outlined} boxes are those around polygons, which have no bbox")
        if self.masks:
            rows.remark(f": {self.masks} boxes are those around masks, which have no bbox")
        return rows


def _whole_of_text(value: Any) -> Any:
    """Return the whole number that a text holds; anything else as it is."""
    return int(value) if isinstance(value, str) and is_count(value, 15) else value


def _float(value: Any, missing: float = math.nan) -> float:
    return missing if value is None else as_float(value)


def _results(path: Path, content: list[Any]) -> BoxTable:
    """Results: a list of image_id, category_id, bbox, score. The number of an image is that of its frame."""
    _check_count(path, content)
    rows, names = _Rows(path, "result"), FrameNames()

    def frame_of(image: Any) -> float:
        if isinstance(image, str):
            return names.number(image)
        if not is_number(image):
            raise ValueError("has no image_id")
        return _float(image)

    for number, entry in enumerate(content):
        rows.add(number, entry, frame_of)
    out = rows.done()
    out.remark(": the number in image_id is taken as the frame")
    return out


def _annotations(path: Path, content: Mapping[str, Any]) -> BoxTable:
    """Annotations: images, annotations and categories."""
    images, entries = content.get("images"), content["annotations"]
    if not isinstance(images, list) or not all(isinstance(image, dict) and "id" in image for image in images):
        raise McaptrackError(f"{path}: `images` is not a list of objects with an id each")
    _check_count(path, entries)
    ids = [_key(image["id"]) for image in images]
    if len(set(ids)) < len(ids):
        twice = Counter(ids).most_common(1)[0][0]
        raise McaptrackError(f"{path}: {twice} is the id of several images")
    videos = {_key(image[key]) for image in images for key in _VIDEOS if key in image}
    if len(videos) > 1:
        raise McaptrackError(f"{path} holds {len(videos)} videos (video_id); give one file for each of them")
    frames, order = _frames(images)
    by_id = dict(zip(ids, frames, strict=True))
    rows = _Rows(path, "annotation")

    def frame_of(image: Any) -> float:
        if _key(image) not in by_id:
            raise ValueError(f"is of image {image!r:.40}, which isn't among the images")
        return by_id[_key(image)]

    for number, entry in enumerate(entries):
        rows.add(number, entry, frame_of)
    out = rows.done()
    facts = out.facts
    is_labelled = np.array([image.get("is_labeled") is not False for image in images], bool)  # PoseTrack
    numbers = np.array(frames, np.int64)
    facts.labelled, facts.states_labelled = np.unique(numbers[is_labelled]), True
    facts.first_frame = int(numbers.min()) if len(numbers) else 0
    facts.is_first_assumed = facts.first_frame > 0
    facts.sizes = {
        frame: (_float(image["width"]), _float(image["height"]))
        for frame, image in zip(frames, images, strict=True)
        if is_number(image.get("width")) and is_number(image.get("height"))
    }
    sizes = {size for size in facts.sizes.values() if all(map(math.isfinite, size))}
    if len(sizes) == 1 and len(facts.sizes) == len(images):
        ((width, height),) = sizes
        facts.size = (int(width), int(height))
    out.remark(f": {len(images)} images, in order of {order}")
    if not is_labelled.all():
        out.remark(f": {int((~is_labelled).sum())} images are not labelled (is_labeled)")
    if order == _BY_LIST and len(images) > 1:
        text = ": its images have neither frame_id nor names with numbers of one sequence; the order in `images`"
        out.find(f"{text} is taken as that of the pictures", "clock")
    return out


def _key(value: Any) -> str:
    """The id of an image or a video as text; 1.0, as pandas writes it, is 1."""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)[:_MAX_NAME]


def _check_count(path: Path, entries: list[Any]) -> None:
    if len(entries) > _MAX_ROWS:
        raise McaptrackError(f"{path} has more than {_MAX_ROWS} boxes; give it in parts")


def _frames(images: list[dict[str, Any]]) -> tuple[list[int], str]:
    """The frame numbers of images, and what they are from: a field, the numbers in names, or the order in the list."""
    for key in _FRAMES:
        values = [image.get(key) for image in images]
        numbers = [number for number in values if isinstance(number, int) and 0 <= number < 2**31]
        if len(numbers) == len(values) and len(set(numbers)) == len(numbers):
            return numbers, key
    names = [name for name in (image.get("file_name") for image in images) if isinstance(name, str)]
    numbered = numbers_of_names(names) if len(names) == len(images) else None
    if numbered is not None:
        return numbered, "the numbers in file_name"
    return list(range(len(images))), _BY_LIST


def _categories(path: Path, categories: Any) -> dict[int, str] | None:
    """Class names by number; None if there are none."""
    if not isinstance(categories, list) or not categories:
        return None
    if len(categories) > _MAX_CLASSES:
        raise McaptrackError(f"{path} has {len(categories)} categories; at most {_MAX_CLASSES} are read")
    out: dict[int, str] = {}
    for number, entry in enumerate(categories):
        key, name = (_whole_of_text(entry.get("id")), entry.get("name")) if isinstance(entry, dict) else (None, None)
        if not isinstance(key, int) or not 0 <= key < 2**31 or not isinstance(name, str) or isinstance(key, bool):
            raise McaptrackError(f"{path}: category {number} has no whole number as its id, or no name")
        if key in out:
            raise McaptrackError(f"{path}: {key} is the id of several categories, {out[key]} and {name[:_MAX_NAME]}")
        out[key] = " ".join(name.split())[:_MAX_NAME]
    return out
