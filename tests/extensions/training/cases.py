"""Cases of ``train`` for the tests of the core."""

from importlib.util import find_spec

import pytest

from mcaptrack.cli.text import with_flags
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.training.sources import SourceOptions, read_scenes

READING = {
    "train": find_spec("torch") and (lambda log, out: [log, "-o", out / "trained", "--epochs", "1", "--device", "cpu"])
}
EFFECTS = {"train": None}  # what needs torch is in test_training
TOPICS = {
    "train": (
        "tracks",
        lambda p, t, _: [scene.xy_m.tobytes() for scene in read_scenes([p], SourceOptions(topic=t), 0.4)],
    )
}


def _without_tracks(scene) -> str:
    with pytest.raises(McaptrackError) as refused:
        read_scenes([scene.ingested("clip.mp4").path], SourceOptions(), 0.4)
    return with_flags(str(refused.value))


def _trained(scene) -> str:
    pytest.importorskip("torch", reason="training needs torch")
    return scene.says("train", "synthetic", "--walks", "1000", "--epochs", "1", "-o", "my net")


PROPOSALS = {
    "extensions/training/command.py:show:predict": _trained,
    "extensions/training/sources.py:_from_log:run": _without_tracks,
}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "training": (
        "it makes the weights that predictors read, of labels",
        "geometry.mixtures predictors.forecast predictors.linear predictors.lstm predictors.red predictors.weights "
        "sources.ingest.labels.reading sources.ingest.labels.roles sources.walks",
    )
}
