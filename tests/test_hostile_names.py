"""Whatever names files and logs hold, a terminal sees printable characters, and lines that mcaptrack began."""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from mcaptrack.cli.text import printable
from mcaptrack.sources import demo
from mcaptrack.viewing.serving import Server
from tests.commands import GROUP, Outcome, call, done, press_ctrl_c
from tests.effects.commands import CASES
from tests.tiers import one_in
from tests.worlds import small_scene

#: A line end, a sequence that clears the screen, one in a single character, writing from right to left, markup.
EVIL = "a\nPWNED\r\x1b[2J\x9b31m\u202e\u2028\t[red]:smile: '"
#: What names become in the command lines of the other tests.
RENAMED = {
    name: f"{name[0]}{EVIL}{name[name.index('.') :]}" for name in ("a.mcap", "fresh.mcap", "clip.mp4", "truth.txt")
}
#: The command lines of the other tests, without the options that they look at.
LINES = sorted(
    {(name, case.base) for name, known in CASES.items() for case in known.values() if " -v" not in case.base}
)


@pytest.fixture(scope="module")
def template(template, tmp_path_factory) -> Path:
    """A folder with files and a log of evil names. Not to be changed."""
    folder = Path(shutil.copytree(template.parent, tmp_path_factory.mktemp("evil"), dirs_exist_ok=True))
    done("ingest", folder / "clip.mp4", "--truth", folder / "truth.txt", "-o", folder / "fresh.mcap")
    shutil.copy(folder / "truth.txt", folder / "tall.txt")
    (folder / "old.jsonl").write_text(f"{EVIL}\n")
    (folder / "taken").mkdir()
    (folder / "taken" / "demo.mcap").write_text("")
    for name in ("a.mcap", "fresh.mcap"):
        _with_evil_names(folder / name, folder / "evil.mcap")
        (folder / "evil.mcap").replace(folder / name)
    for name, evil in RENAMED.items():
        (folder / name).rename(folder / evil)
    return folder


def _with_evil_names(path: Path, target: Path) -> None:
    """A log whose camera has the evil name, written by the stock library, with more that is evil."""
    with path.open("rb") as source, target.open("wb") as stream:
        reader, writer = make_reader(source), Writer(stream)
        writer.start("", EVIL)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                how = {name: _replaced(text) for name, text in channel.metadata.items()} | {EVIL: EVIL}
                topic = channel.topic.replace("/camera", f"/{EVIL}")
                number = writer.register_channel(topic, channel.message_encoding, schemas[schema.id], how)
                channels[channel.id] = number
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            writer.add_message(channels[channel.id], data=message.data, sequence=message.sequence, **times)
        made = {"mcaptrack.transform": EVIL, "mcaptrack.input": EVIL, "mcaptrack.parameters": json.dumps({EVIL: EVIL})}
        number = writer.register_channel(f"/{EVIL}", "json", writer.register_schema(EVIL, "jsonschema", b"{}"), made)
        writer.add_message(number, 1, json.dumps({EVIL: EVIL}).encode(), 1)
        for found in reader.iter_metadata():
            writer.add_metadata(found.name, found.metadata)
        writer.add_metadata(EVIL, {EVIL: EVIL})
        writer.add_attachment(1, 1, EVIL, EVIL, b"")
        writer.finish()


def _replaced(text: str) -> str:
    """The camera's evil name, in text or within JSON."""
    return text.replace("/camera", f"/{json.dumps(EVIL)[1:-1] if text.startswith('{') else EVIL}")


@pytest.fixture
def run(template, tmp_path, monkeypatch):
    """Run a command line in a fresh copy of the template, with evil names for its files and channels."""
    monkeypatch.setitem(demo.SCENES, "square", lambda seed: small_scene(2.0, seed=seed))
    monkeypatch.setattr(Server, "serve_forever", press_ctrl_c)
    folders = (tmp_path / str(number) for number in itertools.count())

    def tried(line: str) -> Outcome:
        folder = next(folders)
        shutil.copytree(template, folder)
        monkeypatch.chdir(folder)
        words = [_evil(word) for word in shlex.split(line)]
        logs = any(word.endswith(".mcap") for word in words)
        is_of_camera = logs and "camera" in GROUP.commands[words[0]].settings and words[0] != "ingest"
        return call(*words, *(["--camera", EVIL] if is_of_camera else []))

    return tried


def _evil(word: str) -> str:
    return RENAMED.get(word) or word.replace("/camera", f"/{EVIL}").replace("/others", f"/{EVIL}")


def check(text: str) -> None:
    for line in text.split("\n"):
        assert line.isprintable(), ascii(line)
        assert not line.lstrip().startswith("PWNED"), ascii(text)


@pytest.mark.parametrize(("command", "line"), one_in(12, LINES), ids=[line for _, line in LINES])
def test_no_name_reaches_the_terminal_as_it_is(command, line, run):
    for outcome in (run(f"{line} -v"), run(f"{line} --json") if "--json" not in line else run(line)):
        check(outcome.err)
        check(outcome.out)


@pytest.mark.parametrize("command", sorted(set(GROUP.commands) - {"demo"}))
def test_names_of_files_that_are_not_there(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = call(command, f"{EVIL}.mcap", *(["/a"] if command == "drop" else []))
    check(outcome.err)
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1 or outcome.code == 2


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_a_name_that_is_no_text(tmp_path, template):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/a\xff\x1b.mcap"))
    shutil.copy(template / RENAMED["a.mcap"], path)
    for command in ("info", "check", "evaluate", "run"):
        outcome = call(command, path)
        assert outcome.code in (0, 1)
        check(outcome.out + outcome.err)
        assert r"a\udcff\x1b.mcap" in outcome.out + outcome.err or command == "evaluate"
    assert json.loads(done("info", path, "--json").out)["results"][0]["log"] == str(path)


def test_every_character_is_shown_or_has_an_escape_of_its_own():
    shown = [printable(chr(code)) for code in range(0x30000)]
    assert all(text.isprintable() for text in shown)
    assert len(set(shown)) == len(shown)
    assert printable("\n\t\r\0\x1b\x7f\x9b\u202e\u2066\ufeff\u2028\udcff") == (
        r"\n\t\r\x00\x1b\x7f\x9b\u202e\u2066\ufeff\u2028\udcff"
    )
    assert printable("Zürich 東京 :smile: [red]") == "Zürich 東京 :smile: [red]"


def test_nothing_but_one_module_prints():
    """So that names in what commands print tomorrow are escaped, too; Typer prints help, and ``evaluate`` data."""
    package = Path(sys.modules["mcaptrack.cli"].__file__ or "").parent
    for path in package.glob("*.py"):
        found = re.findall(r"(?<![\w.])print\(|\bConsole\(|\bstd(?:out|err)\.write|\becho\(", path.read_text())
        allowed = {"command.py": 1, "text.py": 3, "common.py": 2, "group.py": 1}.get(path.name, 0)
        assert len(found) == allowed, (path.name, found)
