"""``lstm``: the paper's network (Yu and Zhou 2021): an encoder and a decoder of one LSTM layer each, on displacements.

Every displacement goes through a linear layer into the encoder; the decoder starts with the last one and is fed its own
output. There is no nonlinearity between these layers, so they are folded into each other exactly: one matrix from the
displacement to the gates of the encoder, and one from the decoder's state to its own next gates.

Letters: B batch, L past positions (4), T future steps, H hidden numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.geometry.histories import fill_gaps, last_positions
from mcaptrack.predictors.forecast import Forecast
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.weights import SHIPPED, Network, load

PAST: Final = 4


@dataclass(frozen=True)
class Lstm(Network):
    """The network in NumPy, folded. Its covariance is that of ``kalman``, scaled per step by a calibrated factor.

    Gaps are interpolated linearly; before the first known position people are assumed to stand.

    References
    ----------
    Yu and Zhou, "Towards Robust Human Trajectory Prediction in Raw Videos", IROS 2021.
    """

    name: ClassVar[str] = "lstm"
    past: ClassVar[int] = PAST

    @cached_property
    def _covariance_model(self) -> LinearPredictor:
        return LinearPredictor("kalman", self.steps, self.step_s)

    @cached_property
    def _layers(self) -> tuple[Floats, ...]:
        get = self.weights.get
        hidden = self.weights.tensors["out.weight"].shape[-1] if "out.weight" in self.weights.tensors else 0
        # A sigmoid is a tanh of half the number. Each gate is a matrix of its own, contiguous in memory.
        half = np.array([0.5, 0.5, 1.0, 0.5])[:, None, None]
        folded = {}
        for part in ("encoder", "decoder"):
            into = get(f"{part}.lstm.weight_ih", 4 * hidden, None)
            embed = get(f"{part}.embed.weight", into.shape[1], 2)
            bias = get(f"{part}.lstm.bias_ih", 4 * hidden) + get(f"{part}.lstm.bias_hh", 4 * hidden)
            bias = bias + into @ get(f"{part}.embed.bias", into.shape[1])
            folded[part] = (into @ embed, bias, get(f"{part}.lstm.weight_hh", 4 * hidden, hidden))

        def by_gate(weights: Floats) -> Floats:
            """(4 H, N) -> (4, N, H)"""
            return np.ascontiguousarray(weights.reshape(4, hidden, -1).transpose(0, 2, 1) * half)

        out, out_bias = get("out.weight", 2, hidden), get("out.bias", 2)
        first, then = folded["encoder"], folded["decoder"]
        return (
            *(by_gate(part) for part in (*first, *then)),
            by_gate(then[2] + then[0] @ out),
            by_gate(then[1] + then[0] @ out_bias),
            np.ascontiguousarray(out.T),
            out_bias,
            get("spread", self.steps),
        )

    def predict(self, xy_m: Floats, valid: Bools) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        into, bias, inside, into_d, bias_d, inside_d, fed, fed_bias, out, out_bias, spread = self._layers
        filled, _ = fill_gaps(*last_positions(xy_m, valid, PAST))
        moves = np.diff(filled, axis=1, prepend=filled[:, :1])  # the first is 0, as in the authors' program
        batch, hidden = len(moves), inside.shape[-1]
        state: Floats = np.zeros((batch, hidden))
        memory = np.zeros((batch, hidden))
        for step in range(moves.shape[1]):
            state, memory = _cell(moves[:, step] @ into + state @ inside + bias, memory)
        memory = np.zeros_like(memory)
        gates = moves[:, -1] @ into_d + state @ inside_d + bias_d
        states = np.empty((batch, self.steps, hidden))
        for step in range(self.steps):
            state, memory = _cell(gates, memory)
            states[:, step] = state
            gates = state @ fed + fed_bias
        mean = filled[:, -1:] + np.cumsum(states @ out + out_bias, axis=1)
        cov = self._covariance_model.predict(xy_m, valid).cov * spread[:, None, None]
        return Forecast(mean, cov)


def _cell(gates: Floats, memory: Floats) -> tuple[Floats, Floats]:
    """One step of an LSTM (Hochreiter, Schmidhuber 1997): state and memory (B, H) from gates i, f, g, o (4, B, H)."""
    gates = np.tanh(gates)
    new = gates[2].copy()
    gates += 1.0
    gates *= 0.5
    enter, keep, _, leave = gates
    memory = keep * memory + enter * new
    return leave * np.tanh(memory), memory


def lstm(steps: int, step_s: float, file: Path | None = None) -> Lstm:
    """An LSTM encoder and decoder, with the weights of a file or those that come with mcaptrack."""
    return Lstm.of(load(file or SHIPPED / "lstm.safetensors"))
