"""Damaged logs: every command reads or refuses them in a line, soon, in little memory, and leaves all as it is.

LOG_MUTANTS in the environment sets how many are tried, FIRST_MUTANT where they begin. With more than a few each goes
through every command, otherwise through one.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from mcaptrack import log
from tests import bounded
from tests.commands import made_log
from tests.log_mutants import KINDS, mutant
from tests.logs import READING
from tests.tiers import thorough

FEW = 12
MUTANTS = int(os.environ.get("LOG_MUTANTS", str(FEW)))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))
COMMANDS = sorted(READING.keys() - {"train"})


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    return made_log(tmp_path_factory.mktemp("whole"), 10).read_bytes()


def fault(commands: bounded.Commands, command: str, path: Path, out: Path) -> str:
    """What goes wrong with a command, "" if nothing does."""
    before = bounded.on_disk(path.parent)
    outcome = commands.run(command, *READING[command](path, out))
    if bounded.on_disk(path.parent) != before:
        return f"the log, or what lies beside it, was changed: {outcome}"
    lines = outcome.err.splitlines()
    if outcome.code not in (0, 1, 3) or outcome.peak_bytes > bounded.MEMORY_BYTES or "Traceback" in outcome.err:
        return str(outcome)
    if outcome.code == 1 and command != "check" and not (lines and lines[-1].startswith("mcaptrack: ")):
        return f"no reason: {outcome}"
    for made in out.glob("*.mcap"):
        if outcome.code in (0, 3) and command == "recover" and not log.check(made).is_sound:
            return f"{made.name} is not sound: {outcome}"
    return ""


@thorough
def test_mutants_of_logs_are_read_or_refused(whole, commands, tmp_path):
    faults = {}
    for seed in range(FIRST, FIRST + MUTANTS):
        path = tmp_path / str(seed) / "a.mcap"
        path.parent.mkdir()
        kind, data = mutant(seed, whole)
        path.write_bytes(data)
        for command in COMMANDS if MUTANTS > FEW else [COMMANDS[seed % len(COMMANDS)]]:
            out = tmp_path / f"{seed}.{command}"
            out.mkdir()
            words = fault(commands, command, path, out)
            if words:
                faults[seed, kind, command] = words
            shutil.rmtree(out)
        shutil.rmtree(path.parent)
    assert not faults, "\n".join(f"{seed}: {words}" for seed, words in faults.items())


def test_every_kind_changes_something_and_the_same_seed_makes_the_same(whole):
    for seed in range(len(KINDS)):
        assert mutant(seed, whole) == mutant(seed, whole)
    assert {mutant(seed, whole)[0] for seed in range(len(KINDS)) if mutant(seed, whole)[1] != whole} == KINDS.keys()
