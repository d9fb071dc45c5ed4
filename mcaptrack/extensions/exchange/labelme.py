"""Folders of JSON of labelme, one file for each picture."""

from __future__ import annotations

from collections.abc import Iterator

from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, around, files_in
from mcaptrack.sources.ingest.labels.format import LabelFile


class Labelme(PictureFormat):
    """Rectangles and polygons; a group_id is no track."""

    title = "labelme"
    row = "a folder of JSON, one for each picture: `shapes` with `label`, `points` and `shape_type`"
    reads_folders = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether it is JSON with shapes, or a folder of it."""
        if file.is_folder:
            file = next((LabelFile(path) for path in file.entries if path.suffix.lower() == ".json"), file)
        return not file.is_folder and {"shapes", "imagePath"} <= set(file.keys)

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file or of a folder."""
        for path in files_in(file.path, ".json") if file.is_folder else [file.path]:
            self.where, content = path.name, LabelFile(path).json
            sides = content.get("imageWidth"), content.get("imageHeight")
            name = str(content.get("imagePath") or path.name)
            picture = LabelledPicture(name, [], sides if all(sides) else None)
            for each in content["shapes"]:
                kind = each.get("shape_type", "polygon")
                if kind in ("rectangle", "polygon", "rotation"):
                    picture.shapes.append(LabelledShape(around(each["points"]), each["label"], each.get("score")))
                else:
                    picture.other[str(kind)] += 1
            yield picture
