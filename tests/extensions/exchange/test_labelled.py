"""Which frames files of COCO, CVAT, KITTI and YOLO say were labelled."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import TRACKS
from tests import test_labelled as core
from tests.test_labelled import FPS, PART, PEOPLE, PICTURES, SIZE, THIRD, Way, assert_same_scores, codes, rows
from tests.tiers import one_in

clip = core.clip


def kitti(path: Path, frames: Iterable[int]) -> Path:
    lines = (
        f"{k} {who} Pedestrian 0 0 0 {x} {y} {x + w} {y + h} 1 1 1 1 1 1 0\n" for k, who, (x, y, w, h) in rows(frames)
    )
    path.write_text("".join(lines))
    return path


def coco(path: Path, frames: Iterable[int], images: Iterable[int] | None = None) -> Path:
    """Annotations of COCO, with a list of images; others of them are marked as not labelled, as PoseTrack does it."""
    shown, labelled = [*(frames if images is None else images)], {*frames}
    content = {
        "images": [{"id": k + 1000, "frame_id": k, "is_labeled": k in labelled} for k in shown],
        "annotations": [
            {"id": at, "image_id": k + 1000, "category_id": 1, "track_id": who, "bbox": box}
            for at, (k, who, box) in enumerate(rows(frames))
        ],
        "categories": [{"id": 1, "name": "person"}],
    }
    path.write_text(json.dumps(content))
    return path


def cvat(path: Path, frames: Iterable[int], first: int, last: int, step: int = 1, key: str = "task") -> Path:
    tracks = "".join(
        f'<track id="{who}" label="person">'
        + "".join(
            f'<box frame="{k}" xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}" outside="0" occluded="0"/>'
            for k, owner, (x, y, w, h) in rows(frames)
            if owner == who
        )
        + "</track>"
        for who in range(PEOPLE)
    )
    about = f"<start_frame>{first}</start_frame><stop_frame>{last}</stop_frame><frame_filter>step={step}</frame_filter>"
    path.write_text(f"<annotations><meta><{key}>{about}</{key}></meta>{tracks}</annotations>")
    return path


def yolo(path: Path, frames: Iterable[int], empty: Iterable[int] = ()) -> Path:
    path.mkdir()
    for k in (*frames, *empty):
        lines = [
            f"0 {(x + w / 2) / SIZE[0]:.9f} {(y + h / 2) / SIZE[1]:.9f} {w / SIZE[0]:.9f} {h / SIZE[1]:.9f} 1 {who}"
            for _, who, (x, y, w, h) in rows([k])
        ]
        (path / f"{k:06}.txt").write_text("\n".join(lines) if k in frames else "")
    return path


def test_numbers_of_images_are_those_of_pictures_if_they_fit(tmp_path, clip):
    for frames, first in ((range(20, 30), 20), (range(70, 130), 0), (range(51, 61), 50)):
        path = tmp_path / f"{first}.mcap"
        result = mcaptrack.ingest(clip, path, truth=coco(tmp_path / "gt.json", frames))
        with log.read(path) as opened:
            assert next(iter(opened.frames("/camera/truth", TRACKS))).index == first
        assert codes(result.warnings) == ["clock"]
        assert f"its first image has the number {frames[0]}, and is" in result.warnings[0].message


def kitti_3d(path: Path, frames: Iterable[int]) -> Path:
    path.write_text("".join(f"{k} 1 Car 0 0 0 1 2 3 4 1.5 1.6 4.0 {k / 2} 1.5 10 0.0\n" for k in frames))
    return path


def test_boxes_in_space_count_from_the_first_label_to_the_last(tmp_path):
    tracks = kitti_3d(tmp_path / "tracks.txt", range(60))
    for frames, given, false in ((PART, None, 0), ([20, 21, 26], None, 4), (PART, "22:25", 0), ([20, 22, 24], None, 0)):
        truth = kitti_3d(tmp_path / "truth.txt", frames)
        scores = mcaptrack.evaluate(
            tracks, truth=truth, label_format="kitti-3d", fps=FPS, similarity="metres", gate_m=2, frames=given
        )
        assert (scores.score("FP"), scores.score("FN")) == (false, 0)
        assert scores.labelled["tracks"] == ((given, "frames") if given else (None, None))


WAYS = {
    "kitti": Way(lambda p: kitti(p / "t.txt", PART), PART, "labels"),
    "images of COCO": Way(lambda p: coco(p / "t.json", PART), PART, "file", first_frame={"truth": 0}),
    "images of COCO from the first on": Way(lambda p: coco(p / "t.json", range(10)), range(10), "file"),
    "images that are not labelled": Way(lambda p: coco(p / "t.json", PART, range(PICTURES)), PART, "file"),
    "a task of CVAT": Way(lambda p: cvat(p / "t.xml", PART, 20, 29), PART, "file"),
    "a job of CVAT": Way(lambda p: cvat(p / "t.xml", PART[:5], 20, 29, key="job"), PART, "file"),
    "a task of CVAT in steps": Way(lambda p: cvat(p / "t.xml", THIRD, 20, 50, 3), THIRD, "file"),
    "files of YOLO": Way(lambda p: yolo(p / "t", PART[2:4], [*PART[:2], *PART[4:]]), PART, "file", first_frame={"truth": 0}),
    "files of YOLO with boxes": Way(lambda p: yolo(p / "t", PART), PART, "labels", first_frame={"truth": 0}),
    "an open range": Way(lambda p: kitti(p / "t.txt", PART), range(20, PICTURES), "frames", frames="20:"),
    "a part of a task": Way(lambda p: cvat(p / "t.xml", THIRD, 20, 50, 3), THIRD[:4], "frames", frames="0:30"),
}  # fmt: skip


@pytest.mark.parametrize("way", one_in(2, WAYS.values()), ids=WAYS)
def test_a_file_and_the_log_that_it_is_ingested_into_give_the_same_scores(tmp_path, clip, way, recwarn):
    assert_same_scores(tmp_path, clip, way)
