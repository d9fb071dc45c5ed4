"""The process of a network: how it is started, asked, watched and ended by the process that needs it; and how it opens
and runs the network itself (``serve``).

It ends with the process that needs it. On the CPU it can open no file once ONNX Runtime is loaded: whatever a network
does, it reads nothing. What it answers is JSON, and arrays lie in memory that both processes see.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import signal
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread
from time import monotonic
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.environment import without
from mcaptrack.extensions.networks import session
from mcaptrack.extensions.networks.session import Device, Facts, Resize, SessionError
from mcaptrack.processes import die_with, resident_bytes

#: What a new process runs: with the path of modules of this one, and nothing from the working folder.
_CODE: Final = (
    "import json, sys; sys.path[:], *given = json.loads(sys.argv[1]); "
    "from mcaptrack.extensions.networks.child import serve; serve(*given)"
)
#: Seconds between two looks at a process that is at work; `ps` tells memory elsewhere than on Linux, and is slow.
_LOOK_S: Final = 0.02 if sys.platform.startswith("linux") else 0.25
#: Seconds that a process gets to start, before it has seen the network.
_START_S: Final = 120.0
#: The most memory that the arrays of one call may take together, in bytes.
_LANE_BYTES: Final = 2**32
#: Longer answers are invalid: answers hold names and shapes.
_LONGEST: Final = 2**24
#: Seconds in which a process that has closed its connection has to be gone.
_GONE_S: Final = 2.0


class NetworkProcess:
    """A network in a process of its own.

    It takes as many calls at a time as it has ``lanes``. A call that takes longer than ``seconds``, or memory beyond
    ``memory_bytes``, ends the process, and so does an interruption of a call; ``failure`` says why it ended. What the
    process takes before it has a network doesn't count.
    """

    def __init__(self, lanes: int, device: Device, memory_bytes: int, seconds: float) -> None:
        """Start the process. Raises SessionError if that fails."""
        self._device: Device = device
        self._memory_bytes, self._seconds = memory_bytes, seconds
        self._most_resident = sys.maxsize
        #: Why the process ended, in words that follow the name of the network; "" while it runs.
        self.failure: SessionError | None = None
        size = min(memory_bytes, _LANE_BYTES)
        path = [os.path.abspath(folder) for folder in sys.path]
        try:
            with ExitStack() as its_ends:
                life, its_life = Pipe()
                its_ends.enter_context(its_life)
                own: list[Lane] = []
                handles: list[tuple[int, int]] = []
                for _ in range(lanes):
                    connection, its_connection = Pipe()
                    its_ends.enter_context(its_connection)
                    memory = _shared_memory(size)
                    its_ends.callback(os.close, memory)
                    own.append(Lane(connection, memory, size))
                    handles.append((its_connection.fileno(), memory))
                self._process = subprocess.Popen(
                    [sys.executable, "-I", "-c", _CODE, json.dumps([path, its_life.fileno(), handles, size, device])],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    cwd="/",  # relative names lead nowhere
                    env=without("ORT_LOAD_CONFIG_FROM_MODEL"),  # a network must not set options of ONNX Runtime
                    pass_fds=[its_life.fileno(), *(handle for pair in handles for handle in pair)],
                    process_group=0,  # Ctrl-C at the terminal is for this process, which ends the other
                )
        except OSError as error:
            raise SessionError(f"can't be run: no process can be started for it ({error.strerror or error})") from None
        self._life = life  # the other process ends when this is closed
        self._finalizer = weakref.finalize(self, _end, self._process)
        self._free: SimpleQueue[Lane] = SimpleQueue()
        self._answer(own[0], _START_S)
        self._base = resident_bytes(self._process.pid)
        for lane in own:
            self._free.put(lane)

    def open(self, data: bytes, resize: Resize | None = None) -> Facts:
        """Open a network, instead of the one before. Raises SessionError."""
        # Beside what the network takes, its file is there, as it came and as ONNX Runtime reads it.
        self._most_resident = self._base + self._memory_bytes + 2 * len(data)
        request = {"device": self._device, "memory_bytes": self._memory_bytes, "resize": resize}
        facts: Facts = self._ask({}, request, data)[0]["facts"]
        for values in (facts["inputs"], facts["outputs"]):
            values[:] = [(name, shape, kind) for name, shape, kind in values]  # which are lists in JSON
        facts["sizes"] = {name: (width, height) for name, (width, height) in facts["sizes"].items()}
        return facts

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """The outputs, in order. Raises SessionError."""
        return self._ask(inputs)[1]

    def end(self, failure: SessionError) -> None:
        """End the process, and the calls that it is at work on."""
        self.failure = self.failure or failure
        self._finalizer()

    def _ask(
        self, inputs: Mapping[str, NDArray[Any]], request: dict[str, Any] | None = None, data: bytes = b""
    ) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        lane = self._free.get()
        try:
            if request is None:
                request = {"inputs": lane.write(dict(inputs))}
            with suppress(OSError):  # it has ended, which the answer tells
                lane.connection.send_bytes(json.dumps(request).encode())
                if "inputs" not in request:
                    lane.connection.send_bytes(data)
            reply = self._answer(lane, self._seconds)
            if "error" in reply:
                raise SessionError(reply["error"], reply["limit"])
            return reply, [values.copy() for values in lane.read(reply.get("outputs", [])).values()]
        except MemoryError:
            raise SessionError("", "memory") from None
        finally:
            self._free.put(lane)

    def _answer(self, lane: Lane, seconds: float) -> dict[str, Any]:
        """Wait for the answer to a request, and see that limits are kept."""
        deadline = monotonic() + seconds
        try:
            while not lane.connection.poll(_LOOK_S):
                if resident_bytes(self._process.pid) > self._most_resident:
                    self.end(SessionError("", "memory"))
                elif monotonic() > deadline:
                    self.end(SessionError("", "time"))
            reply: dict[str, Any] = json.loads(lane.connection.recv_bytes(_LONGEST))
            return reply
        except (EOFError, OSError):
            self.end(self._died())
            assert self.failure is not None
            raise self.failure from None
        except BaseException:  # an interruption: the answer would be taken for that to the next request
            self.end(SessionError("was interrupted"))
            raise

    def _died(self) -> SessionError:
        code: int | None = None
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_GONE_S)
        how = "closed its connection" if code is None else f"exited with code {code}"
        if code is not None and code < 0:
            how = f"was ended by signal {-code}"
            with suppress(ValueError):
                how = f"was ended by {signal.Signals(-code).name}"
        return SessionError(f"can't be run: the process that ran it {how}")


def _shared_memory(size: int) -> int:
    """A handle of memory of ``size`` bytes, of which those that are written take room."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("mcaptrack")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    try:
        os.ftruncate(handle, size)
    except OSError:  # larger than a file may be here
        os.close(handle)
        raise
    return handle


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


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
        except SessionError as error:
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
