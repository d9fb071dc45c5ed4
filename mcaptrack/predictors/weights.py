"""Files of learned weights: safetensors with a model card in the header. Nothing is unpickled."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import unreadable
from mcaptrack.geometry.arrays import Floats

#: The folder of the weights that come with mcaptrack.
SHIPPED: Final = Path(__file__).parent / "trained"


@dataclass(frozen=True)
class Weights:
    """Named arrays and their model card: ``network``, ``steps``, ``step_s``, and how they were trained."""

    path: Path
    tensors: Mapping[str, Floats]
    card: Mapping[str, str]
    sha256: str

    def get(self, name: str, *shape: int | None) -> Floats:
        """One array, of the given shape (None for any size). Raises McaptrackError if it is missing or different."""
        array = self.tensors.get(name)
        if array is None:
            raise McaptrackError(f"{self.path} has no {name}; it has {', '.join(sorted(self.tensors)) or 'nothing'}")
        fits = len(shape) == array.ndim and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if not fits or not np.isfinite(array).all():
            wanted = "x".join("n" if size is None else str(size) for size in shape)
            has = "x".join(map(str, array.shape)) if not fits else "numbers that are not finite"
            raise McaptrackError(f"{self.path}: {name} has to be {wanted}, not {has}")
        return array

    def clock(self, network: str) -> tuple[int, float]:
        """Number of steps and their length in seconds. Raises McaptrackError if the weights are of another network."""
        if self.card.get("network") != network:
            what = self.card.get("network") or "weights that mcaptrack did not train"
            raise McaptrackError(f"{self.path} holds {what}, not {network}")
        try:
            steps, step_s = int(self.card["steps"]), float(self.card["step_s"])
        except (KeyError, ValueError):
            steps, step_s = 0, 0.0
        if steps < 1 or not 0 < step_s < float("inf"):
            raise McaptrackError(f"{self.path}: its card lacks the number of steps or their length (steps, step_s)")
        return steps, step_s


@dataclass(frozen=True)
class Network:
    """A trained network that runs in NumPy. ``network`` is that which its weights are of, if it isn't ``name``."""

    weights: Weights
    name: ClassVar[str]
    network: ClassVar[str] = ""

    @classmethod
    def of(cls, weights: Weights) -> Self:
        """Make the network. Raises McaptrackError if the weights are not of this network."""
        network = cls(weights)
        _ = network.steps, network._layers
        return network

    @property
    def _layers(self) -> tuple[Floats, ...]:
        """The arrays of the network in the layout that ``predict`` uses."""
        raise NotImplementedError

    @property
    def steps(self) -> int:
        return self.weights.clock(self.network or self.name)[0]

    @property
    def step_s(self) -> float:
        return self.weights.clock(self.network or self.name)[1]

    @property
    def weights_sha256(self) -> str:
        return self.weights.sha256


def load(path: Path) -> Weights:
    """Read a file of weights. Raises McaptrackError if it is not one."""
    try:
        stat = path.stat()
    except OSError as error:
        raise unreadable(path, error) from None
    return _load(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=16)
def _load(path: Path, _changed: int, _size: int) -> Weights:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as opened:
            card = opened.metadata() or {}
            tensors = {name: np.asarray(opened.get_tensor(name), np.float64) for name in opened.keys()}  # noqa: SIM118
        return Weights(path, tensors, card, hashlib.sha256(path.read_bytes()).hexdigest())
    except (SafetensorError, TypeError, ValueError) as error:
        raise McaptrackError(f"{path} is not a file of weights (safetensors): {error}") from None
    except OSError as error:
        raise unreadable(path, error) from None


def save(path: Path, tensors: Mapping[str, NDArray[np.floating]], card: Mapping[str, str]) -> None:
    """Write weights as 32-bit floats with their card in the header; the same weights give the same bytes."""
    import safetensors.numpy

    from mcaptrack.files import publish_bytes

    flat = {name: np.ascontiguousarray(value, np.float32) for name, value in sorted(tensors.items())}
    data = safetensors.numpy.save(flat, dict(card))
    # The library writes the header in an order that changes from run to run: rewrite it in a fixed order.
    length = int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8 : 8 + length]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    publish_bytes(path, len(header).to_bytes(8, "little") + header + data[8 + length :])
