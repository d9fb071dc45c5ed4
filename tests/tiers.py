"""Which cases of a test run by default, where there are many alike or where each takes long.

The default run is for everybody who changes something, and has to end in minutes. A case marked ``thorough`` runs with
``pytest -m ""``, as ``make test-all`` and the CI of every push do.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

thorough = pytest.mark.thorough


def one_in(count: int, cases: Iterable[Any]) -> list[Any]:
    """Cases for ``parametrize``, of which each ``count``-th runs by default."""
    return [
        case if not number % count else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=thorough)
        for number, case in enumerate(cases)
    ]
