"""Score the tracks and forecasts of a log, or of label files, against the truth.

Tracks are compared at the truth's times where the tracks have most of these; otherwise (tracks on the clock of
prediction) the truth is brought to the tracks' times. Impossible comparisons are said, never scored as zeros.

Letters: N rows, G true people, H tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError, command
from mcaptrack.evaluation import metrics
from mcaptrack.evaluation.aligned import (
    IOU_THRESHOLD,
    Similarity,
    align,
    matchup,
    strangers,
    without,
)
from mcaptrack.evaluation.forecasts import MADE_FROM, score_forecasts
from mcaptrack.evaluation.metrics import Rules, Score
from mcaptrack.evaluation.metrics.displacement import Displacement
from mcaptrack.evaluation.metrics.displacement import combine as combine_displacements
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at

COMBINED: Final = "COMBINED"
DEFAULT_GATES_M: Final = (0.5, 1.0, 2.0)
#: The channels of a camera that are scored, and those of the forecasts made from them.
SCORED: Final = ("tracks", "samples", "retracks/online", "retracks")
FORECASTS: Final = tuple(MADE_FROM)


@dataclass(frozen=True)
class EvaluateOptions:
    """What to compare and how. ``similarities`` empty means all that the data allow."""

    similarities: tuple[Similarity, ...] = ()
    gates_m: tuple[float, ...] = DEFAULT_GATES_M
    min_iou: float = IOU_THRESHOLD
    rules: Rules = "trackeval"
    topics: tuple[str, ...] = ()


@dataclass
class Candidate:
    """Tracks to be scored: where they come from, their frames, and forecasts made from them, if any."""

    name: str
    mode: str | None
    frames: Sequence[Frame]
    forecasts: Sequence[Frame] | None = None
    forecasts_name: str = ""
    group: str = ""  # what tracks of several sequences have in common, if not their name


@dataclass
class Sequenced:
    """One sequence: its truth and what is to be scored against it."""

    name: str
    truth: Sequence[Frame]
    candidates: Sequence[Candidate]


@dataclass
class Result:
    """One row of the outcome."""

    sequence: str
    tracks: str
    mode: str | None
    similarity: Similarity
    gate: float
    rules: Rules
    score: Score
    displacement: Displacement | None = None
    group: str = ""

    def to_json(self) -> dict[str, Any]:
        """As ``evaluate --json`` prints it."""
        names = ("sequence", "tracks", "mode", "similarity", "gate", "rules")
        out = {name: getattr(self, name) for name in names} | metrics.summary(self.score)
        if self.displacement is not None:
            recall, ade = self.displacement.curve()
            out["displacement"] = self.displacement.summary() | {
                "curve_recall": recall.tolist(),
                "curve_ADE_m": ade.tolist(),
            }
        return out


@dataclass
class Outcome:
    """All results, and what could not be compared and why."""

    results: list[Result] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def truth_of_log(opened: log.Log, prefix: str) -> list[Frame]:
    """The true tracks in a log. Raises McaptrackError if there are none."""
    topic = camera_at(opened, prefix).truth
    if topic not in opened.channels:
        add = command("ingest", "LABELS", "--as", "truth", "--into", opened.path)
        raise McaptrackError(f"{opened.path} has no channel {topic}; add one with {add}")
    return opened.frames(topic, TRACKS)


def sequence_of_log(opened: log.Log, prefix: str, topics: Sequence[str]) -> Sequenced:
    """The truth of a log and its tracks: those of the video's rate, and those of the clock of prediction."""
    truth = truth_of_log(opened, prefix)
    usual = [f"{prefix}/{name}" for name in SCORED]
    chosen = list(topics) or [topic for topic in usual if topic in opened.channels]
    if not chosen:
        raise McaptrackError(f"{opened.path} has no tracks to score; {command('run', opened.path)} makes them")
    forecasts_of = {f"{prefix}/{tracks}": f"{prefix}/{name}" for name, tracks in MADE_FROM.items()}
    candidates = []
    for topic in chosen:
        made = Provenance.from_metadata(opened.channel(topic).metadata)
        mode = None
        if made and made.transform == "retrack":
            mode = "online" if topic.endswith("/online") else "offline"
        name = forecasts_of.get(topic, "")
        forecasts = opened.frames(name, PREDICTIONS) if name in opened.channels else None
        candidates.append(Candidate(topic, mode, opened.frames(topic, TRACKS), forecasts, name))
    return Sequenced(opened.path.stem, truth, candidates)


def evaluate(
    sequences: Iterable[Sequenced], options: EvaluateOptions, progress: Callable[[str], None] = lambda _: None
) -> Outcome:
    """Score every candidate of every sequence, and all sequences together where there are several.

    Raises McaptrackError if nothing at all can be compared.
    """
    outcome = Outcome()
    count = 0
    for sequence in sequences:
        count += 1
        if not any(len(frame.rows) for frame in sequence.truth):
            raise McaptrackError(f"the truth of {sequence.name} holds nobody; there is nothing to score against")
        for candidate in sequence.candidates:
            progress(f"{sequence.name} {candidate.name}")
            outcome.results += _score(sequence, candidate, options, outcome.notes)
    if not outcome.results:
        raise McaptrackError("; ".join(outcome.notes) or "there is nothing to score")
    if count > 1:
        outcome.results += combined(outcome.results)
    return outcome


def combined(results: Sequence[Result]) -> list[Result]:
    """All sequences together: a result for each kind of tracks, similarity and gate."""
    groups: dict[tuple[Any, ...], list[Result]] = {}
    for one in results:
        groups.setdefault((one.group or one.tracks, one.mode, one.similarity, one.gate, one.rules), []).append(one)
    out = []
    for (tracks, mode, similarity, gate, rules), members in groups.items():
        forecasts = [member.displacement for member in members if member.displacement is not None]
        out.append(
            Result(
                COMBINED,
                tracks,
                mode,
                similarity,
                gate,
                rules,
                metrics.combine([member.score for member in members]),
                combine_displacements(forecasts) if len(forecasts) == len(members) else None,
            )
        )
    return out


def _score(sequence: Sequenced, candidate: Candidate, options: EvaluateOptions, notes: list[str]) -> list[Result]:
    truth, tracks = align(sequence.name, candidate.name, sequence.truth, candidate.frames)
    wanted = options.similarities or ("iou", "metres")
    results = []
    for similarity in wanted:
        lacking = without({"the truth": truth, candidate.name: tracks}, similarity)
        if lacking:
            unit = "boxes" if similarity == "iou" else "positions in metres"
            if options.similarities:
                raise McaptrackError(
                    f"{sequence.name}: {' and '.join(lacking)} {'have' if len(lacking) > 1 else 'has'} no {unit}"
                )
            continue
        gates = (options.min_iou,) if similarity == "iou" else options.gates_m
        for gate in gates:
            score = metrics.score(matchup(truth, tracks, similarity, gate), options.rules)
            if gate == gates[-1] and score.hota["HOTA_TP"][0] == 0:
                notes += strangers(sequence.name, candidate.name, truth, tracks, similarity)
            results.append(
                Result(
                    sequence.name,
                    candidate.name,
                    candidate.mode,
                    similarity,
                    gate,
                    options.rules,
                    score,
                    group=candidate.group,
                )
            )
    if not results:
        notes.append(f"{sequence.name}: {candidate.name} and the truth share neither boxes nor positions in metres")
    if candidate.forecasts is not None and any(result.similarity == "metres" for result in results):
        errors = score_forecasts(candidate.forecasts, candidate.frames, sequence.truth, candidate.forecasts_name)
        for result in results:
            result.displacement = errors if result.similarity == "metres" else None
    return results


def sequence_of_files(
    name: str, tracks: Path, truth_frames: Sequence[Frame], track_frames: Sequence[Frame], files: int
) -> Sequenced:
    """A file of tracks, one of ``files``, and its truth as one sequence."""
    group = f"{files} files" if files > 1 else ""
    return Sequenced(name, truth_frames, [Candidate(tracks.name, None, track_frames, group=group)])
