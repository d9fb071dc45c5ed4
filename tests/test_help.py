"""The help and the page `mcaptrack docs options` list all options, in order, with correct names, defaults and ranges."""

from __future__ import annotations

import inspect
import math
import os
import re
import shlex
import subprocess
import sys
from collections import Counter, defaultdict
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from mcaptrack import environment
from mcaptrack.cli.group import entries
from mcaptrack.cli.help import FIRST_PANEL, LAST_PANELS
from mcaptrack.cli.many import NAMES
from mcaptrack.cli.stages import shown_default
from mcaptrack.registry import own
from mcaptrack.transforms import STAGES
from tests.commands import GROUP, call
from tests.extension_cases import of_extensions
from tests.tiers import one_in

ROOT = Path(__file__).parent.parent
#: Options by declaration, as the page is printed.
PAGE = call("docs", "options").out
COMMANDS = GROUP.commands
UNITS = {"s": "second", "m": "metre", "px": "pixel", "hz": "per second", "fps": "per second"}
EVERY_COMMAND = pytest.mark.parametrize("command", sorted(COMMANDS))


def shown(command: str) -> list[Any]:
    """Return the options in the help of a command, except ``--help``."""
    return [one for one in COMMANDS[command].params if one.param_type_name == "option" and not one.hidden]


class TestHelp:
    def test_commands_are_grouped_below_a_few_headings(self):
        panels = Counter(entry.panel for entry in entries().values())
        assert 3 <= len(panels) <= 6
        assert max(panels.values()) <= 9

    def test_the_first_page_names_every_command(self):
        words = call("--help").out
        assert [name for name in COMMANDS if not re.search(rf"^  {name} ", words, re.MULTILINE)] == []
        assert len(words.splitlines()) <= 48  # two screens of 24 lines

    def test_the_line_of_a_command_on_the_first_page_is_the_first_of_its_own_help(self):
        first = {name: " ".join(command.help.split("\n\n")[0].split()) for name, command in COMMANDS.items()}
        assert {name: entry.summary for name, entry in entries().items()} == first

    @EVERY_COMMAND
    @pytest.mark.parametrize("width", one_in(2, ["80", "120"]))
    def test_names_of_options_are_not_cut_at_any_width(self, command, width, monkeypatch):
        monkeypatch.setenv("COLUMNS", width)
        words = set(re.split(r"[\s,/]+", call(command, "--help-all").out))
        assert {name for option in shown(command) for name in (*option.opts, *option.secondary_opts)} <= words

    @EVERY_COMMAND
    def test_examples_are_valid_commands(self, command):
        examples = re.findall(r"^Example: mcaptrack (.+)$", COMMANDS[command].help, re.MULTILINE)
        assert examples
        for example in examples:
            name, *words = shlex.split(example)
            assert name == command
            COMMANDS[name].make_parser(COMMANDS[name].context_class(COMMANDS[name])).parse_args(words)

    def test_commands_with_an_output_have_force(self):
        names = {command: {name for option in shown(command) for name in option.opts} for command in COMMANDS}
        assert [
            command for command in COMMANDS if "--output" in names[command] and "--force" not in names[command]
        ] == []

    def test_parameters_of_transforms_are_shown_with_their_defaults(self, monkeypatch):
        monkeypatch.setenv("COLUMNS", "160")
        words = call("track", "--help-all").out
        for option, default in (("--max-age-s", "1.4"), ("--min-iou", "0.2"), ("--min-hits-s", "0.3")):
            assert option in words
            assert f"[{default}]" in words

    def test_run_shows_the_defaults_of_the_stages(self):
        of = {stage: {option.name: option for option in COMMANDS[stage].params} for stage in ("run", *STAGES)}
        for name, stage in {"detector": "detect", "retracker": "retrack", "predictor": "predict"}.items():
            assert of["run"][name].show_default == f"as before, or {of[stage][name].show_default}"

    @pytest.mark.parametrize("stage", STAGES)
    def test_the_help_of_a_stage_says_what_its_transforms_do(self, stage):
        words = COMMANDS[stage].help
        for name, transform in STAGES[stage].built_in().items() if STAGES[stage].kind else ():
            first, _, _ = inspect.getdoc(transform).partition("\n\n")
            assert f"- `{name}`: {' '.join(first.split())}" in words

    @EVERY_COMMAND
    def test_options_are_grouped_below_headings(self, command):
        panels = [option.rich_help_panel for option in shown(command)]
        assert max(Counter(panels).values()) <= 9
        order = [LAST_PANELS.index(panel) + 1 if panel in LAST_PANELS else -(panel == FIRST_PANEL) for panel in panels]
        assert order == sorted(order)

    @EVERY_COMMAND
    def test_the_options_that_most_people_need_come_first(self, command):
        """Commands with many options begin with the file to write, what is read, and the methods to choose from."""
        names = {option.name for option in shown(command)}
        first = [option.name for option in shown(command) if option.rich_help_panel == FIRST_PANEL]
        assert first == [name for name in COMMANDS[command].most_used if name in names]
        own = [option.name for option in shown(command) if option.rich_help_panel not in LAST_PANELS[1:]]
        choices = {"detector", "tracker", "retracker", "predictor", "output", "topic", "force", "truth", "profile"}
        if len(own) > 9:
            assert choices & set(own) <= set(first)
            words = call(command, "--help-all").out
            names = [max(option.opts, key=len) for option in shown(command)]
            assert words.index(FIRST_PANEL) < min(words.index(f"{name}") for name in names[len(first) :])

    @EVERY_COMMAND
    def test_the_short_help_has_those_alone_and_names_the_rest(self, command, monkeypatch):
        monkeypatch.setenv("COLUMNS", "80")
        text, everything = call(command, "--help").out, call(command, "--help-all").out
        assert len(text.splitlines()) <= 48  # two screens of 24 lines
        assert "\n\n\n" not in everything
        names = {max(option.opts, key=len): option.rich_help_panel for option in shown(command)}
        listed, every = (set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", page, re.MULTILINE)) for page in (text, everything))
        assert every - {"--help", "--help-all"} == names.keys()
        last = LAST_PANELS[1:] if not COMMANDS[command].most_used else {*names.values()} - {FIRST_PANEL}
        assert listed == {name for name in names if names[name] not in last}
        told = " ".join(text.partition("`--help-all` shows all options, also: ")[2].split())
        assert [panel for panel in names.values() if panel in last and panel.partition(" (")[0] not in told] == []

    def test_the_help_of_export_names_all_formats(self):
        words = {*re.findall(r"[\w-]+", call("export", "--help").out)}
        assert {"parquet", "arrow", "csv", "jsonl", *own("exporter")} <= words

    def test_a_short_name_means_the_same_in_all_commands(self):
        for command in COMMANDS:
            short = {name: one.name for one in shown(command) for name in one.opts if re.fullmatch("-[a-z]", name)}
            usual = {"-o": "output", "-q": "quiet", "-v": "verbose", "-f": "file"}
            assert short.items() <= usual.items()
            assert ("-o" in short) == any(one.name == "output" for one in shown(command))

    def test_the_help_of_every_option_is_a_sentence_that_spells_out_units_and_stands_alone(self):
        for command in COMMANDS:
            assert len({option.help for option in shown(command)}) == len(shown(command)), command
            assert len(COMMANDS[command].help) > 40, command
            for option in shown(command):
                name = max(option.opts, key=len)
                assert re.fullmatch(r"(?!The same|For so long)[A-Z].*\.", option.help, re.S), (command, name)
                assert UNITS.get(name.rpartition("-")[2], "") in option.help.lower(), (command, name)

    def test_options_of_the_same_meaning_have_the_same_name(self):
        names = defaultdict(set)
        for command in COMMANDS:
            for option in shown(command):
                names[option.help].add(max(option.opts, key=len))
        assert {words: found for words, found in names.items() if len(found) > 1} == {}


@pytest.mark.parametrize(
    ("default", "words"),
    [
        ((1.0, 2.5), "1.0 2.5"),
        ((), "none"),
        (None, "none"),
        ("", "none"),
        (True, "true"),
        (False, "false"),
        (0.5, "0.5"),
        (0, "0"),
        ("iou", "iou"),
    ],
)
def test_a_default_in_words(default, words):
    assert shown_default(default) == words


class TestWrongUsage:
    """A wrong command line is refused in one line, with the nearest name."""

    @staticmethod
    def refused(*words: str) -> str:
        code, out, err = call(*words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("mcaptrack: ")
        return err

    @EVERY_COMMAND
    def test_a_wrong_and_a_missing_value_are_refused(self, command):
        for setting in COMMANDS[command].settings.values():
            if setting.kind in (int, float):
                assert f"--{setting.name}" in self.refused(command, "a", f"--{setting.name}", "two")
            if setting.kind is not bool:
                assert f"--{setting.name}" in self.refused(command, "a", f"--{setting.name}")

    @EVERY_COMMAND
    def test_a_missing_argument_is_refused(self, command):
        needed = [one for one in COMMANDS[command].params if one.param_type_name == "argument" and one.required]
        if needed:
            assert str(needed[0].metavar) in self.refused(command)

    def test_an_unknown_command_and_an_unknown_option_before_it_are_refused(self):
        assert "did you mean evaluate? `mcaptrack --help` lists" in self.refused("evaluat", "a.mcap")
        assert "--versio" in self.refused("--versio")


class Bounded(NamedTuple):
    """An option with a range, as the page of options lists it."""

    command: str
    chosen: tuple[str, ...]
    name: str
    least: float
    most: float
    whole: bool


def documented() -> list[Bounded]:
    """Return the options for which the page has a range."""
    out, chosen = [], ("", ())
    for line in PAGE.splitlines():
        if head := re.fullmatch(r"### (\w+)(?:, with `--(\w+) (\w+)` alone)?", line):
            chosen = head[1], (f"--{head[2]}", head[3]) if head[2] else ()
        elif row := re.match(r"\| `--([a-z-]+)` \| (whole )?number(?: at least (\S+)| from (\S+) to (\S+))? \|", line):
            least, most = row[3] or row[4], row[5]
            bounds = float(least) if least else -math.inf, float(most) if most else math.inf
            out.append(Bounded(*chosen, row[1], *bounds, bool(row[2])))
    return [one for one in out if one.least > -math.inf or one.most < math.inf]


BOUNDED = documented()
#: What commands are given, in which none finds anything to do, so that each ends at once with 1.
WORDS = {name: ("none.mcap", *of_extensions("NEEDS").get(name, ())) for name in COMMANDS} | {
    "demo": ("-o", str(ROOT / "README.md")),
}


class TestPage:
    @pytest.mark.parametrize("command", STAGES)
    def test_the_page_lists_every_parameter_of_a_stage_as_the_command_takes_it(self, command):
        sections = re.findall(rf"^### {command}\b.*?\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL)
        listed = dict(re.findall(r"^\| `(--set \w+|--[\w-]+)=?` \| .+? \| (.*?) \|", "".join(sections), re.MULTILINE))
        declared = {
            field.name: getattr(kind(), field.name)
            for kind in reversed(STAGES[command].built_in().values())
            for field in fields(kind)
            if not field.metadata.get("context")
        }
        names = {name: name.removeprefix("--set ").removeprefix("--").replace("-", "_") for name in listed}
        assert set(names.values()) - {STAGES[command].kind} == declared.keys() - {STAGES[command].kind}
        options = {name for one in COMMANDS[command].params for name in one.opts}
        for name, parameter in names.items():
            assert name.startswith("--set ") or name in options, name
            assert name.removeprefix("--set ") == name or f"--{parameter.replace('_', '-')}" not in options, name
            if isinstance(value := declared.get(parameter), float):
                assert float(listed[name]) == value

    def test_the_page_lists_environment_variables_that_are_not_options(self):
        listed = re.findall(r"^\| `(MCAPTRACK_\w+)` \| (.+) \|$", PAGE, re.MULTILINE)
        assert dict(listed) == dict(environment.VARIABLES)

    @pytest.mark.parametrize(
        ("case", "way"),
        one_in(4, product(BOUNDED, ["command line", "environment", "file"])),
        ids=lambda one: one if isinstance(one, str) else "-".join([one.command, *one.chosen[1:], one.name]),
    )
    def test_a_number_at_the_bound_is_accepted_and_one_beyond_it_refused(self, case, way, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for bound, sign in ((case.least, -1), (case.most, 1)):
            if math.isinf(bound):
                continue
            after = bound + sign if case.whole else math.nextafter(bound, sign * math.inf)
            for value, is_taken in ((bound, True), (after, False)):
                text = str(int(value)) if case.whole else repr(value)
                words = [case.command, *WORDS[case.command], *case.chosen]
                where = f"--{case.name}"
                with monkeypatch.context() as patch:
                    if way == "command line":
                        words += [f"--{case.name}", text]
                    elif way == "environment":
                        where = f"MCAPTRACK_{case.command}_{case.name}".upper().replace("-", "_")
                        patch.setenv(where, text)
                    else:
                        where = f"set.toml: [{case.command}] {case.name}"
                        Path("set.toml").write_text(f"[{case.command}]\n{case.name} = {text}\n")
                        words += ["--config", "set.toml"]
                    code, out, err = call(*words)
                assert (code, out) == (1, "")
                assert err.startswith(f"mcaptrack: {where} has to be ") is not is_taken, (case, text, err)
                assert err.count("\n") == 1

    def test_all_numbers_have_a_lower_and_an_upper_bound(self):
        bounded = {(one.command, one.name) for one in BOUNDED if math.isfinite(one.least) and math.isfinite(one.most)}
        numbers = {
            (command, setting.name)
            for command in COMMANDS
            for setting in COMMANDS[command].settings.values()
            if setting.kind in (int, float)
        }
        numbers -= {(command, name) for command in COMMANDS if command != "run" for name in NAMES}  # see above
        assert bounded < numbers
        scores = {("track", name) for name in ("min-score",)}  # each detector has its own
        assert numbers - bounded == scores


@pytest.mark.parametrize(
    ("typed", "offered"), [("mcaptrack run --dete", "--detector"), ("mcaptrack nothing --", "--help")]
)
def test_words_are_completed_also_after_a_command_that_there_is_not(typed, offered):
    words = {"_MCAPTRACK_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": "2"}
    program = "import sys; sys.argv[0] = 'mcaptrack'; from mcaptrack.cli import app; app(prog_name='mcaptrack')"
    done = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | words, capture_output=True, text=True, check=False
    )
    assert offered in done.stdout.splitlines()
    assert done.stderr == ""
