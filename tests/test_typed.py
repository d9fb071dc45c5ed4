"""Type checkers pass over what users write: the Python of the documentation, and a script that uses every public name."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import json
import shutil
import subprocess
import sys
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pyarrow as pa
import pytest
from numpy import ndarray

import mcaptrack
from mcaptrack.log import CheckResult, Finding
from tests.extension_cases import EXTENSIONS
from tests.test_library import CLASSES, FUNCTIONS, METHODS
from tests.tiers import thorough
from tools import pages
from tools.pages import ROOT

#: Scripts that use every public name: of the core, and of extensions.
SCRIPTS = [ROOT / "tests" / "typed" / "every_function.py", *EXTENSIONS.glob("*/typed.py")]
#: What checkers must find in: a plug-in without outputs, misspelled names, arguments of another type.
WRONG = """\
import mcaptrack
from mcaptrack.transforms import ByteTrakc
from mcaptrack.pipeline import Summray
from mcaptrack.transforms import ByteTrack

mcaptrack.trakc("log.mcap")
mcaptrack.track("log.mcap", tracker=3)
mcaptrack.track("log.mcap", tracker=ByteTrack)
mcaptrack.run("log.mcap", progress=lambda stage: None)
mcaptrack.run("log.mcap").sumary
number: int = mcaptrack.open("log.mcap").fetch({}).payload
"""
#: What is only imported by type checkers, or by those who have it.
ONLY_TYPES = {
    "pa": pa,
    "Player": getattr(mcaptrack, "Player", object),
    "CheckResult": CheckResult,
    "Finding": Finding,
    "Detections": type("Detections", (), {}),
}


def mypy(folder: Path) -> list[str]:
    """The errors of ``mypy --strict``, as the project's settings have it, in the files of a folder."""
    files = sorted(str(path) for path in folder.glob("*.py"))
    settings = ["--config-file", str(ROOT / "pyproject.toml"), "--output", "json"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *settings, *files], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert not done.stderr, done.stderr
    return [
        f"{Path(error['file']).name}:{error['line']}: {error['message']}"
        for error in map(json.loads, filter(None, done.stdout.splitlines()))
        if error["severity"] == "error"
    ]


def pyright(folder: Path) -> list[str]:
    """The errors of pyright in the files of a folder."""
    options = ["--outputjson", "--pythonpath", sys.executable]
    done = subprocess.run(
        [sys.executable, "-m", "pyright", *options, str(folder)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    report = json.loads(done.stdout)
    assert report["summary"]["filesAnalyzed"] == len(list(folder.glob("*.py")))
    return [
        f"{Path(error['file']).name}:{error['range']['start']['line'] + 1}: {error['message']}"
        for error in report["generalDiagnostics"]
        if error["severity"] == "error"
    ]


CHECKERS = pytest.mark.parametrize(
    "checker",
    [
        pytest.param(
            checker,
            id=checker.__name__,
            marks=[
                pytest.mark.skipif(
                    importlib.util.find_spec(checker.__name__) is None, reason=f"{checker.__name__} isn't installed"
                ),
                *marks,
            ],
        )
        for checker, marks in ((mypy, [thorough]), (pyright, []))
    ],
)


@thorough
@CHECKERS
def test_checkers_pass_over_the_documentation_and_over_scripts_that_use_every_name(
    checker: Callable[[Path], list[str]], tmp_path
):
    for page in pages.pages():
        blocks = [block for block in pages.blocks(page) if block.language == "python"]
        for block in blocks:
            if "file" in block.marks:
                file = tmp_path / block.marks["file"]
                assert not file.exists(), f"{block.place}: another block has this name"
                file.write_text(block.text)
        if text := "\n".join(block.text for block in blocks if "file" not in block.marks):
            (tmp_path / f"page_{page.stem.replace('-', '_').lower()}.py").write_text(text)
    assert len(list(tmp_path.glob("*.py"))) > 10
    for script in SCRIPTS:
        shutil.copy(script, tmp_path / f"{script.parent.name}_{script.name}")
    assert checker(tmp_path) == []


@CHECKERS
def test_checkers_find_what_is_wrong(checker: Callable[[Path], list[str]], tmp_path):
    (tmp_path / "wrong.py").write_text(WRONG)
    lines = {int(error.split(":")[1]) for error in checker(tmp_path)}
    assert lines == set(range(2, len(WRONG.splitlines()) + 1)) - {4, 5}


def test_the_scripts_use_every_public_name():
    nodes = [node for script in SCRIPTS for node in ast.walk(ast.parse(script.read_text()))]
    used = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)}
    assert used >= {f"mcaptrack.{name}" for name in mcaptrack.__all__}


def holds_any(hint: object) -> bool:
    """Whether a type is Any or holds it; but the values of records by name, as of JSON, and elements of arrays may."""
    if typing.get_origin(hint) in (dict, Mapping, ndarray):
        return False
    return hint is typing.Any or any(holds_any(part) for part in typing.get_args(hint))


def returned() -> Iterator[tuple[str, object]]:
    """What public functions, methods and properties return, by name."""
    functions = {name: getattr(mcaptrack, name) for name in FUNCTIONS} | METHODS
    for name in CLASSES:
        for member, value in inspect.getmembers(getattr(mcaptrack, name), lambda value: isinstance(value, property)):
            functions[f"{name}.{member}"] = value.fget
    for name, function in functions.items():
        yield name, typing.get_type_hints(inspect.unwrap(function), localns=ONLY_TYPES)["return"]


def test_nothing_public_returns_any():
    hints = dict(returned())
    assert len(hints) > 50
    assert [name for name, hint in hints.items() if holds_any(hint)] == []
