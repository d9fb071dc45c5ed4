"""XML that others wrote, read piece by piece without document types, which may hold entities."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, NoReturn
from xml.parsers import expat

from mcaptrack.errors import McaptrackError


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
