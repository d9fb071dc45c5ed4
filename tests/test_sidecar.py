"""Results beside a log that must not change: one log to whoever reads it."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from tests.logs import FORTY, SCHEMA, SOME, our_messages, write_log, write_stock


def add(path: Path, topic: str, payload: bytes, sidecar: bool | None = None) -> None:
    with log.read(path, sidecar=sidecar) as opened:
        opened.lock()
        drop = [topic] if topic in opened.channels else []
        with log.extend(opened, drop=drop) as writer:
            writer.add_message(writer.add_channel(topic, SCHEMA, "json", {}), 15, 1, payload)
            writer.add_metadata("about", {"what": topic})


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    return path


def test_results_go_beside_the_log_from_then_on_and_are_read_with_it(path):
    before = path.read_bytes()
    path.chmod(0o444)
    add(path, "new", b"one", sidecar=True)
    add(path, "more", b"two")  # now that results stand there they are taken without a word
    add(path, "new", b"three")
    assert path.read_bytes() == before
    with log.read(path) as opened:
        assert sorted(opened.channels) == ["a", "b", "c", "more", "new"]
        found = [(topic, m.t_ns, m.payload) for topic in ("a", "new", "more") for m in opened.messages(topic)]
        found.sort(key=lambda f: f[1])
        assert [f for f in found if f[0] != "a"] == [("new", 15, b"three"), ("more", 15, b"two")]
        assert [t for _, t, _ in found] == [10, 15, 15, 20]
        assert opened.times("new").tolist() == [15]
        assert opened.metadata("about") == {"what": "new"}
        assert (opened.start_ns, opened.end_ns) == (5, 40)
    assert sorted(our_messages(path.with_name("a.results.mcap"))) == ["more", "new"]


def test_what_the_results_hold_is_seen_instead_of_what_the_log_holds(path):
    add(path, "a", b"theirs", sidecar=True)
    assert our_messages(path)["a"] == [(15, 1, b"theirs")]
    with log.read(path, sidecar=False) as opened:
        assert [m.t_ns for m in opened.messages("a")] == [10, 20]


def test_attachments_and_metadata_are_those_of_the_results_or_else_of_the_log(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, FORTY)
    add(path, "new", b"one", sidecar=True)
    with log.read(path) as opened:
        assert opened.attachment("notes.txt") == b"hello"
        assert opened.metadata("about") == {"what": "new"}
        opened.lock()
        with log.extend(opened) as writer:
            writer.add_attachment("notes.txt", "text/plain", b"good bye")
    with log.read(path) as opened:
        assert opened.attachment("notes.txt") == b"good bye"
    with log.read(path, sidecar=False) as opened:
        assert opened.attachment("notes.txt") == b"hello"
        assert opened.metadata("about") == {"robot": "r2"}
        assert (opened.attachment("none"), opened.metadata("none")) == (None, None)


def test_nothing_is_left_where_nothing_came(path, tmp_path):
    with log.read(path, sidecar=True) as opened:
        opened.lock()
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_writer_of_results_is_turned_away(path):
    add(path, "new", b"one", sidecar=True)
    with log.read(path) as first, log.read(path) as second:
        first.lock()
        with pytest.raises(McaptrackError, match=r"a\.results\.mcap is being written to by another process"):
            second.lock()


def test_results_of_an_earlier_log_are_not_taken_for_those_of_a_new_one(path, tmp_path):
    add(path, "new", b"one", sidecar=True)
    with pytest.raises(McaptrackError, match=r"a\.results\.mcap holds results of an earlier a\.mcap"), log.create(path):
        pass
    with (
        log.read(path) as opened,
        pytest.raises(McaptrackError, match="they can't also go to"),
        log.extend(opened, tmp_path / "b.mcap"),
    ):
        pass
    assert sorted(our_messages(path)) == ["a", "b", "c", "new"]
