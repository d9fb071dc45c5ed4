"""Fixtures of the tests of networks."""

from __future__ import annotations

import pytest


@pytest.fixture
def networks_here(monkeypatch) -> None:
    """Run networks in this process, which takes less time; ``test_strange_networks`` has the other one."""
    monkeypatch.setattr("mcaptrack.extensions.networks.network._runs_apart", lambda is_trusted: False)
