"""What is built and installed: the wheel, the source distribution, and what both say of themselves."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from email.message import Message
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder
from typer.main import get_command

from mcaptrack import __version__
from mcaptrack.cli import app
from tests.commands import call
from tests.sources import PACKAGE, texts
from tests.tiers import thorough
from tools.pages import with_links_that_lead

# The Dockerfile, as far as it can be tried without Docker, and the night's job that uses its image.


ROOT = Path(__file__).parent.parent
PAGES = [path for folder in ("docs", "docs/extensions") for path in (ROOT / folder).glob("*.md")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HOME = "https://github.com/mcaptrack/mcaptrack"


@pytest.fixture(scope="module")
def sdist(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    (artifact,) = SdistBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with tarfile.open(artifact) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"mcaptrack-{__version__}"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    (artifact,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"])
    return Path(artifact)


@pytest.fixture(scope="module")
def shipped(wheel) -> set[str]:
    return set(zipfile.ZipFile(wheel).namelist())


@pytest.fixture(scope="module")
def metadata(wheel, shipped) -> Message:
    (name,) = (name for name in shipped if name.endswith(".dist-info/METADATA"))
    return message_from_bytes(zipfile.ZipFile(wheel).read(name))


@thorough
def test_the_source_distribution_has_every_file_of_the_repository(sdist):
    if not (ROOT / ".git").exists():
        pytest.skip("this is no clone")
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, check=True, text=True).stdout
    kept = {name for name in listed.split("\0") if name and (ROOT / name).exists()}
    built = {path.relative_to(sdist).as_posix() for path in sdist.rglob("*") if path.is_file()}
    assert kept - built == set()
    assert built - kept == {"PKG-INFO"}


@thorough
def test_the_source_distribution_builds_the_same_wheel(sdist, wheel, tmp_path):
    (again,) = WheelBuilder(str(sdist)).build(directory=str(tmp_path), versions=["standard"])
    assert Path(again).read_bytes() == wheel.read_bytes()


def test_the_wheel_has_all_that_is_needed_and_nothing_else(shipped):
    package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "mcaptrack").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    schemas = {f"mcaptrack/schemas/{path.name}" for path in (ROOT / "schemas").glob("*.proto")}
    pages = {
        f"mcaptrack/docs/{path.relative_to(ROOT / 'docs') if path.is_absolute() else path}"
        for path in [*PAGES, *map(Path, ("README.md", "CHANGELOG.md"))]
    }
    about = {name for name in shipped if name.startswith(f"mcaptrack-{__version__}.dist-info/")}
    assert shipped == package | schemas | pages | about
    assert {"mcaptrack/py.typed", "mcaptrack/__init__.pyi"} <= package
    assert {"mcaptrack/predictors/trained/red.safetensors", "mcaptrack/predictors/trained/lstm.safetensors"} <= package
    assert f"mcaptrack-{__version__}.dist-info/licenses/LICENSE" in about


def test_the_wheel_names_the_project_and_its_authors(metadata):
    urls = dict(line.split(", ") for line in metadata.get_all("Project-URL"))
    assert set(urls) == {"Homepage", "Repository", "Documentation", "Changelog", "Issues"}
    for address in urls.values():
        assert address == HOME or address.startswith(f"{HOME}/")
        named = re.fullmatch(rf"{HOME}/(?:tree|blob)/main/(.+)", address)
        assert named is None or (ROOT / named[1]).exists()
    assert metadata["Author"] == "The mcaptrack authors"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.11"
    assert "Typing :: Typed" in metadata.get_all("Classifier")


def test_dependencies_have_a_lower_bound_that_is_tried_and_the_same_one_everywhere():
    extras = PROJECT["optional-dependencies"]
    bounds: dict[str, set[str]] = {}
    for wanted in [*PROJECT["dependencies"], *(each for extra in extras.values() for each in extra)]:
        name, bound = re.fullmatch(r"([\w.-]+)(.*)", wanted).groups()
        bounds.setdefault(name.lower(), set()).add(bound)
    assert all(len(found) == 1 and ">=" in next(iter(found)) for found in bounds.values()), bounds


# What people read: help, and the strings that errors and notes are made of.


def help_texts() -> Iterator[tuple[str, str]]:
    for name, command in get_command(app).commands.items():
        yield name, command.help or ""
        yield from (
            (f"{name} {parameter.name}", getattr(parameter, "help", None) or "") for parameter in command.params
        )


@cache
def said() -> list[tuple[str, str]]:
    """Every text of the package but docstrings; those of commands are their help."""
    modules = sorted(PACKAGE.rglob("*.py"))
    return [*help_texts(), *(text for path in modules for text in texts(path, with_help=True))]


def test_pages_that_help_and_errors_name_are_in_the_wheel(shipped):
    named = [(where, page) for where, text in said() for page in re.findall(r"`mcaptrack docs (\w+)`", text)]
    assert {page for _, page in named} >= {"tables", "options"}
    for where, page in named:
        assert {f"mcaptrack/docs/{name}.md" for name in (page, page.upper(), f"extensions/{page}")} & shipped, where


def test_help_and_errors_name_no_file_of_the_repository():
    """Whoever installed a wheel has none of them, or has them elsewhere."""
    ours = {path.relative_to(ROOT).parts[0] for path in ROOT.iterdir()} - {"mcaptrack", ".git"}
    folders = "|".join(re.escape(name) for name in sorted(ours) if (ROOT / name).is_dir() and not name.startswith("."))
    files = "|".join(re.escape(name) for name in sorted(ours) if (ROOT / name).is_file())
    named = re.compile(rf"(?<![\w/.-])(?:(?:{folders})/[\w./-]*\w|{files})|[\w/-]+\.md\b")
    found = {(where, match) for where, text in said() for match in named.findall(text)}
    assert found == set()


# The command


def test_the_pages_are_listed_and_printed_as_they_were_written():
    code, out, _ = call("docs")
    listed = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert (code, next(iter(listed))) == (0, "readme")
    assert set(listed) == {path.stem for path in PAGES} | {"readme", "changelog"}
    assert listed["results"] == "Results"
    said = json.loads(call("docs", "--json")[1])
    assert {page["name"]: page["title"] for page in said["pages"]} == listed
    text = (ROOT / "docs" / "results.md").read_text()
    for name in ("results", "RESULTS.md", "docs/results.md"):
        assert call("docs", name)[1] == text
    assert json.loads(call("docs", "results", "--json")[1])["text"] == text


def test_pages_are_printed_with_their_generated_parts():
    """Those of the site alone stand in docs/reference."""
    for page in json.loads(call("docs", "--json").out)["pages"]:
        assert "<!-- generated" not in call("docs", page["name"]).out


def test_a_page_that_is_not_there_is_said_with_those_that_are():
    for page, meant in (("tabels", "tables"), ("images", "ingest")):
        code, _, err = call("docs", page)
        assert code == 1
        assert err.startswith(f"mcaptrack: there is no page {page}; did you mean {meant}? There are readme, ")


def test_links_of_the_pages_lead_somewhere():
    lost = []
    for path in [*PAGES, ROOT / "README.md"]:
        text = with_links_that_lead(path.read_text())
        targets = [target for target in re.findall(r"\]\(([^)#][^)]*)\)", text) if not target.startswith("https://")]
        lost += [(path.name, one) for one in targets if not (path.parent / one.partition("#")[0]).exists()]
        heads = [line.lstrip("# ") for line in text.splitlines() if line.startswith("#")]
        headings = {re.sub(r"[^\w -]", "", head).lower().replace(" ", "-") for head in heads}
        lost += [(path.name, one) for one in set(re.findall(r"\]\(#([^)]+)\)", text)) - headings]
    assert lost == []


TEXT = (ROOT / "Dockerfile").read_text()
#: The instructions, and what follows them.
LINES = [tuple(line.split(None, 1)) for line in TEXT.splitlines() if line and not line.startswith("#")]


def named(instruction: str) -> list[str]:
    return [words for name, words in LINES if name == instruction]


def is_sent(path: str) -> bool:
    """Whether .dockerignore lets a file through: the last pattern that fits it or a folder above it counts."""
    above = [path, *(str(parent) for parent in Path(path).parents if str(parent) != ".")]
    kept = True
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        pattern, keeps = line.removeprefix("!"), line.startswith("!")
        anywhere = pattern.removeprefix("**/")
        fits = any(
            fnmatch(name, pattern) or (anywhere != pattern and fnmatch(Path(name).name, anywhere)) for name in above
        )
        if line and not line.startswith("#") and fits:
            kept = keeps
    return kept


def test_what_is_copied_is_there_and_gives_the_wheel_of_the_repository(tmp_path):
    for words in named("COPY"):
        if words.startswith("--from=built"):
            assert words.split()[1:] == ["/opt/mcaptrack", "/opt/mcaptrack"]
            continue
        *sources, target = words.split()
        for source in sources:
            path = ROOT / source
            assert path.exists(), source
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                name = file.relative_to(ROOT)
                if file.is_file() and "__pycache__" not in name.parts and is_sent(str(name)):
                    place = tmp_path / target / (name if len(sources) > 1 else file.relative_to(path))
                    place.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(file, place)
    assert not is_sent("tests/conftest.py")
    assert not is_sent(".git/config")
    made = [WheelBuilder(str(place)).build(directory=str(tmp_path / name), versions=["standard"]) for name, place in {
        "one": ROOT, "other": tmp_path}.items()]  # fmt: skip
    one, other = (Path(next(iter(each))).read_bytes() for each in made)
    assert one == other


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
def test_what_is_left_out_is_what_nothing_needs(tmp_path):
    """In a folder with the files of the packages; `doctor`, the health check, finds what lacks a library."""
    packages = tmp_path / "lib" / "python3.12" / "site-packages"
    kept = ["pyarrow/libarrow.so.2600", "pyarrow/libarrow_substrait.so.2600", "scipy/a.py", "numpy/testing/a.py"]
    left = ["pyarrow/libarrow_flight.so.2600", "pyarrow/_flight.so", "pyarrow/include/a.h", "scipy/b/tests/a.py"]
    for name in (*kept, *left):
        (packages / name).parent.mkdir(parents=True, exist_ok=True)
        (packages / name).touch()
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\necho "$@" > "$0.said"\n')
    python.chmod(0o755)
    for line in runpy.run_path(str(ROOT / "tools" / "installs.py"))["slimming"](TEXT):
        subprocess.run(["sh", "-c", line.replace("/opt/mcaptrack", str(tmp_path))], check=True)
    assert {str(path.relative_to(packages)) for path in packages.rglob("*") if path.is_file()} == set(kept)
    assert (tmp_path / "bin" / "python.said").read_text() == "-m pip uninstall --yes pip\n"


@thorough
@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
def test_a_nights_job_names_what_failed_and_does_the_rest_once(template, tmp_path):
    (tmp_path / "recordings" / "deep").mkdir(parents=True)
    shutil.copy(template, tmp_path / "recordings" / "deep" / "a.mcap")
    (tmp_path / "recordings" / "cut.mcap").write_bytes(template.read_bytes()[:3000])
    environment = {**os.environ, "MCAPTRACK": f"{sys.executable} -m mcaptrack", "PYTHONPATH": str(ROOT)}
    night = ["sh", ROOT / "examples" / "nightly.sh", tmp_path]
    assert subprocess.run(night, env=environment, check=False).returncode == 3
    lines = [json.loads(line) for line in (tmp_path / "nightly.log").read_text().splitlines()]
    failed = {(line["command"], line["log"]) for line in lines if line["event"] == "log" and line["level"] == "error"}
    assert failed == {(name, "recordings/cut.mcap") for name in ("run", "export")}
    assert len([line for line in lines if line["event"] == "summary"]) == 2
    assert (tmp_path / "tables" / "tracks" / "recording=a").is_dir()
    (tmp_path / "recordings" / "cut.mcap").unlink()
    assert subprocess.run(night, env=environment, check=False).returncode == 0
    done = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    assert [Path(line["location"]).name for line in done if line["state"] in ("done", "up-to-date")] == ["a.mcap"]
