"""The protocol on views of WILDTRACK: people who are seen without a fault are tracked without one."""

from __future__ import annotations

import csv
import sys

import numpy as np
import pytest

from tools import reproduce, wildtrack

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
