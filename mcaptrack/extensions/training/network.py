"""The networks in torch, for training; ``mcaptrack.predictors`` runs them in NumPy.

Letters: B batch, L past positions, K pairs of them, T future steps, H hidden numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import nn

from mcaptrack.extensions.training.windows import Windows
from mcaptrack.predictors import red
from mcaptrack.predictors.linear import LinearPredictor

#: A torch.Tensor; torch may be missing when types are checked.
Tensor = Any

_LSTM_HIDDEN = 64


class RedNetwork(nn.Module):
    """See ``mcaptrack.predictors.red``. Before training its forecasts are those of the Kalman filter."""

    def __init__(self, steps: int, step_s: float, hidden: int = 64, dense: int = 128) -> None:
        super().__init__()
        self.steps, self.hidden = steps, hidden
        self.gru = nn.GRUCell(red.FEATURES, hidden)
        self.dense = nn.Linear(hidden, dense)
        self.head = nn.Linear(dense, steps * red.OUTPUTS)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        weights, variance = LinearPredictor("kalman", steps, step_s).table
        self.base = (weights.astype(np.float32), np.sqrt(variance).astype(np.float32))

    def prepare(self, windows: Windows) -> dict[str, Tensor]:
        """The inputs of ``forward`` and the true future, as tensors with the window as first axis."""
        inputs = red.prepare(windows.past, windows.known, *(part.astype(np.float64) for part in self.base))
        out = {name: torch.tensor(part) for name, part in inputs._asdict().items()}
        out["future"] = torch.tensor(windows.future)
        return {name: part.float() if part.is_floating_point() else part for name, part in out.items()}

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """Means (B, T, 2) in m; standard deviations (B, T) along and across the direction; their correlation (B, T)."""
        features, started = batch["features"], batch["started"]
        state = features.new_zeros(len(features), self.hidden)
        for pair in range(features.shape[1]):
            new = self.gru(features[:, pair], state)
            state = torch.where(started[:, pair, None], new, state)
        outputs = self.head(torch.tanh(self.dense(state))).reshape(-1, self.steps, red.OUTPUTS)
        gate, spread = batch["gate"][:, None], batch["spread"]
        mean = batch["mean"] + (outputs[..., :2] * (gate * spread)[..., None]) @ batch["turn"]
        width, longer = spread * torch.exp(outputs[..., 2]), torch.exp(gate * outputs[..., 3])
        return mean, width * longer, width / longer, red.MOST_CORRELATED * torch.tanh(gate * outputs[..., 4])

    def loss(self, batch: dict[str, Tensor], distance_weight: float) -> tuple[Tensor, Tensor]:
        """The mean loss of a batch, and its forecasts (B, T, 2)."""
        mean, along, across, correlation = self(batch)
        off = (batch["future"] - mean) @ batch["turn"].transpose(1, 2)
        x, y, free = off[..., 0] / along, off[..., 1] / across, 1 - correlation**2
        nll = (x * x + y * y - 2 * correlation * x * y) / (2 * free) + torch.log(along * across) + torch.log(free) / 2
        distance = torch.sqrt((off**2).sum(-1) + 1e-6)
        return nll.mean() + distance_weight * distance.mean(), mean

    def tensors(self) -> dict[str, Any]:
        """The weights by the names that ``mcaptrack.predictors.red`` reads."""
        weights, spread = self.base
        return _to_numpy(self) | {"base.weights": weights, "base.spread": spread}


class _Cell(nn.Module):
    """The encoder or the decoder of the paper's network."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = nn.Linear(2, _LSTM_HIDDEN)
        self.lstm = nn.LSTMCell(_LSTM_HIDDEN, _LSTM_HIDDEN)

    def folded(self) -> tuple[Tensor, ...]:
        """The weights of the LSTM cell with the linear layer before it folded in, computed once per batch."""
        cell, embed = self.lstm, self.embed
        into, bias = cell.weight_ih @ embed.weight, cell.weight_ih @ embed.bias + cell.bias_ih
        return into, cell.weight_hh, bias, cell.bias_hh


class LstmNetwork(nn.Module):
    """See ``mcaptrack.predictors.lstm``: 67 074 parameters, displacements in and out."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.encoder, self.decoder = _Cell(), _Cell()
        self.out = nn.Linear(_LSTM_HIDDEN, 2)
        self.spread = np.ones(steps, np.float32)

    def prepare(self, windows: Windows) -> dict[str, Tensor]:
        """Displacements of the past and of the future, as tensors with the window as first axis."""
        path = np.concatenate([windows.past, windows.future], axis=1)
        moves = np.diff(path, axis=1, prepend=path[:, :1])
        length = windows.past.shape[1]
        parts = {"past": moves[:, :length], "future": moves[:, length:]}
        return {name: torch.tensor(part.astype(np.float32)) for name, part in parts.items()}

    def forward(self, moves: Tensor) -> Tensor:
        """Past displacements (B, L, 2), the first of them 0, to future ones (B, T, 2)."""
        state = memory = moves.new_zeros(len(moves), _LSTM_HIDDEN)
        encoder, decoder = self.encoder.folded(), self.decoder.folded()
        for step in range(moves.shape[1]):
            state, memory = torch.lstm_cell(moves[:, step], (state, memory), *encoder)
        memory, move, out = torch.zeros_like(memory), moves[:, -1], []
        for _ in range(self.steps):
            state, memory = torch.lstm_cell(move, (state, memory), *decoder)
            move = self.out(state)
            out.append(move)
        return torch.stack(out, dim=1)

    def loss(self, batch: dict[str, Tensor], angle: float | None) -> Tensor:
        """The sum of squared errors of a batch and, if ``angle`` is given, of the batch rotated by it (radians)."""
        past, future = batch["past"], batch["future"]
        if angle is not None:
            cos, sin = math.cos(angle), math.sin(angle)
            turn = past.new_tensor([[cos, sin], [-sin, cos]])
            past, future = torch.cat([past, past @ turn]), torch.cat([future, future @ turn])
        return ((self(past) - future) ** 2).sum()

    def tensors(self) -> dict[str, Any]:
        """The weights by the names that ``mcaptrack.predictors.lstm`` reads."""
        return _to_numpy(self) | {"spread": self.spread}


def _to_numpy(network: nn.Module) -> dict[str, Any]:
    return {name: part.detach().cpu().numpy() for name, part in network.state_dict().items()}
