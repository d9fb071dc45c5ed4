"""Folders of XML of Pascal VOC and of the old LabelMe, a file for each picture, and trees of small XML files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder

from mcaptrack.sources.ingest.bags.plain_yaml import XmlReader
from mcaptrack.sources.ingest.labels.format import LabelFile
from mcaptrack.sources.ingest.labels.pictures import Picture, PictureFormat, Shape, around, files_in

_MAX_DEPTH: Final = 32
#: All of a file is in memory as a tree.
_MAX_BYTES: Final = 64 * 2**20
_ROOT: Final = "annotation"


class _Tree(XmlReader):
    """Builds the tree of an XML file."""

    writer = "Pascal VOC"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._builder, self._depth = TreeBuilder(), 0

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            self.fail("nested deeper than labels are")
        self._builder.start(name, attributes)

    def end(self, name: str) -> None:
        self._depth -= 1
        self._builder.end(name)

    def text(self, text: str) -> None:
        self._builder.data(text)

    def tree(self) -> Element:
        """The first element, with all that is in it. Raises McaptrackError if it isn't valid or too large."""
        if self.path.stat().st_size > _MAX_BYTES:
            self.fail(f"more than {_MAX_BYTES} bytes of XML; give it in parts")
        self.parse([self.path.read_bytes()])
        return self._builder.close()


class Voc(PictureFormat):
    """Files of Pascal VOC, and of LabelMe, which has polygons."""

    name, title = "voc", "Pascal VOC or LabelMe XML"
    row = "a folder of XML, one for each picture: `<annotation>` with an `<object>` and a `<bndbox>` for each box"
    reads_folders = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether it is XML that begins so, or a folder of it."""
        return (_first(file) if file.is_folder else file).root == _ROOT

    def pictures(self, file: LabelFile) -> Iterator[Picture]:
        """The pictures of a file or of a folder."""
        for path in files_in(file.path, ".xml") if file.is_folder else [file.path]:
            root, self.where = _Tree(path).tree(), path.name
            if root.tag != _ROOT:
                raise ValueError(f"it begins with <{root.tag[:40]}>")
            sides = [root.findtext(f"size/{side}") for side in ("width", "height")]
            sides = sides if all(sides) else [root.findtext(f"imagesize/{side}") for side in ("ncols", "nrows")]
            name = root.findtext("filename") or path.name
            picture = Picture(name, [], (sides[0], sides[1]) if all(sides) else None)
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
                picture.shapes.append(Shape(box, each.findtext("name"), each.findtext("score"), _track_of(each)))
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
