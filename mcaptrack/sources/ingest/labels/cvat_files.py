"""The XML of annotations of CVAT: a file, or one in a zip file, at its top or in a folder.

Nothing is extracted: a member of a zip file is read as a stream, whatever its name is.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special

_ZIP: Final = b"PK\x03\x04"
#: A zip file without members.
_EMPTY_ZIP: Final = b"PK\x05\x06"
_MEMBER: Final = "annotations.xml"
_SHOWN: Final = 5


def is_cvat(path: Path) -> bool:
    """Whether a file is XML, or a zip file: of label files, only those of CVAT are."""
    refuse_special(path)
    head = read_beginning(path, 4096)
    return head.startswith((_ZIP, _EMPTY_ZIP)) or head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"<"


@contextmanager
def opened_xml(path: Path) -> Iterator[IO[bytes]]:
    """The XML of a file or of a zip file. Raises McaptrackError if it can't be read, or if there is none or several."""
    try:
        with path.open("rb") as stream:
            if stream.read(4) not in (_ZIP, _EMPTY_ZIP):
                stream.seek(0)
                yield stream
                return
        with zipfile.ZipFile(path) as archive, archive.open(_member(path, archive.namelist())) as member:
            yield member
    except (zipfile.BadZipFile, zlib.error, KeyError, NotImplementedError, RuntimeError, EOFError) as error:
        raise McaptrackError(f"{path} is a zip file with an {_MEMBER} that can't be read: {error}") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror or error}") from None


def _member(path: Path, names: list[str]) -> str:
    """The name of the only member with annotations. Raises McaptrackError if there is none, or if there are several."""
    found = [name for name in names if name.replace("\\", "/").rsplit("/", 1)[-1] == _MEMBER]
    if len(found) == 1:
        return found[0]
    if found:
        raise McaptrackError(f"{path} holds {len(found)} of {_MEMBER}; give each as a file ({_listed(found)})")
    there = f"it holds {_listed(names)}" if names else "it is empty"
    raise McaptrackError(f"{path} is a zip file without the {_MEMBER} of CVAT: {there}; unpack other formats")


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(name[:60] for name in names[:_SHOWN]) + more
