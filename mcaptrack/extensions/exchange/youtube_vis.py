"""Annotations and results of YouTube-VIS and its like: a track with a box, or a mask, for each picture of a video."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.masks import box_of_mask
from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat
from mcaptrack.sources.ingest.labels.format import LabelFile


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
