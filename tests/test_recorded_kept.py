"""Whatever writes to a log, no channel that others recorded loses a message."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import get_args

import pytest
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.choices import Role
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.transforms import TRANSFORMS
from tests.commands import call
from tests.logs import recorder
from tests.robots import lines, robot_log
from tests.tiers import one_in
from tests.worlds import write_clip

#: Corrections are of tracks in a log, so they are never beside a video.
ROLES = tuple(role for role in get_args(Role) if role != "corrections")
THEIRS = "theirs/Message"


def mcaptrack(*words: object) -> tuple[int, str]:
    outcome = call(*words)
    return outcome.code, outcome.err


def record(path: Path, *topics: str, source: Path | None = None) -> Path:
    """A log with 5 messages of others on each topic, and all that is in ``source``, as others would write it."""
    with recorder(path) as writer:
        if source:
            with source.open("rb") as other:
                known: dict[int, int] = {}
                for schema, channel, message in make_reader(other).iter_messages():
                    if channel.id not in known:
                        number = writer.register_schema(schema.name, schema.encoding, schema.data)
                        known[channel.id] = writer.register_channel(
                            channel.topic, channel.message_encoding, number, channel.metadata
                        )
                    writer.add_message(
                        known[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                    )
        schema = writer.register_schema(THEIRS, "jsonschema", b"{}")
        for topic in topics:
            channel = writer.register_channel(topic, "json", schema)
            for n in range(5):
                writer.add_message(channel, n * 100_000_000, b'{"n": %d}' % n, n)
    return path


def theirs(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (c.topic, m.log_time, m.data) for s, c, m in make_reader(stream).iter_messages() if s and s.name == THEIRS
        ]


@pytest.fixture(scope="module")
def stock(tmp_path_factory) -> Path:
    """Sources to ingest, and a log that has everything a run makes. Not to be changed."""
    folder = tmp_path_factory.mktemp("stock")
    write_clip(folder / "clip.mp4", 12, options={"bf": "0", "g": "10"})
    (folder / "plane.txt").write_text("0.1 0 0\n0 0.1 0\n0 0 1\n")
    robot_log(folder / "robot.mcap", "/camera/image")
    (folder / "det.txt").write_text("".join(f"{k + 1},-1,{k},9,9,20\n" for k in range(12)))
    ingest(folder / "clip.mp4", folder / "boxes.mcap", IngestOptions(labels={"detections": folder / "det.txt"}))
    walk = "".join(f"{12 * k} {who} {who + 0.3 * k:.2f} {2.5 + who}\n" for k in range(25) for who in (1, 2))
    (folder / "tracks.txt").write_text(walk)
    ingest(
        folder / "tracks.txt",
        folder / "run.mcap",
        IngestOptions(labels={"truth": folder / "tracks.txt"}, role="tracks"),
    )
    shutil.copy(folder / "run.mcap", folder / "start.mcap")
    assert mcaptrack("run", folder / "run.mcap", "--no-tables", "-q") == (0, "")
    return folder


def written_by_run(stock: Path) -> list[str]:
    with log.read(stock / "start.mcap") as start, log.read(stock / "run.mcap") as opened:
        made = [c.topic for c in opened.channels.values() if Provenance.from_metadata(c.metadata)]
        return sorted(set(made) - set(start.channels))


@pytest.mark.parametrize("part", one_in(3, range(3)))
def test_nothing_that_a_run_writes_takes_the_place_of_a_recorded_channel(stock, tmp_path, part):
    """Each topic in turn is one that others recorded: all of these messages stay, and the refusal names it."""
    topics = written_by_run(stock)
    assert {"/camera/retracks", "/camera/tracks/events", "/camera/predictions/errors", "/camera/view/tf"} <= set(topics)
    for number, topic in enumerate(topics[part::3]):
        path = record(tmp_path / f"{number}.mcap", topic, source=stock / "start.mcap")
        before, content = path.read_bytes(), theirs(path)
        assert len(content) == 5
        code, err = mcaptrack("run", path, "--no-tables", "--force", "-q")
        assert theirs(path) == content, topic
        if code:
            assert (code, path.read_bytes()) == (1, before), topic
            assert topic in err


@pytest.mark.parametrize("stage", [*TRANSFORMS, "events"])
def test_no_stage_writes_to_a_recorded_channel(stock, tmp_path, stage):
    """Of all that a log may have, each stage finds its input; the channel that it is told to write to is taken."""
    target = "/camera/theirs"
    source = stock / ("boxes.mcap" if stage in ("detect", "track") else "run.mcap")
    path = record(tmp_path / "a.mcap", target, source=source)
    before, content = path.read_bytes(), theirs(path)
    code, err = mcaptrack(stage, path, "--topic" if stage == "events" else "--to", target, "--force")
    assert (code, err.count("\n")) == (1, 1), err
    assert target in err
    assert (path.read_bytes(), len(content)) == (before, 5)


WAYS = {
    **{f"{role} alone": (f"{role}.txt", ["--as", role, "--fps", "10"], f"/camera/{role}") for role in ROLES},
    **{f"{role} beside a video": ("clip.mp4", [f"--{role}", f"{role}.txt"], f"/camera/{role}") for role in ROLES},
    "a video": ("clip.mp4", [], "/camera/video"),
    "a ground plane": ("clip.mp4", ["--ground-plane", "plane.txt"], "/camera/ground_plane"),
    "an mcap file": ("robot.mcap", [], "/camera/image"),
    **{f"{role} beside a recording": ("robot.mcap", [f"--{role}", f"{role}.txt"], f"/camera/{role}") for role in ROLES},
}


@pytest.mark.parametrize(("source", "options", "topic"), WAYS.values(), ids=WAYS)
def test_nothing_that_is_ingested_takes_the_place_of_a_recorded_channel(
    stock, tmp_path, monkeypatch, source, options, topic
):
    """And what the refusal proposes works, and keeps the channel too."""
    monkeypatch.chdir(tmp_path)
    for name in ("clip.mp4", "plane.txt", "robot.mcap"):
        shutil.copy(stock / name, name)
    lines(Path("truth.txt"), 1, 2)
    lines(Path("tracks.txt"), 1, 2)
    Path("detections.txt").write_text("1,-1,1,1,2,2\n2,-1,1,1,2,2\n")
    path = record(Path("m.mcap"), topic)
    before, content = path.read_bytes(), theirs(path)
    for force in ([], ["--force"]):
        code, err = mcaptrack("ingest", source, *options, *force, "--into", path)
        assert (code, err.count("\n")) == (1, 1), err
        assert f"m.mcap has {topic}, which other software recorded ({THEIRS}) and which is never replaced; " in err
        assert "--force" not in err
        assert path.read_bytes() == before
    camera = re.search(r"; --camera (\S+) puts", err)
    more = ["--camera", camera[1], "--into", path] if camera else ["-o", "other.mcap"]
    assert bool(camera) != ("write it to a separate log with -o" in err)
    code, err = mcaptrack("ingest", source, *options, *more)
    assert code == 0, err
    assert theirs(path) == content
