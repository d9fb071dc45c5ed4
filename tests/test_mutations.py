"""The changes that tools/mutants.py tries."""

from __future__ import annotations

import ast

from tools import lines_kept
from tools.mutations import find, mutants_of, sample

SOURCE = b'''"""A docstring with 1 < 2."""
from __future__ import annotations

LIMIT: float = 3

def f(a: tuple[int, 2], b=True):
    """Another: a + b."""
    if a < b and not a:
        a.x = max(a, b) - min(b, 1)
        g(a, b)
    for _ in range(b, 2):
        a **= 2
        continue
    return -a[1:], zip(a, b, strict=True)
'''


def changes(source: bytes) -> set[tuple[int, str, str]]:
    return {(m.line, m.kind, m.new.decode()) for m in mutants_of("x.py", source)}


def test_every_change_is_python_and_differs_in_one_place():
    for mutant in mutants_of("x.py", SOURCE):
        changed = mutant.applied(SOURCE)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(SOURCE))
        kept = len(SOURCE) - mutant.end
        assert changed[: mutant.start] == SOURCE[: mutant.start]
        assert changed[len(changed) - kept :] == SOURCE[mutant.end :]


def test_what_is_changed():
    assert changes(SOURCE) >= {
        (4, "constant", "4"), (4, "constant", "2"), (6, "constant", "False"), (8, "compared", "<="),
        (8, "compared", ">="), (8, "and/or", "(a < b or not a)"), (8, "negated", "(not (a < b and (not a)))"),
        (8, "unary", "(a)"), (9, "operator", "+"), (9, "name", "min"), (9, "deleted", "pass"), (10, "swapped", "b, a"),
        (11, "swapped", "2, b"), (13, "deleted", "pass"), (14, "unary", "(a[1:])"),
    }  # fmt: skip


def test_what_is_not_changed():
    """Docstrings, annotations, imports, arguments of symmetric functions, and strict= of zip()."""
    found = changes(SOURCE)
    assert not {line for line, _, _ in found} & {1, 2, 7}
    assert (6, "constant", "3") not in found
    assert not {new for line, kind, new in found if line == 9 and kind == "swapped"}
    assert not {new for line, kind, new in found if line == 14 and new == "False"}


def test_a_sample_is_the_same_for_the_same_seed_and_takes_no_place_twice():
    everything = find(["mcaptrack/transforms/retrack"])
    one, two, three = (sample(everything, 30, seed) for seed in (1, 1, 2))
    assert one == two != three
    assert len({(mutant.path, mutant.start) for mutant in one}) == len(one) == 30


def test_a_mutant_is_tried_on_the_tests_that_run_its_line_also_after_the_code_has_moved(tmp_path, monkeypatch):
    body = "def f():\n    x = 1\n    return x + 2\n\n\nLIMIT = 3\n"
    other = "from mcaptrack.b import LIMIT\n"
    monkeypatch.setattr(lines_kept, "_package", lambda: {"mcaptrack/a.py": body, "mcaptrack/c.py": other})
    tests = {
        "first": {"took_s": 2.0, "lines": {"mcaptrack/a.py": [2, 3]}},
        "second": {"took_s": 1.0, "lines": {"mcaptrack/a.py": [2, 3], "no longer": [1]}},
        "third": {"took_s": 0.5, "lines": {"mcaptrack/a.py": [2]}},
        "beside": {"took_s": 0.1, "lines": {}},
    }
    file = "tests/test_mutations.py"
    lines_kept.Records(tmp_path).write(file, {"collected": {}, "tests": tests, "failed": []})
    moved = f"import os\n\n{body}"
    monkeypatch.setattr(lines_kept, "_package", lambda: {"mcaptrack/b.py": moved, "mcaptrack/c.py": other})
    records = lines_kept.Records(tmp_path)
    assert records.knows(file)
    mutants = {m.new: m for m in mutants_of("mcaptrack/b.py", moved.encode())}
    assert records.tests_of(mutants[b"-"], [file]) == [("second", 1.0), ("first", 2.0)]
    limit = records.tests_of(mutants[b"4"], [file])
    assert [name for name, _ in limit] == ["third", "second", "first", "beside"]
