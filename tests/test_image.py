"""The Dockerfile, as far as it can be tried without Docker, and the night's job that uses its image."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.tiers import thorough

ROOT = Path(__file__).parent.parent
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
