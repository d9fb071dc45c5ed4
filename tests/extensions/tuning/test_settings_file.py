"""Settings are written into a file of options that stays as it is otherwise."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.tuning.command import edited, write_settings

NEW = {"tracker": "ocsort", "max-age-s": 2.5, "direction-frames": 3}
BOM = "\ufeff"

#: Assignments of [track], each with its key and its text; those of NEW, under all their spellings, and others.
CHANGED = [
    ("tracker", "'sort'"),
    ("max-age-s", "1"),
    ("max_age_s", "1.5"),
    ('"max-age-s"', "0.25"),
    ("direction_frames", "0x10"),
]
KEPT = [("min-iou", "2e-1"), ("mix_classes", "true"), ("'cost'", '"iou # no comment"'), ("min-score", "0.30")]
OTHER = [
    "[retrack] # r",
    "profile = 'paper'",
    "[ sample ]",
    'rate-hz = 2.50  # "quoted"',
    "[predict]",
    "predictor = 'cv'",
]


def plain(key: str) -> str:
    return key.strip("\"'")


@st.composite
def documents(draw) -> tuple[str, list[str]]:
    """Draw a file of options, with [track] in one of the forms of TOML, and the lines of it that have to stay."""
    parts = draw(st.permutations([*draw(st.sets(st.sampled_from(CHANGED))), *draw(st.sets(st.sampled_from(KEPT)))]))
    parts = list({plain(key): (key, text) for key, text in parts}.values())
    style = draw(st.sampled_from(["header", "dotted", "inline", "none"]))
    track: list[str] = []
    if style == "header":
        track = [draw(st.sampled_from(["[track]", "[ track ]", "['track']\t", '  ["track"]'])) + "  # head"]
        for number, (key, text) in enumerate(parts):
            track += [f"# note {number}", ""] if draw(st.booleans()) else []
            track.append(f"{draw(st.sampled_from(['', '    ']))}{key} = {text}{draw(st.sampled_from(['', ' # end']))}")
    elif style == "dotted":
        track = [f"{draw(st.sampled_from(['track.', 'track . ']))}{key}={text} # dotted" for key, text in parts]
        track = ["# first", *track]
    elif style == "inline":
        space = draw(st.sampled_from(["", " "]))
        track = [f"track = {{{space}{', '.join(f'{key} = {text}' for key, text in parts)}{space}}} # inline"]
    other = OTHER[: 2 * draw(st.integers(0, 3))]
    before = style == "header" and draw(st.booleans())
    lines = [
        *draw(st.sampled_from([[], ["# top", ""], ["", "# top"]])),
        *([*other, *track] if before else [*track, *other]),
    ]
    end = draw(st.sampled_from(["\n", "\r\n"]))
    text = end.join(lines) + draw(st.sampled_from(["", end, end + end]))
    names = {plain(key) for key, _ in CHANGED}
    touched = [
        line for line in track if plain(re.sub(r"^track *\.", "", line.strip()).partition("=")[0].strip()) in names
    ]
    stay = [line + end for line in lines if line not in touched and not line.startswith("track = {")]
    return text, stay


def write(text: str) -> str:
    return edited(Path("a.toml"), text, "track", NEW)


@given(document=documents(), bom=st.booleans())
@settings(max_examples=50)
def test_writing_sets_the_value_and_changes_nothing_else(document, bom):
    text, stay = document
    written = write(BOM * bom + text)
    assert written.startswith(BOM) == bom
    written = written.removeprefix(BOM)
    wanted: dict[str, Any] = tomllib.loads(text)
    was = wanted.get("track", {})
    kept = {key: value for key, value in was.items() if key.replace("_", "-") not in NEW}
    found = tomllib.loads(written)
    assert {key: value for key, value in found.items() if key != "track"} == {
        key: value for key, value in wanted.items() if key != "track"
    }
    mine = {key: value for key, value in found["track"].items() if key not in kept}
    assert {key: found["track"][key] for key in kept} == kept
    assert {key.replace("_", "-"): value for key, value in mine.items()} == NEW
    # Whatever names a setting twice, by two spellings, gives the same value under both.
    assert all(NEW[key.replace("_", "-")] == value for key, value in mine.items())
    lines = iter(written.splitlines(keepends=True))
    for line in stay:
        assert any(line.rstrip() == other.rstrip() for other in lines), line
    assert all(word in written for word in ("# top", "# inline", "# dotted", "# first") if word in text)
    if "\r\n" in text:
        assert "\n" not in written.replace("\r\n", "")
    else:
        assert "\r" not in written
    assert write(written) == written


@pytest.mark.parametrize(
    ("text", "form"),
    [
        ("", r"\[track\]\n(.+ = .+\n){3}"),
        ("[ track ]", r"\[ track \]\n(.+ = .+\n){3}"),
        ("track.min-iou = 1 # s\nretrack.profile = 'paper'\n", r"(track\..+\n){4}retrack\.profile = 'paper'\n"),
        ("track = { max-age-s = 1 } # mine\n", r"track = \{ max-age-s = 2\.5.*\} # mine\n"),
    ],
    ids=["empty", "spaced", "dotted", "inline"],
)
def test_a_table_keeps_its_form(text, form):
    assert re.fullmatch(form, write(text))


def test_a_missing_file_is_created(tmp_path):
    write_settings(tmp_path / "new.toml", "track", {"min-iou": 0.3})
    assert (tmp_path / "new.toml").read_text() == "[track]\nmin-iou = 0.3\n"


@pytest.mark.parametrize("text", ["track = 3\n", "[[track]]\nmax-age-s = 1\n", "[track\n", "\0", "\xff"])
def test_a_file_of_something_else_is_refused_and_stays(tmp_path, text):
    path = tmp_path / "a.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(McaptrackError, match=r"a\.toml"):
        write_settings(path, "track", NEW)
    assert path.read_bytes() == text.encode("latin-1")
