"""The weights of what tells people from false tracks, and right joins and links from wrong ones.

All are logistic regressions, fitted on synthetic scenes with the faults of trackers: ``tools/fit_retrack.py`` makes
the file, which says how. No recording was used.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.geometry.arrays import Floats

WEIGHTS: Final = Path(__file__).with_name("weights.json")
_FILE: Final[Mapping[str, Any]] = json.loads(WEIGHTS.read_text(encoding="utf-8"))


def weights_of(model: str, features: Sequence[str]) -> tuple[Floats, Mapping[str, Any]]:
    """The weight of each of the features (F,) of a model as a log odds ratio, and its other numbers by name."""
    entry = _FILE[model]
    return np.array([entry["weights"][name] for name in features]), entry
