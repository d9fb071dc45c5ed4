"""Damaged logs: all damage is seen, all that is whole is saved, nothing wrong is taken for right."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.log.records import MAGIC
from tests import bounded, log_mutants
from tests.commands import call, made_log
from tests.logs import (
    FORTY,
    MESSAGES,
    READING,
    SCHEMA,
    STOCK_OPTIONS,
    our_messages,
    stock_messages,
    write_log,
    write_stock,
)
from tests.tiers import one_in, thorough

WITH_CHECKSUMS = {
    "small chunks": {"chunk_size": 100, "enable_data_crcs": True},
    "no chunks, a checksum": {"use_chunking": False, "enable_data_crcs": True},
}


def some_logs(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Logs with the forty messages, ours and of the stock writer in all its ways."""
    path = folder / "good.mcap"
    write_log(path, FORTY)
    yield "ours", path.read_bytes()
    write_log(path, FORTY, "media")
    yield "media", path.read_bytes()
    write_stock(path, FORTY, chunk_size=300)
    with log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel("new", SCHEMA, "json", {})
        for count in range(10):
            writer.add_message(number, count, count, b"new" * count)
    yield "extended", path.read_bytes()
    for name, options in {**STOCK_OPTIONS, **WITH_CHECKSUMS}.items():
        write_stock(path, FORTY, **options)
        yield name, path.read_bytes()


def kinds_of(checked: log.CheckResult) -> set[str]:
    return {found.kind for found in checked.findings if found.level == "error"}


def triples(path: Path) -> Counter[tuple[str, int, bytes]]:
    return Counter((topic, t, payload) for topic, found in our_messages(path).items() for t, _, payload in found)


def test_a_sound_log_is_said_to_be_sound_and_is_saved_whole(tmp_path):
    path, saved = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for name, whole in some_logs(tmp_path):
        path.write_bytes(whole)
        checked = log.check(path)
        assert checked.is_sound, (name, checked.findings)
        report = log.recover(path, saved)
        assert report.lost == [], name
        assert triples(saved) == triples(path), name
        assert log.check(saved).is_sound, name
        with path.open("rb") as first, saved.open("rb") as second:
            one, other = make_reader(first), make_reader(second)
            assert one.get_header() == other.get_header()
            for kind in ("attachments", "metadata"):
                theirs, ours = (list(getattr(reader, f"iter_{kind}")()) for reader in (one, other))
                assert theirs in ([], ours)  # the stock reader goes by indexes, which not every log has
                assert len(ours) == (name not in ("ours", "media"))


@given(messages=MESSAGES, at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=80)
def test_no_flipped_bit_goes_unseen(tmp_path_factory, messages, at, bit):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    write_log(path, messages)
    raw = bytearray(path.read_bytes())
    raw[int(at * len(raw))] ^= 1 << bit
    path.write_bytes(raw)
    assert not log.check(path).is_sound


@pytest.fixture
def chunked(tmp_path) -> Path:
    """A log of four chunks and more, of which each can be damaged alone."""
    path = tmp_path / "a.mcap"
    write_stock(path, FORTY, chunk_size=600, enable_data_crcs=True)
    return path


def _damages(path: Path) -> dict[str, tuple[bytes, set[str]]]:
    """Damaged logs, and the errors that must be among those that are found."""
    whole = path.read_bytes()
    with log.read(path) as opened:
        chunk, other = opened.index.chunks[1:3]
        summary = opened.index.data_end + 13
        at_index = chunk.chunk_start_offset + chunk.chunk_length
        attachment = opened.index.attachments[0].offset

    def put(at: int, data: bytes) -> bytes:
        return whole[:at] + data + whole[at + len(data) :]

    twice = whole[chunk.chunk_start_offset : other.chunk_start_offset]
    return {
        "not an MCAP file": (b"x" + whole[1:], {"magic"}),
        "cut off in a chunk": (whole[: chunk.chunk_start_offset + 100], {"cut-off", "structure"}),
        "cut off in the summary": (whole[: summary + 30], {"cut-off"}),
        "a chunk's data": (put(chunk.chunk_start_offset + 80, bytes(8)), {"bad-chunk", "data-checksum"}),
        "a chunk's times": (put(chunk.chunk_start_offset + 9, bytes(8)), {"chunk-times", "data-checksum"}),
        "a chunk's declared size": (put(chunk.chunk_start_offset + 25, b"\xff" * 8), {"bad-chunk"}),
        "a message index": (put(at_index + 15, b"\xff" * 8), {"wrong-index"}),
        "a message index of another channel": (put(at_index + 9, b"\x09"), {"wrong-index", "chunk-index"}),
        "an attachment": (whole.replace(b"hello", b"hallo"), {"attachment-checksum", "data-checksum"}),
        "an attachment's length": (put(attachment + 1, b"\xff" * 8), {"structure"}),
        "a record of another kind": (put(chunk.chunk_start_offset, b"\x02"), {"misplaced", "stray-index"}),
        "the summary": (put(summary + 40, b"\xff"), {"summary-checksum"}),
        "where the summary is": (put(len(whole) - 8 - 20, b"\x00\x01"), {"footer"}),
        "a chunk twice": (
            whole[: other.chunk_start_offset] + twice + whole[other.chunk_start_offset :],
            {"data-checksum", "footer"},
        ),
    }


#: Damages that lose nothing at all, and those that take no message away.
HARMLESS = {"the summary", "where the summary is", "cut off in the summary"}
NO_MESSAGES = HARMLESS | {
    "a chunk's times", "not an MCAP file", "an attachment", "a chunk twice", "an attachment's length",
}  # fmt: skip


def test_damage_is_found_by_name_and_what_is_whole_is_saved(chunked, tmp_path):
    true = triples(chunked)
    for kind, (damaged, errors) in _damages(chunked).items():
        chunked.write_bytes(damaged)
        assert errors <= kinds_of(log.check(chunked)), kind
        report = log.recover(chunked, tmp_path / "saved.mcap")
        saved = triples(tmp_path / "saved.mcap")
        assert saved <= true, kind
        assert report.messages == saved.total() >= (6 if kind == "cut off in a chunk" else 25), kind
        assert bool(report.lost) == (kind not in HARMLESS), kind
        assert kind not in NO_MESSAGES or saved == true, kind
        assert log.check(tmp_path / "saved.mcap").is_sound, kind
        by_stock = sorted((t, ns, data) for t, ns, _, data in stock_messages(tmp_path / "saved.mcap"))
        assert by_stock == sorted(saved.elements()), kind
        assert chunked.read_bytes() == damaged


def test_a_log_that_is_cut_off_keeps_every_chunk_that_is_complete(chunked, tmp_path):
    path, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    whole = chunked.read_bytes()
    with log.read(chunked) as opened:
        chunks = [
            (c.chunk_start_offset + c.chunk_length, c.message_start_time, c.message_end_time)
            for c in opened.index.chunks
        ]
        data_end = opened.index.data_end + 13
    for percent in range(1, 100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        spans = [(low, high) for end, low, high in chunks if end <= path.stat().st_size]
        there = Counter((t, ns, data) for t, ns, _, data in FORTY if any(low <= ns <= high for low, high in spans))
        if not spans:
            with pytest.raises(McaptrackError, match="no message in it is intact"):
                log.recover(path, saved)
            continue
        report = log.recover(path, saved)
        assert triples(saved) == there
        is_whole = path.stat().st_size >= data_end
        assert is_whole or "the file is cut off" in report.lost[-1]


def test_a_cut_log_without_chunks_keeps_every_message_that_is_complete(tmp_path):
    path, saved = tmp_path / "a.mcap", tmp_path / "saved.mcap"
    write_stock(path, FORTY, use_chunking=False)
    whole = path.read_bytes()
    ends = {whole.index(payload) + len(payload): (t, ns, payload) for t, ns, _, payload in FORTY}
    for percent in range(20, 70):
        path.write_bytes(whole[: len(whole) * percent // 100])
        there = Counter(m for end, m in ends.items() if end <= path.stat().st_size)
        log.recover(path, saved)
        assert triples(saved) == there


def mutated(whole: bytes, chance: random.Random) -> bytes:
    """With a few bits flipped, cut off, overwritten by a telling number, or with a piece of it put somewhere else."""
    raw, kind = bytearray(whole), chance.random()
    at = chance.randrange(len(raw))
    if kind < 0.5:
        for _ in range(chance.choice([1, 1, 2, 5])):
            raw[chance.randrange(len(raw))] ^= 1 << chance.randrange(8)
    elif kind < 0.65:
        del raw[max(at, 1) :]
    elif kind < 0.8:
        numbers = (0, 2**40, 2**63, 2**64 - 1)
        raw[at : at + 8] = chance.choice(numbers).to_bytes(8, "little")
    else:
        low, high = sorted((chance.randrange(len(raw)), chance.randrange(len(raw))))
        raw[at:at] = raw[low:high]
    return bytes(raw)


@pytest.mark.parametrize("seed", one_in(7, range(21)))
def test_no_mutation_gives_a_wrong_message_or_a_traceback(tmp_path, seed):
    """Neither when it is read, nor when it is extended, nor when it is saved; and what is lost is said."""
    chance = random.Random(seed)
    path, saved = tmp_path / "a.mcap", tmp_path / "saved.mcap"
    kinds = dict(some_logs(tmp_path))
    new = Counter(("new", count, b"new" * count) for count in range(10))
    true = Counter((topic, ns, payload) for topic, ns, _, payload in FORTY)
    unguarded = {"no chunks", "no message index", "no repeated channels", "no statistics"}
    for _ in range(24):
        name, whole = chance.choice(list(kinds.items()))
        raw = mutated(whole, chance)
        path.write_bytes(raw)
        good = true + new if name == "extended" else true
        guarded = name not in unguarded and name not in WITH_CHECKSUMS
        try:
            assert triples(path) <= good or not guarded, name
            with log.read(path) as opened, log.extend(opened, drop=["a"]) as writer:
                writer.add_message(writer.add_channel("more", SCHEMA, "json", {}), 5, 1, b"zz")
            assert triples(path) <= good + Counter([("more", 5, b"zz")]) or not guarded, name
        except McaptrackError as error:
            assert "\n" not in str(error)
        path.write_bytes(raw)
        is_sound = log.check(path).is_sound
        try:
            report = log.recover(path, saved)
        except McaptrackError as error:
            assert "no message in it is intact" in str(error)
            assert not is_sound
            continue
        found = triples(saved)
        assert found.total() == report.messages == len(stock_messages(saved))
        assert found <= good or not guarded, name
        assert log.check(saved).is_sound
        if name in ("ours", "media", *WITH_CHECKSUMS) and raw != whole:
            assert not is_sound, name
            assert report.lost or found == good, name


_HOSTILE = """
import gc, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from pathlib import Path
from mcaptrack import errors, log
def all_of(path):
    with log.read(path) as opened:
        for topic in opened.channels:
            for _ in opened.messages(topic): pass
            opened.times(topic)
def most_kib():
    status = Path("/proc/self/status")  # what getrusage says includes the process that this one was started by
    lines = status.read_text().splitlines() if status.exists() else []
    return max((int(line.split()[1]) for line in lines if line[:6] == "VmHWM:"), default=0)
loaded = most_kib()
for path in map(Path, sys.argv[1:]):
    for look in (all_of, log.check, lambda p: log.recover(p, p.with_suffix(".out"))):
        try: look(path)
        except errors.McaptrackError as error: assert "\\n" not in str(error)
        gc.collect()  # of one file at a time: what an error has seen lives until Python looks for it
    used = most_kib() - loaded
    assert used < (1 << 20 if "bomb" in path.name else 1 << 18), (path.name, used)
"""


@thorough
def test_hostile_logs_cost_neither_time_nor_memory(tmp_path):
    import lz4.frame
    import zstandard

    header = records.pack(1, records.text(""), records.text("x"))
    end = records.pack(15, bytes(4)) + records.pack(2, bytes(20)) + MAGIC
    zeros = bytes(200 << 20)
    zstd, lz = zstandard.compress(zeros), lz4.frame.compress(zeros)
    channel = records.pack(4, (1).to_bytes(2, "little"), bytes(2), records.text("/a"), records.text(""), bytes(4))
    other = records.pack(4, (1).to_bytes(2, "little"), bytes(2), records.text("/b"), records.text(""), bytes(4))
    message = records.pack(5, (1).to_bytes(2, "little"), bytes(4), b"\xff" * 8, b"\xff" * 8)
    bodies = {
        "2^40": records.pack_chunk((0, 0, 2**40, 0), "zstd", zstd),
        "2^63": records.pack_chunk((0, 0, 2**63, 0), "lz4", lz),
        "record of 2^63": b"\x06" + (2**63).to_bytes(8, "little") + bytes(100),
        "map of 2^31": records.pack(4, bytes(4), records.text("/a"), records.text(""), (2**31).to_bytes(4, "little")),
        "two of one number": channel + other + message,
        "absurd times": channel + message,
        "absurd times in a chunk": channel + records.pack_chunk((0, 2**64 - 1, len(message), 0), "", message),
        "many empty records": records.pack(0x80) * 250_000,
        "many beginnings of chunks": (b"\x06" + bytes(40)) * 100_000,
        "a chunk in itself": records.pack_chunk((0, 0, len(channel), 0), "", records.pack_chunk((0, 0, 0, 0), "", b"")),
        # From here on more memory is allowed: what was needed before counts, too.
        "zstd bomb": records.pack_chunk((0, 0, 100, 0), "zstd", zstd),
        "zstd bomb that says so": records.pack_chunk((0, 0, len(zeros), 0), "zstd", zstd),
        "many zstd bombs": records.pack_chunk((0, 0, len(zeros), 0), "zstd", zstd) * 8,
        "lz4 bomb": records.pack_chunk((0, 0, 100, 0), "lz4", lz),
        "lz4 bomb that says so": records.pack_chunk((0, 0, len(zeros), 0), "lz4", lz),
    }
    paths = []
    for name, body in bodies.items():
        paths.append(tmp_path / f"{name}.mcap")
        paths[-1].write_bytes(MAGIC + header + body + end)
    command = [sys.executable, "-c", _HOSTILE, *paths]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def test_a_log_that_was_joined_to_another_is_named(tmp_path):
    for name in "ab":
        write_log(tmp_path / f"{name}.mcap", FORTY)
    first, second = ((tmp_path / f"{name}.mcap").read_bytes() for name in "ab")
    (tmp_path / "both.mcap").write_bytes(first + second)
    report = log.recover(tmp_path / "both.mcap", tmp_path / "saved.mcap")
    assert report.lost == [
        f"byte {len(first)} to {len(first + second)}: another log follows; cut the file in two there"
    ]


def test_content_that_cannot_be_recovered_is_named(tmp_path):
    for name, data in {"text.mcap": b"I am no log\n" * 9, "magic.mcap": MAGIC}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(McaptrackError, match="no message in it is intact"):
            log.recover(tmp_path / name, tmp_path / "saved.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    for verb in (log.check, lambda path: log.recover(path, tmp_path / "saved.mcap")):
        with pytest.raises(McaptrackError, match="is empty"):
            verb(tmp_path / "empty.mcap")
        with pytest.raises(McaptrackError, match="does not exist"):
            verb(tmp_path / "none.mcap")
    assert not (tmp_path / "saved.mcap").exists()


@pytest.mark.parametrize("what", ["text", "nothing", "a JPEG file", "no beginning", "no end", "neither"])
def test_recovering_is_proposed_where_something_shows_that_it_is_a_log(what, template, tmp_path):
    """And then it saves something."""
    path = tmp_path / "a.mcap"
    whole = template.read_bytes()
    content = {
        "text": b"frame,x,y\n1,2,3\n", "nothing": b"", "a JPEG file": b"\xff\xd8\xff\xe0" + bytes(2000),
        "no beginning": b"\0" * 8 + whole[8:], "no end": whole[: len(whole) * 2 // 3],
        "neither": b"\0" * 8 + whole[8 : len(whole) * 2 // 3],
    }[what]  # fmt: skip
    path.write_bytes(content)
    refused = call("info", path)
    assert refused.code == 1
    is_proposed = f"`mcaptrack recover {path}`" in refused.err
    assert is_proposed == (what in ("no beginning", "no end"))
    assert not is_proposed or call("recover", path, "-o", tmp_path / "saved.mcap").code == 3


# Logs with something wrong in them: read or refused in a line, soon, in little memory.
#
# Nothing that a command reads is changed by it. MUTANTS in the environment sets how many are made of each kind of file,
# FIRST_MUTANT where they begin; damaged logs then go through every command instead of one.


MUTANTS = int(os.environ.get("MUTANTS", "0"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))
COMMANDS = sorted(READING)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("whole"), 10)


def logs(whole: Path, seed: int, inside: Path, out: Path) -> Iterator[bounded.Work]:
    path = inside / "a.mcap"
    path.write_bytes(log_mutants.mutant(seed, whole.read_bytes())[1])
    for command in COMMANDS if MUTANTS else [COMMANDS[seed % len(COMMANDS)]]:

        def holds(code: int, command: str = command) -> bool:
            return command != "recover" or code == 1 or all(log.check(made).is_sound for made in out.glob("*.mcap"))

        yield [command, *READING[command](path, out)], holds


@thorough
def test_mutants_are_read_or_refused(whole, commands, tmp_path):
    faults = bounded.faults(commands, range(FIRST, FIRST + (MUTANTS or 12)), tmp_path, partial(logs, whole))
    assert not faults, "\n".join(faults)


def test_every_kind_changes_something_and_the_same_seed_makes_the_same(whole, tmp_path):
    data, kinds = whole.read_bytes(), log_mutants.KINDS
    made = [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert made == [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert {kind for kind, changed in made if changed != data} == kinds.keys()
