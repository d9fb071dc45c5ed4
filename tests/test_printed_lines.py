"""Lines that commands print, word by word, and values of options at the ends of what is accepted."""

from __future__ import annotations

import inspect
import io
import json
import logging
import os
import re
from contextlib import redirect_stdout
from contextvars import copy_context
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import mcaptrack
from mcaptrack.api.running import RunResult
from mcaptrack.cli import common, running
from mcaptrack.cli.calibrate import _words
from mcaptrack.cli.config import MAX_BYTES, ConfigFile, read_toml
from mcaptrack.cli.evaluate import _gates, _limit
from mcaptrack.cli.flags import RUNNING, with_flags
from mcaptrack.cli.plugins import _files, _names_of_settings, _values
from mcaptrack.cli.query import _asked, _form, _named, _print_answer
from mcaptrack.cli.settings import Declared, Setting
from mcaptrack.cli.show import _lineage, _print
from mcaptrack.cli.text import console, printable
from mcaptrack.cli.tune import _range
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import Notice
from mcaptrack.pipeline.summary import Repair, Summary, SummaryScores
from mcaptrack.transforms import STAGES
from tests.commands import GROUP, call
from tests.test_settings import another, options_of, words_for


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        return True


def on_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> Terminal:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    return Terminal()


# What `run` and the stages print


LOG = Path("a b.mcap")


def result(**changed: Any) -> RunResult:
    plain: dict[str, Any] = {
        "log": LOG,
        "stages": ("track",),
        "written_to": LOG,
        "written_because": "",
        "seconds": 1.26,
    }
    plain |= {"summary": None, "zones": None} | {
        name: {} for name in ("frames", "rows", "tracks", "events", "tables", "seconds_by_part")
    }
    plain |= dict.fromkeys(("stale", "layouts", "warnings", "notes"), ())
    return RunResult(**plain | changed)


REPAIRED = Summary(tracks=1200, repair=Repair(1, 2, 3, 4000))
SUMMARIES: dict[str, tuple[Summary, list[str]]] = {
    "nothing": (Summary(), []),
    "boxes of pictures": (Summary(pictures=1000, boxes=2000), ["boxes: 2,000 in 1,000 pictures"]),
    "boxes of a label file": (Summary(boxes=0), ["boxes: 0"]),
    "boxes in space": (Summary(boxes=1200, frame_id="map"), ["boxes: 1,200, tracked in the frame map"]),
    "one track": (
        REPAIRED,
        ["tracks: 1,200", "re-tracked: 1 track: 2 gaps closed, 3 split, 4,000 left out"],
    ),
    "several tracks": (
        Summary(tracks=0, repair=Repair(1000, 0, 0, 0)),
        ["tracks: 0", "re-tracked: 1,000 tracks: 0 gaps closed, 0 split, 0 left out"],
    ),
    "scores": (
        Summary(scores=SummaryScores((0.5, 0.75), (1234, 5), "within 1 m")),
        [
            "ground truth: IDF1 50.0% before re-tracking, 75.0% after; identity switches 1,234, then 5 "
            "(matched within 1 m)"
        ],
    ),
    "no forecasts": (Summary(forecasts=0), ["forecasts: 0"]),
    "forecasts": (Summary(forecasts=1234, horizon_s=4.8), ["forecasts: 1,234, 4.8 s ahead"]),
    "an assumed plane": (
        Summary(ground_plane="assumed"),
        ["assumed: the scale of the ground, from the heights of boxes"],
    ),
    "an estimated plane": (
        Summary(ground_plane="estimated"),
        ["estimated: the ground plane, from the boxes of people"],
    ),
    "a camera that sways": (Summary(camera_motion="shaking"), ["camera: shaking"]),
    "a given plane": (Summary(ground_plane="given"), []),
}


@pytest.mark.parametrize(("summary", "wanted"), SUMMARIES.values(), ids=SUMMARIES)
def test_a_summary_has_a_line_for_each_part_that_is_there(summary, wanted):
    lines = list(running._lines_of_run(result(summary=summary)))
    assert [f"{name}: {words}" for name, words in lines] == wanted


def test_the_warnings_of_a_run_are_counted_by_message_and_named_by_kind():
    said = tuple(Notice(words, code) for words, code in (("a", "other"), ("b", "lost"), ("c", "other")))
    assert list(running._lines_of_run(result(warnings=said))) == [("warnings", "3, see above: other, lost")]


@pytest.mark.parametrize(
    ("changed", "steps"),
    [
        ({}, ["run"]),
        ({"stages": ("detect", "events")}, ["run"]),
        ({"stages": ("events",)}, ["view"]),
        ({"summary": Summary()}, ["info"]),
        ({"summary": Summary(tracks=0)}, ["info"]),
        ({"summary": Summary(tracks=1)}, ["view"]),
        ({"summary": Summary(tracks=1, scores=SummaryScores((0, 0), (0, 0), ""))}, ["view", "evaluate"]),
    ],
)
def test_the_next_command_depends_on_what_there_is(changed, steps):
    assert running._next(result(**changed)) == [f"mcaptrack {step} 'a b.mcap'" for step in steps]


def printed_lines(made: RunResult, shows_events: bool = False, **talk: bool) -> list[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", printed := io.StringIO())
        running._print(made, shows_events, common.Talk(**{"quiet": False, "verbose": False} | talk))
        return printed.getvalue().splitlines()


def test_the_result_of_stages_has_a_line_for_each_channel_below_each_other():
    made = result(
        stages=("detect", "track"),
        frames={"/a/detections": 1000, "/a/tracks": 10},
        rows={"/a/detections": 12345, "/a/tracks": 20},
        tracks={"/a/tracks": 1001},
        events={"/a/tracks": {"birth": 3, "end": 0, "switch": 1}, "/b": {"birth": 0}},
        tables={"tracks": 5, "frames": 6},
        written_to=Path("other.mcap"),
        written_because="ROS reads it",
    )
    brief = [
        "a b.mcap: detect, track in 1.3 s",
        "  /a/detections  12,345 rows in 1,000 frames",
        "  /a/tracks      1,001 tracks, 20 rows in 10 frames",
        "  written        results are in other.mcap: ROS reads it",
        "  next           mcaptrack run 'a b.mcap'",
    ]
    happened = ["/a/tracks: birth 3, switch 1", "/b: nothing happened"]
    assert printed_lines(made) == brief
    assert printed_lines(made, True) == [*happened, *brief]
    assert printed_lines(made, verbose=True) == [
        "a b.mcap: /a/detections 1000 frames",
        "a b.mcap: /a/tracks 10 frames",
        *happened,
        "a b.mcap: tracks 5, frames 6",
        *brief,
    ]
    assert printed_lines(made, True, quiet=True, verbose=True) == []


@pytest.mark.parametrize(("because", "to", "said"), [("", LOG, 0), ("why", None, 0), ("why", LOG, 1)])
def test_where_results_are_is_said_where_that_needs_a_reason(because, to, said):
    lines = printed_lines(result(stages=(), written_because=because, written_to=to))
    assert lines[0] == "a b.mcap: nothing to do, everything is up to date"
    assert sum("results are in a b.mcap: why" in line for line in lines) == said == len(lines) - 2
    data = running._as_json(result(written_because=because, written_to=to))
    assert (data["written_there_because"], data["written_to"]) == (because or None, to and str(to))


# Trees and tables


def channel(number: int, **more: Any) -> dict[str, Any]:
    plain = {"topic": f"/{number}", "input": f"/{number - 1}", "transform": "track", "plugins": None}
    return plain | {"stale": False, "parameters": None, "frame": None} | more


def depths(channels: list[dict[str, Any]]) -> dict[str, int]:
    found, waiting = {}, [(_lineage(channels, False), 0)]
    while waiting:
        node, depth = waiting.pop()
        found[str(node.label).split("  ")[0]] = depth
        waiting += [(child, depth + 1) for child in node.children]
    return found


def test_a_deep_lineage_goes_on_at_its_thirtieth_level():
    found = depths([channel(number) for number in range(1, 34)])
    assert found == {"lineage": 0} | {f"/{number}": min(number, 30) for number in range(1, 34)}


def test_channels_that_share_an_input_stand_in_their_order_with_what_made_them():
    plugin = {"name": "own", "distribution": "pkg", "version": "1.2"}
    channels = [
        channel(1, transform=None),
        channel(2, plugins={"transform": plugin}, stale=True),
        channel(3, input="/1", plugins={"transform": plugin | {"distribution": "", "version": ""}}),
        channel(4, input="/1", transform="view"),
        channel(5, input="/gone"),
    ]
    with redirect_stdout(io.StringIO()) as out:
        console().print(_lineage(channels, False))
    assert [line.rstrip() for line in out.getvalue().splitlines()] == [
        "lineage",
        "├── /1",
        "│   ├── /2  track  own (pkg 1.2)  out of date",
        "│   └── /3  track  own",
        "└── /5  track",
    ]


def answer(**columns: Any) -> Any:
    return pa.table(columns)


def shown(made: Any, limit: int, stream: io.StringIO) -> tuple[list[str], str]:
    with redirect_stdout(stream):
        note = _print_answer(made, limit)
    return [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue()).splitlines()], note


@pytest.mark.parametrize("word", ["abcdefghij" * 5, "abcd fghi " * 5 + "end"])
def test_a_wide_first_column_is_broken_on_a_terminal_and_nowhere_else(word, monkeypatch):
    lines, note = shown(answer(word=[word]), 0, on_terminal(monkeypatch, 30))
    assert ("".join(lines[2:]).replace(" ", ""), note) == (word.replace(" ", ""), "")
    assert max(map(len, lines)) <= 30
    assert shown(answer(word=[word]), 0, io.StringIO())[0][2] == word


def test_numbers_stand_to_the_right_and_words_to_the_left():
    lines, note = shown(answer(n=[1, 1000], word=["a", "bbbb"], x=[0.5, None]), 0, io.StringIO())
    assert note == ""
    head, _, one, two = lines
    assert [one.index("1"), two.index("1000")] == [3, 0]
    assert one.index("a") == two.index("b") == head.index("word")
    assert one.endswith("0.5")
    assert two.endswith("null")


@pytest.mark.parametrize(
    ("count", "limit", "rows", "note"),
    [
        (3, 0, 3, ""),
        (3, 3, 3, ""),
        (3, 4, 3, ""),
        (3, 2, 2, "the first 2 of 3 rows; --rows 0 shows all"),
        (0, 0, 0, "no rows"),
        (0, 5, 0, "no rows"),
    ],
)
def test_a_note_says_how_many_rows_there_are(count, limit, rows, note):
    lines, said = shown(answer(n=pa.array(range(count), pa.int64())), limit, io.StringIO())
    assert (lines[2:], said) == ([str(number) for number in range(rows)], note)


@pytest.mark.parametrize(("width", "cut"), [(59, 0), (60, 0), (61, 1)])
def test_cells_of_more_than_sixty_characters_are_cut_on_a_terminal(monkeypatch, width, cut):
    lines, note = shown(answer(a=["x" * width], b=["y" * width]), 0, on_terminal(monkeypatch, 200))
    words = ("y" * width if not cut else "y" * 59 + "…"), ("2 long values are cut;" if cut else "")
    assert (lines[2].split()[1], note.partition(" --")[0]) == words
    lines, note = shown(answer(a=["x" * 1001, "x" * 1000]), 0, io.StringIO())
    assert lines[2:] == ["x" * 999 + "…", "x" * 1000]
    assert note.startswith("1 long value is cut;")


def test_columns_that_do_not_fit_are_named(monkeypatch):
    made = answer(**{name: ["1234567"] for name in ("aaaa", "bbbb", "cccc", "dddd")})
    lines, note = shown(made, 0, on_terminal(monkeypatch, 20))
    assert lines[0].split() == ["aaaa", "bbbb"]
    assert note == "2 of 4 columns fit; without: cccc, dddd"


# Values of options


def setting(kind: Any, many: bool = False, **declared: Any) -> Setting:
    return Setting("track", "some-option", "some_option", kind, many, Declared(**declared))


@pytest.mark.parametrize(
    ("kind", "value", "wanted"),
    [
        (int, 3, 3),
        (int, 2**63 - 1, 2**63 - 1),
        (int, 1 - 2**63, 1 - 2**63),
        (int, 2**63, None),
        (int, -(2**64), None),
        (int, 3.0, None),
        (int, True, None),
        (float, 3, 3),
        (float, 0.5, 0.5),
        (float, 2**63, None),
        (float, False, None),
        (bool, False, False),
        (bool, 1, None),
        (str, 25, "25"),
        (str, 2.5, "2.5"),
        (str, "", ""),
        (str, True, None),
        (Path, "a", "a"),
        (Path, 1, None),
    ],
)
def test_a_value_of_a_file_is_of_the_type_of_its_option(kind, value, wanted):
    if wanted is None:
        with pytest.raises(ValueError, match=r"^(needs|is too large)"):
            setting(kind).from_toml(value)
        with pytest.raises(ValueError, match=r"^(needs|is too large)"):
            setting(kind, many=True).from_toml([wanted, value])
        return
    made = setting(kind).from_toml(value)
    assert (made, type(made)) == (wanted, type(wanted))
    assert setting(kind, many=True).from_toml(value) == [wanted]
    assert setting(kind, many=True).from_toml([value, value]) == [wanted, wanted]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [(" TRUE ", True), ("1", True), ("yes", True), ("on", True), ("0", False), ("False", False), ("no", False)]
    + [("off\n", False), ("2", None), ("y", None), ("truefalse", None)],
)
def test_switches_have_few_words_in_the_environment(text, wanted):
    if wanted is None:
        with pytest.raises(ValueError, match=r"^needs true or false, not "):
            setting(bool).from_text(text)
    else:
        assert setting(bool).from_text(text) is wanted


def test_a_list_in_the_environment_is_taken_apart_as_by_a_shell():
    assert setting(str, many=True).from_text("a 'b c' d") == ["a", "b c", "d"]
    assert setting(str).from_text(" a b ") == " a b "


@pytest.mark.parametrize(
    ("tuning", "many", "value", "may"),
    [(True, False, "any", True), (False, False, 1, False), ("a+", False, "aa", True), ("a+", False, "aab", False)]
    + [("a+", True, ["a", "aa"], True), ("a+", True, ["a", "b"], False), ("a+", True, [], True)],
)
def test_a_file_beside_the_data_may_tune_by_the_whole_value(tuning, many, value, may):
    assert setting(str, many, tuning=tuning).may_tune(value) is may


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize(
    ("value", "accepted"), [(1, True), (2, True), (0.999, False), (2.001, False), (None, True), (float("nan"), False)]
)
def test_a_number_at_an_end_of_the_range_is_in_it(value, accepted, many):
    option = setting(float, many, least=1, most=2)
    given = value if not many else None if value is None else [1, value]
    if accepted:
        option.check(given, "")
        return
    for where, said in (("", "--some-option"), ("a.toml: [track] some_option", "a.toml: [track] some_option")):
        with pytest.raises(McaptrackError) as error:
            option.check(given, where)
        assert str(error.value) == f"{said} has to be from 1 to 2, not {value}"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [("0.5,1,2", (0.5, 1.0, 2.0)), (" 1 ", (1.0,)), ("0.001", (0.001,)), ("0", None), ("1,-1", None), ("inf", None)]
    + [("nan", None), ("", None), ("1,", None)],
)
def test_gates_are_finite_distances_above_zero(text, wanted):
    if wanted is None:
        with pytest.raises(McaptrackError, match=rf"^--gate-m needs distances .* not {text!r}$"):
            _gates(text)
    else:
        assert _gates(text) == wanted


@pytest.mark.parametrize(
    ("text", "wanted"),
    [("idf1=0.7", ("IDF1", 0.7)), (" MOTA =-1", ("MOTA", -1.0)), ("idf1", None), ("idf1=", None), ("luck=1", None)],
)
def test_a_limit_is_a_score_and_a_number(text, wanted):
    if wanted is None:
        with pytest.raises(McaptrackError, match=rf"^--fail-under needs one of .*idf1.* not '{text}'$"):
            _limit(text)
    else:
        assert _limit(text) == wanted


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("min-iou", ("min_iou", None)),
        ("--min-iou", ("min_iou", None)),
        ("min-iou=0.1:0.5", ("min_iou", (0.1, 0.5))),
        (" max-age-s =1:2", ("max_age_s", (1.0, 2.0))),
        ("min-iou=0.1", None),
        ("min-iou=1:2:3", None),
        ("min-iou=", None),
        ("min-iou=a:b", None),
    ],
)
def test_a_range_to_search_has_two_ends(text, wanted):
    if wanted is None:
        with pytest.raises(McaptrackError, match=rf"^--search needs a range like min-iou=0.1:0.5, not {text}$"):
            _range(text)
    else:
        assert _range(text) == wanted


def test_values_of_an_option_are_found_in_both_spellings():
    words = ["track", "--tracker", "a", "--tracker=b", "--trackers", "c", "--tracker"]
    assert _values(words, "tracker") == ["a", "b"]
    assert _values(["--tracker="], "tracker") == [""]


@pytest.mark.parametrize(
    ("words", "form", "output", "wanted"),
    [
        ([], None, None, "table"),
        ([], "csv", None, "csv"),
        ([], None, "a.CSV", "csv"),
        ([], "jsonl", "a.csv", "jsonl"),
        ([], None, "a.txt", "table"),
        ([], None, "a.parquet", "parquet"),
        (["json"], None, "a.csv", "json"),
        (["json"], "json", None, "json"),
        (["json"], "csv", None, "--json and --format csv are two formats"),
        ([], "parquet", None, "--format parquet is not text"),
        ([], "arrow", None, "--format arrow is not text"),
    ],
)
def test_the_format_of_an_answer_is_named_or_that_of_the_file(words, form, output, wanted):
    def chosen() -> str:
        return _form(form, Path(output) if output else None, bool(words))

    if " " in wanted:
        with pytest.raises(McaptrackError, match=wanted):
            chosen()
    else:
        assert chosen() == wanted


def test_tables_of_files_have_a_name_and_a_path():
    assert _named(["a=b.csv", "c=d=e.csv"]) == {"a": Path("b.csv"), "c": Path("d=e.csv")}
    for words in ("a", "a="):
        with pytest.raises(McaptrackError, match=f"^--with {words}: give a name and a file"):
            _named([words])


@pytest.mark.parametrize(
    ("words", "more", "names", "sql"),
    [
        (["a", "b", "select 1"], {}, ["a", "b"], "select 1"),
        (["a", "b"], {"file": "q.sql"}, ["a", "b"], "select 2"),
        (["a", "b"], {"tables": True}, ["a", "b"], ""),
        ([], {"tables": True}, [], ""),
    ],
)
def test_the_query_is_the_last_word_or_in_a_file(words, more, names, sql, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("q.sql").write_text("select 2")
    file = Path(more["file"]) if "file" in more else None
    assert _asked(words, file, more.get("tables", False)) == ([Path(name) for name in names], sql)


@pytest.mark.parametrize(
    ("words", "more", "said"),
    [
        (["here"], {}, "there is no query"),
        (["a", "here"], {}, "there is no query"),
        ([], {}, "there is no query"),
        ([], {"file": "q.sql"}, "there is no query"),
        (["select 1"], {}, "there is no log"),
        (["a", "FROM", "x"], {}, "FROM is not a log"),
        (["a"], {"file": "none.sql"}, "none.sql can't be read"),
        (["a"], {"file": "bad.sql"}, "bad.sql is not text in UTF-8"),
        (["a"], {"file": "q.sql", "tables": True}, "--tables needs no query"),
        (["a", " ;\n\t"], {}, "the query is empty"),
    ],
)
def test_a_query_that_is_missing_is_said(words, more, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("here").write_text("a log")
    Path("q.sql").write_text("select 2")
    Path("bad.sql").write_bytes(b"select '\xff'")
    file = Path(more["file"]) if "file" in more else None
    with pytest.raises(McaptrackError, match=f"^{re.escape(said)}"):
        _asked(words, file, more.get("tables", False))


def test_a_file_with_the_name_of_a_keyword_is_a_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("show").write_text("a log")
    assert _asked(["show", "select 1"], None, False) == ([Path("show")], "select 1")


# Patterns, files of options, text


def test_patterns_are_replaced_by_files_in_order_without_results_of_logs_that_are_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("b.mcap", "a.mcap", "a.results.mcap", "other.results.mcap", "deep/er/c.mcap", "d[1].mcap"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(b"")

    def names(*words: str, each: bool = False) -> list[str]:
        return [path.as_posix() for path in common.expand([Path(word) for word in words], each=each)]

    assert names("*.mcap") == ["a.mcap", "b.mcap", "d[1].mcap", "other.results.mcap"]
    assert names("*.mcap", each=True) == ["a.mcap", "a.results.mcap", "b.mcap", "d[1].mcap", "other.results.mcap"]
    assert names("**/c.mcap", "b.mcap") == ["deep/er/c.mcap", "b.mcap"]
    assert names("d[1].mcap", "a.results.mcap") == ["d[1].mcap", "a.results.mcap"]
    assert names("missing.mcap") == ["missing.mcap"]


def test_one_output_takes_one_input():
    common.only_one_output([Path("a")], Path("x"))
    common.only_one_output([Path("a"), Path("b")], None)
    with pytest.raises(McaptrackError, match=r"^2 inputs can't all be written to x;"):
        common.only_one_output([Path("a"), Path("b")], Path("x"))


@pytest.mark.parametrize("more", [0, 1])
def test_a_file_of_options_has_at_most_a_mebibyte(more, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("# " + "x" * (MAX_BYTES - 2 + more))
    assert path.stat().st_size == 2**20 + more
    if more:
        with pytest.raises(McaptrackError, match=rf"has {2**20 + 1} bytes; a file of options has at most {2**20}$"):
            read_toml(path)
    else:
        assert read_toml(path).tables == {}


def test_text_is_printed_without_what_a_terminal_acts_on():
    assert printable("a\x1b[31m\n\u202eb\udc80 ä") == r"a\x1b[31m\n\u202eb\udc80 ä"
    assert printable("ä b") == "ä b"


def test_pages_are_listed_below_each_other():
    lines = call("docs").out.splitlines()
    names = [line.split()[0] for line in lines]
    assert names == ["readme", *sorted(names[1:])]
    width = max(map(len, names)) + 2
    assert all(line[width - 2 : width] == "  " and line[width] != " " for line in lines)
    listed = json.loads(call("docs", "--json").out)["pages"]
    assert [f"{page['name']:<{width}}{page['title']}" for page in listed] == lines


def test_a_page_is_drawn_on_a_terminal_and_printed_as_it_is_elsewhere(tmp_path, monkeypatch):
    screen = on_terminal(monkeypatch, 80)
    monkeypatch.setattr("sys.stdout", screen)
    with pytest.raises(SystemExit):
        GROUP.main(["docs", "sql"], prog_name="mcaptrack")
    drawn = re.sub(r"\x1b\[[0-9;]*m", "", screen.getvalue())
    assert "```" not in drawn
    assert " SQL " in drawn.splitlines()[0]
    target = tmp_path / "a.md"
    with pytest.raises(SystemExit):
        GROUP.main(["docs", "sql", "-o", os.fspath(target)], prog_name="mcaptrack")
    assert "```" in target.read_text()


# What commands give to the functions of the same names, and what they say of it


class Stop(McaptrackError):
    """Ends a command once its function was called."""


def asked_of(monkeypatch: pytest.MonkeyPatch, name: str) -> list[dict[str, Any]]:
    """The arguments of calls of a function of the library, by parameter; it ends the command."""
    calls: list[dict[str, Any]] = []
    signature = inspect.signature(getattr(mcaptrack, name))

    def called(*args: Any, **given: Any) -> None:
        calls.append(dict(signature.bind(*args, **given).arguments))
        raise Stop("stop")

    monkeypatch.setattr(mcaptrack, name, called)
    return calls


#: Options that a command treats itself or gives in another form.
OWN = {
    "json",
    "quiet",
    "verbose",
    "form",
    "csv",
    "fail_under",
    "search",
    "file",
    "rows",
    "tables",
    "study",
    "output",
}
OF_FUNCTIONS = ("demo", "drop", "evaluate", "events", "export", "ingest", "recover", "render", "report", "train")


@pytest.mark.parametrize("command", [*OF_FUNCTIONS, "tune", "view"])
def test_every_option_arrives_under_its_name(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known = inspect.signature(getattr(mcaptrack, command)).parameters
    options = options_of(command)  # made before the function is replaced: options follow from its signature
    calls = asked_of(monkeypatch, command)
    first = {"drop": ["x.mcap", "/a"], "demo": []}.get(command, ["x.mcap"])
    tried = set()
    for one in options:
        value = another(one, None)
        if one.parameter in OWN or one.parameter not in known:
            continue
        if one.kind is bool:
            value = True
        if one.kind in (int, float):
            value = one.kind(max(one.declared.least, min(one.declared.most, value)))
        if one.parameter == "gate_m" and one.kind is str:
            value = "0.25"
        if one.parameter == "similarity":
            value = "metres"
        call(command, *first, *words_for(one, value))
        got = calls.pop()[one.parameter]
        got = [str(part) for part in got] if isinstance(got, list | tuple) else got
        wanted = (
            [str(part) for part in value]
            if one.many
            else ["0.25"]
            if one.parameter == "gate_m" and one.kind is str
            else value
        )
        assert (str(got) if isinstance(got, Path) else got) == wanted, one.name
        tried.add(one.parameter)
    assert tried or command in ("recover", "drop")


@pytest.mark.parametrize(
    "command", ["detect", "track", "sample", "predict", "retrack", "run", "events", "render", "recover", "ingest"]
)
def test_several_inputs_are_not_written_to_one_output(command):
    refused = call(command, "a.mcap", "b.mcap", "-o", "x.mcap")
    assert (refused.code, refused.out) == (1, "")
    assert refused.err == (
        "mcaptrack: 2 inputs can't all be written to x.mcap; give one input, or no name for the output\n"
    )


def test_commands_that_only_read_are_known():
    assert {name for name, one in GROUP.commands.items() if one.reads} == {
        "check", "docs", "doctor", "evaluate", "info", "query", "view"
    }  # fmt: skip


class TestTune:
    SCORES = {"IDF1": 0.75, "MOTA": 0.5, "HOTA": 0.25, "IDSW": 1, "FP": 2, "FN": 3}

    def tuned(self, monkeypatch, *words: object, best: int = 3, similarity: str = "iou") -> tuple[Any, dict[str, Any]]:
        given: dict[str, Any] = {}

        def tune(inputs: Any, **more: Any) -> mcaptrack.TuneResult:
            given.update(more)
            return mcaptrack.TuneResult(
                stage=more["stage"],
                metric=more["metric"],
                similarity=similarity,
                settings={"max_age_s": 2.5},
                scores=self.SCORES,
                default_scores=self.SCORES | {"IDF1": 0.5},
                trials=7,
                best=best,
                notes=(),
                warnings=(),
            )

        monkeypatch.setattr(mcaptrack, "tune", tune)
        return call("tune", "x.mcap", *words), given

    @pytest.fixture(autouse=True)
    def folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)

    def test_settings_that_beat_the_defaults_are_written(self, monkeypatch):
        outcome, _ = self.tuned(monkeypatch)
        assert outcome.err == "mcaptrack.toml: IDF1 0.5000 with the defaults, 0.7500 now\n"
        assert Path("mcaptrack.toml").read_text() == "[track]\nmax-age-s = 2.5\n"
        outcome, _ = self.tuned(
            monkeypatch, "-o", "b.toml", "--metric", "mota", "--stage", "sample", "--similarity", "iou"
        )
        assert outcome.err == "b.toml: MOTA 0.5000 with the defaults, 0.5000 now\n"
        assert Path("b.toml").read_text() == "[sample]\nmax-age-s = 2.5\n"

    def test_the_file_stays_if_nothing_beats_the_defaults(self, monkeypatch):
        outcome, _ = self.tuned(monkeypatch, best=0)
        assert outcome.err == "nothing that was tried beats the defaults (IDF1 0.5000); mcaptrack.toml stays\n"
        assert not Path("mcaptrack.toml").exists()
        assert json.loads(self.tuned(monkeypatch, "--json", best=0)[0].out)["results"] == [
            {
                "stage": "track",
                "metric": "IDF1",
                "settings": {"max_age_s": 2.5},
                "trials": 7,
                "best": 0,
                "scores": self.SCORES,
                "default_scores": self.SCORES | {"IDF1": 0.5},
            }
        ]

    @pytest.mark.parametrize(
        ("words", "study", "tracker"),
        [
            ([], "mcaptrack.sort.trials.jsonl", "sort"),
            (["--tracker", "own:It"], "mcaptrack.own.It.trials.jsonl", "own:It"),
            (["--stage", "retrack", "-o", "to/b.toml"], "to/b.retrack.trials.jsonl", None),
            (["--study", "mine"], "mine", "sort"),
        ],
    )
    def test_trials_are_kept_beside_the_settings(self, monkeypatch, words, study, tracker):
        _, given = self.tuned(monkeypatch, *words, best=0)
        assert (given["study"], given["tracker"]) == (Path(study), tracker)

    @pytest.mark.parametrize(
        ("words", "similarity", "unused"),
        [
            ([], "iou", []),
            (["--gate-m", "1"], "iou", ["--gate-m changes nothing here: overlap is compared"]),
            (["--gate-m", "1"], "metres", []),
            (["--min-iou", "0.4"], "metres", ["--min-iou changes nothing here: distance is compared"]),
            (["--min-iou", "0.4"], "iou", []),
            (
                ["--tracker", "sort", "--stage", "sample"],
                "iou",
                ["--tracker changes nothing here: sample has no trackers"],
            ),
            (["--tracker", "sort"], "iou", []),
            (["--fps", "5"], "iou", ["--fps changes nothing here: it is about label files; logs have theirs inside"]),
            (["--truth", "t.txt", "--fps", "5"], "iou", []),
            (
                ["--truth", "t.txt", "--point", "foot"],
                "iou",
                ["--point changes nothing here: there is no ground plane"],
            ),
            (["--truth", "t.txt", "--point", "foot", "--ground-plane", "p.txt"], "iou", []),
            (
                ["--truth", "t.txt", "--camera", "c", "--topic", "/t"],
                "iou",
                [
                    f"--{name} changes nothing here: files of detections are of no camera"
                    for name in ("topic", "camera")
                ],
            ),
            (["--camera", "c"], "iou", []),
        ],
    )
    def test_options_without_an_effect_are_said(self, monkeypatch, words, similarity, unused):
        outcome, _ = self.tuned(monkeypatch, *words, best=0, similarity=similarity)
        assert [line for line in outcome.err.splitlines() if "changes nothing" in line] == [
            f"warning: {one}" for one in unused
        ]


class TestQuery:
    @pytest.fixture(autouse=True)
    def answers(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        many = pa.table({"n": pa.array(range(61), pa.int64()), "word": ["a\x1b[31m"] * 61})
        monkeypatch.setattr(mcaptrack, "query", lambda paths, sql, files: many)

    def on_screen(self, monkeypatch, *words: str) -> str:
        with redirect_stdout(on_terminal(monkeypatch, 80)) as screen, pytest.raises(SystemExit):
            GROUP.main(["query", "x.mcap", "select 1", *words], prog_name="mcaptrack")
        return re.sub(r"\x1b\[[0-9;]*m", "", screen.getvalue())

    def test_a_terminal_shows_sixty_rows_and_a_pipe_all(self, monkeypatch):
        rows = {
            words: len(self.on_screen(monkeypatch, *words).splitlines()) - 2
            for words in ((), ("--rows", "0"), ("--rows", "5"))
        }
        assert rows == {(): 60, ("--rows", "0"): 61, ("--rows", "5"): 5}
        assert self.on_screen(monkeypatch, "-o", "a.txt") == ""
        assert len(Path("a.txt").read_text().splitlines()) == 63
        outcome = call("query", "x.mcap", "select 1")
        assert (len(outcome.out.splitlines()), outcome.err) == (63, "")

    def test_a_note_is_left_out_with_quiet(self):
        words = ["query", "x.mcap", "select 1", "--rows", "2"]
        assert call(*words, "-v").err.endswith("the first 2 of 61 rows; --rows 0 shows all\n")
        assert call(*words, "-q").err == ""

    def test_control_characters_are_escapes_on_a_terminal_and_data_elsewhere(self, monkeypatch):
        assert r'0,"a\x1b[31m"' in self.on_screen(monkeypatch, "--format", "csv")
        assert '0,"a\x1b[31m"\n' in call("query", "x.mcap", "select 1", "--format", "csv").out

    def test_options_without_an_effect_are_said(self, monkeypatch):
        monkeypatch.setattr(mcaptrack, "list_tables", lambda paths, files: mcaptrack.TableList((), (), ()))
        words = ["query", "x.mcap", "select 1", "--rows", "2", "--format"]
        for form in ("csv", "json", "jsonl"):
            assert call(*words, form).err == f"warning: --rows changes nothing here: {form} has all rows\n"
        outcome = call("query", "--tables", "--rows", "2", "--format", "csv")
        assert outcome.err.splitlines() == [
            f"warning: --{name} changes nothing here: --tables lists what could be asked" for name in ("format", "rows")
        ]

    def test_an_answer_replaces_a_file_on_request_only(self):
        Path("a.json").write_text("old")
        words = ["query", "x.mcap", "select 1", "--json", "-o", "a.json"]
        assert call(*words).code == 1
        assert Path("a.json").read_text() == "old"
        assert call(*words, "--force").code == 0
        assert len(json.loads(Path("a.json").read_text())["results"]) == 61
        Path("x.mcap").write_text("")
        refused = call("query", "x.mcap", "select 1", "-o", "x.mcap", "--force")
        assert "x.mcap is both input and output; give another name with -o" in refused.err


def test_a_channel_that_results_replace_is_said_and_drawn_once():
    described = {"schema": "S", "messages": 1234, "replaced": False, "transform": None, "input": None, "plugins": None}
    described |= {"stale": False, "parameters": {"b": 1, "a": 2}, "frame": None, "rate_hz": 12.34}
    data = {
        "log": "a\x1b.mcap",
        "bytes": 12345,
        "messages": 6789,
        "start_ns": 5,
        "end_ns": 10**18 + 5,
        "results": "a.results.mcap",
        "frames": None,
        "channels": [
            described | {"topic": "/a", "replaced": True},
            described | {"topic": "/a"},
            described | {"topic": "/b"},
        ],
    }
    for verbose in (False, True):
        with redirect_stdout(io.StringIO()) as out:
            _print(data, verbose)
        more = [["│   └── a=2, b=1"], ["    └── a=2, b=1"]] if verbose else [[], []]
        assert [line.rstrip() for line in out.getvalue().splitlines()] == [
            r"a\x1b.mcap  12,345 bytes, 6,789 messages, 1000000000.000 s",
            "starts at 0.000 s",
            "with results in a.results.mcap",
            f"{'topic':<31}schema  messages  per second",
            *(f"{topic:<31}S          1,234        12.3" for topic in ("/a  (replaced by the results)", "/a", "/b")),
            "lineage",
            "├── /a",
            *more[0],
            "└── /b",
            *more[1],
        ]


@pytest.mark.parametrize(
    ("message", "wanted"),
    [
        ("give `fps=` or `ground_plane=`", "give --fps or --ground-plane"),
        ("give `fps=25` and `force=True`", "give --fps 25 and --force"),
        ("give `point='foot'`", "give --point foot"),
        ("`sidecar=False`", "--sidecar"),
        ("`fps=a b`", "`fps=a b`"),
        ("`mcaptrack.run('a b.mcap')`", "`mcaptrack run 'a b.mcap'`"),
        ("`mcaptrack.run('-a.mcap')`", "`mcaptrack run ./-a.mcap`"),
        ("`mcaptrack.run('a.mcap', force=True)`", "`mcaptrack run a.mcap --force`"),
        ("`mcaptrack.track('a.mcap', max_age_s=2.0)`", "`mcaptrack track a.mcap --max-age-s 2.0`"),
        ("`mcaptrack.list_tables('a.mcap')`", "`mcaptrack query a.mcap --tables`"),
        ("`mcaptrack.run(path)`", "`mcaptrack.run(path)`"),
        ("`mcaptrack.run(**x)`", "`mcaptrack.run(**x)`"),
        ("`code` stays", "`code` stays"),
    ],
)
def test_words_of_the_library_become_words_of_the_command_line(message, wanted):
    assert copy_context().run(lambda: (RUNNING.set(None), with_flags(message))[1]) == wanted


def test_options_are_called_as_the_running_command_calls_them():
    group = GROUP.make_context("mcaptrack", ["ingest"])
    context = GROUP.commands["ingest"].make_context("ingest", ["x.mp4"], parent=group)

    def said(message: str) -> str:
        RUNNING.set(context)
        return with_flags(message)

    for message, wanted in (
        ("`label_format=`", "--format"),
        ("`role='truth'`", "--as truth"),
        ("`sidecar=True`", "--sidecar"),
        ("`sidecar=False`", "--in-place"),
        ("`output=`", "-o"),
        ("`inputs=`", "--inputs"),
        ("`mcaptrack.run('a', events=False)`", "`mcaptrack run a --no-events`"),
        ("`mcaptrack.run('a', sidecar=False)`", "`mcaptrack run a --in-place`"),
        ("`mcaptrack.demo(seed=3)`", "`mcaptrack demo --seed 3`"),
    ):
        assert copy_context().run(said, message) == wanted


class TestNamesOfPlugins:
    STAGE = STAGES["track"]

    def names(self, *files: ConfigFile) -> list[str]:
        return _names_of_settings(self.STAGE, files, lambda: ["tracker", "min-iou"])

    def test_files_and_environment_name_them_in_order_and_once(self, monkeypatch):
        trusted = ConfigFile(Path("u"), {"track": {"tracker": "mod:A"}, "run": {"tracker": "b"}}, True)
        other = ConfigFile(Path("w"), {"track": {"tracker": "mod:C"}, "run": {"tracker": "b"}, "detect": 3}, False)
        assert self.names(trusted, other) == ["mod:A", "b"]
        monkeypatch.setenv("MCAPTRACK_TRACK_TRACKER", "own")
        monkeypatch.setenv("MCAPTRACK_RUN_TRACKER", "second")
        assert self.names(other) == ["own", "second", "b"]
        monkeypatch.setenv("MCAPTRACK_RUN_TRACKER", "sort")
        assert self.names() == ["own"]
        assert self.names(ConfigFile(Path("w"), {"track": 3, "run": {"tracker": 7}}, True)) == ["own"]

    @pytest.mark.parametrize("where", ["file", "environment"])
    @pytest.mark.parametrize(("option", "is_unknown"), [("min-iou", False), ("min_iou", False), ("own-option", True)])
    def test_an_option_that_is_none_of_theirs_loads_all_that_are_installed(
        self, monkeypatch, option, is_unknown, where
    ):
        monkeypatch.setattr("mcaptrack.cli.plugins.names", lambda kind: ("sort", "installed"))
        files = []
        if where == "file":
            files = [ConfigFile(Path("w"), {"track": {option: 1}}, False)]
        else:
            monkeypatch.setenv(f"MCAPTRACK_TRACK_{option.upper().replace('-', '_')}", "1")
        assert self.names(*files) == (["installed"] if is_unknown else [])

    def test_the_file_on_the_command_line_counts(self, tmp_path, monkeypatch):
        for name in "ab":
            (tmp_path / name).write_text(f"[track]\ntracker = '{name}'\n")
        monkeypatch.setenv("MCAPTRACK_TRACK_CONFIG", str(tmp_path / "b"))
        assert [file.path for file in _files("track", [f"--config={tmp_path / 'a'}"])] == [tmp_path / "a"]
        assert [file.path for file in _files("track", [])] == [tmp_path / "b"]


@pytest.mark.parametrize("command", [*OF_FUNCTIONS, "tune", "view", "query", "info", "check"])
def test_notes_are_printed_unless_quiet_and_details_with_verbose(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("x.mcap").write_bytes(b"")

    def called(*_: Any, **__: Any) -> None:
        logging.getLogger("mcaptrack").info("a note")
        logging.getLogger("mcaptrack").debug("a detail")
        raise Stop("stop")

    monkeypatch.setattr(mcaptrack, command, called)
    words = {"drop": ["x.mcap", "/a"], "demo": [], "query": ["x.mcap", "select 1"]}.get(command, ["x.mcap"])
    for more, notes in (([], ["a note"]), (["-q"], []), (["-v"], ["a note", "a detail"]), (["-q", "-v"], [])):
        outcome = call(command, *words, *more)
        *said, last = [line for line in outcome.err.splitlines() if not line.startswith("options: ")]
        assert (outcome.code, outcome.out, said) == (1, "", notes)
        assert last.startswith("mcaptrack: ")
        assert last.endswith("stop")


def test_results_beside_a_log_are_recovered_by_themselves(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.mcap", "a.results.mcap"):
        Path(name).write_bytes(b"no log")
    found: list[str] = []

    def process(logs: list[Any], *_: Any) -> None:
        found.extend(str(one.path) for one in logs)
        raise Stop("stop")

    monkeypatch.setattr("mcaptrack.cli.files.process", process)
    call("recover", "*.mcap")
    assert found == ["a.mcap", "a.results.mcap"]


def test_tables_of_two_logs_of_one_name_are_not_written_to_one_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("x", "y"):
        Path(name).mkdir()
        Path(name, "a.mcap").write_bytes(b"no log")
    calls = asked_of(monkeypatch, "export")
    refused = call("export", "x/a.mcap", "y/a.mcap", "-o", "tables")
    assert (refused.code, calls, refused.err.count("\n")) == (1, [], 1)


LINE = "people walk on one line"


@pytest.mark.parametrize(
    ("found", "is_unchanged", "words"),
    [
        (("", 0.0, 0, None, None, None, None, "too few pairs", "", 0.0), False, "as it was: too few pairs"),
        (
            ("", 0.0, 1200, 0.1, 0.3, None, None, "it agrees with the others", "", -0.5),
            False,
            "as it was: it agrees with the others; feet are 0.10 m (90 %: 0.30 m) from those of the others (1,200 "
            "compared); its times are 0.50 s early",
        ),
        (
            ("rigid", 2.5, 90, 1.0, 2.0, 0.1, 0.2, "", LINE, 0.25),
            False,
            "corrected by a shift and a rotation, which moves feet by 2.50 m: they are 0.10 m (90 %: 0.20 m) from those of "
            f"the others, and were 1.00 m (90 %: 2.00 m) (90 compared); {LINE}; its times are 0.25 s late",
        ),
        (
            ("full", 2.5, 90, None, 2.0, 0.1, None, "", "", 0.0),
            True,
            "corrected already by a homography, which moves feet by 2.50 m: they are - from those of the others, and were - "
            "(90 compared)",
        ),
    ],
    ids=["too few", "agrees", "corrected", "corrected before"],
)
def test_the_line_of_a_camera_says_what_was_found_about_it(found, is_unchanged, words):
    assert _words(mcaptrack.CameraCorrection(*found, homography=None), is_unchanged) == words
