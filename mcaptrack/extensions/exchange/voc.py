"""Folders of XML of Pascal VOC and of the old LabelMe, a file for each picture, and trees of small XML files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError, fromstring

from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, around, files_in
from mcaptrack.sources.ingest.decompression import opened
from mcaptrack.sources.ingest.labels.format import LabelFile

#: All of a file is in memory as a tree.
_MAX_BYTES: Final = 64 * 2**20
_ROOT: Final = "annotation"


def _tree(path: Path) -> Element:
    """The first element of XML, with all that is in it. Raises ValueError if it is too large or invalid, or has a
    document type, which may hold entities.
    """
    with opened(path) as stream:
        text = stream.read(_MAX_BYTES + 1).decode("utf-8-sig")  # no other encoding, which may hide what it holds
    if len(text) > _MAX_BYTES or "<!DOCTYPE" in text:
        raise ValueError(f"more than {_MAX_BYTES} bytes, or a document type, which isn't read")
    try:
        return fromstring(text)  # noqa: S314 without a document type it is harmless
    except ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


class Voc(PictureFormat):
    """Files of Pascal VOC, and of LabelMe, which has polygons."""

    title = "Pascal VOC or LabelMe XML"
    row = "a folder of XML, one for each picture: `<annotation>` with an `<object>` and a `<bndbox>` for each box"
    rank = -1
    reads_folders = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether it is XML that begins so, or a folder of it."""
        return (_first(file) if file.is_folder else file).root == _ROOT

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file or of a folder."""
        for path in files_in(file.path, ".xml") if file.is_folder else [file.path]:
            self.where = path.name
            root = _tree(path)
            if root.tag != _ROOT:
                raise ValueError(f"it begins with <{root.tag[:40]}>")
            sides = [root.findtext(f"size/{side}") for side in ("width", "height")]
            sides = sides if all(sides) else [root.findtext(f"imagesize/{side}") for side in ("ncols", "nrows")]
            name = root.findtext("filename") or path.name
            picture = LabelledPicture(name, [], (sides[0], sides[1]) if all(sides) else None)
            for each in root.iterfind("object"):
                corners = [each.findtext(f"bndbox/{key}") for key in ("xmin", "ymin", "xmax", "ymax")]
                points = [[point.findtext("x"), point.findtext("y")] for point in each.iterfind("polygon/pt")]
                if each.findtext("deleted") == "1" or not (points or any(corners)):
                    picture.other.update([each.findtext("type") or "without a box"])
                    continue
                if points:
                    box = around(points)
                else:
                    left, top, right, bottom = (float(end or "") for end in corners)
                    box = [left, top, right - left, bottom - top]
                picture.shapes.append(
                    LabelledShape(box, each.findtext("name"), each.findtext("score"), _track_of(each))
                )
            yield picture


def _first(folder: LabelFile) -> LabelFile:
    """The first XML file of a folder; the folder if there is none."""
    return next((LabelFile(path) for path in folder.entries if path.suffix.lower() == ".xml"), folder)


def _track_of(each: Element) -> str | None:
    """The id of the track, if the attributes name one."""
    named = {entry.findtext("name"): entry.findtext("value") for entry in each.iterfind("attributes/attribute")}
    pairs = (part.partition("=") for part in (each.findtext("attributes") or "").split(","))
    named |= {key.strip(): value.strip() for key, _, value in pairs}
    return named.get("track_id")
