"""Cases of ``review`` for the tests of the core."""

import json
from pathlib import Path

import numpy as np

import mcaptrack
from tests.worlds import noisy_tracks, write_channels

READING = {"review": lambda log, out: [log, "--print"]}
EFFECTS = {"review": None}  # its options are seen where tracks are doubtful: test_review


def _answered(scene) -> str:
    """Answer the only question about people who were occluded."""
    walks = noisy_tracks(np.random.default_rng(2), people=2, ticks=20, hidden=0.05)
    mcaptrack.retrack(write_channels(scene.path, samples=walks))
    (name,) = mcaptrack.review(scene.path).questions
    Path("answers.json").write_text(json.dumps({name: "yes"}))
    return scene.says("review", "LOG", "--answers", "answers.json")


def _by_consistency(scene) -> str:
    """Ask about tracks of the method of the paper, which has no probabilities."""
    scene.says("retrack", "LOG", "--retracker", "consistency", "--force")
    return scene.says("review", "LOG")


PROPOSALS = {
    "extensions/review/questions.py:solve:retrack": _by_consistency,
    "extensions/review/questions.py:solve:run": lambda s: s.untracked().says("review", "LOG"),
    "extensions/review/command.py:show:review": _answered,
}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "review": (
        "its answers are written as the channels of a stage are",
        "pipeline.rebuild pipeline.write sources.sidecar transforms.retrack.options",
    )
}
