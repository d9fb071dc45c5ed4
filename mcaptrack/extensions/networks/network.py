"""Networks in ONNX format: the one door to them, for whatever needs one.

Whoever wrote the file may be a stranger. So a network runs in a process of its own, which can open no other file, ends
when it takes too much time or memory, and ends with the process that needs it; and a file that keeps weights in others
is refused, wherever in it they are named. Only a file that is trusted, because its digest is known, runs in this
process.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from numpy.typing import NDArray

from mcaptrack import environment
from mcaptrack.errors import McaptrackError, lacks
from mcaptrack.extensions.networks.child import NetworkProcess
from mcaptrack.extensions.networks.session import (
    Device,
    Facts,
    Resize,
    Session,
    SessionError,
    Value,
    is_installed,
    providers,
)
from mcaptrack.files import reading
from mcaptrack.notices import warn

__all__ = [
    "Device",
    "NetworkFile",
    "NetworkLimitError",
    "NetworkLimits",
    "OnnxNetwork",
    "Value",
    "digest_of",
    "providers",
    "read_file",
]

_MEMORY: Final = "MCAPTRACK_MAX_NETWORK_MB"
_TIME: Final = "MCAPTRACK_MAX_NETWORK_S"
#: Unless one of the variables above says otherwise: megabytes, and seconds for one call.
_MEMORY_MB: Final = 1000
_TIME_S: Final = 60


class NetworkLimitError(McaptrackError):
    """A network took more memory or time than it may, and was ended."""


@dataclass(frozen=True)
class NetworkLimits:
    """Limits of a network; its file, which may be as large, does not count.

    Attributes
    ----------
    memory_bytes : int
        Resident memory, in bytes.
    seconds : float
        Time to be opened, and for each call, in seconds.
    setting : str
        What sets the memory, for messages.
    hint : str
        What else helps against too much memory, for messages.

    """

    memory_bytes: int
    seconds: float
    setting: str
    hint: str = ""

    @classmethod
    def of_environment(cls) -> Self:
        """The limits that the environment sets. Raises McaptrackError if it sets no numbers."""
        return cls.with_memory(environment.whole_number(_MEMORY, _MEMORY_MB), _MEMORY)

    @classmethod
    def with_memory(cls, memory_mb: int, setting: str, hint: str = "") -> Self:
        """The time limit of the environment, and a memory limit of the caller in MB."""
        return cls(memory_mb * 1_000_000, environment.whole_number(_TIME, _TIME_S), setting, hint)

    def in_words(self, error: SessionError) -> str:
        """The error as words that follow the name of the network."""
        if error.limit == "memory":
            hint = f"; {self.hint}" if self.hint else ""
            return f"needs more than {self.memory_bytes / 1e6:,.0f} MB of memory; {self.setting} allows more{hint}"
        if error.limit == "time":
            return f"took longer than {self.seconds:g} s and was ended; {_TIME} allows more"
        return str(error)


@dataclass(frozen=True)
class NetworkFile:
    """An ONNX file: its bytes, and their digest.

    ``data`` are the bytes, and ``sha256`` is the digest in hexadecimal.
    """

    path: Path
    data: bytes = field(repr=False, compare=False)
    sha256: str


def digest_of(path: Path) -> str:
    """The SHA-256 of a file. Raises McaptrackError if it can't be read."""
    with reading(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_file(path: Path, limits: NetworkLimits) -> NetworkFile:
    """Read a file, once. Raises McaptrackError if that can't be done, or if it is larger than a network may be.

    ``limits`` are those of the network.
    """
    with reading(path) as file:
        if path.stat().st_size > limits.memory_bytes:
            raise McaptrackError(
                f"{path} holds {path.stat().st_size / 1e6:,.0f} MB; a network may take "
                f"{limits.memory_bytes / 1e6:,.0f} MB ({limits.setting})"
            )
        data = file.read()
    return NetworkFile(path, data, hashlib.sha256(data).hexdigest())


class OnnxNetwork:
    """A network that is ready to run.

    Attributes
    ----------
    facts : Facts
        Its inputs and outputs, and what else its file says.

    """

    facts: Facts

    def __init__(
        self,
        file: NetworkFile,
        limits: NetworkLimits,
        *,
        device: Device = "cpu",
        is_trusted: bool = False,
        lanes: int = 1,
    ) -> None:
        """Open it.

        Parameters
        ----------
        file : NetworkFile
            Its file.
        limits : NetworkLimits
            What it may take. A trusted network is held to the memory that it computes in, and to no time.
        device : {"auto", "cpu", "cuda"}
            Where it runs.
        is_trusted : bool
            Whether it may run in this process.
        lanes : int
            How many calls it takes at a time.

        Raises
        ------
        NetworkLimitError
            If it takes too much memory or time.
        McaptrackError
            If it can't be opened, or reaches out of its file; if ONNX Runtime is not installed.

        """
        self._file, self._limits, self._device = file, limits, device
        self._session: Session | NetworkProcess | None = None
        if not is_installed():
            raise McaptrackError(lacks(str(file.path), "ONNX Runtime", "onnx"))
        with self._blamed():
            if _runs_apart(is_trusted):
                self._session = NetworkProcess(lanes, device, limits.memory_bytes, limits.seconds)
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        if self.facts["is_without_gpu"]:
            warn("ONNX Runtime has CUDA but can't use it here; detecting on the CPU", "device")

    def open(self, resize: Resize | None = None) -> None:
        """Open it again, for pictures of another size. Raises as at first."""
        with self._blamed():
            if isinstance(self._session, NetworkProcess):
                self.facts = self._session.open(self._file.data, resize)
            else:
                self._session = Session(self._file.data, self._device, self._limits.memory_bytes, resize)
                self.facts = self._session.facts

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """The outputs for inputs by name, in order; one that holds no numbers is empty, of type object.

        Several threads may call this. Raises NetworkLimitError if that takes too much memory or time, and
        McaptrackError if it fails. After a call that ended its process, all calls fail.
        """
        assert self._session is not None
        with self._blamed():
            return self._session.run(inputs)

    def close(self) -> None:
        """End it, and the calls that it is at work on."""
        if isinstance(self._session, NetworkProcess):
            self._session.end(SessionError("was ended"))

    @contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            yield
        except SessionError as error:
            kind = NetworkLimitError if error.limit else McaptrackError
            if error.limit:
                self.close()
            raise kind(f"{self._file.path} {self._limits.in_words(error)}") from None


def _runs_apart(is_trusted: bool) -> bool:
    """Whether a network runs in a process of its own."""
    return not is_trusted
