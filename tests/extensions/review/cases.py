"""Cases of ``review`` for the tests of the core."""

import json
from pathlib import Path

import mcaptrack

READING = {"review": lambda log, out: [log, "--print"]}
EFFECTS = {"review": None}  # its options are seen where tracks are doubtful: test_review


def _answered(scene) -> str:
    """Answer the first question."""
    (name, *_) = mcaptrack.review(scene.path, questions=1).questions
    Path("answers.json").write_text(json.dumps({name: "yes"}))
    return scene.says("review", "LOG", "--answers", "answers.json")


PROPOSALS = {
    "extensions/review/questions.py:solve:run": lambda s: s.untracked().says("review", "LOG"),
    "extensions/review/command.py:show:review": _answered,
}
