"""Every option has an effect: a command with it has another outcome than without it.

What is seen is everything that a command leaves: exit code, stdout, stderr, and what changed of its folder. That an option
means the same whichever way it is given is tested in ``test_settings``, what parameters of transforms do in
``test_options``.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shlex
import shutil
import stat
import webbrowser
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from mcaptrack import log
from mcaptrack.cli.group import Commands
from mcaptrack.cli.many import NAMES
from mcaptrack.sources import demo
from mcaptrack.transforms import STAGES, TRANSFORMS, GroundTracker
from mcaptrack.viewing.serving import Server
from tests.commands import GROUP, call, done, press_ctrl_c
from tests.effects import Case, ground, others
from tests.effects.commands import CASES
from tests.extension_cases import of_extensions
from tests.logs import plain
from tests.tiers import one_in
from tests.undefined import write_undefined
from tests.worlds import small_scene, write_eventful


class Seen(NamedTuple):
    """The outcome of a command: ``files`` are the new and changed ones with their digests, and removed ones."""

    code: int
    out: str
    err: str
    files: dict[str, str]


def parameters(command: str) -> set[str]:
    """Return the options of a stage that its transforms declare."""
    if command not in STAGES:
        return set()
    declared = [
        field
        for kind in STAGES[command].built_in().values()
        for field in fields(kind)
        if not field.metadata.get("context") and field.metadata["flag"]
    ]
    return {field.name.replace("_", "-") for field in declared}


def test_every_option_has_a_case():
    elsewhere = {name for name, effects in of_extensions("EFFECTS").items() if effects is None}
    for command, known in Commands().items():
        if command in elsewhere:
            continue
        options = set(known.settings)
        options -= {name.replace("_", "-") for name in NAMES}  # see test_many_logs
        assert set(CASES[command]) | parameters(command) == options, command


@pytest.fixture(scope="module")
def template(template, tmp_path_factory) -> Path:
    """A folder with inputs of all commands. Tests must not change it."""
    folder = Path(shutil.copytree(template.parent, tmp_path_factory.mktemp("template"), dirs_exist_ok=True))
    done("ingest", folder / "clip.mp4", "--truth", folder / "truth.txt", "-o", folder / "fresh.mcap")
    rows = [line.split(",") for line in (folder / "truth.txt").read_text().splitlines()]
    tall = [[*row[:3], str(float(row[3]) - 6), row[4], "14", *row[6:]] for row in rows]  # as before on the ground
    (folder / "tall.txt").write_text("\n".join(map(",".join, tall)) + "\n")
    walk = [f"{row[0]} {row[1]} {0.1 * (float(row[2]) + 4)} 3.2" for row in rows]
    for camera, where in (("left", "-o"), ("right", "--into")):
        words = ("--as", "detections", "--fps", 10, "--camera", camera, "--ground-plane", folder / "plane.txt")
        done("ingest", folder / "truth.txt", *words, where, folder / "two.mcap")
    (folder / "walk.txt").write_text("\n".join(walk) + "\n")
    (folder / "old.html").write_text("")
    with log.create(folder / "things.mcap") as writer:
        channel = writer.add_channel("/things", ("my_msgs/Things", "jsonschema", b"{}"), "json", {})
        for number in range(40):
            box = {"left": 10 + number, "top": 20, "right": 22 + number, "bottom": 50, "label": "7", "conf": 0.9}
            payload = json.dumps({"stamp": {"sec": 1, "nanosec": number}, "things": [box]}).encode()
            writer.add_message(channel, number * 10**8, number, payload)
    kinds = "".join(
        f"{n},{who},{9 * n},24,8,16,{kind}\n" for n in range(30) for who, kind in ((1, "person"), (2, "cart"))
    )
    (folder / "kinds.csv").write_text(f"frame,id,x,y,w,h,class\n{kinds}")
    (folder / "table.csv").write_text("frame,id,x,y,w,h\n" + "".join(f"{n},1,{n},24,8,16\n" for n in range(30)))
    (folder / "cubes.csv").write_text("t,id,x_m,y_m\n" + "".join(f"{n},1,{n},2\n" for n in range(3)))
    shares = "".join(f"{n},1,{0.05 + n / 100},0.35,0.1,0.3\n" for n in range(30))
    (folder / "shares.csv").write_text(f"frame,id,x,y,w,h\n{shares}")
    (folder / "motion.txt").write_text("".join(f"{n}\t1\t0\t0.5\t0\t1\t0\n" for n in range(30)))
    lens, down = "[40, 0, 31.5, 0, 40, 23.5, 0, 0, 1]", "[0, -2.2, 2.2]"
    (folder / "pose.yml").write_text(f"%YAML:1.0\n---\nK: {lens}\nrvec: {down}\ntvec: [0, 0, 9]\n")
    pinhole = "{camera_model: pinhole, distortion_model: none, intrinsics: [40, 40, 31.5, 23.5]}"
    (folder / "camchain.yaml").write_text(f"cam0: {pinhole}\ncam1: {pinhole.replace('40', '50')}\n")
    (folder / "query.sql").write_text("select count(*) as n from tracks")
    (folder / "more.csv").write_text("a\n1\n")
    (folder / "verbose.toml").write_text("\n".join(f"[{name}]\nverbose = true" for name in GROUP.commands))
    _add_channels_of_others(folder / "a.mcap")
    plain(folder / "robot.mcap", "ros2")
    write_undefined(folder)
    write_eventful(folder / "eventful.mcap")
    done("export", folder / "fresh.mcap", "-o", folder / "taken")
    for path in [*(folder / "taken").glob("*/recording=fresh")]:
        path.rename(path.with_name("recording=a"))
    (folder / "taken" / "demo.mcap").write_text("")
    return folder


def _add_channels_of_others(path: Path) -> None:
    """Write a recording of a robot: messages with bytes in them, and detections."""
    with log.read(path) as opened, log.extend(opened) as writer:
        channel = writer.add_channel("/others", ("", "", b""), "json", {})
        writer.add_message(channel, 1, 1, b'{"a": 1}')


class Work:
    """A copy of a folder in which commands run: what one has changed is put back before the next."""

    def __init__(self, template: Path, folder: Path) -> None:
        self.folder, self._template = folder, template
        shutil.copytree(template, folder, copy_function=_copy)
        self.given = {name: _digest(folder / name) for name in _states(folder)}
        self._clean = _states(folder)

    def changed(self) -> dict[str, str]:
        """Return digests of the files that are new or have changed; those that are gone are "removed"."""
        now = _states(self.folder)
        found = dict.fromkeys(self._clean.keys() - now.keys(), "removed")
        found |= {name: _digest(self.folder / name) for name, state in now.items() if self._clean.get(name) != state}
        return {name: digest for name, digest in found.items() if self.given.get(name) != digest}

    def restore(self) -> None:
        now = _states(self.folder)
        if now == self._clean:
            return
        for name in [name for name in now if name not in self._clean]:
            (self.folder / name).rmdir() if now[name] is None else (self.folder / name).unlink()
        for name in sorted(name for name, state in self._clean.items() if now.get(name, ()) != state):
            mine, original = self.folder / name, self._template / name
            mine.unlink(missing_ok=True)
            mine.mkdir() if original.is_dir() else _copy(str(original), str(mine))
        self._clean = _states(self.folder)


def _copy(source: str, target: str) -> None:
    """Copy a file; files of tables, which are many, get a second name, because commands replace them as a whole."""
    if source.endswith(".parquet"):
        os.link(source, target)
    else:
        shutil.copy2(source, target)


def _states(folder: Path, inside: str = "") -> dict[str, tuple[int, ...] | None]:
    """What changes in the file system with any change of a file, by its name, those in a folder before that folder."""
    found: dict[str, tuple[int, ...] | None] = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            name = f"{inside}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                found |= _states(Path(entry.path), f"{name}/")
                found[name] = None
            else:
                facts = entry.stat(follow_symlinks=False)
                found[name] = (facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)
    return found


def _digest(path: Path) -> str:
    """The digest of a file; of one with a second name that is the place on the disk, and folders have none."""
    facts = path.lstat()
    if not stat.S_ISREG(facts.st_mode):
        return ""
    return str(facts.st_ino) if facts.st_nlink > 1 else hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def work(template, tmp_path_factory) -> Work:
    return Work(template, tmp_path_factory.mktemp("effects") / "work")


@pytest.fixture
def see(work, tmp_path, monkeypatch) -> Callable[[str], Seen]:
    """Run a command line in a folder that is as the template."""
    monkeypatch.setitem(demo.SCENES, "square", lambda seed: small_scene(2.0, seed=seed))
    monkeypatch.setitem(demo.SCENES, "crowd", lambda seed: small_scene(1.0, seed=seed))
    monkeypatch.setattr(Server, "serve_forever", press_ctrl_c)
    monkeypatch.setattr(secrets, "token_urlsafe", lambda _: "secret")
    monkeypatch.setattr(webbrowser, "open", lambda address: print(f"opened {address}"))

    def run(line: str) -> Seen:
        work.restore()
        monkeypatch.chdir(work.folder)
        code, out, err = call(*shlex.split(line))
        out = re.sub(r"(?<=127\.0\.0\.1)(:|%3A)\d{5}\b", ":any", out)  # a port that was free
        out = re.sub(r'"seconds": [\d.]+|"seconds_by_part": \{[^}]*\}', "", out)  # how long it took
        out = re.sub(r"[\d.]+ GB free", "", out)  # others write there, too
        err = re.sub(r" in [\d.]+ s\b|^  time .*\n", "", err, flags=re.MULTILINE)
        monkeypatch.chdir(tmp_path)
        return Seen(code, out, err, work.changed())

    return run


#: What came of command lines without the option that is looked at.
KNOWN: dict[str, Seen] = {}


@pytest.mark.parametrize(
    ("command", "option"), one_in(37, [(name, option) for name, known in CASES.items() for option in known])
)
def test_an_option_has_an_effect(command, option, see):
    case = CASES[command][option]
    if case.base not in KNOWN:
        KNOWN[case.base] = see(case.base)
        assert see(case.base) == KNOWN[case.base]  # what differs is the option's doing
    before, after = KNOWN[case.base], see(f"{case.base} {case.words}")
    # Where both are refused, nothing is seen of an option, but for detect: it reads no boxes, defined or not.
    assert 0 in (before.code, after.code) or (command, option) == ("detect", "definitions"), before.err
    assert after.code != 2, after.err
    assert before != after


#: Options that need data of their own to be seen: rules that differ in rare frames, a table that isn't asked for, classes,
#: several gates.
BY_DATA = ("set", "seed", "with", "classes", "all")
#: Other things that commands are used for: an option that does nothing there has to be refused, or a line says so.
USES = {
    "evaluate": [
        "evaluate a.mcap",
        "evaluate a.mcap --similarity iou",
        "evaluate a.mcap --similarity metres",
        "evaluate tall.txt --truth truth.txt --ground-plane plane.txt",
    ],
    "events": ["events a.mcap --similarity iou", "events a.mcap --similarity metres"],
    "ingest": [
        "ingest truth.txt --fps 10 --as truth",
        "ingest truth.txt --fps 10 --as truth --ground-plane plane.txt",
        "ingest a.mcap -o b.mcap",
        "ingest clip.mp4",
        "ingest clip.mp4 --image-format jpeg",
    ],
} | of_extensions("USES")


@pytest.mark.parametrize(
    ("command", "base"), one_in(17, [(name, base) for name, bases in USES.items() for base in bases])
)
def test_an_option_without_effect_is_a_warning(command, base, see):
    before, silent = KNOWN.get(base) or see(base), []
    assert before.code == 0, before.err
    for option, case in CASES[command].items():
        is_there = f"--{option}" in base or case.words in base
        if (
            option not in ("force", "config", "quiet", *BY_DATA)
            and not is_there
            and see(f"{base} {case.words}") == before
        ):
            silent.append(case.words)
    assert silent == []


# Every option of the transforms without a reference has a scene in which it matters, with the expected effect.
#
# Those of SORT and its relatives and of re-tracking are all varied against slow implementations in ``test_sort`` and
# ``test_retracking_reference``.


SCENES = others.CASES | ground.CASES
KINDS = {name: kind for name, kind in TRANSFORMS.items() if name not in ("track", "retrack")} | {
    "ground": GroundTracker
}
ORDER = ("least", "more", "most")


@pytest.mark.parametrize(
    ("option", "case"), one_in(2, [(name, case) for (_, name), case in SCENES.items()]), ids=map("-".join, SCENES)
)
def test_an_option_has_the_effect_that_its_scene_says(option: str, case: Case):
    found = {}
    for value in case.wanted:
        transform = replace(case.transform, **{option: value})
        found[value] = case.number([list(output) for output in zip(*transform(case.frames), strict=True)])
    if set(case.wanted.values()) <= set(ORDER):
        ordered = sorted(found, key=lambda value: ORDER.index(case.wanted[value]))
        numbers = [found[value] for value in ordered]
        assert all(more > 1.02 * less for less, more in pairwise(numbers)), found
    else:
        assert found == pytest.approx(case.wanted), case.scene


def test_every_option_has_a_scene():
    options = {(kind, o.name) for kind, made in KINDS.items() for o in fields(made) if not o.metadata.get("context")}
    assert set(SCENES) == options | {("retrack", "class_limits")}
