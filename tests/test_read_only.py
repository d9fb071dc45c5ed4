"""Commands that read change nothing, also for a log that was left half written."""

from __future__ import annotations

import os
import shutil
import stat
from itertools import product
from pathlib import Path

import pytest

from mcaptrack.log.journal import journal_of
from mcaptrack.viewing.serving import Server
from tests.commands import GROUP, call, done, made_log, press_ctrl_c
from tests.extension_cases import of_extensions
from tests.interrupted import everything, interrupt
from tests.logs import READING
from tests.tiers import one_in

#: Those that read no log.
OTHERS = {"demo", "docs", "doctor"}
pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("whole"), 16)


@pytest.fixture(scope="module")
def half(whole, tmp_path_factory) -> Path:
    """A log that was left half written. Tests must not change it."""
    path = tmp_path_factory.mktemp("half") / "a.mcap"
    shutil.copy(whole, path)
    interrupt(path)
    return path


@pytest.fixture
def out(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_command_has_a_case():
    assert READING.keys() | of_extensions("READING").keys() | OTHERS == set(GROUP.commands)


@pytest.mark.parametrize("command", one_in(6, sorted(READING)))
def test_a_half_written_log_stays_as_it_is_and_is_read_as_it_was(command, half, whole, out):
    before = everything(half.parent)
    words = READING[command](half, out)
    outcome = call(command, *words)
    assert everything(half.parent) == before
    said = [line for line in outcome.err.splitlines() if "left half written" in line]
    if command == "view":
        assert outcome.code == 1
        assert "viewers can't open" in outcome.err
    elif command == "check":
        assert outcome.code == 1
        assert "half-written" in outcome.out
    else:
        assert [line.startswith("warning: ") for line in said] == [True]
    shutil.rmtree(out)
    out.mkdir()
    other = call(command, *READING[command](whole, out))
    if command not in ("view", "check"):
        assert outcome.code == other.code
        assert outcome.out.replace(str(half), str(whole)) == other.out


def test_the_next_command_that_writes_restores_the_log_with_a_warning(half, whole, tmp_path):
    path = tmp_path / "a.mcap"
    shutil.copy(whole, path)
    interrupt(path)
    outcome = done("drop", path, "/camera/truth", "-q")
    assert "its state before that has been restored" in outcome.err
    assert not journal_of(path).exists()
    other = tmp_path / "b.mcap"
    shutil.copy(whole, other)
    done("drop", other, "/camera/truth")
    assert path.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("command", sorted(READING))
def test_a_path_that_is_not_a_file_is_refused_in_one_line(command, out):
    """For the log, and for the results beside a log."""
    folder = out / "logs"
    folder.mkdir()
    os.mkfifo(folder / "pipe.mcap")
    (folder / "folder.mcap").mkdir()
    os.mkfifo(folder / "beside.results.mcap")
    shutil.copy(os.devnull, folder / "beside.mcap")
    (folder / "circle.mcap").symlink_to("circle.mcap")
    kinds = {"pipe.mcap": "pipe", "folder.mcap": "folder", "beside.mcap": "", "circle.mcap": "circle.mcap"}
    for name, words in kinds.items():
        before = everything(folder)
        outcome = call(command, *READING[command](folder / name, out))
        assert outcome.code in (1, 2)
        assert "Traceback" not in outcome.err
        assert len([line for line in outcome.err.splitlines() if words in line]) == 1 or not words
        assert everything(folder) == before


# Commands that read change nothing in the folder of the log: no byte, no timestamp, no name


def seen(folder: Path) -> dict[str, tuple[object, ...]]:
    """Return the content and attributes of a folder and of everything in it, except times of access."""
    found = {}
    for path in (folder, *sorted(folder.rglob("*"))):
        about = path.lstat()
        content = path.read_bytes() if stat.S_ISREG(about.st_mode) else path.is_symlink() and path.readlink()
        kind = (about.st_mode, about.st_ino, about.st_nlink, about.st_uid, about.st_gid, about.st_size)
        found[str(path)] = (*kind, about.st_mtime_ns, about.st_ctime_ns, content)
    return found


@pytest.fixture(scope="module")
def template(template, tmp_path_factory) -> Path:
    """A folder with inputs of all commands. Tests must not change it."""
    folder = Path(shutil.copytree(template.parent, tmp_path_factory.mktemp("reading"), dirs_exist_ok=True))
    done("ingest", folder / "clip.mp4", "--truth", folder / "truth.txt", "-o", folder / "fresh.mcap")
    return folder


#: Names of what belongs to a log or could pass for it.
NAMES_BESIDE = (
    "a.mcap.journal", "a.results.mcap", "a.results.mcap.journal", "a.layout.json", "a.tables", ".a.mcap.1.ab.part",
)  # fmt: skip


#: What stands under these names: nothing, noise, or emptiness.
SURROUNDINGS = {"nothing": None, "noise": os.urandom(4096), "emptiness": b""}


@pytest.mark.usefixtures("never_waits")
@pytest.mark.parametrize(
    ("beside", "command"), one_in(7, product(SURROUNDINGS, sorted(READING.keys() | {"docs", "doctor"})))
)
def test_commands_that_read_change_nothing(command: str, beside: str, template: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(Server, "serve_forever", press_ctrl_c)
    folder = tmp_path / "work"
    shutil.copytree(template, folder)
    for path in folder.glob("*.layout.json"):
        path.unlink()
    if (content := SURROUNDINGS[beside]) is not None:
        shutil.rmtree(folder / "a.tables", ignore_errors=True)
        for name in NAMES_BESIDE:
            (folder / name).write_bytes(content)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(folder)
    before = seen(folder)
    others = {
        "docs": [], "doctor": [], "ingest": ["clip.mp4", "-o", elsewhere / "b.mcap"],
        "run": ["fresh.mcap", "-o", elsewhere / "b.mcap"], "view": ["a.mcap"],
    }  # fmt: skip
    words = others[command] if command in others else READING[command](Path("a.mcap"), elsewhere)
    outcome = call(command, *words)
    assert outcome.code in (0, 1), outcome.err
    assert outcome.code == 0 or beside != "nothing", outcome.err
    after = seen(folder)
    assert after.keys() == before.keys()
    assert [name for name in after if after[name] != before[name]] == []
