"""What a repository has beside its code: how to contribute, to cite and to report, and what runs for every change."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from mcaptrack import __version__
from tests.extension_cases import is_gone

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = ("CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md")
PYTHONS = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d", line)}
#: The classifier of each system that runs in the workflow.
SYSTEMS = {"ubuntu": "POSIX :: Linux", "macos": "MacOS", "windows": "Microsoft :: Windows"}


def parsed(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())


@pytest.fixture(scope="module")
def jobs() -> dict[str, Any]:
    return parsed(".github/workflows/ci.yml")["jobs"]


def steps(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


def checks_of_make() -> list[str]:
    """The commands of ``make test`` after those that install."""
    text = (ROOT / "Makefile").read_text()
    return re.findall(r"^\t\$\(BIN\)/(.+)$", re.search(r"^test:.*\n((?:\t.*\n)+)", text, re.M)[1], re.M)


@pytest.mark.parametrize("page", PAGES)
def test_links_and_files_that_pages_name_exist(page):
    text = (ROOT / page).read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert target.startswith("https://") or (ROOT / target).exists(), target
    for path in re.findall(r"`((?:mcaptrack|tests|tools|docs|\.github)/[\w./-]*|\w+\.(?:md|toml|txt|cff))`", text):
        assert (ROOT / path).exists() or path == "mcaptrack.toml" or is_gone(path), path
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    assert set(re.findall(r"\bmake (\w+)[`\n]", text)) <= targets


def test_security_names_the_line_of_releases_that_there_is_and_limits_that_exist():
    from mcaptrack.environment import VARIABLES

    text = (ROOT / "SECURITY.md").read_text()
    assert f"| {'.'.join(__version__.split('.')[:2])}.x | yes |" in text
    assert set(re.findall(r"MCAPTRACK_\w+", text)) <= set(VARIABLES)


def test_the_citation_is_of_this_version_and_names_the_paper():
    said = parsed("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= set(said)  # what the format requires
    assert said["version"] == __version__
    assert ("date-released" in said) == (".dev" not in __version__)
    assert (said["title"], said["license"]) == (PROJECT["name"], PROJECT["license"])
    assert said["repository-code"] == PROJECT["urls"]["Repository"]
    assert [author["name"] for author in said["authors"]] == [author["name"] for author in PROJECT["authors"]]
    (paper,) = said["references"]
    assert (paper["title"], paper["year"]) == ("Towards Robust Human Trajectory Prediction in Raw Videos", 2021)
    assert [author["family-names"] for author in paper["authors"]] == ["Yu", "Zhou"]


def test_the_pythons_and_systems_that_are_claimed_are_those_that_have_to_pass(jobs):
    matrix = jobs["tests"]["strategy"]["matrix"]
    assert set(matrix["python"]) == PYTHONS
    claimed = {line.partition(":: ")[2] for line in PROJECT["classifiers"] if line.startswith("Operating System")}
    assert {SYSTEMS[name.partition("-")[0]] for name in matrix["os"]} == claimed
    # Whatever is only tried may fail; it isn't claimed.
    for one in matrix["include"]:
        assert one["tried"], one
        assert one["python"] not in PYTHONS or one["os"] not in matrix["os"], one
    assert jobs["tests"]["continue-on-error"] == "${{ matrix.tried || false }}"
    assert set(jobs["installs"]["strategy"]["matrix"]["python"]) == PYTHONS
    assert min(PYTHONS, key=lambda name: int(name[2:])) == PROJECT["requires-python"].removeprefix(">=")


def test_the_workflow_checks_what_make_test_checks(jobs):
    run = [re.sub(r"^(?:python -m )?", "", command) for command in steps(jobs["tests"])]
    # And the tests that are left to `make test-all`.
    assert checks_of_make() == [command.replace('-m "" ', "") for command in run if not command.startswith("pip ")]
    assert 'pip install --editable ".[test]"' in run
    assert steps(jobs["make"]) == ["make demo", "make test"]


def test_the_hooks_are_the_checks_of_make_test_in_its_versions():
    (local,) = parsed(".pre-commit-config.yaml")["repos"]
    assert local["repo"] == "local"
    entries = [hook["entry"].replace(" --force-exclude", "") for hook in local["hooks"]]
    wanted = [command.replace(" --check", "") for command in checks_of_make() if not command.startswith("pytest")]
    assert entries == [f".venv/bin/{command}" for command in wanted]
    assert all(hook["language"] == "system" for hook in local["hooks"])


def test_the_page_about_tools_names_each_of_them_with_options_that_it_has():
    text = (ROOT / "tools" / "README.md").read_text()
    scripts = {path.relative_to(ROOT).as_posix() for path in (ROOT / "tools").rglob("*.py")}
    modules = {name.replace(".", "/") + ".py" for name in re.findall(r"-m (tools\.[\w.]+)", text)}
    assert set(re.findall(r"\btools/[\w/]+\.py", text)) | modules == scripts
    assert all((ROOT / name).exists() for name in re.findall(r"\b(?:docs|tests|mcaptrack)/[\w/]+\.\w+", text))
    for line in text.splitlines():
        for script in re.findall(r"(?<=`)[^`]*?python3? (?:-m )?(tools[\w./]+)", line)[:1]:
            path = ROOT / (script if script.endswith(".py") else script.replace(".", "/") + ".py")
            for option in re.findall(r"(?<=[ `])--[\w-]+", line):
                assert f'"{option}"' in path.read_text(), (script, option)


# Tests are skipped for want of a package only where `make test` doesn't install it


INSTALLED = {
    re.split(r"[^\w-]", wanted)[0] for wanted in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["test"]
}


def test_no_test_is_skipped_for_want_of_a_package_that_is_installed():
    texts = {path.name: path.read_text() for path in (ROOT / "tests").rglob("*.py")}
    skipped = {name: set(re.findall(r"importorskip\(\"([\w-]+)", text)) & INSTALLED for name, text in texts.items()}
    assert not {name: packages for name, packages in skipped.items() if packages}


# Functions of the rooms in which a change touches much can be read at once


MOST_LINES, MOST_PATHS = 80, 15
#: What adds a path through a function: the same as `radon cc` counts (McCabe's complexity).
FORKS = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.comprehension, ast.Assert, ast.match_case)


def parts_of(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below one, without functions within it."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield child
            yield from parts_of(child)


def paths_through(function: ast.FunctionDef) -> int:
    nodes = [*parts_of(ast.Module(function.body, []))]
    conditions = sum(len(node.values) - 1 for node in nodes if isinstance(node, ast.BoolOp))
    filters = sum(len(node.ifs) for node in nodes if isinstance(node, ast.comprehension))
    otherwise = sum(bool(node.orelse) for node in nodes if isinstance(node, ast.For | ast.While | ast.Try))
    return 1 + sum(isinstance(node, FORKS) for node in nodes) + conditions + filters + otherwise


def lines_of(function: ast.FunctionDef) -> int:
    """The lines of a function with its signature, without its docstring."""
    first = function.body[0]
    said = first.end_lineno - first.lineno + 1 if ast.get_docstring(function) is not None else 0
    return function.end_lineno - function.lineno + 1 - said


def functions_of(text: str) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))


def test_paths_and_lines_are_counted():
    text = '''
def f(a, b):
    """Not a line.

    Nor these."""
    for x in a or b:  # 3
        if x and (y := [z for z in x if z]):  # 7
            continue
    else:  # 8
        try:
            return 1 if y else 2  # 9
        except ValueError:  # 10
            match y:
                case 1:  # 11
                    pass

    def inner():
        return a if b else a
'''
    assert [(node.name, paths_through(node), lines_of(node)) for node in functions_of(text)] == [
        ("f", 11, 14),
        ("inner", 2, 2),
    ]


@pytest.mark.parametrize("room", ["api", "pipeline"])
def test_functions_can_be_read_at_once(room):
    paths = sorted((ROOT / "mcaptrack" / room).rglob("*.py"))
    assert paths
    large = [
        f"{path.name}: {node.name} has {paths_through(node)} paths and {lines_of(node)} lines"
        for path in paths
        for node in functions_of(path.read_text())
        if paths_through(node) > MOST_PATHS or lines_of(node) > MOST_LINES
    ]
    assert not large, "\n".join(large)


def test_only_types_and_names_of_the_mcap_package_are_used():
    """Reading and writing are ours, so that its reader and writer can say whether they are right."""
    used = {}
    for path in (ROOT / "mcaptrack").rglob("*.py"):
        for name in re.findall(r"^ *(?:from|import) (mcap(?:\.\w+)*)(?= |$)", path.read_text(), re.M):
            used.setdefault(name, set()).add(path.relative_to(ROOT / "mcaptrack").parts[0])
    assert used.pop("mcap.opcode") == {"log"}
    assert used.pop("mcap.records") == {"log", "api"}
    assert used.keys() == {"mcap.decoder", "mcap.exceptions", "mcap.well_known"}
