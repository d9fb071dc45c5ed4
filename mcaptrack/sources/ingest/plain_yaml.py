"""Read untrusted YAML as plain data: scalars, lists and maps, within limits.

Aliases, tags and directives are refused, so that a small file can't expand to a large one. Scalars stay text; the
reader of a field determines its type.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Final, NoReturn
from xml.parsers import expat

from mcaptrack.errors import McaptrackError, in_one_line

#: Larger than the metadata of a recording with thousands of topics and files.
MAX_BYTES: Final = 8 * 2**20
_MAX_VALUES: Final = 500_000
_MAX_DEPTH: Final = 32
_NULL: Final = ("", "~", "null", "Null", "NULL")
_WHOLE: Final = re.compile(r"\d{1,19}", re.ASCII)
_DIRECTIVE: Final = re.compile(rb"^%", re.MULTILINE)


class UnsupportedYamlError(ValueError):
    """Invalid YAML, or features that are not supported; the message says where and why."""


def load(data: bytes, tags: Collection[str] = ()) -> Any:
    """The only document of ``data``: text, a list, or a dict with text as its keys.

    Values may have these tags, which change nothing. Raises UnsupportedYamlError.
    """
    import yaml

    if len(data) > MAX_BYTES:
        raise UnsupportedYamlError(f"it has {len(data)} bytes; at most {MAX_BYTES} are read")
    if _DIRECTIVE.search(data):
        raise UnsupportedYamlError("it has a line that begins with %; directives are not read")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnsupportedYamlError(f"byte {error.start} is no UTF-8") from None
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _build(yaml, yaml.parse(text, Loader=loader), tags)
    except yaml.YAMLError as error:
        raise UnsupportedYamlError(in_one_line(error)) from None


def _build(yaml: Any, events: Iterator[Any], tags: Collection[str]) -> Any:
    """Build the value from parser events, in one loop, because deep nesting must not use the stack."""
    documents: list[Any] = []
    open_values: list[tuple[Any, list[str]]] = [(documents, [])]  # each with the key of the next value
    for number, event in enumerate(events):
        where = f"line {event.start_mark.line + 1}"
        if number > _MAX_VALUES:
            raise UnsupportedYamlError(f"{where}: it has more than {_MAX_VALUES} values")
        if getattr(event, "anchor", None) is not None:
            raise UnsupportedYamlError(f"{where}: anchors and aliases are not read")
        if getattr(event, "tag", None) not in (None, "!", *tags):
            raise UnsupportedYamlError(f"{where}: tags are not read")
        value: Any
        if isinstance(event, yaml.ScalarEvent):
            value = event.value
        elif isinstance(event, yaml.SequenceStartEvent):
            value = []
        elif isinstance(event, yaml.MappingStartEvent):
            value = {}
        else:
            if isinstance(event, yaml.CollectionEndEvent):
                open_values.pop()
            continue
        parent, keys = open_values[-1]
        if isinstance(parent, list):
            parent.append(value)
        elif keys:
            parent[keys.pop()] = value
        elif not isinstance(value, str):
            raise UnsupportedYamlError(f"{where}: a list or a map is a key")
        elif value in parent:
            raise UnsupportedYamlError(f"{where}: {value[:40]!r} is there twice")
        else:
            keys.append(value)
        if not isinstance(value, str):
            open_values.append((value, []))
            if len(open_values) > _MAX_DEPTH:
                raise UnsupportedYamlError(f"{where}: it is nested more than {_MAX_DEPTH} deep")
    if len(documents) != 1:
        raise UnsupportedYamlError(f"it holds {len(documents)} documents, not one")
    return documents[0]


#: The kinds of values that fields may have, in words; whole numbers are from 0 to 2^63 - 1.
_KINDS: Final = {str: "text", int: "a whole number", list: "a list", dict: "a map"}


def field(fields: Any, name: str, kind: type, default: Any = None) -> Any:
    """The value of a field of a map, of this kind; ``default``, if there is one, for an empty or missing field.

    Raises UnsupportedYamlError, with the field and what it is, for another kind.
    """
    value = fields.get(name) if isinstance(fields, dict) else None
    if default is not None and (value is None or (isinstance(value, str) and value in _NULL)):
        return default
    if kind is int and isinstance(value, str) and _WHOLE.fullmatch(value) and int(value) < 2**63:
        return int(value)
    if kind is int or not isinstance(value, kind):
        stated = "missing" if value is None else repr(value[:40]) if isinstance(value, str) else _KINDS[type(value)]
        raise UnsupportedYamlError(f"{name} is {stated}, not {_KINDS[kind]}")
    return value


# XML that others wrote, read piece by piece without document types, which may hold entities.


class XmlReader:
    """Base of readers of XML: a subclass takes elements and texts. ``writer`` is the program that writes the files."""

    writer: ClassVar[str]

    def __init__(self, path: Path) -> None:
        self.path = path
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._parser.StartElementHandler = self.start
        self._parser.EndElementHandler = self.end
        self._parser.CharacterDataHandler = self.text

    @property
    def line(self) -> int:
        """The number of the line that is read."""
        return self._parser.CurrentLineNumber

    def parse(self, pieces: Iterable[bytes]) -> None:
        """Read all of the XML. Raises McaptrackError, with the line, if it isn't valid or has an unknown encoding."""
        try:
            for piece in pieces:
                self._parser.Parse(piece, False)
            self._parser.Parse(b"", True)
        except expat.ExpatError as error:
            why = expat.ErrorString(error.code)
            raise McaptrackError(f"{self.path}:{error.lineno}: not valid XML: {why}") from None
        except (LookupError, ValueError) as error:  # of encodings that expat doesn't know
            self.fail(f"not read: {error}")

    def fail(self, problem: str) -> NoReturn:
        """Raise McaptrackError, with the line that is read."""
        raise McaptrackError(f"{self.path}:{self.line}: {problem}") from None

    def _refuse_doctype(self, *_: object) -> NoReturn:
        self.fail(f"a document type, which {self.writer} doesn't write; it may hold entities, and isn't read")

    def start(self, name: str, attributes: dict[str, str]) -> None:
        """Take the beginning of an element."""
        raise NotImplementedError

    def end(self, name: str) -> None:
        """Take the end of an element."""
        raise NotImplementedError

    def text(self, text: str) -> None:
        """Take some text of an element."""
        raise NotImplementedError
