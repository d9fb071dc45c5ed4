"""Bags with something wrong in them: read or refused in a line, soon, in little memory. See tests/test_mutants.py."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.reader import make_reader

from tests import bounded
from tests.extensions.bags import bag_mutants
from tests.tiers import thorough

MUTANTS = int(os.environ.get("MUTANTS", "0"))
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


def recordings(seed: int, inside: Path, out: Path) -> Iterator[bounded.Work]:
    source, made = bag_mutants.mutant(seed, inside), out / "out.mcap"

    def holds(code: int) -> bool:
        is_written = [entry.name for entry in out.iterdir()] == ["out.mcap"]
        may_be_odd = not all(map(is_sound, source.glob("*.mcap*")))
        return is_written and (may_be_odd or is_sound(made)) if code in (0, 3) else not any(out.iterdir())

    yield ["ingest", source, "-o", made], holds


@thorough
def test_mutants_are_read_or_refused(commands, tmp_path):
    faults = bounded.faults(commands, range(FIRST, FIRST + (MUTANTS or 27)), tmp_path, recordings)
    assert not faults, "\n".join(faults)


@thorough
def test_the_same_seed_makes_the_same(tmp_path):
    for seed in range(len(bag_mutants.KINDS)):
        names = []
        for folder in (tmp_path / f"{seed} one", tmp_path / f"{seed} two"):
            folder.mkdir()
            bag_mutants.mutant(seed, folder)
            names.append({entry.relative_to(folder) for entry in folder.rglob("*")})
        assert names[0] == names[1]
