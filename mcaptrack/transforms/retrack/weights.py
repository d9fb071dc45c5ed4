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

from mcaptrack.geometry.arrays import Floats

WEIGHTS: Final = Path(__file__).with_name("weights.json")
_FILE: Final[Mapping[str, Any]] = json.loads(WEIGHTS.read_text(encoding="utf-8"))


class Logistic(NamedTuple):
    """A logistic regression: weights of features (F,) as log odds ratios, the log odds without any, other numbers."""

    weights: Floats
    bias: float
    numbers: Mapping[str, Any]

    @classmethod
    def of(cls, model: str, features: Sequence[str]) -> Logistic:
        """The model of this name in the file, for features in this order."""
        entry = _FILE[model]
        return cls(np.array([entry["weights"][name] for name in features]), float(entry["bias"]), entry)

    def log_odds(self, features: Floats) -> Floats:
        """The log odds (N,) of what has these features (N, F)."""
        return np.asarray(features @ self.weights + self.bias)

    def probability(self, features: Floats) -> Floats:
        """The probability (N,) of what has these features (N, F)."""
        return probability(self.log_odds(features))


class Choices(NamedTuple):
    """Multinomial logits of what ends and beginnings of tracklets choose: one of the links, or none.

    ``links`` (H, F) are the weights of the terms of links by the class of their gap, ``leaves`` and ``comes`` (G,) of
    the terms of ends and beginnings; ``usual_leaves`` and ``usual_comes`` (H + 1,) say how often each class is chosen
    where they were fitted, and none (the last).
    """

    links: Floats
    leaves: Floats
    comes: Floats
    usual_leaves: Floats
    usual_comes: Floats

    @classmethod
    def of(cls, model: str, gaps: Sequence[str], terms: Sequence[str], end_terms: Sequence[str]) -> Choices:
        """The model of this name in the file, for terms in this order."""
        return cls.from_entry(_FILE[model], gaps, terms, end_terms)

    @classmethod
    def from_entry(
        cls, entry: Mapping[str, Any], gaps: Sequence[str], terms: Sequence[str], end_terms: Sequence[str]
    ) -> Choices:
        """The model of an entry of such a file."""
        links = [[entry["links"][gap][name] for name in terms] for gap in gaps]
        ends = [[entry[side][name] for name in end_terms] for side in ("leaves", "comes")]
        usual = [[entry[side][name] for name in (*gaps, "none")] for side in ("usual_leaves", "usual_comes")]
        return cls(np.array(links), *map(np.array, (*ends, *usual)))


def probability(log_odds: Floats) -> Floats:
    """Log odds as probabilities."""
    return np.asarray(1 / (1 + np.exp(-log_odds)))
