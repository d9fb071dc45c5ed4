"""Ctrl-C and SIGTERM end every command soon, with the exit code of the signal, and leave the files unchanged."""

from __future__ import annotations

import shutil
import signal
import tempfile
from pathlib import Path

import pytest

from mcaptrack.cli.group import Commands
from tests import bounded
from tests.commands import ONLY_READ, done
from tests.extension_cases import of_extensions
from tests.logs import READING, on_a_log
from tests.tiers import one_in

#: Seconds of processor time that a command may still take: the time on a clock depends on what else the machine does.
SOON_S = 2
SIGNALS = {"Ctrl-C": signal.SIGINT, "kill": signal.SIGTERM}
#: Command lines other than on a log with all results.
LINES = {
    "demo": "demo", "docs": "docs tables", "doctor": "doctor", "ingest": "ingest clip.mp4",
    "run": "run fresh.mcap", "view": "view a.mcap", **of_extensions("LINES"),
}  # fmt: skip
#: What is looked at of a command, where it is not the reading, and the writing and publishing of those that write.
DEEDS = {
    "demo": ["write"],
    "doctor": ["write"],
    "view": ["read", "serve"],
} | of_extensions("DEEDS")
MOMENTS = [
    (command, deed)
    for command in sorted(LINES.keys() | READING.keys())
    for deed in DEEDS.get(command)
    or (
        ["read"]
        if command in ONLY_READ or "output" not in Commands()[command].settings
        else ["read", "write", "publish"]
    )
]
#: Where these commands read or write; all others do so in the working folder.
ELSEWHERE = {"docs": Path(__file__).parent.parent / "docs", "doctor": Path(tempfile.gettempdir())}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(entry): entry.read_bytes() for entry in folder.rglob("*") if entry.is_file()}


@pytest.fixture(scope="module")
def folder(template, tmp_path_factory) -> Path:
    """A folder with inputs of all commands. An interrupted command must not change it."""
    folder = tmp_path_factory.mktemp("ended")
    for name in ("a.mcap", "clip.mp4", "plane.txt", "truth.txt"):
        shutil.copy(template.with_name(name), folder)
    done("ingest", folder / "clip.mp4", "--truth", folder / "truth.txt", "-o", folder / "fresh.mcap")
    return folder


@pytest.mark.parametrize("number", one_in(6, range(len(MOMENTS))), ids=[" ".join(moment) for moment in MOMENTS])
def test_a_signal_ends_a_command_and_leaves_the_files_unchanged(number, commands, folder):
    command, deed = MOMENTS[number]
    where = ELSEWHERE.get(command, folder)
    name = list(SIGNALS)[number // 2 % 2]
    words = LINES[command].split() if command in LINES else [command, *on_a_log(command, folder / "a.mcap", folder)]
    before = contents(folder)
    outcome = commands.end(bounded.Moment(deed, where, SIGNALS[name]), *words)
    assert outcome.code == 128 + SIGNALS[name], outcome
    assert "Traceback" not in outcome.err
    assert outcome.cpu_s - outcome.signal_cpu_s < SOON_S
    assert contents(folder) == before
