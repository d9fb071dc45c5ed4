"""Several cameras: their boxes become detections of one scene.

The scene is projected by the pinhole cameras of ``tests/places.py``; where people walk is known.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import McaptrackError
from mcaptrack.extensions.cameras import feet as fuse
from mcaptrack.extensions.cameras import fusing
from mcaptrack.extensions.cameras.feet import CameraView, FootFuser, Offset, Shared, group, places_of
from mcaptrack.extensions.cameras.scenes import FUSION
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.registry import names
from mcaptrack.schema import DETECTIONS, SIGHTINGS, Frame
from mcaptrack.testing import check_transform
from tests.commands import call
from tests.places import CAMERAS, HEIGHT, NS, PEOPLE, SECONDS, WIDTH, errors, fused, said, write_log
from tests.references.joining import joined
from tests.tiers import one_in, thorough


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four cameras, fused. Not to be changed."""
    path = write_log(tmp_path_factory.mktemp("scene") / "scene.mcap", people=0.9)
    assert not mcaptrack.fuse(path).warnings
    return path


class TestScene:
    def test_four_cameras_see_each_person_once_where_he_is(self, scene: Path) -> None:
        away, count, people = errors(fused(scene))
        assert abs(count - people) <= 0.03 * people
        assert np.median(away) < 0.12
        assert away.max() < 0.8

    def test_pointers_lead_to_the_boxes_of_each_camera(self, scene: Path) -> None:
        boxes = {camera.name: fused(scene, f"/{camera.name}/detections") for camera in CAMERAS}
        (channel,) = (one for one in mcaptrack.info(scene).channels if one.topic == "/world/detections/sightings")
        names = channel.parameters["cameras"]
        for rows in fused(scene, "/world/detections/sightings").values():
            for row in rows[:3]:
                camera = next(one for one in CAMERAS if one.name == names[row["camera"]])
                box = boxes[camera.name][int(row["picture_ns"])][row["box_row"]]
                foot = np.array([box["x_px"] + box["w_px"] / 2, box["y_px"] + box["h_px"], 1.0])
                x, y, w = camera.homography() @ foot
                assert [row["x_m"], row["y_m"]] == pytest.approx([x / w, y / w], abs=1e-6)


class TestFaults:
    def test_a_homography_that_is_off_is_named_with_its_distance(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "moved.mcap", moved_m={"east": 0.6})
        lines = said(mcaptrack.fuse(path), "cameras-disagree")
        assert len(lines) == 1
        assert lines[0].startswith("east: feet stand 0.")
        assert 0.45 < float(lines[0].split("stand ")[1].split(" m")[0]) < 0.75

    @pytest.mark.parametrize("late", one_in(2, [0.3, -0.4]))
    def test_a_clock_that_is_off_is_estimated_and_taken_off(self, tmp_path: Path, late: float) -> None:
        path = write_log(tmp_path / "late.mcap", late_s={"south": late})
        lines = said(mcaptrack.fuse(path), "clock")
        assert len(lines) == 1
        assert lines[0].startswith("south: its times are ")
        assert ("late" if late > 0 else "early") in lines[0]
        assert float(lines[0].split("are ")[1].split(" s")[0]) == pytest.approx(abs(late), abs=0.08)
        away, count, people = errors(fused(path))
        assert abs(count - people) <= 0.05 * people
        assert np.median(away) < 0.15

    @thorough
    def test_an_offset_that_is_given_is_not_estimated(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "late.mcap", late_s={"south": 0.3})
        assert not said(mcaptrack.fuse(path, clock_offset_s={"south": 0.3}), "clock")
        assert "seem" in said(mcaptrack.fuse(path, clock_offset_s={"south": 0.0}), "clock")[0]

    def test_cameras_with_other_rates_are_joined_at_the_times_of_the_slowest(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "rates.mcap", rate_hz={"north": 5.0, "east": 3.0})
        mcaptrack.fuse(path)
        found = fused(path)
        assert len(found) == SECONDS * 2
        away, count, people = errors(found)
        assert abs(count - people) <= 0.03 * people
        assert np.median(away) < 0.15


class TestInput:
    def test_cameras_that_lack_something_are_left_out_and_named(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "scene.mcap", CAMERAS[:2])
        with mcaptrack.open(path) as log:
            log.write("/hall/detections", [mcaptrack.detections([[1, 2, 30, 40]], [0.5], [1], NS, box_format="xywh")])
        assert said(mcaptrack.fuse(path), "left-out")[0].startswith("hall is left out: it has no ground plane; ")

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"cameras": "north,nowhere"}, "has no camera nowhere; it has "),
            ({"to": "a/b"}, "is no name of a scene"),
            ({"to": "north"}, "/north/detections was ingested; give the scene another name"),
            ({"clock_offset_s": {"north": 1e300}}, "has 1e\\+300 s for north; a clock is late by a day at most"),
            ({"clock_offset_s": {"north": float("nan")}}, "has nan s for north"),
            ({"clock_offset_s": {"up": 1.0}}, "has up, which is not fused; east, north are"),
        ],
    )
    def test_what_cannot_be_is_one_line(self, tmp_path: Path, options: Mapping[str, object], words: str) -> None:
        path = write_log(tmp_path / "scene.mcap", CAMERAS[:2])
        before = path.read_bytes()
        with pytest.raises(McaptrackError, match=words):
            mcaptrack.fuse(path, **options)  # type: ignore[arg-type]
        assert path.read_bytes() == before

    @thorough
    def test_a_run_tracks_the_scene_by_what_suits_it(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "scene.mcap", CAMERAS[:3])
        mcaptrack.fuse(path)
        (note,) = (one for one in mcaptrack.run(path, camera="world", tables=False).notes if "suits" in one)
        assert note.startswith("track by ground (birth_score 0.8, ")
        assert note.endswith("which suits the fuser feet; `tracker=` chooses")

    def test_a_run_makes_a_scene_again_that_is_out_of_date(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "scene.mcap", CAMERAS[:3], late_s={"east": 0.2})
        mcaptrack.fuse(path, min_score=0.4, clock_offset_s={"east": 0.2})
        mcaptrack.run(path, camera="world", tables=False)
        assert mcaptrack.run(path, camera="world", tables=False).is_up_to_date
        with mcaptrack.open(path) as log, collected() as warnings:
            rows = log.array("detections", "/north/detections")
            frames = []
            for t_ns in np.unique(rows["t_ns"]):
                part = rows[rows["t_ns"] == t_ns][1:]
                boxes = np.stack([part[name] for name in ("x_px", "y_px", "w_px", "h_px")], axis=-1)
                scores, classes = [0.9] * len(part), [1] * len(part)
                frames.append(mcaptrack.detections(boxes, scores, classes, int(t_ns), box_format="xywh"))
            log.write("/north/detections", frames, replace=True)
        (line,) = (one.message for one in warnings if one.message.startswith("/world/detections is out"))
        assert "camera='world'" in line
        again = mcaptrack.run(path, camera="world", tables=False)
        assert again.stages[:2] == ("fuse", "track")
        assert again.rows["/world/detections/sightings"] == 2 * SECONDS * (3 * PEOPLE - 1)
        how = {one.topic: one.parameters for one in mcaptrack.info(path).channels}["/world/detections"]
        assert (how["min_score"], how["clock_offsets_given"]) == (0.4, ["east"])
        assert mcaptrack.fuse(path, min_score=0.4, clock_offset_s={"east": 0.2}).rows == {
            topic: count for topic, count in again.rows.items() if "detections" in topic
        }


places = st.lists(
    st.tuples(
        st.integers(0, 4), st.floats(-5, 5), st.floats(-5, 5), st.floats(0.05, 0.6), st.floats(0.05, 0.6),
        st.floats(-0.9, 0.9),
    ),
    max_size=14,
)  # fmt: skip


def sightings(drawn: Sequence[tuple[int, float, float, float, float, float]]) -> np.ndarray:
    camera, x, y, sx, sy, r = (np.array(part) for part in zip(*drawn, strict=True)) if drawn else np.empty((6, 0))
    return SIGHTINGS.rows(
        camera=camera.astype(np.int64),
        picture_ns=np.zeros(len(x), np.int64),
        box_row=np.arange(len(x)),
        x_m=x, y_m=y, cov_xx_m2=sx**2, cov_xy_m2=r * sx * sy, cov_yy_m2=sy**2,
        class_id=np.ones(len(x), np.int64),
    )  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.lists(places, min_size=1, max_size=3))
def test_boxes_are_joined_as_by_matrices_whatever_frames_are_beside(
    drawn: list[list[tuple[int, float, float, float, float, float]]],
) -> None:
    parts = [sightings(one) for one in drawn]
    rows, part = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(one) for one in parts])
    of = group(rows["camera"].astype(np.int64), places_of(rows), 9.0, 1.2, part)
    found = [set(np.flatnonzero(of == number).tolist()) for number in range(int(of.max(initial=-1)) + 1)]
    expected, before = [], 0
    for one in parts:
        boxes = [
            (int(row["camera"]), np.array([row["x_m"], row["y_m"]]), np.array([[xx, xy], [xy, yy]]))
            for row in one
            for xx, xy, yy in [(row["cov_xx_m2"], row["cov_xy_m2"], row["cov_yy_m2"])]
        ]
        expected += [{before + number for number in members} for members in joined(boxes, 9.0, 1.2)]
        before += len(one)
    assert found == expected


def test_classes_are_joined_by_themselves_in_each_frame() -> None:
    """Two cameras see an object of class 2, and one of class 1 at the same place in the second frame."""
    rows = sightings([(camera, x, 0.0, 0.1, 0.1, 0.0) for camera, x in [(0, 1.0), (0, 5.0), (1, 5.0), (1, 1.02)]])
    rows["class_id"] = [2, 1, 1, 2]
    first, second = FootFuser(min_score=0.0)([Frame(0, 0, rows[3:]), Frame(NS, 1, rows)])
    assert first[0].rows["class_id"].tolist() == [2]
    assert second[0].rows["x_m"].tolist() == pytest.approx([1.01, 5.0])
    assert second[0].rows["class_id"].tolist() == [2, 1]
    assert second[1].rows["detection"].tolist() == [0, 1, 1, 0]


def test_what_is_kept_of_comparing_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_log(tmp_path / "scene.mcap", CAMERAS[:3], people=0.8)
    mcaptrack.fuse(path)
    kept = fused(path)
    monkeypatch.setattr("mcaptrack.extensions.cameras.fusing._KEPT_BYTES", 1500)  # some frames only
    monkeypatch.setattr("mcaptrack.extensions.cameras.feet._BLOCK", 40)
    monkeypatch.setattr("mcaptrack.extensions.cameras.fusing._TOGETHER", 3)
    mcaptrack.fuse(path)
    for t_ns, rows in fused(path).items():
        for name in ("x_m", "y_m", "cov_xx_m2", "score", "seen_by", "expected_by"):
            assert rows[name] == pytest.approx(kept[t_ns][name], rel=1e-9)


def camera_of(matrix: Sequence[Sequence[float]], **others: object) -> CameraView:
    plane = GroundPlane(tuple(np.array(matrix, float).ravel()), int(WIDTH), int(HEIGHT))
    return CameraView(name="camera", planes=((0, plane),), **others)  # type: ignore[arg-type]


class TestOneView:
    #: 1 px is 1 cm along the first axis; along the second the picture is sheared.
    SHEARED: Final = ((0.01, 0.02, 1.0), (0.0, 0.03, 2.0), (0.0, 0.0, 1.0))

    def test_the_covariance_of_a_foot_is_that_of_its_pixels_and_of_the_plane(self) -> None:
        box = np.array([[80.0, 100.0, 40.0, 100.0]])  # its foot is at (100, 200) px, uncertain by 4 px
        places = camera_of(self.SHEARED).places(box, 0, 0.04, 0.1)
        assert places.xy_m[0] == pytest.approx([0.01 * 100 + 0.02 * 200 + 1, 0.03 * 200 + 2])
        across, along = np.array([0.01, 0.0]) * 4, np.array([0.02, 0.03]) * 4
        cov = np.outer(across, across) + np.outer(along, along) + 0.01 * np.eye(2)
        assert places.cov[0] == pytest.approx([cov[0, 0], cov[0, 1], cov[1, 1]])

    def test_the_heights_of_people_are_learned_in_spite_of_others(self) -> None:
        rng = np.random.default_rng(3)
        foot = rng.uniform((0, 100), (WIDTH, HEIGHT), (60, 2))
        high = 0.02 * foot[:, 0] + 0.3 * foot[:, 1] + 7
        high[:6] *= 3  # false boxes
        boxes = np.column_stack([foot[:, 0] - 10, foot[:, 1] - high, np.full(60, 20.0), high])
        found = camera_of(np.eye(3)).with_heights(boxes).heights
        assert found is not None
        assert foot[6:] @ found[:2] + found[2] == pytest.approx(high[6:], rel=0.06)
        assert camera_of(np.eye(3)).with_heights(boxes[:19]).heights is None  # too few

    def test_what_is_visible_of_people_is_in_the_picture_and_not_behind_others(self) -> None:
        view = camera_of(np.eye(3), heights=(0.0, 0.0, 100.0))  # each is 40 px wide
        feet = np.array([[200.0, 300.0], [220.0, 320.0], [0.0, 400.0], [500.0, HEIGHT + 50], [700.0, 200.0]])
        # The second one hides 20 x 80 px of the first; the third is cut at the left, the fourth below.
        assert view.visible(feet, 0) == pytest.approx([0.6, 1.0, 0.5, 0.5, 1.0])
        # The same in two frames: those of one hide nobody in the other.
        several = view.visible(np.concatenate([feet[1:2], feet, feet[:1]]), 0, (1, 0, 5, 1))
        assert several == pytest.approx([1.0, 0.6, 1.0, 0.5, 0.5, 1.0, 1.0])
        assert camera_of(np.eye(3)).visible(feet[:2], 0) == pytest.approx([1.0, 1.0])  # heights that aren't known

    def test_rates_are_those_of_the_share_that_is_visible(self) -> None:
        view = camera_of(np.eye(3), detects=(0.1, 0.2, 0.3, 0.4))
        assert view.rate(np.array([0.0, 0.1, 0.3, 0.6, 0.9, 1.0])).tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.4]


class TestEvidence:
    @staticmethod
    def fused(cameras: Sequence[int]) -> np.void:
        """One person at (300, 300), seen by some of three cameras that detect 80 % of people; 20 % of boxes are false."""
        view = camera_of(np.eye(3), heights=(0.0, 0.0, 100.0), detects=(0.8,) * 4, false_share=0.2)
        rows = sightings([(camera, 300.0, 300.0, 0.1, 0.1, 0.0) for camera in cameras])
        ((found, _),) = FootFuser(min_score=0.0, views=(view,) * 3)([Frame(0, 0, rows)])
        return found.rows[0]

    @pytest.mark.parametrize(
        ("cameras", "odds"),
        [
            # a true box for each false one (4), a camera that sees 8 times as many as by chance, one that sees nobody
            ([0], 4 * (0.2 / 0.9) ** 2),
            ([0, 1], 4 * 8 * (0.2 / 0.9)),
            ([2, 1, 0], 4 * 8 * 8),
        ],
    )
    def test_each_camera_counts_for_or_against(self, cameras: list[int], odds: float) -> None:
        row = self.fused(cameras)
        assert row["score"] == pytest.approx(odds / (1 + odds), rel=1e-5)
        assert (row["seen_by"], row["expected_by"]) == (len(cameras), 3)

    def test_what_is_less_probable_is_left_out(self) -> None:
        rows = sightings([(0, 300.0, 300.0, 0.1, 0.1, 0.0), (0, 800.0, 300.0, 0.1, 0.1, 0.0)])
        view = camera_of(np.eye(3), heights=(0.0, 0.0, 100.0), detects=(0.8,) * 4, false_share=0.2)
        both = FootFuser(min_score=0.16, views=(view,) * 3)
        assert [len(one.rows) for one in next(both([Frame(0, 0, rows)]))] == [2, 2]
        fewer = FootFuser(min_score=0.17, views=(view,) * 3)
        found, members = next(fewer([Frame(0, 0, rows)]))
        assert (len(found.rows), members.rows["detection"].tolist()) == (0, [-1, -1])


class TestPersistence:
    """A person whom one of three cameras sees, again and again; scores by hand."""

    #: A true box for each false one (4), and two cameras that see nobody; what a frame adds that has nobody near.
    ALONE: Final = 4 * (0.2 / 0.9) ** 2
    GONE: Final = 0.15 / 0.7

    @staticmethod
    def scores(drawn: Sequence[Sequence[float]], step_s: float = 0.5, cameras: int = 3) -> list[list[float]]:
        """The odds of each detection, by the places along the first axis in each frame."""
        view = camera_of(np.eye(3), heights=(0.0, 0.0, 100.0), detects=(0.8,) * 4, false_share=0.2)
        frames = [
            Frame(round(n * step_s * NS), n, sightings([(0, 300 + x, 300.0, 0.1, 0.1, 0.0) for x in part]))
            for n, part in enumerate(drawn)
        ]
        made = FootFuser(min_score=0.0, views=(view,) * cameras)(frames)
        return [(found.rows["score"] / (1 - found.rows["score"])).tolist() for found, _ in made]

    def stays(self, before: float = ALONE) -> float:
        """What a frame adds in which somebody is near, with these odds."""
        there = before / (1 + before)
        return there * 0.85 / 0.3 + (1 - there) * self.GONE

    def test_somebody_who_was_near_is_more_probable_and_others_less(self) -> None:
        first, second, third = self.scores([[0.0], [0.6], [0.6, 50.0]])
        assert first == pytest.approx([self.ALONE], rel=1e-4)
        assert second == pytest.approx([self.ALONE * self.stays()], rel=1e-4)
        assert third == pytest.approx([self.ALONE * self.stays(), self.ALONE * self.GONE], rel=1e-4)

    def test_one_place_confirms_one_other_the_nearest(self) -> None:
        _, second = self.scores([[0.0], [0.2, 0.9]])
        assert second == pytest.approx([self.ALONE * self.stays(), self.ALONE * self.GONE], rel=1e-4)

    def test_nobody_walks_farther_than_a_person_can(self) -> None:
        # 3 standard deviations of .1 m for each frame, and .5 m for the walk: 1.56 m
        (_, near), (_, far) = self.scores([[0.0], [1.55]]), self.scores([[0.0], [1.57]])
        assert near == pytest.approx([self.ALONE * self.stays()], rel=1e-4)
        assert far == pytest.approx([self.ALONE * self.GONE], rel=1e-4)

    def test_a_frame_without_boxes_or_long_ago_or_of_one_camera_says_nothing(self) -> None:
        assert self.scores([[0.0], [], [0.0]])[2] == pytest.approx([self.ALONE], rel=1e-4)
        assert self.scores([[0.0], [0.0]], step_s=1.1)[1] == pytest.approx([self.ALONE], rel=1e-4)
        assert self.scores([[0.0], [50.0]], cameras=1)[1] == pytest.approx([4.0], rel=1e-4)

    def test_blocks_of_frames_are_seamless(self, monkeypatch: pytest.MonkeyPatch) -> None:
        drawn = [[0.0, 9.0], [0.4], [0.9, 9.3, 30.0], [], [1.0], [1.1, 9.0]]
        together = self.scores(drawn)
        monkeypatch.setattr("mcaptrack.extensions.cameras.feet._BLOCK", 1)
        assert self.scores(drawn) == together


@settings(max_examples=10, deadline=None)
@given(st.lists(places, min_size=1, max_size=4))
def test_a_fuser_obeys_the_laws_of_transforms(
    drawn: list[list[tuple[int, float, float, float, float, float]]],
) -> None:
    frames = [Frame(number * NS, number, sightings(part)) for number, part in enumerate(drawn)]
    check_transform(FootFuser(min_score=0.0), frames)


class TestAgreement:
    """What cameras are compared by, beside the same said box by box."""

    CAMERAS: Final = 4

    @staticmethod
    def frames(seed: int) -> list[Frame]:
        """Six people who walk or stand; cameras miss some, see false ones, and the third one is late and off."""
        rng = np.random.default_rng(seed)
        begin, pace = rng.uniform(60, 700, (6, 2)), rng.normal(0, 1.0, (6, 2)) * (np.arange(6) < 4)[:, None]
        frames = []
        for n in range(9):
            drawn = []
            for camera in range(TestAgreement.CAMERAS):
                for at, speed in zip(begin, pace, strict=True):
                    if rng.random() < 0.8:
                        x, y = at + speed * (n / 2) + rng.normal(0, 0.1, 2) + (camera == 2) * np.array([0.3, 0.1])
                        drawn.append((camera, x, y, 0.3, 0.3, 0.1))
                if rng.random() < 0.3:
                    drawn.append((camera, *rng.uniform(60, 700, 2), 0.3, 0.3, 0.0))
            rows = sightings(drawn) if n != 5 else sightings([])
            rows["picture_ns"] = n * NS // 2 + 4 * NS + rows["camera"].astype(np.int64) * 10_000_000
            frames.append(Frame(n * NS // 2 + 4 * NS, n, rows))
        return frames

    @staticmethod
    def fuser() -> FootFuser:
        views = [
            camera_of(np.eye(3), heights=(0.0, 0.0, 100.0), detects=(0.2, 0.5, 0.6, 0.8), false_share=0.1 * k)
            for k in range(1, TestAgreement.CAMERAS + 1)
        ]
        return FootFuser(min_score=0.0, views=tuple(views))

    @staticmethod
    def slowly(frames: Sequence[Frame], fuser: FootFuser, offset_ns: Sequence[int]):
        count = len(fuser.views)
        hits = [[5.0 * rate for rate in view.detects] for view in fuser.views]
        tries, boxes = [[5.0] * 4 for _ in range(count)], [5.0] * count
        false = [5.0 * view.false_share for view in fuser.views]
        expected = both = 0
        off, late = ([[] for _ in range(count)] for _ in range(2))
        before: tuple[int, list] | None = None
        for frame in frames:
            rows = frame.rows
            if not len(rows):
                before = None
                continue
            (block,) = fuser.joined([frame])
            of, centre, seen = block.of, block.centre, block.seen
            share = np.array([view.visible(centre.xy_m, frame.t_ns) for view in fuser.views]).T
            rate = np.array([view.rate(part) for view, part in zip(fuser.views, share.T, strict=True)]).T
            sure = [g for g in range(len(seen)) if seen[g].sum() >= 3]
            pace = {}
            if before:
                pairs = mutual([centre.xy_m[g] for g in sure], before[1])
                pace = {
                    sure[i]: (centre.xy_m[sure[i]] - before[1][j]) / ((frame.t_ns - before[0]) / NS) for i, j in pairs
                }
            before = frame.t_ns, [centre.xy_m[g] for g in sure]
            for g in range(len(seen)):
                expected += sum(bool(share[g, c] >= 0.5 or seen[g, c]) for c in range(count)) >= 2
                both += seen[g].sum() >= 2
                for c in range(count):
                    others = [o for o in range(count) if o != c]
                    if sum(seen[g, o] for o in others) >= 2 and share[g, c] > 0:
                        place = next((k for k, end in enumerate((0.25, 0.5, 0.75)) if share[g, c] < end), 3)
                        tries[c][place] += 1
                        hits[c][place] += seen[g, c]
                    if seen[g, c] and sum(rate[g, o] for o in others) >= 1.5:
                        boxes[c] += 1
                        false[c] += not any(seen[g, o] for o in others)
            for c in range(count):
                mine = [k for k in range(len(rows)) if rows["camera"][k] == c]
                places = {}
                for g in sure:
                    rest = [k for k in range(len(rows)) if of[k] == g and rows["camera"][k] != c]
                    cov = [
                        np.array([[r["cov_xx_m2"], r["cov_xy_m2"]], [r["cov_xy_m2"], r["cov_yy_m2"]]])
                        for r in rows[rest]
                    ]
                    total = sum(map(np.linalg.inv, cov))
                    at = [np.array([r["x_m"], r["y_m"]]) for r in rows[rest]]
                    places[g] = np.linalg.solve(total, sum(np.linalg.inv(m) @ p for m, p in zip(cov, at, strict=True)))
                own = [np.array([rows["x_m"][k], rows["y_m"][k]]) for k in mine]
                for i, j in mutual(own, list(places.values())):
                    g = list(places)[j]
                    apart = own[i] - places[g]
                    off[c].append(apart)
                    if g in pace and pace[g] @ pace[g] > 0.25:
                        away_s = (int(rows["picture_ns"][mine[i]]) - offset_ns[c] - frame.t_ns) / NS
                        late[c].append(away_s - apart @ pace[g] / (pace[g] @ pace[g]))
        rates = [[h / t for h, t in zip(*pair, strict=True)] for pair in zip(hits, tries, strict=True)]
        return rates, [f / b for f, b in zip(false, boxes, strict=True)], (expected, both), off, late

    @pytest.mark.parametrize("seed", range(3))
    def test_rates_and_offsets(self, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(fuse, "LEAST_COMPARED", 5)  # fewer say nothing of a clock
        frames, fuser, offset_ns = self.frames(seed), self.fuser(), [0, 30_000_000, 0, 10_000_000]
        for taken_ns in (offset_ns, ()):
            rates, false, shared, off, late = self.slowly(frames, fuser, taken_ns or [0] * 4)
            views, offsets, found = fuse.compare(fuser.joined(frames), fuser.views, taken_ns)
            assert tuple(found) == shared
            for c, (view, offset) in enumerate(zip(views, offsets, strict=True)):
                assert view.detects == pytest.approx(rates[c])
                assert view.false_share == pytest.approx(false[c])
                assert offset.compared == len(off[c]) > 10
                assert (offset.x_m, offset.y_m) == pytest.approx(np.median(off[c], axis=0))
                assert len(late[c]) > 5
                assert offset.late_s == pytest.approx(np.median(late[c]))
                assert offset.distance_m == pytest.approx(np.hypot(offset.x_m, offset.y_m))

    @pytest.mark.parametrize(
        ("expected", "seen", "strangers"), [(50, 12, True), (50, 13, False), (49, 0, False), (100, 25, False)]
    )
    def test_cameras_of_other_places(self, expected: int, seen: int, strangers: bool) -> None:
        shared = fuse.Shared(expected, seen)
        assert shared.are_strangers is strangers
        assert f"of {expected} people that two cameras should see, two see {seen}; " in str(shared)

    def test_nothing_says_nothing(self) -> None:
        views, offsets, shared = fuse.compare([], self.fuser().views)
        assert shared == (0, 0)
        assert [view.false_share for view in views] == pytest.approx([0.1, 0.2, 0.3, 0.4])
        assert views[0].detects == pytest.approx((0.2, 0.5, 0.6, 0.8))
        assert all(np.isnan([one.x_m, one.y_m, one.late_s]).all() and one.compared == 0 for one in offsets)


def mutual(some: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Places that are the nearest of each other, and less than 1.5 m apart."""
    away = np.array([[np.linalg.norm(a - b) for b in others] for a in some]).reshape(len(some), len(others))
    return [
        (i, j)
        for i, j in np.ndindex(*away.shape)
        if away[i, j] < 1.5 and away[i].argmin() == j and away[:, j].argmin() == i
    ]


# Fusers of other packages: found, checked, recorded and used again like detectors and trackers


CELLS = '''
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mcaptrack.schema import DETECTIONS, SIGHTINGS
from mcaptrack.transforms.protocol import option


@dataclass(frozen=True, kw_only=True)
class CellFuser:
    """Join boxes that stand in one cell of a grid."""

    cell_m: float = option(1.0, "size of the cells in metres", least=0.1)

    reads: ClassVar = SIGHTINGS
    writes: ClassVar = {"": DETECTIONS, "sightings": SIGHTINGS}
    latency_s: ClassVar = {"": 0.0, "sightings": 0.0}

    def __call__(self, frames):
        for frame in frames:
            rows = frame.rows[np.lexsort((frame.rows["box_row"], frame.rows["camera"]))]
            xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
            cells, of = np.unique(np.floor(xy_m / self.cell_m), axis=0, return_inverse=True)
            rows["detection"] = of
            x_m, y_m = (cells.T + 0.5) * self.cell_m
            found = DETECTIONS.rows(x_m=x_m, y_m=y_m, class_id=[1] * len(cells))
            yield frame._replace(rows=found), frame._replace(rows=rows)


class Silent(CellFuser):
    writes: ClassVar = {"": DETECTIONS}


class Tracker(CellFuser):
    reads: ClassVar = DETECTIONS


class Broken(CellFuser):
    def __call__(self, frames):
        yield from ()
        raise ValueError("no cells")
'''
NAME = "cells_of_a_test:CellFuser"


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("fusers") / "boxes.mcap", CAMERAS[:2])


@pytest.fixture
def path(boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cells_of_a_test.py").write_text(CELLS)
    return Path(shutil.copy(boxes, tmp_path / "log.mcap"))


def test_a_fuser_of_a_module_makes_the_scene_and_is_recorded(path: Path) -> None:
    mcaptrack.fuse(path, fuser=NAME)
    for t_ns, rows in fused(path).items():
        seen = fused(path, "/world/detections/sightings")[t_ns] if t_ns < 3_000_000_000 else None
        if seen is not None:  # boxes of one cell are one detection, in its middle
            cells = {(np.floor(x), np.floor(y)) for x, y in zip(seen["x_m"], seen["y_m"], strict=True)}
            assert {(x - 0.5, y - 0.5) for x, y in zip(rows["x_m"], rows["y_m"], strict=True)} == cells
    (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
    assert channel.parameters is not None
    assert (channel.parameters["fuser"], channel.parameters["cell_m"]) == (NAME, 1.0)
    assert channel.plugins is not None
    assert channel.plugins["transform"]["implementation"] == NAME


@thorough
def test_a_later_run_uses_the_same_fuser_if_it_may(path: Path) -> None:
    made = FUSION.make(NAME, cell_m=2.0)
    mcaptrack.fuse(path, fuser=made)
    with mcaptrack.open(path) as log:
        frames = [mcaptrack.detections([], [], [], t_ns, box_format="xywh") for t_ns in (1_000_000_000, 2_000_000_000)]
        log.write("/north/detections", frames, replace=True)
    options = {"camera": "world", "tables": False, "events": False, "predictor": "cv"}
    with collected(), pytest.raises(McaptrackError, match="is imported only if you name it"):
        mcaptrack.run(path, **options)
    with collected():
        again = mcaptrack.run(path, fuser=NAME, **options)
        assert any(note.endswith("fusing east, north again, as before") for note in again.notes) or any(
            note.endswith("fusing north, east again, as before") for note in again.notes
        )
        other = mcaptrack.run(path, fuser="feet", **options)
    assert any(note.endswith("again, by the fuser feet") for note in other.notes)
    (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
    assert channel.parameters is not None
    assert channel.parameters["fuser"] == "feet"
    assert channel.parameters["max_sigma"] == 3.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--fuser", "cells_of_a_test:Silent"), "has no output 'sightings'; a fuser also writes which boxes it joined"),
        (("--fuser", "cells_of_a_test:Tracker"), "reads mcaptrack.Detections; a fuser reads mcaptrack.Sightings"),
        (("--fuser", "cells_of_a_test:Broken"), "ValueError: no cells (cells_of_a_test.py, line"),
        (("--fuser", "feets"), "no fuser is called feets; did you mean feet?"),
        (("--fuser", NAME, "--set", "max_sigma=2"), "has no parameter max_sigma; there are cell_m"),
    ],
)
def test_a_fuser_that_can_not_be_used_is_refused_in_one_line(path: Path, options: tuple[str, ...], words: str) -> None:
    before = path.read_bytes()
    outcome = call("fuse", path, *options)
    assert (outcome.code, path.read_bytes()) == (1, before)
    assert words in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_the_laws_of_transforms_are_those_of_fusers(path: Path) -> None:
    assert names("fuser")[0] == "feet"
    check_transform(FUSION.make(NAME))
    check_transform(FUSION.make())


# Boxes of several cameras brought to one time, beside a slow search; and which cameras are disagreements to disagree


S = 10**9
#: Of two cameras, the second at 2 cm to a pixel.
PLANES = tuple(GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 640, 480) for s in (0.01, 0.02))


def source(
    name: str, times_s: Sequence[float], late_s: float = 0.0, plane: GroundPlane = PLANES[0], seed: int = 0
) -> Any:
    """Detections at these times, some without a box in pixels."""
    rng = np.random.default_rng(seed)
    frames = []
    for number, t_s in enumerate(times_s):
        count = int(rng.integers(0, 4))
        px = rng.uniform(10, 300, (4, count))
        px[:, rng.random(count) < 0.2] = np.nan
        rows = DETECTIONS.rows(
            **dict(zip(("x_px", "y_px", "w_px", "h_px"), px, strict=True)), x_m=np.zeros(count), y_m=np.zeros(count),
            score=rng.random(count).round(3), class_id=rng.integers(1, 3, count),
        )  # fmt: skip
        frames.append(Frame(round(t_s * S), number + 50, rows))
    t_ns = np.array([frame.t_ns for frame in frames]) - round(late_s * S)
    return fusing.Source(f"/{name}", frames, t_ns, CameraView(name=name, planes=((0, plane),)))


@pytest.mark.parametrize(
    ("steps_s", "late_s", "within_s"),
    [((0.5, 0.2), 0.0, 0.25), ((0.5, 0.2), 0.13, 0.25), ((4.0, 0.7), 0.3, 0.5), ((1.0, 1.0), 1.6, 0.5)],
)
@pytest.mark.parametrize("together", [64, 3])
def test_boxes_of_all_cameras_are_at_the_times_of_the_slowest(steps_s, late_s, within_s, together, monkeypatch):
    monkeypatch.setattr(fusing, "_TOGETHER", together)
    sources = [
        source("fast", np.arange(0.0, 8.0, steps_s[1]) + 0.03, plane=PLANES[1], seed=1),
        source("slow", np.arange(0.0, 8.0, steps_s[0]), late_s, seed=2),
    ]
    fuser = FootFuser(noise=0.05, noise_m=0.2)
    found = fusing.Gathered(sources, fuser)
    slow = next(one for one in sources if len(one.frames) == min(len(each.frames) for each in sources))
    assert found.at.topic == slow.topic or steps_s[0] == steps_s[1]
    at = [(int(t_ns), frame.index) for t_ns, frame in zip(found.at.t_ns, found.at.frames, strict=True)]
    assert found.left_out == sum(t_ns < 0 for t_ns, _ in at)
    assert len(found) == len(at) - found.left_out
    frames = list(found)
    assert [(frame.t_ns, frame.index) for frame in frames] == [one for one in at if one[0] >= 0]
    for _ in range(2):  # what is kept of the first time is the same the second time
        joined = [frame for block in found.joined(fuser, keeps=True) for frame in block.frames]
        assert [(frame.t_ns, frame.index) for frame in joined] == [(frame.t_ns, frame.index) for frame in frames]
    assert found._within_ns == round(within_s * S)
    for frame in frames:
        wanted = []
        for camera, one in enumerate(sources):
            away, k = min((abs(int(t_ns) - frame.t_ns), k) for k, t_ns in enumerate(one.t_ns))
            if away > within_s * S:
                continue
            scale = one.view.planes[0][1].homography[0]
            for row, box in enumerate(one.frames[k].rows):
                if np.isfinite(box["x_px"]):
                    foot = np.array([box["x_px"] + box["w_px"] / 2, box["y_px"] + box["h_px"]]) * scale
                    # uncertain by the box, by the plane, and by how far people walk in between
                    spread = (0.05 * box["h_px"] * scale) ** 2 + 0.2**2 + (away / S) ** 2
                    wanted.append(
                        (camera, one.frames[k].t_ns, row, *foot, spread, 0, spread, box["score"], box["class_id"])
                    )
        names = (
            "camera", "picture_ns", "box_row", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "score", "class_id",
        )  # fmt: skip
        got = np.array([frame.rows[name].astype(float) for name in names]).T
        np.testing.assert_allclose(got, np.array(wanted, float).reshape(-1, len(names)), rtol=1e-6, atol=1e-9)


def test_of_single_frames_pictures_count_that_are_a_quarter_of_a_second_away():
    for apart_s, count in ((0.25, 2), (0.26, 1)):
        sources = [source("one", [3.0], seed=4), source("other", [3.0 + apart_s], seed=4)]
        found = fusing.Gathered(sources, FootFuser())
        assert len(found) == 1
        (frame,) = found
        assert len(np.unique(frame.rows["camera"])) == count


def offsets_of(*each: tuple[float, int]) -> tuple[Offset, ...]:
    return tuple(Offset(0.0, 0.0, late_s, compared) for late_s, compared in each)


@pytest.mark.parametrize(
    ("late", "given", "offset_s", "calls"),
    [
        # what is seen late in each round, by camera; the offsets in the end
        ([(0.119, -0.1)], {}, {"a": 0.0, "b": 0.0}, 1),
        ([(0.2, -0.5), (0.2, 0.0), (0.01, 0.0)], {}, {"a": 0.2, "b": -0.5}, 3),
        ([(0.3, np.nan), (0.12, np.nan), (0.12, np.nan)], {}, {"a": 0.54, "b": 0.0}, 3),
        ([(0.3, 0.2)], {"a": 0.1}, {"a": 0.1, "b": 0.0}, 1),  # the worst one is as the user says
        ([(0.1, 0.4), (0.1, 0.0)], {"a": 0.1}, {"a": 0.1, "b": 0.4}, 2),
        ([(np.nan, np.nan)], {}, {"a": 0.0, "b": 0.0}, 1),
    ],
)
def test_clocks_are_set_one_at_a_time_the_worst_first(late, given, offset_s, calls, monkeypatch):
    taken: list[list[int]] = []
    starts: list[list[int]] = []

    def compare(blocks, views, taken_ns):
        taken.append(list(taken_ns))
        starts.append([sum(len(block.frames) for block in blocks)])
        return views, offsets_of(*((one, 99) for one in late[len(taken) - 1])), Shared(9, 9)

    monkeypatch.setattr(fusing, "compare", compare)
    sources = [source("a", np.arange(2, 8, 0.5)), source("b", np.arange(2, 8, 0.5), plane=PLANES[1])]
    gathered, fuser, offsets, found, shared = fusing.compared_cameras(sources, FootFuser(), given)
    assert found == pytest.approx(offset_s)
    assert len(taken) == calls
    assert taken[0] == [round(given.get(name, 0.0) * S) for name in ("a", "b")]
    assert starts[0] == [12]
    assert [view.name for view in fuser.views] == ["a", "b"]
    assert (len(offsets), shared, len(gathered)) == (2, Shared(9, 9), 12)
    moved = {one.view.name: int(one.t_ns[0] - frame.t_ns) for one in gathered._sources for frame in one.frames[:1]}
    late_by = {name: -round((offset_s[name] - given.get(name, 0.0)) * S) for name in offset_s}
    if calls < 3:
        assert moved == pytest.approx(late_by)


def disagreements(
    offset: Offset, taken_s: float = 0.0, given: dict[str, float] | None = None, others: int = 1
) -> list[tuple[str, str]]:
    views = [CameraView(name="a", planes=()), *[CameraView(name="b", planes=())] * others]
    with collected() as notices:
        fusing.warn_disagreeing(
            "a.mcap", views, [offset, *offsets_of((0.0, 60)) * others], {"a": taken_s, "b": 0.0}, given or {}
        )
    return [(notice.code, notice.message) for notice in notices]


class TestDisagreeing:
    @pytest.mark.parametrize(("x_m", "compared", "is_said"), [(0.25, 50, False), (0.26, 50, True), (9.0, 49, False)])
    def test_planes_that_are_off(self, x_m, compared, is_said):
        found = [
            message for code, message in disagreements(Offset(0.0, x_m, 0.0, compared)) if code == "cameras-disagree"
        ]
        assert len(found) == is_said
        if is_said:
            assert found[0].startswith("a: feet stand 0.26 m from where the other cameras see them (median of 50); ")

    @pytest.mark.parametrize(
        ("late_s", "word"), [(0.12, ""), (-0.12, ""), (0.125, "late"), (-0.5, "early"), (np.nan, "")]
    )
    def test_clocks_that_seem_off(self, late_s, word):
        found = disagreements(Offset(0.0, 0.0, late_s, 60))
        assert [code for code, _ in found] == ["clock"] * bool(word)
        if word:
            assert found[0][1] == f"a: its times seem {abs(late_s):.2f} s {word}, as people who walk show"

    def test_clocks_that_were_set(self):
        for taken_s, word in ((0.25, "0.25 s late"), (-0.5, "0.50 s early")):
            ((code, message),) = disagreements(Offset(0.0, 0.0, 0.5, 60), taken_s)
            assert (code, message.startswith(f"a: its times are {word}, as people who walk show; ")) == ("clock", True)
        ((_, message),) = disagreements(Offset(0.0, 0.0, 0.5, 60), 0.25, {"a": 0.25})  # as the user says
        assert "seem 0.50 s late" in message

    @pytest.mark.parametrize(("compared", "others", "is_said"), [(50, 1, False), (49, 1, True), (0, 0, False)])
    def test_cameras_that_cannot_be_compared(self, compared, others, is_said):
        found = disagreements(Offset(0.0, 0.0, 0.0, compared), others=others)
        assert [code for code, _ in found] == ["other"] * is_said
        if is_said:
            assert found[0][1].startswith("a: only 49 of its boxes are near people seen by two other cameras")
