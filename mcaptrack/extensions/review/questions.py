"""The questions about identities with the largest expected change, and the rows of their answers.

What is not sure is what differs between worlds: re-tracking decided again with noise (``retrack --worlds``). A question
is worth the probability that its answer is another one than was decided, times the rows that would change.

Letters: W worlds, K tracklets, E pairs of tracklets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Final

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.schema import DECISIONS, TRACKS, WORLDS, DecisionKind, Frame, Rows
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.sources.cameras import provenance_of
from mcaptrack.sources.corrections import ANSWERS
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.retrack.options import LikelihoodOptions

#: The worlds that questions are found in.
_WORLDS: Final = 100
#: Answers that are less likely to change anything are not asked for.
_LEAST: Final = 0.5


#: The samples that a question is about: track and time before a gap (-1 if none is), and after it.
Key = tuple[int, int, int, int]


@dataclass(frozen=True)
class Tracklet:
    """A certain part of a track: its id in the input of re-tracking, and its first and last samples."""

    source_id: int
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Question:
    """A question: whether ``after`` goes on from the end of ``before``, or, without ``before``, whether it is a person.

    ``probability`` is that of yes, ``decided`` what re-tracking has decided, and ``rows`` what changes otherwise.
    """

    before: Tracklet | None
    after: Tracklet
    probability: float
    decided: bool
    rows: int

    @property
    def key(self) -> Key:
        """The samples that it is about: the same question has the same key, also after other answers."""
        end = (self.before.source_id, self.before.end_ns) if self.before else (-1, self.after.begin_ns)
        return *end, self.after.source_id, self.after.begin_ns

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
        again = call("retrack", opened.path, retracker="likelihood", force=True)
        raise McaptrackError(
            f"{opened.path}: {topic} was made by a method that knows no probabilities; {again} takes one that does"
        )
    frames, context = pipeline.input_of(opened, prefix, "retrack", transform, how.input)
    given = {} if answers is None else {"answers": answers}
    transform = replace(transform, **context | given, worlds=_WORLDS)
    if transform.leaves_unchanged:
        raise McaptrackError(f"{opened.path}: without a measured ground plane {prefix} has no decisions to review")
    outputs = dict(zip(transform.writes, zip(*transform(frames), strict=True), strict=True))
    return Solved(frames, outputs[""], outputs["decisions"], outputs["worlds"])


def questions(solved: Solved, answered: Sequence[Frame], count: int) -> list[Question]:
    """The most valuable questions, the best first, without those that a person answered; the same for the same log."""
    worlds = join_frames(WORLDS, solved.worlds)
    if not len(worlds.rows):
        return []
    order = np.lexsort((worlds.rows["source_id"], worlds.row_ns, worlds.rows["world"]))
    track = worlds.rows["track_id"][order].reshape(int(worlds.rows["world"].max()), -1)
    first = order[: track.shape[1]]
    rows, begins = worlds.rows[first], worlds.row_ns[first]
    tracks = join_frames(TRACKS, solved.tracks)
    at = find_rows((tracks.row_ns, tracks.rows["source_id"]), (begins, rows["source_id"]))
    decided = -1 - np.arange(len(at))  # those left out have no other's
    decided[at >= 0] = tracks.rows["track_id"][at[at >= 0]]
    is_certain = np.isin(join_frames(DECISIONS, answered).rows["probability"], (0, 1))
    done = {*compress(keys_of(answered), is_certain)}
    asked = _asked(track, decided, _tracklets(solved.samples, rows, begins), rows["frames"].astype(np.int64))
    out: list[Question] = []
    ends: set[tuple[int, ...]] = set()
    for question in sorted(asked, key=lambda question: (-question.value, question.key)):
        before, end_ns, after, begin_ns = question.key
        exchange = (*sorted([before, after]), begin_ns)
        sides = {(before, end_ns), (after, begin_ns, 1), exchange} if question.before else set()
        if question.key in done or question.value < _LEAST or sides & ends:
            continue  # one for each end, each beginning and each exchange: the others follow from its answer
        out.append(question)
        ends |= sides
    return out[:count]


def _tracklets(samples: Sequence[Frame], rows: Rows, begins: Ints) -> list[Tracklet]:
    """The tracklets of worlds, with the times of their last samples: durations are in steps, which may jitter."""
    joined = join_frames(TRACKS, samples)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    order = order[joined.rows["observed"][order]]
    ids, t_ns = joined.rows["track_id"][order], joined.row_ns[order]
    last = find_rows((ids, t_ns), (rows["source_id"], begins)) + rows["frames"] - 1
    last = np.minimum(last, np.searchsorted(ids, rows["source_id"], "right") - 1)
    columns = rows["source_id"].tolist(), begins.tolist(), t_ns[last].tolist()
    return [Tracklet(*values) for values in zip(*columns, strict=True)]


def _asked(track: Ints, decided: Ints, tracklets: Sequence[Tracklet], frames: Ints) -> Iterator[Question]:
    """Yield a question for each tracklet, and for each two that follow each other in a world (W, K), or as decided."""
    people = (track >= 0).mean(axis=0), decided >= 0, frames
    for after, *values in zip(tracklets, *(column.tolist() for column in people), strict=True):
        yield Question(None, after, *values)
    begins = np.array([tracklet.begin_ns for tracklet in tracklets])
    a, b = np.unique(np.concatenate([_following(of, begins) for of in (decided, *track)], axis=1), axis=1)
    order = np.lexsort((begins, decided))
    total, of = np.cumsum(frames[order]), decided[order]
    up_to, since = np.empty_like(frames), np.empty_like(frames)  # samples of its track, each with its own
    up_to[order] = total - (total - frames[order])[np.searchsorted(of, of)]
    since[order] = total[np.searchsorted(of, of, "right") - 1] - total + frames[order]
    together = ((track[:, a] == track[:, b]) & (track[:, a] >= 0)).mean(axis=0)
    pairs = a, b, together, decided[a] == decided[b], np.minimum(up_to[a], since[b])
    for before, after, *values in zip(*(column.tolist() for column in pairs), strict=True):
        yield Question(tracklets[before], tracklets[after], *values)


def _following(track: Ints, begins: Ints) -> Ints:
    """Pairs (2, E) of tracklets that follow each other in a track (K,)."""
    order = np.lexsort((begins, track))
    same = np.flatnonzero(track[order][1:] == track[order][:-1])
    return np.stack([order[same], order[same + 1]])


def read_answers(opened: log.Log, prefix: str) -> Sequence[Frame]:
    """The answers in a log."""
    topic = f"{prefix}/{ANSWERS}"
    return opened.frame_columns(topic, DECISIONS) if topic in opened.channels else ()


def name_of(key: Key, start_ns: int) -> str:
    """The name of a question, with seconds since the start of the log."""
    ends = [f"{track}@{(t_ns - start_ns) / NS_PER_S:.3f}" for track, t_ns in (key[:2], key[2:])]
    return ends[1] if key[0] < 0 else "-".join(ends)


def keys_of(answers: Sequence[Frame]) -> list[Key]:
    """The key of the question that each row of answers is about (``Question.key``)."""
    joined = join_frames(DECISIONS, answers)
    gap_ns = np.round(joined.rows["duration_s"] * NS_PER_S).astype(np.int64)
    columns = joined.rows["previous_id"], joined.row_ns - gap_ns, joined.rows["source_id"], joined.row_ns
    return [*zip(*(column.tolist() for column in columns), strict=True)]


def with_answers(
    answers: Sequence[Frame], new: Sequence[tuple[Key, float | None]], samples: Sequence[Frame]
) -> list[Frame]:
    """``answers`` with new ones in place of those to the same questions: the probability of yes, or None for none."""
    again = {key for key, _ in new}
    earlier, seen = join_frames(DECISIONS, answers), join_frames(TRACKS, samples)
    kept = np.array([key not in again for key in keys_of(answers)], bool)
    keys = [key for key, yes in new if yes is not None]
    before, end_ns, after, t_ns = np.array(keys, np.int64).reshape(-1, 4).T
    at = seen.rows[find_rows((seen.row_ns, seen.rows["track_id"]), (t_ns, after))]
    rows = DECISIONS.rows(
        kind=np.where(before < 0, DecisionKind.KEPT, DecisionKind.JOINED),
        track_id=np.full(len(at), -1),
        alternative_id=np.full(len(at), -1),
        previous_id=before,
        source_id=after,
        probability=[yes for _, yes in new if yes is not None],
        duration_s=(t_ns - end_ns) / NS_PER_S,
        frames=np.zeros(len(at), np.int64),
        x_m=at["x_m"],
        y_m=at["y_m"],
        x_px=at["x_px"] + at["w_px"] / 2,
        y_px=at["y_px"] + at["h_px"] / 2,
    )
    times = np.concatenate([earlier.row_ns[kept], t_ns])
    order = np.argsort(times, kind="stable")
    rows, steps = DECISIONS.joined([earlier.rows[kept], rows])[order], np.unique(times)
    return split_rows(steps.tolist(), range(len(steps)), rows, np.searchsorted(times[order], steps, "right"))
