"""The weights of what tells people from false tracks, and right joins and links from wrong ones.

All are logistic regressions, fitted on synthetic scenes with the faults of trackers: ``tools/fit_retrack.py`` makes
the file, which says how. No recording was used.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack.geometry.arrays import Floats

WEIGHTS: Final = Path(__file__).with_name("weights.json")
FILE: Final[Mapping[str, Any]] = json.loads(WEIGHTS.read_text(encoding="utf-8"))


class Logistic(NamedTuple):
    """A logistic regression: weights of features (F,), by name, as log odds ratios, the log odds without any, and other
    numbers.
    """

    names: tuple[str, ...]
    weights: Floats
    bias: float
    numbers: Mapping[str, Any]

    @classmethod
    def of(cls, model: str) -> Logistic:
        """The model of this name in the file."""
        entry = FILE[model]
        return cls(tuple(entry["weights"]), np.array([*entry["weights"].values()]), float(entry["bias"]), entry)

    def log_odds(self, features: Floats) -> Floats:
        """The log odds (N,) of what has these features (N, F)."""
        return np.asarray(features @ self.weights + self.bias)

    def probability(self, features: Floats) -> Floats:
        """The probability (N,) of what has these features (N, F)."""
        return probability(self.log_odds(features))


class Choices(NamedTuple):
    """Multinomial logits of what ends and beginnings of tracklets choose: one of the links, or none.

    ``links`` (H, F) are the weights of ``terms`` of links by the class of their gap, ``leaves`` and ``comes`` (G,) of
    ``end_terms`` of ends and beginnings; ``usual_leaves`` and ``usual_comes`` (H + 1,) say how often each class is
    chosen where they were fitted, and none (the last).
    """

    terms: tuple[str, ...]
    end_terms: tuple[str, ...]
    links: Floats
    leaves: Floats
    comes: Floats
    usual_leaves: Floats
    usual_comes: Floats

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Choices:
        """The model of an entry of the file."""
        terms, end_terms = tuple(next(iter(entry["links"].values()))), tuple(entry["leaves"])
        links = [[weights[name] for name in terms] for weights in entry["links"].values()]
        ends = [[entry[side][name] for name in end_terms] for side in ("leaves", "comes")]
        usual = [[entry[side][name] for name in (*entry["links"], "none")] for side in ("usual_leaves", "usual_comes")]
        return cls(terms, end_terms, np.array(links), *map(np.array, (*ends, *usual)))


def columns(names: Sequence[str], values: Mapping[str, ArrayLike]) -> Floats:
    """Values (N,) by name as columns in the order of the names, (N, F)."""
    return np.column_stack([values[name] for name in names]).astype(np.float64)


def probability(log_odds: Floats) -> Floats:
    """Log odds as probabilities."""
    return np.asarray(1 / (1 + np.exp(-log_odds)))
