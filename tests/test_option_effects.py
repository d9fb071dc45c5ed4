"""Every option of the transforms without a reference has a scene in which it matters, with the expected effect.

Those of SORT and its relatives and of re-tracking are all varied against slow implementations in ``test_sort`` and
``test_retracking_reference``.
"""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import pytest

from mcaptrack.transforms import TRANSFORMS, GroundTracker
from tests.effects import Case, ground, others
from tests.tiers import one_in

CASES = others.CASES | ground.CASES
KINDS = {name: kind for name, kind in TRANSFORMS.items() if name not in ("track", "retrack")} | {
    "ground": GroundTracker
}
ORDER = ("least", "more", "most")


@pytest.mark.parametrize(
    ("option", "case"), one_in(2, [(name, case) for (_, name), case in CASES.items()]), ids=map("-".join, CASES)
)
def test_an_option_has_the_effect_that_its_scene_says(option: str, case: Case):
    found = {}
    for value in case.wanted:
        transform = replace(case.transform, **{option: value})
        found[value] = case.number([list(output) for output in zip(*transform(case.frames), strict=True)])
    if set(case.wanted.values()) <= set(ORDER):
        ordered = sorted(found, key=lambda value: ORDER.index(case.wanted[value]))
        numbers = [found[value] for value in ordered]
        assert all(more > 1.02 * less for less, more in pairwise(numbers)), found
    else:
        assert found == pytest.approx(case.wanted), case.scene


def test_every_option_has_a_scene():
    options = {(kind, o.name) for kind, made in KINDS.items() for o in fields(made) if not o.metadata.get("context")}
    assert set(CASES) == options | {("retrack", "class_limits")}
