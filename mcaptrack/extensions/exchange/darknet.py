"""JSON that darknet writes (`detector test ... -out`): objects of pictures, in shares of their size."""

from __future__ import annotations

from collections.abc import Iterator

from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat
from mcaptrack.sources.ingest.labels.format import LabelFile


class Darknet(PictureFormat):
    """Detections with scores."""

    title, is_normalised = "JSON of darknet", True
    row = "a list of pictures: `frame_id`, `filename` and `objects` with `relative_coordinates`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON is a list of pictures with objects."""
        return {"frame_id", "objects"} <= set(file.keys) and isinstance(file.json, list)

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file."""
        for entry in file.json:
            picture = LabelledPicture(str(entry.get("filename") or entry["frame_id"]), [])
            for each in entry["objects"]:
                place = each["relative_coordinates"]
                x, y, width, height = (float(place[key]) for key in ("center_x", "center_y", "width", "height"))
                box, label = (x - width / 2, y - height / 2, width, height), each.get("name") or each["class_id"]
                picture.shapes.append(LabelledShape(box, label, each["confidence"]))
            yield picture
