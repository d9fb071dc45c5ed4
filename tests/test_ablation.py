"""The table of parts of re-tracking: its rows are what their options say, and its cells what was scored."""

from __future__ import annotations

from dataclasses import fields

from mcaptrack.transforms import PROFILES
from tools.ablation import PARTS, STEPS, cell


def test_each_part_is_left_out_once_and_the_steps_end_at_the_default():
    default = PROFILES["default"]
    assert PARTS["the default"][1] == default == list(STEPS.values())[-1][1]
    changed = [
        [one.name for one in fields(default) if getattr(options, one.name) != getattr(default, one.name)]
        for _, options in PARTS.values()
    ]
    assert sorted(len(names) for names in changed) == [0] + [1] * (len(PARTS) - 1)
    switches = {one.name for one in fields(default) if getattr(default, one.name) is True}
    switches -= {"adapt", "adapt_online", "appearance"}  # of ellipses, of online tracks and of pictures
    assert switches <= {name for names in changed for name in names}


def test_cells_hold_means_and_spreads_by_hand():
    scores = {"IDF1": [90.0, 92.0, 94.0], "MOTA": [80.0, 80.0, 80.0], "IDSW": [1.0, 2.0, 6.0]}
    assert cell(scores, is_seeded=True) == "92.0 (2.0) / 80.0 (0.0) / 3.0 (2.6)"
    assert cell(scores, is_seeded=False) == "90.0 (1.4) / 80.0 (0.0) / 1.0 (2.8)"  # the first is of all scenes
