"""The command line: text, JSON, exit codes and errors of all commands."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mcaptrack import __version__
from mcaptrack.cli.demo import _next_commands
from mcaptrack.sources import demo
from mcaptrack.sources.demo import read_scores
from mcaptrack.viewing.serving import Server
from tests.commands import GROUP, call, press_ctrl_c, printed
from tests.worlds import small_scene, write_clip

LAYOUTS = [".comparing.layout.json", ".layout.json"]


class TestHelp:
    def test_help_imports_nothing_heavy(self):
        code = (
            "import sys; sys.argv = ['mcaptrack', '--help']\n"
            "from mcaptrack.__main__ import main\n"
            "try: main()\n"
            "except SystemExit: pass\n"
            "print('LOADED', *[m for m in ('torch', 'cv2', 'scipy', 'pyarrow', 'av', 'google.protobuf', 'mcaptrack.fleet') if m in sys.modules])"
        )
        done_ = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done_.stdout.splitlines()[-1].split() == ["LOADED"]

    def test_version(self):
        assert printed("--version")[0].strip() == f"mcaptrack {__version__}"


class TestCommands:
    def test_run_writes_layouts_and_tables_beside_the_log(self, finished):
        names = sorted(path.name for path in finished.parent.iterdir())
        assert names == [f"walk{end}" for end in (*LAYOUTS, ".mcap", ".predictions.layout.json", ".tables")]
        layout = json.loads((finished.parent / "walk.layout.json").read_text())
        shown = layout["configById"]["Image!picture"]["imageMode"]["annotations"]
        assert shown["/camera/retracks/full/view/image"] == {"visible": True}
        assert shown["/camera/tracks/view/image"] == {"visible": False}
        assert shown["/camera/detections/view/image"] == {"visible": False}

    def test_a_stage_runs_missing_inputs_and_says_so(self, fresh):
        _, err = printed("track", fresh)
        assert "/camera/detections is missing: running detect" in err
        assert f"{fresh}: detect, track" in err

    def test_quiet_prints_nothing_and_progress_is_not_written_to_a_pipe(self, fresh):
        assert printed("track", fresh, "-q") == ("", "")
        _, err = printed("track", fresh, "--max-age-s", 3)
        assert not {"\x1b", "\r"} & set(err)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "text.mp4").write_text("I am no video\n")
    (folder / "folder").mkdir()
    (folder / "link.mcap").symlink_to("gone.mcap")
    (folder / "bad.txt").write_text("1,1,1,1,2,2\n2,1,x,1,2,2\n")
    (folder / "good.txt").write_text("1,1,1,1,2,2\n")
    write_clip(folder / "clip.mp4", options={"bf": "0"})
    printed("ingest", "clip.mp4", "-o", "a.mcap", folder=folder)
    return folder


class TestErrors:
    CASES = {
        "ingest nothing.mp4": "nothing.mp4 does not exist",
        "ingest text.mp4": "text.mp4 can't be read as a video",
        "ingest folder": "folder holds no images",
        "ingest clip.mp4 --ground-plane text.mp4 -o x.mcap": "is not a homography",
        "ingest clip.mp4 --truth bad.txt -o x.mcap": "bad.txt:2: not MOTChallenge",
        "ingest clip.mp4 -o a.mcap": "a.mcap exists; give another name with -o, or --force",
        "ingest clip.mp4 -o no/x.mcap": "the folder no does not exist",
        "ingest clip.mp4 -o good.txt/x.mcap": "good.txt is a file, no folder",
        "ingest clip.mp4 -o clip.mp4 --force": "clip.mp4 is both input and output",
        "run a.mcap -o a.mcap --force": "a.mcap is both input and output",
        "run text.mp4": "text.mp4 can't be read as an MCAP file",
        "detect a.mcap --detector mog2": "no detector is called mog2;",
        "info link.mcap": "link.mcap is a link to gone.mcap, which does not exist",
        "info folder": "the folder folder has no log, which is a file that ends with .mcap and no part of a recording",
        "run clip.mp4": "clip.mp4 is a video, not an MCAP file; `mcaptrack ingest clip.mp4`",
        "evaluate a.mcap --truth good.txt": "add it with `mcaptrack ingest good.txt --as truth --into a.mcap`",
        "track a.mcap --topic /none": "has no channel /none for track; it has /camera/video",
        "evaluate a.mcap": "has no channel /camera/truth; add one with",
        "run *.nothing": "no file matches *.nothing",
        "ingest clip.mp4 --fps fast -o x.mcap": "--fps needs a number",
        "evaluate bad.txt good.txt --truth good.txt": "give one of ground truth for each",
        "ingest good.txt -o x.mcap": "give the frames per second with --fps",
        "ingest clip.mp4 --into a.mcap -o x.mcap": "it does not go with -o",
    }

    def test_an_error_is_one_line(self, place):
        before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
        for words, said in self.CASES.items():
            code, out, err = call(*words.split(), folder=place)
            assert (code, out, err.count("\n")) == (1, "", 1), err
            assert said in err
            assert err.startswith("mcaptrack: ")
            assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before, words

    def test_a_wrong_option_is_refused_with_the_nearest_one(self, place):
        for words, said in (
            (["--predictor", "red"], "no such option: --predictor (run, predict, retrack have it)"),
            (["--min_iou", "0.5"], "no such option: --min_iou; did you mean --min-iou?"),
            (["--max-age", "2"], "no such option: --max-age; did you mean --max-age-s?"),
            (["--across-classes"], "no such option: --across-classes (run has it); write --set across_classes=true"),
            (
                ["--frame", "map"],
                "no such option: --frame (ingest, run have it); in Python mcaptrack.track has it: frame=...",
            ),
            (["--all"], "no such option: --all (export, evaluate have it);"),
            (
                ["--ledger", "x"],
                "no such option: --ledger (ingest, run, detect, retrack, export have it); in Python mcaptrack.fleet.run",
            ),
            (["--views"], "no such option: --views; in Python mcaptrack.track has it: views=True"),
            (["--max-age-s", "2s"], "invalid value for '--max-age-s': '2s' is not a number;"),
            (["--jobs", "2.5"], "invalid value for '--jobs': '2.5' is not a whole number;"),
        ):
            code, out, err = call("track", "a.mcap", *words, folder=place)
            assert (code, out) == (2, "")
            assert err.startswith(f"mcaptrack: {said}")
            assert err.endswith(" `mcaptrack track --help-all` lists the options\n")

    def test_an_option_of_many_commands_is_refused_with_some_of_them(self):
        assert re.match(
            r"mcaptrack: no such option: -o \((\w+, ){4}\w+ and 1\d more have it\); `> FILE` ",
            call("info", "-o", "x").err,
        )

    def test_a_mode_that_there_is_not_is_refused(self, place):
        code, _, err = call("retrack", "labels.mcap", "--set", "mode=offlin", folder=place)
        assert (code, err) == (
            1,
            "mcaptrack: --set mode can't be 'offlin'; did you mean offline? there are both, offline, online\n",
        )

    def test_a_stage_that_cannot_run_is_not_announced(self, place):
        printed("ingest", "good.txt", "--as", "truth", "--fps", "10", "-o", place / "labels.mcap", folder=place)
        code, _, err = call("run", "labels.mcap", folder=place)
        (place / "labels.mcap").unlink()
        assert (code, err.count("\n")) == (1, 1)
        assert "add pictures with `mcaptrack ingest VIDEO --into labels.mcap`" in err

    def test_lost_data_exits_with_3(self, tmp_path):
        write_clip(tmp_path / "a.avi", frames=30, codec="mjpeg", pixels="yuvj420p", size=(320, 240))
        raw = (tmp_path / "a.avi").read_bytes()
        (tmp_path / "a.avi").write_bytes(raw[: len(raw) * 2 // 3])
        code, _, err = call("ingest", "a.avi", folder=tmp_path)
        assert code == 3
        assert "lost: a.avi claims 30 frames" in err
        assert (tmp_path / "a.mcap").is_file()


def ended(app: str, before: str = "", main: str = "ours.main()") -> tuple[int, str]:
    """The exit code and the errors of a command that does this: lines of a function ``app``, indented."""
    code = (
        f"import os, signal, sys, tempfile, time, types, weakref{before}\ndef app():\n{app}"
        "sys.modules['mcaptrack.cli'] = types.SimpleNamespace(app=app)\n"
        f"import mcaptrack.__main__ as ours; {main}\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=600)
    return run.returncode, run.stderr


@pytest.mark.parametrize("soon_s", [0.01, 1e-5], ids=["soon", "at once"])
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "kill"])
def test_an_interruption_ends_the_command_where_python_ignores_exceptions(sent, soon_s):
    """The signal arrives in a callback of the garbage collector, where Python ignores exceptions, and once more soon."""
    app = (
        "    class Thing: pass\n"
        "    thing = Thing()\n"
        f"    kept = weakref.ref(thing, lambda _: (os.kill(os.getpid(), {int(sent)}), time.sleep(0.01)))\n"
        "    del thing\n"
        "    signal.pause()\n"
    )
    assert ended(app, main=f"ours._SOON_S = {soon_s}; ours.main()") == (128 + sent, "")


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "kill"])
def test_an_interruption_that_a_library_replaces_by_its_own_error_counts(sent):
    """Extension modules do that when the signal arrives while they are imported."""
    app = (
        f"    try: os.kill(os.getpid(), {int(sent)}); signal.pause()\n"
        "    except BaseException: raise ImportError('initialization failed') from None\n"
    )
    assert ended(app) == (128 + sent, "")


@pytest.mark.parametrize(("before", "wanted"), [("SIG_DFL", 128 + signal.SIGHUP), ("SIG_IGN", 0)], ids=["", "nohup"])
def test_a_closed_terminal_ends_the_command_after_it_has_cleared_up(tmp_path, before, wanted):
    app = f"    with tempfile.TemporaryDirectory(dir={str(tmp_path)!r}):\n        os.kill(os.getpid(), signal.SIGHUP)\n"
    assert ended(app, f"; signal.signal(signal.SIGHUP, signal.{before})") == (wanted, "")
    assert list(tmp_path.iterdir()) == []


def test_the_demonstration(tmp_path, monkeypatch):
    monkeypatch.setitem(demo.SCENES, "square", lambda seed: small_scene(seed=seed))
    monkeypatch.setattr(sys, "argv", ["mcaptrack", "demo"])
    folder = tmp_path / "d"
    shown, _ = printed("demo", "-o", folder)
    for words in ("SORT", "re-tracked", "identity switches", "demo.mcap", "Lichtblick"):
        assert words in shown
    made = ("video", "log", "layouts", "tables")
    assert [line.split()[0] for line in shown.splitlines() if line.split()[:1] and line.split()[0] in made] == [*made]
    assert sorted(path.name for path in folder.iterdir()) == [
        *(f"demo{end}" for end in (*LAYOUTS, ".mcap", ".mp4", ".predictions.layout.json", ".tables")),
        "ground_plane.txt",
        "truth.txt",
    ]
    compared, seeds, files, more = (part.splitlines() for part in shown.split("\n\n"))
    assert compared[0].split() == ["within", "1", "m,", "2.5", "Hz", "SORT", "re-tracked"]
    assert (len(compared), seeds[0].partition(":")[0]) == (7, "This is scene square, seed 2")
    assert [line.split()[0] for line in seeds[1:]] == list(read_scores()["scenes"])
    assert len({len(line) for line in compared}) == 1
    assert files == [
        f"video    {folder / 'demo.mp4'}",
        f"log      {folder / 'demo.mcap'}",
        f"layouts  {'  '.join(f'{folder}/demo{end}.layout.json' for end in ('', '.comparing', '.predictions'))}",
        f"tables   {folder / 'demo.tables'}",
    ]
    assert (more[0].split()[0], more[1], len(more)) == (
        "Open",
        "See more:",
        5 + len({"report", "query"} & {*GROUP.commands}),
    )
    scored = json.loads(
        printed("evaluate", folder / "demo.mcap", "--similarity", "metres", "--gate-m", "1", "--json")[0]
    )
    one, other = ({r["tracks"]: r for r in scored["results"]}[f"/camera/{name}"] for name in ("samples", "retracks"))
    compared = [line.split()[-4:] for line in shown.splitlines()[1:7]]
    assert [words[-4:] for words in compared[:2]] == [
        [f"{100 * one[name]:.1f}", "%", f"{100 * other[name]:.1f}", "%"] for name in ("IDF1", "MOTA")
    ]
    assert [words[-2:] for words in compared[2:]] == [
        [str(one[name]), str(other[name])] for name in ("IDSW", "FP", "FN", "Frag")
    ]
    proposed = [shlex.split(line) for line in shown.partition("See more:\n")[2].splitlines()]
    assert [words[3] for words in proposed] == [
        name for name in ("view", "info", "evaluate", "report", "query") if name in GROUP.commands
    ]
    subprocess.run(proposed[1], capture_output=True, check=True, env=os.environ | {"PATH": "/usr/bin:/bin"})
    monkeypatch.setattr(Server, "serve_forever", press_ctrl_c)
    for words in proposed:  # works as it stands, where the demonstration was called
        assert words[:3] == proposed[0][:3]
        assert any(printed(*words[3:]))
    again = call("demo", "-o", folder)
    assert again.code == 1
    assert "exists; give another folder with -o, or --force" in again.err


def test_the_demonstration_proposes_commands_as_the_shell_finds_them(tmp_path, monkeypatch):
    for folder in (".venv", "other"):
        program = tmp_path / folder / "bin" / "mcaptrack"
        program.parent.mkdir(parents=True)
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(tmp_path / ".venv" / "bin" / "mcaptrack"), "demo"])
    for path, called in {
        ".venv/bin": "mcaptrack",
        "other/bin": ".venv/bin/mcaptrack",
        "": ".venv/bin/mcaptrack",
    }.items():
        monkeypatch.setenv("PATH", str(tmp_path / path) if path else "/nowhere")
        assert _next_commands(Path("a b.mcap"))[0] == f"{called} view 'a b.mcap'"
    monkeypatch.chdir(tmp_path / "other")
    assert _next_commands(Path("a.mcap"))[0] == f"{tmp_path}/.venv/bin/mcaptrack view a.mcap"


def test_check_lists_findings_in_a_table(finished, tmp_path):
    out, err = printed("check", finished)
    assert out.startswith(f"{finished}: sound; ")
    assert "error" not in out + err
    raw = bytearray(finished.read_bytes())
    raw[len(raw) // 3] ^= 1
    (tmp_path / "bad.mcap").write_bytes(raw)
    code, out, err = call("check", finished, tmp_path / "bad.mcap")
    each, bad, together = err.splitlines()  # of many logs, a line for each as it ends, and one for all
    assert (code, each) == (1, f"{finished}: sound")
    assert bad.startswith(f"{tmp_path / 'bad.mcap'}: damaged, ")
    assert together.startswith("2 logs in ")
    assert f"{tmp_path / 'bad.mcap'}: damaged; " in out
    assert "the checksum of a chunk is wrong" in out
    code, out, _ = call("check", tmp_path / "bad.mcap", "--json")
    (result,) = json.loads(out)["results"]
    assert (code, result["sound"]) == (1, False)
    assert {"level", "kind", "byte", "times", "words"} == set(result["findings"][0])


def test_recover_saves_intact_chunks_and_exits_with_3_after_losses(finished, tmp_path):
    damaged = tmp_path / "bad.mcap"
    whole = finished.read_bytes()
    damaged.write_bytes(whole[: len(whole) * 2 // 3])
    code, _, err = call("info", damaged)
    assert code == 1
    assert f"`mcaptrack recover {damaged}` saves what is intact" in err
    code, out, err = call("recover", damaged, "--json")
    (result,) = json.loads(out)["results"]
    assert (code, result["output"]) == (3, str(tmp_path / "bad.recovered.mcap"))
    assert "chunks saved" in err
    assert f"lost: {result['lost'][0]}" in err
    printed("check", result["output"])
    code, _, err = call("recover", damaged)
    assert code == 1
    assert "bad.recovered.mcap exists; give another name with -o, or --force to replace it" in err
    code, _, err = call("recover", finished, "-o", finished, "--force")
    assert (code, "is both input and output" in err) == (1, True)
    _, err = printed("recover", finished, "-o", tmp_path / "all.mcap")
    assert "nothing was lost" in err


def test_drop_removes_a_channel_and_its_views_only(finished, tmp_path):
    before = json.loads(printed("info", finished, "--json")[0])["results"][0]["channels"]
    out, _ = printed("drop", finished, "/camera/retracks*", "/camera/video", "-o", tmp_path / "small.mcap", "--json")
    (result,) = json.loads(out)["results"]
    after = json.loads(printed("info", tmp_path / "small.mcap", "--json")[0])["results"][0]["channels"]
    assert {c["topic"] for c in before} - {c["topic"] for c in after} == set(result["dropped"])
    assert "/camera/retracks/full/view/image" in result["dropped"]
    for channel in before:  # what was held against the re-tracked people has nothing to be held against any more
        channel["stale"] |= channel["topic"] in ("/camera/predictions/errors", "/camera/predictions/scores")
    assert [c for c in before if c["topic"] not in result["dropped"]] == after
    assert result["bytes"] == (tmp_path / "small.mcap").stat().st_size < finished.stat().st_size
    code, _, err = call("drop", finished, "/nothing/*")
    assert code == 1
    assert "has no channel /nothing/*; it has /camera/detections" in err
