"""Which lines of the package each test runs, in this process and in those that it starts, for ``mutants.py``."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import coverage
import pytest
from coverage.exceptions import DataError

#: Python imports this before all else, where PYTHONPATH names its folder.
SITECUSTOMIZE = "import coverage\n\ncoverage.process_startup()\n"
#: Names the test in the data of the processes that it starts.
CONTEXT = "LINES_RUN_BY"
RULES = f"""[run]
parallel = true
sigterm = true
source = {{source}}
data_file = {{data}}
context = ${{{{{CONTEXT}}}}}
"""


class LinesRun:
    """A plugin of pytest: notes, for each test, how long it took and which lines of the package it ran.

    What a fixture of a module or of the session runs counts for every test that asks for it.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self._folder = root, folder
        folder.mkdir(exist_ok=True)
        source = str(root / "mcaptrack")
        (folder / "rules").write_text(RULES.format(source=source, data=folder / "lines"))
        (root / "sitecustomize.py").write_text(SITECUSTOMIZE)
        os.environ["COVERAGE_PROCESS_START"] = str(folder / "rules")
        os.environ[CONTEXT] = "collecting"
        self._coverage = coverage.Coverage(data_file=str(folder / "own"), config_file=False, source=[source])
        self._names: list[str] = []
        self._fixtures: dict[str, tuple[str, ...]] = {}
        self._made: dict[int, str] = {}
        self._took_s: dict[str, float] = {}
        self._failed: list[str] = []

    @contextmanager
    def _within(self, name: str) -> Iterator[None]:
        before = os.environ[CONTEXT]
        self._names.append(name)
        os.environ[CONTEXT] = str(len(self._names))
        self._coverage.switch_context(os.environ[CONTEXT])
        try:
            yield
        finally:
            os.environ[CONTEXT] = before
            self._coverage.switch_context(before)

    @pytest.hookimpl(tryfirst=True)
    def pytest_load_initial_conftests(self) -> None:
        """Start before conftest.py, because what it imports runs code of the package, too."""
        self._coverage.start()
        self._coverage.switch_context(os.environ[CONTEXT])

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Any:
        if fixturedef.scope == "function":
            return (yield)
        name = self._made[id(fixturedef)] = f"fixture {len(self._made)}"
        with self._within(name):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Any:
        begin = time.perf_counter()
        with self._within(item.nodeid):
            result = yield
        self._took_s[item.nodeid] = time.perf_counter() - begin
        wanted = [id(one) for several in item._fixtureinfo.name2fixturedefs.values() for one in several]
        self._fixtures[item.nodeid] = tuple(self._made[one] for one in wanted if one in self._made)
        return result

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._failed.append(report.nodeid)

    def record(self) -> dict[str, Any]:
        """What is kept: for each test, its time and, by file, its lines; tests that failed are left out."""
        self._coverage.stop()
        self._coverage.save()
        lines: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        for path in [self._folder / "own", *self._folder.glob("lines.*")]:
            data = coverage.CoverageData(str(path))
            try:
                data.read()
            except DataError:  # of a process that was killed while it wrote them
                continue
            for file in filter(lambda name: name.endswith(".py"), data.measured_files()):
                for line, contexts in data.contexts_by_lineno(file).items():
                    for context in contexts:
                        name = self._names[int(context) - 1] if context.isdigit() else "collecting"
                        lines[name][os.path.relpath(file, self._root)].add(line)
        tests = {}
        for name, took_s in self._took_s.items():
            if name not in self._failed:
                found: dict[str, set[int]] = defaultdict(set)
                for part in (name, *self._fixtures[name]):
                    for file, numbers in lines[part].items():
                        found[file] |= numbers
                tests[name] = {"took_s": round(took_s, 3), "lines": {f: sorted(found[f]) for f in sorted(found)}}
        collected = {file: sorted(numbers) for file, numbers in lines["collecting"].items()}
        return {"collected": collected, "tests": tests, "failed": self._failed}
