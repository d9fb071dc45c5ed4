"""Score the tracks and forecasts of a log, or of label files, against the truth.

Tracks are compared at the truth's times where the tracks have most of these; otherwise (tracks on the clock of
prediction) the truth is brought to the tracks' times. Impossible comparisons are said, never scored as zeros.

Letters: N rows, G true people, H tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log, metrics
from mcaptrack.boxes import columns_to_boxes, iou_of_pairs
from mcaptrack.clock import NS_PER_S, seconds_to_ns
from mcaptrack.errors import McaptrackError
from mcaptrack.metrics import Matchup, Rules, Score
from mcaptrack.metrics.displacement import Displacement, Forecasts, displacement
from mcaptrack.metrics.displacement import Path as Positions
from mcaptrack.metrics.displacement import combine as combine_displacements
from mcaptrack.provenance import Provenance
from mcaptrack.resample import looked_at, resample
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Similarity = Literal["iou", "metres"]

SCHEMA_VERSION: Final = 1
COMBINED: Final = "COMBINED"
IOU_THRESHOLD: Final = 0.5
DEFAULT_GATES_M: Final = (0.5, 1.0, 2.0)
#: The truth is interpolated over no longer hole than this.
_MAX_HOLE_S: Final = 2.0
#: Sizes that differ by more than this factor, where nothing ever meets, are in different units.
_OTHER_UNIT: Final = 8.0
#: Positions further apart than twice this have nothing to do with each other.
_FAR_M: Final = 5.0
#: How many pairs of boxes are compared in one go, to bound the memory that takes.
_PAIRS_AT_ONCE: Final = 1_000_000
_MODES: Final = {"online": "online", "": "offline"}
#: The channels of a camera that are scored, and those of the forecasts made from them.
SCORED: Final = ("tracks", "samples", "retracks/online", "retracks")
FORECASTS: Final = ("predictions", "retracks/predictions")


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
    topic = f"{prefix}/truth"
    if topic not in opened.channels:
        raise McaptrackError(
            f"{opened.path} has no channel {topic}; "
            f"add one with `mcaptrack ingest FILE --as truth --into {opened.path}`"
        )
    return opened.frames(topic, TRACKS)


def sequence_of_log(opened: log.Log, prefix: str, topics: Sequence[str]) -> Sequenced:
    """The truth of a log and its tracks: those of the video's rate, and those of the clock of prediction."""
    truth = truth_of_log(opened, prefix)
    usual = [f"{prefix}/{name}" for name in SCORED]
    chosen = list(topics) or [topic for topic in usual if topic in opened.channels]
    if not chosen:
        raise McaptrackError(f"{opened.path} has no tracks to score; run `mcaptrack run {opened.path}`")
    forecasts_of = {
        f"{prefix}/samples": f"{prefix}/predictions",
        f"{prefix}/retracks/online": f"{prefix}/retracks/predictions",
    }
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
        outcome.results += _combined(outcome.results)
    return outcome


def _combined(results: Sequence[Result]) -> list[Result]:
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
    truth, tracks = _aligned(sequence, candidate)
    wanted = options.similarities or ("iou", "metres")
    results = []
    for similarity in wanted:
        column = "x_px" if similarity == "iou" else "x_m"
        sides = {"the truth": truth, candidate.name: tracks}
        without = [
            name for name, frames in sides.items() if not _has(frames, column) and any(len(f.rows) for f in frames)
        ]
        if without:
            unit = "boxes" if similarity == "iou" else "positions in metres"
            if options.similarities:
                raise McaptrackError(
                    f"{sequence.name}: {' and '.join(without)} {'have' if len(without) > 1 else 'has'} no {unit}"
                )
            continue
        gates = (options.min_iou,) if similarity == "iou" else options.gates_m
        for gate in gates:
            score = metrics.score(matchup(truth, tracks, similarity, gate), options.rules)
            if gate == gates[-1] and score.hota["HOTA_TP"][0] == 0:
                notes += _strangers(sequence, candidate, truth, tracks, similarity)
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
        errors = _displacement(sequence, candidate)
        for result in results:
            result.displacement = errors if result.similarity == "metres" else None
    return results


def _strangers(
    sequence: Sequenced, candidate: Candidate, truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity
) -> list[str]:
    """Words on tracks that never come near anybody. Raises McaptrackError if that is because units differ."""
    both = {f"the truth of {sequence.name}": truth, candidate.name: tracks}
    if not all(any(len(frame.rows) for frame in frames) for frames in both.values()):
        return []
    if similarity == "iou":
        alike = matchup(truth, tracks, "iou", IOU_THRESHOLD)
        sizes = [float(np.nanmedian(np.concatenate([f.rows["h_px"] for f in frames]))) for frames in both.values()]
        what, unit = "boxes", "px high"
    else:
        alike = matchup(truth, tracks, "metres", _FAR_M)
        spans = [np.concatenate([_xy(f.rows) for f in frames]) for frames in both.values()]
        sizes = [float(np.nanmedian(np.abs(xy - np.nanmedian(xy, axis=0)))) for xy in spans]
        what, unit = "positions", "m from their middle"
    if len(alike.pairs.frame):
        return []
    small, large = sorted(sizes)
    if large > _OTHER_UNIT * max(small, 1e-9):
        (a, b), (m, n) = both, sizes
        raise McaptrackError(
            f"{what} of {a} are {m:.3g} {unit}, those of {b} {n:.3g}, and none ever meet: they are not in the same unit"
        )
    return [f"{sequence.name}: {candidate.name} and the truth never come near each other"]


def _has(frames: Sequence[Frame], column: str) -> bool:
    return any(np.isfinite(frame.rows[column]).any() for frame in frames)


def _aligned(sequence: Sequenced, candidate: Candidate) -> tuple[list[Frame], list[Frame]]:
    """Truth and tracks at the same times. Raises McaptrackError if they never overlap."""
    truth_ns = np.array([frame.t_ns for frame in sequence.truth], np.int64)
    tracks_ns = np.array([frame.t_ns for frame in candidate.frames], np.int64)
    by_time = {frame.t_ns: frame for frame in candidate.frames}
    if 2 * np.isin(truth_ns, tracks_ns).sum() >= len(truth_ns):
        empty = TRACKS.empty()
        return list(sequence.truth), [by_time.get(f.t_ns, Frame(f.t_ns, f.index, empty)) for f in sequence.truth]
    kept = looked_at(truth_ns, tracks_ns, seconds_to_ns(_MAX_HOLE_S))
    if not kept.any():
        raise McaptrackError(
            f"{sequence.name}: the truth ({_span(truth_ns)}) and {candidate.name} ({_span(tracks_ns)}) "
            "never overlap in time"
        )
    at_ns = np.unique(tracks_ns[kept])
    return _resampled(sequence.truth, at_ns), [by_time[t_ns] for t_ns in at_ns.tolist()]


def _span(t_ns: Ints) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} to {t_ns[-1] / NS_PER_S:.3f} s" if len(t_ns) else "no frames"


def _resampled(frames: Sequence[Frame], at_ns: Ints) -> list[Frame]:
    out, at = resample(frames, at_ns, seconds_to_ns(_MAX_HOLE_S))
    ends = np.searchsorted(at, np.arange(len(at_ns)), "right").tolist()
    spans = zip(at_ns.tolist(), [0, *ends][:-1], ends, strict=True)
    return [Frame(t_ns, index, out[low:high]) for index, (t_ns, low, high) in enumerate(spans)]


def _xy(rows: Rows) -> Floats:
    return np.stack([rows["x_m"], rows["y_m"]], axis=-1)


def matchup(truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity, gate: float) -> Matchup:
    """Truth and tracks at the same times as a matchup: boxes by overlap, or positions by distance."""
    column = "x_px" if similarity == "iou" else "x_m"
    (people, true_ids, true_ends), (found, track_ids, track_ends) = (_usable(part, column) for part in (truth, tracks))
    places = columns_to_boxes if similarity == "iou" else _xy
    a, b = places(people), places(found)
    alike: list[Floats] = []
    step = max(1, round(_PAIRS_AT_ONCE / max(1.0, len(a) * len(b) / max(1, len(truth)) ** 2)))
    for first in range(0, len(truth), step):
        alike += _similarities(a, b, true_ends[first : first + step + 1], track_ends[first : first + step + 1], gate)
    return Matchup(
        tuple(np.split(true_ids.where, true_ends[1:-1])),
        tuple(np.split(track_ids.where, track_ends[1:-1])),
        tuple(alike),
        gate if similarity == "iou" else 0.5,
        true_ids.total,
        track_ids.total,
    )


class _Ids(NamedTuple):
    """Ids as dense numbers from 0 on (N,), and how many there are."""

    where: Ints
    total: int


def _usable(frames: Sequence[Frame], column: str) -> tuple[Rows, _Ids, Ints]:
    """The rows of all frames that have a place, their ids, and where the rows of each frame begin and end."""
    ends = np.cumsum([0] + [len(frame.rows) for frame in frames])
    rows = TRACKS.empty(int(ends[-1]))
    for low, frame in zip(ends.tolist(), frames, strict=False):
        rows[low : low + len(frame.rows)] = frame.rows
    usable = np.isfinite(rows[column])
    if not usable.all():
        ends, rows = np.concatenate([[0], usable.cumsum()])[ends], rows[usable]
    names, where = np.unique(rows["track_id"], return_inverse=True)
    return rows, _Ids(where, len(names)), ends


def _similarities(a: Floats, b: Floats, a_ends: Ints, b_ends: Ints, gate: float) -> list[Floats]:
    """How alike are the boxes or places in ``a`` and ``b`` of some frames, (G, H) a frame; all pairs in one go."""
    people, found = np.diff(a_ends), np.diff(b_ends)
    size = people * found
    ends = np.cumsum(size)
    frame = np.repeat(np.arange(len(size)), size)
    within = np.arange(len(frame)) - (ends - size)[frame]
    row = a_ends[frame] + within // found[frame]
    column = b_ends[frame] + within % found[frame]
    if a.shape[1] == 4:
        alike = iou_of_pairs(a[row], b[column])
    else:
        apart = a[row] - b[column]
        alike = metrics.metres_to_similarity(np.hypot(apart[:, 0], apart[:, 1]), gate)
    spans = zip((ends - size).tolist(), ends.tolist(), people.tolist(), found.tolist(), strict=True)
    return [alike[low:high].reshape(g, h) for low, high, g, h in spans]


def _displacement(sequence: Sequenced, candidate: Candidate) -> Displacement | None:
    """The errors of the forecasts made from a candidate; None if there are no forecasts at all."""
    frames = [frame for frame in candidate.forecasts or () if len(frame.rows)]
    if not frames:
        return None
    rows = np.concatenate([frame.rows for frame in frames])
    horizon = int(rows["step"].max())
    step_s = float(rows["ahead_s"][0]) / int(rows["step"][0])
    if len(rows) % horizon:
        raise McaptrackError(f"{candidate.forecasts_name}: not all forecasts have {horizon} steps")
    clock_ns = np.unique([frame.t_ns for frame in candidate.frames])
    start, step_ns = int(clock_ns[0]), step_s * NS_PER_S

    def to_step(t_ns: Ints) -> Ints:
        return np.rint((t_ns - start) / step_ns).astype(np.int64)

    last = int(to_step(clock_ns[-1:])[0])
    truth_ns = np.array([frame.t_ns for frame in sequence.truth], np.int64)
    ticks = start + np.rint(np.arange(last + 1) * step_ns).astype(np.int64)
    ticks = ticks[looked_at(truth_ns, ticks, seconds_to_ns(_MAX_HOLE_S))]
    made_ns = np.repeat(np.array([frame.t_ns for frame in frames], np.int64), [len(frame.rows) for frame in frames])
    mean = _xy(rows).reshape(-1, horizon, 2)
    cov = np.stack([rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"]], axis=-1)
    forecasts = Forecasts(
        to_step(made_ns[::horizon]), rows["track_id"][::horizon], mean, cov.reshape(-1, horizon, 2, 2)
    )

    def positions(members: Sequence[Frame]) -> Positions:
        kept = [frame.rows[np.isfinite(frame.rows["x_m"])] for frame in members]
        all_rows = np.concatenate([TRACKS.empty(), *kept])
        t_ns = np.repeat(np.array([frame.t_ns for frame in members], np.int64), [len(part) for part in kept])
        return Positions(to_step(t_ns), all_rows["track_id"], _xy(all_rows))

    return displacement(positions(_resampled(sequence.truth, ticks)), positions(candidate.frames), forecasts)


def sequence_of_files(
    name: str, tracks: Path, truth_frames: Sequence[Frame], track_frames: Sequence[Frame], files: int
) -> Sequenced:
    """A file of tracks, one of ``files``, and its truth as one sequence."""
    group = f"{files} files" if files > 1 else ""
    return Sequenced(name, truth_frames, [Candidate(tracks.name, None, track_frames, group=group)])
