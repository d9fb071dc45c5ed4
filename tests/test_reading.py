"""Commands that read change nothing in the folder of the log: no byte, no timestamp, no name.

Which commands read, they declare themselves; all others leave everything as it is where ``-o`` names another place.
"""

from __future__ import annotations

import os
import shlex
import shutil
import stat
from pathlib import Path

import pytest

from mcaptrack.viewing.serving import Server
from tests.commands import GROUP, call, done
from tests.effects.commands import CASES
from tests.tiers import one_in

#: What a command is given, where the case without options of the other tests isn't what reads most.
LINES = {
    "query": "query a.mcap 'select count(*) as n from tracks'",
    "evaluate": "evaluate a.mcap",
    "tune": "tune a.mcap --trials 1 --search min-iou --study {elsewhere}/b.jsonl",
    "train": "train a.mcap",
    "fuse": "fuse a.mcap",
}


def line_of(command: str) -> str:
    """Return a command line that should change nothing in the folder."""
    base = LINES.get(command) or CASES[command]["json"].base
    name = {"train": "b", "export": "b", "report": "b.html", "render": "b.mp4", "tune": "b.toml"}
    output = f" -o {{elsewhere}}/{name.get(command, 'b.mcap')}"
    return base if GROUP.commands[command].reads else base + output


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
BESIDE = (
    "a.mcap.journal",
    "a.results.mcap",
    "a.results.mcap.journal",
    "a.layout.json",
    "a.tables",
    ".a.mcap.1.ab.part",
)


#: What stands under these names: nothing, noise, or emptiness.
SURROUNDINGS = {"nothing": None, "noise": os.urandom(4096), "emptiness": b""}


def _interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.usefixtures("never_waits")
@pytest.mark.parametrize("beside", one_in(2, SURROUNDINGS))
@pytest.mark.parametrize(
    "command", sorted(set(GROUP.commands) - {"calibrate", "demo", "models", "train"})
)  # train needs torch, and calibrate several cameras
def test_commands_that_read_change_nothing(command: str, beside: str, template: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(Server, "serve_forever", _interrupted)
    folder = tmp_path / "work"
    shutil.copytree(template, folder)
    for path in folder.glob("*.layout.json"):
        path.unlink()
    if (content := SURROUNDINGS[beside]) is not None:
        shutil.rmtree(folder / "a.tables", ignore_errors=True)
        for name in BESIDE:
            (folder / name).write_bytes(content)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(folder)
    before = seen(folder)
    outcome = call(*shlex.split(line_of(command).format(elsewhere=tmp_path / "elsewhere")))
    assert outcome.code in (0, 1), outcome.err
    assert outcome.code == 0 or beside != "nothing", outcome.err
    after = seen(folder)
    assert after.keys() == before.keys()
    assert [name for name in after if after[name] != before[name]] == []
