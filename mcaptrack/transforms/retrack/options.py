"""The options of re-tracking: those that both methods share, and those of each.

They are apart from ``methods``, which run the steps of re-tracking, because these steps read them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.predictors import PredictorName
from mcaptrack.schema import APPEARANCE, DECISIONS, PREDICTIONS, TRACKS, WORLDS, Frame, Schema
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import join_frames
from mcaptrack.transforms.forecasts import ADAPT_HELP
from mcaptrack.transforms.motion_limits import LIMITS_HELP, LIMITS_PATTERN, ClassNames, read_limits
from mcaptrack.transforms.protocol import check_options, context, option, parameters, setting
from mcaptrack.transforms.retrack.appearance import Descriptors

# Headings of the options in the help.
_ASSOCIATION: Final = "Association"
_MOTION: Final = "Motion model"
_PREDICTIONS: Final = "Predictions"
_LIFE: Final = "Begin and end of tracks"
_OFFLINE: Final = "With the whole log known (offline)"
#: Tracks of a short log last at least this share of it.
_SHARE_OF_LOG: Final = 1 / 3
#: The outputs that are written on request.
APPEARANCE_OUTPUT: Final = "appearance"
WORLDS_OUTPUT: Final = "worlds"
#: The longest gap of a link where tracks are only linked in the picture, in seconds.
MAX_LINK_IN_PICTURE_S: Final = 4.0


# Durations of tracks.


def longest_track_s(frames: Sequence[Frame]) -> float:
    """The duration of the longest track in seconds; the frames have at least one row."""
    joined = join_frames(TRACKS, frames)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    t_ns, starts = joined.row_ns[order], run_starts(joined.rows["track_id"][order])
    return float((t_ns[run_ends(starts)] - t_ns[starts]).max()) / NS_PER_S


@dataclass(frozen=True, kw_only=True)
@parameters
class RetrackOptions:
    """The options that the methods of re-tracking share: input, outputs, and all that is done offline.

    Parameters
    ----------
    predictor : str
        Predictor: blend, the mean of red and cv; red, cv, holt-cv, kalman; social, which looks at other people; or
        lstm, which is less exact than cv; red:FILE and so on; one of an extension or an installed package, or
        module:Class.
    horizon_s : float
        How far ahead to predict, in seconds.
    min_history : int
        Number of positions, the current one included, that a prediction needs.
    noise_m : float or None
        Noise of measured positions: standard deviation per axis in metres; if not given it is estimated from
        the input (likelihood) or 0.2 (consistency).
    speed_m_per_s : float
        Expected speed of tracks without a history: standard deviation per axis in metres per second.
    drift_m_per_s : float
        How much velocities change within a second, in metres per second.
    drift_ratio : float
        How much velocities change within a second, as a share of the speed.
    same_id_bonus : float
        How much a pair gains if the observation has the input id that the track had last, in squared standard
        deviations (likelihood) or standard deviations (consistency); the paper ignores input ids.
    max_age_s : float
        A track terminates after this many seconds without an observation (t_max in the paper).
    interpolated : bool
        Use interpolated samples as observations, too.
    min_track_s : float
        Leave out tracks that last less than this many seconds, or than a third of a shorter log (probation).
    link_s : float
        Link the end of a track with the beginning of another up to this many seconds later, by likelihood also
        online, from the past alone; 0 for never.
    link_confidence : float
        Link two tracks if they are one person with at least this probability; with a ground plane people are
        linked from a third of these odds on, and from an eleventh where a track was cut, because a person goes
        on there.
    resolve_swaps : bool
        Decide again which track is which where two tracks met, from what was before and after (identity
        switches).
    track_confidence : float
        Leave out tracks that are a person with less than this probability (false tracks).
    across_classes : bool
        A track may continue with one of another class; offline it then has the class of most of its samples.
    smooth : bool
        Smooth positions by past and future.
    side_view : bool
        Re-track also where no ground plane is known and the camera looks along the ground.
    """

    predictor: PredictorName = option("blend", kind="predictor", theme=_PREDICTIONS)
    horizon_s: float = option(4.8, least=0.1, most=60.0, theme=_PREDICTIONS)
    min_history: int = setting(2, least=1, most=100, theme=_PREDICTIONS)
    noise_m: float | None = setting(None, least=0.0, theme=_MOTION)
    speed_m_per_s: float = setting(1.75, least=0.0, theme=_MOTION)
    drift_m_per_s: float = setting(0.12, least=0.0, theme=_MOTION)
    drift_ratio: float = setting(0.08, least=0.0, theme=_MOTION)
    same_id_bonus: float = setting(12.0, least=0.0, theme=_ASSOCIATION)
    max_age_s: float = option(2.0, least=0.0, theme=_LIFE)
    interpolated: bool = setting(False, theme=_ASSOCIATION)
    min_track_s: float = setting(2.0, least=0.0, theme=_LIFE)
    link_s: float = setting(20.0, least=0.0, theme=_OFFLINE)
    link_confidence: float = setting(0.5, least=0.01, most=0.99, theme=_OFFLINE)
    resolve_swaps: bool = setting(True, theme=_OFFLINE)
    track_confidence: float = setting(0.5, least=0.0, most=1.0, theme=_OFFLINE)
    across_classes: bool = setting(False, theme=_ASSOCIATION)
    class_limits: str = setting("", LIMITS_HELP, pattern=LIMITS_PATTERN, theme=_MOTION)
    smooth: bool = option(True, theme=_OFFLINE)
    side_view: bool = setting(False, theme=_ASSOCIATION)
    rate_hz: float = context(lambda: 2.5)
    ground_planes: Planes = context(tuple)
    class_names: ClassNames = context(tuple, is_recorded=False)
    poor_scale: bool = context(lambda: False)
    fixed_ids: tuple[int, ...] = context(tuple, is_recorded=False)
    boxes: FrameColumns | None = context(lambda: None, is_recorded=False)
    answers: Sequence[Frame] = context(tuple, is_recorded=False)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType(
        {"": TRACKS, "online": TRACKS, "predictions": PREDICTIONS}
    )
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": float("inf"), "online": 0.0, "predictions": 0.0})

    # What methods do differently: whether tracks that are left unchanged are linked over gaps in the picture, and how
    # long ones are filled; whether ellipses of predictions follow the log, and the unit of offline tracks its speed;
    # whether a sample that was assigned to two tracks stays with both; the descriptors of samples, if appearance is
    # compared, and if it is stored; the number of worlds that are drawn.
    links_in_picture: ClassVar[bool] = False
    filled_s: ClassVar[float] = 0.0
    adapt: ClassVar[bool] = True
    follows_speed: ClassVar[bool] = False
    shares_samples: ClassVar[bool] = False
    looks: ClassVar[Descriptors | None] = None
    stored_looks: ClassVar[Descriptors | None] = None
    worlds: ClassVar[int] = 0

    @property
    def bridged_s(self) -> float:
        """The longest time without a sample that a track may bridge."""
        return self.max_age_s + self.link_s

    def __post_init__(self) -> None:
        check_options(self)
        read_limits(self.class_limits)

    @property
    def leaves_unchanged(self) -> bool:
        """Whether boxes keep their tracks, because positions in metres are too wrong to repair these."""
        return self.poor_scale and not self.side_view

    def shortest_s(self, log_s: float) -> float:
        """The seconds that tracks of a log of some seconds last at least.

        Where tracks are kept by how likely they are people, those of a short log may be shorter.
        """
        return self.min_track_s if self.track_confidence <= 0 else min(self.min_track_s, _SHARE_OF_LOG * log_s)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        longest_s = longest_track_s(given)
        least_s = self.shortest_s((given[-1].t_ns - given[0].t_ns) / NS_PER_S)
        if longest_s < least_s:
            return f"the longest track lasts {longest_s:.3g} s; those under {least_s:.3g} s are left out (min_track_s)"
        return "no track is likely enough to be a person (track_confidence)"


class _OfOutputs:
    """A value for each output: on the class for all outputs, on an object for those that it writes."""

    def __init__(self, of_all: Mapping[str, Any]) -> None:
        self._of_all = MappingProxyType(of_all)

    def __get__(self, options: LikelihoodOptions | None, _: type) -> Mapping[str, Any]:
        if options is None:
            return self._of_all
        is_asked = {APPEARANCE_OUTPUT: options.store_appearance, WORLDS_OUTPUT: options.worlds > 0}
        return MappingProxyType({name: value for name, value in self._of_all.items() if is_asked.get(name, True)})


@dataclass(frozen=True, kw_only=True)
@parameters
class LikelihoodOptions(RetrackOptions):
    """The options of re-tracking by likelihood.

    Parameters
    ----------
    merge_distance_m : float
        Two tracks may be merged into one detection that lies between them (occlusion), this many metres from
        both; 0 for never.
    merge_timeout_s : float
        Longest time that tracks stay merged into one detection, in seconds.
    confirm_s : float
        Online, a track is confirmed once it was observed for this many seconds: predicted, and written if it
        was not before.
    coast_s : float
        Online, a track is written for up to this many seconds without an observation.
    adapt_online : bool
        Online, follow the log so far: write new tracks at once if most tracks last, and lost ones only as long
        as it is likely that they come back.
    appearance : bool or None
        Compare the colours of what people wear before and after gaps and encounters; by default where the log
        has pictures that tell people apart.
    store_appearance : bool
        Also write the mean colours of each track, as histograms of the upper body and of the legs.
    worlds : int
        Also write the identities of tracks in so many plausible worlds, which differ where re-tracking is not
        sure; 0 for none.
    """

    writes: ClassVar[Mapping[str, Schema]] = _OfOutputs(  # type: ignore[assignment]
        {**RetrackOptions.writes, "decisions": DECISIONS, APPEARANCE_OUTPUT: APPEARANCE, WORLDS_OUTPUT: WORLDS}
    )
    latency_s: ClassVar[Mapping[str, float]] = _OfOutputs(  # type: ignore[assignment]
        {**RetrackOptions.latency_s, **dict.fromkeys(("decisions", APPEARANCE_OUTPUT, WORLDS_OUTPUT), float("inf"))}
    )

    @property
    def links_in_picture(self) -> bool:  # type: ignore[override]
        return self.link_s > 0 or self.store_appearance

    @property
    def filled_s(self) -> float:  # type: ignore[override]
        """The longest gap that is filled where tracks are only linked in the picture; the longest link."""
        return min(self.link_s, MAX_LINK_IN_PICTURE_S)

    follows_speed: ClassVar[bool] = True

    merge_distance_m: float = setting(1.0, least=0.0, theme=_ASSOCIATION)
    merge_timeout_s: float = setting(3.0, least=0.0, theme=_ASSOCIATION)
    confirm_s: float = setting(1.2, least=0.0, theme=_LIFE)
    coast_s: float = setting(1.2, least=0.0, theme=_LIFE)
    adapt_online: bool = setting(True, theme=_LIFE)
    adapt: bool = setting(True, ADAPT_HELP, theme=_PREDICTIONS)  # type: ignore[misc]
    appearance: bool | None = option(None, theme=_OFFLINE)
    store_appearance: bool = setting(False, theme=_OFFLINE)
    worlds: int = option(0, least=0, most=1000, theme=_OFFLINE)  # type: ignore[misc]
    descriptors: Descriptors | None = context(lambda: None, is_recorded=False)

    @property
    def looks(self) -> Descriptors | None:  # type: ignore[override]
        return None if self.appearance is False else self.descriptors

    @property
    def stored_looks(self) -> Descriptors | None:  # type: ignore[override]
        return self.descriptors if self.store_appearance else None


@dataclass(frozen=True, kw_only=True)
@parameters
class ConsistencyOptions(RetrackOptions):
    """The options of re-tracking by prediction consistency (Algorithm 1 of the paper).

    Parameters
    ----------
    distance : str
        How a track and an observation are compared: by the mean or the max distance between their predicted steps.
    max_distance : float
        Gate: pairs further apart, in standard deviations of their predictions (d_min in the paper), are not
        matched.
    gate_m : float or None
        Gate: a track is not matched further than this from its predicted current position, in metres.
    priority_distance : float
        Pairs nearer than this, in standard deviations, are matched before all others; 0 for never.
    covariance : str
        Covariance of predictions: the predictor's, or the paper's (u - t) sigma^2.
    sigma_m : float
        Sigma of the paper's covariance, in metres.
    alpha : float
        Smoothing of displacements (Eq. 3 of the paper); 1 for none.
    beta : float
        Smoothing of the trend of displacements (Eq. 3 of the paper).
    birth : str
        What a new track predicts from: its past as observed, or smoothed.
    min_hits : int
        Online, a track is written from this many matches in a row.
    trim_ends : bool
        Offline, leave out what a track matched after its last min_hits matches in a row.
    backfill : str
        Whether a new track gets the past of its first observation: not at all, what no other track has, or all.
    """

    #: Its covariances decide which tracks match, so that it isn't that of predictions alone.
    predictor: PredictorName = option("kalman", kind="predictor", theme=_PREDICTIONS)
    distance: Literal["mean", "max"] = setting("mean", theme=_ASSOCIATION)
    max_distance: float = setting(3.0, least=0.0, theme=_ASSOCIATION)
    gate_m: float | None = setting(3.0, least=0.0, theme=_ASSOCIATION)
    priority_distance: float = setting(0.0, least=0.0, theme=_ASSOCIATION)
    covariance: Literal["paper", "predictor"] = setting("predictor", theme=_PREDICTIONS)
    sigma_m: float = setting(1.0, least=1e-6, theme=_PREDICTIONS)
    alpha: float = setting(1.0, least=0.0, most=1.0, theme=_PREDICTIONS)
    beta: float = setting(0.0, least=0.0, most=1.0, theme=_PREDICTIONS)
    birth: Literal["raw", "smoothed"] = setting("raw", theme=_PREDICTIONS)
    min_hits: int = setting(1, least=0, most=1000, theme=_LIFE)
    trim_ends: bool = setting(False, theme=_LIFE)
    backfill: Literal["none", "unclaimed", "all"] = setting("unclaimed", theme=_OFFLINE)

    @property
    def shares_samples(self) -> bool:  # type: ignore[override]
        return self.backfill == "all"
