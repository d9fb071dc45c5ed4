"""The score of re-tracked people by the number of questions of ``mcaptrack review`` that the ground truth answers.

    .venv/bin/python tools/second_look.py pets.mcap crowd/demo.mcap [--questions 20] [--at-once 10]

Logs hold pictures, re-tracked people and ground truth. A question is answered where, of the ten samples of each side
next to the gap, at least two boxes are people's by IoU 0.5, and nine in ten of these one person's; others are skipped.
Wrong samples are those that match a person, but not the track of that person.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import missing_extension  # noqa: F401

from mcaptrack import log
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import person_scores
from mcaptrack.extensions.review import questions as asking
from mcaptrack.extensions.review.questions import Question, Solved, Tracklet
from mcaptrack.schema import TRACKS, Frame

NEAR, SURE, CLEAR = 10, 0.9, 2


class Truth:
    """Answers from the ground truth."""

    def __init__(self, truth: list[Frame], samples: list[Frame]) -> None:
        scores = person_scores(truth, samples, MatchRule("iou", 0.5))
        rows = zip(scores.t_ns.tolist(), scores.track.tolist(), scores.person.tolist(), strict=True)
        self._person = {(t_ns, track): person for t_ns, track, person in rows}
        self._times = [frame.t_ns for frame in samples]

    def answer(self, question: Question) -> bool | None:
        """Yes or no; None if it can't be told."""
        if question.before is None:
            seen = self._seen(question.after)
            share = sum(person is not None for person in seen) / max(len(seen), 1)
            return None if 0.3 < share < 0.7 else share > 0.5
        sides = self._one(self._seen(question.before)[-NEAR:]), self._one(self._seen(question.after)[:NEAR])
        return None if None in sides else sides[0] == sides[1]

    def _seen(self, tracklet: Tracklet) -> list[int | None]:
        inside = (t_ns for t_ns in self._times if tracklet.begin_ns <= t_ns <= tracklet.end_ns)
        return [self._person.get((t_ns, tracklet.source_id)) for t_ns in inside]

    @staticmethod
    def _one(seen: list[int | None]) -> int | None:
        clear = [person for person in seen if person is not None]
        most = max(set(clear), key=clear.count) if len(clear) >= CLEAR else None
        return most if clear.count(most) >= SURE * len(clear) else None


def curve(path: Path, most: int, at_once: int) -> list[tuple[int, float, int, int]]:
    """Questions asked, IDF1 in percent, identity switches and wrong samples, from none on."""
    with log.read(path) as opened:
        truth = opened.frame_columns("/camera/truth", TRACKS)

        def scored(count: int, solved: Solved) -> tuple[int, float, int, int]:
            scores = person_scores(truth, solved.tracks, MatchRule("metres", 1.0))
            wrong = int((scores.matched - scores.hits).sum())
            return count, 100 * scores.idf1(), int(scores.switches.sum()), wrong

        solved, given, asked = asking.solve(opened, "/camera", ()), [], []
        person, out, count = Truth(truth, solved.samples), [scored(0, solved)], 0
        while count < most and (some := asking.questions(solved, asked, min(at_once, most - count))):
            answers = [(question.key, person.answer(question)) for question in some]
            said = [(key, float(yes)) for key, yes in answers if yes is not None]
            given = asking.with_answers(given, said, solved.samples)
            asked = asking.with_answers(asked, [(key, 0.0) for key, _ in answers], solved.samples)
            count += len(some)
            solved = asking.solve(opened, "/camera", given)
            out.append(scored(count, solved))
        return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--questions", type=int, default=20)
    parser.add_argument("--at-once", type=int, default=10)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for path in options.logs:
        print(path)
        for count, idf1, switches, wrong in curve(path, options.questions, options.at_once):
            print(f"  {count:3} asked: IDF1 {idf1:5.1f}, {switches:3} switches, {wrong:4} wrong samples", flush=True)


if __name__ == "__main__":
    main()
