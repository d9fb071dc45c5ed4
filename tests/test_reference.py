"""The main job on real footage, where it is at hand (see ``data`` in conftest.py): a public square, filmed in 2009."""

from __future__ import annotations

import json

import pytest

from tests.test_cli import done


@pytest.fixture(scope="module")
def scores(data, tmp_path_factory) -> dict[tuple[str, str, float], dict]:
    folder, path = data / "pets09-s2l1", tmp_path_factory.mktemp("pets") / "pets.mcap"
    plane = ("--ground-plane", folder / "homography.txt", "--point", "foot")
    done("ingest", folder / "video.avi", "--fps", 7, *plane, "--truth", folder / "gt.txt", "-o", path)
    done("run", path)
    rows = json.loads(done("evaluate", path, "--json")[0])["results"]
    return {(row["tracks"].removeprefix("/camera/"), row["similarity"], row["gate"]): row for row in rows}


def test_a_motion_detector_and_sort_find_and_follow_people(scores):
    row = scores["tracks", "iou", 0.5]
    assert row["MOTA"] >= 0.45
    assert row["IDF1"] >= 0.40


def test_retracking_keeps_more_identities_and_takes_switches_away(scores):
    sort, retracked = (scores[name, "metres", 1.0] for name in ("samples", "retracks"))
    assert retracked["IDF1"] >= sort["IDF1"] + 0.05
    assert retracked["IDSW"] <= sort["IDSW"] * 5 / 6
