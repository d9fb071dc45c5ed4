"""A second look: answers bind re-tracking, questions are the same again, and the page keeps each answer at once."""

from __future__ import annotations

import json
import shutil
import socket
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import person_scores
from mcaptrack.extensions.review import questions as asking
from mcaptrack.extensions.review.questions import Solved
from mcaptrack.log.writer import LogWriter
from mcaptrack.notices import collected
from mcaptrack.schema import DECISIONS, TRACKS, Frame
from mcaptrack.transforms import Retrack
from tests.browser import browser, needs_browser
from tests.commands import call, done, printed
from tests.tiers import thorough
from tests.worlds import crossing_tracks, noisy_tracks, ns, replace_channel, tracked, write_channels

QUICK = [Phase.explicit, Phase.generate]


def scene(seed: int) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return crossing_tracks(rng) if rng.random() < 0.4 else noisy_tracks(rng, people=6, ticks=60, hidden=0.03)


def solved_with(frames: list[Frame], answers: Sequence[tuple[asking.Question, float]] = ()) -> Solved:
    made = Retrack(
        worlds=20, answers=asking.with_answers((), [(question.key, yes) for question, yes in answers], frames)
    )
    out = dict(zip(made.writes, map(list, zip(*made(frames), strict=True)), strict=True))
    return Solved(frames, out[""], out["decisions"], out["worlds"])


def track_at(solved: Solved, t_ns: int, source: int) -> int | None:
    """The track of a sample; None if it was left out."""
    rows = next(frame.rows for frame in solved.tracks if frame.t_ns == t_ns)
    found = rows["track_id"][rows["source_id"] == source].tolist()
    return found[0] if found else None


def obeys(solved: Solved, question: asking.Question, yes: bool) -> bool:
    after = track_at(solved, question.after.begin_ns, question.after.source_id)
    if question.before is None:
        return (after is not None) is yes
    before = track_at(solved, question.before.end_ns, question.before.source_id)
    return (before == after) if yes else (before != after or before is None)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=2, phases=QUICK, deadline=None)
def test_an_answer_binds_and_one_that_agrees_with_what_was_decided_changes_nothing(seed):
    frames = scene(seed)
    plain = solved_with(frames)
    asked = asking.questions(plain, [], 6)
    for question in asked:
        for yes in (True, False):
            assert obeys(solved_with(frames, [(question, float(yes))]), question, yes), question
    agreeing = solved_with(frames, [(q, float(q.decided)) for q in asked if obeys(plain, q, q.decided)])
    for one, other in zip(agreeing.tracks, plain.tracks, strict=True):
        assert one.rows["track_id"].tolist() == other.rows["track_id"].tolist()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=3, phases=QUICK, deadline=None)
def test_the_same_log_has_the_same_questions_fewer_are_the_first_and_answered_ones_are_not_asked_again(seed):
    frames = scene(seed)
    solved = solved_with(frames)
    asked = asking.questions(solved, [], 8)
    assert asking.questions(solved_with(frames), [], 8) == asked
    assert asking.questions(solved, [], 3) == asked[:3]
    assert [question.value for question in asked] == sorted((q.value for q in asked), reverse=True)
    answered = asking.with_answers((), [(question.key, 1.0) for question in asked[:2]], frames)
    again = asking.questions(solved, answered, 100)
    assert not {question.key for question in again} & {question.key for question in asked[:2]}


def exchanged() -> tuple[list[Frame], list[Frame]]:
    """Two people who are lost for 3.2 s, and seen again where each could be either; ids are new. True and tracked."""
    truth, tracks = [], []
    for n in range(60):
        x = 0.5 * n * 0.4
        places = np.array([[x, 0.5], [x, -0.5]])
        rng = np.random.default_rng(n)
        truth.append(Frame(ns(n * 0.4), n, tracked(rng, np.array([1, 2]), places)))
        ids = np.array([1, 2] if n < 26 else [4, 3])
        seen = [] if 26 <= n < 34 else [0, 1]
        tracks.append(
            Frame(ns(n * 0.4), n, tracked(rng, ids[seen], places[seen] + rng.normal(0, 0.05, (len(seen), 2))))
        )
    for frame in (*truth, *tracks):
        frame.rows["observed"] = True
    return truth, tracks


def test_answers_from_the_truth_repair_identities_that_were_mistaken():
    truth, frames = exchanged()
    pairs = [
        asking.Question(
            asking.Tracklet(a, 0, ns(25 * 0.4)), asking.Tracklet(b, ns(34 * 0.4), ns(59 * 0.4)), 0.5, False, 25
        )
        for a, b in ((1, 4), (1, 3))
    ]
    wrong = solved_with(frames, [(pairs[0], 0.0), (pairs[1], 1.0)])
    right = solved_with(frames, [(pairs[0], 1.0), (pairs[1], 0.0)])
    rule = MatchRule("metres", 1.0)
    switches = [int(person_scores(truth, made.tracks, rule).switches.sum()) for made in (wrong, right)]
    assert switches == [2, 0]


def test_answers_that_contradict_each_other_are_said_and_the_tracks_stay_possible():
    _, frames = exchanged()
    first, second = asking.Tracklet(1, 0, ns(10.0)), asking.Tracklet(4, ns(13.6), ns(23.6))
    question = asking.Question(first, second, 0.5, True, 25)
    with collected() as warnings:
        solved_with(frames, [(question, 1.0), (question, 0.0)])
    assert [notice for notice in warnings if "1 of 2 answers contradict others" in notice.message]


@pytest.fixture(scope="module")
def walkers(tmp_path_factory):
    """A log of re-tracked walkers, without pictures."""
    path = tmp_path_factory.mktemp("review") / "log.mcap"
    write_channels(path, samples=noisy_tracks(np.random.default_rng(5), people=8, ticks=80, hidden=0.03))
    done("retrack", path, "-q")
    return path


@pytest.fixture
def own(walkers, tmp_path):
    return shutil.copyfile(walkers, tmp_path / "log.mcap")


def described(path) -> list[dict]:
    return json.loads(printed("review", path, "--print", "--json", "-q")[0])["questions"]


def test_a_file_of_answers_is_kept_obeyed_and_taken_back_by_drop(own, tmp_path):
    asked = described(own)
    question = next(one for one in asked if "-" in one["name"])
    file = tmp_path / "answers.json"
    file.write_text(json.dumps({question["name"]: "no" if question["decided"] == "yes" else "yes"}))
    before = log_tracks(own)
    changed = json.loads(printed("review", own, "--answers", file, "--json", "-q")[0])
    assert changed["rows_changed"] > 0
    assert log_tracks(own) != before
    assert question["name"] not in {one["name"] for one in described(own)}
    done("run", own, "-q", "--no-tables")  # nothing is due: the tracks know the answers that they were made with
    assert len(mcaptrack.run(own, tables=False).stages) == 0
    changed = log_tracks(own)
    file.write_text(json.dumps({question["name"]: "skip"}))  # an earlier answer can be given again, or taken back
    assert printed("review", own, "--answers", file, "-q")[0].count("answered 0")
    assert log_tracks(own) == before
    file.write_text(json.dumps({question["name"]: "no" if question["decided"] == "yes" else "yes"}))
    done("review", own, "--answers", file, "-q")
    assert log_tracks(own) == changed
    done("drop", own, "/camera/answers", "-q")
    done("run", own, "-q", "--no-tables")
    assert log_tracks(own) == before


def log_tracks(path) -> list:
    with log.Log(path) as opened:
        return [(frame.t_ns, frame.rows["track_id"].tolist()) for frame in opened.frames("/camera/retracks", TRACKS)]


@thorough
def test_answers_about_tracks_that_are_gone_are_left_out_and_said(own):
    review = mcaptrack.review(own)
    name = next(iter(review.questions))
    review.answer(name, "yes")
    with log.read(own) as opened:
        frames = [frame._replace(rows=frame.rows.copy()) for frame in opened.frames("/camera/samples", TRACKS)]
    for frame in frames:
        frame.rows["track_id"] += 1000
    replace_channel(own, "/camera/samples", frames)
    run = mcaptrack.run(own, tables=False)
    assert any("1 of 1 answers in /camera/answers are about tracks" in notice.message for notice in run.warnings)


def test_an_answer_that_is_interrupted_leaves_the_log_before_it(own, monkeypatch):
    review = mcaptrack.review(own)
    first, second, *_ = review.questions
    review.answer(first, "yes")
    before = own.read_bytes()

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LogWriter, "add_message", stop)
    with pytest.raises(KeyboardInterrupt):
        review.answer(second, "no")
    monkeypatch.undo()
    with log.read(own) as opened:
        assert sum(len(frame.rows) for frame in opened.frames("/camera/answers", DECISIONS)) == 1
    assert own.read_bytes() == before


def test_bad_answers_are_refused_in_a_line(own, tmp_path):
    name, file = described(own)[0]["name"], tmp_path / "answers.json"
    for content, text in (
        (f'{{"{name}": "perhaps"}}', "has no answers; it holds them by question"),
        (f'{{"{name}": "yes", "{name}": "no"}}', "stands there twice"),
        ("[", "is not valid JSON"),
        (f'{{"{name}": ["yes"]}}', "has no answers; it holds them by question"),
        (f'{{"{name}": "yes", "1@2": "no"}}', "has no question 1@2"),
        ('{"1@2": "yes"}', "has no question 1@2"),
    ):
        file.write_text(content)
        before = own.read_bytes()
        result = call("review", own, "--answers", file)
        assert result.code == 1
        assert text in result.err
        assert own.read_bytes() == before
    result = call("review", own)
    assert result.code == 1
    assert "has no pictures of /camera to show" in result.err


@pytest.fixture(scope="module")
def seen(finished, tmp_path_factory):
    """A log with pictures in which each track of the tracker gets a new id after 3 s."""
    path = shutil.copyfile(finished, tmp_path_factory.mktemp("seen") / "walk.mcap")
    with log.read(path) as opened:
        frames = [frame._replace(rows=frame.rows.copy()) for frame in opened.frames("/camera/samples", TRACKS)]
    for frame in frames[len(frames) // 2 :]:
        frame.rows["track_id"] += 100
    replace_channel(path, "/camera/samples", frames)
    done("retrack", path, "-q")
    return path


@thorough
def test_a_judge_weighs_where_there_are_pictures_and_is_never_certain(seen, tmp_path, monkeypatch):
    own = shutil.copyfile(seen, tmp_path / "walk.mcap")
    (tmp_path / "alike.py").write_text(
        "import numpy as np\n\nclass Alike:\n    def __call__(self, a, b):\n"
        "        assert all(crop.ndim == 3 and crop.dtype == np.uint8 for crop in a + b)\n        return 100.0\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(asking, "_LEAST", 0.0)
    review = mcaptrack.review(own, judge="alike:Alike", questions=50)
    asked = [name for name, question in review.questions.items() if question.before]
    assert asked
    assert {*review.answers} == {*asked}
    assert all(0.9 < yes < 1 for yes in review.answers.values())
    again = mcaptrack.review(own, questions=50)
    assert {*asked} & {*again.questions}  # a person is still asked
    printed = call("review", own, "--print", "--judge", "alike:Alike").err
    assert "--print changes nothing here: answers are taken" in printed


@needs_browser
def test_the_page_keeps_each_answer_at_once_and_takes_it_back(seen, tmp_path, monkeypatch):
    own = shutil.copyfile(seen, tmp_path / "walk.mcap")
    monkeypatch.setattr(asking, "_LEAST", 0.0)
    with mcaptrack.review(own, questions=2) as review, browser() as tab:
        first, _ = review.questions
        tab.open(review.address)
        assert tab.run("[...document.images].every(one => one.complete && one.naturalWidth > 5)")
        key = "document.dispatchEvent(new KeyboardEvent('keydown', {key: '%s'}))"
        number = "document.getElementById('count').textContent.includes('question %d ')"
        tab.run(key % "y")
        tab.wait(number % 2)
        assert review.answers == {first: 1.0}
        assert kept(own) == [1.0]
        tab.run(key % "u")
        tab.wait(number % 1)
        assert kept(own) == []
        tab.run(key % "n")
        tab.wait(number % 2)
        tab.run(key % "s")
        tab.wait("document.getElementById('text').textContent.startsWith('That was the last')")
        assert not review.is_done.is_set()
        tab.run(key % "f")
        tab.wait("document.getElementById('text').textContent.startsWith('Thank')")
        assert review.is_done.is_set()
        assert review.answers == {first: 0.0}
        assert tab.said == []
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(review.address + "yes-0")


@thorough
def test_every_option_of_the_command_has_an_effect(seen, tmp_path, monkeypatch):
    own, opened = shutil.copyfile(seen, tmp_path / "walk.mcap"), []
    monkeypatch.setattr(asking, "_LEAST", 0.0)
    assert len(json.loads(printed("review", own, "--print", "--json", "--questions", 1, "-q")[0])["questions"]) == 1
    assert "has no camera other" in call("review", own, "--camera", "other").err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"port {port} of this machine can't be used" in call("review", own, "--port", port).err
    assert "port 0 of this machine can't be used" in call("review", own, "--host", "192.0.2.1").err

    def open_and_stop(address: str) -> None:
        opened.append(address)
        raise KeyboardInterrupt

    monkeypatch.setattr(webbrowser, "open", open_and_stop)
    assert "answered 0" in done("review", own, "--open").out
    assert opened[0].startswith("http://127.0.0.1:")


def test_only_a_post_answers(seen, tmp_path, monkeypatch):
    """Neither GET nor HEAD, as previews of links send them, and an answer that can't be kept says why."""
    own = shutil.copyfile(seen, tmp_path / "walk.mcap")
    monkeypatch.setattr(asking, "_LEAST", 0.0)
    with mcaptrack.review(own, questions=1) as review:
        page = urllib.request.urlopen(review.address).read().decode()
        address = review.address.rstrip("/") + json.loads(page.partition('id="data">')[2].partition("<")[0])["root"]
        for method, status in (("GET", 405), ("HEAD", 405), ("PUT", 501), ("POST", 200)):
            assert review.answers == {}
            assert asked_by(method, f"{address}yes-0")[0] == status
        assert list(review.answers.values()) == [1.0]
        assert asked_by("POST", review.address)[0] == 501
        own.unlink()
        status, text = asked_by("POST", f"{address}no-0")
        assert status == 500
        assert "does not exist" in text
        assert list(review.answers.values()) == [1.0]


def asked_by(method: str, address: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, method=method)) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def kept(path) -> list[float]:
    with log.read(path) as opened:
        if "/camera/answers" not in opened.channels:
            return []
        return [float(p) for frame in opened.frames("/camera/answers", DECISIONS) for p in frame.rows["probability"]]


def test_a_log_without_probabilities_is_refused(tmp_path):
    path = write_channels(tmp_path / "log.mcap", samples=noisy_tracks(np.random.default_rng(5), people=3))
    with pytest.raises(McaptrackError, match=r"has no /camera/retracks to review"):
        mcaptrack.review(path)
    done("retrack", path, "--retracker", "consistency", "-q")
    with pytest.raises(McaptrackError, match="method that knows no probabilities"):
        mcaptrack.review(path)
