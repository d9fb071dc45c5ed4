"""The programs in tools: changes that tools/mutants.py tries, the protocol of WILDTRACK, the table of an ablation."""

from __future__ import annotations

import ast
import csv
import sys
from dataclasses import fields

import numpy as np
import pytest

from mcaptrack.transforms import PROFILES
from tests.extension_cases import needs
from tools import lines_kept, reproduce, wildtrack
from tools.ablation import PARTS, STEPS, cell
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
    file = "tests/test_tools.py"
    lines_kept.Records(tmp_path).write(file, {"collected": {}, "tests": tests, "failed": []})
    moved = f"import os\n\n{body}"
    monkeypatch.setattr(lines_kept, "_package", lambda: {"mcaptrack/b.py": moved, "mcaptrack/c.py": other})
    records = lines_kept.Records(tmp_path)
    assert records.knows(file)
    mutants = {m.new: m for m in mutants_of("mcaptrack/b.py", moved.encode())}
    assert records.tests_of(mutants[b"-"], [file]) == [("second", 1.0), ("first", 2.0)]
    limit = records.tests_of(mutants[b"4"], [file])
    assert [name for name, _ in limit] == ["third", "second", "first", "beside"]


# The protocol on views of WILDTRACK: people who are seen without a fault are tracked without one.


FRAMES = 14


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Three views of two people who walk side by side, 4 m apart; the third sees one of them alone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "homography").mkdir()
    truth = [(frame, who, 2 + 0.1 * frame, 3 + 4 * who) for frame in range(1, FRAMES + 1) for who in (0, 1)]
    (tmp_path / "truth.txt").write_text("".join(f"{f} {who} {x} {y}\n" for f, who, x, y in truth))
    for view, left_px in ((1, 0), (2, 100), (3, -275)):
        rows = [(f, 100 * x + left_px, 100 * y) for f, _, x, y in truth]
        rows = [row for row in rows if view < 3 or (row[2] < 500 and row[1] >= 0)]
        text = "".join(f"{f},-1,{x - 20},{y - 90},40,90,0.9,-1,-1,-1\n" for f, x, y in rows)
        (tmp_path / f"view{view}.det.txt").write_text(text)
        numbers = f"0.01,0,{-left_px / 100}\n0,0.01,0\n0,0,1\n"
        (tmp_path / "homography" / f"view{view}.txt").write_text(numbers)
    return tmp_path


@needs("fuse")
def test_each_view_is_scored_on_those_in_its_picture_and_the_scene_on_all(folder, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["reproduce", str(folder), "--profile", "default", "-o", "out"])
    reproduce.main()
    assert wildtrack.NOTE in capsys.readouterr().out
    with (folder / "out" / "table.csv").open() as file:
        rows = {(row["method"], float(row["gate_m"])): row for row in csv.DictReader(file)}
    for name in ("view1: SORT", "view2: SORT", "fused: ground", "view1: re-tracking, default"):
        assert {rows[name, 1.0][key] for key in ("IDF1", "MOTA")} == {"100.0"}, name
    # The third view looks at the ground from x = 2.75 m on; the one who is never detected there is missed.
    inside = sum(100 * (2 + 0.1 * frame) >= 275 for frame in range(1, FRAMES + 1))
    assert inside <= int(rows["view3: SORT", 1.0]["FN"]) <= inside + 1  # a track may begin a frame late
    assert float(rows["fused: ground", 1.0]["recall_at_tau"]) > 0


def test_a_folder_without_views_is_none_of_wildtrack(tmp_path):
    assert not wildtrack.is_wildtrack(tmp_path)
    frames = wildtrack._truth(np.array([[1, 7, 0.5, 0.5], [3, 7, 1.5, 0.5]]))
    assert [(frame.t_ns, len(frame.rows)) for frame in frames] == [(0, 1), (500_000_000, 0), (1_000_000_000, 1)]


# The table of parts of re-tracking: its rows are what their options say, and its cells what was scored.


def test_each_part_is_left_out_once_and_the_steps_end_at_the_default():
    default = PROFILES["default"]
    assert PARTS["the default"][1] == default == list(STEPS.values())[-1][1]
    changed = [
        [one.name for one in fields(default) if getattr(options, one.name) != getattr(default, one.name)]
        for name, (_, options) in PARTS.items()
        if name not in ("paper", "authors")
    ]
    assert sorted(len(names) for names in changed) == [0] + [1] * (len(PARTS) - 3)
    switches = {one.name for one in fields(default) if getattr(default, one.name) is True}
    switches -= {"adapt", "adapt_online", "appearance"}  # of ellipses, of online tracks and of pictures
    assert switches <= {name for names in changed for name in names}


def test_cells_hold_means_and_spreads_by_hand():
    scores = {"IDF1": [90.0, 92.0, 94.0], "MOTA": [80.0, 80.0, 80.0], "IDSW": [1.0, 2.0, 6.0]}
    assert cell(scores, is_seeded=True) == "92.0 (2.0) / 80.0 (0.0) / 3.0 (2.6)"
    assert cell(scores, is_seeded=False) == "90.0 (1.4) / 80.0 (0.0) / 1.0 (2.8)"  # the first is of all scenes
