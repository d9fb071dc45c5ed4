"""Score the tracks and forecasts of a log, or of label files, against ground truth.

Tracks are compared at the times of the ground truth if they have most of these; otherwise (tracks at the prediction
rate) the ground truth is resampled to the times of the tracks. What can't be compared is reported, never scored as
zero.

Letters: N rows, G people of the ground truth, H tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation import metrics
from mcaptrack.evaluation.aligned import (
    GATE_3D_M,
    GATE_M,
    IOU_THRESHOLD,
    LocatedRows,
    RowComparison,
    align,
    are_3d,
    compare_rows,
    explain_no_match,
    has_positions,
    ids_of_class,
    of_class,
    refuse_sides_without,
    share_classes,
    sides_without,
    with_ids,
)
from mcaptrack.evaluation.forecasts import FORECAST_INPUTS, score_forecasts
from mcaptrack.evaluation.metrics import Rules, Score, ScoredMatchup, average_over_recalls
from mcaptrack.evaluation.metrics.displacement import Displacement, combine_displacements
from mcaptrack.geometry.arrays import Floats
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources.camera_motion import read_ground_truth
from mcaptrack.sources.cameras import camera_at
from mcaptrack.transforms import STAGES

__all__ = [
    "Candidate", "EvaluateOptions", "EvaluationInput", "EvaluationRow", "combined", "evaluate",
    "ground_truth_of_log", "sequence_of_log", "set_means",
]  # fmt: skip

COMBINED: Final = "COMBINED"
DEFAULT_GATES_M: Final = (0.5, 1.0, 2.0)
#: The channels of a camera that are scored, and the channels of forecasts made from them.
SCORED: Final = ("tracks", "samples", "retracks/online", "retracks")
#: One more channel of 3D boxes: re-tracked, at the rate of the boxes.
FULL: Final = "retracks/full"
FORECASTS: Final = tuple(FORECAST_INPUTS)


@dataclass(frozen=True)
class EvaluateOptions:
    """The options of a comparison.

    Parameters
    ----------
    similarities : tuple of {"iou", "metres", "bev-iou", "3d-iou"}
        By overlap of boxes in pictures, by distance on the ground, by overlap of oriented boxes on the ground (bird's
        eye view) or in space. Empty: the first two, as far as the data allow.
    gates_m : tuple of float, m
        The largest distances of a match, for "metres".
    min_iou : float
        The least overlap of a match, for the similarities that are overlaps.
    rules : {"trackeval", "motmetrics"}
        Rules of CLEAR, see `mcaptrack.evaluation.metrics`.
    topics : tuple of str
        The channels to score. Empty: all tracks of the camera.
    """

    similarities: tuple[Similarity, ...] = ()
    gates_m: tuple[float, ...] = DEFAULT_GATES_M
    min_iou: float = IOU_THRESHOLD
    rules: Rules = "trackeval"
    topics: tuple[str, ...] = ()


@dataclass
class Candidate:
    """Tracks to be scored: their name and frames, and the forecasts made from them, if any.

    ``mode`` is "online" or "offline" for re-tracked ones, None for others. ``group`` is a name shared by the tracks of
    several sequences, if theirs differ; ``classes`` are the names of the classes in the rows, by class id.
    """

    name: str
    mode: str | None
    frames: Sequence[Frame]
    forecasts: Sequence[Frame] | None = None
    forecasts_name: str = ""
    group: str = ""  # a name shared by the tracks of several sequences, if theirs differ
    classes: Mapping[int, str] = field(default_factory=dict)  # names of the classes in the rows


class Labelled(NamedTuple):
    """Which frames of the ground truth were labelled, as ``--frames`` names them, None for all of them; and how that is
    known: by "frames" (the option), by the "file", or assumed by its first and last "labels".
    """

    frames: str | None = None
    by: str | None = None


@dataclass
class EvaluationInput:
    """One sequence: its ground truth and the tracks to be scored against it.

    ``name`` is that of the sequence. ``candidates`` are those tracks; ``classes`` are the names of the classes of the
    ground truth by class id, and ``labelled`` says which of its frames were labelled.
    """

    name: str
    ground_truth: Sequence[Frame]
    candidates: Sequence[Candidate]
    classes: Mapping[int, str] = field(default_factory=dict)  # names of the classes of the ground truth
    labelled: Labelled = Labelled()


# Scores of 3D tracks averaged over recalls (AMOTA, sAMOTA), with the scores of tracks that they need.
#
# Letters: N rows, H tracks.


#: The similarity of a recall that is not reached: a distance at the gate, no overlap.
_WORST: Final[dict[Similarity, float]] = {"metres": 0.5}
_AMOTP: Final = "AMOTP"


def scored_matchups(compared: RowComparison) -> tuple[ScoredMatchup, ...]:
    """A comparison with the scores of its tracks; none if no track has any."""
    score = _track_scores(compared.tracks)
    has_score = np.isfinite(score)
    if len(score) and not has_score.any():
        return ()
    return (ScoredMatchup(compared.matchup, np.where(has_score, score, score[has_score].min(initial=0.0))),)


def _track_scores(tracks: LocatedRows) -> Floats:
    """The mean score of the boxes of each track (H,), of those that a detection stands behind if there are any."""
    count, score = len(tracks.ids), tracks.rows["score"].astype(float)
    out = np.full(count, np.nan)
    for used in (np.isfinite(score), np.isfinite(score) & tracks.rows["observed"]):
        of, rows = tracks.track[used], np.bincount(tracks.track[used], minlength=count)
        total = np.bincount(of, score[used], minlength=count)
        out[rows > 0] = total[rows > 0] / rows[rows > 0]
    return out


def averages(parts: Sequence[ScoredMatchup], similarity: Similarity, gate: float, rules: Rules) -> dict[str, float]:
    """The averages over recalls of one class, in all sequences; AMOTP is a distance (AMOTP_m) or an overlap."""
    means = average_over_recalls(parts, rules, _WORST.get(similarity, 0.0))
    if similarity == "metres":
        means["AMOTP_m"] = 2 * gate * (1 - means.pop(_AMOTP))
    return means


def mean_of_classes(of_classes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The averages of all classes together: their means over classes, as nuScenes gives them."""
    return {name: float(np.mean([row[name] for row in of_classes])) for name in (of_classes[0] if of_classes else ())}


@dataclass
class EvaluationRow:
    """The scores of one channel of tracks, for one similarity and gate.

    ``of_class`` is the class that is scored, None for all together. Counts of all together are the sums over classes;
    ``class_means`` are then the means of rates over classes, as TrackEval gives them ("class averaged"). ``averages``
    are scores averaged over recalls (AMOTA), of 3D tracks (``is_3d``) with scores; ``scored`` are the matchups that
    they are from.

    ``sequence``, ``mode`` and ``group`` are as for ``EvaluationInput`` and ``Candidate``; ``rules`` are those of
    "trackeval" or "motmetrics"; ``displacement`` are the errors of forecasts, None without any.
    """

    sequence: str
    tracks: str
    mode: str | None
    similarity: Similarity
    gate: float
    rules: Rules
    score: Score
    displacement: Displacement | None = None
    group: str = ""
    of_class: str | None = None
    class_means: Mapping[str, float] | None = None
    is_3d: bool = False
    scored: tuple[ScoredMatchup, ...] = field(default=(), repr=False)
    averages: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The row as ``evaluate --json`` prints it."""
        names = ("sequence", "tracks", "mode", "similarity", "gate", "rules")
        out = {name: getattr(self, name) for name in names}
        out |= {"class": self.of_class} | metrics.summary(self.score) | dict(self.averages)
        if self.class_means is not None:
            out["class_means"] = dict(self.class_means)
        if self.displacement is not None:
            recall, ade = self.displacement.curve()
            out["displacement"] = self.displacement.summary() | {
                "constant_velocity": self.displacement.constant_velocity(),
                "reliability": self.displacement.reliability(),
                "curve_recall": recall.tolist(),
                "curve_ADE_m": ade.tolist(),
                "curve_ADE_squared_m2": self.displacement.curve(squared=True)[1].tolist(),
            }
        return out


@dataclass
class EvaluationResult:
    """All scores, and notes on what could not be compared and why."""

    results: list[EvaluationRow] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def ground_truth_of_log(opened: log.Log, prefix: str) -> list[Frame]:
    """The frames of the ground truth of a camera. Raises McaptrackError if there is none."""
    topic = camera_at(opened, prefix).truth
    if topic not in opened.channels:
        add = call("ingest", "LABELS", role="truth", into=opened.path)
        raise McaptrackError(f"{opened.path} has no channel {topic}; add one with {add}")
    return read_ground_truth(opened, prefix)


def sequence_of_log(opened: log.Log, prefix: str, topics: Sequence[str]) -> EvaluationInput:
    """The ground truth of a camera and its tracks, at the video rate and at the prediction rate.

    ``topics`` are the tracks, by default those that the camera usually has. Raises McaptrackError if the log has no
    ground truth, or no tracks.
    """
    ground_truth = ground_truth_of_log(opened, prefix)
    names_of_usual = (*SCORED, FULL) if has_positions(ground_truth, "bev-iou") else SCORED
    usual = [f"{prefix}/{name}" for name in names_of_usual]
    chosen = [*dict.fromkeys(opened.find(topic, prefix) for topic in topics)] or [
        topic for topic in usual if topic in opened.channels
    ]
    if not chosen:
        makes = f"{call('run', opened.path)} makes them of pictures or detections"
        adds = call("ingest", "LABELS", role="tracks", into=opened.path)
        raise McaptrackError(f"{opened.path} has no tracks to score; {makes}, {adds} takes them from a file")
    forecasts_of = {f"{prefix}/{tracks}": f"{prefix}/{name}" for name, tracks in FORECAST_INPUTS.items()}
    candidates = []
    for topic in chosen:
        provenance = Provenance.from_metadata(opened.channel(topic).metadata)
        mode = None
        if provenance and provenance.transform in STAGES and STAGES[provenance.transform].repairs_tracks:
            mode = "online" if topic.endswith("/online") else "offline"
        name = forecasts_of.get(topic) or _own_forecasts(opened, topic)
        forecasts = opened.frames(name, PREDICTIONS) if name in opened.channels else None
        names = class_names(opened.channel(topic).metadata)
        candidates.append(Candidate(topic, mode, opened.frames(topic, TRACKS), forecasts, name, classes=names))
    metadata = opened.channel(camera_at(opened, prefix).truth).metadata
    how = Provenance.from_metadata(metadata)
    parameters = how.parameters if how is not None and how.transform == INGEST else {}
    labelled = Labelled(parameters.get("frames"), parameters.get("frames_by"))
    return EvaluationInput(opened.path.stem, ground_truth, candidates, class_names(metadata), labelled)


def _own_forecasts(opened: log.Log, topic: str) -> str:
    """The forecasts that a user has written beside tracks, without samples that they could be of; "" if none."""
    above = topic.rpartition("/")[0]
    samples, forecasts = f"{above}/{FORECAST_INPUTS['predictions']}", f"{above}/predictions"
    channel = opened.channels.get(forecasts)
    how = Provenance.from_metadata(channel.metadata) if channel else None
    return forecasts if how is not None and how.written_by and samples not in opened.channels else ""


def evaluate(
    sequences: Iterable[EvaluationInput], options: EvaluateOptions, progress: Callable[[str], None] = lambda _: None
) -> EvaluationResult:
    """Score each candidate of each sequence, and all sequences together if there are several.

    Parameters
    ----------
    sequences : iterable of EvaluationInput
    options : EvaluateOptions
    progress : callable
        Called with a text before each candidate.

    Returns
    -------
    EvaluationResult

    Raises
    ------
    McaptrackError
        If nothing at all can be compared.
    """
    outcome = EvaluationResult()
    count = 0
    for sequence in sequences:
        count += 1
        if not any(len(frame.rows) for frame in sequence.ground_truth):
            raise McaptrackError(f"the ground truth of {sequence.name} is empty; there is nothing to score against")
        for candidate in sequence.candidates:
            progress(f"{sequence.name} {candidate.name}")
            outcome.results += _score(sequence, candidate, options, outcome.notes)
    if not outcome.results:
        raise McaptrackError("; ".join(outcome.notes) or "there is nothing to score")
    if count > 1:
        outcome.results += combined(outcome.results)
    set_means(outcome.results)
    return outcome


def set_means(results: Sequence[EvaluationRow]) -> None:
    """Set averages over recalls, and ``class_means`` of rows of all classes together, where there are several.

    ``results`` are the rows of all sequences; they are changed.
    """
    for row in results:
        if row.scored:
            row.averages = averages(row.scored, row.similarity, row.gate, row.rules)
    groups: dict[tuple[Any, ...], list[EvaluationRow]] = {}
    for row in results:
        groups.setdefault((row.sequence, row.tracks, row.mode, row.similarity, row.gate, row.rules), []).append(row)
    for members in groups.values():
        rates = [metrics.summary(member.score) for member in members if member.of_class is not None]
        of_classes = [member.averages for member in members if member.of_class is not None and member.averages]
        for row in members:
            if row.of_class is None and rates:
                row.class_means = {name: float(np.mean([rate[name] for rate in rates])) for name in metrics.RATES}
                row.averages = mean_of_classes(of_classes)


def combined(results: Sequence[EvaluationRow]) -> list[EvaluationRow]:
    """Combine all sequences: a row for each kind of tracks, similarity and gate.

    ``results`` are the rows of all sequences.
    """
    groups: dict[tuple[Any, ...], list[EvaluationRow]] = {}
    for row in results:
        key = (row.group or row.tracks, row.mode, row.similarity, row.gate, row.rules, row.of_class)
        groups.setdefault(key, []).append(row)
    out = []
    for members in groups.values():
        first = members[0]
        forecasts = [member.displacement for member in members if member.displacement is not None]
        scored = [part for member in members for part in member.scored] if all(m.scored for m in members) else []
        out.append(
            EvaluationRow(
                COMBINED,
                first.group or first.tracks,
                first.mode,
                first.similarity,
                first.gate,
                first.rules,
                metrics.combine([member.score for member in members]),
                combine_displacements(forecasts) if len(forecasts) == len(members) else None,
                of_class=first.of_class,
                is_3d=all(member.is_3d for member in members),
                scored=tuple(scored),
            )
        )
    return out


def _score(
    sequence: EvaluationInput, candidate: Candidate, options: EvaluateOptions, notes: list[str]
) -> list[EvaluationRow]:
    aligned = align(sequence.name, candidate.name, sequence.ground_truth, candidate.frames)
    shared = share_classes(sequence.name, candidate.name, *aligned, sequence.classes, candidate.classes)
    notes += shared.notes
    ground_truth, tracks = shared.ground_truth, shared.tracks
    parts = {name: (of_class(ground_truth, number), of_class(tracks, number)) for number, name in shared.names.items()}
    wanted = options.similarities or ("iou", "metres")
    is_3d = are_3d(ground_truth, tracks)
    results = []
    for similarity in wanted:
        sides = {"the ground truth": ground_truth, candidate.name: tracks}
        if options.similarities:
            refuse_sides_without(f"{sequence.name}: ", sides, similarity)
        elif sides_without(sides, similarity):
            continue
        gates = options.gates_m if similarity == "metres" else (options.min_iou,)
        for gate in gates:
            compared: dict[str | None, RowComparison]
            compared = {name: compare_rows(*part, similarity, gate) for name, part in parts.items()}
            compared = compared or {None: compare_rows(ground_truth, tracks, similarity, gate)}
            scores = {name: metrics.score(part.matchup, options.rules) for name, part in compared.items()}
            whole = scores.pop(None, None) or metrics.combine(list(scores.values()))
            is_averaged = is_3d and gate == max(gates)
            scored = {name: scored_matchups(part) for name, part in compared.items()} if is_averaged else {}
            if gate == gates[-1] and whole.hota["HOTA_TP"][0] == 0:
                notes += explain_no_match(sequence.name, candidate.name, ground_truth, tracks, similarity)
            key = sequence.name, candidate.name, candidate.mode, similarity, gate, options.rules
            for name, score in ((None, whole), *scores.items()):
                row = EvaluationRow(*key, score, group=candidate.group, of_class=name, is_3d=is_3d)
                row.scored = scored.get(name, ())
                results.append(row)
    if is_3d and results and not any(row.averages or row.scored for row in results):
        notes.append(f"{sequence.name}: {candidate.name} has no scores; there is no AMOTA and no sAMOTA")
    if not results:
        notes.append(
            f"{sequence.name}: {candidate.name} and the ground truth share neither boxes nor positions in metres"
        )
    if candidate.forecasts is not None and any(result.similarity == "metres" for result in results):
        errors = _forecast_scores(sequence, candidate, candidate.forecasts, parts)
        for result in results:
            result.displacement = errors.get(result.of_class) if result.similarity == "metres" else None
    return results


def _forecast_scores(
    sequence: EvaluationInput, candidate: Candidate, forecasts: Sequence[Frame], classes: Collection[str]
) -> dict[str | None, Displacement | None]:
    """The errors of all forecasts, under None, and of those of each class, by its name."""
    name, ground_truth, tracks = candidate.forecasts_name, sequence.ground_truth, candidate.frames
    out: dict[str | None, Displacement | None] = {None: score_forecasts(forecasts, tracks, ground_truth, name)}
    # At their own times, unlike the rows that tracks are scored by.
    shared = share_classes(sequence.name, name, ground_truth, tracks, sequence.classes, candidate.classes)
    for number, class_name in shared.names.items() if classes else ():
        ids = ids_of_class(shared.tracks, number)
        parts = (with_ids(forecasts, ids), with_ids(shared.tracks, ids), of_class(shared.ground_truth, number))
        out[class_name] = score_forecasts(*parts, name)
    return out


def sequence_of_files(
    name: str,
    tracks: Path,
    truth_frames: Sequence[Frame],
    track_frames: Sequence[Frame],
    files: int,
    classes: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {}),
    labelled: tuple[str | None, str | None] = (None, None),
) -> EvaluationInput:
    """One of ``files`` files of tracks, with its ground truth, as a sequence.

    ``classes`` are the names of the classes of the ground truth and of the tracks, ``labelled`` says which frames were
    labelled.
    """
    group = f"{files} files" if files > 1 else ""
    candidate = Candidate(tracks.name, None, track_frames, group=group, classes=classes[1])
    return EvaluationInput(name, truth_frames, [candidate], classes[0], Labelled(*labelled))


#: Similarities that are overlaps, as text.
_OVERLAPS: Final = {"iou": "IoU", "bev-iou": "BEV IoU", "3d-iou": "3D IoU"}
#: A smaller difference of errors, as a share, is no difference.
_ALIKE: Final = 0.01


def main_results(results: Sequence[EvaluationRow]) -> list[EvaluationRow]:
    """Choose the results of one similarity and gate.

    Parameters
    ----------
    results : sequence of EvaluationRow
        At least one.

    Returns
    -------
    list of EvaluationRow
        Those by distance on the ground where there are any, at the gate that is nearest to 1 m, for 3D boxes to 2 m.
    """
    by_distance = [result for result in results if result.similarity == "metres"]
    if not by_distance:
        first: Similarity = results[0].similarity
        return [result for result in results if result.similarity == first]
    usual_m = GATE_3D_M if all(result.is_3d for result in by_distance) else GATE_M
    gate_m = min((result.gate for result in by_distance), key=lambda gate: abs(gate - usual_m))
    return [result for result in by_distance if result.gate == gate_m]


def gate_text(result: EvaluationRow) -> str:
    """The gate of a result: "1 m" or "IoU 0.5"."""
    overlap = _OVERLAPS.get(result.similarity)
    return f"{overlap} {result.gate:g}" if overlap else f"{result.gate:g} m"


def matched_by(result: EvaluationRow) -> str:
    """The rule by which tracks match ground truth: "within 1 m" or "with IoU 0.5"."""
    return f"{'with' if result.similarity in _OVERLAPS else 'within'} {gate_text(result)}"


def verdict(results: Sequence[EvaluationRow]) -> list[str]:
    """Say in a few lines what the main results are: identities, and forecasts beside constant velocity.

    Parameters
    ----------
    results : sequence of EvaluationRow
        At least one.

    Returns
    -------
    list of str
    """
    of_all = [result for result in main_results(results) if result.of_class is None]
    whole = [result for result in of_all if result.sequence == COMBINED]
    together = f"{len({result.sequence for result in of_all}) - 1} sequences together, " if whole else ""
    whole = whole or of_all
    lines = [f"{together}{matched_by(whole[0])}: {_identities(whole)}"]
    return lines + [_forecasts(row.tracks, row.displacement) for row in whole if row.displacement is not None]


def _identities(rows: Sequence[EvaluationRow]) -> str:
    samples = STAGES["retrack"].input_topic
    before = next((row for row in rows if row.tracks.endswith(f"/{samples}")), None)
    after = next((row for row in rows if row.mode == "offline"), None)
    if before is not None and after is not None:
        (was, switches), (now, left) = _scores(before), _scores(after)
        return f"IDF1 {100 * was:.1f} -> {100 * now:.1f}, identity switches {switches} -> {left}" + (
            "; re-tracking made it worse" if now < was else ""
        )
    best = max(rows, key=lambda row: _scores(row)[0])
    idf1, switches = _scores(best)
    text = f"IDF1 {100 * idf1:.1f}, identity switches {switches}"
    return text if len(rows) == 1 else f"{text} ({best.tracks}, the best of {len(rows)})"


def _scores(row: EvaluationRow) -> tuple[float, int]:
    """IDF1 as a share, and identity switches."""
    values = row.to_json()
    return values["IDF1"], values["IDSW"]


def _forecasts(tracks: str, displacement: Displacement) -> str:
    own, straight = displacement.summary()["FDE_m"], displacement.constant_velocity()["FDE_m"]
    if own is None or straight is None:
        return f"forecasts of {tracks}: none can be compared with the ground truth"
    text = f"forecasts of {tracks} end {own:.2f} m off, constant velocity {straight:.2f} m"
    if own > (1 + _ALIKE) * straight:
        return f"{text}: they don't help here"
    return text if own < (1 - _ALIKE) * straight else f"{text}: they help little here"
