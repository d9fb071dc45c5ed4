"""Medians and intervals of 90 % of numbers that differ between worlds of re-tracking."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack import notices

__all__ = ["WorldInterval", "lacks_intervals"]

#: Intervals of counts, and of other numbers, are wider than 90 % of the worlds by this share of the median on both
#: sides, for what worlds get wrong alike. (Chosen on drawn scenes, as are the values below.)
WIDER, WIDER_MEAN = 0.06, 0.1
#: There are no intervals for fewer people; where larger shares of tracks begin, and end, in the middle of the seen area
#: even if all go on that can; and where some worlds have so many times more people than others.
_FEW, _LATE, _LOST, _APART = 15, 0.1, 0.4, 3.0


class WorldInterval(NamedTuple):
    """The ``median`` of a number in all worlds, and an interval of 90 % from ``low`` to ``high``; None for none."""

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
        wider = (WIDER if is_count else WIDER_MEAN) * abs(middle)
        low, high = low - wider, high + wider
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


def lacks_intervals(worlds: Sequence[tuple[int, float, float]]) -> bool:
    """Whether the log can't tell how sure numbers are; then it is said why.

    Of each world there are the number of its people, and the shares of tracks that are ``late`` and ``lost`` (see
    ``WorldTracks``).
    """
    people, late, lost = np.array(worlds, float).T
    low, middle, high = np.quantile(people, (0.05, 0.5, 0.95)).tolist()
    least_late, least_lost = np.quantile([late, lost], 0.05, axis=1).tolist()
    if middle < _FEW:
        why = f"there are only {middle:g} people; how often they are missed can't be told from fewer than {_FEW}"
    elif high > _APART * low:
        why = f"there are {low:g} to {high:g} people, by which tracks are taken for some"
    elif least_late > _LATE or least_lost > _LOST:
        share, verbs = (least_late, "begin") if least_late > _LATE else (least_lost, "end")
        why = (
            f"{share:.0%} of the tracks {verbs} in the middle of the seen area, away from others that may be the same "
            "person; many people may never be tracked"
        )
    else:
        return False
    notices.warn(f"numbers have no intervals: {why}", "not-compared")
    return True
