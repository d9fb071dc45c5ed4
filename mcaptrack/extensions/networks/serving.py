"""The process of a network, from its own side: it opens a network and runs it, for the process that started it.

It ends with that process. On the CPU it can open no file once ONNX Runtime is loaded: whatever a network does, it reads
nothing. What it answers is JSON, and arrays lie in memory that both processes see.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import signal
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.extensions.networks import session
from mcaptrack.processes import die_with

#: Arrays begin at multiples of so many bytes.
_ALIGN: Final = 64
#: The network y = x. Opening it loads what ONNX Runtime loads only when it is needed.
_FIRST: Final = bytes.fromhex(
    "08083a3b0a100a017812017922084964656e746974791205677261706"
    "85a0f0a0178120a0a08080112040a020801620f0a0179120a0a08080112040a0208014202100d"
)


class Lane:
    """A connection, and memory for the arrays of one call at a time."""

    def __init__(self, connection: Connection[Any, Any], memory_handle: int, size: int) -> None:
        self.connection = connection
        self._memory = mmap.mmap(memory_handle, size)

    def write(self, arrays: dict[str, NDArray[Any]], begin: int = 0) -> list[list[Any]]:
        """Write arrays from a place on: name, type, shape, place of each. Raises MemoryError if they don't fit."""
        written = []
        for name, array in arrays.items():
            values = np.ascontiguousarray(array).reshape(array.shape)
            place = -(-begin // _ALIGN) * _ALIGN
            begin = place + values.nbytes
            if begin > len(self._memory):
                raise MemoryError
            if values.nbytes:
                self._view(values.dtype, values.shape, place)[...] = values
            written.append([name, values.dtype.str, values.shape, place])
        return written

    def read(self, written: list[list[Any]]) -> dict[str, NDArray[Any]]:
        """The arrays that were written, in the memory itself. Raises ValueError if they can't lie there."""
        return {name: self._view(np.dtype(kind), tuple(shape), place) for name, kind, shape, place in written}

    def _view(self, kind: np.dtype[Any], shape: tuple[int, ...], place: int) -> NDArray[Any]:
        if kind.kind == "O":
            return np.empty(0, object)
        return np.ndarray(shape, kind, self._memory, place)


def serve(life: int, lanes: list[tuple[int, int]], size: int, device: session.Device) -> None:
    """Answer on all lanes (a connection and a memory of ``size`` bytes each) until the other process ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the other process ends this one
    die_with(life)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    opened = _Opened()
    own = [Lane(Connection(connection), memory, size) for connection, memory in lanes]
    if not session.uses_gpu(device):  # drivers of GPUs open files whenever they like
        session.Session(_FIRST, "cpu", size).run({"x": np.zeros(1, np.float32)})
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    for lane in own[1:]:
        Thread(target=opened.answer, args=(lane,), daemon=True).start()
    own[0].connection.send_bytes(b"{}")  # ready
    opened.answer(own[0])


class _Opened:
    """The network that is open, if one is."""

    _session: session.Session

    def answer(self, lane: Lane) -> None:
        """Answer requests on a lane; when there are no more, end the process."""
        try:
            while True:
                request = json.loads(lane.connection.recv_bytes())
                lane.connection.send_bytes(json.dumps(self._reply(lane, request)).encode())
        finally:
            os._exit(0)

    def _reply(self, lane: Lane, request: dict[str, Any]) -> dict[str, Any]:
        try:
            if "inputs" in request:
                return {"outputs": self._run(lane, request["inputs"])}
            resize = request["resize"]
            data = lane.connection.recv_bytes()
            resize = resize and (resize[0], tuple(resize[1]), tuple(resize[2]))
            self._session = session.Session(data, request["device"], request["memory_bytes"], resize)
            return {"facts": self._session.facts}
        except session.SessionError as error:
            return {"error": str(error), "limit": error.limit}
        except MemoryError:
            return {"error": "", "limit": "memory"}
        except Exception as error:  # the network is odd, and not the process
            return {"error": f"can't be run: {type(error).__name__}: {error}"[:200], "limit": ""}

    def _run(self, lane: Lane, written: list[list[Any]]) -> list[list[Any]]:
        inputs = lane.read(written)
        outputs = self._session.run(inputs)
        names = [name for name, _, _ in self._session.facts["outputs"]]
        end = max((place + inputs[name].nbytes for name, _, _, place in written), default=0)
        return lane.write(dict(zip(names, outputs, strict=True)), end)
