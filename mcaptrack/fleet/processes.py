"""Worker processes on this machine: a thread for each, which waits for it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event, Lock, local
from time import monotonic

from mcaptrack.fleet.child import Child, WorkerLimits
from mcaptrack.fleet.results import Running
from mcaptrack.fleet.worker import Reply, Request
from mcaptrack.location import Location


class Processes:
    """Processes logs in workers of their own. ``places`` is how many it can be busy with."""

    def __init__(self, limits: WorkerLimits) -> None:
        self.places = limits.workers
        self._limits, self._stopping, self._lock = limits, Event(), Lock()
        self._threads = ThreadPoolExecutor(limits.workers, "mcaptrack-worker")
        self._own = local()
        self._children: list[Child] = []
        self._busy: dict[Location, tuple[Child, float]] = {}

    def start(self, request: Request, then: Callable[[Future[Reply]], None]) -> None:
        """Begin with a log; ``then`` is called in another thread when it has ended."""
        self._threads.submit(self._attempt, request).add_done_callback(then)

    def _attempt(self, request: Request) -> Reply:
        if not hasattr(self._own, "child"):
            try:
                self._own.child = Child(self._limits)
            except OSError as error:  # no folder for temporary files, or no room there
                words = f"{request.log}: no worker process can be started ({error.strerror or error})"
                return Reply("failed", error=words)
            with self._lock:
                self._children.append(self._own.child)
        child: Child = self._own.child
        self._busy[request.log] = (child, monotonic())
        try:
            return child.do(request, self._stopping.is_set)
        finally:
            del self._busy[request.log]

    def running(self) -> tuple[Running, ...]:
        """Return the logs that workers are busy with."""
        now = monotonic()
        return tuple(
            Running(log, *child.progress, seconds=now - since, resident_bytes=child.resident)
            for log, (child, since) in list(self._busy.items())
        )

    def lost(self) -> str:
        """Return why no log can be processed any more; "" if all is well."""
        return ""

    def stop(self, grace_s: float) -> None:
        """End all workers, after ``grace_s`` seconds whatever they do."""
        self._stopping.set()
        if not grace_s:
            for child in self._children:
                child.end(0.0)
        self._threads.shutdown(wait=True, cancel_futures=True)
        for child in self._children:
            child.close(grace_s)
