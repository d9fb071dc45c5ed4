"""Damaged labels and settings: read or refused in a line, soon, in little memory, and nothing else is touched.

TEXT_MUTANTS in the environment sets how many are tried, FIRST_MUTANT where they begin.
"""

from __future__ import annotations

import os
import shutil

import pytest

from tests import bounded
from tests.commands import made_log
from tests.text_mutants import WHOLE, mutant
from tests.tiers import thorough

MUTANTS = int(os.environ.get("TEXT_MUTANTS", "10"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))
SETTINGS = "set.toml"
#: What is done with labels, and with settings.
WITH_LABELS = (
    "ingest {labels} --fps 10 -o {out}/a.mcap",
    "ingest {labels} --as truth --into {log} -o {out}/a.mcap",
    "evaluate {labels} --truth {labels}",
)
WITH_SETTINGS = ("track {log} -o {out}/a.mcap --config {labels}", "info {log} --config {labels}")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return made_log(tmp_path_factory.mktemp("made"), 10)


def fault(commands, line, folder, out) -> str:
    """What goes wrong with a command, "" if nothing does."""
    before = bounded.on_disk(folder)
    outcome = commands.run(*line)
    if bounded.on_disk(folder) != before:
        return f"something was changed: {outcome}"
    lines = outcome.err.splitlines()
    if outcome.code not in (0, 1, 2, 3) or outcome.peak_bytes > bounded.MEMORY_BYTES or "Traceback" in outcome.err:
        return str(outcome)
    if outcome.code in (1, 2) and not (lines and lines[-1].startswith("mcaptrack: ") and len(lines[-1]) < 2000):
        return f"no reason: {outcome}"
    if any(not c.isprintable() and c != "\n" for c in outcome.err):
        return f"unescaped: {outcome}"
    return "" if outcome.code == 0 or not list(out.glob("*.mcap")) or outcome.code == 3 else f"left behind: {outcome}"


@thorough
def test_mutants_of_labels_and_settings_are_read_or_refused(made, commands, tmp_path):
    faults = {}
    for seed in range(FIRST, FIRST + MUTANTS):
        folder, out = tmp_path / f"{seed}", tmp_path / f"{seed}.out"
        folder.mkdir()
        shutil.copy(made, folder / "a.mcap")
        name, data = mutant(seed)
        (folder / name).write_bytes(data)
        for given in WITH_SETTINGS if name == SETTINGS else WITH_LABELS:
            out.mkdir()
            line = [word.format(labels=folder / name, log=folder / "a.mcap", out=out) for word in given.split()]
            words = fault(commands, line, folder, out)
            if words:
                faults[seed, name, given] = words
            shutil.rmtree(out)
        shutil.rmtree(folder)
    assert not faults, "\n".join(f"{seed}: {words[:3000]}" for seed, words in faults.items())


@pytest.mark.parametrize("name", sorted(WHOLE.keys() - {"boxes.json", SETTINGS}))
def test_what_is_whole_is_read(name, commands, tmp_path):
    (tmp_path / name).write_text(WHOLE[name])
    outcome = commands.run("ingest", tmp_path / name, "--fps", "10", "-o", tmp_path / "a.mcap")
    assert outcome.code == 0, outcome.err


def test_the_same_seed_makes_the_same():
    assert [mutant(seed) for seed in range(50)] == [mutant(seed) for seed in range(50)]
    assert {mutant(seed)[0] for seed in range(200)} == WHOLE.keys()
