"""What belongs to a file beside its content stays when a log is changed: other names, links, owner, rights, attributes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mcaptrack import log, notices
from mcaptrack.files import publish_bytes
from mcaptrack.log import in_place
from mcaptrack.log.journal import journal_of
from tests.interrupted import killed
from tests.logs import SCHEMA, SOME, STOCK_OPTIONS, our_messages, write_log, write_stock

AS_ROOT = os.geteuid() == 0
#: An access control list of one more user, as Linux keeps it: entries of tag, rights and number.
ACCESS_LIST = b"\x02\0\0\0" + b"".join(
    tag.to_bytes(2, "little") + rights.to_bytes(2, "little") + number.to_bytes(4, "little", signed=False)
    for tag, rights, number in (
        (1, 6, 2**32 - 1),
        (2, 4, 1001),
        (4, 0, 2**32 - 1),
        (16, 4, 2**32 - 1),
        (32, 0, 2**32 - 1),
    )
)


def add(path: Path) -> None:
    with log.read(path) as opened, log.extend(opened, drop=["b"]) as writer:
        writer.add_message(writer.add_channel("new", SCHEMA, "json", {}), 15, 1, b"added")


def attributes(path: Path) -> dict[str, bytes]:
    return {name: os.getxattr(path, name) for name in os.listxattr(path)}


LOGS: dict[str, Callable[[Path], None]] = {
    "ours": lambda path: write_log(path, SOME),
    **{name: (lambda path, given=given: write_stock(path, SOME, **given)) for name, given in STOCK_OPTIONS.items()},
}


@pytest.fixture(params=LOGS)
def path(request, tmp_path) -> Path:
    path = tmp_path / "a.mcap"
    LOGS[request.param](path)
    return path


def test_a_file_with_two_names_has_both_afterwards(path, tmp_path):
    also = tmp_path / "also.mcap"
    os.link(path, also)
    node = path.stat().st_ino
    add(path)
    assert (path.stat().st_ino, also.stat().st_ino, path.stat().st_nlink) == (node, node, 2)
    assert sorted(our_messages(also)) == ["a", "c", "new"]
    assert log.check(also).is_sound
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mcap", "also.mcap"]


@pytest.mark.skipif(not AS_ROOT, reason="only root gives files away")
def test_owner_and_group_stay(path):
    os.chown(path, 1001, 1002)
    path.chmod(0o664)
    add(path)
    there = path.stat()
    assert (there.st_uid, there.st_gid, there.st_mode & 0o7777) == (1001, 1002, 0o664)


@pytest.mark.parametrize(
    ("name", "value"), [("user.note", b"take 3"), ("system.posix_acl_access", ACCESS_LIST)], ids=["note", "access"]
)
def test_attributes_stay(path, name, value):
    try:
        os.setxattr(path, name, value)
    except OSError as error:
        pytest.skip(f"the file system keeps no attributes: {error.strerror}")
    before = attributes(path)
    assert name in before
    add(path)
    assert attributes(path) == before


def test_what_a_folder_gives_to_new_files_does_not_come_to_an_old_one(path, tmp_path):
    try:
        os.setxattr(tmp_path, "system.posix_acl_default", ACCESS_LIST)
    except OSError as error:
        pytest.skip(f"the file system keeps no attributes: {error.strerror}")
    before = attributes(path), path.stat().st_mode
    add(path)
    assert (attributes(path), path.stat().st_mode) == before


def test_where_the_owner_cant_be_kept_the_file_stays_the_same_one(path, monkeypatch):
    def refused(*_):
        raise PermissionError(1, "Operation not permitted")

    other = path.stat().st_uid + 1
    if AS_ROOT:
        os.chown(path, other, -1)
    else:
        monkeypatch.setattr("mcaptrack.log.extend.can_replace", lambda _: False)
    monkeypatch.setattr(os, "chown", refused)
    node = path.stat().st_ino
    add(path)
    assert path.stat().st_ino == node
    assert sorted(our_messages(path)) == ["a", "c", "new"]
    if AS_ROOT:
        assert path.stat().st_uid == other


def test_the_journal_has_the_permissions_of_the_log(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    write_log(path, [("a", n, n, bytes([n]) * 3000) for n in range(100)], "media")
    path.chmod(0o604)
    old = path.read_bytes()
    monkeypatch.setattr(in_place, "_PIECE", 1000)
    assert killed(lambda: add(path), 1, ["pwrite"])
    assert journal_of(path).stat().st_mode & 0o7777 == 0o604
    journal_of(path).unlink()
    path.write_bytes(old)
    monkeypatch.setattr(in_place, "keep_attributes", lambda *_: ["group"])
    assert killed(lambda: add(path), 1, ["pwrite"])
    assert journal_of(path).stat().st_mode & 0o7777 == 0o600


@pytest.mark.parametrize("refused", ["owner", "group", "permissions", "extended attributes"])
def test_what_a_new_file_can_t_be_given_is_said(tmp_path, monkeypatch, refused):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    real = path.stat()

    def stat(self, **_):
        if self != path:
            return real
        other = {"owner": (4, real.st_uid + 1), "group": (5, real.st_gid + 1)}.get(refused)
        return os.stat_result(other[1] if other and at == other[0] else value for at, value in enumerate(real[:10]))

    def fail(*_, **__):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "stat", stat)
    call = {"permissions": (Path, "chmod"), "extended attributes": ("mcaptrack.files", "_keep_extended")}
    at = call.get(refused, (os, "chown"))
    monkeypatch.setattr(*at, fail) if not isinstance(at[0], str) else monkeypatch.setattr(".".join(at), fail)
    with notices.collected() as said:
        publish_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    expected = f"{path} is a new file now, without the {refused} of the old one"
    assert [notice.message for notice in said] == [expected]
