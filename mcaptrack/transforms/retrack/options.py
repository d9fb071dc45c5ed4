"""The transforms of re-tracking: what both methods share, the options of each, and named sets of options (profiles)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, Protocol

import numpy as np

from mcaptrack.geometry.plane import Planes
from mcaptrack.predictors import PredictorName
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.transforms.durations import longest_track_s
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.protocol import check_options, context, option
from mcaptrack.transforms.retrack.assignments import Assignments
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


class OnlinePass(Protocol):
    """Online re-tracking of one log: ``step`` for each frame, then ``outputs``; and what it leaves for ``offline``."""

    assignments: Assignments
    samples: list[Rows]
    steps: list[int]

    @property
    def noise_m(self) -> float:
        """The noise of measured positions."""
        ...

    def step(self, frame: Frame) -> None:
        """One step."""
        ...

    def outputs(self) -> list[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions."""
        ...


@dataclass(frozen=True, kw_only=True)
class Retracking:
    """What the methods of re-tracking share: their input and outputs, and all that is done offline."""

    predictor: PredictorName = option(
        "kalman",
        "predictor: cv, holt-cv, kalman, lstm, red; red:FILE, lstm:FILE, onnx:FILE; one of an installed package, or "
        "module:Class",
        kind="predictor",
        theme=_PREDICTIONS,
    )
    horizon_s: float = option(4.8, "how far ahead to predict, in seconds", least=0.1, most=60.0, theme=_PREDICTIONS)
    min_history: int = option(
        2,
        "number of positions, the current one included, that a prediction needs",
        least=1,
        most=100,
        theme=_PREDICTIONS,
    )
    noise_m: float | None = option(
        None,
        "noise of measured positions: standard deviation per axis in metres; if not given it is estimated from the "
        "input (likelihood) or 0.2 (consistency)",
        least=0.0,
        theme=_MOTION,
    )
    speed_m_per_s: float = option(
        1.75,
        "expected speed of tracks without a history: standard deviation per axis in metres per second",
        least=0.0,
        theme=_MOTION,
    )
    drift_m_per_s: float = option(
        0.12,
        "how much velocities change within a second, in metres per second",
        least=0.0,
        theme=_MOTION,
        was="drift",
    )
    drift_ratio: float = option(
        0.08,
        "how much velocities change within a second, as a share of the speed",
        least=0.0,
        theme=_MOTION,
        was="drift_share",
    )
    same_id_bonus: float = option(
        12.0,
        "how much a pair gains if the observation has the input id that the track had last, in squared standard "
        "deviations (likelihood) or standard deviations (consistency); the paper ignores input ids",
        least=0.0,
        theme=_ASSOCIATION,
        was="same_source",
    )
    max_age_s: float = option(
        2.0,
        "a track terminates after this many seconds without an observation (t_max in the paper)",
        least=0.0,
        theme=_LIFE,
    )
    interpolated: bool = option(
        False, "use interpolated samples as observations, too", theme=_ASSOCIATION, was="filled"
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
    link_confidence: float = option(
        0.5,
        "link two tracks if they are one person with at least this probability",
        least=0.01,
        most=0.99,
        theme=_OFFLINE,
        was="link_certainty",
    )
    resolve_swaps: bool = option(
        True,
        "decide again which track is which where two tracks met, from what was before and after (identity switches)",
        theme=_OFFLINE,
        was="part",
    )
    track_confidence: float = option(
        0.5,
        "leave out tracks that are a person with less than this probability (false tracks)",
        least=0.0,
        most=1.0,
        theme=_OFFLINE,
        was="min_certainty",
    )
    smooth: bool = option(True, "smooth positions by past and future", theme=_OFFLINE)
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

    @property
    def shares_samples(self) -> bool:
        """Whether a sample that was assigned to two tracks stays with both."""
        return False

    def online_pass(self) -> OnlinePass:
        """The method: online re-tracking of one log."""
        raise NotImplementedError

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        if self.holds_back:
            forecaster = Forecaster(self.predictor, self.horizon_s, self.min_history, self.rate_hz)
            for frame in frames:
                online = frame._replace(rows=frame.rows[frame.rows["observed"]])
                yield frame, online, frame._replace(rows=forecaster.predict(frame))
            return
        run = self.online_pass()
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
        return "no track is likely enough to be a person (track_confidence)"


@dataclass(frozen=True, kw_only=True)
class Retrack(Retracking):
    """Repair tracks: re-tracking by likelihood.

    Reads samples; writes repaired tracks that use the whole log (offline), repaired tracks that use the past alone
    (online), and predictions from the latter.

    Examples
    --------
    A person walks on under another track id; re-tracking gives both tracks one id:

    >>> def row(track_id, x_m):
    ...     return TRACKS.rows(track_id=[track_id], x_m=[x_m], y_m=[0.0], observed=[True], source_id=[-1])
    >>> frames = [Frame(t * 400_000_000, t, row(7 if t < 10 else 8, t / 2)) for t in range(20)]
    >>> {id for offline, online, predictions in Retrack()(frames) for id in offline.rows["track_id"].tolist()}
    {1}
    """

    merge_distance_m: float = option(
        1.0,
        "two tracks may be merged into one detection that lies between them (occlusion), this many metres from both; 0 "
        "for never",
        least=0.0,
        theme=_ASSOCIATION,
        was="share_m",
    )
    merge_timeout_s: float = option(
        3.0,
        "longest time that tracks stay merged into one detection, in seconds",
        least=0.0,
        theme=_ASSOCIATION,
        was="share_s",
    )
    confirm_s: float = option(
        1.2,
        "online, a track is confirmed and written once it was observed for this many seconds",
        least=0.0,
        theme=_LIFE,
        was="sure_s",
    )
    coast_s: float = option(
        1.2,
        "online, a track is written for this many seconds without an observation",
        least=0.0,
        theme=_LIFE,
    )

    def online_pass(self) -> OnlinePass:
        return LikelihoodPass(self)


@dataclass(frozen=True, kw_only=True)
class RetrackByConsistency(Retracking):
    """Repair tracks by prediction consistency: Algorithm 1 of the paper.

    Tracks and observations are compared by their predictions. The profile "paper" has the values of the paper.

    References
    ----------
    Yu and Zhou, "Towards Robust Human Trajectory Prediction in Raw Videos", IROS 2021.
    """

    distance: Distance = option(
        "mean",
        "how a track and an observation are compared: mean, max or first distance between their predicted steps, or "
        "that between expected and measured position (now)",
        theme=_ASSOCIATION,
    )
    max_distance: float = option(
        3.0,
        "gate: pairs further apart, in standard deviations of their predictions (d_min in the paper), are not matched",
        least=0.0,
        theme=_ASSOCIATION,
    )
    gate_m: float | None = option(
        3.0,
        "gate: a track is not matched further than this from its predicted current position, in metres",
        least=0.0,
        theme=_ASSOCIATION,
        was="max_jump_m",
    )
    priority_distance: float = option(
        0.0,
        "pairs nearer than this, in standard deviations, are matched before all others; 0 for never",
        least=0.0,
        theme=_ASSOCIATION,
        was="certain_distance",
    )
    covariance: Covariance = option(
        "predictor", "covariance of predictions: the predictor's, or the paper's (u - t) sigma^2", theme=_PREDICTIONS
    )
    sigma_m: float = option(1.0, "sigma of the paper's covariance, in metres", least=1e-6, theme=_PREDICTIONS)
    alpha: float = option(
        1.0, "smoothing of displacements (Eq. 3 of the paper); 1 for none", least=0.0, most=1.0, theme=_PREDICTIONS
    )
    beta: float = option(
        0.0, "smoothing of the trend of displacements (Eq. 3 of the paper)", least=0.0, most=1.0, theme=_PREDICTIONS
    )
    birth: Literal["raw", "smoothed"] = option(
        "raw", "what a new track predicts from: its past as observed, or smoothed", theme=_PREDICTIONS
    )
    min_hits: int = option(
        1, "online, a track is written from this many matches in a row", least=0, most=1000, theme=_LIFE
    )
    trim_ends: bool = option(
        False,
        "offline, leave out what a track matched after its last min_hits matches in a row",
        theme=_LIFE,
        was="confirm",
    )
    backfill: Literal["none", "unclaimed", "all"] = option(
        "unclaimed",
        "whether a new track gets the past of its first observation: not at all, what no other track has, or all",
        theme=_OFFLINE,
    )

    @property
    def shares_samples(self) -> bool:
        return self.backfill == "all"

    def online_pass(self) -> OnlinePass:
        return ConsistencyPass(self)


_PAPER: Final = RetrackByConsistency(
    predictor="cv",
    distance="mean",
    covariance="paper",
    max_distance=3.0,
    gate_m=None,
    noise_m=0.5,
    same_id_bonus=0.0,
    max_age_s=3.2,
    alpha=0.5,
    beta=0.5,
    min_history=4,
    min_hits=2,
    interpolated=True,
    link_s=0.0,
    resolve_swaps=False,
    track_confidence=0.0,
    smooth=False,
)

#: Values of all parameters by name. "paper" is Algorithm 1 with Eq. 1 to 3 to the letter; where the paper gives no
#: number (sigma, d_min, t_max, the probation) it is that of the authors' program. "authors" is what their program does:
#: the largest distance instead of the mean, near pairs first, tracks that start from the smoothed past, and assignments
#: that two matches in a row confirm. "default" is this project's method.
PROFILES: Final[Mapping[str, Retracking]] = MappingProxyType(
    {
        "default": Retrack(),
        "paper": _PAPER,
        "authors": replace(
            _PAPER, distance="max", priority_distance=0.15, birth="smoothed", backfill="all", trim_ends=True
        ),
    }
)


def upgrade_parameters(had: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of version 0.1, where ``distance`` chose the method and both had all options, as those of today."""
    if "retracker" in had or "distance" not in had:
        return dict(had)
    is_likelihood = had["distance"] == "likelihood"
    own, other = (RetrackByConsistency, Retrack)[::-1] if is_likelihood else (RetrackByConsistency, Retrack)
    unused = _names(other) - _names(own)
    return {name: value for name, value in had.items() if name not in unused} | {
        "retracker": "likelihood" if is_likelihood else "consistency"
    }


def _names(cls: type[Retracking]) -> set[str]:
    """The parameters of a method under the names that they had before."""
    return {field.metadata.get("was") or field.name for field in fields(cls)}
