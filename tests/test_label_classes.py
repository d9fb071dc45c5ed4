"""``ingest --classes``: classes other than people in tracks and ground truth, with their names, from every format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses

MOT = "".join(f"{t},{who},{10 * who},20,30,60,{flag},{kind},1\n" for t in (1, 2)
              for who, flag, kind in ((1, 1, 1), (2, 0, 3), (3, 0, 4), (4, 0, 1)))  # fmt: skip
SDD = "".join(
    f'{who} {10 * who} 20 {10 * who + 9} 40 {t} {lost} 0 0 "{kind}"\n'
    for who, kind, lost in ((1, "Pedestrian", 0), (2, "Biker", 0), (3, "Cart", 1))
    for t in (0, 12, 24)
)
CSV = "frame,id,x,y,w,h,class\n" + "".join(
    f"{t},{who},{10 * who},20,30,60,{kind}\n"
    for t in (0, 1, 2)
    for who, kind in ((1, "human"), (2, "vélo"), (3, "Cat"))
)
FILES = {"mot": ("gt.txt", MOT), "sdd": ("gt.txt", SDD), "csv": ("gt.csv", CSV)}


def classes_of(folder: Path, form: str | tuple[str, str], **options):
    """The ids of each class in the ground truth of a file, by name and number of the class."""
    name, content = FILES.get(form, form)
    (folder / name).write_text(content)
    target = folder / f"{name}-{options.get('classes', '')[:5]}.mcap"
    mcaptrack.ingest(folder / name, target, role=options.pop("role", "truth"), fps=10, force=True, **options)
    found = {}
    with mcaptrack.open(target) as log:
        for row in log.table("tracks").to_pylist():
            found.setdefault((row["class"], row["class_id"]), set()).add(row["track_id"])
    return found


@pytest.mark.parametrize(
    ("form", "people", "everything", "one", "of_one"),
    [
        ("mot", {("person", 1): {1}}, {("pedestrian", 1): {1}, ("car", 3): {2}, ("bicycle", 4): {3}}, "car,4",
         {("car", 3): {2}, ("bicycle", 4): {3}}),
        ("sdd", {("Pedestrian", 1): {1}}, {("Pedestrian", 1): {1}, ("Biker", 2): {2}}, "person", {("Pedestrian", 1): {1}}),
        ("csv", {("human", 1): {1}}, {("human", 1): {1}, ("Cat", 2): {3}, ("vélo", 3): {2}}, "vélo", {("vélo", 3): {2}}),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_wanted_classes_are_kept_with_their_names(tmp_path, form, people, everything, one, of_one):
    assert_kept(tmp_path, form, people, everything, one, of_one)


def assert_kept(
    tmp_path: Path, form: str | tuple[str, str], people: Any, everything: Any, one: str, of_one: Any
) -> None:
    assert classes_of(tmp_path, form) == people
    assert classes_of(tmp_path, form, classes="all") == everything
    assert classes_of(tmp_path, form, classes=one) == of_one
    assert classes_of(tmp_path, form, classes=one, role="tracks").keys() == of_one.keys()


@pytest.mark.parametrize(
    ("classes", "words"),
    [
        ("bus", "has no class 'bus'; `classes=` takes human, Cat, vélo, or all"),
        ("Cat,", "has no class ''"),
        ("7", "has no class '7'"),
        ("9" * 5000, "has no class '99999"),
        ("", "has no class ''"),
    ],
)
def test_classes_that_a_file_lacks_are_refused(tmp_path, classes, words):
    with pytest.raises(McaptrackError) as caught:
        classes_of(tmp_path, "csv", classes=classes)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_left_out_is_said_and_classes_without_effect_too(tmp_path):
    with pytest.warns(UserWarning, match="3 Cat; left out of truth"):
        classes_of(tmp_path, "csv", classes="person,vélo")
    (tmp_path / "found.csv").write_text(CSV)
    with pytest.warns(UserWarning, match="classes"):
        mcaptrack.ingest(tmp_path / "found.csv", tmp_path / "a.mcap", role="detections", fps=10, classes="all")


def ingest(folder: Path, name: str, content: bytes, **options):
    (folder / name).write_bytes(content)
    return mcaptrack.ingest(folder / name, folder / "a.mcap", fps=10, force=True, **options)


#: Classes of a data set with their numbers, and others with the next ones.
SDD_NUMBERS = {"Pedestrian": 1, "Biker": 2, "Skater": 3, "Cart": 4, "Car": 5, "Bus": 6, "Dog": 7, "Tram": 8}


def test_classes_have_their_numbers_and_others_the_next_ones(tmp_path):
    rows = [f'{n} {10 * n} 20 {10 * n + 9} 40 0 0 0 0 "{name}"\n' for n, name in enumerate(SDD_NUMBERS)]
    assert_numbered("sdd", rows, SDD_NUMBERS, tmp_path)


def assert_numbered(form: str, rows: list[str], numbers: dict[str, int], tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("".join(rows))
    labels = read_labels(tmp_path / "a.txt", form, "tracks", wanted=WantedClasses("all"))
    assert labels.class_id.tolist() == list(numbers.values())
    assert labels.classes == {number: name for name, number in numbers.items()}


MOT_NAMES = [
    "pedestrian", "person on vehicle", "car", "bicycle", "motorbike", "non motorized vehicle", "static person",
    "distractor", "occluder", "occluder on the ground", "occluder full", "reflection", "crowd",
]  # fmt: skip


def test_classes_of_the_motchallenge_that_are_scored_forgiven_or_false(tmp_path):
    rows = [f"1,{n},{10 * n},20,9,20,1,{n},1\n" for n in range(1, 14)] + ["1,14,5,20,9,20,0,1,1\n"]
    (tmp_path / "a.txt").write_text("".join(rows))
    truth = read_labels(tmp_path / "a.txt", "mot", "truth", wanted=WantedClasses("person"))
    assert (truth.id.tolist(), truth.class_id.tolist(), truth.classes) == ([1], [1], {})
    assert truth.left_out.endswith(", 4 of other classes and 1 boxes that don't count (score 0)")
    assert truth.ignored.boxes_px[:, 0].tolist() == [*range(20, 140, 10), 5]
    assert np.flatnonzero(truth.ignored.forgiven).tolist() == [n - 2 for n in (2, 7, 8, 12)]
    assert not truth.ignored.region.any()
    every = read_labels(tmp_path / "a.txt", "mot", "truth", wanted=WantedClasses("all"))
    assert (every.id.tolist(), every.class_id.tolist()) == (list(range(1, 14)), list(range(1, 14)))
    assert every.classes == dict(enumerate(MOT_NAMES, start=1))
    assert every.left_out == "1 boxes that don't count (score 0)"
    tracks = read_labels(tmp_path / "a.txt", "mot", "tracks", wanted=WantedClasses("person"))
    assert (tracks.id.tolist(), set(tracks.class_id.tolist())) == ([1, 14], {1})


def test_tracks_without_people_are_refused_with_a_remedy(tmp_path):
    rows = "".join(f"{t},1,{10 * t},20,30,60,car\n" for t in range(3)).encode()
    with pytest.raises(McaptrackError, match=r"a.csv holds no people, only 3 car; `classes=` takes others"):
        ingest(tmp_path, "a.csv", b"frame,id,x,y,w,h,class\n" + rows)


@pytest.mark.parametrize("people", [0, 1], ids=["without people", "with people"])
def test_detections_keep_all_classes_also_where_none_is_a_person(tmp_path, people):
    rows = [f"{t},{10 * t},20,30,60,car" for t in range(3)] + ["1,200,20,30,60,person"] * people
    ingest(tmp_path, "a.csv", ("frame,x,y,w,h,class\n" + "\n".join(rows) + "\n").encode())
    with mcaptrack.open(tmp_path / "a.mcap") as log:
        assert sorted(row["class"] for row in log.table("detections").to_pylist()) == ["car"] * 3 + ["person"] * people
