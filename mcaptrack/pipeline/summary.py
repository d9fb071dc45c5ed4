"""Count the results for one camera of a log, and score them against the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M, are_3d
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.plane import origin_of
from mcaptrack.notices import warn
from mcaptrack.pipeline.planes import fit_of
from mcaptrack.pipeline.staleness import read_planes
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.as_rows import rows_to_verdict
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import has_any, joined_parts, row_ends, unique_values
from mcaptrack.schema.provenance import Provenance, frame_id_of
from mcaptrack.sources import foreign
from mcaptrack.sources.camera_motion import motion_topic, read_ground_truth
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.sources.corrections import corrected_tracks, corrections_of
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.transforms import STAGES

#: Minimum IoU of boxes at which a track matches the ground truth, as in the demo.
_MIN_IOU = 0.5


@dataclass(frozen=True)
class Repair:
    """The changes that re-tracking made, as counts: tracks after it; tracks joined, split and left out by it."""

    tracks: int
    joined: int
    parted: int
    left_out: int


@dataclass(frozen=True)
class SummaryScores:
    """IDF1 (0 to 1) and identity switches, each before and after re-tracking; ``by`` is the matching rule in words."""

    idf1: tuple[float, float]
    switches: tuple[int, int]
    by: str


@dataclass(frozen=True)
class Corrected:
    """The corrections by people that re-tracking took: boxes, their tracks, and the pictures that were looked at."""

    boxes: int
    tracks: int
    pictures: int


@dataclass(frozen=True)
class Looks:
    """The colours of clothes in re-tracking: whether they were used, and how well they tell people apart.

    ``separation`` is the probability that two people differ more than one does after a gap, as measured on ``tracks``;
    None if too few people were seen for that.
    """

    used: bool
    separation: float | None
    tracks: int


@dataclass(frozen=True)
class Summary:
    """Counts and scores for one camera; None for channels that the log lacks.

    ``ground_plane`` is "given" (measured), "estimated" from boxes or "assumed" (a scale alone); ``plane_fit`` says how
    well one fits that was estimated (see ``mcaptrack.geometry.plane_from_boxes.PlaneFit``). ``camera_motion`` is
    "still", "shaking" or "moving". ``frame_id`` is the frame of reference that boxes in space were tracked in.
    """

    pictures: int | None = None
    boxes: int | None = None
    tracks: int | None = None
    repair: Repair | None = None
    forecasts: int | None = None
    horizon_s: float | None = None
    scores: SummaryScores | None = None
    ground_plane: str | None = None
    plane_fit: Mapping[str, float] | None = None
    camera_motion: str | None = None
    corrected: Corrected | None = None
    frame_id: str | None = None
    appearance: Looks | None = None

    def to_json(self) -> dict[str, Any]:
        """Convert the summary to JSON values."""
        return asdict(self)


def summarise(opened: log.Log, prefix: str, boxes_read: BoxesRead | None = None) -> Summary:
    """Count the results for a camera, and score them against its ground truth, if it has one.

    ``boxes_read`` are boxes of other software that were read before. Warns if IDF1 is lower after re-tracking than
    before.
    """
    camera = camera_at(opened, prefix)
    names = ("detect", "track", "sample", "predict", "retrack")
    boxes, tracks, samples, predictions, retracks = (f"{prefix}/{STAGES[name].output_topic}" for name in names)
    motion = _frames(opened, motion_topic(prefix), CAMERA_MOTION)
    tracked, repaired = _sources(opened, tracks), _sources(opened, retracks)
    corrected = _corrected(opened, prefix, tracks, samples)
    compared = tracked
    if corrected:
        compared = _pairs(corrected_tracks(opened, prefix, tracks, opened.frame_columns(tracks, TRACKS)))
    forecasts = _forecasts(opened, f"{retracks}/predictions") or _forecasts(opened, predictions)
    planes = read_planes(opened, prefix)
    scores = _scores(opened, prefix, camera.truth, (samples, retracks))
    if scores is not None and scores.idf1[1] < scores.idf1[0]:
        was, now = scores.idf1
        warn(
            f"re-tracking made it worse: IDF1 {was:.1%} before, {now:.1%} after, against {camera.truth}, {scores.by}",
            "worse",
        )
    return Summary(
        pictures=opened.channels[camera.pictures].messages if camera.pictures else None,
        boxes=_count_boxes(opened, tracks, boxes, boxes_read or BoxesRead()),
        tracks=None if tracked is None else len(np.unique(tracked[0])),
        repair=None if compared is None or repaired is None else _repair(compared, repaired),
        forecasts=None if forecasts is None else forecasts[0],
        horizon_s=None if forecasts is None else forecasts[1],
        scores=scores,
        ground_plane=None if planes is None else origin_of(planes),
        plane_fit=fit_of(provenance_of(opened, camera.ground_plane)),
        camera_motion=None if motion is None else rows_to_verdict(motion.rows()).name.lower(),
        corrected=corrected,
        frame_id=_frame_id(opened, tracks),
        appearance=_appearance(provenance_of(opened, retracks)),
    )


def _appearance(provenance: Provenance | None) -> Looks | None:
    """Return what re-tracking found of the appearance of people; None if it didn't look."""
    facts = provenance.model if provenance else {}
    separation = facts.get("separation")
    try:
        was = None if separation is None else float(separation)
        return Looks(facts["appearance"] == "used", was, int(facts.get("tracks", 0)))
    except (KeyError, ValueError):
        return None


def _frame_id(opened: log.Log, tracks: str) -> str | None:
    """Return the frame that tracks are in, if they have no place in pictures; None if none is named."""
    frames = _frames(opened, tracks, TRACKS)
    if frames is None or has_any(TRACKS, frames, lambda rows: ~np.isnan(rows["x_px"])):
        return None
    return frame_id_of(opened.channels[tracks].metadata) or None


def _corrected(opened: log.Log, prefix: str, tracks: str, samples: str) -> Corrected | None:
    """Count the corrections that the samples were made with; None if there are none."""
    topic, provenance = corrections_of(opened, prefix, tracks), provenance_of(opened, samples)
    if topic is None or provenance is None or topic not in provenance.references:
        return None
    frames = opened.frame_columns(topic, TRACKS)
    return Corrected(int(row_ends(frames)[-1]), len(unique_values(TRACKS, frames, "track_id")), len(frames))


def _frames(opened: log.Log, topic: str, schema: Schema) -> FrameColumns | None:
    """Return all rows of a channel; None if it is missing or has another schema."""
    return opened.frame_columns(topic, schema) if opened.holds(topic, schema) else None


def _sources(opened: log.Log, topic: str) -> Ints | None:
    """Return the different pairs of a track's id and the id that its rows had before, (2, P); None without tracks."""
    frames = _frames(opened, topic, TRACKS)
    return None if frames is None else _pairs(frames)


def _pairs(frames: Sequence[Frame]) -> Ints:
    """Return the different pairs of a track's id and the id that its rows had before, (2, P)."""
    pairs = np.empty((2, 0), np.int64)
    for _, _, joined in joined_parts(TRACKS, frames):
        those = np.stack([joined.rows["track_id"], joined.rows["source_id"]]).astype(np.int64)
        pairs = np.unique(np.concatenate([pairs, those], axis=1), axis=1)
    return pairs


def _forecasts(opened: log.Log, topic: str) -> tuple[int, float | None] | None:
    """Return the number of forecasts, and how far ahead they reach in seconds; None if there is no such channel."""
    frames = _frames(opened, topic, PREDICTIONS)
    if frames is None:
        return None
    count, ahead_s = 0, -1.0
    for _, _, joined in joined_parts(PREDICTIONS, frames):
        count += int((joined.rows["step"] == 1).sum())
        ahead_s = float(joined.rows["ahead_s"].max(initial=ahead_s))
    return count, None if ahead_s < 0 else round(ahead_s, 3)


def _count_boxes(opened: log.Log, tracks: str, usual: str, boxes_read: BoxesRead) -> int | None:
    """Return the number of boxes that tracks were made from."""
    provenance = provenance_of(opened, tracks)
    source = opened.channels.get(provenance.input if provenance else usual) or opened.channels.get(usual)
    if source is None:
        return None
    if foreign.holds_boxes(opened, source.topic):
        return int(row_ends(boxes_read.read(opened, source.topic).frames)[-1])
    frames = _frames(opened, source.topic, DETECTIONS)
    return None if frames is None else int(frames.ends[-1])


def _repair(tracked: Ints, repaired: Ints) -> Repair:
    """Count joined, split and missing tracks, by ``_sources`` of the tracks and of the re-tracked ones."""
    pairs = repaired[:, repaired[1] >= 0]
    ids, sources = np.unique(pairs[0]), np.unique(pairs[1])
    return Repair(
        tracks=len(np.unique(repaired[0])),
        joined=pairs.shape[1] - len(ids),
        parted=pairs.shape[1] - len(sources),
        left_out=int((~np.isin(np.unique(tracked[0]), sources)).sum()),
    )


def _scores(opened: log.Log, prefix: str, truth: str, topics: tuple[str, str]) -> SummaryScores | None:
    """Score tracks before and after re-tracking, at their common sample times; None if they can't be compared."""
    if not all(opened.holds(topic, TRACKS) for topic in (truth, *topics)):
        return None
    names = {topic: class_names(opened.channel(topic).metadata) for topic in (truth, *topics)}
    candidates = [Candidate(topic, None, opened.frames(topic, TRACKS), classes=names[topic]) for topic in topics]
    sequence = EvaluationInput(opened.path.stem, read_ground_truth(opened, prefix), candidates, names[truth])
    is_3d = all(are_3d(sequence.ground_truth, candidate.frames) for candidate in candidates)
    gate_m = GATE_3D_M if is_3d else GATE_M
    rules = {
        f"within {gate_m:g} m": EvaluateOptions(similarities=("metres",), gates_m=(gate_m,)),
        f"by an overlap of {_MIN_IOU:g}": EvaluateOptions(similarities=("iou",), min_iou=_MIN_IOU),
    }
    for by, options in rules.items():
        try:
            results = evaluate([sequence], options).results
        except McaptrackError:
            continue  # one of them has no positions in this unit
        rows = [result.to_json() for result in results if result.of_class is None]
        idf1, switches = (tuple(row[name] for row in rows) for name in ("IDF1", "IDSW"))
        return SummaryScores((idf1[0], idf1[1]), (switches[0], switches[1]), by)
    return None
