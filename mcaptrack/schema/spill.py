"""A temporary file for what is computed and takes more room than memory."""

from __future__ import annotations

import os
import tempfile
import weakref
from typing import NamedTuple

from mcaptrack.errors import McaptrackError


class Stored(NamedTuple):
    """Bytes in a ``SpillFile``: their place and size there, and their size before compression."""

    at: int
    stored: int
    size: int


class SpillFile:
    """A temporary file without a name, made when it is needed, with blocks of compressed bytes.

    It disappears with this object, or with the process.
    """

    def __init__(self) -> None:
        self._handle: int | None = None
        self._end = 0

    def put(self, data: bytes | memoryview) -> Stored:
        """Append bytes. Raises McaptrackError if there is no room for them."""
        import lz4.block

        packed = lz4.block.compress(data, store_size=False)
        try:
            if self._handle is None:
                with tempfile.TemporaryFile(prefix="mcaptrack-") as file:
                    self._handle = os.dup(file.fileno())
                weakref.finalize(self, os.close, self._handle)
            done = 0
            while done < len(packed):
                done += os.pwrite(self._handle, packed[done:], self._end + done)
        except OSError as error:
            raise McaptrackError(
                f"{tempfile.gettempdir()} takes no more of what is computed ({error.strerror or error}), which needs "
                "more room than memory; the variable TMPDIR names another folder"
            ) from error
        stored = Stored(self._end, len(packed), memoryview(data).nbytes)
        self._end += len(packed)
        return stored

    def get(self, place: Stored) -> bytes:
        """Bytes that were put."""
        import lz4.block

        assert self._handle is not None
        packed = b""
        while len(packed) < place.stored:
            more = os.pread(self._handle, place.stored - len(packed), place.at + len(packed))
            if not more:
                raise McaptrackError(f"a temporary file in {tempfile.gettempdir()} was made shorter by another process")
            packed += more
        data: bytes = lz4.block.decompress(packed, uncompressed_size=place.size)
        return data
