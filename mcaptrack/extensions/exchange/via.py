"""VGG Image Annotator 1 and 2: JSON with `regions` of pictures, its projects, and CSV with JSON in cells."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, around
from mcaptrack.sources.ingest.labels.format import LabelFile

_PROJECT: Final = "_via_img_metadata"
_CELLS: Final = ("region_shape_attributes", "region_attributes")
#: Attributes that hold a class, and those that hold a track; others do if a region has one alone.
_CLASSES: Final = ("class", "label", "label_id", "category", "name", "type", "object")
_TRACKS: Final = ("track_id", "track", "id")


class Via(PictureFormat):
    """Rectangles and polygons of pictures."""

    title = "VIA"
    row = "JSON of pictures with `filename` and `regions`, or CSV with `region_shape_attributes`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON has regions of pictures, or a table the columns of VIA."""
        if not file.is_json:
            return all(name in file.row for name in _CELLS)
        pictures = _pictures(file.json) if file.keys else []
        return bool(pictures) and isinstance(pictures[0], dict) and {"filename", "regions"} <= set(pictures[0])

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file."""
        if file.is_json:
            for entry in _pictures(file.json):
                regions = entry["regions"]
                regions = [*regions.values()] if isinstance(regions, dict) else regions
                shapes = ((each["shape_attributes"], each["region_attributes"]) for each in regions)
                yield _picture(entry["filename"], shapes)
            return
        by_name: dict[str, list[tuple[Any, Any]]] = {}
        for row in csv.DictReader(line for _, line in file.lines()):
            shape, more = (json.loads(row[name] or "{}") for name in _CELLS)
            by_name.setdefault(row["filename"].lstrip("#"), []).extend([(shape, more)] if shape else [])
        for name, regions in by_name.items():
            yield _picture(name, iter(regions))


def _pictures(content: Any) -> list[Any]:
    """The entries of pictures."""
    content = content.get(_PROJECT, content) if isinstance(content, dict) else content
    return [*content.values()] if isinstance(content, dict) else content


def _picture(name: str, regions: Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> LabelledPicture:
    picture = LabelledPicture(name, [])
    for shape, more in regions:
        if shape["name"] == "rect":
            box = [shape[key] for key in ("x", "y", "width", "height")]
        elif shape["name"] in ("polygon", "polyline"):
            box = around([*zip(shape["all_points_x"], shape["all_points_y"], strict=True)])
        else:
            picture.other[str(shape["name"])] += 1
            continue
        track = next((more[key] for key in _TRACKS if key in more), None)
        others = [value for key, value in more.items() if key not in _TRACKS]
        label = next((more[key] for key in _CLASSES if key in more), others[0] if len(others) == 1 else None)
        if isinstance(label, dict):  # boxes to tick: {"person": true}
            label = next((key for key, is_set in label.items() if is_set), None)
        picture.shapes.append(LabelledShape(box, label, None, track))
    return picture
