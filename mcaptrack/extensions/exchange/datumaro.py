"""JSON of datumaro: `items` with annotations of pictures, and `categories`."""

from __future__ import annotations

from collections.abc import Iterator

from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, around
from mcaptrack.sources.ingest.labels.format import LabelFile


class Datumaro(PictureFormat):
    """Boxes, and those around polygons."""

    title = "datumaro"
    row = "JSON with `items` of pictures, their `annotations`, and `categories`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON has items and categories."""
        return {"items", "categories"} <= set(file.keys) and isinstance(file.json, dict)

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file."""
        content = file.json
        entries = content["categories"].get("label", {}).get("labels", [])
        labels = {f"label_id {number}": entry["name"] for number, entry in enumerate(entries)}
        for item in content["items"]:
            height, width = (item.get("image") or {}).get("size") or (None, None)
            picture = LabelledPicture(str(item["id"]), [], (width, height) if width else None)
            for each in item["annotations"]:
                more, number = each.get("attributes") or {}, each.get("label_id")
                if each["type"] == "bbox":
                    box = each["bbox"]
                elif each["type"] == "polygon":
                    box = around(each["points"])
                else:
                    picture.other[str(each["type"])] += 1
                    continue
                label = None if number is None else labels[f"label_id {number}"]
                picture.shapes.append(LabelledShape(box, label, more.get("score"), more.get("track_id")))
            yield picture
