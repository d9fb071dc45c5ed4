"""Recordings and logs with something wrong in them: read or refused in a line, soon, in little memory.

Nothing that a command reads is changed by it. MUTANTS in the environment sets how many are made of each kind of file,
FIRST_MUTANT where they begin; damaged logs then go through every command instead of one.
"""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader

from mcaptrack import log
from tests import bag_mutants, bounded, log_mutants
from tests.commands import made_log
from tests.logs import READING
from tests.tiers import thorough

MUTANTS = int(os.environ.get("MUTANTS", "0"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))
COMMANDS = sorted(READING)
#: A command, and what has to hold of what it wrote, by the exit code.
Work = tuple[list[object], Callable[[int], bool]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("whole"), 10)


def fault(commands: bounded.Commands, words: list[object], inside: Path, holds: Callable[[int], bool]) -> str:
    """What goes wrong with a command that reads from a folder, "" if nothing does."""
    before = bounded.on_disk(inside)
    outcome = commands.run(*words)
    lines = outcome.err.splitlines()
    if bounded.on_disk(inside) != before:
        return f"what it reads was changed: {outcome}"
    if outcome.code not in (0, 1, 2, 3) or outcome.peak_bytes > bounded.MEMORY_BYTES or "Traceback" in outcome.err:
        return str(outcome)
    is_said = bool(lines) and lines[-1].startswith("mcaptrack: ") and max(map(len, lines)) < 2000
    if outcome.code in (1, 2) and words[0] != "check" and not is_said:
        return f"no reason: {outcome}"
    if any(not character.isprintable() and character != "\n" for character in outcome.err):
        return f"unescaped: {outcome}"
    return "" if holds(outcome.code) else f"what it wrote does not add up: {outcome}"


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


def recordings(seed: int, inside: Path, out: Path, whole: Path) -> Iterator[Work]:
    source, made = bag_mutants.mutant(seed, inside), out / "out.mcap"

    def holds(code: int) -> bool:
        is_written = [entry.name for entry in out.iterdir()] == ["out.mcap"]
        may_be_odd = not all(map(is_sound, source.glob("*.mcap*")))
        return is_written and (may_be_odd or is_sound(made)) if code in (0, 3) else not any(out.iterdir())

    yield ["ingest", source, "-o", made], holds


def logs(seed: int, inside: Path, out: Path, whole: Path) -> Iterator[Work]:
    path = inside / "a.mcap"
    path.write_bytes(log_mutants.mutant(seed, whole.read_bytes())[1])
    for command in COMMANDS if MUTANTS else [COMMANDS[seed % len(COMMANDS)]]:

        def holds(code: int, command: str = command) -> bool:
            return command != "recover" or code == 1 or all(log.check(made).is_sound for made in out.glob("*.mcap"))

        yield [command, *READING[command](path, out)], holds


@thorough
@pytest.mark.parametrize(("make", "count"), [(recordings, 27), (logs, 12)])
def test_mutants_are_read_or_refused(make, count, whole, commands, tmp_path):
    faults = {}
    for seed in range(FIRST, FIRST + (MUTANTS or count)):
        inside = tmp_path / str(seed)
        inside.mkdir()
        out = tmp_path / f"{seed}.out"
        out.mkdir()
        for words, holds in make(seed, inside, out, whole):
            if said := fault(commands, words, inside, holds):
                faults[seed, words[0]] = said[:3000]
            shutil.rmtree(out)
            out.mkdir()
    assert not faults, "\n".join(f"{seed}: {words}" for seed, words in faults.items())


def test_every_kind_changes_something_and_the_same_seed_makes_the_same(whole, tmp_path):
    data, kinds = whole.read_bytes(), log_mutants.KINDS
    made = [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert made == [log_mutants.mutant(seed, data) for seed in range(len(kinds))]
    assert {kind for kind, changed in made if changed != data} == kinds.keys()
    for seed in range(len(bag_mutants.KINDS)):
        names = []
        for folder in (tmp_path / f"{seed} one", tmp_path / f"{seed} two"):
            folder.mkdir()
            bag_mutants.mutant(seed, folder)
            names.append({entry.relative_to(folder) for entry in folder.rglob("*")})
        assert names[0] == names[1]
