"""Statistics of tracks and forecasts that need no ground truth, or say more than a score: for charts and as JSON.

Letters: N rows, P pairs of people and forecasts, T future steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluationInput, EvaluationRow
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.evaluation.metrics.displacement import Displacement
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, join_frames
from mcaptrack.schema.resampling import interval_ns
from mcaptrack.transforms import Predict
from mcaptrack.viewing.charts import round_step, thinned

#: Steps longer than this many frame intervals are gaps, over which the speed is not known.
_HOLE: Final = 1.5
#: The number of bins of a histogram, and the percentile of values at which it ends, both about.
_BINS, _SHOWN = 18, 99.0


def frame_interval_s(frames: Sequence[Frame]) -> float:
    """The usual time between two frames: the median; 0 for fewer than two frames."""
    return interval_ns(frame_times(frames)) / NS_PER_S


def rows_by_track(frames: Sequence[Frame]) -> tuple[Any, Ints]:
    """All rows (N,) ordered by track and time, and their times (N,)."""
    joined = join_frames(TRACKS, frames)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    return joined.rows[order], joined.row_ns[order]


def durations_s(frames: Sequence[Frame]) -> Floats:
    """The duration of each track; one frame interval for tracks of a single row."""
    rows, t_ns = rows_by_track(frames)
    starts = run_starts(rows["track_id"])
    return np.asarray((t_ns[run_ends(starts)] - t_ns[starts]) / NS_PER_S + frame_interval_s(frames), np.float64)


def speeds_m_per_s(frames: Sequence[Frame]) -> Floats:
    """The speeds between consecutive rows of a track, without gaps."""
    rows, t_ns = rows_by_track(frames)
    if len(rows) < 2:
        return np.empty(0)
    step_s = np.diff(t_ns) / NS_PER_S
    far = np.hypot(np.diff(rows["x_m"]), np.diff(rows["y_m"]))
    kept = (
        (np.diff(rows["track_id"]) == 0)
        & (step_s > 0)
        & (step_s <= _HOLE * frame_interval_s(frames))
        & np.isfinite(far)
    )
    return np.asarray(far[kept] / step_s[kept])


def list_tracks(frames: Sequence[Frame], start_ns: int) -> list[dict[str, Any]]:
    """Each track in numbers: when it is there in seconds of the log, how far it goes, and the share of observed rows.

    A gap counts with its shortest way. ``metres`` is None without positions.
    """
    rows, t_ns = rows_by_track(frames)
    starts = run_starts(rows["track_id"])
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    if not len(first):
        return []
    x_m, y_m = rows["x_m"], rows["y_m"]
    has_place = np.isfinite(x_m) & np.isfinite(y_m)
    step_m = np.zeros(len(rows))
    placed = np.flatnonzero(has_place)
    same = rows["track_id"][placed[1:]] == rows["track_id"][placed[:-1]]
    step_m[placed[1:]] = np.where(same, np.hypot(np.diff(x_m[placed]), np.diff(y_m[placed])), 0.0)
    counts = last - first + 1
    columns = {
        "id": rows["track_id"][first].astype(np.int64),
        "from_s": (t_ns[first] - start_ns) / NS_PER_S,
        "to_s": (t_ns[last] - start_ns) / NS_PER_S,
        "seconds": (t_ns[last] - t_ns[first]) / NS_PER_S,
        "metres": np.where(np.add.reduceat(has_place, first) > 0, np.add.reduceat(step_m, first), np.nan),
        "observed": np.add.reduceat(rows["observed"].astype(np.float64), first) / counts,
    }
    values = [column.round(3).tolist() for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


def track_statistics(frames: Sequence[Frame]) -> dict[str, Any]:
    """Counts and durations of tracks."""
    rows = join_frames(TRACKS, frames).rows
    durations = durations_s(frames)
    return {
        "tracks": len(durations),
        "rows": len(rows),
        "frames": len(frames),
        "median_s": float(np.median(durations)) if len(durations) else None,
        "longest_s": float(durations.max()) if len(durations) else None,
        "observed_share": float(rows["observed"].mean()) if len(rows) else None,
    }


def histograms(values: Mapping[str, Floats]) -> dict[str, Any] | None:
    """Histograms of several sets of values from 0 on, in the same bins; None if there are no values at all.

    The last bin ends where it holds nearly all values of each set; ``above`` counts the values beyond.
    """
    filled = [part for part in values.values() if len(part)]
    if not filled:
        return None
    most = max(float(np.percentile(part, _SHOWN)) for part in filled) or 1.0
    width = round_step(most / _BINS)
    edges = (
        np.arange(int(most / width + 1e-6) + 2) * width
    )  # values at an edge, up to rounding, lie within the last bin
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


def forecast_statistics(sequence: EvaluationInput, results: Sequence[EvaluationRow]) -> list[dict[str, Any]]:
    """The errors of the forecasts of a sequence, by recall and by horizon, beside those of constant velocity."""
    out = []
    for candidate in sequence.candidates:
        of_all = [result for result in results if result.tracks == candidate.name and result.of_class is None]
        displacement = next((result.displacement for result in of_all if result.displacement), None)
        rows = next((frame.rows for frame in candidate.forecasts or () if len(frame.rows)), None)
        if displacement is None or rows is None:
            continue
        step_s = float(rows["ahead_s"][0]) / int(rows["step"][0])
        recall, ade = thinned(*displacement.curve())
        summary = displacement.summary()
        values = {
            "tracks": candidate.name,
            "forecasts": candidate.forecasts_name,
            "curve_recall": recall.tolist(),
            "curve_ADE_m": ade.tolist(),
            "by_horizon": _by_horizon(displacement, step_s),
            "constant_velocity": None,
            "calibration": [{"nominal": part["level"], "held": part["held"]} for part in displacement.reliability()],
            "NLL": summary["NLL"],
        }
        baseline = _constant_velocity(sequence, candidate, step_s, displacement.error_m.shape[1])
        if baseline is not None:
            values["constant_velocity"] = _by_horizon(baseline, step_s)
        out.append(values)
    return out


def _by_horizon(displacement: Displacement, step_s: float) -> dict[str, Any]:
    away = displacement.errors_by_step()
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
    """The errors of constant velocity for the same tracks at the same times; None if it makes no forecasts."""
    try:
        walking_on = Predict(predictor="cv", horizon_s=steps * step_s, rate_hz=1 / step_s, adapt=False)
        frames = [frame for (frame,) in walking_on(candidate.frames)]
        return score_forecasts(frames, candidate.frames, sequence.ground_truth, "cv")
    except McaptrackError:  # a horizon or a rate that no built-in predictor supports
        return None
