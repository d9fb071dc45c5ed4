"""The tool that installs the wheel on every Python: what it tries, what it skips, and that it never does so silently."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("installs", ROOT / "tools" / "installs.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["installs"] = module
    spec.loader.exec_module(module)
    return module


def program(path: Path, said: str, code: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\ncat <<'END'\n{said}\nEND\nexit {code}\n")
    path.chmod(0o755)
    return path


def test_every_python_is_found_once_in_its_latest_release(tool, tmp_path, monkeypatch):
    program(tmp_path / "bin" / "python3.97", "3 97 1")
    program(tmp_path / "bin" / "python3.99", "no such version is chosen", 127)
    program(tmp_path / "bin" / "python3.10", "3 10 4")
    program(tmp_path / "bin" / "python3.97-config", "3 96 0")
    later = program(tmp_path / "pyenv" / "versions" / "3.97.2" / "bin" / "python3", "3 97 2")
    program(tmp_path / "pyenv" / "versions" / f"{sys.version_info[0]}.{sys.version_info[1]}.99" / "bin" / "python3", "")
    other = program(tmp_path / "managed" / "python3.98", "3 98 0")
    listed = json.dumps([{"path": str(other)}, {"path": str(tmp_path / "not there")}])
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    found = {each.minor: each for each in tool.pythons(program(tmp_path / "uv", listed))}
    assert found["3.97"] == ((3, 97, 2), later)
    assert found["3.98"] == ((3, 98, 0), other)
    own = found.get(f"{sys.version_info[0]}.{sys.version_info[1]}")
    assert own is None or own.path == Path(sys.executable)  # Debian may have it without what makes environments
    assert not {"3.10", "3.99", "3.96"} & found.keys()
    assert {"3.11", "3.12", "3.13"} <= tool.NAMED


def test_releases_that_are_not_the_lowest_are_named(tool):
    wanted = ["av>=17", "opencv-python-headless>=4.13,<6", "mcap>=1.2", "ruamel.yaml>=0.18"]
    has = {"av": "17.0.1", "opencv-python-headless": "4.13.0.90", "mcap": "1.20", "ruamel-yaml": "0.18.5"}
    assert [line.split()[0] for line in tool.higher(wanted, has)] == ["mcap"]


def test_nothing_that_is_installed_needs_torch(tool):
    extras = tool.PROJECT["optional-dependencies"]
    named = [*tool.PROJECT["dependencies"], *(each for extra in tool.EXTRAS for each in extras[extra])]
    assert not any(re.match("torch", each) for each in named)


def test_what_fails_and_what_is_skipped_is_said_in_a_line(tool, capsys):
    attempt = tool.Attempts()

    def fails(said: str):
        raise tool.Failed(f"$ pip install x\nexit 1\n{said}\n")

    attempt("one", lambda: fails("NewConnectionError(...): refused"))
    attempt("two", lambda: fails("AssertionError: no people"))
    attempt("three", tool.in_time(lambda: ["done"], 0))
    attempt("four", tool.in_time(lambda: ["done"], float("inf")))
    assert attempt.failed == ["one", "two"]
    out = capsys.readouterr().out
    assert "FAILED: one: the package registry can't be reached (NewConnectionError)\n" in out
    assert "FAILED: two: AssertionError: no people\n" in out
    assert "skipped: three: the 0 minutes are over\n" in out
    assert re.search(r"^ok: four \(\d+ s\)\n    done$", out, re.M)


def test_wheels_may_lack_only_where_nothing_is_promised(tool):
    command = (sys.executable, "-c", "raise SystemExit('x has no usable wheels')")
    with pytest.raises(tool.Skipped, match=r"no wheels for Python 3\.99 yet"):
        tool.with_wheels(tool.Python((3, 99, 0), Path("x")), *command)
    with pytest.raises(tool.Failed):
        tool.with_wheels(tool.Python((3, 11, 0), Path("x")), *command)
