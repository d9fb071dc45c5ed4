"""Cases of networks for the tests of the core."""

from __future__ import annotations

from typing import Any

import mcaptrack
from tests.extensions.networks.models import stocked

READING = {"models": None}  # it reads no log
EFFECTS = {"models": None}  # those of its options are in test_models
LINES = {"models": "models"}
PREPARED = {"networks": stocked}


def _with_other_weights(scene: Any) -> str:
    """Damage the fetched file of a model."""
    path = mcaptrack.models()[0].path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"damaged")
    return scene.says("detect", "LOG", "--detector", "yolox-nano")


PROPOSALS = {
    "extensions/networks/catalogue.py:check:get_model": _with_other_weights,
    "extensions/networks/catalogue.py:stored:get_model": lambda scene: scene.says(
        "detect", "LOG", "--detector", "yolox-nano"
    ),
    "extensions/networks/api.py:get_model:get_model": lambda scene: scene.says(
        "models", "get", "yolox-nano", "--from", "http://127.0.0.1:1/"
    ),
    "extensions/networks/command.py:arguments:models": lambda scene: scene.says("models", "get"),
    "extensions/networks/command.py:show:models": lambda scene: scene.says("models"),
    "extensions/networks/command.py:show:run": lambda scene: scene.says("models", "get", "yolox-nano"),
}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "networks": (
        "it runs and watches a process with limits that the environment sets, and predicts from gaps in tracks",
        "environment geometry.histories processes",
    )
}
