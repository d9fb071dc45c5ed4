"""Masks as COCO writes them (runs of pixels, RLE), the boxes around them, and the formats of tracks of masks: MOTS, and
YouTube-VIS and its like.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat
from mcaptrack.sources.ingest.labels.format import MAX_LINE, LabelFile

_MAX_PIXELS: Final = 2**31
#: Classes of MOTS; the last one marks regions in which tracks don't count.
_NAMES: Final = {"1": "car", "2": "pedestrian", "10": "DontCare"}


def box_of_mask(mask: Mapping[str, Any]) -> list[float]:
    """The box of left, top, width, height around a mask of ``size`` (height, width) and ``counts``, which are a list,
    or packed in a text. Raises ValueError if it isn't one, KeyError if something lacks.
    """
    (height, width), counts = (int(side) for side in mask["size"]), mask["counts"]
    lengths = np.asarray(_unpacked(counts) if isinstance(counts, str) else counts, np.int64).reshape(-1)
    ends = np.cumsum(lengths)
    is_possible = 0 < height * width <= _MAX_PIXELS and len(ends) and not (lengths < 0).any()
    if not is_possible or ends[-1] > height * width:
        raise ValueError("the runs of a mask don't fit its size")
    first, last = ends[:-1:2], ends[1::2] - 1  # runs alternate, and the first is of what isn't the object
    first, last = (places[: len(last)][last >= first[: len(last)]] for places in (first, last))
    if not len(first):
        return [0.0, 0.0, 0.0, 0.0]
    columns, many = (first // height, last // height), first // height != last // height
    top = 0 if many.any() else (first % height).min()
    bottom = height - 1 if many.any() else (last % height).max()
    left = columns[0].min()
    return [float(left), float(top), float(columns[1].max() + 1 - left), float(bottom + 1 - top)]


def _unpacked(text: str) -> list[int]:
    """The runs in a text: 5 bits in a character, a sixth if more follow; the fourth and later are differences."""
    counts, value, shift = list[int](), 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError("the text of a mask isn't RLE of COCO")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            value -= (1 << shift) if bits & 16 else 0
            counts.append(value + (counts[-2] if len(counts) > 2 else 0))
            value, shift = 0, 0
    return counts


class Mots(PictureFormat):
    """Text of MOTS: boxes are those around the masks."""

    title = "MOTS"
    row = "`frame id class height width rle`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has 6 parts, the last of which is a mask."""
        cells = file.row.split()
        return len(cells) == 6 and all(cell.isdecimal() for cell in cells[:5]) and not cells[5].isdecimal()

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The frames of a file."""
        pictures = dict[str, LabelledPicture]()
        for number, line in file.lines(MAX_LINE):
            self.where = f"line {number}"
            frame, track, kind, height, width, counts = line.split()
            picture = pictures.setdefault(str(int(frame)), LabelledPicture(frame, [], (width, height)))
            box = box_of_mask({"size": (height, width), "counts": counts})
            picture.shapes.append(LabelledShape(box, _NAMES.get(kind, kind), None, track))
        self.where = ""
        yield from pictures.values()


class YoutubeVis(PictureFormat):
    """Tracks of one video."""

    title = "YouTube-VIS"
    row = "JSON with `videos`, `categories`, and `annotations` with `bboxes` or `segmentations` for all pictures"
    rank = -2

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON has annotations, or results, of whole videos."""
        keys, content = set(file.keys), file.json if file.keys else None
        if isinstance(content, list):
            return {"video_id", "segmentations"} <= keys
        tracks = content["annotations"] if content and {"videos", "annotations"} <= keys else None
        return bool(tracks) and isinstance(tracks, list) and bool({"bboxes", "segmentations"} & set(tracks[0]))

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of the video."""
        content: Any = file.json if isinstance(file.json, dict) else {"annotations": file.json}
        tracks = content["annotations"]
        videos = content.get("videos") or [{"id": number} for number in {track["video_id"] for track in tracks}]
        if len(videos) > 1:
            raise McaptrackError(f"{file.path} holds {len(videos)} videos; give one file for each of them")
        video, categories = videos[0], {entry["id"]: entry["name"] for entry in content.get("categories", ())}
        boxes = [track.get("bboxes") or track["segmentations"] for track in tracks]
        count = max(map(len, boxes), default=0)
        names = video.get("file_names") or [str(number) for number in range(count)]
        size = (video["width"], video["height"]) if video.get("width") else None
        pictures = [LabelledPicture(str(name), [], size) for name in names]
        for number, (track, of_pictures) in enumerate(zip(tracks, boxes, strict=True)):
            label = categories.get(track["category_id"], track["category_id"])
            for picture, box in zip(pictures, of_pictures, strict=True):
                if box:
                    sides = box_of_mask(box) if isinstance(box, dict) else box
                    picture.shapes.append(LabelledShape(sides, label, track.get("score"), track.get("id", number)))
        yield from pictures
