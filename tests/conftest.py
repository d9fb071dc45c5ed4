"""What all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# The same examples each time, so that a run says something about a change; `--hypothesis-profile search` looks for new
# ones, and for many more.
settings.register_profile("same", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
settings.register_profile("search", settings.get_profile("same"), derandomize=False, print_blob=True, max_examples=3000)
settings.load_profile("same")


@pytest.fixture(scope="session", autouse=True)
def no_settings(tmp_path_factory) -> Iterator[None]:
    """Tests know nothing of the settings of whoever runs them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """Real data to compare with, if there is any: a folder named by MCAPTRACK_DATA."""
    folder = os.environ.get("MCAPTRACK_DATA", "")
    if not folder:
        pytest.skip("MCAPTRACK_DATA names no folder with reference data")
    return Path(folder)
