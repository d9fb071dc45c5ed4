"""Many logs: one that fails, kills its worker, hangs or eats memory is named, and all others are done, once."""

from __future__ import annotations

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from mcaptrack import environment, fleet
from mcaptrack.errors import McaptrackError
from mcaptrack.fleet import ledger
from mcaptrack.fleet import worker as of_worker
from mcaptrack.fleet.expansion import NamedLog, outputs_in
from mcaptrack.fleet.ledger import Claims, Ledger, claim_name
from mcaptrack.fleet.worker import Child, Reply, Request, WorkerLimits
from tests import fleet_tasks
from tests.awaiting import is_running, until
from tests.tiers import one_in, thorough

pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture
def folder(tmp_path) -> Path:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.mcap").write_text(name)
    return tmp_path


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def states(done: fleet.FleetResult) -> dict[str, str]:
    return {one.log.name: one.state for one in done.outcomes}


def stamps(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes()) for path in sorted(folder.rglob("*.mcap"))}


class TestWhichLogs:
    def names(self, *arguments, **given) -> list[str]:
        return [str(one.path) for one in fleet.find_logs(arguments, **given)]

    def test_a_folder_stands_for_its_logs_at_any_depth_without_hidden_ones(self, folder, monkeypatch):
        monkeypatch.chdir(folder.parent)
        (folder / "deep" / "er").mkdir(parents=True)
        (folder / "deep" / "er" / "Z.MCAP").write_text("z")
        (folder / ".hidden").mkdir()
        for name in (".hidden/x.mcap", ".y.mcap", "a.results.mcap", "notes.txt", "lonely.results.mcap"):
            (folder / name).write_text("x")
        found = self.names(folder.name)
        wanted = ["a.mcap", "b.mcap", "c.mcap", "lonely.results.mcap", "deep/er/Z.MCAP"]
        assert found == [f"{folder.name}/{name}" for name in wanted]
        assert f"{folder.name}/a.results.mcap" in self.names(folder.name, each=True)
        assert self.names(f"{folder.name}/**/*.MCAP") == [f"{folder.name}/deep/er/Z.MCAP"]

    def test_one_log_under_several_names_is_one(self, folder):
        (folder / "link.mcap").symlink_to("a.mcap")
        os.link(folder / "b.mcap", folder / "twin.mcap")
        names = [Path(name).name for name in self.names(folder / "c.mcap", folder, folder / "*.mcap")]
        assert names == ["c.mcap", "a.mcap", "b.mcap"]

    @pytest.mark.parametrize("end", [b"\n", b"\0"])
    def test_a_list_has_a_name_a_line_or_between_zero_bytes(self, folder, end):
        odd = os.fsencode(folder) + (b"/o \xff\xc3\xa9.mcap" if end == b"\n" else b"/two\nlines.mcap")
        Path(os.fsdecode(odd)).write_text("x")
        text = odd + end + os.fsencode(folder / "a.mcap") + end
        found = fleet.find_logs(["-"], read_list=lambda: text)
        assert [os.fsencode(one.path) for one in found] == [odd, os.fsencode(folder / "a.mcap")]
        assert fleet.find_logs(["-"], read_list=lambda: b"\n") == []

    def test_names_below_a_folder_stay_apart_in_the_output(self, folder):
        for name in ("x", "y"):
            (folder / name).mkdir()
            (folder / name / "same.mcap").write_text(name)
        done = fleet.run(fleet_tasks.touch, folder, {"add": "+"}, output_dir=folder / "out", suffix=".done.mcap")
        assert len(done.results) == 5
        assert (folder / "out/x/same.done.mcap").read_text() == "x+"
        with pytest.raises(McaptrackError, match=r"would both be .*or give the folder that holds both"):
            fleet.run(fleet_tasks.touch, [folder / "x/same.mcap", folder / "y/same.mcap"], output_dir=folder / "o")
        with pytest.raises(McaptrackError, match=r"would both be .* \(`output=`\)$"):  # no folder keeps these apart
            outputs_in(folder, [NamedLog(Path(name), Path("a.mcap")) for name in ("a.mp4", "a.ts")], ".mcap")

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"ad": "+"}, "touch has no option 'ad'; did you mean add\\? it has .*add"),
            ({"log": "x"}, "touch: each log has its own log"),
            ({"output": "x"}, "touch: each log has its own output"),
            ({1: 2}, "touch has no option 1; it has"),
        ],
    )
    def test_an_option_that_the_function_does_not_take_is_refused_before_it_begins(self, folder, options, words):
        with pytest.raises(McaptrackError, match=words):
            fleet.run(fleet_tasks.touch, folder, options, output_dir=folder / "out")
        assert not (folder / "out").exists()

    @pytest.mark.parametrize(
        ("argument", "words"),
        [("empty", "has no log"), ("*.none", "no file matches"), ("ftp://b/a.mcap", "is a URL")],
    )
    def test_what_names_no_log_is_refused(self, folder, argument, words, monkeypatch):
        monkeypatch.chdir(folder)
        Path("empty").mkdir()
        with pytest.raises(McaptrackError, match=words):
            self.names(argument)


def test_logs_that_harm_their_worker_are_named_and_the_others_are_done(folder):
    harm = {
        "die": ("killed", "killed by SIGKILL, 2 times"),
        "crash": ("killed", "SIGABRT"),
        "leave": ("killed", "exited with code 7"),
        "exit": ("failed", "ended its process with code 3"),
        "refuse": ("failed", "is refused"),
        "break": ("failed", "ZeroDivisionError: nothing is divided"),
    }
    for word in harm:
        (folder / f"{word}.mcap").write_text(word)
    (folder / "once.mcap").write_text(f"once {folder / 'mark'}")
    for name in ("warn", "warn2", "warn3"):
        (folder / f"{name}.mcap").write_text("warn")
    ledger, said = folder / "ledger.jsonl", []
    done = fleet.run(fleet_tasks.touch, folder, jobs=2, ledger=ledger, on_note=said.append)
    good = {f"{name}.mcap": "done" for name in ("a", "b", "c", "once", "warn", "warn2", "warn3")}
    assert states(done) == good | {f"{word}.mcap": state for word, (state, _) in harm.items()}
    by_name = {one.log.stem: one for one in done.outcomes}
    for word, (_, words) in harm.items():
        assert words in by_name[word].error
        assert str(by_name[word].log) in by_name[word].error
        assert "\n" not in by_name[word].error
    assert "last words" in by_name["crash"].detail
    assert "ZeroDivisionError" in by_name["break"].detail
    assert [notice.code for notice in by_name["warn"].warnings] == ["clock"]
    assert {by_name[name].printed for name in ("warn", "warn2", "warn3")} == {"printed by a library"}
    tries = Counter(Path(line["location"]).stem for line in lines(ledger))
    assert tries == Counter([*by_name, "die", "crash", "leave", "once"])
    assert (by_name["once"].tries, by_name["a"].tries) == (2, 1)
    assert sum("tried again" in words for words in said) == 4
    assert by_name["a"].peak_bytes > 1e6
    assert not list(folder.glob(".*"))


@thorough
def test_logs_that_exceed_a_limit_are_ended_and_named(folder):
    """What exceeds a limit never ends; the log that does is the only one with a limit of time, which others may miss."""
    (folder / "eat.mcap").write_text("eat")
    done = fleet.run(fleet_tasks.touch, folder, jobs=3, memory_limit="200MB", tries=1)
    assert states(done) == dict.fromkeys(("a.mcap", "b.mcap", "c.mcap"), "done") | {"eat.mcap": "out-of-memory"}
    (folder / "hang.mcap").write_text("hang")
    done = fleet.run(fleet_tasks.touch, folder / "hang.mcap", timeout_s=2.0, tries=1)
    assert states(done) == {"hang.mcap": "timed-out"}
    hung = folder / "hang.hangs"  # not there if a busy machine took all the time for imports
    assert not hung.exists() or not is_running(int(hung.read_text()))


class TestASecondTime:
    def test_only_what_is_not_done_or_has_changed_is_done(self, folder):
        ledger = folder / "ledger.jsonl"
        (folder / "refuse.mcap").write_text("refuse")
        run = lambda **more: fleet.run(fleet_tasks.touch, folder, {"add": "+"} | more, ledger=ledger)  # noqa: E731
        first = run()
        before = stamps(folder)
        again = run()
        assert set(states(first).values()) == {"done", "failed"}
        assert again.counts == {"skipped": 3, "failed": 1}
        assert stamps(folder) == before
        (folder / "b.mcap").write_text("other")
        assert run().counts == {"skipped": 2, "done": 1, "failed": 1}
        assert run(add="-").counts == {"done": 3, "failed": 1}

    @thorough
    def test_a_ledger_that_was_cut_or_is_of_another_command_does_no_harm(self, folder):
        ledger = folder / "ledger.jsonl"
        fleet.run(fleet_tasks.touch, folder, {"add": "+"}, ledger=ledger)
        text = ledger.read_bytes()
        ledger.write_bytes(text[:-25])
        with pytest.warns(UserWarning, match=r"^a line of the ledger .* and was left out"):
            done = fleet.run(fleet_tasks.touch, folder, {"add": "+"}, ledger=ledger)
        assert done.counts == {"skipped": 2, "up-to-date": 1}
        assert ledger.read_bytes().startswith(text[:-25] + b"\n")
        assert fleet.run(fleet_tasks.parity, folder, ledger=ledger).counts == {"done": 3}
        assert len(ledger.read_bytes().splitlines()) == 7

    def test_a_file_that_is_no_ledger_is_refused_and_kept(self, folder):
        for name in ("a.mcap", "."):
            with pytest.raises(McaptrackError, match=r"is not a ledger|can't be written"):
                fleet.run(fleet_tasks.touch, folder, ledger=folder / name)
        assert (folder / "a.mcap").read_text() == "a"


SCRIPT = """
import json
import sys
from pathlib import Path
from mcaptrack import fleet
from tests import fleet_tasks
folder = Path(sys.argv[1])
done = fleet.run(fleet_tasks.touch, folder, {"add": "+"}, jobs=2, ledger=folder / "ledger.jsonl", on_note=print)
print(json.dumps(done.counts))
"""


def start(folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SCRIPT, str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path) -> None:
    until(lambda: path.exists() and path.read_text())


def test_a_fleet_that_is_killed_takes_its_workers_along_and_can_be_started_again(folder):
    (folder / "d.mcap").write_text("hang")
    with start(folder) as killed:
        wait_for(folder / "d.hangs")
        worker = int((folder / "d.hangs").read_text())
        killed.kill()
    assert list(folder.glob(".*.claim"))
    before = {name: stamps(folder)[name] for name in stamps(folder) if stamps(folder)[name][1].endswith(b"+")}
    (folder / "d.mcap").write_text("d")
    said: list[str] = []
    given = {"ledger": folder / "ledger.jsonl", "jobs": 2}
    done = fleet.run(fleet_tasks.touch, folder, {"add": "+"}, on_note=said.append, **given)
    assert done.counts.get("done", 0) + done.counts.get("skipped", 0) + done.counts.get("up-to-date", 0) == 4
    assert {name: stamps(folder)[name] for name in before} == before
    assert not list(folder.glob(".*"))
    assert not is_running(worker)


@thorough
def test_two_fleets_share_the_work_and_do_no_log_twice(folder):
    for number in range(8):
        (folder / f"{number}.mcap").write_text(f"wait {folder / 'go'}")
    with start(folder) as one, start(folder) as other:
        until(lambda: len(list(folder.glob(".*.claim"))) >= 4)
        (folder / "go").write_text("go")
        outs = [one.communicate()[0], other.communicate()[0]]
    assert [one.returncode, other.returncode] == [0, 0]
    counts = Counter({state: n for out in outs for state, n in json.loads(out.splitlines()[-1]).items()})
    assert "done" in counts
    done = [line for line in lines(folder / "ledger.jsonl") if line["state"] == "done"]
    assert len(done) == len({line["location"] for line in done}) == 11
    assert len(done) == len(lines(folder / "ledger.jsonl"))
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("number", one_in(2, [signal.SIGINT, signal.SIGTERM]))
def test_a_signal_ends_workers_and_gives_claims_up(folder, number):
    (folder / "d.mcap").write_text("hang")
    script = SCRIPT.replace("import sys\n", "import signal, sys\nsignal.signal(15, lambda *_: sys.exit(143))\n", 1)
    command = [sys.executable, "-c", script, str(folder)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE) as ended:
        wait_for(folder / "d.hangs")
        ended.send_signal(number)
        ended.communicate()
    assert ended.returncode in (-signal.SIGINT, 1, 143)
    assert not list(folder.glob(".*"))
    until(lambda: not is_running(int((folder / "d.hangs").read_text())))


def test_the_first_failure_can_end_it(folder):
    (folder / "a.mcap").write_text("refuse")
    done = fleet.run(fleet_tasks.touch, folder, keep_going=False)
    assert done.counts == {"failed": 1, "not-tried": 2} or done.counts == {"failed": 1, "not-tried": 1, "done": 1}
    assert "a.mcap failed" in done.stopped


class TestClaims:
    def test_a_claim_of_a_living_process_is_respected_and_of_a_dead_one_taken_over(self, tmp_path, monkeypatch):
        one, other = Claims(), Claims()
        assert one.take("x", tmp_path).is_mine
        assert not other.take("x", tmp_path).is_mine
        one.release("x")
        assert other.take("x", tmp_path).is_mine
        path = tmp_path / claim_name("x")
        owner = json.loads(path.read_text())
        for change in ({"pid": 2**22 - 1}, {"started": "0"}):
            path.write_text(json.dumps(owner | change))
            taken = one.take("x", tmp_path)
            assert taken.is_mine
            assert "which has ended" in taken.note

    def test_a_claim_of_another_machine_counts_as_long_as_it_shows_life(self, tmp_path):
        path = tmp_path / claim_name("x")
        path.write_text(json.dumps({"host": "other", "pid": os.getpid(), "started": "1"}))
        assert not Claims().take("x", tmp_path).is_mine
        os.utime(path, (0, time.time() - ledger.STALE_S - 1))
        assert Claims().take("x", tmp_path).is_mine

    def test_life_is_shown_and_only_own_claims_are_given_up(self, tmp_path, monkeypatch):
        mine = Claims()
        mine.take("x", tmp_path)
        path = tmp_path / claim_name("x")
        os.utime(path, (0, 0))
        mine.beat()
        assert path.stat().st_mtime == 0
        monkeypatch.setattr(ledger, "BEAT_S", 0.0)
        mine.beat()
        assert path.stat().st_mtime > 1e9
        path.write_text(json.dumps({"host": "other", "pid": 1, "started": None}))
        mine.release("x")
        assert path.exists()

    @pytest.mark.parametrize("left", [None, b"", b'{"host"'])
    def test_a_disk_that_is_full_has_no_claims(self, tmp_path, monkeypatch, left):
        path = tmp_path / claim_name("x")
        if left is not None:  # by a fleet that was killed
            path.write_bytes(left)
            os.utime(path, (0, 0))

        def full(*_):
            raise OSError(errno.ENOSPC, "no space left")

        monkeypatch.setattr(ledger.os, "write", full)
        assert Claims().take("x", tmp_path) == (True, "")
        assert not path.exists()

    def test_a_folder_that_cannot_be_written_has_no_claims(self, tmp_path):
        assert Claims().take("x", tmp_path / "missing").is_mine


def test_settings_are_the_same_in_every_process_and_differ_with_every_value(tmp_path):
    file = tmp_path / "plane.txt"
    file.write_text("1")
    given = {"b": 1, "a": (1.5, None), "path": file, "set": {"x", "y"}}
    script = "from mcaptrack.fleet import ledger; from pathlib import Path; import sys; " + (
        "print(ledger.digest_of_settings({'set': {'y', 'x'}, 'a': [1.5, None], 'b': 1, 'path': Path(sys.argv[1])}))"
    )
    found = ledger.digest_of_settings(given)
    again = subprocess.run([sys.executable, "-c", script, file], capture_output=True, text=True, check=True)
    assert again.stdout.strip() == found
    assert len({found, *(ledger.digest_of_settings(given | {key: 7}) for key in given)}) == 5
    file.write_text("2")
    assert ledger.digest_of_settings(given) != found


def test_a_function_of_a_script_is_refused():
    function = type("Local", (), {"__module__": "__main__", "__qualname__": "f"})
    with pytest.raises(McaptrackError, match="can't be sent to workers"):
        fleet.run(function, __file__)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"jobs": 0}, "jobs"),
        ({"tries": 0}, "tries"),
        ({"timeout_s": 0}, "timeout_s"),
        ({"memory_limit": "lots"}, "needs a size"),
        ({"memory_limit": "2kB"}, "too little"),
    ],
)
def test_wrong_arguments_are_refused(folder, given, words):
    with pytest.raises(McaptrackError, match=words):
        fleet.run(fleet_tasks.touch, folder, **given)


def test_lines_of_a_ledger_are_whole_though_many_write(tmp_path):
    path = tmp_path / "l.jsonl"
    ledgers = [Ledger(path, "x", "s") for _ in range(4)]
    for number in range(100):
        ledgers[number % 4].append(location=f"/{number}", state="done", digest="d", error="é" * number)
    assert [line["location"] for line in lines(path)] == [f"/{number}" for number in range(100)]
    ledgers[0].refresh()
    assert ledgers[0].is_done("/99", "d")
    assert not ledgers[0].is_done("/99", "e")


def test_workers_share_the_cores(monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(of_worker, "cores", lambda: 9)
    assert environment.threads() == environment.cores()
    given = [of_worker.environment_of_worker(workers) for workers in (1, 2, 20)]
    assert [(one["OMP_NUM_THREADS"], one["OPENCV_FOR_THREADS_NUM"]) for one in given] == [
        ("9",) * 2,
        ("4",) * 2,
        ("1",) * 2,
    ]
    for said, wanted in (("3", 3), ("2,1", 2), ("0", environment.cores()), ("many", environment.cores())):
        monkeypatch.setenv("OMP_NUM_THREADS", said)
        assert environment.threads() == wanted
        assert of_worker.environment_of_worker(2)["OMP_NUM_THREADS"] == said


# Workers that end while they wait, that don't start, and that can't be started.


#: A worker that answers each request in the same way, without the packages that others import.
LIGHT = """
import json, os, sys
from multiprocessing.connection import Connection
connection = Connection(json.loads(sys.argv[1])[0])
connection.send(None)
while True:
    connection.recv_bytes()
    connection.send_bytes(bytes.fromhex({!r}))
"""


def test_a_worker_that_was_ended_while_it_waited_is_replaced(monkeypatch):
    """The system may end it for its memory. That was a broken pipe, which ended the whole command."""
    answer = pickle.dumps(Reply(Path("a.mcap"), "done", seconds=7.0)).hex()
    monkeypatch.setattr(of_worker, "_CODE", LIGHT.format(answer))
    worker, request = Child(WorkerLimits()), Request(Path("a.mcap"), b"", {})
    try:
        for number in range(3):
            assert worker.do(request, lambda: False) == Reply(Path("a.mcap"), "done", seconds=7.0), number
            process = worker._process
            assert process is not None
            os.kill(process.pid, signal.SIGKILL)
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    finally:
        worker.close(0.0)


def test_a_worker_that_does_not_start_is_named_as_that(monkeypatch):
    monkeypatch.setattr(of_worker, "_CODE", "import signal; signal.pause()")
    monkeypatch.setattr(of_worker, "_START_S", 0.3)
    monkeypatch.setattr(of_worker, "_GRACE_S", 0.2)
    worker = Child(WorkerLimits(timeout_s=3600))
    try:
        reply = worker.do(Request(Path("a.mcap"), b"", {}), lambda: False)
    finally:
        worker.close(0.0)
    assert reply.state == "timed-out"
    assert reply.error == (
        "a.mcap: its worker process did not start within 0.3 s (the machine may be too busy), and was ended"
    )


def test_logs_are_named_where_workers_cannot_be_started(tmp_path, monkeypatch):
    def no_folder(*_: object, **__: object) -> None:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    (tmp_path / "a.mcap").touch()
    monkeypatch.setattr("mcaptrack.fleet.worker.tempfile.TemporaryFile", no_folder)
    done = fleet.run(fleet_tasks.touch, tmp_path)
    assert [(one.state, one.error) for one in done.failed] == [
        (
            "failed",
            f"{tmp_path}/a.mcap: no worker process can be started (No usable temporary directory found in ['/tmp'])",
        )
    ]
