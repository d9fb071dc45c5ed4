"""``red``: a recurrent encoder with a dense head (after Becker et al. 2018, "RED"), and a covariance for every step.

The network corrects a linear forecast. Its input is up to eight past positions, with gaps and short histories masked,
in a frame of reference with the direction of the linear forecast as first axis. Its output is, for each future step, a
correction, a width of the error, the ratio along / across, and a correlation. All that depends on the direction fades
with the speed, so that people who stand have circular ellipses and forecasts rotate with their inputs.
``blend`` is the mean of that and of constant velocity: it is better than either where one of them is off.

Letters: B batch, L past positions (8), K pairs of them (4), T future steps, H hidden numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.geometry.histories import fill_gaps, last_positions
from mcaptrack.predictors.forecast import Forecast
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.weights import SHIPPED, Network, load

#: Number of past positions, and how many of them form one input of the recurrent unit.
PAST: Final = 8
PAIR: Final = 2
#: Number of features of a pair: position, displacement and validity of each, and the length of the linear forecast.
FEATURES: Final = 5 * PAIR + 1
#: Outputs per step: two corrections, width, elongation, correlation.
OUTPUTS: Final = 5
WIDTH: Final = 2
#: Length of the linear forecast at which direction-dependent outputs count half.
_HALFWAY_M: Final = 0.3
#: A length that is practically 0.
_TINY_M: Final = 1e-12
#: Largest correlation of errors along and across.
MOST_CORRELATED: Final = 0.95


class Inputs(NamedTuple):
    """The input of the network, and the linear forecast that it corrects.

    ``features`` (B, K, FEATURES); ``started`` (B, K): whether the history begins before or in a pair; ``turn``
    (B, 2, 2) rotates into the frame of the forecast; ``mean`` (B, T, 2) m; ``spread`` (B, T) m; ``gate`` (B,): weight
    of direction-dependent outputs.
    """

    features: Floats
    started: Bools
    turn: Floats
    mean: Floats
    spread: Floats
    gate: Floats


def prepare(xy_m: Floats, valid: Bools, base_weights: Floats, base_spread: Floats) -> Inputs:
    """Convert positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always, to network inputs.

    ``base_weights`` (L + 1, T, L) and ``base_spread`` (L + 1, T): the linear forecast by the number of known positions.
    """
    xy_m, valid = last_positions(xy_m, valid, PAST)
    batch = len(valid)
    filled, count = fill_gaps(xy_m, valid)
    now = filled[:, -1:]
    relative = filled - now
    ahead = base_weights[count] @ relative
    east, north = ahead[:, -1, 0] + _TINY_M, ahead[:, -1, 1]  # a forecast of length 0 points east
    far = np.hypot(east, north)
    turn = np.empty((batch, 2, 2))
    turn[:, 0, 0] = turn[:, 1, 1] = east / far
    turn[:, 0, 1] = north / far
    turn[:, 1, 0] = -turn[:, 0, 1]
    relative = relative @ turn.transpose(0, 2, 1)
    features = np.zeros((batch, PAST, FEATURES // PAIR))
    features[:, :, :2] = relative
    np.subtract(relative[:, 1:], relative[:, :-1], out=features[:, 1:, 2:4])
    features[:, :, 2:4] *= 2.0
    features[:, :, 4] = valid
    pairs = PAST // PAIR
    inputs = np.empty((batch, pairs, FEATURES))
    inputs[:, :, :-1] = features.reshape(batch, pairs, FEATURES - 1)
    inputs[:, :, -1] = (far / 5)[:, None]
    started = np.arange(1, pairs + 1) * PAIR > (PAST - count)[:, None]
    return Inputs(inputs, started, turn, now + ahead, base_spread[count], far / (far + _HALFWAY_M))


@dataclass(frozen=True)
class Red(Network):
    """The network in NumPy. Its forecasts equal those of the trained network up to rounding of 64-bit numbers.

    References
    ----------
    Becker et al., "RED: A simple but effective baseline predictor for the TrajNet benchmark", ECCV Workshops 2018.
    """

    name: ClassVar[str] = "red"
    past: ClassVar[int] = PAST

    @cached_property
    def _layers(self) -> tuple[Floats, ...]:
        get, steps = self.weights.get, self.steps
        hidden = self.weights.tensors["gru.weight_hh"].shape[-1] if "gru.weight_hh" in self.weights.tensors else 0
        into, inside = get("gru.weight_ih", 3 * hidden, FEATURES).T, get("gru.weight_hh", 3 * hidden, hidden).T
        bias, bias_inside = get("gru.bias_ih", 3 * hidden).copy(), get("gru.bias_hh", 3 * hidden)
        # A sigmoid is a tanh of half the number: one call for both gates. All biases but the candidate's add up. Each
        # gate is a matrix of its own, contiguous in memory: that alone makes it twice as fast.
        half = np.array([0.5, 0.5, 1.0])[:, None, None]
        bias[: 2 * hidden] += bias_inside[: 2 * hidden]
        by_output = np.arange(steps * OUTPUTS).reshape(steps, OUTPUTS).T
        return (
            np.ascontiguousarray(into.reshape(FEATURES, 3, hidden).transpose(1, 0, 2) * half),
            bias.reshape(3, 1, hidden) * half,
            np.ascontiguousarray(inside.reshape(hidden, 3, hidden).transpose(1, 0, 2) * half),
            bias_inside[2 * hidden :].copy(),
            np.ascontiguousarray(get("dense.weight", None, hidden).T),
            get("dense.bias", None),
            np.ascontiguousarray(get("head.weight", steps * OUTPUTS, None).T[:, by_output].transpose(1, 0, 2)),
            get("head.bias", steps * OUTPUTS)[by_output][:, None],
            get("base.weights", PAST + 1, steps, PAST),
            get("base.spread", PAST + 1, steps),
        )

    def _encode(self, features: Floats, started: Bools) -> Floats:
        """The gated recurrent unit (Cho et al. 2014): (B, K, FEATURES) -> (B, H)."""
        into, bias, inside, bias_inside, *_ = self._layers
        batch, pairs, _ = features.shape
        inputs = features.transpose(1, 0, 2).reshape(-1, FEATURES) @ into
        inputs += bias
        hidden = len(bias_inside)
        inputs = inputs.reshape(3, pairs, batch, hidden)
        state: Floats = np.zeros((batch, hidden))
        all_started: Bools = np.asarray(started.all(axis=0))
        for pair in range(pairs):
            old = state @ inside if pair else np.zeros((3, batch, hidden))
            gates = inputs[:2, pair] + old[:2]
            np.tanh(gates, out=gates)
            gates += 1.0
            gates *= 0.5
            candidate = old[2]
            candidate += bias_inside
            candidate *= gates[0]
            candidate += inputs[2, pair]
            np.tanh(candidate, out=candidate)
            new = state - candidate
            new *= gates[1]
            new += candidate
            state = new if all_started[pair] else np.where(started[:, pair, None], new, state)
        return state

    def predict(self, xy_m: Floats, valid: Bools) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        *_, dense, dense_bias, head, head_bias, base_weights, base_spread = self._layers
        inputs = prepare(xy_m, valid, base_weights, base_spread)
        state = self._encode(inputs.features, inputs.started)
        outputs = np.tanh(state @ dense + dense_bias) @ head + head_bias  # (OUTPUTS, B, T)
        gate, spread = inputs.gate[:, None], inputs.spread
        off = outputs[:WIDTH] * (gate * spread)
        mean = inputs.mean + off.transpose(1, 2, 0) @ inputs.turn
        width, longer = spread * np.exp(outputs[WIDTH]), np.exp(gate * outputs[3])
        along, across = width * longer, width / longer
        parts = np.empty((*along.shape, 3))  # variances along and across, and covariance
        parts[:, :, 0] = along * along
        parts[:, :, 1] = across * across
        parts[:, :, 2] = MOST_CORRELATED * np.tanh(gate * outputs[4]) * along * across
        cos, sin = inputs.turn[:, 0, 0], inputs.turn[:, 0, 1]
        turned = np.empty((len(mean), 3, 4))  # parts to xx, xy, yx, yy
        both = cos * sin
        turned[:, 0, 0] = turned[:, 1, 3] = cos * cos
        turned[:, 0, 3] = turned[:, 1, 0] = sin * sin
        turned[:, 0, 1] = turned[:, 0, 2] = both
        turned[:, 1, 1] = turned[:, 1, 2] = -both
        turned[:, 2, 0], turned[:, 2, 3] = -2 * both, 2 * both
        turned[:, 2, 1] = turned[:, 2, 2] = cos * cos - sin * sin
        return Forecast(mean, (parts @ turned).reshape(*mean.shape, 2))


@dataclass(frozen=True)
class Blend(Red):
    """The mean of what ``red`` and constant velocity predict, with the covariance of ``red``.

    ``red`` is better where positions are noisy, constant velocity where people walk straight on; their mean is no worse
    than constant velocity in either (docs/predictors.md has the figures).

    References
    ----------
    J. M. Bates and C. W. J. Granger, "The combination of forecasts", Operational Research Quarterly, 1969.
    """

    name: ClassVar[str] = "blend"
    network: ClassVar[str] = Red.name

    @cached_property
    def _constant_velocity(self) -> LinearPredictor:
        return LinearPredictor("cv", self.steps, self.step_s)

    def predict(self, xy_m: Floats, valid: Bools) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        network, straight = super().predict(xy_m, valid), self._constant_velocity.predict(xy_m, valid)
        return network._replace(mean=(network.mean + straight.mean) / 2)


def red(steps: int, step_s: float, file: Path | None = None) -> Red:
    """A recurrent encoder with a dense head, with the weights of a file or those that come with mcaptrack."""
    return Red.of(load(file or SHIPPED / "red.safetensors"))


def blend(steps: int, step_s: float, file: Path | None = None) -> Blend:
    """The mean of ``red`` and ``cv``, with the weights of a file or those that come with mcaptrack."""
    return Blend.of(load(file or SHIPPED / "red.safetensors"))
