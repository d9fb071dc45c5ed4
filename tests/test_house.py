"""The house stands when an extension is taken away: its folder, and the entry points that name it."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

from mcaptrack.installed import declared
from tests.extension_cases import of_extensions
from tests.tiers import one_in, thorough

TESTS = Path(__file__).parent
ROOT = TESTS.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
POINTS = PROJECT["project"]["entry-points"]
EXTENSIONS = sorted(path.parent.name for path in (ROOT / "mcaptrack" / "extensions").glob("*/__init__.py"))
#: Groups of what users choose by name, beside commands and names in Python.
CHOSEN = POINTS.keys() - {f"mcaptrack.{kind}s" for kind in ("command", "name", "page", "player", "viewer")}
#: Says of a house which commands its help lists, what becomes of names, and which modules of the core can't be imported.
ASK = """
import importlib, io, json, pkgutil, sys
from contextlib import redirect_stderr, redirect_stdout
import mcaptrack
from mcaptrack.cli import app

def call(*words):
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
        try:
            app(words)
        except SystemExit:
            return out.getvalue()

from mcaptrack.installed import missing_extensions
from mcaptrack.registry import find

names, parts, core = json.loads(sys.argv[1])
said = {}
for name in names:
    try:
        said[name] = getattr(mcaptrack, name).__module__
    except AttributeError as error:
        said[name] = str(error)
imports = {}
for name in names:
    try:
        exec(f"from mcaptrack import {name}")
        imports[name] = ""
    except ImportError as error:
        imports[name] = str(error)
for kind, name in parts:
    try:
        said[f"{kind} {name}"] = find(kind, name).module
    except mcaptrack.McaptrackError as error:
        said[f"{kind} {name}"] = str(error)
broken = []
for module in pkgutil.walk_packages(mcaptrack.__path__, "mcaptrack.") if core else ():
    if not module.name.startswith(("mcaptrack.extensions", "mcaptrack.__main__")):
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            broken.append(str(error))
commands = {name: call(name, "x") for name in names if name.islower()}
options = {name: call("info", f"--{name}", "x") for name in commands}
loaded = [name for name in sys.modules if name.startswith("mcaptrack.extensions.")] if core else []
print(json.dumps({
    "help": call("--help"), "names": said, "imports": imports, "missing": missing_extensions(), "all": mcaptrack.__all__, "commands": commands, "options": options, "broken": broken,
    "where": mcaptrack.__file__, "loaded": loaded,
}))
"""


def room_of(value: str) -> str:
    return value.split(".")[2]


def house_without(extensions: list[str], folder: Path) -> None:
    """Put a house without some extensions into a folder: links to all else, and what pip leaves of it."""
    info = folder / "mcaptrack-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mcaptrack\nVersion: 1\n")
    lines = []
    for group, points in POINTS.items():
        lines += [f"[{group}]", *(f"{k} = {v}" for k, v in points.items() if room_of(v) not in extensions)]
    (info / "entry_points.txt").write_text("\n".join(lines))
    (folder / "mcaptrack" / "extensions").mkdir(parents=True)
    for path in (ROOT / "mcaptrack").iterdir():
        if path.name != "extensions":
            (folder / "mcaptrack" / path.name).symlink_to(path)
    for path in (ROOT / "mcaptrack" / "extensions").iterdir():
        if path.name not in extensions:
            (folder / "mcaptrack" / "extensions" / path.name).symlink_to(path)


def ask(folder: Path, *, core: bool) -> dict[str, Any]:
    names = sorted({name for group in ("commands", "names") for name in POINTS[f"mcaptrack.{group}"]})
    parts = [(group.partition(".")[2][:-1], name) for group in CHOSEN for name in POINTS[group]]
    done = subprocess.run(
        [sys.executable, "-c", ASK, json.dumps([names, parts, core])], cwd=folder, env={"PYTHONPATH": str(folder), "COLUMNS": "200"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert not done.returncode, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("gone", ["all", *one_in(len(EXTENSIONS), EXTENSIONS)])
def test_without_an_extension_the_rest_works_and_what_is_missing_is_named(gone, tmp_path):
    missing = EXTENSIONS if gone == "all" else [gone]
    house_without(missing, tmp_path)
    said = ask(tmp_path, core=gone == "all")
    assert said["where"].startswith(str(tmp_path))
    assert (said["broken"], said["loaded"]) == ([], [])
    for group in ("commands", "names"):
        for name, value in POINTS[f"mcaptrack.{group}"].items():
            text = f"{name} is an extension that isn't installed; install mcaptrack again, with mcaptrack/extensions/"
            is_there = room_of(value) not in missing
            assert (name in said["all"]) is is_there
            assert (f"{text}{room_of(value)}" in said["names"][name]) is not is_there
            assert (f"{text}{room_of(value)}" in said["imports"][name]) is not is_there
            if group == "commands":
                assert (f"\n  {name} " in said["help"]) is is_there
                assert (f"mcaptrack: {text}{room_of(value)}\n" == said["commands"][name]) is not is_there
                assert (f"mcaptrack: {text}{room_of(value)}; " in said["options"][name]) is not is_there
    for group in CHOSEN:
        for name, value in POINTS[group].items():
            text = f"{name} is an extension that isn't installed; install mcaptrack again, with mcaptrack/extensions/"
            is_named = said["names"][f"{group.partition('.')[2][:-1]} {name}"] == f"{text}{room_of(value)}"
            assert is_named is (room_of(value) in missing)
    assert "\n  ingest " in said["help"]
    assert {*missing} <= {*said["missing"]}
    assert [name for name, why in said["missing"].items() if not why] == [
        name for name in EXTENSIONS if name not in missing
    ]


@pytest.mark.parametrize("gone", EXTENSIONS[:1])
@thorough
def test_entry_points_of_a_folder_that_is_gone_do_not_count(gone, tmp_path):
    house_without([gone], tmp_path)
    info = tmp_path / "mcaptrack-1.dist-info" / "entry_points.txt"
    info.write_text(
        "\n".join(line for g, own in POINTS.items() for line in (f"[{g}]", *(f"{k}={v}" for k, v in own.items())))
    )
    (tmp_path / "mcaptrack" / "extensions" / gone / "__pycache__").mkdir(parents=True)  # which git leaves
    said = ask(tmp_path, core=False)
    for name, value in POINTS["mcaptrack.commands"].items():
        assert (name in said["all"]) is (room_of(value) != gone)
        assert ("isn't installed" in said["commands"][name]) is (room_of(value) == gone)


@pytest.mark.parametrize("gone", EXTENSIONS[:1])
@thorough
def test_a_folder_that_no_entry_point_leads_to_is_no_extension(gone, tmp_path):
    house_without([gone], tmp_path)
    (tmp_path / "mcaptrack" / "extensions" / gone).symlink_to(ROOT / "mcaptrack" / "extensions" / gone)
    with (tmp_path / "mcaptrack-1.dist-info" / "entry_points.txt").open("a") as file:
        file.write("\n[mcaptrack.commands]\nelsewhere = mcaptrack:open\n")  # of another version
    said = ask(tmp_path, core=False)
    assert "elsewhere" not in said["help"]
    for group in CHOSEN:
        for name in (name for name, value in POINTS[group].items() if room_of(value) == gone):
            assert "isn't installed" in said["names"][f"{group.partition('.')[2][:-1]} {name}"]
    ask_missing = "from mcaptrack.installed import missing_names; print(*missing_names('ending'))"
    done = subprocess.run([sys.executable, "-c", ask_missing], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)},
                          capture_output=True, text=True, check=True)  # fmt: skip
    stub = (ROOT / "mcaptrack" / "__init__.pyi").read_text()
    assert done.stdout.split() == re.findall(rf"^# ending (\S+): mcaptrack\.extensions\.{gone}$", stub, re.M)


def test_every_extension_has_a_folder_of_tests_and_every_entry_point_a_folder():
    tested = {path.name for path in (ROOT / "tests" / "extensions").iterdir() if list(path.glob("test_*.py"))}
    assert set(EXTENSIONS) == tested == {room_of(value) for points in POINTS.values() for value in points.values()}


def test_every_table_of_cases_is_one_that_a_test_of_the_core_gathers():
    asked = {name for path in TESTS.rglob("*.py") for name in re.findall(r'of_extensions\("(\w+)"\)', path.read_text())}
    for path in (TESTS / "extensions").glob("*/cases.py"):
        tables = set(re.findall(r"^([A-Z]\w*)(?:: .*)? = ", path.read_text(), re.M))
        assert tables <= asked, path


def test_the_installed_entry_points_are_those_of_the_project():
    points = {(point.group, point.name, point.value) for point in declared().points if point.is_own}
    wanted = {(group, name, value) for group, own in POINTS.items() for name, value in own.items()}
    assert points == wanted, "install again: .venv/bin/python -m pip install --editable ."


def test_the_workflow_takes_each_extension_away():
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    (command,) = re.findall(r"names=\$\(python3 (.+)\)", jobs["extensions"]["steps"][-1]["run"])
    listed = subprocess.run([sys.executable, *command.split()], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(listed.stdout) == [*EXTENSIONS, "all"]
    assert jobs["without"]["strategy"]["matrix"]["extension"] == "${{ fromJSON(needs.extensions.outputs.names) }}"


def test_the_core_names_no_extension():
    for path in (ROOT / "mcaptrack").rglob("*.py"):
        if "extensions" not in path.relative_to(ROOT / "mcaptrack").parts:
            assert not [name for name in EXTENSIONS if f"extensions.{name}" in path.read_text()], path


def names_from_the_core(path: Path) -> Iterator[tuple[str, str]]:
    """The modules of the core that a module of an extension imports, and the names of them that it uses."""
    tree, modules = ast.parse(path.read_text()), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and re.match(r"mcaptrack\b(?!\.extensions)", node.module):
            for alias in node.names:
                if find_spec(node.module).submodule_search_locations and find_spec(f"{node.module}.{alias.name}"):
                    modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                else:
                    yield node.module, alias.name
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            yield modules[node.value.id], node.attr


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_extensions_use_public_names_of_public_modules(extension):
    """Public are the rooms that offer what they import, and modules with ``__all__``; the cases of each name others."""
    rooms = next(o["module"] for o in PROJECT["tool"]["mypy"]["overrides"] if o.get("implicit_reexport"))
    deep = set()
    for path in (ROOT / "mcaptrack" / "extensions" / extension).rglob("*.py"):
        for module, name in names_from_the_core(path):
            public = getattr(import_module(module), "__all__", None)
            assert not name.startswith("_") or name.endswith("__"), f"{path}: {module}.{name}"
            if public is None and module not in rooms:
                deep.add(module.removeprefix("mcaptrack."))
            elif public is not None and module != "mcaptrack":
                assert name in public, f"{path}: {module} has no public name {name}"
    _, modules = of_extensions("DEEP").get(extension, ("", ""))
    assert deep == {*modules.split()}


@pytest.mark.parametrize(("command", "option"), one_in(2, [("run", "zones"), ("zones", "topic")]))
def test_a_setting_of_a_missing_extension_is_named_with_it(command, option, tmp_path):
    house_without(["zones"], tmp_path)
    (tmp_path / "own.toml").write_text(f'[{command}]\n{option} = "a"\n')
    environment = {"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin"}
    ways = (["--config", "own.toml"], {}), ([], {f"MCAPTRACK_{command}_{option}".upper(): "a"})
    for words, more in ways:
        done = subprocess.run([sys.executable, "-m", "mcaptrack", *words, "check", "a.mcap"], cwd=tmp_path,
                              env=environment | more, capture_output=True, text=True, check=False)  # fmt: skip
        assert done.returncode == 2
        assert "zones is an extension that isn't installed; install mcaptrack again" in done.stderr
        assert len(done.stderr.splitlines()) == 1


#: Makes channels again that parts of a missing extension made, and prints what is said.
MAKE_AGAIN = """
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES

for stage, parameters in (("detect", {"detector": "onnx", "file": "a"}), ("predict", {"predictor": "onnx:a"})):
    try:
        rebuild(STAGES[stage], Provenance(stage, parameters), {})
    except Exception as error:
        print(error)
"""


def test_a_part_with_a_file_of_a_missing_extension_is_named(tmp_path):
    house_without(["networks"], tmp_path)

    def said(*words: str) -> tuple[int, str]:
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin"},
                              capture_output=True, text=True, check=False)  # fmt: skip
        return done.returncode, done.stderr + done.stdout

    why = "onnx is an extension that isn't installed; install mcaptrack again, with mcaptrack/extensions/networks\n"
    for words in ("detect a.mcap --detector onnx:a.onnx", "predict a.mcap --predictor onnx:a.onnx"):
        assert said("-m", "mcaptrack", *words.split()) == (1, f"mcaptrack: {why}")
    assert said("-c", MAKE_AGAIN) == (0, f"detector onnx made it; {why}{why}")


TOOLS = [path for path in (ROOT / "tools").rglob("*.py") if re.search(r"^from mcaptrack\.ext", path.read_text(), re.M)]


@pytest.mark.parametrize("has_points", [False, True])
def test_a_tool_about_a_missing_extension_ends_with_one_line(tmp_path, has_points):
    for path in TOOLS:
        before = path.read_text().partition("from mcaptrack.extensions")[0]
        assert re.search(r"^import (tools\.)?missing_extension  # noqa", before, re.M), path
    house_without(["review"], tmp_path)
    if has_points:
        points = tmp_path / "mcaptrack-1.dist-info" / "entry_points.txt"
        points.write_text(
            points.read_text() + "\n[mcaptrack.commands]\nreview=mcaptrack.extensions.review.api:review\n"
        )
    done = subprocess.run([sys.executable, ROOT / "tools" / "second_look.py", "-h"], env={"PYTHONPATH": str(tmp_path)},
                          capture_output=True, text=True, check=False)  # fmt: skip
    why = "review is an extension that isn't installed; install mcaptrack again, with mcaptrack/extensions/review\n"
    assert (done.returncode, done.stderr) == (1, why)
