"""Parameters of stages arrive in what they make.

The tests follow from what the code declares, so that an option that is added is tested, too.
"""

from __future__ import annotations

import inspect
import io
import json
import logging
import shutil
import sys
from contextvars import copy_context
from dataclasses import dataclass, fields
from datetime import date
from pathlib import Path
from typing import Any, Literal, get_type_hints

import pytest

import mcaptrack
from mcaptrack.api.declared import Option
from mcaptrack.cli import common, text
from mcaptrack.cli.many import ManyOptions
from mcaptrack.cli.settings import Setting
from mcaptrack.cli.text import RUNNING, with_flags
from mcaptrack.errors import McaptrackError
from mcaptrack.predictors import NAMES
from mcaptrack.transforms import PROFILES, TRACKERS, TRANSFORMS
from mcaptrack.transforms import STAGES as STAGES_OF_LOGS
from mcaptrack.transforms.protocol import bare_type, choices
from tests.commands import GROUP, Terminal, call, done, toml_value
from tests.extension_cases import of_extensions
from tests.logs import provenance_of
from tests.tiers import one_in


@pytest.fixture
def folder(template, tmp_path, monkeypatch) -> Path:
    shutil.copy(template, tmp_path / "a.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@dataclass(frozen=True)
class Stage:
    """The command of a stage with one of its transforms, which the options ``chosen`` select."""

    command: str
    transform: Any
    target: str
    chosen: tuple[tuple[str, str], ...] = ()

    def parameters(self) -> dict[str, Any]:
        options = [field.name for field in fields(self.transform) if not field.metadata.get("context")]
        return {name: getattr(self.transform, name) for name in options}

    def others(self) -> dict[str, Any]:
        hints = get_type_hints(type(self.transform))
        out = {}
        for field in fields(self.transform):
            if field.name in (default := self.parameters()):
                out[field.name] = _other(default[field.name], bare_type(hints[field.name]), field.metadata)
        return out

    def made(self, path: Path) -> dict[str, Any]:
        said = provenance_of(path, self.target).parameters
        return {name: value for name, value in said.items() if name in self.parameters()}


def _other(default: Any, kind: Any, declared: Any) -> Any:
    """Return an allowed value of a parameter that differs from its default."""
    if kind is bool:
        return not default
    if names := choices(kind):
        return next(name for name in names if name != default)
    if kind is str:
        if "NAME=SPEED" in declared["help"]:
            return "car=40"
        return next(name for name in NAMES if name != default)
    least, most = declared["least"], declared["most"]
    near = [default + 1, default / 2, default - 1] if default else [1, least, most]
    return next(kind(value) for value in near if least <= value <= most and kind(value) != default)


STAGES = [
    Stage("detect", TRANSFORMS["detect"](), "/camera/detections"),
    Stage("motion", TRANSFORMS["motion"](), "/camera/motion"),
    *(Stage("track", kind(), "/camera/tracks", (("tracker", name),)) for name, kind in TRACKERS.items()),
    Stage("sample", TRANSFORMS["sample"](), "/camera/samples"),
    Stage("predict", TRANSFORMS["predict"](), "/camera/predictions"),
    *(Stage("retrack", made, "/camera/retracks", (("profile", name),)) for name, made in PROFILES.items()),
]


def as_settings(values: dict[str, Any], transform: Any) -> dict[str, Any]:
    """Parameters as settings: those without an option of their own are texts of ``set``."""
    flagless = {field.name for field in fields(transform) if not field.metadata.get("flag", True)}
    texts = [f"{name}={str(value).lower()}" for name, value in values.items() if name in flagless]
    return {name: value for name, value in values.items() if name not in flagless} | ({"set": texts} if texts else {})


def flags(values: dict[str, Any]) -> list[str]:
    out = []
    for name, value in values.items():
        if name == "set":
            out += [word for text in value for word in ("--set", text)]
            continue
        flag = name.replace("_", "-")
        out += [f"--{flag}" if value else f"--no-{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    return out


def toml(command: str, values: dict[str, Any]) -> str:
    lines = [f"{name.replace('_', '-')} = {toml_value(value)}" for name, value in values.items()]
    return "\n".join([f"[{command}]", *lines]) + "\n"


def named(stage: Stage) -> str:
    return "-".join([stage.command, *dict(stage.chosen).values()])


@pytest.mark.parametrize("stage", STAGES, ids=named)
def test_every_parameter_of_a_stage_arrives_in_the_provenance(stage, folder):
    """From the command line: tests/test_settings.py has it that a value is the same wherever it comes from."""
    values = flags(as_settings(stage.others(), stage.transform))
    done(stage.command, "a.mcap", "-o", "b.mcap", *flags(dict(stage.chosen)), *values)
    assert stage.made(folder / "b.mcap") == stage.others()
    assert len(stage.others()) == len(stage.parameters())


# Motion is made by run only where it is needed.
@pytest.mark.parametrize("stage", one_in(4, [stage for stage in STAGES if stage.command != "motion"]), ids=named)
def test_parameters_reach_the_stages_that_run_makes(stage, folder):
    """``run --force`` applies them where the channel exists; without it a warning says that they are not applied."""
    values = as_settings(stage.others(), stage.transform) | dict(stage.chosen)
    Path("mcaptrack.toml").write_text(toml(stage.command, values))
    before = (folder / "a.mcap").read_bytes()
    left = json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)
    assert (folder / "a.mcap").read_bytes() == before
    assert [(one["code"], stage.target in one["message"]) for one in left["warnings"]] == [("other-settings", True)]
    again = json.loads(done("run", "a.mcap", "--no-tables", "--force", "--json").out)
    made = [one for one in again["results"][0]["stages"] if one != "motion"]
    assert made == ["detect", "track", "sample", "predict", "retrack", "events", "views"]
    assert stage.made(folder / "a.mcap") == stage.others()
    after = json.loads(done("run", "a.mcap", "--no-tables", "--json").out)["warnings"]
    assert "other-settings" not in [one["code"] for one in after]


def test_a_parameter_has_an_option_in_all_transforms_of_a_stage_or_in_none():
    for command in STAGES_OF_LOGS.values():
        has_flag: dict[str, set[bool]] = {}
        for kind in command.built_in().values():
            for field in fields(kind):
                has_flag.setdefault(field.name, set()).add(field.metadata.get("flag", True))
        assert {name for name, values in has_flag.items() if len(values) > 1} == set()


# Values of options at the ends of what is accepted, what commands give to functions, and what terminals get


@pytest.fixture
def terminal(monkeypatch) -> Terminal:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    return Terminal()


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("x.mcap").write_bytes(b"no log")
    return tmp_path


class Stop(McaptrackError):
    """Ends a command once its function was called."""


@pytest.fixture
def asked(monkeypatch):
    """Runs a command; the arguments that its function in the library gets, by parameter."""

    def run(command: str, *words: object) -> dict[str, Any]:
        signature, calls = inspect.signature(getattr(mcaptrack, command)), []

        def called(*args: Any, **given: Any) -> None:
            calls.append(dict(signature.bind(*args, **given).arguments))
            raise Stop("stop")

        with monkeypatch.context() as patch:
            patch.setattr(mcaptrack, command, called)
            call(command, *words)
        return calls[0] if calls else {}

    return run


# Values


def setting(kind: Any, many: bool = False, **declared: Any) -> Setting:
    return Setting("track", "some-option", "some_option", kind, many, Option(**declared))


VALUES = [
    *((int, value, value) for value in (3, 2**63 - 1, 1 - 2**63)),
    *((int, value, None) for value in (2**63, -(2**64), 3.0, True, "1")),
    *((float, value, value) for value in (3, 0.5)),
    *((float, value, None) for value in (2**63, False, "1", date(1979, 5, 27))),
    *((str, value, wanted) for value, wanted in ((25, "25"), (2.5, "2.5"), ("", ""), (True, None), ([["a"]], None))),
    *((bool, False, False), (bool, 1, None), (bool, "no", None)),
    *((Path, "a", "a"), (Path, 1, None), (Path, {"a": 1}, None), (Literal["a"], 1, None)),
]


def test_a_value_of_a_file_is_of_the_type_of_its_option():
    for kind, value, wanted in VALUES:
        if wanted is None:
            for option, given in ((setting(kind), value), (setting(kind, many=True), [wanted, value])):
                with pytest.raises(ValueError, match=r"^(needs|is too large)"):
                    option.from_toml(given)
            continue
        made = setting(kind).from_toml(value)
        assert (made, type(made)) == (wanted, type(wanted))
        assert setting(kind, many=True).from_toml(value) == [wanted]
        assert setting(kind, many=True).from_toml([value, value]) == [wanted, wanted]


def test_values_of_the_environment_are_words_as_in_a_shell():
    for words, wanted in (([" TRUE ", "1", "yes", "on"], True), (["0", "False", "no", "off\n"], False)):
        assert [setting(bool).from_text(word) for word in words] == [wanted] * 4
    for word in ("2", "y", "truefalse"):
        with pytest.raises(ValueError, match=r"^needs true or false, not "):
            setting(bool).from_text(word)
    assert setting(str, many=True).from_text("a 'b c' d") == ["a", "b c", "d"]
    assert setting(str).from_text(" a b ") == " a b "


def test_a_file_beside_the_data_may_tune_by_the_whole_value():
    for tuning, several, value, may in (
        *((True, False, "any", True), (False, False, 1, False), ("a+", False, "aa", True), ("a+", False, "aab", False)),
        *(("a+", True, ["a", "aa"], True), ("a+", True, ["a", "b"], False), ("a+", True, [], True)),
    ):
        assert setting(str, several, tuning=tuning).may_tune(value) is may


@pytest.mark.parametrize("several", [False, True])
def test_a_number_at_an_end_of_the_range_is_in_it(several):
    option = setting(float, several, least=1, most=2)
    for value in (1, 2, None):
        option.check([1, value] if several and value else value, "")
    for value in (0.999, 2.001, float("nan")):
        for where, said in (("", "--some-option"), ("a.toml: [track] some_option", "a.toml: [track] some_option")):
            with pytest.raises(McaptrackError) as error:
                option.check([1, value] if several else value, where)
            assert str(error.value) == f"{said} has to be from 1 to 2, not {value}"


START_S = 1_777_636_800
STARTS = {
    "0": 0,
    "1777636800": START_S * 10**9,
    "1777636800.25": START_S * 10**9 + 250_000_000,
    "1777636800123456789/1000000000": START_S * 10**9 + 123_456_789,
    "2026-05-01T12:00:00Z": START_S * 10**9,
    "2026-05-01T12:00:00": START_S * 10**9,
    "2026-05-01T14:30:00+02:30": START_S * 10**9,
    "2026-05-01T12:00:01.000003Z": START_S * 10**9 + 1_000_003_000,
    "9223372035": 9_223_372_035 * 10**9,
} | dict.fromkeys(("9223372037", "-1", "1969-12-31T23:59:59Z", "2300-01-01T00:00:00Z", "noon"))


def test_start_time_sets_the_first_timestamp(elsewhere):
    Path("clip.txt").write_text("1,1,1,1,2,2\n3,1,1,1,2,2\n")
    for said, wanted in STARTS.items():
        outcome = call("ingest", "clip.txt", "--fps", "10", "--force", f"--start-time={said}")
        if wanted is None:
            assert (outcome.code, outcome.err.count("\n")) == (1, 1)
            assert "--start-time" in outcome.err
            assert said in outcome.err
        else:
            (one,) = json.loads(done("info", "clip.mcap", "--json").out)["results"]
            assert (one["start_ns"], one["end_ns"]) == (wanted, wanted + 200_000_000)


def test_texts_of_options_are_numbers_and_names_for_the_library(elsewhere, asked):
    """What is none of these is in tests/printed.txt."""
    for said, gates in (("0.5,1,2", (0.5, 1.0, 2.0)), (" 1 ", (1.0,)), ("0.001", (0.001,))):
        assert asked("evaluate", "x.mcap", "--gate-m", said)["gate_m"] == gates
    for said, seconds in (("90s", 90), ("90", 90), (" 1.5M ", 90), ("2h", 7200), ("10 m", 600), (None, None)):
        assert ManyOptions(timeout=said).for_fleet()["timeout_s"] == seconds
    for words, values in of_extensions("GIVEN").items():
        assert asked(*words).items() >= values.items(), words


def test_options_that_concern_a_single_log_make_it_one_of_many(monkeypatch):
    for name, value in {"ledger": Path("a"), "timeout": "1h"}.items():
        assert ManyOptions(**{name: value}).concern_one
    assert not ManyOptions(jobs=3).concern_one
    assert ManyOptions().for_fleet()["memory_limit"] is None
    monkeypatch.setenv("MCAPTRACK_MAX_WORKER_MB", "300")
    assert ManyOptions().for_fleet()["memory_limit"] == 300_000_000
    monkeypatch.setenv("MCAPTRACK_SCHEDULER", "tcp://a:1")
    assert ManyOptions(jobs=3).concern_one
    assert ManyOptions().for_fleet()["scheduler"] == "tcp://a:1"


# What commands give to the functions of the same names


FIRST = {"drop": ["x.mcap", "/a"], "demo": []} | {
    name: ["x.mcap", *words] for name, words in of_extensions("NEEDS").items()
}


@pytest.mark.parametrize("twice", [["-o", "a.html", "-ob.html"], ["--output=a.html", "-o", "b.html"]])
def test_an_option_of_one_value_is_not_given_two(elsewhere, twice):
    outcome = call("evaluate", "x.mcap", *twice)
    assert (outcome.code, "--output is given as a.html and as b.html; give one" in outcome.err) == (2, True), (
        outcome.err
    )
    assert "can't be" in call("evaluate", "x.mcap", "-o", "a.html", "-o", "a.html", "--", "-ob.html").err


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


def test_results_beside_a_log_are_recovered_by_themselves(elsewhere, monkeypatch):
    Path("x.results.mcap").write_bytes(b"no log")
    found: list[str] = []

    def run(_: Any, logs: list[Any], *__: Any, **___: Any) -> None:
        found.extend(str(one.path) for one in logs)
        raise Stop("stop")

    monkeypatch.setattr("mcaptrack.fleet.run", run)
    call("recover", "*.mcap")
    assert found == ["x.mcap", "x.results.mcap"]


def test_tables_of_two_logs_of_one_name_are_not_written_to_one_folder(elsewhere, asked):
    for name in ("x", "y"):
        Path(name).mkdir()
        Path(name, "a.mcap").write_bytes(b"no log")
    words = ("x/a.mcap", "y/a.mcap", "-o", "tables")
    assert asked("export", *words) == {}
    assert (call("export", *words).code, call("export", *words).err.count("\n")) == (1, 1)


@pytest.mark.parametrize("command", sorted(GROUP.commands.keys() & {*mcaptrack.__all__} - {"models", *TRANSFORMS}))
def test_notes_are_printed_unless_quiet_and_details_with_verbose(command, elsewhere, monkeypatch):
    def called(*_: Any, **__: Any) -> None:
        logging.getLogger("mcaptrack").info("a note")
        logging.getLogger("mcaptrack").debug("a detail")
        raise Stop("stop")

    monkeypatch.setattr(mcaptrack, command, called)
    for more, notes in (([], ["a note"]), (["-q"], []), (["-v"], ["a note", "a detail"]), (["-q", "-v"], [])):
        outcome = call(command, *FIRST.get(command, ["x.mcap"]), *more)
        *said, last = [line for line in outcome.err.splitlines() if not line.startswith("options: ")]
        assert (outcome.code, outcome.out, said) == (1, "", notes)
        assert last.startswith("mcaptrack: ")
        assert last.endswith("stop")


WORDS = {
    "give `fps=` or `ground_plane=`": "give --fps or --ground-plane",
    "give `fps=25` and `force=True`": "give --fps 25 and --force",
    "give `point='foot'`": "give --point foot",
    "`sidecar=False`": "--sidecar",
    "`fps=a b`": "`fps=a b`",
    "`mcaptrack.run('a b.mcap')`": "`mcaptrack run 'a b.mcap'`",
    "`mcaptrack.run('-a.mcap')`": "`mcaptrack run ./-a.mcap`",
    "`mcaptrack.run('a.mcap', force=True)`": "`mcaptrack run a.mcap --force`",
    "`mcaptrack.track('a.mcap', max_age_s=2.0)`": "`mcaptrack track a.mcap --max-age-s 2.0`",
    **of_extensions("SAID"),
    "`mcaptrack.no_such('a.mcap', size=2)`": "`mcaptrack no_such a.mcap --size 2`",
    "`mcaptrack.run(path)`": "`mcaptrack.run(path)`",
    "`mcaptrack.run(**x)`": "`mcaptrack.run(**x)`",
    "`code` stays": "`code` stays",
}
WORDS_OF_INGEST = {
    "`label_format=`": "--format",
    "`role='truth'`": "--as truth",
    "`sidecar=True`": "--sidecar",
    "`sidecar=False`": "--in-place",
    "`output=`": "-o",
    "`inputs=`": "--inputs",
    "`mcaptrack.run('a', events=False)`": "`mcaptrack run a --no-events`",
    "`mcaptrack.run('a', sidecar=False)`": "`mcaptrack run a --in-place`",
    "`mcaptrack.demo(seed=3)`": "`mcaptrack demo --seed 3`",
}


def test_words_of_the_library_become_words_of_the_command_line():
    """Options are called as the running command calls them."""
    group = GROUP.make_context("mcaptrack", ["ingest"])
    ingest = GROUP.commands["ingest"].make_context("ingest", ["x.mp4"], parent=group)
    for context, table in ((None, WORDS), (ingest, WORDS_OF_INGEST)):
        for message, wanted in table.items():
            assert copy_context().run(lambda: (RUNNING.set(context), with_flags(message))[1]) == wanted  # noqa: B023


# Where it is printed


@pytest.mark.parametrize(("command", "more"), [("evaluate", []), *of_extensions("ANSWERS").items()])
def test_output_writes_what_would_be_printed(command, more, finished, tmp_path):
    target = tmp_path / "out.txt"
    for form in ([], ["--json"]):
        words = [command, finished, *more, *form]
        target.unlink(missing_ok=True)
        assert done(*words, "-o", target).out == ""
        before = target.read_text()
        assert before == done(*words).out != ""
        refused = call(*words, "-o", target)
        assert (refused.code, refused.out, refused.err.count("\n")) == (1, "", 1)
        target.write_text("old")
        done(*words, "-o", target, "--force")
        assert target.read_text() == before


def test_a_score_at_the_limit_passes(finished):
    words = ["evaluate", finished, "--similarity", "iou", "--topic", "/camera/tracks"]
    (one,) = json.loads(done(*words, "--json").out)["results"]
    assert call(*words, "--fail-under", f"mota={one['MOTA']!r}").code == 0
    assert call(*words, "--fail-under", f"MOTA={one['MOTA'] + 1e-4!r}").code == 4


def test_a_page_is_drawn_on_a_terminal_and_printed_as_it_is_elsewhere(monkeypatch, terminal):
    monkeypatch.setattr("sys.stdout", terminal)
    with pytest.raises(SystemExit):
        GROUP.main(["docs", "tables"], prog_name="mcaptrack")
    assert "```" not in terminal.shown()
    assert " Tables " in terminal.shown().splitlines()[0]


def test_progress_is_shown_on_a_terminal_only(monkeypatch, terminal):
    now = iter(0.06 * n for n in range(1000))
    monkeypatch.setattr(common, "monotonic", lambda: next(now))
    shown = {}
    for name, stream, quiet in (
        ("terminal", terminal, False),
        ("pipe", io.StringIO(), False),
        ("quiet", Terminal(), True),
    ):
        with monkeypatch.context() as patch, common.Talk(quiet).open() as talk:
            patch.setattr("sys.stderr", stream)
            for number in range(11):
                talk.progress("detect", number, 10)
            talk.progress("track", 3, 7)
            talk.progress("track", 7, 7)
            talk.say("a line")
            talk.progress("sample", 2, 2)
            talk.clear()
            shown[name] = sys.stderr.getvalue()
    assert (shown["pipe"], shown["quiet"]) == ("a line\n", "")
    before, after = terminal.shown().split("a line\n")
    assert all(part in before for part in ("detect", "10/10", " 7/7 "))
    assert "sample" not in before
    assert "2/2" in after
    assert "detect" not in after  # what was said before a line is over


def test_progress_is_said_now_and_then_as_json(capsys, monkeypatch):
    clock = iter((100.0, 104.9, 105.0))
    monkeypatch.setattr(common, "monotonic", lambda: next(clock))
    talk = common.Talk(False)
    with text.log_format("json", "run"):
        for total in (9, 9, None):
            talk.progress("detect", 3.5, total)
    first, second = (json.loads(line) for line in capsys.readouterr().err.splitlines())
    assert (first["message"], first["stage"], first["done"], first["total"]) == ("detect: 3.5 of 9", "detect", 3.5, 9)
    assert (second["message"], second["total"]) == ("detect: 3.5", None)
