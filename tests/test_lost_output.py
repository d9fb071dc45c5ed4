"""Whatever becomes of stdout and stderr (closed, full, read by nobody): no traceback, and no harm to a log.

Commands run in processes that are forked from one which has loaded the command line, because 300 starts take minutes.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.commands import GROUP
from tests.extension_cases import of_extensions
from tests.tiers import one_in, thorough

#: Forks a process for each line of JSON on stdin, and prints its exit code. What streams become is as a shell does it.
_SERVER = """
import contextlib, io, json, os, sys
from mcaptrack import __main__ as program
import mcaptrack
from mcaptrack.cli import app

for name in mcaptrack.__all__:
    getattr(mcaptrack, name)
with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
    app(["info", "none.mcap"])  # loads what every command needs

replies = os.fdopen(os.dup(1), "w", buffering=1)
for line in sys.stdin:
    case = json.loads(line)
    child = os.fork()
    if child:
        replies.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\\n")
        continue
    os.chdir(case["folder"])
    replies.close()
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, what in enumerate(case["streams"], start=1):
        name = ("stdout", "stderr")[number - 1]
        if what == "closed":
            os.close(number)
            setattr(sys, name, None)
            continue
        if what == "nobody":
            reader, handle = os.pipe()
            os.close(reader)
        else:
            handle = os.open("/dev/full" if what == "full" else what, os.O_WRONLY | os.O_CREAT)
        os.dup2(handle, number)
        os.close(handle)
        errors = "strict" if number == 1 else "backslashreplace"
        setattr(sys, name, io.TextIOWrapper(open(number, "wb", closefd=False), "utf-8", errors, line_buffering=number == 2))
    sys.argv = ["mcaptrack", *case["words"]]
    program.main()
"""
#: What becomes of stdout and stderr; others are the names of files.
STREAMS = [
    ("closed", "closed"), ("closed", "err"), ("full", "err"), ("out", "full"), ("out", "closed"), ("nobody", "nobody"),
]  # fmt: skip
#: Command lines that print; those that write a log are the first.
LINES = [
    "drop a.mcap /camera/predictions",
    "run a.mcap --force --json",
    "run a.mcap a.mcap clip.mp4 --force --json --log-format json",
    "info a.mcap",
    "check a.mcap",
    *of_extensions("PRINTING"),
    "evaluate a.mcap --json",
    "export a.mcap -o T --json",
    "docs",
    "--version",
    "--help",
    "nothing",
]
EVERY = [f"{command} {words}" for command in GROUP.commands for words in ("--help", "no.mcap --json")]


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with subprocess.Popen(
        [sys.executable, "-c", _SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.stdin.close()


def _run(server: Any, folder: Path, line: str, out: str, err: str) -> tuple[int, str]:
    for name in ("out", "err"):
        (folder / name).unlink(missing_ok=True)
    case = {"folder": str(folder), "words": shlex.split(line), "streams": [out, err]}
    server.stdin.write(json.dumps(case) + "\n")
    server.stdin.flush()
    code = int(server.stdout.readline())
    return code, "".join((folder / name).read_text() for name in ("out", "err") if (folder / name).exists())


def _check(server: Any, folder: Path, line: str, log: Path | None) -> None:
    def fresh() -> None:
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        if log is not None:
            for name in ("a.mcap", "clip.mp4"):
                shutil.copy(log.with_name(name), folder)

    def bytes_of_log() -> bytes:
        return (folder / "a.mcap").read_bytes() if log is not None else b""

    fresh()
    whole_code, _ = _run(server, folder, line, "out", "err")
    answer, written = (folder / "out").read_text(), bytes_of_log()
    for out, err in STREAMS:
        fresh()
        code, printed = _run(server, folder, line, out, err)
        which = (line, out, err, code, printed)
        assert "Traceback" not in printed, which
        assert "ignored" not in printed, which
        if out == "out" or not answer:
            assert code == whole_code, which
        else:
            assert code == 1, which
        if out == "out":
            assert (folder / "out").read_text().count("\n") == answer.count("\n"), which
        if err == "err":
            is_named = out in ("closed", "full") and bool(answer)
            assert printed.count("stdout can't be written") == is_named, which
        if "json-lines" not in line:  # a fleet stops when its lines are lost
            assert bytes_of_log() == written, which
        assert not list(folder.glob("*.journal")) + list(folder.glob(".*.part")), which


@pytest.mark.parametrize("line", one_in(len(LINES), LINES))
def test_an_answer_that_is_lost_is_said(server, tmp_path, template, line):
    _check(server, tmp_path, line, template)


@pytest.mark.parametrize("line", EVERY)
@thorough
def test_of_every_command(server, tmp_path, line):
    _check(server, tmp_path, line, None)
