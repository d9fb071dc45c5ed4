"""Samples -> re-tracked tracks: re-tracking by prediction (Yu and Zhou, IROS 2021, Algorithm 1).

An observation is a sample with the forecast from its own past; its identity is dropped. A track is a forecast and an
age. Observations go to the tracks whose forecasts agree with theirs; a matched track is smoothed and foretells again;
an unmatched one ages. Three readings are offered by name, see ``PROFILES``.

Letters: K tracks, N observations, L past positions, T future steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar, Final, Literal

import numpy as np

from mcaptrack.plane import Planes
from mcaptrack.predictors import NAMES, PredictorName
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.transforms.protocol import check_options, context, option
from mcaptrack.transforms.retrack.algorithm import Forecasting
from mcaptrack.transforms.retrack.distance import Covariance, Distance
from mcaptrack.transforms.retrack.following import Following, walker
from mcaptrack.transforms.retrack.whole import whole_tracks


@dataclass(frozen=True, kw_only=True)
class Retrack:
    """Repair tracks by what is foretold of them (re-tracking by prediction).

    Reads samples; writes the repaired tracks of the whole log, the same as they were known at the time (online), and
    the forecasts of these.
    """

    predictor: PredictorName = option(
        "kalman", "what predicts: cv, holt-cv, kalman, lstm, red; or red:FILE, lstm:FILE, onnx:FILE", names=NAMES
    )
    horizon_s: float = option(4.8, "how far ahead", least=0.1, most=60.0)
    distance: Distance = option(
        "likelihood",
        "what is compared: the mean, max or first of the foretold steps, the expected and the seen position now, or "
        "how likely a track makes a sample, with what the input says of identity",
    )
    covariance: Covariance = option("predictor", "whose uncertainty: the predictor's, or the paper's (u - t) sigma^2")
    sigma_m: float = option(1.0, "the paper's sigma", least=1e-6)
    noise_m: float | None = option(
        None,
        "noise of a seen position (now, likelihood); found out on the way unless it is given",
        least=0.0,
    )
    speed_m_per_s: float = option(1.75, "how fast people may be when nothing is known of them (likelihood)", least=0.0)
    drift: float = option(0.12, "how much velocities change in a second, m/s (likelihood)", least=0.0)
    drift_share: float = option(0.08, "the same, as a share of the speed", least=0.0)
    max_distance: float = option(
        3.0, "a track and an observation further apart than this (d_min) are not matched", least=0.0
    )
    certain_distance: float = option(
        0.0, "a pair nearer than this is matched before all others; 0 for never", least=0.0
    )
    max_jump_m: float | None = option(
        3.0, "a track is not matched further than this from where it is expected now", least=0.0
    )
    same_source: float = option(
        12.0,
        "how much nearer a pair counts if the input gives it the id that the track had last; the paper drops ids",
        least=0.0,
    )
    max_age_s: float = option(2.0, "a track is dropped after so long without an observation (t_max)", least=0.0)
    share_m: float = option(
        1.0, "two tracks may be one sample (one box) that is so near to both, and between them; 0 for never", least=0.0
    )
    share_s: float = option(3.0, "for so long at most", least=0.0)
    sure_s: float = option(1.2, "a track is shown online once it was seen for so long (likelihood)", least=0.0)
    coast_s: float = option(1.2, "a track is shown online for so long where it is not seen (likelihood)", least=0.0)
    alpha: float = option(1.0, "smoothing of displacements, Eq. 3; 1 for none", least=0.0, most=1.0)
    beta: float = option(0.0, "smoothing of their trend, Eq. 3", least=0.0, most=1.0)
    birth: Literal["raw", "smoothed"] = option("raw", "what a new track foretells from: its past as seen, or smoothed")
    min_history: int = option(2, "past positions (with the present one) that an observation needs", least=1)
    min_hits: int = option(1, "a track is shown online from so many matches in a row", least=0)
    confirm: bool = option(
        False, "offline, leave out what a track matched after it was last matched min_hits times in a row"
    )
    min_track_s: float = option(2.0, "a track that lasts less than this is left out (probation)", least=0.0)
    link_s: float = option(20.0, "offline, ends and beginnings so far apart are put together; 0 for never", least=0.0)
    link_certainty: float = option(
        0.5, "offline, what is put together is one person with at least this probability", least=0.01, most=0.99
    )
    part: bool = option(True, "offline, decide anew who is who after two came near each other, from before and after")
    min_certainty: float = option(
        0.5, "offline, a track that is a person with less than this probability is left out", least=0.0, most=1.0
    )
    smooth: bool = option(True, "offline, smooth positions, from past and future")
    backfill: Literal["none", "unclaimed", "all"] = option(
        "unclaimed", "whether a new track gets the past of its first observation, and also what other tracks hold"
    )
    filled: bool = option(False, "take samples inside holes of the input for observations too")
    rate_hz: float = context(lambda: 2.5)
    ground_planes: Planes = context(tuple)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType(
        {"": TRACKS, "online": TRACKS, "predictions": PREDICTIONS}
    )
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": float("inf"), "online": 0.0, "predictions": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        run = Following(self) if self.distance == "likelihood" else Forecasting(self)
        times_ns = []
        for frame in frames:
            run.tick(frame)
            times_ns.append(frame.t_ns)
        rows, step = whole_tracks(self, walker(self, run.noise_m), run.claims, run.samples, run.steps, times_ns)
        first, last = (np.searchsorted(step, run.steps, side) for side in ("left", "right"))
        for (online, predictions), low, high in zip(run.outputs(), first.tolist(), last.tolist(), strict=True):
            yield Frame(online.t_ns, online.index, rows[low:high]), online, predictions


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

#: Readings by name. "paper" is Algorithm 1 and Eq. 1 to 3 to the letter; where the paper gives no number (sigma, d_min,
#: t_max, the probation) the authors' stands. "authors" is what their program does: the largest distance instead of the
#: mean, certain pairs first, birth from the smoothed past, and what two matches in a row confirm.
#: "default" is ours.
PROFILES: Final = MappingProxyType(
    {
        "default": Retrack(),
        "paper": _PAPER,
        "authors": replace(
            _PAPER, distance="max", certain_distance=0.15, birth="smoothed", backfill="all", confirm=True
        ),
    }
)
