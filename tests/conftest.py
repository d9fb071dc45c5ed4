"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("mcaptrack", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("mcaptrack")


@pytest.fixture(scope="session")
def data() -> Path:
    """Real data to compare with, if there is any: a folder named by MCAPTRACK_DATA."""
    folder = os.environ.get("MCAPTRACK_DATA", "")
    if not folder:
        pytest.skip("MCAPTRACK_DATA names no folder with reference data")
    return Path(folder)
