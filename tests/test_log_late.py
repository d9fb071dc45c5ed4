"""Times from 2^63 ns on, which MCAP allows: kept as they are by what passes messages on, refused by what computes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import parse_ns
from mcaptrack.log.chunks import LOG_MAX_NS, MAX_NS
from mcaptrack.log.index import ChunkList
from mcaptrack.registry import BUILT_IN
from mcaptrack.schema import Frame
from mcaptrack.schema.resampling import resample
from mcaptrack.sources.pictures import Pictures
from tests.commands import call, done, made_log
from tests.extension_cases import of_extensions
from tests.interrupted import everything
from tests.log_mutants import CHUNK, parts, without_summary
from tests.logs import READING, SCHEMA, SOME, STOCK_OPTIONS, our_messages, stock_messages, write_stock
from tests.tiers import one_in
from tests.worlds import tracks_at

LATE = [
    ("a", MAX_NS, 6, b"the last that is computed with"),
    ("b", MAX_NS + 1, 7, b"late"),
    ("a", LOG_MAX_NS, 8, b"the last of all"),
    ("c", LOG_MAX_NS - 1, 9, b""),
]


@pytest.fixture(params=STOCK_OPTIONS)
def theirs(request, tmp_path) -> Path:
    path = tmp_path / "theirs.mcap"
    write_stock(path, [*SOME, *LATE], **STOCK_OPTIONS[request.param])
    return path


def test_they_are_kept_by_every_way_to_pass_messages_on(theirs, tmp_path):
    wanted = Counter([*SOME, *LATE])
    done("recover", theirs, "-o", tmp_path / "recovered.mcap")
    done("ingest", theirs, "-o", tmp_path / "ingested.mcap")
    done("drop", theirs, "b", "-o", tmp_path / "dropped.mcap")
    assert Counter(stock_messages(tmp_path / "recovered.mcap")) == wanted
    assert Counter(stock_messages(tmp_path / "ingested.mcap")) == wanted
    assert Counter(stock_messages(tmp_path / "dropped.mcap")) == Counter(m for m in wanted if m[0] != "b")
    with log.read(theirs) as opened, log.extend(opened) as writer:
        writer.add_message(writer.add_channel("new", SCHEMA, "json", {}), MAX_NS + 5, 1, b"added")
    assert Counter(stock_messages(theirs)) == wanted + Counter([("new", MAX_NS + 5, 1, b"added")])
    found = our_messages(theirs)
    assert found["a"] == sorted(m[1:] for m in [*SOME, *LATE] if m[0] == "a")
    with log.read(theirs) as opened:
        assert [m.sequence for m in opened.messages("a", MAX_NS, LOG_MAX_NS)] == [6]
        assert [m.sequence for m in opened.messages("b", 41)] == [7]
        assert (opened.start_ns, opened.end_ns) == (5, LOG_MAX_NS)
    assert log.check(theirs).is_sound


def test_check_names_the_channels_and_counts_the_messages(theirs):
    outcome = done("check", theirs, "--json")
    late = [finding for finding in json.loads(outcome.out)["results"][0]["findings"] if finding["kind"] == "late"]
    assert [(finding["level"], finding["times"]) for finding in late] == [("warning", 3)]
    assert "later than the year 2262" in late[0]["words"]
    write_stock(theirs, [*SOME, LATE[0]])
    assert "late" not in [f["kind"] for f in json.loads(done("check", theirs, "--json").out)["results"][0]["findings"]]


def test_tables_leave_out_what_they_can_t_hold_and_say_so(tmp_path):
    theirs = tmp_path / "theirs.mcap"
    write_stock(theirs, [*SOME, *LATE])
    outcome = done("export", theirs, "-o", tmp_path / "tables")
    assert "recordings: messages are later than the year 2262, which tables can't hold" in outcome.err
    with mcaptrack.open(theirs) as opened:
        (row,) = opened.table("recordings").to_pylist()
    assert (row["start_t_ns"], row["end_t_ns"], row["messages"]) == (5, None, 9)
    refused = call("export", theirs, "--topic", "a", "-o", tmp_path / "tables")
    assert refused.code == 1
    assert f"a has 1 messages later than the year 2262, the first at {LOG_MAX_NS} ns" in refused.err
    proposed = refused.err.split("`mcaptrack ")[1].split("`")[0].replace("OTHER.mcap", str(tmp_path / "other.mcap"))
    done(*proposed.split())
    assert Counter(stock_messages(tmp_path / "other.mcap")) == Counter(m for m in [*SOME, *LATE] if m[0] != "a")


def retime(path: Path, output: Path, when: Callable[[int], int]) -> None:
    """Write a log once more, with other times of messages."""
    with log.read(path) as opened, log.create(output) as writer:
        numbers = {}
        for number, channel in opened.index.channels.items():
            schema = opened.index.schemas.get(channel.schema_id)
            layout = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
            numbers[number] = writer.add_channel(channel.topic, layout, channel.message_encoding, channel.metadata)
        for number, message in log.stream(opened):
            writer.add_message(numbers[number], when(message.t_ns), message.sequence, message.payload)
        log.copy_attachments_and_metadata(opened, writer)


@pytest.fixture(scope="module")
def early(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("early"), 12)


@pytest.fixture(scope="module", params=["all of them", "some of them"])
def ours(request, early, tmp_path_factory) -> Path:
    """A log with everything in it, whose messages are later than they were."""
    path = tmp_path_factory.mktemp("late") / "late.mcap"
    with log.read(early) as opened:
        middle = (opened.start_ns + opened.end_ns) // 2
    later = MAX_NS + 1 - (0 if request.param == "all of them" else middle)
    retime(early, path, lambda t_ns: t_ns + later)
    return path


@pytest.mark.parametrize("command", one_in(3, sorted(READING)))
def test_every_command_keeps_them_or_refuses_in_a_line(command, ours, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = everything(ours.parent)
    outcome = call(command, *READING[command](ours, tmp_path))
    assert everything(ours.parent) == before
    assert outcome.code in (0, 1), outcome.err
    if outcome.code:
        last = outcome.err.splitlines()[-1]
        assert last.startswith("mcaptrack: ")
        if command in BUILT_IN["command"] and command != "view":
            assert "later than the year 2262" in last
        assert not [made for made in tmp_path.iterdir() if made.suffix == ".mcap"]


def test_a_clock_start_that_can_t_be_computed_with_is_none():
    wanted = {"0": 0, "-5": -5, str(MAX_NS): MAX_NS} | dict.fromkeys(
        (str(MAX_NS + 1), "9" * 5000, "", "1.5", "٣", " 1")
    )
    assert {text: parse_ns(text) for text in wanted} == wanted


@pytest.mark.parametrize("shared", one_in(2, [3, 1000]), ids=["some share a time", "all share a time"])
def test_messages_may_share_a_time(early, tmp_path, monkeypatch, shared):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "same" / "a.mcap"
    path.parent.mkdir()
    retime(early, path, lambda t_ns: t_ns // (shared * 10**8) * shared * 10**8)
    for command in {"predict", "retrack", "evaluate"} | READING.keys() & of_extensions("READING").keys():
        done(command, *READING[command](path, tmp_path))
        (tmp_path / "other.mcap").unlink(missing_ok=True)


def test_pictures_outside_of_the_times_that_their_chunk_names_are_refused(early):
    with log.read(early) as opened:
        opened.index.chunks = ChunkList(
            replace(chunk, message_start_time=0, message_end_time=0) for chunk in opened.index.chunks
        )
        with pytest.raises(McaptrackError, match="lie outside of the times that their chunk names"):
            list(Pictures(opened, "/camera/video").frames([3]))


def test_chunks_without_an_index_are_found_by_the_times_of_their_messages(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, SOME)
    records, _ = parts(path.read_bytes())
    records = [(opcode, bytes(16) + body[16:] if opcode == CHUNK else body) for opcode, body in records]
    path.write_bytes(without_summary(records))
    with log.read(path) as opened:
        assert [message.sequence for message in opened.messages("b", 35, 50)] == [5]


def test_the_last_time_of_all_is_computed_with():
    rows = tracks_at({1: (1.0, 2.0)})
    at_ns = np.array([MAX_NS - 1, MAX_NS])
    found, at = resample([Frame(MAX_NS - 1, 0, rows), Frame(MAX_NS, 1, rows)], at_ns, 5)
    assert at.tolist() == [0, 1]
    assert found["track_id"].tolist() == [1, 1]
