"""Ranges of numbers in words."""

from __future__ import annotations

import math


def limits(least: float, most: float) -> str:
    """The text of a range, as in "from 0 to 1"; "" if it has no ends."""
    if most == math.inf:
        return "" if least == -math.inf else f"at least {_number(least)}"
    return f"at most {_number(most)}" if least == -math.inf else f"from {_number(least)} to {_number(most)}"


def _number(value: float) -> str:
    return f"{value:.15g}"
