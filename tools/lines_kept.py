"""Records of which test runs which lines, kept from run to run of ``mutants.py``."""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Sequence
from difflib import SequenceMatcher
from functools import cache
from pathlib import Path
from typing import Any

from tools.mutations import ROOT, Mutant


def _package() -> dict[str, str]:
    """The sources of the package."""
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted((ROOT / "mcaptrack").rglob("*.py"))}


class Records:
    """A folder of records, one for each test file; each names the sources of the package that it was made with.

    The package may have changed since: lines are then found again by comparing old and new sources.
    """

    def __init__(self, folder: Path, stale: bool = False) -> None:
        self._folder, self._stale = folder, stale
        self._now = _package()
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self._now)
        self._sources = hashlib.sha256(text.encode()).hexdigest()[:16]
        path = folder / f"sources-{self._sources}.json.gz"
        if not path.exists():
            path.write_bytes(gzip.compress(text.encode(), 1))
        self._read: dict[str, list[tuple[str, float, dict[str, set[int]]]]] = {}
        self._collected: dict[str, dict[str, set[int]]] = {}

    def _path(self, file: str) -> Path:
        return self._folder / f"{file.replace('/', '-')}.json.gz"  # two folders may have files of one name

    def knows(self, file: str) -> bool:
        """Whether this test file has been recorded as it is now."""
        if not self._path(file).exists():
            return False
        return self._stale or self._load(file)["digest"] == _digest(file)

    def write(self, file: str, record: dict[str, Any]) -> None:
        text = json.dumps(record | {"digest": _digest(file), "sources": self._sources})
        self._path(file).write_bytes(gzip.compress(text.encode(), 1))

    def _load(self, file: str) -> dict[str, Any]:
        return json.loads(gzip.decompress(self._path(file).read_bytes()))

    def _tests(self, file: str) -> list[tuple[str, float, dict[str, set[int]]]]:
        """The tests of a file, with their times, and the lines that they run, as these are numbered now."""
        if file not in self._read:
            if not self._path(file).exists():
                return []
            record = self._load(file)
            self._collected[file] = self._numbered(record["sources"], record["collected"])
            self._read[file] = [
                (name, test["took_s"], self._numbered(record["sources"], test["lines"]))
                for name, test in record["tests"].items()
            ]
        return self._read[file]

    def _numbered(self, sources: str, lines: dict[str, list[int]]) -> dict[str, set[int]]:
        if sources == self._sources:
            return {path: set(numbers) for path, numbers in lines.items()}
        out = {}
        for path, numbers in lines.items():
            if path not in self._old(sources):
                continue
            now, moved = self._moved(sources, path)
            out[now] = {new for number in numbers for new in moved.get(number, ())}
        return out

    @cache  # noqa: B019
    def _old(self, sources: str) -> dict[str, str]:
        return json.loads(gzip.decompress((self._folder / f"sources-{sources}.json.gz").read_bytes()))

    @cache  # noqa: B019
    def _moved(self, sources: str, path: str) -> tuple[str, dict[int, range]]:
        """Where a file of old sources stands now, and for each of its lines, which those are now."""
        old = self._old(sources)[path].splitlines()
        now = path
        if path not in self._now:
            known = set(old)
            gone = [other for other in self._now if other not in self._old(sources)]
            now = max(gone, key=lambda other: len(known & set(self._now[other].splitlines())), default=path)
        new = self._now.get(now, "").splitlines()
        moved: dict[int, range] = {}
        for kind, a, b, c, d in SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
            for number in range(a, b):
                at = c + number - a
                moved[number + 1] = range(at + 1, at + 2) if kind == "equal" or b - a == d - c else range(c + 1, d + 1)
        return now, moved

    def tests_of(self, mutant: Mutant, files: Sequence[str]) -> list[tuple[str, float]]:
        """The tests that run what is changed, the quickest first, and the time that each takes.

        Those that run the line, or the statement or the function if no test runs that line. Constants and defaults run
        when modules are imported: defaults matter to all tests that run anything of the function; constants to those
        that run anything of the file, then to those that stand beside them or run files that import it.
        """
        every = [(*test, file) for file in files for test in self._tests(file)]
        signature = mutant.function[0] and mutant.statement[0] == mutant.function[0]
        spans = [mutant.function] if signature else [(mutant.line, mutant.line), mutant.statement, mutant.function]
        for first, last in spans if mutant.function[0] else ():
            wanted = set(range(mutant.statement[1] + 1 if signature else first, last + 1))
            chosen = [t for t in every if wanted & t[2].get(mutant.path, set())]
            chosen += [t for t in every if t not in chosen and wanted & self._collected[t[3]].get(mutant.path, set())]
            if chosen:
                return sorted(((t[0], t[1]) for t in chosen), key=lambda t: t[1])
        near = [t for t in every if t[2].get(mutant.path)]
        around, users = {test[3] for test in near}, self._users(mutant.path)
        beside = [t for t in every if t not in near and t[3] in around]
        beside += [t for t in every if t[3] not in around and any(t[2].get(path) for path in users)]
        return [(t[0], t[1]) for part in (near, beside) for t in sorted(part, key=lambda t: t[1])]

    def _users(self, path: str) -> list[str]:
        """Files that import a module, or names from its package."""
        module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        packages = "|".join(re.escape(name) for name in (module, module.rpartition(".")[0]) if "." in name)
        return [other for other, text in self._now.items() if re.search(rf"(from|import) ({packages})\b(?!\.)", text)]


def _digest(file: str) -> str:
    return hashlib.sha256((ROOT / file).read_bytes()).hexdigest()[:16]
