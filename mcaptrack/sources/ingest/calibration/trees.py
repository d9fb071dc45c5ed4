"""Read XML, YAML and JSON of calibrations as plain trees: maps, lists and text, within limits.

OpenCV's FileStorage is XML below ``<opencv_storage>``, YAML that begins with ``%YAML:1.0`` and has matrices tagged as
``!!opencv-matrix``, or JSON; ROS and Kalibr write plain YAML. Document types, entities and other tags are refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final, NoReturn
from xml.parsers import expat

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special
from mcaptrack.sources.ingest.bags.plain_yaml import Scalar, UnsupportedYamlError, load

#: The root of OpenCV's XML.
_ROOT: Final = "opencv_storage"
_MAX_BYTES: Final = 2**20
_MAX_DEPTH: Final = 16
_MAX_NODES: Final = 20_000
#: OpenCV's tags; what they hold says what it is, too.
_TAGS: Final = tuple(f"tag:yaml.org,2002:opencv-{kind}" for kind in ("matrix", "nd-matrix"))
#: The first line of OpenCV's YAML, which YAML itself doesn't allow, and the line that ends a document.
_HEAD: Final = re.compile(rb"\A(\xef\xbb\xbf)?%YAML[: ]1\.[0-9][^\n]*\n")
_END: Final = re.compile(rb"\n---[ \t\r\n]*\Z")
#: What tells a calibration from labels: a word that it has, within its first bytes.
_WORDS: Final = re.compile(
    rb"<opencv_storage|%YAML:1\.|camera_matrix|distortion_model|distortion_coefficients|opencv-matrix", re.IGNORECASE
)
_BEGIN: Final = 4096


def is_calibration(path: Path) -> bool:
    """Return whether a file looks like a calibration of a camera."""
    refuse_special(path)
    if path.is_dir() or path.suffix.lower() not in (".xml", ".yaml", ".yml", ".json", ".txt", ""):
        return False
    head = read_beginning(path, _BEGIN)
    return b"\0" not in head and _WORDS.search(head) is not None


def read_tree(path: Path) -> dict[str, Any]:
    """Return the content of a file: a map of maps, lists and text.

    Raises McaptrackError if it is none, or too large.
    """
    refuse_special(path)
    data = read_beginning(path, _MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise McaptrackError(f"{path} has more than {_MAX_BYTES} bytes; a calibration is a small file")
    if not data.strip():
        raise McaptrackError(f"{path} is empty; a calibration is XML or YAML of OpenCV, ROS or Kalibr")
    if data.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"<":
        return _Xml(path).read(data)
    try:
        tree = load(_END.sub(b"\n", _HEAD.sub(b"", data)), _TAGS)
    except UnsupportedYamlError as error:
        raise McaptrackError(f"{path} can't be read as YAML: {error}") from None
    if not isinstance(tree, dict):
        raise McaptrackError(
            f"{path} holds no calibration: that is a map with names such as camera_matrix; a homography of 3 x 3 "
            "numbers is given with `ground_plane=`"
        )
    return tree


class _Xml:
    """Reads OpenCV's XML: elements with elements become maps (or lists, if they are named ``_``), others text."""

    def __init__(self, path: Path) -> None:
        self._path, self._nodes = path, 0
        self._open: list[tuple[str, list[tuple[str, Any]], list[str]]] = [("", [], [])]
        self._reader = expat.ParserCreate()
        self._reader.buffer_text = True
        self._reader.StartDoctypeDeclHandler = self._refuse_doctype
        self._reader.StartElementHandler = self._start
        self._reader.EndElementHandler = self._end
        self._reader.CharacterDataHandler = self._text

    def read(self, data: bytes) -> dict[str, Any]:
        try:
            self._reader.Parse(data, True)
        except expat.ExpatError as error:
            why = expat.ErrorString(error.code)
            raise McaptrackError(f"{self._path}:{error.lineno}: not valid XML: {why}") from None
        ((name, tree),) = self._open[0][1]
        if name != _ROOT:
            raise McaptrackError(f"{self._path} is XML of <{name:.40}>; calibrations of OpenCV are of <{_ROOT}>")
        return tree if isinstance(tree, dict) else {}

    def _fail(self, words: str) -> NoReturn:
        raise McaptrackError(f"{self._path}:{self._reader.CurrentLineNumber}: {words}")

    def _refuse_doctype(self, *_: object) -> NoReturn:
        self._fail("a document type, which OpenCV doesn't write; it may hold entities, and isn't read")

    def _start(self, name: str, _: dict[str, str]) -> None:
        self._nodes += 1
        if self._nodes > _MAX_NODES or len(self._open) > _MAX_DEPTH:
            self._fail(f"it has more than {_MAX_NODES} elements, or is nested more than {_MAX_DEPTH} deep")
        self._open.append((name, [], []))

    def _text(self, text: str) -> None:
        self._open[-1][2].append(text)

    def _end(self, name: str) -> None:
        _, inner, text = self._open.pop()
        value: Any = Scalar.of("".join(text).strip().strip('"'), is_plain=True)
        if inner and all(key == "_" for key, _ in inner):
            value = [one for _, one in inner]
        elif inner:
            value = dict(inner)
            if len(value) != len(inner):
                twice = next(key for number, (key, _) in enumerate(inner) if key in dict(inner[:number]))
                self._fail(f"<{twice:.40}> is there twice")
        self._open[-1][1].append((name, value))
