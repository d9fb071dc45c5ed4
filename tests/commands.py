"""The command line within the process of the tests, and a small log to run it on."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from typer.main import get_command

from mcaptrack.api.running import RunResult
from mcaptrack.cli import app
from tests.extension_cases import of_extensions
from tests.worlds import write_clip

GROUP = get_command(app)
#: Commands that change no file except the one that -o names.
ONLY_READ = ("check", "docs", "doctor", "evaluate", "info", "view")


class Outcome(NamedTuple):
    """What came of a command."""

    code: int
    out: str
    err: str


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        return True

    def shown(self) -> str:
        """What was written, without colours and moves of the cursor."""
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.getvalue())


def press_ctrl_c(*_: object, **__: object) -> None:
    """Take the place of what would last until Ctrl-C, such as serving a log."""
    raise KeyboardInterrupt


def call(*words: object, folder: Path | None = None, environment: Mapping[str, str] | None = None) -> Outcome:
    """Run a command in this process, which is quicker than in one of its own."""
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        if folder:
            patch.chdir(folder)
        for name, value in (environment or {}).items():
            patch.setenv(name, value)
        try:
            GROUP.main([str(word) for word in words], prog_name="mcaptrack")
        except SystemExit as ended:
            code = ended.code or 0
    assert isinstance(code, int)
    return Outcome(code, out.getvalue(), err.getvalue())


def done(*words: object, folder: Path | None = None) -> Outcome:
    """Run a command that has to succeed."""
    outcome = call(*words, folder=folder)
    assert outcome.code == 0, outcome.err
    return outcome


def printed(*words: object, folder: Path | None = None) -> tuple[str, str]:
    """What a command that has to succeed prints to stdout and stderr."""
    return done(*words, folder=folder)[1:]


def start(*words: object, folder: Path | None = None) -> subprocess.Popen[str]:
    """A command in a process of its own."""
    command = [sys.executable, "-m", "mcaptrack", *map(str, words)]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def toml_value(value: object) -> str:
    """A value as TOML has it."""
    return (
        f"[{', '.join(map(toml_value, value))}]"
        if isinstance(value, list)
        else str(value).lower()
        if isinstance(value, bool)
        else repr(value)
        if isinstance(value, int | float)
        else f'"{value}"'
    )


def made_log(folder: Path, frames: int = 30) -> Path:
    """A log of two people who walk beside each other, found, tracked, predicted and re-tracked."""
    write_clip(folder / "clip.mp4", frames)
    rows = [
        f"{frame + 1},{person + 1},{frame + 20 * person},24,8,8,1,1,1" for frame in range(frames) for person in (0, 1)
    ]
    (folder / "truth.txt").write_text("\n".join(rows) + "\n")
    (folder / "plane.txt").write_text("0.1,0,0\n0,0.1,0\n0,0,1\n")
    for name, text in of_extensions("FILES").items():
        (folder / name).write_text(text)
    path = folder / "a.mcap"
    labels = ["--truth", folder / "truth.txt", "--ground-plane", folder / "plane.txt"]
    done("ingest", folder / "clip.mp4", *labels, "-o", path)
    done("run", path)
    return path


def run_result(**changed: Any) -> RunResult:
    """The result of a run that did nothing in 1.26 s, but for what is given."""
    names = ("frames", "rows", "tracks", "events", "finished", "tables", "seconds_by_part")
    plain = dict.fromkeys(("stages", "stale", "layouts", "warnings", "notes"), ()) | {name: {} for name in names}
    plain |= {"log": Path("a b.mcap"), "written_to": Path("a b.mcap"), "written_because": "", "seconds": 1.26}
    return RunResult(**{"summary": None} | plain | changed)
