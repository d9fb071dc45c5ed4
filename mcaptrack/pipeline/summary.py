"""Count the results for one camera of a log, and score them against the ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M, are_3d
from mcaptrack.geometry.plane import origin_of
from mcaptrack.notices import warn
from mcaptrack.pipeline.planes import fit_of, read_planes
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, PREDICTIONS, TRACKS, Rows, Schema
from mcaptrack.schema.camera_motion import rows_to_verdict
from mcaptrack.schema.classes import class_names
from mcaptrack.sources.camera_motion import motion_topic, read_ground_truth
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.sources.fixed_frame import BoxesRead, holds_boxes
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
class Summary:
    """Counts and scores for one camera; None for channels that the log lacks.

    ``ground_plane`` is "given" (measured), "estimated" from boxes or "assumed" (a scale alone); ``plane_fit`` says how
    well one fits that was estimated (see ``mcaptrack.geometry.plane_from_boxes.PlaneFit``). ``camera_motion`` is
    "still", "shaking" or "moving".
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
    motion = _rows(opened, motion_topic(prefix), CAMERA_MOTION)
    tracked, repaired = _rows(opened, tracks, TRACKS), _rows(opened, retracks, TRACKS)
    forecasts = _rows(opened, f"{retracks}/predictions", PREDICTIONS)
    forecasts = _rows(opened, predictions, PREDICTIONS) if forecasts is None else forecasts
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
        tracks=None if tracked is None else len(np.unique(tracked["track_id"])),
        repair=None if tracked is None or repaired is None else _repair(tracked, repaired),
        forecasts=None if forecasts is None else int((forecasts["step"] == 1).sum()),
        horizon_s=None if forecasts is None or not len(forecasts) else round(float(forecasts["ahead_s"].max()), 3),
        scores=scores,
        ground_plane=None if planes is None else origin_of(planes),
        plane_fit=fit_of(provenance_of(opened, camera.ground_plane)),
        camera_motion=None if motion is None else rows_to_verdict(motion).name.lower(),
    )


def _rows(opened: log.Log, topic: str, schema: Schema) -> Rows | None:
    """Return all rows of a channel; None if it is missing or has another schema."""
    channel = opened.channels.get(topic)
    return opened.rows(topic, schema).rows if channel and channel.schema_name == schema.name else None


def _count_boxes(opened: log.Log, tracks: str, usual: str, boxes_read: BoxesRead) -> int | None:
    """Return the number of boxes that tracks were made from."""
    made = provenance_of(opened, tracks)
    source = opened.channels.get(made.input if made else usual) or opened.channels.get(usual)
    if source is None:
        return None
    if holds_boxes(opened, source.topic):
        return sum(len(frame.rows) for frame in boxes_read.read(opened, source.topic).frames)
    rows = _rows(opened, source.topic, DETECTIONS)
    return None if rows is None else len(rows)


def _repair(tracked: Rows, repaired: Rows) -> Repair:
    """Count joined, split and missing tracks by the column ``source_id`` of re-tracked rows."""
    named = repaired[repaired["source_id"] >= 0]
    pairs = np.unique(np.stack([named["track_id"], named["source_id"]]), axis=1)
    ids, sources = np.unique(pairs[0]), np.unique(pairs[1])
    return Repair(
        tracks=len(np.unique(repaired["track_id"])),
        joined=pairs.shape[1] - len(ids),
        parted=pairs.shape[1] - len(sources),
        left_out=int((~np.isin(np.unique(tracked["track_id"]), sources)).sum()),
    )


def _scores(opened: log.Log, prefix: str, truth: str, topics: tuple[str, str]) -> SummaryScores | None:
    """Score tracks before and after re-tracking, at their common sample times; None if they can't be compared."""
    there = [opened.channels.get(topic) for topic in (truth, *topics)]
    if not all(channel and channel.schema_name == TRACKS.name for channel in there):
        return None
    names = {topic: class_names(opened.channel(topic).metadata) for topic in (truth, *topics)}
    candidates = [Candidate(topic, None, opened.frames(topic, TRACKS), classes=names[topic]) for topic in topics]
    sequence = EvaluationInput(opened.path.stem, read_ground_truth(opened, prefix), candidates, names[truth])
    is_3d = all(are_3d(sequence.ground_truth, one.frames) for one in candidates)
    gate_m = GATE_3D_M if is_3d else GATE_M
    rules = {
        f"within {gate_m:g} m": EvaluateOptions(similarities=("metres",), gates_m=(gate_m,)),
        f"by an overlap of {_MIN_IOU:g}": EvaluateOptions(similarities=("iou",), min_iou=_MIN_IOU),
    }
    for by, options in rules.items():
        try:
            found = evaluate([sequence], options).results
        except McaptrackError:
            continue  # one of them has no positions in this unit
        rows = [result.to_json() for result in found if result.of_class is None]
        idf1, switches = (tuple(row[name] for row in rows) for name in ("IDF1", "IDSW"))
        return SummaryScores((idf1[0], idf1[1]), (switches[0], switches[1]), by)
    return None
