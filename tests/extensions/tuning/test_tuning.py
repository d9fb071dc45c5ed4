"""Tuning: the search for parameters that score best."""

from __future__ import annotations

import json
import os
import re
import sys
import tomllib
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import EvaluateOptions
from mcaptrack.extensions.tuning import search
from mcaptrack.extensions.tuning.command import edited, write_settings
from mcaptrack.extensions.tuning.search import Range, Task
from mcaptrack.schema import Frame
from mcaptrack.transforms import STAGES, Sort
from tests.commands import call, printed
from tests.worlds import boxed, boxes_at, detections, ns

IOU = EvaluateOptions(similarities=("iou",))
tune = partial(search.tune, entry=STAGES["track"].entry(Sort))


def scene() -> Task:
    """A person is occluded for 2.5 s: tracks with a larger maximum age keep the identity."""
    path = [(50 + 0.5 * n, 50) for n in range(80)]
    found = detections(lambda n: [] if 30 <= n < 55 else [path[n]], 80)
    truth = [Frame(ns(n / 10), n, boxed({1: (x - 5, y - 10)})) for n, (x, y) in enumerate(path)]
    return Task(
        "scene", [f._replace(rows=boxes_at([path[n]] * len(f.rows), (10, 20))) for n, f in enumerate(found)], truth, {}
    )


@pytest.fixture
def chance(monkeypatch):
    """Search without Optuna, also where it is installed."""
    monkeypatch.setitem(sys.modules, "optuna", None)


def test_ranges_of_every_search_are_within_the_limits_of_the_parameter():
    kinds = {kind for stage in STAGES.values() for kind in stage.built_in().values()}
    declared = [one.metadata for kind in kinds for one in fields(kind) if one.metadata.get("search")]
    assert len(declared) > 10
    for limits in declared:
        low, high = limits["search"]
        assert limits["least"] <= low < high <= limits["most"], limits


@pytest.mark.parametrize("with_optuna", [False, True])
def test_a_search_finds_the_age_that_keeps_an_identity(with_optuna, monkeypatch):
    if not with_optuna:
        monkeypatch.setitem(sys.modules, "optuna", None)
    first, best = tune(Sort(), [scene()], {"max_age_s": Range(0.1, 6.0, False)}, IOU, trials=25)
    assert first.number == 0
    assert first.parameters == {}
    assert best.parameters["max_age_s"] > 2.4
    assert best.scores["IDF1"] > first.scores["IDF1"] + 0.2


@pytest.mark.parametrize("with_optuna", [False, True])
def test_an_interrupted_search_continues(with_optuna, tmp_path, monkeypatch):
    if not with_optuna:
        monkeypatch.setitem(sys.modules, "optuna", None)
    path, ranges, task = tmp_path / "study.jsonl", {"max_age_s": Range(0.1, 6.0, False)}, scene()
    told = []
    tune(Sort(), [task], ranges, IOU, trials=4, study=path, on_trial=lambda trial, *_: told.append(trial.number))
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])  # ended while the fourth was written
    tune(Sort(), [task], ranges, IOU, trials=6, study=path, on_trial=lambda trial, *_: told.append(trial.number))
    assert told == [0, 1, 2, 3, 3, 4, 5]
    assert [json.loads(line).get("number") for line in path.read_text().splitlines()] == [None, 0, 1, 2, 3, 4, 5]
    made = path.read_bytes()
    os.utime(path, ns=(5, 5))
    first, _ = tune(Sort(), [task], ranges, IOU, trials=6, study=path)  # nothing is left to try
    assert (first.number, path.stat().st_mtime_ns, path.read_bytes()) == (0, 5, made)
    if not with_optuna:  # chance draws the same whenever it is asked
        whole_way = tmp_path / "other.jsonl"
        tune(Sort(), [task], ranges, IOU, trials=6, study=whole_way)
        assert whole_way.read_bytes() == path.read_bytes()


def test_a_study_of_another_search_is_refused(chance, tmp_path):
    path, ranges = tmp_path / "study.jsonl", {"max_age_s": Range(0.1, 6.0, False)}
    tune(Sort(), [scene()], ranges, IOU, trials=1, study=path)
    with pytest.raises(McaptrackError, match=r"study of another search \(parameters differ\)"):
        tune(Sort(min_iou=0.5), [scene()], ranges, IOU, trials=2, study=path)
    path.write_text("frame,id\n1,2\n")
    with pytest.raises(McaptrackError, match="is no study"):
        tune(Sort(), [scene()], ranges, IOU, trials=2, study=path)
    with pytest.raises(McaptrackError, match="sort declares no ranges to search in; a field"):
        tune(Sort(), [scene()], {}, IOU)


def test_the_study_has_the_exact_parameters_that_were_tried(chance):
    seen = []

    @dataclass(frozen=True, kw_only=True)
    class Watched(Sort):
        def __post_init__(self):
            seen.append((self.max_age_s, self.min_iou))

    _, best = tune(
        Watched(), [scene()], {"max_age_s": Range(0, 3, False), "min_iou": Range(0, 1, False)}, IOU, trials=5
    )
    assert (best.parameters.get("max_age_s", 1.4), best.parameters.get("min_iou", 0.2)) in seen


def test_drawn_values_are_within_their_ranges():
    rng = np.random.default_rng(0)
    assert {Range(1, 3, True).draw(rng) for _ in range(100)} == {1, 2, 3}
    assert all(0.2 <= Range(0.2, 0.4, False).draw(rng) <= 0.4 for _ in range(100))


def write_files(folder):
    (folder / "det.txt").write_text(
        "".join(
            f"{f.index + 1},-1,{r['x_px']},{r['y_px']},{r['w_px']},{r['h_px']},0.9\n"
            for f in scene().frames
            for r in f.rows
        )
    )
    (folder / "gt.txt").write_text(
        "".join(
            f"{f.index + 1},1,{r['x_px']},{r['y_px']},10,20,1,-1,-1,-1\n" for f in scene().ground_truth for r in f.rows
        )
    )


def test_tune_writes_settings_that_other_commands_read(tmp_path):
    write_files(tmp_path)
    words = ("tune", "det.txt", "--truth", "gt.txt", "--set", "fps=10", "--trials", 12, "--search", "max-age-s=0.1:6")
    out, err = printed(*words, "--json", folder=tmp_path)
    row = json.loads(out)["results"][0]
    assert row["scores"]["IDF1"] > row["default_scores"]["IDF1"]
    settings = tomllib.loads((tmp_path / "mcaptrack.toml").read_text())["track"]
    assert settings["tracker"] == "sort"
    assert settings["max-age-s"] == row["settings"]["max_age_s"]
    assert "mcaptrack.toml: IDF1" in err
    printed(
        "ingest", "det.txt", "--as", "detections", "--truth", "gt.txt", "--fps", 10, "-o", "a.mcap", folder=tmp_path
    )
    printed("run", "a.mcap", "--no-tables", "-q", folder=tmp_path)
    channels = json.loads(printed("info", "a.mcap", "--json", folder=tmp_path)[0])["results"][0]["channels"]
    made = {channel["topic"]: channel["parameters"] for channel in channels}
    assert made["/camera/tracks"]["max_age_s"] == settings["max-age-s"]


def test_a_log_is_tuned_and_errors_are_one_line(tmp_path):
    write_files(tmp_path)
    log = tmp_path / "a.mcap"
    printed("ingest", tmp_path / "det.txt", "--as", "detections", "--fps", 10, "-o", log)
    code, _, err = call("tune", log, "--trials", 2, folder=tmp_path)
    assert code == 1
    assert "has no channel /camera/truth" in err
    printed("ingest", tmp_path / "gt.txt", "--as", "truth", "--fps", 10, "--into", log)
    out, _ = printed("tune", log, "--trials", 2, "--tracker", "ocsort", "-q", folder=tmp_path)
    assert "defaults" in out
    code, _, err = call("tune", log, "--search", "speed=1:2", folder=tmp_path)
    assert code == 1
    assert "--search has speed, which can't be searched; there are max_age_s" in err
    code, _, err = call("tune", log, "--search", "min-iou=0.1:7", folder=tmp_path)
    assert code == 1
    assert "min_iou has to be from 0 to 1, not 7" in err


def test_settings_are_added_to_a_file_that_exists_unless_it_cannot_be_edited(tmp_path):
    write_files(tmp_path)
    words = (
        "tune",
        "det.txt",
        "--truth",
        "gt.txt",
        "--set",
        "fps=10",
        "--trials",
        12,
        "--search",
        "max-age-s=0.1:6",
        "-q",
    )
    settings = tmp_path / "mcaptrack.toml"
    settings.write_bytes(b"# mine\r\n[ track ]  # spaced\r\nmax_age_s = 1.4 # seconds\r\nretrack.profile = 'paper'\r\n")
    settings.write_bytes(settings.read_bytes().replace(b"retrack.", b"[retrack]\r\n"))
    printed(*words, folder=tmp_path)
    written = settings.read_bytes()
    best = tomllib.loads(written.decode())["track"]["max_age_s"]
    assert best > 2.4
    assert written == (
        b"# mine\r\n[ track ]  # spaced\r\nmax_age_s = %a # seconds\r\ntracker = \"sort\"\r\n[retrack]\r\nprofile = 'paper'\r\n"
        % best
    )
    (tmp_path / "other.toml").write_text("[track\n")
    code, _, err = call(*words, "-o", "other.toml", folder=tmp_path)
    assert code == 1
    assert err.startswith("mcaptrack: other.toml is not valid TOML: ")
    assert not (tmp_path / "other.sort.trials.jsonl").exists()


def test_parameters_without_any_track_score_zero(chance):
    """Parameters without any track get a score of zero, and do not end the search."""
    task = scene()
    empty = Task("x", [f._replace(rows=f.rows[:0]) for f in task.frames], task.ground_truth, {})
    first, _ = tune(Sort(), [empty], {"min_iou": Range(0, 1, False)}, IOU, trials=2)
    assert first.scores["IDF1"] == 0.0


# Settings are written into a file of options that stays as it is otherwise


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


@pytest.mark.parametrize("text", ["track = 3\n", "[[track]]\nmax-age-s = 1\n", "[track\n", "\0", "\xff"])
def test_a_file_of_something_else_is_refused_and_stays(tmp_path, text):
    path = tmp_path / "a.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(McaptrackError, match=r"a\.toml"):
        write_settings(path, "track", NEW)
    assert path.read_bytes() == text.encode("latin-1")
