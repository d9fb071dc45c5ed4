"""Logs in a store: as few requests as the index allows, the same results as of files, and one version at a time."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.stores import objects
from mcaptrack.extensions.stores.store import ObjectStore
from mcaptrack.fleet import find_logs
from mcaptrack.location import parse
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.testing import check_store
from tests.commands import call, done
from tests.extension_cases import of_extensions
from tests.logs import some_log
from tests.tiers import one_in, thorough


@pytest.fixture
def impatient(monkeypatch) -> Iterator[None]:
    """Failed requests to stores are sent again once only."""
    monkeypatch.setattr(objects, "_RETRIES", 1)
    objects._made_store.cache_clear()
    yield
    objects._made_store.cache_clear()


def _tracks(frames: int = 150, each: int = 8) -> list[Frame]:
    random = np.random.default_rng(1)
    found = []
    for number in range(frames):
        rows = TRACKS.empty(each)
        for name in rows.dtype.names or ():
            if rows[name].dtype.kind == "f":
                rows[name] = random.normal(size=rows[name].shape)
        rows["track_id"] = np.arange(1, each + 1)
        found.append(Frame(number * 40_000_000, number, rows))
    return found


@pytest.fixture(scope="session")
def large(tmp_path_factory) -> Path:
    """A log of 24 MB of pictures, with two channels of tracks behind and a third one between the pictures."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    schema = (TRACKS.name, "protobuf", TRACKS.descriptor)
    with log.create(path) as writer:
        kind = ("foxglove.CompressedVideo", "protobuf", b"")
        picture = writer.add_channel("/camera/video", kind, "protobuf", {}, "media")
        for number in range(48):
            writer.add_message(picture, number * 320_000_000, number, os.urandom(2**19))
        for topic in ("/camera/tracks", "/other/tracks"):
            channel = writer.add_channel(topic, schema, "protobuf", {}, "rows", topic)
            for frame in _tracks():
                writer.add_message(channel, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    return path


@thorough
def test_one_channel_takes_few_requests_and_few_bytes(store, large):
    url = parse(store.put("large.mcap", large))
    with store.counted() as requests, log.read(url) as opened:
        frames = opened.frames("/camera/tracks", TRACKS)
    with log.read(large) as opened:
        expected = opened.frames("/camera/tracks", TRACKS)
    assert [frame.t_ns for frame in frames] == [frame.t_ns for frame in expected]
    assert len(frames) == 150
    assert all(np.array_equal(one.rows, other.rows) for one, other in zip(frames, expected, strict=True))
    assert len(requests) <= 4, "\n".join(map(str, requests))
    assert sum(request.bytes for request in requests) <= 0.02 * large.stat().st_size


def test_commands_give_the_same_of_a_store_as_of_a_file(store, template):
    Path("here").mkdir()
    path = Path(shutil.copy(template, "here/a.mcap"))
    url = store.put("night/a.mcap", path)
    for words in (["info", "--json"], ["check", "--json"], ["evaluate", "--json"]):
        ours, theirs = (done(words[0], log, *words[1:]).out for log in (path, url))
        assert theirs == ours.replace(str(path), url)
    for command, words in of_extensions("ANSWERS").items():
        assert done(command, url, *words, "--json").out == done(command, path, *words, "--json").out
    done("export", path)
    done("export", url)
    names = {str(file.relative_to("here/a.tables")) for file in Path("here").rglob("*.parquet")}
    assert names
    assert names == {str(file.relative_to("a.tables")) for file in Path("a.tables").rglob("*.parquet")}
    for name in names:
        if name.startswith("recordings"):  # which says where the log is
            continue
        assert (Path("a.tables") / name).read_bytes() == (Path("here/a.tables") / name).read_bytes()
    assert pq.read_table("a.tables/recordings")["recording"].to_pylist() == ["a"]
    assert sorted(os.listdir()) == ["a.tables", "here"]
    assert store.names() == ["night/a.mcap"]


def test_stages_write_the_same_results_beside_an_object_as_beside_a_file(store, bare):
    path = Path(shutil.copy(bare, "b.mcap"))
    url = store.put("night/b.mcap", path)
    local = json.loads(done("run", path, "--sidecar", "--no-tables", "--json").out)["results"][0]
    with store.counted() as requests:
        remote = json.loads(done("run", url, "--json").out)["results"][0]
    assert store.get("night/b.mcap") == bare.read_bytes()
    assert store.get("night/b.results.mcap") == Path("b.results.mcap").read_bytes()
    assert remote["written_to"] == "s3://bucket/night/b.results.mcap"
    for name in ("stages", "frames", "events"):
        assert remote[name] == local[name]
    assert [r.key for r in requests if r.method not in ("GET", "HEAD")] == ["night/b.results.mcap"]
    assert json.loads(done("run", url, "--json").out)["results"][0]["stages"] == []
    again = mcaptrack.track(url, tracker="bytetrack")
    mcaptrack.track(path, tracker="bytetrack")
    assert (str(again.log), again.written_to) == (url, "s3://bucket/night/b.results.mcap")
    assert store.get("night/b.results.mcap") == Path("b.results.mcap").read_bytes()
    with mcaptrack.open(url) as opened:
        rows = mcaptrack.detections([[9, 20, 17, 28]], t_ns=0, box_format="xyxy")
        assert opened.write("/mine/detections", [rows]) == 1
        assert opened.write("/mine/speed", np.array([(5, 1.5)], [("t_ns", "i8"), ("speed_m_per_s", "f8")])) == 1
        assert "/mine/detections" in opened.topics
        assert opened.array("/mine/speed")["speed_m_per_s"].tolist() == [1.5]
    assert store.get("night/b.mcap") == bare.read_bytes()
    assert sorted(store.names()) == ["night/b.mcap", "night/b.results.mcap"]


@pytest.mark.parametrize("fault", ["error", "cut"])
def test_a_store_that_fails_always_gives_one_line(store, bare, impatient, fault):
    url = store.put("b.mcap", bare)
    with store.failing(lambda _: fault):
        code, out, err = call("info", url)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"mcaptrack: {url} can't be read: ")
    with store.failing(lambda request: fault if request.method == "PUT" else ""):
        code, out, err = call("track", url, "-q")
    assert (code, out, store.names()) == (
        (1, "", ["b.mcap"]) if fault == "error" else (0, "", ["b.mcap", "b.results.mcap"])
    )


def test_an_object_that_is_replaced_while_it_is_read_gives_one_error(store, large):
    url = parse(store.put("large.mcap", large))
    with log.read(url) as opened:
        store.put("large.mcap", large.read_bytes()[:-4] + b"else")
        opened.channel("/camera/tracks")  # what was read when it was opened
        with pytest.raises(McaptrackError, match=f"^{url} was replaced by another version while it was being read; "):
            opened.frames("/camera/tracks", TRACKS)
    store.put("large.mcap", large)
    with log.read(url) as opened:
        assert len(opened.frames("/camera/tracks", TRACKS)) == 150


def test_results_of_another_process_are_never_replaced_unseen(store, bare):
    url = parse(store.put("b.mcap", bare))
    for _ in range(2):  # new results, and results that were there
        with log.read(url, sidecar=True) as opened:
            mcaptrack.track(url, tracker="bytetrack", max_age_s=0.3 + len(store.names()))
            theirs = store.get("b.results.mcap")
            with pytest.raises(McaptrackError, match=r"b\.results\.mcap was written by another process meanwhile"):  # noqa: SIM117
                with log.extend(opened) as writer:
                    writer.add_metadata("ours", {})
        assert store.get("b.results.mcap") == theirs


def test_nothing_is_left_of_a_stage_that_fails(store, bare):
    url = parse(store.put("b.mcap", bare))
    with pytest.raises(ZeroDivisionError), log.read(url, sidecar=True) as opened, log.extend(opened):
        1 / 0  # noqa: B018
    assert store.names() == ["b.mcap"]


ABSENT = {
    "s3://bucket": "can't be read: it is a bucket; name the logs in it, as in s3://bucket/*.mcap",
    "s3://bucket/night": "can't be read: it is no object but a prefix, of s3://bucket/night/a.mcap and maybe others; name "
    "logs, as in s3://bucket/night/*.mcap",
    "s3://bucket/none.mcap": "can't be read: there is no such object",
    "s3://nowhere/a.mcap": "can't be read: there is no such bucket",
    "s3://bucket/empty.mcap": "can't be read as an MCAP file: it is empty",
    "s3://bucket/text.mcap": "can't be read as an MCAP file: it does not begin as an MCAP file does",
}


def test_what_is_no_log_is_named_in_one_line(store):
    for name, content in (("night/a.mcap", b"x"), ("empty.mcap", b""), ("text.mcap", b"text" * 99)):
        store.put(name, content)
    for url, why in ABSENT.items():
        with pytest.raises(McaptrackError) as raised:
            mcaptrack.info(url)
        assert str(raised.value) == f"{url} {why}"


def test_what_needs_a_file_refuses_an_object(store, bare):
    url = store.put("b.mcap", bare)
    for command, *more in (["drop", "/camera/tracks"], ["view"], ["track", "--in-place"]):
        code, _, err = call(command, url, *more)
        assert (code, err.count("\n"), url in err) == (1, 1, True)
        assert store.names() == ["b.mcap"]


def test_prefixes_and_patterns_name_the_logs_below(store, bare):
    for name in [
        "one.mcap",
        "one.results.mcap",
        "2/two.mcap",
        ".old/x.mcap",
        "notes.txt",
        "../bb/three.mcap",
        "../[4].mcap",
    ]:
        store.put(os.path.normpath(f"b/{name}"), b"" if name.endswith(".txt") else bare)

    def found(*given: str) -> list[tuple[str, str]]:
        return [(str(one.path).removeprefix("s3://bucket/"), str(one.below)) for one in find_logs(given)]

    both = [("b/2/two.mcap", "2/two.mcap"), ("b/one.mcap", "one.mcap")]
    assert found("s3://bucket/b") == found("s3://bucket/b/") == both
    assert found("s3://bucket/b*/*.mcap") == [("b/one.mcap", "b/one.mcap"), ("bb/three.mcap", "bb/three.mcap")]
    assert found("s3://bucket/**/t*.mcap") == [("b/2/two.mcap", "b/2/two.mcap"), ("bb/three.mcap", "bb/three.mcap")]
    assert found("s3://bucket/[b]b") == [("bb/three.mcap", "bb/three.mcap")]
    assert found("s3://bucket/b/one.mcap", "s3://bucket/b") == [("b/one.mcap", "one.mcap"), both[0]]
    for url, words in (("none/", "has no log: no object below it ends with .mcap"), ("x*.mcap", "no object matches")):
        with pytest.raises(McaptrackError, match=words):
            find_logs([f"s3://bucket/{url}"])
    code, out, err = call("info", "s3://bucket/b", "--json")
    assert code == 0, err
    assert [one["log"] for one in json.loads(out)["results"]] == ["s3://bucket/b/2/two.mcap", "s3://bucket/b/one.mcap"]


def test_without_the_library_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore", None)
    words = (
        "s3://b/a.mcap is in Amazon S3, which needs obstore, and that is not installed; install it with: pip install "
    )
    assert call("info", "s3://b/a.mcap") == (1, "", f'mcaptrack: {words}"mcaptrack[cloud]"\n')


def test_credentials_come_from_a_profile_and_are_never_shown(store, bare, monkeypatch):
    url = store.put("b.mcap", bare)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_ENDPOINT_URL"):
        monkeypatch.delenv(name)
    Path("keys").write_text("[default]\n[robots]\naws_access_key_id = AKIDROBOTS\naws_secret_access_key = hidden\n")
    Path("config").write_text(f"[profile robots]\nregion = eu-west-1\nendpoint_url = {store.endpoint}\n")
    for name, value in (("CONFIG_FILE", "config"), ("SHARED_CREDENTIALS_FILE", "keys"), ("PROFILE", "robots")):
        monkeypatch.setenv(f"AWS_{name}", value)
    with store.counted() as requests:
        done("info", url)
    assert {request.key_id for request in requests} == {"AKIDROBOTS"}
    monkeypatch.setenv("AWS_DEFAULT_REGION", "eu-north-1")
    assert "region" not in objects.store_of(parse(url)).config  # the library reads AWS_REGION
    monkeypatch.delenv("AWS_REGION")
    assert objects.store_of(parse(url)).config["region"] == "eu-north-1"
    monkeypatch.setenv("AWS_PROFILE", "default")
    code, _, err = call("info", url)
    assert (code, err.count("\n")) == (1, 1)
    assert "the profile default of AWS (AWS_PROFILE) has no aws_access_key_id" in err
    code, _, err = call("info", "s3://AKIDROBOTS:hidden@bucket/b.mcap")
    assert (code, err.count("\n")) == (1, 1)
    assert "hidden" not in err
    assert "AKID" not in err


def test_what_the_store_refuses_is_named(store, bare):
    url = store.put("a.mcap", bare)
    refused = "can't be read: the store refuses it to these credentials (forbidden)"
    with store.failing(lambda _: "denied"):
        for command in ("check", "info"):
            assert call(command, url) == (1, "", f"mcaptrack: {url} {refused}\n")
    url = url.replace("a.mcap", "a.results.mcap")
    hint = "it may be absent, which S3 tells only to those with s3:ListBucket"
    with store.failing(lambda request: "denied" if request.key == "a.results.mcap" else ""):
        for command in ("check", "info"):
            assert call(command, "s3://bucket/a.mcap") == (1, "", f"mcaptrack: {url} {refused}; {hint}\n")


def test_a_log_in_a_store_is_recovered_to_a_file(store, template):
    url = store.put("a.mcap", template.read_bytes()[:-2000])
    assert call("check", url).code == 1
    done("recover", url)
    with mcaptrack.open("a.recovered.mcap") as opened:
        assert "/camera/tracks" in opened.topics


def test_messages_of_an_object_are_those_of_the_file_in_few_requests(store, large):
    url = store.put("large.mcap", large)
    with mcaptrack.open(url) as remote, mcaptrack.open(large) as local:
        assert list(remote.messages(decode=False)) == list(local.messages(decode=False))
        period = {"start": 10**9, "end": 2 * 10**9, "reverse": True, "decode": False}
        assert list(remote.messages(**period)) == list(local.messages(**period))
    with mcaptrack.open(url) as remote, store.counted() as requests:
        assert len(list(remote.messages("/camera/tracks"))) == 150
    assert [request.method for request in requests].count("GET") <= 2
    assert sum(request.bytes for request in requests) < 2**20


@thorough
def test_a_recording_in_a_store_is_never_stale(store, large, tmp_path):
    content = {name: some_log(tmp_path / f"{name}.mcap", **{name: (TRACKS, [])}) for name in ("/one", "/other")}
    url = store.put("a.mcap", large)
    with mcaptrack.open(url) as opened:
        begun = opened.messages(decode=False)
        store.put("a.mcap", content["/one"])
        assert "/one" in opened.topics
        with pytest.raises(McaptrackError, match=r"a.mcap was replaced by another version while it was being read"):
            list(begun)
        begun = opened.messages(decode=False)  # of an object that is small enough to be kept whole
        wanted = list(opened.messages(decode=False))
        store.put("a.mcap", content["/other"])
        assert "/other" in opened.topics
        assert list(begun) == wanted
        for change, there in (
            (lambda: mcaptrack.track(url, tracker="sort", force=True), True), (lambda: store.client.delete_object(
                Bucket="bucket", Key="a.results.mcap"), False),
        ):  # fmt: skip
            change()
            assert any(c["part"] == "results" for c in mcaptrack.info(url).to_json()["channels"]) == there
            with mcaptrack.open(url) as fresh:
                assert opened.table("channels").equals(fresh.table("channels"))


def test_a_process_that_was_forked_from_one_that_has_used_a_store_says_so(store, large, monkeypatch):
    url = store.put("large.mcap", large)
    with mcaptrack.open(url) as opened:
        monkeypatch.setattr(os, "getpid", lambda: -1)
        for work in (lambda: opened.topics, lambda: mcaptrack.open(url)):
            with pytest.raises(McaptrackError, match=r"can't be reached: this process was forked .* by spawning"):
                work()


# Stores that several commands use at once: what ``doctor`` says of a store, and faults during a whole run


NIGHT = parse("s3://bucket/night")


def test_it_keeps_the_laws_of_stores(store):
    check_store(ObjectStore, str(NIGHT))
    assert store.names() == []


def test_of_two_writers_one_succeeds(store):
    url = NIGHT / "a"
    first = objects.put_if_unchanged(url, b"one", None)
    assert first == objects.find(url)
    assert objects.put_if_unchanged(url, b"two", None) is None
    second = objects.put_if_unchanged(url, b"three", first)
    assert second not in (None, first)
    assert objects.put_if_unchanged(url, b"four", first) is None
    assert store.get(url.key) == b"three"
    objects.delete(url)
    objects.delete(url)
    assert objects.put_if_unchanged(url, b"five", second) is None
    assert objects.find(url) is None


class TestDoctor:
    def access(self, *words: str) -> tuple[int, dict[str, str], str]:
        code, out, err = call("doctor", *words, "--json")
        return code, json.loads(out)["store"]["access"], err

    def test_a_store_that_can_be_used_has_no_faults_and_nothing_is_left_over(self, store):
        store.put("night/a.mcap", b"x")
        names = ("list", "write", "read", "put-if-absent", "replace", "delete")
        assert self.access(str(NIGHT)) == (0, dict.fromkeys(names, ""), "")
        assert store.names() == ["night/a.mcap"]
        page = done("doctor", f"{NIGHT}/a.mcap").out
        assert re.search(rf"^store +{NIGHT}$", page, re.M)
        assert f"{store.endpoint}, region us-east-1" in page
        assert re.search("^  credentials +the environment$", page, re.M)

    @thorough
    def test_what_may_not_be_done_is_one_line(self, store):
        store.put("night/a.mcap", b"x")
        with store.failing(lambda request: "denied" if request.method == "PUT" else ""):
            code, access, err = self.access(str(NIGHT))
        why = "the store refuses it to these credentials (forbidden)"
        assert (code, access) == (1, {"list": "", "write": why, "read": ""})
        assert err == f"mcaptrack: {NIGHT}: objects can't be written: {why}\n"
        with store.failing(lambda request: "denied" if "list-type" in request.query else ""):
            code, access, err = self.access(str(NIGHT))
        assert (code, err) == (1, f"mcaptrack: {NIGHT}: objects can't be listed: {why}\n")
        assert store.names() == ["night/a.mcap"]

    def test_a_store_that_ignores_conditions_is_found_out(self, store, monkeypatch):
        real = objects.put_if_unchanged
        monkeypatch.setattr(objects, "put_if_unchanged", lambda url, data, _: real(url, data, objects.find(url)))
        code, access, err = self.access(str(NIGHT))
        assert code == 1
        assert [name for name, why in access.items() if why] == ["put-if-absent", "replace"]
        assert "two commands at once may both write the first results of a log" in err
        assert store.names() == []

    @pytest.mark.parametrize(
        ("variables", "url", "words"),
        [
            ({}, "s3://nowhere/night", "there is no such bucket"),
            ({"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, NIGHT, "the store can't be reached at http://127.0.0.1:9"),
            ({"AWS_PROFILE": "none", "AWS_ACCESS_KEY_ID": None}, NIGHT, "the profile none of AWS (AWS_PROFILE) has no"),
        ],
    )
    def test_a_cause_of_several_faults_is_said_once(self, store, impatient, monkeypatch, variables, url, words):
        for name, value in variables.items():
            monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name)
        code, _, err = call("doctor", url, "-q")
        assert (code, err.count("\n"), err.count(words)) == (1, 1, 1), err

    @pytest.mark.parametrize(
        ("url", "shown"), [("night", "night"), ("https://me:secret@example.org/x", "https://example.org/x")]
    )
    def test_a_text_that_names_no_store_is_refused(self, url, shown):
        words = "is no bucket or prefix in a store; give a URL with s3://, gs://, az://"
        with pytest.raises(McaptrackError, match=f"^{shown} {words}$"):
            mcaptrack.doctor(url)


@pytest.fixture
def expected(bare, tmp_path) -> bytes:
    mcaptrack.run(shutil.copy(bare, tmp_path / "b.mcap"), sidecar=True, tables=False)
    return (tmp_path / "b.results.mcap").read_bytes()


@pytest.mark.parametrize("fault", one_in(4, ["error", "slow", "lost", "cut"]))
def test_a_whole_run_is_right_though_one_request_in_twenty_fails(store, bare, expected, fault):
    url, number = store.put("night/b.mcap", bare), count(17)
    with store.failing(lambda _: fault if next(number) % 20 == 19 else ""), store.counted() as requests:
        mcaptrack.run(url)
    assert len(requests) >= 3
    assert store.get("night/b.results.mcap") == expected


def test_a_log_that_is_replaced_during_a_run_is_one_line(store, bare):
    url, number = store.put("night/b.mcap", bare), count()

    def replace(_: object) -> str:
        if next(number) == 1:
            store.put("night/b.mcap", bare.read_bytes() + b" ")
        return ""

    with store.failing(replace):
        code, _, err = call("run", url, "-q")
    assert (code, store.names()) == (1, ["night/b.mcap"])
    assert "was replaced by another version while it was being read; try again" in err.splitlines()[-1]


@thorough
def test_a_whole_run_whose_credentials_expire_is_one_line_and_can_be_run_again(store, bare, expected):
    url, number = store.put("night/b.mcap", bare), count()
    with store.failing(lambda _: "expired" if next(number) > 1 else ""):
        code, _, err = call("run", url, "-q")
    lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
    assert (code, len(lines)) == (1, 1)
    assert lines[0].startswith(f"mcaptrack: {url} can't be read: ")
    assert "the credentials may have expired" in lines[0] or "the credentials have expired; renew them" in lines[0]
    assert store.names() == ["night/b.mcap"]
    mcaptrack.run(url)
    assert store.get("night/b.results.mcap") == expected
