"""Logs with something wrong in them: read or refused in a line, soon, in little memory.

Nothing that a command reads is changed by it. MUTANTS in the environment sets how many are made of each kind of file,
FIRST_MUTANT where they begin; damaged logs then go through every command instead of one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from mcaptrack import log
from tests import bounded, log_mutants
from tests.commands import made_log
from tests.logs import READING
from tests.tiers import thorough

MUTANTS = int(os.environ.get("MUTANTS", "0"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))
COMMANDS = sorted(READING)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("whole"), 10)


def logs(whole: Path, seed: int, inside: Path, out: Path) -> Iterator[bounded.Work]:
    path = inside / "a.mcap"
    path.write_bytes(log_mutants.mutant(seed, whole.read_bytes())[1])
    for command in COMMANDS if MUTANTS else [COMMANDS[seed % len(COMMANDS)]]:

        def holds(code: int, command: str = command) -> bool:
            return command != "recover" or code == 1 or all(log.check(made).is_sound for made in out.glob("*.mcap"))

        yield [command, *READING[command](path, out)], holds


@thorough
def test_mutants_are_read_or_refused(whole, commands, tmp_path):
    faults = bounded.faults(commands, range(FIRST, FIRST + (MUTANTS or 12)), tmp_path, partial(logs, whole))
    assert not faults, "\n".join(faults)


def test_every_kind_changes_something_and_the_same_seed_makes_the_same(whole, tmp_path):
    data, kinds = whole.read_bytes(), log_mutants.KINDS
    made = [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert made == [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert {kind for kind, changed in made if changed != data} == kinds.keys()
