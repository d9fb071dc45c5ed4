"""Every command that a message proposes works, for any name of a file."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.cli.text import with_flags
from mcaptrack.errors import McaptrackError, command
from mcaptrack.schema import TRACKS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.viewing import serving
from tests.commands import GROUP, call, done
from tests.extension_cases import of_extensions
from tests.interrupted import interrupt
from tests.robots import write_log
from tests.sources import PACKAGE, texts
from tests.tiers import one_in

#: A name that is difficult for a shell, an option parser and a parser of messages.
NAME = "-a  b'c$(x)`.mcap".replace("`", "")
VERBS = "|".join(GROUP.commands)


class Scene:
    """A folder with a log that has an odd name, its video and its labels."""

    def __init__(self, template: Path, folder: Path) -> None:
        for name in ("clip.mp4", "truth.txt", "plane.txt"):
            shutil.copy(template.with_name(name), folder / name)
        (folder / "boxes.txt").write_text("".join(f"{n},-1,{n},24,8,8,1,-1,-1,-1\n" for n in range(1, 31)))
        shutil.copy(template, folder / NAME)
        self.path = Path(NAME)

    def says(self, *words: str) -> str:
        """Run a command on the log (LOG), and return what it prints."""
        given = [f"./{NAME}" if word == "LOG" else word for word in words]
        outcome = call(*given)
        return outcome.err + outcome.out

    def without(self, *topics: str) -> Scene:
        """Remove channels from the log."""
        done("drop", f"./{NAME}", *topics, "-o", "left.mcap")
        Path("left.mcap").replace(NAME)
        return self

    def ingested(self, *words: str) -> Scene:
        """Make the log again."""
        done("ingest", *words, "-o", f"./{NAME}", "--force")
        return self

    def without_temporary_folder(self) -> str:
        """Look at a log that lacks views, where none can be drawn."""
        self.ingested("clip.mp4", "--truth", "truth.txt", "--ground-plane", "plane.txt")
        with patch.object(tempfile, "tempdir", "./gone"):
            return self.says("view", "LOG")

    def cubes(self) -> Scene:
        """Add a file of 3D labels."""
        Path("cubes.csv").write_text("t,id,x_m,y_m\n0,1,2,3\n1,1,2,3\n")
        return self

    def damaged(self) -> str:
        """Change a byte of each chunk except the last."""
        data = bytearray(self.path.read_bytes())
        with log.read(self.path) as opened:
            places = [chunk.chunk_start_offset + 200 for chunk in opened.index.chunks[:-1]]
        for place in places:
            data[place] ^= 0xFF
        self.path.write_bytes(data)
        return self.says("export", "LOG", "-o", "tables")

    def half_written(self) -> Scene:
        """Interrupt a change of the log."""
        interrupt(self.path.resolve())
        return self

    def late(self) -> str:
        """Add messages with times out of range."""
        channel = (TRACKS.name, "protobuf", TRACKS.descriptor)
        with log.read(self.path) as opened, log.extend(opened) as writer:
            number = writer.add_channel("/camera/late", channel, "protobuf", {})
            writer.add_message(number, 2**63 + 5, 0, TRACKS.codec.encode(TRACKS.empty()))
        return self.says("sample", "LOG", "--topic", "/camera/late", "--to", "/camera/later")

    def elsewhere(self) -> str:
        """Add detections of other software to the channel where a stage would write."""
        write_log(self.path, "/eye/image", boxes="/eye/detections")
        return self.says("run", "LOG", "--topic", "/eye/image")

    def side_view(self) -> str:
        """Detect people at one distance, seen from their height, without a ground plane."""
        rows = [f"{n},-1,{n * 2},{20 + k % 2},20,60,1,-1,-1,-1" for n in range(1, 60) for k in (0, 1)]
        Path("boxes.txt").write_text("\n".join(rows))
        return self.ingested("boxes.txt", "--as", "detections", "--fps", "10").says("run", "LOG", "--no-tables")

    def of_a_later_version(self) -> str:
        Path("mcaptrack.toml").write_text("[track]\nmax-age-s = 7.0\n")
        return self.says("run", "LOG", "--no-tables")

    def of_an_older_version(self) -> str:
        written = Provenance.to_metadata
        with pytest.MonkeyPatch.context() as before:
            before.setattr(Provenance, "to_metadata", lambda made: written(replace(made, version="0.2.0")))
            self.says("detect", "LOG")
        return self.says("run", "LOG", "--no-tables")

    def by_own_tracker(self) -> str:
        """Track with a class in a file, and make the tracks out of date."""
        text = "from mcaptrack.transforms import Sort\n\n\nclass Own(Sort):\n    pass\n"
        Path("own_tracker_of_a_scene.py").write_text(text)
        self.says("track", "LOG", "--tracker", "own_tracker_of_a_scene:Own")
        self.says("detect", "LOG", "--detector", "knn")
        return self.says("run", "LOG", "--no-tables")

    def timed(self, name: str) -> Scene:
        """Write tracks that name times, not frames."""
        rows = "".join(f"{n / 10},1,{n},24,8,8\n" for n in range(1, 31))
        Path(name).write_text("t,id,x,y,w,h\n" + rows)
        return self

    def video(self) -> str:
        """Replace the log by a video."""
        shutil.copy("clip.mp4", self.path)
        return self.says("info", "LOG")

    def followed(self) -> str:
        """A log without tracks, and one that follows it."""
        shutil.copy(self.path, "next.mcap")
        self.untracked()
        with pytest.raises(McaptrackError) as refused:
            mcaptrack.run("next.mcap", follows=self.path)
        return with_flags(str(refused.value))

    def without_views(self) -> str:
        """Look for views of a log that nothing was found in."""
        with log.read(self.untracked().path) as opened, pytest.raises(McaptrackError) as refused:
            pipeline.find_views(opened, "/camera")
        return with_flags(str(refused.value))

    def untracked(self) -> Scene:
        return self.ingested("clip.mp4", "--truth", "truth.txt", "--ground-plane", "plane.txt")


#: By module, function and verb: a scene in which the message comes.
SCENES: dict[str, Callable[[Scene], str]] = {
    "cli/group.py:resolve_command:info": lambda s: s.says("LOG"),
    "cli/files.py:logs:drop": lambda s: s.says("drop", "/camera/video", "LOG"),
    "sources/ingest/labels/format.py:_instead:ingest": lambda s: s.says("ingest", "plane.txt", "-o", "b.mcap"),
    "tables/export/__init__.py:_note_left_out:export": lambda s: s.says(
        "export", "LOG", "--topic", "/camera/video", "-o", "tables"
    ),
    "cli/running.py:next_commands:*": lambda s: s.says("run", "LOG", "--no-tables"),
    "api/scoring.py:_smoothed:run": lambda s: s.without("/camera/predictions*").says(
        "evaluate", "LOG", "--set", "smoothed=true"
    ),
    "pipeline/following.py:_check_camera:run": Scene.followed,
    "api/running.py:warn_stale:run": lambda s: s.says("detect", "LOG", "--detector", "knn"),
    "api/ingesting.py:_changes:run": lambda s: s.says("ingest", "truth.txt", "--as", "corrections", "--into", "LOG"),
    "api/running.py:products:export": lambda s: s.says("run", "s3://bucket/a.mcap"),
    "evaluation/__init__.py:sequence_of_log:run": lambda s: s.untracked().says("evaluate", "LOG"),
    "evaluation/__init__.py:sequence_of_log:ingest": lambda s: s.untracked().says("evaluate", "LOG"),
    "evaluation/__init__.py:ground_truth_of_log:ingest": lambda s: s.without("/camera/truth*").says("evaluate", "LOG"),
    "api/viewing.py:_note_trouble:ingest": lambda s: s.says("view", "LOG", "--links"),
    "api/viewing.py:view:run": lambda s: s.ingested("clip.mp4", "--truth", "truth.txt").says("view", "LOG", "--links"),
    "pipeline/views.py:with_views:run": Scene.without_temporary_folder,
    "api/viewing.py:view:recover": lambda s: s.half_written().says("view", "LOG"),
    "tables/compared.py:pair_files:ingest": lambda s: s.without("/camera/truth*").says(
        "evaluate", "LOG", "--truth", "truth.txt"
    ),
    "log/journal.py:recover_command:recover": Scene.damaged,
    "log/reader.py:reporting_bad_times:drop": Scene.late,
    "log/recording_files.py:not_mcap:ingest": Scene.video,
    "log/reader.py:channel:info": lambda s: s.says("export", "LOG", "--topic", "/nothing"),
    "pipeline/checks.py:_lacks:info": lambda s: s.says("sample", "LOG", "--topic", "/nothing"),
    "pipeline/checks.py:_lacks:ingest": lambda s: s.ingested("truth.txt", "--as", "truth", "--fps", "10").says(
        "run", "LOG"
    ),
    "pipeline/events.py:make:run": lambda s: s.untracked().says("events", "LOG"),
    "pipeline/views.py:find_views:run": Scene.without_views,
    "pipeline/planes.py:plane_in_words:ingest": Scene.side_view,
    "pipeline/runner.py:_warn_held_back:retrack": Scene.side_view,
    "pipeline/plan.py:_warn_settings:run": Scene.of_a_later_version,
    "pipeline/plan.py:_replace_older:run": Scene.of_an_older_version,
    "pipeline/plan.py:_refusal:run": Scene.by_own_tracker,
    "pipeline/plan.py:_not_made:*": Scene.elsewhere,
    "tables/compared.py:_read:ingest": lambda s: s.timed("tracks.csv").says(
        "evaluate", "tracks.csv", "--truth", "truth.txt"
    ),
    "sources/ingest/job.py:read:ingest": lambda s: (
        s.without("/camera/truth*").cubes().says("ingest", "clip.mp4", "--truth", "cubes.csv")
    ),
} | of_extensions("PROPOSALS")


def functions(tree: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield every node of a module with the name of the innermost function around it."""

    def within(node: ast.AST, name: str) -> Iterator[tuple[str, ast.AST]]:
        name = node.name if isinstance(node, ast.FunctionDef) else name
        yield name, node
        for child in ast.iter_child_nodes(node):
            yield from within(child, name)

    return within(tree, "")


def names_of(node: ast.ImportFrom) -> set[str]:
    return {alias.name for alias in node.names}


def proposals() -> set[str]:
    """Return the places where the package proposes commands: module, function and command."""
    out = set()
    for path in PACKAGE.rglob("*.py"):
        if path == PACKAGE / "cli" / "text.py":
            continue  # it turns the calls that others propose into commands
        text = path.read_text(encoding="utf-8")
        if "mcaptrack.errors" not in text:
            continue
        tree = ast.parse(text)
        if not any(
            isinstance(node, ast.ImportFrom)
            and node.module == "mcaptrack.errors"
            and {"call", "command"} & names_of(node)
            for node in ast.walk(tree)
        ):
            continue
        for name, node in functions(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("call", "command"):
                first = node.args[0]
                verb = first.value if isinstance(first, ast.Constant) else "*"
                if verb == "open":
                    continue  # no command does this
                out.add(f"{path.relative_to(PACKAGE).as_posix()}:{name}:{verb}")
    return out


def test_every_proposal_has_a_scene():
    assert proposals() == set(SCENES)


def test_commands_are_proposed_in_one_way():
    """Texts other than documentation name commands through ``errors.command`` only."""
    named, found = re.compile(rf"\bmcaptrack ({VERBS})\b"), []
    for path in PACKAGE.rglob("*.py"):
        if named.search(path.read_text("utf-8")):
            found += [place for place, text in texts(path) if named.search(text) and not text.startswith("Example: ")]
    assert found == []


def words_of(line: str) -> list[str]:
    """Return the words of a command as a shell parses them."""
    shown = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], capture_output=True, check=True).stdout
    return shown.decode().split("\0")[:-1]


@pytest.mark.parametrize("where", one_in(12, SCENES))
def test_a_proposed_command_works(where, template, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(serving.Server, "serve_forever", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    verb = where.rpartition(":")[2]
    verb = getattr(getattr(mcaptrack, verb, None), "done_by", ([verb],))[0][0]
    for extension, prepare in of_extensions("PREPARED").items():
        if where.startswith(f"extensions/{extension}/"):
            prepare(monkeypatch, tmp_path)
    if where == "api/running.py:products:export":
        request.getfixturevalue("store").put("a.mcap", template)
    said = SCENES[where](Scene(template, tmp_path))
    lines = re.findall(r"mcaptrack ((?:" + VERBS + r")\b[^`\n]*?)(?=`|\n|$|    )", said)
    lines = [line for line in lines if verb in ("*", line.split()[0])]
    assert lines, said
    given = {
        "LABELS": "truth.txt",
        "VIDEO": "clip.mp4",
        "INPUT": "boxes.txt",
        "HOMOGRAPHY": "plane.txt",
        "LOG": f"./{NAME}",
        "FILE": "known.onnx",
    }
    for line in dict.fromkeys(lines):
        words = [given.get(word, word) for word in words_of(line)]
        if "boxes.txt" in words:
            words += ["--as", "detections", "--fps", "10"]
        outcome = call(*words)
        assert outcome.code in (0, 3), f"{line}: {outcome.err}"


@pytest.mark.parametrize(
    "name", ["a.mcap", "a b.mcap", "it's.mcap", "-o.mcap", "$(rm -r).mcap", 'say "a".mcap', "line\nend\t.mcap", "naïve.mcap", "a*?[b].mcap", "back\\slash.mcap", "~.mcap", "#.mcap", "--help"]
)  # fmt: skip
def test_a_shell_parses_a_proposed_command_as_intended(name):
    line = command("run", Path(name), "--topic", "/a b")
    assert (line[0], line[-1], "\n" in line) == ("`", "`", False)
    assert words_of(line.strip("`")) == [
        "mcaptrack",
        "run",
        f"./{name}" if name.startswith("-") else name,
        "--topic",
        "/a b",
    ]
