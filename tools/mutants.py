"""Change the code at random, one place at a time, and print the changes that no test notices.

A mutant is a copy of the project with one changed expression or statement: a comparison, a constant, an operator, a
condition, a swapped pair of arguments, a deleted statement. A test that fails on it has caught it. A survivor is code
that no test guards, code that does nothing, or a change that makes no difference.

The project is copied to a temporary folder, so the working tree is never touched. Each test file runs once unchanged,
to record which test runs which lines, in processes that it starts as well; the record is kept until the test file
changes, in `.mutants_cache/`. A mutant then runs only the tests that run its lines, the quickest first. A test that
fails has to fail a second time, alone.

    python -m tools.mutants mcaptrack/transforms/retrack --count 40 --seed 3

Records are good only if nothing else keeps the machine busy while they are made: a test that fails then leaves its file
without a record. `--count 0` makes the missing ones and tries no mutant, so that they can be made beforehand:

    python -m tools.mutants --count 0
    python -m tools.mutants mcaptrack/cli --count 40 --stale --verbose | tee mutants.log

Each result is printed as soon as it is known, so a run that is ended early has lost none.
"""

from __future__ import annotations

import argparse
import difflib
import gc
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from compileall import compile_dir
from contextlib import suppress
from importlib import import_module
from itertools import accumulate
from math import inf
from pathlib import Path
from typing import Any

from tools.lines_kept import Records
from tools.lines_run import LinesRun
from tools.mutations import ROOT, Mutant, find, sample

#: Time that tests get at most, beside ten times what they take unchanged.
SLACK_S = 60.0
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore::pytest.PytestAssertRewriteWarning")
#: The quickest tests run first, without the others, because most mutants are caught by them: so much time of them.
FIRST_S = 3.0
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


class Chooser:
    """A plugin of pytest: runs the named tests, in their order, and notes in a file which one failed."""

    def __init__(self, names: Sequence[str], failed: Path) -> None:
        self._order, self._failed = {name: at for at, name in enumerate(names)}, failed

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self._order), key=lambda i: self._order[i.nodeid])

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._failed.write_text(report.nodeid)


class Bench:
    """A copy of the project in which mutants are tried, each in a process forked from this one.

    This process has loaded the libraries, but nothing of the project.
    """

    def __init__(self, folder: Path, records: Records, most_s: float = inf) -> None:
        self._folder, self._root, self._records, self._most_s = folder, folder / "copy", records, most_s
        ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", "mcaptrack-demo", ".hypothesis")
        shutil.copytree(ROOT, self._root, ignore=ignored)
        for name in WARM:
            with suppress(ImportError):
                import_module(name)
        # Runs of mutants write no bytecode, and without any each would compile all that it imports.
        compile_dir(self._root / "mcaptrack", quiet=2)
        self._pytest(["--collect-only", "tests"], 3600, None)

    def _pytest(self, files: Sequence[str], limit_s: float, plugin: Any, **environment: str) -> int | None:
        """Run tests in a fork; None if they take longer than ``limit_s``. What they print goes to a file."""
        gc.freeze()  # the records are large: no collection in the fork may look at them
        child = os.fork()
        if child == 0:
            code = 3
            try:
                os.setsid()
                gc.unfreeze = lambda: None  # type: ignore[assignment]  # which the tests do at their end
                out = os.open(self._folder / "out.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
                os.dup2(out, 1)
                os.dup2(out, 2)
                os.chdir(self._root)
                os.environ |= {"PYTHONPATH": str(self._root)} | environment
                sys.path[:] = [str(self._root), *(place for place in sys.path if place not in ("", str(ROOT)))]
                sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in environment
                import pytest

                once = isinstance(plugin, LinesRun)
                code = int(pytest.main([*PYTEST[once:], *files], [plugin] if plugin else None))
                if once:
                    self._records.write(files[0], plugin.record())
                    code = 0
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

    def record(self, file: str) -> None:
        """Note which lines the tests of a file run."""
        lines = self._folder / "lines"
        if self._pytest([file], 3600, LinesRun(self._root, lines)) != 0:
            print(f"{file}: not recorded\n{self._said()[-3000:]}")
        shutil.rmtree(lines)
        (self._root / "sitecustomize.py").unlink()

    def _said(self) -> str:
        return (self._folder / "out.txt").read_text(errors="replace")

    def survives(self, mutant: Mutant, files: Sequence[str]) -> tuple[bool, str]:
        """Whether all tests pass on the mutant; and if not, what caught it."""
        tests = self._records.tests_of(mutant, files)
        if not tests:
            return True, "no test runs it"
        times_s = list(accumulate(took_s for _, took_s in tests))
        quick, most = bisect(times_s, FIRST_S), bisect(times_s, self._most_s)
        path = self._root / mutant.path
        source, times = path.read_bytes(), path.stat()
        try:
            path.write_bytes(mutant.applied(source))
            for part in (tests[:quick], tests[quick:most]):
                if part and (caught := self._fails(part)):
                    return False, caught
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # its bytecode is good again
        if most < len(tests):
            return True, f"the quickest {most} of {len(tests)} tests"
        return True, f"{len(tests)} tests, {times_s[-1]:.0f} s"

    def _fails(self, tests: Sequence[tuple[str, float]]) -> str:
        """What caught the mutant; empty if all tests pass.

        A test that fails has to fail again alone: a machine that is busy makes tests fail on code that is right.
        """
        names, limit_s = [name for name, _ in tests], SLACK_S + 10 * sum(took_s for _, took_s in tests)
        while names:
            code, failed = self._run(names, limit_s)
            if code is None:
                return f"more than {limit_s:.0f} s"
            if code in (0, 5):
                return ""
            if not failed:  # before any test ran
                return f"exit {code}"
            if self._run([failed], limit_s)[0] != 0:
                return failed
            print(f"{failed} failed, and passed alone")
            names = names[names.index(failed) + 1 :]
        return ""

    def _run(self, names: Sequence[str], limit_s: float) -> tuple[int | None, str]:
        """Run these tests: the exit code, None after ``limit_s``, and the test that failed."""
        failed = self._folder / "failed.txt"
        failed.write_text("")
        files = sorted({name.partition("::")[0] for name in names})
        code = self._pytest(files, limit_s, Chooser(names, failed), PYTHONDONTWRITEBYTECODE="1")
        return code, failed.read_text()


def difference(mutant: Mutant) -> Iterator[str]:
    """The changed lines of a mutant."""
    source = (ROOT / mutant.path).read_bytes()
    old, new = (text.decode().splitlines() for text in (source, mutant.applied(source)))
    for line in difflib.unified_diff(old, new, mutant.path, mutant.path, lineterm="", n=1):
        if not line.startswith(("---", "+++")):
            yield line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", nargs="*", default=["mcaptrack/transforms"], help="files and folders to change")
    parser.add_argument("--count", type=int, default=40, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1, help="random seed")
    parser.add_argument("--tests", nargs="*", help="test files; all by default")
    parser.add_argument("--mutant", action="append", help="try this one, by its printed name")
    parser.add_argument("--records", type=Path, default=ROOT / ".mutants_cache", help="which test runs which lines")
    parser.add_argument("--stale", action="store_true", help="use records of test files that have changed since")
    parser.add_argument("--most-s", type=float, default=inf, help="run the quickest tests of a mutant, for so long")
    parser.add_argument("--verbose", action="store_true", help="print what caught the others")
    options = parser.parse_args()
    files = options.tests or sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))
    mutants = find(options.places)
    if options.mutant:
        chosen = [mutant for mutant in mutants if mutant.name in options.mutant]
    else:
        chosen = sample(mutants, options.count, options.seed)
    tally: dict[str, Counter[bool]] = defaultdict(Counter)
    with tempfile.TemporaryDirectory() as folder:
        records = Records(options.records, options.stale)
        bench = Bench(Path(folder), records, options.most_s)
        for file in files:
            if not records.knows(file):
                bench.record(file)
        for mutant in chosen:
            survived, why = bench.survives(mutant, files)
            tally[str(Path(mutant.path).parent)][survived] += 1
            if survived or options.verbose:
                print(f"{'SURVIVED' if survived else 'caught  '} {mutant.name}  {why}")
                print("\n".join(f"    {line}" for line in difference(mutant)), flush=True)
    for folder, counts in sorted(tally.items()):
        print(f"{folder}: {counts[False]} of {counts.total()} caught")
    caught, total = sum(c[False] for c in tally.values()), sum(c.total() for c in tally.values())
    print(f"caught {caught} of {total} mutants ({len(mutants)} there are), seed {options.seed}")


if __name__ == "__main__":
    sys.stdout.reconfigure(line_buffering=True)  # also into a file or a pipe
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
