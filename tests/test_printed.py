"""Text and JSON of commands have the same numbers, and -o writes what would be printed."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mcaptrack import log
from tests.commands import GROUP, call, done
from tests.logs import SOME, write_stock

#: Commands with --output for what they print, and arguments for each.
PRINTING = {
    "check": [],
    "evaluate": [],
    "info": [],
    "query": ["select topic, count(*) from tracks group by all order by all"],
}


def data(*words: object) -> list[dict[str, Any]]:
    """Run a command that has to succeed, and return its results."""
    return json.loads(done(*words, "--json").out)["results"]


def tables(text: str) -> list[tuple[list[str], list[list[str]]]]:
    """Parse the tables in a text: head and rows of each as lists of cells; an empty line is a row without cells."""
    found = []
    for part in re.split(r"\n\n(?=\S+(?: \S+)*  +\S)", text.rstrip("\n")):
        head, *rows = ([cell for cell in re.split(r"  +", line.strip()) if cell] for line in part.split("\n"))
        found.append((head, rows))
    return found


@pytest.fixture(scope="module")
def twice(finished, tmp_path_factory) -> tuple[Path, Path]:
    """A log with all channels, and a copy without some, in which detections are newer than tracks."""
    less = tmp_path_factory.mktemp("twice") / "less.mcap"
    done("drop", finished, "/camera/retracks/predictions", "-o", less, "-q")
    done("detect", less, "--threshold", "30", "-q")
    return finished, less


@pytest.fixture(scope="module", params=[1, 2], ids=["one log", "two logs"])
def scored(request, twice) -> tuple[list[str], list[dict[str, Any]], str, str]:
    logs = [*twice][: request.param]
    first = ["sequence"] if request.param == 2 else []
    return first, data("evaluate", *logs), done("evaluate", *logs).out, done("evaluate", *logs, "--csv").out


class TestEvaluate:
    HEAD = ["tracks", "by", "MOTA", "IDF1", "HOTA", "IDSW", "FP", "FN", "Frag"]
    FORECASTS = {
        "ADE m": "ADE_m",
        "FDE m": "FDE_m",
        "ADE m²": "ADE_squared_m2",
        "recall": "recall",
        "false": "false_forecasts_per_frame",
        "drift m": "consistency_m",
        "NLL": "NLL",
        "in 50 %": "coverage_50",
        "in 90 %": "coverage_90",
        "in 95 %": "coverage_95",
    }

    def test_the_table_groups_scores_by_similarity_and_gate(self, scored):
        first, results, text, _ = scored
        (head, rows), *_ = tables(text)
        assert head == [*first, *self.HEAD]
        wanted: list[list[str]] = []
        before = None
        for one in sorted(
            results, key=lambda r: (r["sequence"] == "COMBINED", r["sequence"], r["similarity"], r["gate"])
        ):
            by = f"IoU {one['gate']:g}" if one["similarity"] == "iou" else f"{one['gate']:g} m"
            values = [one[name] for name in self.HEAD[2:]]
            numbers = [f"{100 * value:.1f}" if isinstance(value, float) else str(value) for value in values]
            if before not in (None, (one["sequence"], by)):
                wanted.append([])
            before = one["sequence"], by
            wanted.append([*([one["sequence"]] if first else []), one["tracks"], by, *numbers])
        assert rows == wanted
        assert len({row[0] for row in wanted if row}) > 1

    def test_predictions_have_a_table_with_a_row_for_each_channel(self, scored):
        first, results, text, _ = scored
        _, (head, rows), *_ = tables(text)
        assert head == [*first, "forecasts of", *self.FORECASTS]
        made: dict[tuple[str, ...], dict[str, Any]] = {}
        for one in results:
            if "displacement" in one:
                key = (one["sequence"], one["tracks"]) if first else (one["tracks"],)
                made.setdefault(key, one["displacement"])
        assert rows == [
            [*key, *("-" if found[name] is None else f"{found[name]:.3f}" for name in self.FORECASTS.values())]
            for key, found in made.items()
        ]
        assert rows

    def test_numbers_are_aligned_right(self, scored):
        _, _, text, _ = scored
        for part in re.split(r"\n\n(?=\S+(?: \S+)*  +\S)", text.rstrip("\n")):
            lines = [line.rstrip() for line in part.split("\n") if line.strip()]
            assert len({len(line) for line in lines}) == 1

    def test_csv_has_the_values_of_the_json(self, scored):
        _, results, _, text = scored
        rows = list(csv.DictReader(io.StringIO(text)))
        plain = [{key: value for key, value in one.items() if key != "displacement"} for one in results]
        assert rows == [{key: "" if value is None else str(value) for key, value in one.items()} for one in plain]

    def test_a_score_at_the_limit_passes(self, finished):
        asked = ["evaluate", finished, "--similarity", "iou", "--topic", "/camera/tracks"]
        (one,) = data(*asked)
        assert 0.05 < one["MOTA"] < 1
        assert call(*asked, "--fail-under", f"mota={one['MOTA']!r}").code == 0
        missed = call(*asked, "--fail-under", f"MOTA={one['MOTA'] + 1e-4!r}", "--fail-under", "idf1=0")
        assert missed.code == 4
        assert missed.err.splitlines() == [
            f"walk /camera/tracks iou 0.5: MOTA {one['MOTA']:.4f} is under {one['MOTA'] + 1e-4:g}"
        ]

    def test_the_limit_is_for_several_logs_together(self, twice):
        asked = ["evaluate", *twice, "--similarity", "metres", "--gate-m", "1"]
        missed = call(*asked, "--fail-under", "idf1=1.5")
        together = [one for one in data(*asked) if one["sequence"] == "COMBINED"]
        assert [line.partition(":")[0] for line in missed.err.splitlines()[-len(together) :]] == [
            f"COMBINED {one['tracks']} metres 1" for one in together
        ]
        assert sum(" is under " in line for line in missed.err.splitlines()) == len(together)


class TestInfo:
    def test_every_channel_has_a_line_with_its_schema_and_messages(self, twice):
        for path in twice:
            (one,) = data("info", path)
            first, begin, head, *rest = done("info", path).out.splitlines()
            seconds = (one["end_ns"] - one["start_ns"]) / 1e9
            assert first == f"{path}  {one['bytes']:,} bytes, {one['messages']:,} messages, {seconds:.3f} s"
            assert begin == f"starts at {one['start_ns'] / 1e9:.3f} s"
            assert head.split() == ["topic", "schema", "messages", "per", "second"]
            channels = [[c["topic"], c["schema"], f"{c['messages']:,}"] for c in one["channels"]]
            for row, channel in zip(channels, one["channels"], strict=True):
                row.extend([] if channel["rate_hz"] is None else [f"{channel['rate_hz']:.1f}"])
            assert [line.split() for line in rest[: len(channels)]] == channels
            assert rest[len(channels)] == "lineage"
            assert len({len(line) for line in [head, *rest[: len(channels)]]}) == 1  # numbers end below each other

    def test_info_agrees_with_the_log(self, twice):
        for path in twice:
            (one,) = data("info", path)
            with log.read(path) as opened:
                assert (one["log"], one["bytes"]) == (str(path), path.stat().st_size)
                assert (one["start_ns"], one["end_ns"]) == (opened.start_ns, opened.end_ns)
                found = {c["topic"]: (c["id"], c["schema"], c["encoding"], c["messages"]) for c in one["channels"]}
                assert found == {
                    topic: (c.id, c.schema_name, c.message_encoding, c.messages) for topic, c in opened.channels.items()
                }
                assert [c["topic"] for c in one["channels"]] == sorted(opened.channels)
            assert one["messages"] == sum(c["messages"] for c in one["channels"])
            assert {c["part"] for c in one["channels"]} == {"log"}
            assert not any(c["replaced"] for c in one["channels"])
            recorded = [c for c in one["channels"] if c["transform"] is None]
            assert all(c["input"] is c["version"] is c["parameters"] is c["references"] is None for c in recorded)

    def test_each_channel_is_once_in_the_tree_below_its_input(self, twice):
        for path in twice:
            (one,) = data("info", path)
            channels = {c["topic"]: c for c in one["channels"]}
            lines = done("info", path, "-v").out.partition("\nlineage\n")[2].splitlines()
            above: list[str] = []
            seen = []
            for line in lines:
                depth, words = len(re.match(r"[│├└─ ]*", line)[0]) // 4, re.sub(r"^[│├└─ ]+", "", line)
                if not words.startswith("/"):  # what -v adds: the parameters of the channel above
                    made = channels[above[depth - 2]]["parameters"]
                    assert words == ", ".join(f"{key}={value}" for key, value in sorted(made.items()))
                    continue
                topic, *rest = words.split("  ")
                del above[depth - 1 :]
                source = channels[topic]["input"]
                assert (above[-1] if above else None) == (source if source in channels else None)
                above.append(topic)
                wanted = [channels[topic]["transform"]] if channels[topic]["transform"] else []
                assert rest == wanted + (["out of date"] if channels[topic]["stale"] else [])
                seen.append(topic)
            assert sorted(seen) == sorted(topic for topic, c in channels.items() if c["transform"] != "view")
            assert any(channels[topic]["stale"] for topic in seen) == (path == twice[1])

    def test_parameters_are_shown_with_verbose_only(self, finished):
        brief, full = (done("info", finished, *more).out.splitlines() for more in ([], ["-v"]))
        assert [line for line in full if "=" not in line] == brief
        assert len(full) > len(brief)


class TestChecked:
    @pytest.fixture
    def bad(self, finished, tmp_path) -> Path:
        """A log with a byte changed in the middle and its end cut off."""
        raw = bytearray(finished.read_bytes())
        raw[len(raw) // 3] ^= 1
        path = tmp_path / "bad.mcap"
        path.write_bytes(raw[: len(raw) * 5 // 6])
        return path

    @pytest.fixture
    def odd(self, tmp_path) -> Path:
        """A log without chunks, with a byte changed in its summary."""
        path = tmp_path / "odd.mcap"
        write_stock(path, SOME, use_chunking=False)
        raw = bytearray(path.read_bytes())
        raw[-60] ^= 1
        path.write_bytes(raw)
        return path

    def test_findings_are_listed_in_a_table(self, finished, bad, odd):
        for logs in ([finished, bad], [bad, odd, finished]):
            outcome = call("check", *logs)
            results = json.loads(call("check", *logs, "--json").out)["results"]
            assert outcome.code == 1
            assert [one["log"] for one in results] == [str(path) for path in logs]
            lines = [line.split() for line in outcome.out.splitlines()]
            for one in results:
                verdict = "sound" if one["sound"] else "damaged"
                words = f"{one['log']}: {verdict}; {one['messages']} messages in {one['chunks']} chunks"
                assert lines.pop(0) == words.split()
                if one["findings"]:
                    assert lines.pop(0) == ["byte", "times", "kind"]
                for f in one["findings"]:
                    cells = f"{f['level']} {f['byte']} {f['times']} {f['kind']} {f['words']}"
                    assert lines.pop(0) == cells.split()
            assert not lines
        assert {f["level"] for one in results for f in one["findings"]} == {"error", "warning"}

    def test_quiet_prints_errors_only(self, finished, odd):
        assert done("check", finished, "-q").out == ""
        (one,) = json.loads(call("check", odd, "--json").out)["results"]
        lines = call("check", odd, "-q").out.splitlines()
        errors = [f for f in one["findings"] if f["level"] == "error"]
        assert len(lines) == 1 + len(errors) < 1 + len(one["findings"])

    def test_text_and_json_agree_on_what_was_saved_and_lost(self, bad, tmp_path):
        outcome = call("recover", bad, "-o", tmp_path / "b.mcap")
        (one,) = json.loads(call("recover", bad, "-o", tmp_path / "c.mcap", "--json", "-q").out)["results"]
        assert outcome.code == 3
        assert one["lost"]
        assert (one["log"], one["output"]) == (str(bad), str(tmp_path / "c.mcap"))
        assert outcome.err.splitlines() == [
            f"{tmp_path / 'b.mcap'}: {one['messages']} messages in {one['chunks']} chunks are saved",
            *(f"lost: {words}" for words in one["lost"]),
        ]
        with log.read(tmp_path / "c.mcap") as opened:
            assert sum(channel.messages for channel in opened.channels.values()) == one["messages"] > 0

    def test_the_first_twenty_losses_are_printed(self, finished, tmp_path, monkeypatch):
        from mcaptrack.log import recover as real

        lost = [f"thing {number}" for number in range(22)]
        monkeypatch.setattr(log, "recover", lambda *args: replace(real(*args), lost=lost[:count]))
        for count, more, said in ((20, [], 20), (22, [], 20), (22, ["-v"], 22)):
            lines = call("recover", finished, "-o", tmp_path / "a.mcap", "--force", *more).err.splitlines()
            lines = [line for line in lines if line.startswith("lost: ")]
            wanted = [f"lost: thing {number}" for number in range(said)]
            assert lines == wanted + (["lost: 2 more; -v shows them"] if said < count else [])

    def test_drop_counts_messages_and_bytes(self, finished, tmp_path):
        with log.read(finished) as opened:
            gone = {t: c.messages for t, c in opened.channels.items() if t.startswith("/camera/retracks/online")}
        target = tmp_path / "b.mcap"
        outcome = done("drop", finished, "/camera/retracks/online*", "-o", target)
        before, after = finished.stat().st_size, target.stat().st_size
        assert outcome.err.splitlines()[-1] == (
            f"{target}: {', '.join(sorted(gone))} with {sum(gone.values())} messages left out; {before} bytes became {after}"
        )
        assert call("drop", finished, "/camera/truth", "-o", target).code == 1
        (one,) = data("drop", finished, "/camera/retracks/online*", "-o", target, "--force")
        assert one == {"log": str(target), "dropped": sorted(gone), "messages": sum(gone.values()), "bytes": after}


class TestRun:
    def test_a_stage_prints_a_line_for_each_channel(self, fresh):
        copy = fresh.with_name("copy.mcap")
        shutil.copyfile(fresh, copy)
        (one,) = data("track", fresh, "-q")
        lines = done("track", copy).err.splitlines()
        stated = {line.split()[0]: " ".join(line.split()[1:]) for line in lines if line.startswith("  ")}
        for topic, rows in one["rows"].items():
            tracks = f"{one['tracks'][topic]:,} tracks, " if topic in one["tracks"] else ""
            assert stated.pop(topic) == f"{tracks}{rows:,} rows in {one['frames'][topic]:,} frames"
        stated.pop("time", None)  # of a slow machine
        assert list(stated) == ["next"]
        assert one["tracks"].keys() == {"/camera/tracks"}
        with log.read(fresh) as opened:
            from mcaptrack.schema import TRACKS

            made = opened.rows("/camera/tracks", TRACKS).rows
        assert (one["rows"]["/camera/tracks"], one["tracks"]["/camera/tracks"]) == (
            len(made),
            len(set(made["track_id"])),
        )
        assert (one["log"], one["written_to"]) == (str(fresh), str(fresh))
        assert len({line.index(line.split()[1]) for line in lines if line.startswith("  ")}) == 1

    def test_the_summary_of_a_run_agrees_with_the_log(self, finished, tmp_path):
        path = tmp_path / "walk.mcap"
        shutil.copyfile(finished, path)
        (one,) = data("run", path, "-q")
        found, lines = one["summary"], done("run", path).err.splitlines()
        stated = {line.split("  ")[1].strip(): re.split(r"  +", line.strip())[1] for line in lines if line[:2] == "  "}
        assert stated["boxes"] == f"{found['boxes']:,} in {found['pictures']:,} pictures"
        assert stated["tracks"] == f"{found['tracks']:,}"
        assert stated["forecasts"].startswith(f"{found['forecasts']:,}, {found['horizon_s']:g} s ahead")
        assert (one["stages"], one["written_to"]) == ([], None)
        assert f"{path}: nothing to do, everything is up to date" in lines
        (score,) = data("evaluate", path, "--similarity", "iou", "--topic", "/camera/tracks")
        del score
        for key, value in found["repair"].items():
            assert re.search(rf"(?<![\d,]){value:,}(?![\d,])", stated["re-tracked"]), key

    def test_events_are_counted_by_kind(self, finished, tmp_path):
        path = tmp_path / "walk.mcap"
        shutil.copyfile(finished, path)
        outcome = done("events", path)
        (one,) = data("events", path)
        assert one["events"]
        for topic, kinds in one["events"].items():
            words = ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count) or "nothing happened"
            assert f"{topic}: {words}" in outcome.err.splitlines()

    def test_tables_are_named_with_their_rows(self, finished, tmp_path):
        outcome = done("export", finished, "-o", tmp_path / "t", "-v")
        (one,) = data("export", finished, "-o", tmp_path / "u", "-q")
        folder = tmp_path / "t"
        assert f"{folder}: " + ", ".join(f"{name} {rows}" for name, rows in one["rows"].items()) in outcome.err
        assert f"{folder}: written {', '.join(one['written'])}" in outcome.err
        assert sorted(path.name for path in folder.iterdir()) == sorted(one["written"])
        again = done("export", finished, "-o", folder, "-v")
        assert f"{folder}: written nothing, all tables are up to date" in again.err
        (one,) = data("export", finished, "-o", folder)
        assert (one["written"], one["log"], one["folder"]) == ([], str(finished), str(folder))


def test_tune_prints_scores_and_settings(finished, tmp_path):
    words = [
        "tune",
        finished,
        "--trials",
        "6",
        "--search",
        "min-iou=0.2:0.9",
        "--search",
        "max-age-s=0:2",
        "--seed",
        "3",
    ]
    (one,) = data(*words, "-o", tmp_path / "a.toml")
    outcome = done(*words, "-o", tmp_path / "b.toml")
    (head, rows), settings = tables(outcome.out)[0], outcome.out.rpartition("\n\n")[2].splitlines()
    assert head == ["IDF1", "MOTA", "HOTA", "IDSW", "FP", "FN"]
    for row, scores in zip(rows, (one["default_scores"], one["scores"]), strict=False):
        values = [scores[name] for name in head]
        assert row[1:] == [f"{100 * v:.1f}" if isinstance(v, float) else str(v) for v in values]
    assert [row[0] for row in rows[:2]] == ["defaults", "best"]
    assert settings == [f"{name.replace('_', '-')} = {value}" for name, value in one["settings"].items()]
    (score,) = data("evaluate", finished, "--similarity", "iou", "--topic", "/camera/tracks")
    assert {name: one["default_scores"][name] for name in head} == {name: pytest.approx(score[name]) for name in head}
    assert (one["stage"], one["trials"]) == ("track", 6)


@pytest.mark.parametrize("command", sorted(PRINTING))
def test_output_writes_what_would_be_printed(command, finished, tmp_path):
    for more in ([], ["--json"]):
        words = [command, finished, *PRINTING[command], *more]
        printed = done(*words)
        target = tmp_path / f"out{len(more)}.txt"
        outcome = done(*words, "-o", target)
        assert outcome.out == ""
        assert target.read_text() == printed.out != ""
        before = target.read_bytes()
        refused = call(*words, "-o", target)
        assert (refused.code, refused.out, refused.err.count("\n")) == (1, "", 1)
        target.write_text("old")
        done(*words, "-o", target, "--force")
        assert target.read_bytes() == before


@pytest.mark.parametrize("command", sorted(GROUP.commands))
def test_switches_are_off_by_default(command):
    flags = {p.name: p.default for p in GROUP.commands[command].params if p.param_type_name == "option" and p.is_flag}
    off = {"force", "json", "quiet", "verbose", "csv", "gif", "tables", "blobs", "in_place", "open_"} & flags.keys()
    assert {name: flags[name] for name in off} == dict.fromkeys(off, False) | (
        {"tables": True} if command == "run" else {}
    )


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("0", 0),
        ("1777636800", 1_777_636_800 * 10**9),
        ("1777636800.25", 1_777_636_800_250_000_000),
        ("1777636800123456789/1000000000", 1_777_636_800_123_456_789),
        ("2026-05-01T12:00:00Z", 1_777_636_800 * 10**9),
        ("2026-05-01T12:00:00", 1_777_636_800 * 10**9),
        ("2026-05-01T14:30:00+02:30", 1_777_636_800 * 10**9),
        ("2026-05-01T12:00:01.000003Z", 1_777_636_801_000_003_000),
        ("9223372035", 9_223_372_035 * 10**9),
        ("9223372037", None),
        ("-1", None),
        ("1969-12-31T23:59:59Z", None),
        ("2300-01-01T00:00:00Z", None),
        ("noon", None),
    ],
)
def test_start_time_sets_the_first_timestamp(text, wanted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.txt").write_text("1,1,1,1,2,2\n3,1,1,1,2,2\n")
    outcome = call("ingest", "clip.txt", "--fps", "10", f"--start-time={text}")
    assert outcome.code == (wanted is None)
    if wanted is None:
        assert outcome.err.count("\n") == 1
        assert "--start-time" in outcome.err
        assert text in outcome.err
    else:
        (one,) = data("info", "clip.mcap")
        assert (one["start_ns"], one["end_ns"]) == (wanted, wanted + 200_000_000)


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        return True


def test_progress_is_shown_on_a_terminal_only(monkeypatch):
    from mcaptrack.cli.common import Talk

    now = iter(0.06 * n for n in range(1000))
    monkeypatch.setattr("mcaptrack.cli.common.monotonic", lambda: next(now))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    shown = {}
    for name, kind, quiet in (("terminal", Terminal, False), ("pipe", io.StringIO, False), ("quiet", Terminal, True)):
        with monkeypatch.context() as patch, Talk(quiet).open() as talk:
            patch.setattr("sys.stderr", kind())
            for done_ in range(11):
                talk.progress("detect", done_, 10)
            talk.progress("track", 3, 7)
            talk.progress("track", 7, 7)
            talk.say("a line")
            talk.progress("sample", 2, 2)
            talk._stop()
            shown[name] = sys.stderr.getvalue()
    assert (shown["pipe"], shown["quiet"]) == ("a line\n", "")
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown["terminal"])
    before, after = text.split("a line\n")
    assert "detect" in before
    assert "10/10" in before
    assert " 7/7 " in before
    assert "sample" not in before
    assert "2/2" in after
    assert "detect" not in after  # what was said before a line is over
