"""Stores that several commands use at once: what ``doctor`` says of a store, and faults during a whole run."""

from __future__ import annotations

import json
import re
import shutil
from itertools import count

import pytest

import mcaptrack
from mcaptrack import objects
from mcaptrack.errors import McaptrackError
from mcaptrack.location import parse
from mcaptrack.objects import trial
from tests.commands import call, done
from tests.tiers import one_in

NIGHT = parse("s3://bucket/night")


def test_of_two_writers_one_succeeds(store):
    url = NIGHT / "a"
    first = objects.put_if_unchanged(url, b"one", None)
    assert first == objects.find(url)
    assert objects.put_if_unchanged(url, b"two", None) is None
    second = objects.put_if_unchanged(url, b"three", first)
    assert second not in (None, first)
    assert objects.put_if_unchanged(url, b"four", first) is None
    assert objects.read(url) == b"three"
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
        monkeypatch.setattr(trial, "put_if_unchanged", lambda url, data, _: real(url, data, objects.find(url)))
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
    """The results of a whole run of a file."""
    mcaptrack.run(shutil.copy(bare, tmp_path / "b.mcap"), sidecar=True, tables=False)
    return (tmp_path / "b.results.mcap").read_bytes()


@pytest.mark.parametrize("fault", one_in(2, ["error", "slow", "lost", "cut"]))
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
