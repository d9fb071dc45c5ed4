"""What may lie at LOG.journal: it is used only where it is proof, said in a line otherwise, and stays as it is."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.log import in_place, journal
from mcaptrack.log.byte_source import OpenFile
from mcaptrack.log.journal import journal_of
from tests.interrupted import add_results, everything, interrupt
from tests.logs import SCHEMA, write_log
from tests.tiers import one_in

SOME = [("abc"[n % 3], n, n, bytes([n]) * 3000) for n in range(100)]
AS_ROOT = os.geteuid() == 0
pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "a b.mcap"  # a name that a shell takes apart
    write_log(path, SOME, "media")
    interrupt(path)
    return path


def a_socket(at: Path) -> None:
    here = os.getcwd()
    os.chdir(at.parent)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(at.name)
    os.chdir(here)


def linked(at: Path) -> None:
    at.rename(at.with_name("elsewhere"))
    at.symlink_to("elsewhere")


def flipped(at: Path, place: int) -> None:
    raw = bytearray(at.read_bytes())
    raw[place] ^= 1
    at.write_bytes(raw)


def of_another(at: Path) -> None:
    other = at.with_name("other.mcap")
    write_log(other, [(t, ns + 1, n, data) for t, ns, n, data in SOME], "media")
    interrupt(other)
    os.replace(journal_of(other), at)


def of_a_copy(at: Path) -> None:
    other = at.with_name("other.mcap")
    write_log(other, SOME, "media")
    interrupt(other)
    os.replace(journal_of(other), at)


def anew(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def put(at: Path) -> None:
        at.unlink()
        make(at)

    return put


#: What lies beside the log, and what is said of it.
THINGS: dict[str, tuple[Callable[[Path], object], str]] = {
    "words": (lambda at: at.write_bytes(b"dear diary"), "is not a journal of mcaptrack"),
    "nothing in it": (lambda at: at.write_bytes(b""), "is not a journal of mcaptrack"),
    "the first bytes": (lambda at: at.write_bytes(at.read_bytes()[:90]), "is an incomplete or damaged journal"),
    "a head": (lambda at: at.write_bytes(at.read_bytes()[:240]), "is an incomplete or damaged journal"),
    "a flipped head": (lambda at: flipped(at, 40), "is an incomplete or damaged journal"),
    "a flipped end": (lambda at: flipped(at, 400), "is an incomplete or damaged journal"),
    "a folder": (anew(Path.mkdir), "is a folder"),
    "a pipe": (anew(os.mkfifo), "is a named pipe"),
    "a socket": (anew(a_socket), "is a socket"),
    "a link to itself, elsewhere": (linked, "is a symbolic link"),
    "a link to nothing": (anew(lambda at: at.symlink_to("nothing")), "is a symbolic link"),
    "one of another log": (of_another, "belongs to a log with another beginning"),
    "one of a copy": (of_a_copy, "belongs to another file than"),
}
if AS_ROOT:
    THINGS["a device"] = (anew(lambda at: os.mknod(at, 0o020644, os.makedev(1, 5))), "is a device")


def look(path: Path) -> None:
    with log.read(path) as opened:
        for topic in opened.channels:
            list(opened.messages(topic))


@pytest.mark.parametrize("thing", one_in(3, THINGS))
def test_what_is_no_proof_is_said_in_a_line_and_never_used(path, tmp_path, thing):
    make, words = THINGS[thing]
    make(journal_of(path))
    before = everything(tmp_path)
    out = tmp_path.parent / f"{tmp_path.name}.recovered.mcap"
    for verb in (look, log.check, lambda there: log.recover(there, out)):
        with notices.collected() as said:
            try:
                verb(path)
            except McaptrackError as error:  # it is left half written, after all
                assert "\n" not in str(error)
        assert everything(tmp_path) == before
        assert len(said) == 1
        assert "\n" not in said[0].message
        if "its state before that is recovered" not in said[0].message:
            assert said[0].message.startswith(f"{journal_of(path)} ")
            assert words in said[0].message
            assert "it is ignored" in said[0].message
    assert out.exists()


@pytest.mark.parametrize("thing", one_in(3, THINGS))
def test_what_lies_in_the_way_is_refused_and_the_command_that_is_proposed_removes_it(tmp_path, thing):
    path = tmp_path / "a b.mcap"
    write_log(path, SOME, "media")
    whole = path.read_bytes()
    interrupt(path)
    THINGS[thing][0](journal_of(path))
    with path.open("rb+") as stream:  # a whole log again
        stream.write(whole)
        stream.truncate(len(whole))
    before = everything(tmp_path)
    with (
        log.read(path) as opened,
        pytest.raises(McaptrackError, match="needs that name for its journal") as refused,
        log.extend(opened),
    ):
        pass
    assert everything(tmp_path) == before
    command = str(refused.value).rpartition("remove it with `")[2].rstrip("`")
    subprocess.run(command, shell=True, check=True)
    assert not os.path.lexists(journal_of(path))
    add_results(path, 3, 5)
    assert log.check(path).is_sound


@pytest.mark.skipif(not AS_ROOT, reason="only root gives files away")
@pytest.mark.parametrize(("owner", "is_used"), [(0, True), (1001, True), (1002, False)])
def test_a_journal_of_another_user_is_not_used(tmp_path, monkeypatch, owner, is_used):
    path = tmp_path / "a.mcap"
    write_log(path, SOME, "media")
    os.chown(path, 1001, 1001)
    interrupt(path)
    assert journal_of(path).stat().st_uid == 1001  # whoever owns the log owns its journal
    os.chown(journal_of(path), owner, owner)
    monkeypatch.setattr(os, "geteuid", lambda: 1001)
    with notices.collected() as said:
        try:
            look(path)
        except McaptrackError:
            assert not is_used
    assert ("belongs to another user" in said[0].message) == (not is_used)


def test_a_file_that_is_no_log_is_never_written_to(path, tmp_path):
    text = tmp_path / "thesis.txt"
    for content in (b"", b"chapter one\n" * 1000, b"x" + path.read_bytes()[1:]):
        text.write_bytes(content)
        journal_of(text).write_bytes(journal_of(path).read_bytes())
        before = everything(tmp_path)
        for verb in (look, log.check, lambda there: log.recover(there, tmp_path.parent / "no.mcap")):
            try:
                verb(text)
            except McaptrackError as error:
                assert "\n" not in str(error)
            assert everything(tmp_path) == before
        (tmp_path.parent / "no.mcap").unlink(missing_ok=True)


def test_a_journal_that_fits_a_file_that_is_no_log_changes_nothing(tmp_path):
    text = tmp_path / "thesis.txt"
    text.write_bytes(b"chapter one\n" * 1000)
    with text.open("rb+") as stream:
        journal_of(text).write_bytes(journal.pack_head(stream.fileno(), 100) + text.read_bytes()[100:])
        before = everything(tmp_path)
        with pytest.raises(McaptrackError, match="which is not an MCAP file"):
            in_place.resolve_journal(text, stream.fileno(), OpenFile.at(text))
    assert everything(tmp_path) == before


def test_what_another_program_wrote_into_a_half_written_log_is_not_undone(path):
    """Also where it is a few rows only: their content is not known."""
    with log.read(path) as opened:
        first = opened.index.data_end  # where new results begin
    with path.open("rb+") as stream:
        for row in range(2):  # one more was torn by the kill; two at most are expected
            stream.seek((first // 512 + 2 * row + 1) * 512)
            stream.write(b"by other software")
    before = everything(path.parent)
    with notices.collected() as said, pytest.raises(McaptrackError):
        look(path)
    assert "has been changed since" in said[0].message
    assert everything(path.parent) == before


def test_a_log_that_replaces_another_is_not_held_up_by_its_journal(path):
    """What `ingest --force` does: the half-written log is gone, and so is what was left of its change."""
    with log.create(path) as writer:
        writer.add_message(writer.add_channel("a", SCHEMA, "json", {}), 1, 1, b"new")
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    add_results(path, 3, 5)


def test_a_journal_that_comes_while_results_are_computed_is_not_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME, "media")
    whole = path.read_bytes()
    with log.read(path) as opened:
        opened.lock()
        journal_of(path).write_bytes(b"other content")
        with pytest.raises(McaptrackError, match="there is something else with that name"), log.extend(opened):
            pass
    assert journal_of(path).read_bytes() == b"other content"
    assert path.read_bytes() == whole


def test_the_pieces_of_a_journal_follow_each_other_and_all_but_the_last_say_so(path):
    """The numbers of the format: a journal is read by other versions than the one that wrote it."""
    raw = journal_of(path).read_bytes()
    head = struct.Struct("<QQQQQQ32s32s")
    magic = b"mcaptrack journal 2\n"
    assert raw.startswith(magic)
    at, _, _, _, size, start, *_ = head.unpack_from(raw, len(magic))
    assert at == len(magic) + head.size + 32 + size - start
    where, length, final = struct.unpack_from("<QQQ", raw, at)
    assert (where, final) == (start, 2**64 - 1)
    assert 0 < length <= path.stat().st_size
