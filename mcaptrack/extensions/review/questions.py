"""The questions about identities with the largest expected change, and the rows of their answers.

What is not sure is what differs between worlds: re-tracking decided again with noise (``retrack --worlds``). A question
is worth the probability that its answer is another one than was decided, times the rows that would change.

Letters: W worlds, K tracklets, E pairs of tracklets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows, run_starts
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.schema import DECISIONS, TRACKS, WORLDS, DecisionKind, Frame, Rows
from mcaptrack.schema.framing import join_frames
from mcaptrack.sources.cameras import provenance_of
from mcaptrack.sources.corrections import ANSWERS
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.retrack.options import LikelihoodOptions

#: The worlds that questions are found in.
_WORLDS: Final = 100
#: Answers that are less likely to change anything are not asked for.
_LEAST: Final = 0.5


@dataclass(frozen=True)
class Tracklet:
    """A certain part of a track: its id in the input of re-tracking, and its first and last samples."""

    source_id: int
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Question:
    """A question: whether the ends of two tracklets are one person, or, without ``after``, whether one is a person.

    ``probability`` is that of yes, ``decided`` what re-tracking has decided, and ``rows`` what changes otherwise.
    """

    before: Tracklet
    after: Tracklet | None
    probability: float
    decided: bool
    rows: int

    @property
    def key(self) -> tuple[int, int, int, int]:
        """The samples that it is about: the same question has the same key, also after other answers."""
        after = self.after or Tracklet(-1, -1, -1)
        return self.before.source_id, self.before.end_ns, after.source_id, after.begin_ns

    def name(self, start_ns: int) -> str:
        """Its name, with seconds since the start of the log."""
        edge = self.before.end_ns if self.after else self.before.begin_ns
        name = f"{self.before.source_id}@{(edge - start_ns) / NS_PER_S:.3f}"
        return name + (
            f"-{self.after.source_id}@{(self.after.begin_ns - start_ns) / NS_PER_S:.3f}" if self.after else ""
        )

    @property
    def value(self) -> float:
        """The rows that its answer is expected to change."""
        return (1 - self.probability if self.decided else self.probability) * self.rows


@dataclass(frozen=True)
class Solved:
    """The samples of a camera, and the tracks, decisions and worlds that re-tracking makes of them."""

    samples: Sequence[Frame]
    tracks: Sequence[Frame]
    decisions: Sequence[Frame]
    worlds: Sequence[Frame]


def solve(opened: log.Log, prefix: str, answers: Sequence[Frame] | None = None) -> Solved:
    """Re-track a camera as before, with worlds, in memory; with these answers, or else with those of the log.

    Raises McaptrackError if the log can't be reviewed.
    """
    topic = f"{prefix}/{STAGES['retrack'].output_topic}"
    how = provenance_of(opened, topic) if topic in opened.channels else None
    if how is None:
        raise McaptrackError(f"{opened.path} has no {topic} to review; {call('run', opened.path)} makes it")
    transform = rebuild(STAGES["retrack"], how, {})
    if not isinstance(transform, LikelihoodOptions):
        raise McaptrackError(f"{opened.path}: {topic} was made by a method that knows no probabilities")
    frames, context = pipeline.input_of(opened, prefix, "retrack", transform, how.input)
    given = {} if answers is None else {"answers": answers}
    transform = replace(transform, **context | given, worlds=_WORLDS)
    if transform.leaves_unchanged:
        raise McaptrackError(f"{opened.path}: without a measured ground plane {prefix} has no decisions to review")
    outputs = dict(zip(transform.writes, zip(*transform(frames), strict=True), strict=True))
    return Solved(frames, outputs[""], outputs["decisions"], outputs["worlds"])


def questions(solved: Solved, answered: Sequence[tuple[int, Rows]], count: int) -> list[Question]:
    """The most valuable questions, the best first, without those that a person answered; the same for the same log."""
    worlds = join_frames(WORLDS, solved.worlds)
    if not len(worlds.rows):
        return []
    order = np.lexsort((worlds.rows["source_id"], worlds.row_ns, worlds.rows["world"]))
    track = worlds.rows["track_id"][order].reshape(int(worlds.rows["world"].max()), -1)
    first = order[: track.shape[1]]
    rows, begins = worlds.rows[first], worlds.row_ns[first]
    tracklets = _placed(solved.samples, rows, begins)
    decided = _decided(solved.tracks, rows, begins)
    frames = rows["frames"].astype(np.int64)
    asked = [*_of_pairs(track, decided, tracklets, frames), *_of_people(track, decided, tracklets, frames)]
    done = {key for answer in answered if answer[1]["probability"][0] in (0, 1) for key in keys_of(*answer)}
    asked = [question for question in asked if question.key not in done and question.value >= _LEAST]
    asked.sort(key=lambda question: (-question.value, question.key))
    out: list[Question] = []
    ends: set[tuple[int, int]] = set()
    for question in asked:  # one question for each end and each beginning: the others follow from its answer
        sides = {question.key[:2], (question.key[2], -1 - question.key[3])}
        if not sides & ends or question.after is None:
            out.append(question)
            ends |= sides if question.after else set()
    return out[:count]


def _decided(tracks: Sequence[Frame], tracklets: Rows, begins: Ints) -> Ints:
    """The track of each tracklet (K,) as it was decided; those that are left out have negative numbers of their own."""
    joined = join_frames(TRACKS, tracks)
    at = find_rows((joined.row_ns, joined.rows["source_id"]), (begins, tracklets["source_id"]))
    return np.where(at >= 0, joined.rows["track_id"][at], -1 - np.arange(len(at)))


def _placed(samples: Sequence[Frame], rows: Rows, begins: Ints) -> list[Tracklet]:
    """The tracklets of worlds, with the times of their last samples: durations are in steps, which may jitter."""
    joined = join_frames(TRACKS, samples)
    seen = joined.rows["observed"]
    order = np.lexsort((joined.row_ns[seen], joined.rows["track_id"][seen]))
    ids, t_ns = joined.rows["track_id"][seen][order], joined.row_ns[seen][order]
    out = []
    for row, begin in zip(rows, begins.tolist(), strict=True):
        low, high = (int(np.searchsorted(ids, row["source_id"], side)) for side in ("left", "right"))
        first = low + int(np.searchsorted(t_ns[low:high], begin))
        end = int(t_ns[min(first + int(row["frames"]), high) - 1])
        out.append(Tracklet(int(row["source_id"]), begin, end))
    return out


def _of_pairs(track: Ints, decided: Ints, tracklets: Sequence[Tracklet], frames: Ints) -> list[Question]:
    """A question for each two tracklets that follow each other in a world (W, K), or as was decided."""
    begins = np.array([tracklet.begin_ns for tracklet in tracklets])
    pairs = np.unique(np.concatenate([_following(of, begins) for of in (decided, *track)], axis=1), axis=1)
    a, b = pairs
    together = ((track[:, a] == track[:, b]) & (track[:, a] >= 0)).mean(axis=0)
    heads, tails = _sides(decided, frames)
    columns = pairs.T, together, decided[a] == decided[b], np.minimum(heads[a], tails[b])
    return [
        Question(tracklets[i], tracklets[j], p, is_one, count)
        for (i, j), p, is_one, count in zip(*(column.tolist() for column in columns), strict=True)
    ]


def _following(track: Ints, begins: Ints) -> Ints:
    """Pairs (2, E) of tracklets that follow each other in a track (K,)."""
    order = np.lexsort((begins, track))
    same = np.flatnonzero((track[order][1:] == track[order][:-1]) & (track[order][1:] >= 0))
    return np.stack([order[same], order[same + 1]])


def _sides(track: Ints, frames: Ints) -> tuple[Ints, Ints]:
    """The samples of the track of each tracklet (K,) up to its end, and from its beginning on."""
    order = np.argsort(track, kind="stable")
    total = np.cumsum(frames[order])
    starts = run_starts(track[order])
    before = (total - frames[order])[starts][np.cumsum(starts) - 1]
    heads, tails = np.empty_like(frames), np.empty_like(frames)
    heads[order] = total - before
    whole = np.bincount(np.cumsum(starts) - 1, frames[order])[np.cumsum(starts) - 1].astype(np.int64)
    tails[order] = whole - (total - before) + frames[order]
    return heads, tails


def _of_people(track: Ints, decided: Ints, tracklets: Sequence[Tracklet], frames: Ints) -> list[Question]:
    """A question for each tracklet: whether it is a person."""
    columns = (track >= 0).mean(axis=0), decided >= 0, frames
    return [
        Question(tracklet, None, p, is_kept, count)
        for tracklet, p, is_kept, count in zip(tracklets, *(column.tolist() for column in columns), strict=True)
    ]


def keys_of(t_ns: int, rows: Rows) -> list[tuple[int, int, int, int]]:
    """The keys of the questions that rows of answers at a time are about (``Question.key``)."""
    gap_ns = np.round(rows["duration_s"] * NS_PER_S).astype(np.int64)
    return [
        (int(row["previous_id"]), t_ns - int(gap), int(row["source_id"]), t_ns)
        if row["kind"] == DecisionKind.JOINED
        else (int(row["source_id"]), t_ns + int(gap), -1, -1)
        for row, gap in zip(rows, gap_ns, strict=True)
    ]


def answer_row(question: Question, yes: float, samples: Sequence[Frame]) -> tuple[int, Rows]:
    """The time and the row of an answer: ``yes`` is the probability that it is yes."""
    rows = DECISIONS.empty(1)
    about = question.after or question.before
    t_ns = about.begin_ns
    rows["kind"] = DecisionKind.JOINED if question.after else DecisionKind.KEPT
    rows["track_id"] = rows["alternative_id"] = -1
    rows["previous_id"] = question.before.source_id if question.after else -1
    rows["source_id"], rows["probability"] = about.source_id, yes
    since = (t_ns - question.before.end_ns) if question.after else question.before.end_ns - t_ns
    rows["duration_s"], rows["frames"] = since / NS_PER_S, 0
    rows["additional"] = np.nan
    number = int(np.searchsorted([frame.t_ns for frame in samples], t_ns))
    sample = samples[number].rows[samples[number].rows["track_id"] == about.source_id][0]
    for axis in "xy":
        rows[f"{axis}_m"] = sample[f"{axis}_m"]
        rows[f"{axis}_px"] = sample[f"{axis}_px"] + sample[f"{'wh'['xy'.index(axis)]}_px"] / 2
    return t_ns, DECISIONS.check(rows)


def in_frames(answers: Sequence[tuple[int, Rows]]) -> list[Frame]:
    """Rows of answers at their times, as frames in order."""
    by_time: dict[int, list[Rows]] = {}
    for t_ns, rows in sorted(answers, key=lambda answer: answer[0]):
        by_time.setdefault(t_ns, []).append(rows)
    return [Frame(t_ns, number, DECISIONS.joined(rows)) for number, (t_ns, rows) in enumerate(by_time.items())]


def read_answers(opened: log.Log, prefix: str) -> list[tuple[int, Rows]]:
    """The answers in a log: the time and the row of each."""
    topic = f"{prefix}/{ANSWERS}"
    frames = opened.frame_columns(topic, DECISIONS) if topic in opened.channels else ()
    return [(frame.t_ns, frame.rows[number : number + 1]) for frame in frames for number in range(len(frame.rows))]
