"""Medians and intervals of 90 % of numbers that differ between worlds of re-tracking."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack import notices

#: Intervals are wider than 90 % of the worlds by this share of the median on both sides, because worlds lack rows that
#: no detector gave: so they hold in nine of ten drawn scenes (``tools/without_truth.py``).
WIDER: Final = 0.12


class WorldInterval(NamedTuple):
    """The median of a number in all worlds, and an interval of 90 %, given what was detected; None for none."""

    median: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, values: ArrayLike, is_count: bool = False, has_none: bool = False) -> WorldInterval:
        """Find the interval of the ``values`` of all worlds (W,), NaN for none; that of a count has whole ends.

        With ``has_none`` there is the median alone.
        """
        some = np.asarray(values, float)
        some = some[~np.isnan(some)]
        if not len(some):
            return cls(None, None, None)
        low, middle, high = np.quantile(some, (0.05, 0.5, 0.95)).tolist()
        if has_none:
            return cls(middle, None, None)
        low, high = low - WIDER * abs(middle), high + WIDER * abs(middle)
        low = low if some.min() < 0 else max(low, 0.0)
        return cls(middle, float(np.floor(low)), float(np.ceil(high))) if is_count else cls(middle, low, high)

    def to_json(self) -> dict[str, float | None]:
        """As values of JSON."""
        return {"median": self.median, "from": self.low, "to": self.high}

    def words(self, digits: int = 0, unit: str = "") -> str:
        """As text: the median, of counts also a half, and the interval in brackets; none for none."""
        if self.median is None:
            return ""
        middle = f"{self.median:.{digits}f}" if digits else f"{self.median:.12g}"
        return middle + ("" if self.low is None else f" ({self.low:.{digits}f} to {self.high:.{digits}f})") + unit


def is_people(name: str, values: ArrayLike, people: ArrayLike) -> bool:
    """Whether a number in all worlds (W,) is that of all their people (W,), which has no interval; that is said."""
    if not np.array_equal(values, people):
        return False
    notices.warn(
        f"{name}: the number of people has no interval; worlds hold it too seldom, because they lack people that no "
        "detector saw, and take those who come back late for others", "not-compared"
    )  # fmt: skip
    return True
