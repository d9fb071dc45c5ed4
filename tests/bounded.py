"""Commands on hostile input, each in a process of its own with bounds on its time and memory, and commands that are ended.

``python -m tests.bounded`` loads the command line once, then forks for each line of JSON on its stdin.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from shutil import rmtree
from typing import NamedTuple

#: Seconds of processor time, and bytes beyond what the loaded program takes.
CPU_S, MEMORY_BYTES = 5, 10**9


@contextmanager
def limited(kind: int, most: int) -> Iterator[None]:
    """Bound this process. Python keeps no compiled module meanwhile: it would keep one that had no room as it is."""
    before, keeps_none = resource.getrlimit(kind), sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(kind, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)
        sys.dont_write_bytecode = keeps_none


class Outcome(NamedTuple):
    """How a command ended: ``code`` is negative if a signal ended it.

    ``signal_cpu_s`` is the processor time that it had taken when it got the signal that it was to get.
    """

    code: int
    err: str
    cpu_s: float
    peak_bytes: int
    signal_cpu_s: float | None = None


class Moment(NamedTuple):
    """When a command gets which signal: as soon as it is about to do that with a file in this folder.

    ``deed`` is read, write or publish (put a file in the place of another), or serve, wherever that is.
    """

    deed: str
    folder: Path
    signal: int


@contextmanager
def commands() -> Iterator[Commands]:
    """A process that runs commands."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MCAPTRACK_")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.bounded"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=environment, cwd=Path(__file__).parent.parent,
    )  # fmt: skip
    try:
        yield Commands(process)
    finally:
        process.stdin.close()
        process.wait(timeout=600)
        process.stdout.close()


class Commands:
    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def run(self, *words: object) -> Outcome:
        """Run a command of mcaptrack within the bounds."""
        return self._ask([str(word) for word in words], None)

    def end(self, moment: Moment, *words: object) -> Outcome:
        """Run a command in the folder of that moment until then, without bounds on its memory."""
        return self._ask([str(word) for word in words], moment._replace(folder=str(moment.folder)))

    def _ask(self, words: list[str], moment: Moment | None) -> Outcome:
        print(json.dumps([words, moment]), file=self._process.stdin, flush=True)
        return Outcome(*json.loads(self._process.stdout.readline()))


def on_disk(*folders: Path) -> dict[str, tuple[int, bytes]]:
    """All that lies in some folders: names, times and bytes."""
    found = (entry for folder in folders for entry in (folder, *folder.rglob("*")))
    return {str(entry): (entry.lstat().st_mtime_ns, entry.read_bytes() if entry.is_file() else b"") for entry in found}


#: A command, and what has to hold of what it wrote, by the exit code.
Work = tuple[list[object], Callable[[int], bool]]


def _fault(commands: Commands, words: list[object], inside: Path, holds: Callable[[int], bool]) -> str:
    """What goes wrong with a command that reads from a folder, "" if nothing does."""
    before = on_disk(inside)
    outcome = commands.run(*words)
    lines = outcome.err.splitlines()
    if on_disk(inside) != before:
        return f"what it reads was changed: {outcome}"
    if outcome.code not in (0, 1, 2, 3) or outcome.peak_bytes > MEMORY_BYTES or "Traceback" in outcome.err:
        return str(outcome)
    is_said = bool(lines) and lines[-1].startswith("mcaptrack: ") and max(map(len, lines)) < 2000
    if outcome.code in (1, 2) and words[0] != "check" and not is_said:
        return f"no reason: {outcome}"
    if any(not character.isprintable() and character != "\n" for character in outcome.err):
        return f"unescaped: {outcome}"
    return "" if holds(outcome.code) else f"what it wrote does not add up: {outcome}"


def faults(
    commands: Commands, seeds: Iterable[int], folder: Path, make: Callable[[int, Path, Path], Iterator[Work]]
) -> list[str]:
    """What goes wrong with the commands on what ``make`` makes by each seed, in one folder, for output in another."""
    found = []
    for seed in seeds:
        inside, out = folder / str(seed), folder / f"{seed}.out"
        inside.mkdir()
        out.mkdir()
        for words, holds in make(seed, inside, out):
            if said := _fault(commands, words, inside, holds):
                found.append(f"{seed} {words[0]}: {said[:3000]}")
            rmtree(out)
            out.mkdir()
    return found


def _serve(lines: Iterable[str]) -> None:
    from mcaptrack import pipeline  # noqa: F401
    from mcaptrack.__main__ import main
    from mcaptrack.cli import app
    from mcaptrack.sources.ingest import ingest  # noqa: F401
    from mcaptrack.tables import export  # noqa: F401

    with suppress(SystemExit), redirect_stderr(StringIO()):
        app(["info", "none.mcap"])  # loads what every command needs

    for line in lines:
        words, moment = json.loads(line)
        with tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as noted:
            child = os.fork()
            if child == 0:
                _run(main, words, err.fileno(), (Moment(*moment), noted.fileno()) if moment else None)
            _, status, used = os.wait4(child, 0)
            err.seek(0)
            said = err.read().decode("utf-8", "replace")
            noted.seek(0)
            signal_cpu_s = float(noted.read() or "nan")
        code, cpu_s = os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime
        print(json.dumps(Outcome(code, said, cpu_s, used.ru_maxrss * 1024, signal_cpu_s)), flush=True)


def _get_signal(moment: Moment, noted: int) -> None:
    """Send this process a signal at that moment."""
    left, folder = [moment], str(moment.folder)

    def watch(event: str, given: tuple[object, ...]) -> None:
        deed = {"open": "read", "os.mkdir": "write", "os.rename": "publish", "socket.bind": "serve"}.get(event)
        if deed is None or not left:
            return
        if event == "open":
            path, _, flags = given
            if not isinstance(path, str | os.PathLike):
                return
            deed = "write" if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR) else "read"
        is_there = deed == "serve" or os.path.abspath(os.fspath(given[0])).startswith(folder)
        if is_there and deed == moment.deed:
            left.clear()
            os.write(noted, str(time.process_time()).encode())
            os.kill(os.getpid(), moment.signal)

    sys.addaudithook(watch)


def _run(main: object, words: list[str], err: int, moment: tuple[Moment, int] | None) -> None:
    """In the child: run the command and be gone."""
    code = 99
    try:
        if moment is None:
            with Path("/proc/self/statm").open() as stream:
                now = int(stream.read().split()[0]) * resource.getpagesize()
            # DuckDB reserves addresses that it doesn't use; what it uses is looked at afterwards.
            most = now + (8 if words[0] == "query" else 1) * MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        else:
            os.chdir(moment[0].folder)
            _get_signal(*moment)
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
        signal.alarm(300)  # for what waits without computing
        os.dup2(err, 2)
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(1, 0)
        sys.argv = ["mcaptrack", *words]
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 98
    finally:
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve(sys.stdin)


def held(work: Callable[[], object]) -> tuple[int, int]:
    """Bytes that are alive at the end of a piece of work, and the most while it lasted."""
    tracemalloc.start()
    try:
        kept = work()
        alive, most = tracemalloc.get_traced_memory()
        del kept
        return alive, most
    finally:
        tracemalloc.stop()
