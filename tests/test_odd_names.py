"""Names are bytes: logs whose names are as long as they can be, not UTF-8, or look like URLs or options."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack.location import sibling
from mcaptrack.log import results_path
from mcaptrack.log.journal import journal_of
from tests.commands import call
from tests.extension_cases import of_extensions
from tests.tiers import one_in

NAMES = {
    "not UTF-8": os.fsdecode(b"a\xff\xfe.mcap"),
    "a time": "walk-12:00.mcap",
    "as long as can be": "n" * 250 + ".mcap",
    "letters of two bytes": "\u00e9" * 124 + "xx.mcap",
    "a store": "s3:foo.mcap",
    "an address": "http:x.mcap",
    "lines": "a\nb\x1b[2J.mcap",
    "an option": "--json.mcap",
    "no room for a journal": "n" * 243 + ".mcap",
    "a blank": " ",
}


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
@pytest.mark.parametrize("name", one_in(len(NAMES), NAMES.values()), ids=NAMES)
def test_logs_of_all_names_are_used_as_others_are(template, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    shutil.copy(template, name)
    for line in (
        ["info", "--json"],
        ["track", "--force"],
        ["run"],
        ["export", "--force"],
        *of_extensions("NAMED").values(),
        ["recover"],
        ["track", "--sidecar", "--force"],
        ["drop", "/camera/predictions*"],
        ["info", "--json"],
    ):
        words = [*line[:1], *(["draw"] if "draw" in line else []), f"./{name}", *(w for w in line[1:] if w != "draw")]
        outcome = call(*words)
        assert outcome.code == 0, (line, outcome)
        assert all(text.isprintable() for text in (outcome.out + outcome.err).split("\n")), (line, outcome)
        if line[0] == "info":
            assert json.loads(outcome.out)["results"][0]["log"] == name
    assert results_path(Path(name)).is_file()
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.parametrize("command", ["info", "run", "drop", "export", *of_extensions("NEEDS")])
def test_names_that_no_file_can_have_are_refused_in_one_line(command):
    outcome = call(
        command, "n" * 300 + ".mcap", *of_extensions("NEEDS").get(command, ["/a"] if command == "drop" else [])
    )
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1)
    assert "File name too long" in outcome.err


@given(
    st.sets(
        st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=60), min_size=1, max_size=9
    )
)
def test_names_beside_a_log_fit_and_differ(parts):
    names = {part * (250 // len(part.encode())) for part in parts if part.strip(".")}
    paths = [Path(f"{name}.mcap") for name in names]
    for beside in (results_path, journal_of, lambda path: sibling(path, ".page.html")):
        found = [beside(path).name for path in paths]
        assert len(set(found)) == len(paths)
        assert all(len(name.encode()) <= 255 for name in found)
    assert sibling(Path("a/b.c.mcap"), ".tables") == Path("a/b.c.tables")
