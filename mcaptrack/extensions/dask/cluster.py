"""Workers of a Dask cluster: each log is a task there, which a worker process executes, as on one machine."""

from __future__ import annotations

import logging
import platform
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import replace
from time import monotonic
from typing import Any, Final
from uuid import uuid4

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError, in_one_line, needing
from mcaptrack.fleet import Running
from mcaptrack.fleet.worker import Child, Reply, Request, WorkerLimits
from mcaptrack.location import Location
from mcaptrack.notices import warn

#: Seconds to wait for the scheduler, and between two looks at the number of workers.
_ANSWER_S: Final = 10
_LOOK_S: Final = 2.0
#: Dask's own messages about connections: what matters of them is said in one line.
_LOGGERS: Final = ("distributed", "tornado", "asyncio")


class Cluster:
    """Processes logs on a cluster. ``places`` is how many it can be busy with: one for each thread of its workers."""

    def __init__(self, address: str, limits: WorkerLimits, most: int | None) -> None:
        with needing("`scheduler=`", "Dask", "fleet"):
            from distributed import Client
        self._address, self._most = address, most
        loggers = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in _LOGGERS]
        self._levels = {name: logging.getLogger(name).level for name in (*_LOGGERS, *loggers)}
        for name in self._levels:  # Dask sets the levels of some of them, so that those above don't count
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            make: Any = Client
            self._client = make(address, timeout=_ANSWER_S, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            self._restore_logging()
            raise McaptrackError(f"no Dask scheduler answers at {address}: {in_one_line(error, 200)}") from error
        self._futures: dict[Location, tuple[Any, float]] = {}
        self._places, self._looked = 0, 0.0
        self._limits = limits
        try:
            self._compare_versions()
            hosts = Counter[str]()
            for worker in self._client.scheduler_info(n_workers=-1)["workers"].values():
                hosts[worker["host"]] += worker["nthreads"]
            self._limits = replace(limits, workers=max(hosts.values(), default=1))
        except BaseException:
            self.stop(0.0)
            raise
        if not hosts:
            warn(f"the scheduler at {address} has no workers yet; logs wait for them", "other")

    def _compare_versions(self) -> None:
        """Warn of workers with other versions. Raises McaptrackError if they lack the package."""
        own = versions()
        try:
            theirs = self._client.run(versions)
        except Exception as error:
            text = f"workers of {self._address} can't use this version of mcaptrack"
            raise McaptrackError(f"{text}: {in_one_line(error, 200)}") from error
        for name, version in own.items():
            others = sorted({worker_versions[name] for worker_versions in theirs.values()} - {version})
            if others:
                warn(f"workers of {self._address} have {name} {', '.join(others)}, not {version}", "other-version")

    @property
    def places(self) -> int:
        """The number of logs that the cluster can be busy with."""
        if monotonic() - self._looked > _LOOK_S and not self.lost():
            self._looked = monotonic()
            try:
                self._places = sum(self._client.nthreads().values())
            except (OSError, CancelledError, TimeoutError):
                self._places = 0
        return self._places if self._most is None else min(self._most, self._places)

    def start(self, request: Request, then: Callable[[Future[Reply]], None]) -> None:
        """Begin with a log; ``then`` is called in another thread when it has ended."""
        name = f"mcaptrack-{request.log.name}-{uuid4().hex}"
        task = self._client.submit(attempt, request, self._limits, key=name, pure=False, retries=0)
        self._futures[request.log] = (task, monotonic())

        def ended(task: Any) -> None:
            then(self._reply(request, task))

        task.add_done_callback(ended)

    def _reply(self, request: Request, task: Any) -> Future[Reply]:
        """Return what became of a task, as a future of the standard library."""
        from distributed import KilledWorker

        out: Future[Reply] = Future()
        try:
            out.set_result(task.result(timeout=_ANSWER_S))
        except KilledWorker as error:
            text = f"{request.log}: workers of the cluster died while they processed it"
            out.set_result(Reply(request.log, "killed", error=text, detail=str(error)))
        except CancelledError:
            out.cancel()
        except Exception as error:
            out.set_result(Reply(request.log, "failed", error=f"{request.log}: {in_one_line(error, 500)}"))
        self._futures.pop(request.log, None)
        return out

    def running(self) -> tuple[Running, ...]:
        """Return the logs that the cluster is busy with."""
        now = monotonic()
        return tuple(Running(log, seconds=now - since) for log, (_, since) in list(self._futures.items()))

    def lost(self) -> str:
        """Return why no log can be processed any more; "" if all is well."""
        return "" if self._client.status == "running" else f"the scheduler at {self._address} was lost"

    def stop(self, grace_s: float) -> None:
        """Cancel all tasks; their worker processes end within ``grace_s`` seconds."""
        is_lost = bool(self.lost())
        if not is_lost and self._futures:
            self._client.cancel([task for task, _ in self._futures.values()], force=True)
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=max(0.1, grace_s))
        if not is_lost:  # otherwise Dask still logs that it can't connect
            self._restore_logging()

    def _restore_logging(self) -> None:
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)


def versions() -> dict[str, str]:
    """Return the versions that results depend on."""
    import numpy as np

    return {"mcaptrack": __version__, "Python": platform.python_version(), "NumPy": np.__version__}


#: The worker process of each thread of a worker of the cluster.
_OWN: Final = threading.local()


def attempt(request: Request, limits: WorkerLimits) -> Reply:
    """Process a log in a worker process beside this thread of a worker of the cluster."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_cancelled() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    if getattr(_OWN, "limits", None) != limits:
        if hasattr(_OWN, "child"):
            _OWN.child.close()
        _OWN.limits, _OWN.child = limits, Child(limits)
    child: Child = _OWN.child
    return child.do(request, is_cancelled)
