"""``onnx:FILE``: a network in ONNX format, run by ONNX Runtime.

Input: positions ``obs`` (B, L, 2) float32 in metres relative to the last one, and, if the network has a second input,
``valid`` (B, L) bool. Output: positions (B, T, 2) relative to the same point, and, if there is a second one, covariance
(B, T, 2, 2) in m^2. B is dynamic. Metadata of the file may set ``step_s`` (0.4 otherwise).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Final, Self

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks.network import NetworkFile, NetworkLimits, OnnxNetwork, read_file
from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.geometry.histories import fill_gaps, last_positions
from mcaptrack.predictors import Forecast, Predictor, are_covariances, make

_STEP_S: Final = 0.4
#: The most positions that a network may take or give for a track: more than an hour of them, and little memory.
_MAX_STEPS: Final = 10_000


@dataclass(frozen=True)
class Onnx:
    """A network in ONNX format (see the module). Without a covariance of its own it has that of ``kalman``."""

    path: Path
    network: OnnxNetwork
    past: int
    steps: int
    step_s: float
    weights_sha256: str
    name: str = "onnx"

    @classmethod
    def of(cls, path: Path) -> Self:
        """Open and test the network. Raises McaptrackError if it can't be run or has other inputs or outputs."""
        limits = NetworkLimits.of_environment()
        return cls._of(read_file(path, limits), limits)

    @classmethod
    @lru_cache(maxsize=4)
    def _of(cls, file: NetworkFile, limits: NetworkLimits) -> Self:
        network = OnnxNetwork(file, limits)
        try:
            return cls._tried(file, network)
        except BaseException:
            network.close()
            raise

    @classmethod
    def _tried(cls, file: NetworkFile, network: OnnxNetwork) -> Self:
        path, sha256 = file.path, file.sha256
        shape = next((shape for _, shape, _ in network.facts["inputs"]), [])
        if len(shape) != 3 or not isinstance(shape[1], int) or shape[2] != 2:
            raise McaptrackError(f"{path}: its first input has to be B x L x 2 with a fixed L, not {shape}")
        if shape[1] > _MAX_STEPS:
            raise McaptrackError(f"{path} takes {shape[1]:,} past positions; at most {_MAX_STEPS:,} are supported")
        text = network.facts["metadata"].get("step_s", "")
        try:
            step_s = float(text or _STEP_S)
        except ValueError:
            step_s = 0.0
        if not 0 < step_s < float("inf"):
            raise McaptrackError(f"{path}: its metadata have step_s = {text!r}; a positive number of seconds is needed")
        tried = cls(path, network, shape[1], 0, step_s, sha256)
        outputs_by_batch = [
            tried._run(np.zeros((batch, shape[1], 2)), np.ones((batch, shape[1]), bool)) for batch in (1, 7)
        ]
        steps = {outputs[0].shape[1] for outputs in outputs_by_batch}
        declared = network.facts["outputs"][0][1]  # some declare none
        steps |= {size for size in declared[1:2] if isinstance(size, int)}
        if len(steps) > 1:
            raise McaptrackError(
                f"{path} declares the output {declared}, and returns {sorted(steps)} steps, depending on the batch"
            )
        return cls(path, network, shape[1], steps.pop(), step_s, sha256)

    @cached_property
    def _covariance_model(self) -> Predictor:
        return make("kalman", self.steps, self.step_s)

    def _run(self, xy_m: Floats, valid: Bools) -> list[Floats]:
        arrays = (xy_m.astype(np.float32), valid)
        inputs = {name: values for (name, _, _), values in zip(self.network.facts["inputs"], arrays, strict=False)}
        try:
            outputs = self.network.run(inputs)[:2]
        except BaseException:  # it may have ended: the next who wants it opens it again
            Onnx._of.cache_clear()
            raise
        mean = outputs[0] if outputs else np.empty(0)
        if mean.ndim == 3 and mean.shape[1] > _MAX_STEPS:
            raise McaptrackError(f"{self.path} returns {mean.shape[1]:,} steps; at most {_MAX_STEPS:,} are supported")
        fits = mean.ndim == 3 and len(mean) == len(xy_m) and mean.shape[1] > 0 and mean.shape[2] == 2
        if fits and len(outputs) > 1:
            fits = outputs[1].shape == (*mean.shape, 2)
        if not fits:
            shapes = " and ".join(str(output.shape) for output in outputs)
            raise McaptrackError(
                f"{self.path} has to return (B, T, 2), and may return (B, T, 2, 2); it returns {shapes}"
            )
        outputs = [output.astype(np.float64) for output in outputs]
        if not all(np.isfinite(output).all() for output in outputs):
            raise McaptrackError(f"{self.path} returns numbers that are not finite")
        if len(outputs) > 1 and not are_covariances(outputs[1]):
            raise McaptrackError(
                f"{self.path} returns matrices that are no covariances: variances of 0 or less, or not symmetric"
            )
        return outputs

    def predict(self, xy_m: Floats, valid: Bools) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        if len(valid) == 0:
            return Forecast(np.empty((0, self.steps, 2)), np.empty((0, self.steps, 2, 2)))
        padded, is_known = last_positions(xy_m, valid, self.past)
        filled, _ = fill_gaps(padded, is_known)
        now = filled[:, -1:]
        outputs = self._run(filled - now, is_known)
        cov = outputs[1] if len(outputs) > 1 else self._covariance_model.predict(xy_m, valid).cov
        return Forecast(now + outputs[0], cov)


def onnx(steps: int, step_s: float, file: Path) -> Onnx:
    """A network in ONNX format, with steps of its own."""
    return Onnx.of(file)
