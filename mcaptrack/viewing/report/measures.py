"""Numbers about tracks and forecasts that need no truth, or more than a score: for charts, and as JSON.

Letters: N rows, P pairs of people and forecasts, T future steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluationInput, EvaluationRow
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.evaluation.metrics.calibration import LEVELS
from mcaptrack.evaluation.metrics.displacement import Displacement
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, join_frames
from mcaptrack.transforms import Predict
from mcaptrack.viewing.report.charts import round_step, thinned

#: A step longer than so many usual ones is a hole, over which nobody's speed is known.
_HOLE: Final = 1.5
#: Histograms have about so many bins, and end where all but so many percent of the values are.
_BINS, _SHOWN = 18, 99.0


def usual_s(frames: Sequence[Frame]) -> float:
    """What lies between two frames, most often; 0 where there are not two."""
    t_ns = frame_times(frames)
    return float(np.median(np.diff(t_ns))) / NS_PER_S if len(t_ns) > 1 else 0.0


def by_track(frames: Sequence[Frame]) -> tuple[Any, Ints]:
    """All rows (N,) by track and time, and their times (N,)."""
    joined = join_frames(TRACKS, frames)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    return joined.rows[order], joined.row_ns[order]


def lives_s(frames: Sequence[Frame]) -> Floats:
    """For how long each track is there, one frame for tracks of a single row."""
    rows, t_ns = by_track(frames)
    first = np.flatnonzero(np.append(True, np.diff(rows["track_id"]) != 0)[: len(rows)])
    last = np.append(first[1:], len(rows)) - 1 if len(first) else first
    return np.asarray((t_ns[last] - t_ns[first]) / NS_PER_S + usual_s(frames), np.float64)


def speeds_m_per_s(frames: Sequence[Frame]) -> Floats:
    """Speeds from one row of a track to the next, holes left out."""
    rows, t_ns = by_track(frames)
    if len(rows) < 2:
        return np.empty(0)
    step_s = np.diff(t_ns) / NS_PER_S
    far = np.hypot(np.diff(rows["x_m"]), np.diff(rows["y_m"]))
    kept = (np.diff(rows["track_id"]) == 0) & (step_s > 0) & (step_s <= _HOLE * usual_s(frames)) & np.isfinite(far)
    return np.asarray(far[kept] / step_s[kept])


def describe_tracks(frames: Sequence[Frame]) -> dict[str, Any]:
    """What can be said of tracks without knowing the truth."""
    rows = join_frames(TRACKS, frames).rows
    lives = lives_s(frames)
    return {
        "tracks": len(lives),
        "rows": len(rows),
        "frames": len(frames),
        "median_s": float(np.median(lives)) if len(lives) else None,
        "longest_s": float(lives.max()) if len(lives) else None,
        "observed_share": float(rows["observed"].mean()) if len(rows) else None,
    }


def histograms(values: Mapping[str, Floats]) -> dict[str, Any] | None:
    """Histograms of several sets of values from 0 on, in the same bins; None if there are no values at all.

    The last bin ends where nearly all values of every set are; ``above`` says how many are beyond.
    """
    filled = [part for part in values.values() if len(part)]
    if not filled:
        return None
    most = max(float(np.percentile(part, _SHOWN)) for part in filled) or 1.0
    width = round_step(most / _BINS)
    edges = np.arange(int(most / width + 1e-6) + 2) * width  # what is just at an edge is not beyond the last
    series = [
        {
            "topic": topic,
            "n": len(part),
            "median": float(np.median(part)) if len(part) else None,
            "counts": np.histogram(part, edges)[0].tolist(),
            "above": int((part > edges[-1]).sum()),
        }
        for topic, part in values.items()
    ]
    return {"edges": edges.tolist(), "series": series}


def describe_forecasts(sequence: EvaluationInput, results: Sequence[EvaluationRow]) -> list[dict[str, Any]]:
    """How good the forecasts of a sequence are: over recall, and step by step, beside constant velocity."""
    out = []
    for candidate in sequence.candidates:
        found = next((r.displacement for r in results if r.tracks == candidate.name and r.displacement), None)
        rows = next((frame.rows for frame in candidate.forecasts or () if len(frame.rows)), None)
        if found is None or rows is None:
            continue
        step_s = float(rows["ahead_s"][0]) / int(rows["step"][0])
        recall, ade = thinned(*found.curve())
        summary = found.summary()
        said = {
            "tracks": candidate.name,
            "forecasts": candidate.forecasts_name,
            "curve_recall": recall.tolist(),
            "curve_ADE_m": ade.tolist(),
            "by_horizon": _by_horizon(found, step_s),
            "constant_velocity": None,
            "calibration": [{"nominal": level, "held": summary[f"coverage_{100 * level:g}"]} for level in LEVELS],
        }
        plain = _constant_velocity(sequence, candidate, step_s, found.error_m.shape[1])
        if plain is not None:
            said["constant_velocity"] = _by_horizon(plain, step_s)
        out.append(said)
    return out


def _by_horizon(found: Displacement, step_s: float) -> dict[str, Any]:
    away = found.errors_by_step()
    quartiles = np.percentile(away, [25, 75], axis=0) if len(away) else np.empty((2, 0))
    return {
        "n": len(away),
        "ahead_s": ((np.arange(away.shape[1]) + 1) * step_s).tolist() if len(away) else [],
        "mean_m": away.mean(axis=0).tolist() if len(away) else [],
        "quarter_m": quartiles[0].tolist(),
        "three_quarters_m": quartiles[1].tolist(),
    }


def _constant_velocity(
    sequence: EvaluationInput, candidate: Candidate, step_s: float, steps: int
) -> Displacement | None:
    """The errors of walking on as before, from the same tracks at the same times; None if it foretells nothing."""
    try:
        walking_on = Predict(predictor="cv", horizon_s=steps * step_s, rate_hz=1 / step_s)
        frames = [frame for (frame,) in walking_on(candidate.frames)]
        return score_forecasts(frames, candidate.frames, sequence.ground_truth, "cv")
    except McaptrackError:  # a horizon or a rate that no predictor of ours has
        return None
