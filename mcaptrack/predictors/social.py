"""``social``: ``red`` corrected by what other people do: attention over those nearby.

Every person is first predicted by ``red``. Then each one looks at up to 16 people within 12 m: where they are, how they
are predicted to move, whether both have kept together so far, how near they would come. From these the network computes
how much of the displacement of each is taken over (people who walk together have the same future, and two noisy pasts
say more about it than one), a correction of the mean (giving way), and a factor of the covariance. Of the directions
everything fades with the speed, as in ``red``. The order of people has no influence.

The network was trained on synthetic walks by social forces (``tools/train_social.py``); the weights of ``red`` are part
of the file and were not changed.

Letters: B batch, M people, L past positions (8), T future steps, P pairs of a track and another person, H hidden
numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.histories import last_positions
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.predictors.forecast import Forecast, PeopleSeen
from mcaptrack.predictors.red import PAST, Red, prepare
from mcaptrack.predictors.weights import SHIPPED, Network, Weights, load

#: Only so many people are looked at, the nearest, and only within this distance (m).
MOST_PEOPLE: Final = 16
FAR_M: Final = 12.0
#: Numbers of features: of a track, and of a pair.
OWN_FEATURES: Final = 15
PAIR_FEATURES: Final = 30
#: Outputs per step: two corrections, width, elongation.
OUTPUTS: Final = 4
#: The parts of the forecast that are features, as shares of its steps; and past steps at which distances are compared.
_EARLY, _MIDDLE, _LATE = 0.25, 0.5, 1.0
_BACK: Final = (1, 3, 7)
_LEAST_M2: Final = 1e-6
#: Distances that differ by less are the same, whatever they are rounded to (m).
_SAME_M: Final = 1e-6


class Seen(NamedTuple):
    """The results of ``red`` for each of M people: forecasts, state (M, H), and frame of reference (M, 2, 2)."""

    xy_m: Floats
    valid: Bools
    mean: Floats
    cov: Floats
    turn: Floats
    gate: Floats
    spread: Floats
    state: Floats


def pairs_of(people: PeopleSeen, now: Floats) -> tuple[Ints, Ints]:
    """The pairs (P,) of a track of the batch and a row of ``people``: the nearest, by track and distance.

    ``now`` (M, 2) are the current positions. Of people at the same distance as the last one all are taken.
    """
    order = np.argsort(people.moment, kind="stable")
    moments = people.moment[order]
    mine = people.moment[people.row]
    low, high = np.searchsorted(moments, mine), np.searchsorted(moments, mine, "right")
    track = group_index(high - low)
    other = order[ragged_range(low, high - low)]
    away = now[other] - now[people.row[track]]
    distance = np.hypot(away[:, 0], away[:, 1])
    near = (distance < FAR_M) & (other != people.row[track])
    track, other, distance = track[near], other[near], distance[near]
    by = np.lexsort((distance, track))
    track, other, distance = track[by], other[by], distance[by]
    starts = np.searchsorted(track, np.arange(len(mine)))
    last = np.minimum(starts + MOST_PEOPLE, np.append(starts[1:], len(track))) - 1
    kept = distance <= distance[last[track]] if len(track) else np.empty(0, bool)
    return track[kept], other[kept]


def own_features(seen: Seen) -> Floats:
    """Features of the tracks alone, (B, OWN_FEATURES)."""
    ahead = (seen.mean - seen.xy_m[:, -1:]) @ seen.turn.transpose(0, 2, 1)
    steps = ahead.shape[1]
    at = [_step(share, steps) for share in (_EARLY, _MIDDLE, _LATE)]
    spreads = np.log(seen.spread[:, [0, at[1], at[2]]])
    out = [ahead[:, at, 0] / 5, ahead[:, at, 1], spreads, seen.gate[:, None], seen.valid.sum(1)[:, None] / PAST]
    for step in (at[2], at[0]):
        cov = seen.turn @ seen.cov[:, step] @ seen.turn.transpose(0, 2, 1)
        out.append(np.log(np.maximum(cov[:, [0, 1], [0, 1]], _LEAST_M2)) / 2)
    return np.concatenate(out, axis=1)


def pair_features(viewer: Seen, other: Seen, step_s: float) -> Floats:
    """Features of other people as seen by tracks, (P, PAIR_FEATURES), in the frames of reference of the tracks."""
    faded = viewer.turn * viewer.gate[:, None, None]
    now = other.xy_m[:, -1] - viewer.xy_m[:, -1]
    mine, theirs = viewer.mean - viewer.xy_m[:, -1:], other.mean - other.xy_m[:, -1:]
    steps = mine.shape[1]
    distance = np.hypot(now[:, 0], now[:, 1])[:, None]
    side = _rotated(faded, now)
    out = [side / 5, distance / 5, np.exp(-distance), np.exp(-distance / 3), side / (distance + 0.3)]
    for share in (_MIDDLE, _LATE):
        step = _step(share, steps)
        faster = (theirs[:, step] - mine[:, step]) / (step_s * (step + 1))
        out += [_rotated(faded, faster), _length(faster)]
    out.append(_rotated(faded, theirs[:, -1]) / (step_s * steps))
    for back in _BACK:
        both = viewer.valid[:, -1 - back] & other.valid[:, -1 - back]
        before = np.where(both[:, None], other.xy_m[:, -1 - back] - viewer.xy_m[:, -1 - back], now)
        change = (now - before) / np.sqrt(step_s * back)
        out += [_rotated(faded, change), _length(change), both[:, None].astype(np.float64)]
    apart = now[:, None] + theirs - mine
    gaps = np.hypot(apart[..., 0], apart[..., 1])
    least = gaps.min(axis=1)
    first = (gaps <= least[:, None] + _SAME_M).argmax(axis=1)  # of those who stay as near as they are, now
    out += [np.exp(-least / 0.7)[:, None], first[:, None] / steps]
    out.append(other.valid.sum(axis=1)[:, None] / PAST)
    return np.concatenate(out, axis=1)


def _step(share: float, steps: int) -> int:
    """The step at a share of the horizon, the first of which is 0."""
    return max(round(share * steps), 1) - 1


def _rotated(turn: Floats, vectors: Floats) -> Floats:
    return np.asarray((turn @ vectors[..., None])[..., 0])


def _length(vectors: Floats) -> Floats:
    return np.asarray(np.hypot(vectors[:, 0], vectors[:, 1])[:, None])


@dataclass(frozen=True)
class Social(Network):
    """The network in NumPy, in 64 bits.

    References
    ----------
    Alahi et al., "Social LSTM: Human trajectory prediction in crowded spaces", CVPR 2016. Vemula et al., "Social
    attention: Modeling attention in human crowds", ICRA 2018. Moussaid et al., "The walking behaviour of pedestrian
    social groups and its impact on crowd dynamics", PLoS ONE, 2010.
    """

    name: ClassVar[str] = "social"
    past: ClassVar[int] = PAST
    uses_people: ClassVar[bool] = True

    @cached_property
    def _red(self) -> Red:
        weights = self.weights
        tensors = {k.removeprefix("red."): v for k, v in weights.tensors.items() if k.startswith("red.")}
        return Red.of(Weights(weights.path, tensors, {**weights.card, "network": "red"}, weights.sha256))

    @cached_property
    def _layers(self) -> tuple[Floats, ...]:
        get, steps = self.weights.get, self.steps
        state = (
            self.weights.tensors["red.gru.weight_hh"].shape[-1] if "red.gru.weight_hh" in self.weights.tensors else 0
        )
        hidden = len(self.weights.tensors.get("own.bias", ()))
        _ = self._red

        def layer(name: str, outputs: int | None, inputs: int | None) -> tuple[Floats, Floats]:
            return np.ascontiguousarray(get(f"{name}.weight", outputs, inputs).T), get(f"{name}.bias", outputs)

        return (
            *layer("own", hidden, OWN_FEATURES + state),
            *layer("pair", hidden, PAIR_FEATURES),
            *layer("both", hidden, hidden),
            np.ascontiguousarray(get("both.own", hidden, hidden).T),
            *layer("attention", 3, hidden),
            *layer("alone", 3, hidden),
            *layer("dense", None, 3 * hidden),
            *layer("head", steps * OUTPUTS, None),
        )

    def see(self, xy_m: Floats, valid: Bools) -> Seen:
        """The results of ``red`` for the pasts (M, L', 2) of people."""
        xy_m, valid = last_positions(xy_m, valid, PAST)
        *_, weights, spread = self._red._layers
        inputs = prepare(xy_m, valid, weights, spread)
        mean, cov = self._red.predict(xy_m, valid)
        state = self._red._encode(inputs.features, inputs.started)
        return Seen(xy_m, valid, mean, cov, inputs.turn, inputs.gate, inputs.spread, state)

    def predict(self, xy_m: Floats, valid: Bools, people: PeopleSeen | None = None) -> Forecast:
        """Predict a batch of tracks among other people.

        Parameters
        ----------
        xy_m, valid : (B, L', 2) of float, in m, and (B, L') of bool
            As in ``forecast.Predictor``.
        people : PeopleSeen, optional
            Those who are there; without them every track is alone.

        Returns
        -------
        Forecast
        """
        if people is None:
            people = PeopleSeen.alone(xy_m, valid)
        own, own_bias, pair, pair_bias, both, both_bias, of_own, *others = self._layers
        attend, attend_bias, alone, alone_bias, dense, dense_bias, head, head_bias = others
        everyone = self.see(people.xy_m, people.valid)
        track, other = pairs_of(people, everyone.xy_m[:, -1])
        tracks = taken(everyone, people.row)
        viewer, two = taken(tracks, track), taken(everyone, other)
        ego = np.tanh(np.concatenate([own_features(tracks), tracks.state], axis=1) @ own + own_bias)
        seen = np.tanh(pair_features(viewer, two, self.step_s) @ pair + pair_bias)
        seen = np.tanh(seen @ both + both_bias + (ego @ of_own)[track])
        score = seen @ attend + attend_bias  # for the pool, and for taking over displacements, early and late
        odds, of_alone = np.exp(score), np.exp(ego @ alone + alone_bias)
        share = odds / (of_alone + _summed(odds, track, len(ego)))[track]
        pool = _summed(share[:, :1] * seen, track, len(ego))
        total = _summed(seen / (1 + np.exp(-score[:, :1])), track, len(ego))
        late = np.linspace(0.0, 1.0, self.steps)
        followed = (1 - late) * share[:, 1:2] + late * share[:, 2:3]  # (P, T)
        differ = (two.mean - two.xy_m[:, -1:]) - (viewer.mean - viewer.xy_m[:, -1:])
        mean = tracks.mean + _summed(followed[..., None] * differ, track, len(ego))
        hidden = np.tanh(np.concatenate([ego, pool, total], axis=1) @ dense + dense_bias)
        outputs = (hidden @ head + head_bias).reshape(len(ego), self.steps, OUTPUTS)
        gate = tracks.gate[:, None]
        mean += (outputs[..., :2] * (gate * tracks.spread)[..., None]) @ tracks.turn
        scale = np.exp(outputs[..., 2:3] + (gate * outputs[..., 3])[..., None] * [1.0, -1.0])
        turn = tracks.turn[:, None]
        cov = turn @ tracks.cov @ turn.transpose(0, 1, 3, 2) * scale[..., :, None] * scale[..., None, :]
        cov = turn.transpose(0, 1, 3, 2) @ cov @ turn
        return Forecast(mean, (cov + cov.transpose(0, 1, 3, 2)) / 2)


def _summed(values: Floats, track: Ints, count: int) -> Floats:
    """Sums (B, ...) of values (P, ...) by track, which are in order."""
    out = np.zeros((count, *values.shape[1:]))
    starts = np.flatnonzero(np.diff(track, prepend=-1))
    if len(starts):
        out[track[starts]] = np.add.reduceat(values, starts, axis=0)
    return out


def social(steps: int, step_s: float, file: Path | None = None) -> Social:
    """``red`` corrected by what other people do, with the weights of a file or those that come with mcaptrack."""
    return Social.of(load(file or SHIPPED / "social.safetensors"))
