"""The laws that hold for every crew, which processes many logs elsewhere."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.fleet import Crew, task_of
from mcaptrack.fleet.worker import Reply, Request, StoppedError
from mcaptrack.registry import blamed, of_type
from mcaptrack.testing.formats import object_entry
from mcaptrack.testing.transforms import LawError, law, same_process

#: Seconds between two beats of work that goes on, and between two looks at it.
_BEAT_S, _LOOK_S = 0.05, 0.5
#: The longest time until work has ended after it was stopped.
_STOPPED_S: Final = 10.0
#: What work does, as the name of its log says, and the state of its reply.
_STATES: Final = {"good": "done", "refused": "failed", "deadly": "killed"}
_ENDLESS: Final = "endless"


def check_crew(crew: Crew, *, patience_s: float = 60.0) -> None:
    """Check a crew against the laws that hold for every one, and stop it.

    The laws: it has places in time; a log that is started gives one reply, with what the function returned in another
    process; a function that fails, or ends its process, costs its own log alone; logs that it is busy with are listed;
    ``stop`` ends what goes on; it leaves the process that it is asked from as it was.

    Parameters
    ----------
    crew : Crew
        The crew. Its workers have to see temporary files of this machine.
    patience_s : float, default 60
        The longest time in seconds to wait for a reply.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    for method in ("start", "running", "lost", "stop"):
        entry = object_entry("crew", crew, method)
    ended: SimpleQueue[tuple[Path, Future[Reply]]] = SimpleQueue()

    def start(log: Path) -> None:
        log.write_text("")
        with blamed(entry, f"can't start {log.name}"):
            request = Request(log, task_of(work, {"caller": os.getpid()}), {})
            crew.start(request, lambda future: ended.put((log, future)))

    with TemporaryDirectory() as folder, same_process(entry.name), law("conforms"):
        endless = Path(folder, _ENDLESS)
        try:
            if not _is_soon(lambda: of_type(entry, crew.places, int, "places") > 0, patience_s):
                raise LawError(f"conforms: it has {crew.places} places after {patience_s:g} s")
            for word, state in _STATES.items():
                start(log := Path(folder, word))
                _check_reply(log, _next(ended, log, patience_s), state)
            start(endless)
            if not _is_soon(endless.read_text, patience_s):
                raise LawError("conforms: it doesn't begin with a log after one that ended its process")
            busy = [getattr(each, "log", None) for each in of_type(entry, crew.running(), tuple, "running")]
            if busy != [endless] or crew.lost():
                raise LawError(f"conforms: it is busy with {endless}, and says {busy} and that it lost {crew.lost()!r}")
        finally:
            with blamed(entry, "can't be stopped"):
                crew.stop(1.0)
        if not _is_soon(partial(_is_still, endless), _STOPPED_S):
            raise LawError("stop: work goes on after it was stopped")


def work(log: Path, *, caller: int) -> str:
    """Do what the name of a log says, in another process than the caller's."""
    if os.getpid() == caller:
        raise McaptrackError(f"{log} is processed in the process that asks, which must outlive it")
    if log.name == "refused":
        raise McaptrackError(f"{log} is refused")
    if log.name == "deadly":
        os._exit(7)
    while log.name == _ENDLESS and log.exists():  # until the folder is removed
        log.write_text(str(monotonic()))
        sleep(_BEAT_S)
    return log.name


def _next(ended: SimpleQueue[tuple[Path, Future[Reply]]], log: Path, patience_s: float) -> Future[Reply]:
    try:
        of, future = ended.get(timeout=patience_s)
    except Empty:
        raise LawError(f"conforms: nothing came of {log.name} within {patience_s:g} s") from None
    if of != log:
        raise LawError(f"conforms: {of.name} has a second reply")
    return future


def _check_reply(log: Path, future: Future[Reply], state: str) -> None:
    """Check what became of a log; one that ends its worker may also be given up."""
    try:
        reply = future.result(0)
    except (CancelledError, StoppedError) as error:
        reply = Reply(log, "killed", error=repr(error))
    except Exception as error:
        raise LawError(f"conforms: {log.name} raises {type(error).__name__}, and gives no reply: {error}") from None
    if not isinstance(reply, Reply) or (reply.log, reply.state) != (log, state) or "\n" in reply.error:
        raise LawError(f"conforms: {log.name} is {state}, and its reply {reply!r:.300}")
    if state == "done" and pickle.loads(reply.result or b"N.") != log.name:  # noqa: S301  # what a worker of ours gave
        raise LawError(f"conforms: the result of {log.name} is not what its function returned: {reply.result!r:.80}")


def _is_soon(is_so: Callable[[], object], patience_s: float) -> bool:
    """Whether this becomes true in time."""
    until = monotonic() + patience_s
    while not is_so():
        if monotonic() > until:
            return False
        sleep(_BEAT_S)
    return True


def _is_still(log: Path) -> bool:
    """Whether the work on a log has no beat for a while."""
    before = log.read_text()
    sleep(_LOOK_S)
    return log.read_text() == before
