"""Samples -> re-tracked tracks: re-tracking by prediction (Yu and Zhou, IROS 2021).

Two methods associate observations online: ``consistency`` (Algorithm 1 of the paper) and ``likelihood``. Both leave
assignments of samples to tracks, from which ``offline`` makes the tracks of the whole log: it links tracks over gaps
(``linking``), resolves identity swaps (``identity_swaps``), leaves out false tracks (``false_tracks``) and smooths
(``motion_model``). All of this is in metres: where their scale is guessed and can't be right (``poor_scale``), tracks
are passed on unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar, Final, Literal

import numpy as np

from mcaptrack.geometry.plane import Planes
from mcaptrack.predictors import PredictorName
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.transforms.durations import longest_track_s
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.protocol import check_options, context, option
from mcaptrack.transforms.retrack.consistency import ConsistencyPass
from mcaptrack.transforms.retrack.distances import Covariance, Distance
from mcaptrack.transforms.retrack.likelihood import LikelihoodPass, motion_model
from mcaptrack.transforms.retrack.offline import offline_tracks

# Headings of the options in the help.
_ASSOCIATION: Final = "Association"
_MOTION: Final = "Motion model"
_PREDICTIONS: Final = "Predictions"
_LIFE: Final = "Begin and end of tracks"
_OFFLINE: Final = "With the whole log known (offline)"


@dataclass(frozen=True, kw_only=True)
class Retrack:
    """Repair tracks: re-tracking by prediction.

    Reads samples; writes repaired tracks that use the whole log (offline), repaired tracks that use the past alone
    (online), and predictions from the latter.
    """

    predictor: PredictorName = option(
        "kalman",
        "predictor: cv, holt-cv, kalman, lstm, red; red:FILE, lstm:FILE, onnx:FILE; or another, as for `predict`",
        kind="predictor",
        theme=_PREDICTIONS,
    )
    horizon_s: float = option(4.8, "how far ahead to predict, in seconds", least=0.1, most=60.0, theme=_PREDICTIONS)
    distance: Distance = option(
        "likelihood",
        "how a track and an observation are compared: mean, max or first distance between their predicted steps, the "
        "current distance (now), or the likelihood of the observation",
        theme=_ASSOCIATION,
    )
    covariance: Covariance = option(
        "predictor", "uncertainty of predictions: the predictor's, or the paper's (u - t) sigma^2", theme=_PREDICTIONS
    )
    sigma_m: float = option(1.0, "sigma of the paper's covariance, in metres", least=1e-6, theme=_PREDICTIONS)
    noise_m: float | None = option(
        None,
        "noise of observed positions in metres (--distance now or likelihood); estimated from the input if not given",
        least=0.0,
        theme=_MOTION,
    )
    speed_m_per_s: float = option(
        1.75,
        "expected speed of people without a history, in metres per second (--distance likelihood)",
        least=0.0,
        theme=_MOTION,
    )
    drift: float = option(
        0.12, "how much velocities change within a second, in m/s (--distance likelihood)", least=0.0, theme=_MOTION
    )
    drift_share: float = option(
        0.08,
        "how much velocities change within a second, as a share of the speed (--distance likelihood)",
        least=0.0,
        theme=_MOTION,
    )
    max_distance: float = option(
        3.0,
        "gate: a track and an observation that are further apart (d_min in the paper) are not matched",
        least=0.0,
        theme=_ASSOCIATION,
    )
    certain_distance: float = option(
        0.0, "pairs nearer than this are matched before all others; 0 for never", least=0.0, theme=_ASSOCIATION
    )
    max_jump_m: float | None = option(
        3.0,
        "gate: a track is not matched further than this from its predicted current position, in metres",
        least=0.0,
        theme=_ASSOCIATION,
    )
    same_source: float = option(
        12.0,
        "how much nearer a pair counts if the observation has the input id that the track had last; the paper ignores "
        "input ids",
        least=0.0,
        theme=_ASSOCIATION,
    )
    max_age_s: float = option(
        2.0, "a track ends after this many seconds without an observation (t_max in the paper)", least=0.0, theme=_LIFE
    )
    share_m: float = option(
        1.0,
        "two tracks may be merged into one detection that lies between them, this many metres from both; 0 for never",
        least=0.0,
        theme=_ASSOCIATION,
    )
    share_s: float = option(
        3.0, "longest time that tracks stay merged into one detection, in seconds", least=0.0, theme=_ASSOCIATION
    )
    sure_s: float = option(
        1.2,
        "online, a track is written once it was observed for this many seconds (--distance likelihood)",
        least=0.0,
        theme=_LIFE,
    )
    coast_s: float = option(
        1.2,
        "online, a track is written for this many seconds without an observation (--distance likelihood)",
        least=0.0,
        theme=_LIFE,
    )
    alpha: float = option(
        1.0, "smoothing of displacements (Eq. 3 of the paper); 1 for none", least=0.0, most=1.0, theme=_PREDICTIONS
    )
    beta: float = option(
        0.0, "smoothing of the trend of displacements (Eq. 3 of the paper)", least=0.0, most=1.0, theme=_PREDICTIONS
    )
    birth: Literal["raw", "smoothed"] = option(
        "raw", "what a new track predicts from: its past as observed, or smoothed", theme=_PREDICTIONS
    )
    min_history: int = option(
        2,
        "number of positions, the current one included, that an observation needs",
        least=1,
        most=100,
        theme=_PREDICTIONS,
    )
    min_hits: int = option(
        1, "online, a track is written from this many matches in a row", least=0, most=1000, theme=_LIFE
    )
    confirm: bool = option(
        False, "offline, leave out what a track matched after its last --min-hits matches in a row", theme=_LIFE
    )
    min_track_s: float = option(
        2.0, "leave out tracks that last less than this many seconds (probation)", least=0.0, theme=_LIFE
    )
    link_s: float = option(
        20.0,
        "link the end of a track with the beginning of another up to this many seconds later; 0 for never",
        least=0.0,
        theme=_OFFLINE,
    )
    link_certainty: float = option(
        0.5,
        "link two tracks if they are one person with at least this probability",
        least=0.01,
        most=0.99,
        theme=_OFFLINE,
    )
    part: bool = option(
        True, "assign identities again where two people met, by what was before and after", theme=_OFFLINE
    )
    min_certainty: float = option(
        0.5,
        "leave out tracks that are a person with less than this probability (false tracks)",
        least=0.0,
        most=1.0,
        theme=_OFFLINE,
    )
    smooth: bool = option(True, "smooth positions by past and future", theme=_OFFLINE)
    backfill: Literal["none", "unclaimed", "all"] = option(
        "unclaimed",
        "whether a new track gets the past of its first observation: not at all, what no other track has, or all",
        theme=_OFFLINE,
    )
    filled: bool = option(False, "use interpolated samples as observations, too", theme=_ASSOCIATION)
    side_view: bool = option(
        False,
        "re-track also where no ground plane is known and the camera looks along the ground",
        theme=_ASSOCIATION,
    )
    rate_hz: float = context(lambda: 2.5)
    ground_planes: Planes = context(tuple)
    poor_scale: bool = context(lambda: False)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType(
        {"": TRACKS, "online": TRACKS, "predictions": PREDICTIONS}
    )
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": float("inf"), "online": 0.0, "predictions": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def holds_back(self) -> bool:
        """Whether tracks are passed on unchanged, because positions in metres are too wrong to repair them."""
        return self.poor_scale and not self.side_view

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        if self.holds_back:
            forecaster = Forecaster(self.predictor, self.horizon_s, self.min_history, self.rate_hz)
            for frame in frames:
                online = frame._replace(rows=frame.rows[frame.rows["observed"]])
                yield frame, online, frame._replace(rows=forecaster.predict(frame))
            return
        run = LikelihoodPass(self) if self.distance == "likelihood" else ConsistencyPass(self)
        times_ns = []
        for frame in frames:
            run.step(frame)
            times_ns.append(frame.t_ns)
        model = motion_model(self, run.noise_m)
        rows, step = offline_tracks(self, model, run.assignments, run.samples, run.steps, times_ns)
        first, last = (np.searchsorted(step, run.steps, side) for side in ("left", "right"))
        for (online, predictions), low, high in zip(run.outputs(), first.tolist(), last.tolist(), strict=True):
            yield Frame(online.t_ns, online.index, rows[low:high]), online, predictions

    def why_nothing(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        longest_s = longest_track_s(given)
        if longest_s < self.min_track_s:
            least_s = f"{self.min_track_s:g} s"
            return f"the longest track lasts {longest_s:.3g} s; those under {least_s} are left out (min_track_s)"
        return "no track is likely enough to be a person (min_certainty)"


_PAPER: Final = Retrack(
    predictor="cv",
    distance="mean",
    covariance="paper",
    max_distance=3.0,
    max_jump_m=None,
    noise_m=0.5,
    same_source=0.0,
    max_age_s=3.2,
    alpha=0.5,
    beta=0.5,
    min_history=4,
    min_hits=2,
    filled=True,
    link_s=0.0,
    part=False,
    min_certainty=0.0,
    smooth=False,
)

#: Values of all parameters by name. "paper" is Algorithm 1 with Eq. 1 to 3 to the letter; where the paper gives no
#: number (sigma, d_min, t_max, the probation) it is that of the authors' program. "authors" is what their program does:
#: the largest distance instead of the mean, near pairs first, tracks that start from the smoothed past, and assignments
#: that two matches in a row confirm. "default" is this project's method.
PROFILES: Final[Mapping[str, Retrack]] = MappingProxyType(
    {
        "default": Retrack(),
        "paper": _PAPER,
        "authors": replace(
            _PAPER, distance="max", certain_distance=0.15, birth="smoothed", backfill="all", confirm=True
        ),
    }
)
