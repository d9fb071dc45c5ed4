"""Recordings with something wrong in them: read or refused in a line, soon, in little memory, and left as they are.

MUTANTS in the environment sets how many are made, FIRST_MUTANT where they begin.
"""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path

import zstandard
from mcap.reader import make_reader

from tests import bounded
from tests.bag_mutants import KINDS, mutant
from tests.tiers import thorough

MUTANTS = int(os.environ.get("MUTANTS", "27"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))


def is_sound(path: Path) -> bool:
    """Whether the stock reader finds all messages of a log. An MCAP file alone is passed on as it is."""
    data = path.read_bytes()
    try:
        if path.suffix == ".zstd":
            data = zstandard.decompress(data)
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        return reader.get_summary().statistics.message_count == sum(1 for _ in reader.iter_messages())
    except Exception:
        return False


def fault(commands: bounded.Commands, folder: Path, seed: int) -> str:
    """What goes wrong with a mutant, "" if nothing does."""
    inside, out = folder / "in", folder / "out.mcap"
    inside.mkdir()
    source = mutant(seed, inside)
    before = bounded.on_disk(inside)
    outcome = commands.run("ingest", source, "-o", out)
    if bounded.on_disk(inside) != before:
        return f"the input was changed: {outcome}"
    if sorted(entry.name for entry in folder.iterdir()) != ["in", *(["out.mcap"] if out.exists() else [])]:
        return f"something was left: {sorted(folder.iterdir())}"
    lines = outcome.err.splitlines()
    if outcome.code not in (0, 1, 3) or outcome.peak_bytes > bounded.MEMORY_BYTES:
        return str(outcome)
    if (outcome.code == 1) != (not out.exists()) or (outcome.code == 1 and not lines[-1].startswith("mcaptrack: ")):
        return f"no log, and no reason: {outcome}"
    if outcome.code == 1 and any(len(line) > 2000 for line in lines):
        return f"a long line: {outcome}"
    if out.exists() and not is_sound(out) and all(map(is_sound, source.glob("*.mcap*"))):
        return f"the log does not add up: {outcome}"
    return ""


@thorough
def test_mutants_are_read_or_refused(commands, tmp_path):
    faults, codes = {}, set()
    for seed in range(FIRST, FIRST + MUTANTS):
        folder = tmp_path / str(seed)
        folder.mkdir()
        words = fault(commands, folder, seed)
        if words:
            faults[seed, KINDS[seed % len(KINDS)]] = words
        else:
            codes.add((folder / "out.mcap").exists())
            shutil.rmtree(folder)
    assert not faults, "\n".join(f"{seed}: {words}" for seed, words in faults.items())
    assert codes == {True, False}


@thorough
def test_a_seed_makes_the_same_mutant_again(tmp_path):
    for seed in range(len(KINDS)):
        made = []
        for name in (f"{seed} one", f"{seed} two"):
            (tmp_path / name).mkdir()
            mutant(seed, tmp_path / name)
            made.append({entry.relative_to(tmp_path / name) for entry in (tmp_path / name).rglob("*")})
        assert made[0] == made[1]
