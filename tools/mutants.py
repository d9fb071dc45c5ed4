"""Change the code at random, one place at a time, and print the changes that no test notices.

A mutant is a copy of the project with one changed expression or statement: a comparison, a constant, an operator, a
condition, a swapped pair of arguments, a deleted statement. A test that fails on it has caught it. A survivor is code
that no test guards, code that does nothing, or a change that makes no difference.

The project is copied to a temporary folder, so the working tree is never touched. The tests run once unchanged, to
record which of them call which function; a mutant then runs only those that call the function it is in, the quickest
first.

    python -m tools.mutants mcaptrack/transforms/retrack --count 40 --seed 3
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

from tools.mutations import ROOT, Mutant, find, sample

RETRACK = "retrack offline offline_reference retracking_reference retracking_laws retracking_thresholds"
#: The test files that cover a folder or a file, beside those of the folders around it; all tests where none are named.
COVERS = {
    "mcaptrack/evaluation": "evaluation events events_reference forecast_errors metrics_oracles compared",
    "mcaptrack/sources/ingest": "ingest label_clock compared recorded_kept",
    "mcaptrack/evaluation/metrics": "metrics metrics_oracles networks forecast_errors evaluation",
    "mcaptrack/predictors": "prediction networks",
    "mcaptrack/schema": "schema events tables",
    "mcaptrack/tables": "tables",
    "mcaptrack/transforms": "transform_laws option_effects defaults",
    "mcaptrack/transforms/detect": "detect",
    "mcaptrack/transforms/predict.py": "prediction sample_reference",
    "mcaptrack/transforms/retrack": RETRACK,
    "mcaptrack/transforms/sample.py": "prediction sample_reference",
    "mcaptrack/transforms/sort": "sort sort_reference",
    "mcaptrack/sources/video": "picture_limits video passing",
}
#: Time that tests get at most, beside five times what they take unchanged.
SLACK_S = 60.0
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning")
#: Loaded once for all mutants.
WARM = (
    "pytest",
    "numpy",
    "scipy.optimize",
    "scipy.sparse.csgraph",
    "hypothesis.extra.numpy",
    "google.protobuf",
    "cv2",
)


def covering(path: str) -> list[str]:
    """The test files that cover a file, relative to the root."""
    names = " ".join(tests for place, tests in COVERS.items() if path == place or path.startswith(f"{place}/")).split()
    return [f"tests/test_{name}.py" for name in names] or ["tests"]


class Recorder:
    """A plugin of pytest: notes, for each test, how long it took and which functions of the package it called."""

    def __init__(self, root: Path) -> None:
        self._front = str(root) + os.sep
        self.calls: dict[str, list[str]] = {}
        self.took_s: dict[str, float] = {}

    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> bool:
        from _pytest.runner import runtestprotocol

        called: set[tuple[str, int]] = set()

        def note(frame: FrameType, _event: str, _arg: object) -> None:
            called.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

        begin = time.perf_counter()
        sys.settrace(note)
        try:
            runtestprotocol(item, nextitem=nextitem)
        finally:
            sys.settrace(None)
        ours = (f"{file.removeprefix(self._front)}:{line}" for file, line in called if file.startswith(self._front))
        self.calls[item.nodeid] = sorted(ours)
        self.took_s[item.nodeid] = time.perf_counter() - begin
        return True


class Chooser:
    """A plugin of pytest: runs the named tests, in their order."""

    def __init__(self, names: Sequence[str]) -> None:
        self._order = {name: at for at, name in enumerate(names)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self._order), key=lambda i: self._order[i.nodeid])


class Bench:
    """A copy of the project in which mutants are tried, each in a process forked from this one.

    This process has loaded the libraries, but nothing of the project.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._root = folder, folder / "copy"
        ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", "mcaptrack-demo", ".hypothesis")
        shutil.copytree(ROOT, self._root, ignore=ignored)
        self._records: dict[tuple[str, ...], dict[str, Any]] = {}
        for name in WARM:
            with suppress(ImportError):
                import_module(name)

    def _pytest(self, files: Sequence[str], limit_s: float, plugin: Any, **environment: str) -> int | None:
        """Run tests in a fork; None if they take longer than ``limit_s``. What they print goes to a file."""
        child = os.fork()
        if child == 0:
            code = 3
            try:
                os.setsid()
                out = os.open(self._folder / "out.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
                os.dup2(out, 1)
                os.dup2(out, 2)
                os.chdir(self._root)
                os.environ |= {"PYTHONPATH": str(self._root)} | environment
                sys.path[:] = [str(self._root), *(place for place in sys.path if place not in ("", str(ROOT)))]
                sys.dont_write_bytecode = bool(environment)
                import pytest

                code = int(pytest.main([*PYTEST, *files], [plugin]))
                if isinstance(plugin, Recorder):
                    (self._folder / "record.json").write_text(json.dumps(vars(plugin)))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return None

    def record(self, files: Sequence[str]) -> dict[str, Any]:
        """What the tests in these files call, once they have passed unchanged."""
        key = tuple(files)
        if key not in self._records:
            if self._pytest(files, float("inf"), Recorder(self._root)) != 0:
                sys.exit(f"{' '.join(files)}: tests fail without any change\n{self._said()[-3000:]}")
            self._records[key] = json.loads((self._folder / "record.json").read_text())
        return self._records[key]

    def _said(self) -> str:
        return (self._folder / "out.txt").read_text(errors="replace")

    def tests_of(self, mutant: Mutant, record: dict[str, Any]) -> list[str]:
        """The tests that call the function that is changed; all where none does, those that use the file first.

        Constants and defaults of a module or a class may matter to tests that call nothing in it.
        """
        calls, took_s = record["calls"], record["took_s"]
        place = f"{mutant.path}:{mutant.scope}"
        chosen = [test for test, called in calls.items() if place in called] if mutant.scope else []
        if chosen:
            return sorted(chosen, key=lambda test: took_s[test])
        uses = {test: any(call.startswith(f"{mutant.path}:") for call in called) for test, called in calls.items()}
        return sorted(calls, key=lambda test: (not uses[test], took_s[test]))

    def survives(self, mutant: Mutant, files: Sequence[str]) -> tuple[bool, str]:
        """Whether all tests pass on the mutant; and if not, what caught it."""
        record = self.record(files)
        names = self.tests_of(mutant, record)
        limit_s = SLACK_S + 5 * sum(record["took_s"][name] for name in names)
        path = self._root / mutant.path
        source, times = path.read_bytes(), path.stat()
        try:
            path.write_bytes(mutant.applied(source))
            chosen = sorted({name.partition("::")[0] for name in names})
            code = self._pytest(chosen, limit_s, Chooser(names), PYTHONDONTWRITEBYTECODE="1")
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # its bytecode is good again
        if code is None:
            return False, f"more than {limit_s:.0f} s"
        failed = re.search(r"^(?:FAILED|ERROR) (.*)$", self._said(), re.MULTILINE)
        return code == 0, failed.group(1)[:160] if failed else f"exit {code}"


def difference(mutant: Mutant) -> Iterator[str]:
    """The changed lines of a mutant."""
    source = (ROOT / mutant.path).read_bytes()
    old, new = (text.decode().splitlines() for text in (source, mutant.applied(source)))
    for line in difflib.unified_diff(old, new, mutant.path, mutant.path, lineterm="", n=1):
        if not line.startswith(("---", "+++")):
            yield line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("places", nargs="*", default=["mcaptrack/transforms"], help="files and folders to change")
    parser.add_argument("--count", type=int, default=40, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1, help="random seed")
    parser.add_argument("--tests", nargs="*", help="test files, instead of those that cover the places")
    parser.add_argument("--mutant", action="append", help="try this one, by its printed name")
    parser.add_argument("--verbose", action="store_true", help="print what caught the others")
    options = parser.parse_args()
    mutants = find(options.places)
    if options.mutant:
        chosen = [mutant for mutant in mutants if mutant.name in options.mutant]
    else:
        chosen = sample(mutants, options.count, options.seed)
    tally: dict[str, Counter[bool]] = defaultdict(Counter)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for mutant in chosen:
            survived, why = bench.survives(mutant, options.tests or covering(mutant.path))
            tally[str(Path(mutant.path).parent)][survived] += 1
            if survived or options.verbose:
                print(f"{'SURVIVED' if survived else 'caught  '} {mutant.name}{'' if survived else '  ' + why}")
                print("\n".join(f"    {line}" for line in difference(mutant)), flush=True)
    for folder, counts in sorted(tally.items()):
        print(f"{folder}: {counts[False]} of {counts.total()} caught")
    caught, total = sum(c[False] for c in tally.values()), sum(c.total() for c in tally.values())
    print(f"caught {caught} of {total} mutants ({len(mutants)} there are), seed {options.seed}")


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
