"""Ground planes corrected by people whom several cameras see: drawn people, cameras whose planes are known to be off."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.extensions.cameras.calibrating import Refined, Refiner, Watched
from mcaptrack.extensions.cameras.ground_correction import MODELS, Corrector, Feet, moved, vote
from mcaptrack.geometry.arrays import taken
from mcaptrack.geometry.pinhole import Lens, ground_homography
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.schema import GROUND_PLANE
from mcaptrack.schema.encodings import PROTOBUF, record_of
from mcaptrack.sources.cameras import camera_at
from tests.commands import call, done
from tests.places import CAMERAS, errors, fused, said, write_log
from tests.tiers import thorough

RATE_HZ, FRAMES, PEOPLE = 2.0, 60, 6
SHIFT, TURN = np.array([[1, 0, 0.5], [0, 1, -0.3], [0, 0, 1.0]]), np.deg2rad(5)
ROTATION = np.array([[np.cos(TURN), -np.sin(TURN), 0.4], [np.sin(TURN), np.cos(TURN), -0.5], [0, 0, 1.0]])
TILT = np.array([[1.02, 0.03, 0.2], [-0.02, 0.97, 0.3], [0.006, -0.008, 1.0]])


def walks(seed: int, on_line: bool = False) -> np.ndarray:
    """Where people are (FRAMES, PEOPLE, 2): each walks straight on and turns at the edges of 16 m x 12 m."""
    rng = np.random.default_rng(seed)
    at, pace = rng.uniform((-8, -6), (8, 6), (PEOPLE, 2)), rng.uniform(-1.2, 1.2, (PEOPLE, 2))
    if on_line:
        at[:, 1], pace[:, 1] = 0.0, 0.0
    out = at + np.arange(FRAMES)[:, None, None] / RATE_HZ * pace
    return np.stack(
        [np.abs((part + size) % (4 * size) - 2 * size) - size for part, size in zip(out.T, (8, 6), strict=True)]
    ).T


def watched(
    name: str, at: np.ndarray, off: np.ndarray | None = None, noise_m: float = 0.12, seen: float = 0.85
) -> Watched:
    """A camera that sees people with noise, and takes them for ``off`` of where they are."""
    rng = np.random.default_rng(len(name) + 7 * ord(name[-1]))
    frame = np.repeat(np.arange(FRAMES), PEOPLE)
    kept = rng.random(len(frame)) < seen
    xy_m = (at.reshape(-1, 2) + rng.normal(0, noise_m, (len(frame), 2)))[kept]
    xy_m = xy_m if off is None else moved(off, xy_m)
    cov = np.tile([noise_m**2 + 0.01, 0, noise_m**2 + 0.01], (len(xy_m), 1))
    plane = GroundPlane((0.01, 0, 0, 0, 0.01, 0, 0, 0, 1.0), 1000, 1000)
    return Watched(name, Feet(xy_m, cov, frame[kept]), np.ones(len(xy_m), np.int64), plane)


def refined(cameras: Sequence[Watched], *trusted: str) -> dict[str, Refined]:
    found = Refiner(cameras, FRAMES, RATE_HZ, frozenset(trusted), (3.0, 1.2)).refine()
    return {one.name: one for one in found}


def off_by(one: Refined, off: np.ndarray | None, at: np.ndarray) -> float:
    """How far people still are from where they should be, in m: the root of the mean square."""
    xy_m = at.reshape(-1, 2)
    apart = moved(one.matrix @ (np.eye(3) if off is None else off), xy_m) - xy_m
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


class TestCorrections:
    @pytest.mark.parametrize(
        ("off", "kinds"),
        [
            pytest.param(SHIFT, {"shift"}, marks=thorough),
            (SHIFT @ [[1, 0, 2.4], [0, 1, 1.7], [0, 0, 1]], {"shift"}),  # 3 m, farther than people are from each other
            pytest.param(ROTATION, {"rigid"}, marks=thorough),
            (np.linalg.inv(TILT), {"full"}),
        ],
        ids=["0.6 m", "3 m", "rotated", "tilted"],
    )
    def test_a_plane_that_is_off_is_brought_back_and_others_stay(self, off: np.ndarray, kinds: set[str]) -> None:
        at = walks(3)
        found = refined([watched("a", at), watched("b", at, off), watched("c", at)])
        assert off_by(found["b"], off, at) < 0.06
        assert found["b"].model in kinds
        assert found["b"].after is not None
        assert found["b"].before is not None
        assert found["b"].after.median_m < 0.25 < found["b"].before.median_m
        assert found["b"].after.pairs == found["b"].before.pairs > 200
        assert {name for name, one in found.items() if one.model} == {"b"}

    @thorough
    def test_a_plane_that_is_off_by_less_than_a_step_stays(self) -> None:
        at, off = walks(9), np.array([[1, 0, 0.12], [0, 1, -0.1], [0, 0, 1.0]])
        found = refined([watched("a", at), watched("b", at, off), watched("c", at)])
        assert [one.why for one in found.values()] == ["it agrees with the others"] * 3
        assert np.array_equal(found["b"].matrix, np.eye(3))

    @thorough
    def test_two_planes_that_are_off_at_once(self) -> None:
        at, off = walks(4), {"b": SHIFT, "d": ROTATION}
        found = refined([watched(name, at, off.get(name)) for name in "abcd"])
        assert {name for name, one in found.items() if one.model} == {"b", "d"}
        assert off_by(found["b"], SHIFT, at) < 0.1
        assert off_by(found["d"], ROTATION, at) < 0.1

    def test_cameras_are_brought_to_the_reference(self) -> None:
        at = walks(5)
        found = refined([watched("a", at), watched("b", at, ROTATION)], "a")
        assert off_by(found["b"], ROTATION, at) < 0.1
        assert found["a"].model == ""

    def test_walks_on_one_line_determine_a_shift_and_a_rotation_alone(self) -> None:
        at = walks(6, on_line=True)
        found = refined([watched("a", at), watched("b", at, np.linalg.inv(TILT)), watched("c", at)])["b"]
        assert found.model in ("shift", "rigid")
        assert found.limit == "people walk on one line: only a shift and a rotation are determined"

    def test_too_few_people_are_not_compared(self) -> None:
        at = walks(7)
        rare = [replace(one, feet=taken(one.feet, one.feet.frame < 8), classes=one.classes[one.feet.frame < 8]) for one in
                (watched("a", at), watched("b", at, SHIFT), watched("c", at))]  # fmt: skip
        found = refined(rare)
        assert not any(one.model for one in found.values())
        assert found["b"].why.startswith("it can't be compared: ")
        assert found["b"].before is None

    @thorough
    def test_a_lens_stays_right(self) -> None:
        """A camera that was moved and turned: its correction is such a movement, for the same lens."""
        lens = Lens((700.0, 700.0), (480.0, 270.0))
        down = np.array([[1.0, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]])
        right = np.reshape(ground_homography(lens, down, -down @ [0, -14.0, 6.0], np.eye(3)), (3, 3))
        turn = np.array([[1, 0.02, 0], [-0.02, 1, 0.03], [0, -0.03, 1.0]])
        turned = np.linalg.qr(turn)[0] * np.sign(np.diag(np.linalg.qr(turn)[1])) @ down
        wrong = np.reshape(ground_homography(lens, turned, -turned @ [0.3, -14.2, 6.1], np.eye(3)), (3, 3))
        at, off = walks(8), wrong @ np.linalg.inv(right)
        plane = GroundPlane(tuple((wrong / 1.0).ravel()), 960, 540, lens=lens)
        b = replace(watched("b", at, off / off[2, 2]), plane=plane)
        found = refined([watched("a", at), b, watched("c", at)])["b"]
        assert found.model == "pose"
        assert off_by(found, off / off[2, 2], at) < 0.1
        pose = np.linalg.inv(lens.matrix) @ np.linalg.inv(found.matrix @ wrong)  # two columns of a rotation, scaled
        assert np.linalg.norm(pose[:, 0]) == pytest.approx(np.linalg.norm(pose[:, 1]), rel=1e-6)
        assert pose[:, 0] @ pose[:, 1] == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.floats(-6, 6), st.floats(-6, 6), st.integers(0, 50))
def test_a_vote_finds_any_shift(x: float, y: float, seed: int) -> None:
    at = walks(seed)
    off = np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
    found = vote(watched("a", at, off).feet, watched("b", at, noise_m=0.1, seen=1.0).feet, 20)
    apart = moved(found @ off, at.reshape(-1, 2)) - at.reshape(-1, 2)
    assert np.hypot(*apart.T).mean() < 0.7  # near enough to pair people with themselves


@pytest.mark.parametrize("model", MODELS)
def test_maps_begin_with_nothing_and_are_fitted_exactly(model: str) -> None:
    corrector = Corrector.around(model, np.random.default_rng(1).uniform(-5, 5, (50, 2)))
    assert corrector.matrix(np.zeros(corrector.size)) == pytest.approx(np.eye(3))
    wanted = corrector.matrix(np.array([0.1, -0.08, 0.05, 0.03, -0.02, 0.03, 0.02, -0.02][: corrector.size]))
    at = walks(2)
    clean = watched("a", at, noise_m=1e-6, seen=1.0).feet
    there = clean._replace(xy_m=moved(wanted, clean.xy_m))
    found = corrector.fit(clean, there, np.eye(3))
    assert moved(found, clean.xy_m) == pytest.approx(there.xy_m, abs=0.01)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of four cameras, of which one has a plane that is off by 0.8 m; fused."""
    path = write_log(tmp_path_factory.mktemp("wrong") / "wrong.mcap", moved_m={"east": 0.8}, people=0.9)
    with collected():
        mcaptrack.fuse(path)
    return path


@pytest.fixture(scope="module")
def right(wrong: Path) -> tuple[Path, mcaptrack.CalibrateResult]:
    """The log after it was calibrated."""
    path = Path(shutil.copy(wrong, wrong.with_name("right.mcap")))
    with collected():
        return path, mcaptrack.calibrate(path)


def homography(path: Path, topic: str) -> np.ndarray:
    with mcaptrack.open(path) as opened:
        row = opened.array("ground_planes", topic)[0]
    return np.array([[row[f"h{i}{j}"] for j in range(3)] for i in range(3)])


class TestLogs:
    @thorough
    def test_the_given_plane_stays_and_the_corrected_one_is_used(
        self, wrong: Path, right: tuple[Path, mcaptrack.CalibrateResult], tmp_path: Path
    ) -> None:
        path, result = right
        assert dict(result.corrected) == {"east": "/east/ground_plane/refined"}
        assert result.cameras["east"].moved_m == pytest.approx(0.8, abs=0.1)
        with log.read(path) as opened, log.read(wrong) as before:
            given, same = (list(one.messages("/east/ground_plane")) for one in (opened, before))
            assert [one.payload for one in given] == [one.payload for one in same]
        feet = np.array([[300.0, 400.0, 1.0], [700.0, 350.0, 1.0], [500.0, 500.0, 1.0]]).T
        truth, used = CAMERAS[1].homography() @ feet, homography(path, "/east/ground_plane/refined") @ feet
        assert used[:2] / used[2] == pytest.approx(truth[:2] / truth[2], abs=0.15)
        again = Path(shutil.copy(path, tmp_path / "again.mcap"))
        with collected():
            mcaptrack.fuse(again)
        assert np.median(errors(fused(again))[0]) < 0.8 * np.median(errors(fused(wrong))[0])

    def test_what_was_made_before_is_out_of_date(self, right: tuple[Path, mcaptrack.CalibrateResult]) -> None:
        path, result = right
        assert result.stale == ("/world/detections", "/world/detections/sightings")
        with log.read(path) as opened:
            made = opened.channels["/east/ground_plane/refined"].metadata
        how = json.loads(made["mcaptrack.parameters"])
        assert (how["correction"], how["compared_with"]) == ("shift", ["north", "south", "west"])
        assert made["mcaptrack.input"] == "/east/ground_plane"

    def test_a_second_time_changes_nothing_and_it_can_be_taken_back(
        self, right: tuple[Path, mcaptrack.CalibrateResult], wrong: Path, tmp_path: Path
    ) -> None:
        path = Path(shutil.copy(right[0], tmp_path / "log.mcap"))
        before = path.read_bytes()
        with collected():
            again = mcaptrack.calibrate(path)
        assert (again.written_to, path.read_bytes()) == (None, before)
        assert again.cameras == right[1].cameras
        assert (right[1].unchanged, again.unchanged, dict(again.corrected)) == ((), ("east",), right[1].corrected)
        told = done("calibrate", path, "--dry-run").err
        assert "0 of 4 cameras would be corrected, 1 already: east\n" in told
        assert "east   corrected already by a shift" in told
        with collected():
            mcaptrack.track(path, camera="east", views=True)
            drawn = "/east/ground_plane/view/scene"
            gone = mcaptrack.drop(path, "/east/ground_plane/refined").dropped
            assert gone == ("/east/ground_plane/refined", drawn)  # the outline was that of the corrected plane
            (line,) = said(mcaptrack.fuse(path), "cameras-disagree")  # type: ignore[arg-type]
            assert line.endswith(f"is not right; `mcaptrack.calibrate('{path}')` corrects it")

    def test_a_new_plane_ends_a_correction(self, right: tuple[Path, mcaptrack.CalibrateResult], tmp_path: Path) -> None:
        path = Path(shutil.copy(right[0], tmp_path / "log.mcap"))
        labels, plane = tmp_path / "labels.txt", tmp_path / "plane.txt"
        labels.write_text("1,1,20,50,20,50,1,-1,-1,-1\n")
        np.savetxt(plane, CAMERAS[1].homography())
        with collected() as notices:
            mcaptrack.ingest(labels, fps=2, role="truth", camera="east", ground_plane=plane, into=path, force=True)
        (line,) = (one.message for one in notices if "refined" in one.message)
        assert line == "/east/ground_plane/refined is dropped: it corrected the ground plane that is replaced"
        with log.read(path) as opened:
            assert "/east/ground_plane/refined" not in opened.channels
        with collected():
            assert not said(mcaptrack.fuse(path), "cameras-disagree")  # type: ignore[arg-type]

    def test_what_can_not_be_is_one_line(self, wrong: Path) -> None:
        before = wrong.read_bytes()
        for words, message in {
            "--cameras east,north": "of two cameras, east and north, the log doesn't say which is right; name that",
            "--cameras east,nowhere": "has no camera nowhere; it has east, north, south, west",
            "--cameras east": "--cameras has east alone; two cameras with detections and measured ground planes are",
            "--reference up": "--reference has up, which is not compared; east, north, south, west are",
            "--clock-offset-s up=1": "--clock-offset-s has up, which is not compared; east, north, south, west are",
            "--clock-offset-s east=1e300": "a clock is late by a day at most",
        }.items():
            told = call("calibrate", wrong, *words.split())
            assert (told.code, told.err.count("\n"), wrong.read_bytes()) == (1, 1, before)
            assert message in told.err

    def test_a_plane_that_was_replaced_elsewhere_is_used_without_its_old_correction(
        self, right: tuple[Path, mcaptrack.CalibrateResult], tmp_path: Path
    ) -> None:
        """Other software may replace the plane that was given, and leave the correction of the one before."""
        path = Path(shutil.copy(right[0], tmp_path / "log.mcap"))
        with log.read(path) as opened:
            assert camera_at(opened, "/east").ground_plane == "/east/ground_plane/refined"
            plane, other = (opened.channels[f"/{name}/ground_plane"] for name in ("east", "north"))
            assert plane.metadata["mcaptrack.digest"] != other.metadata["mcaptrack.digest"]
            (message,) = opened.messages("/north/ground_plane")
            with log.extend(opened, drop={plane.topic}) as writer:
                channel = writer.add_channel(plane.topic, record_of(GROUND_PLANE, PROTOBUF), PROTOBUF, other.metadata)
                writer.add_message(channel, message.t_ns, message.sequence, message.payload)
        with log.read(path) as opened:
            assert "/east/ground_plane/refined" in opened.channels
            assert camera_at(opened, "/east").ground_plane == "/east/ground_plane"

    @thorough
    def test_a_correction_that_no_longer_holds_is_dropped_and_a_dry_run_says_so(
        self, right: tuple[Path, mcaptrack.CalibrateResult], tmp_path: Path
    ) -> None:
        path = Path(shutil.copy(right[0], tmp_path / "log.mcap"))
        topic = "/north/ground_plane/refined"
        with log.read(path) as opened:
            made, (message,) = opened.channels[right[1].corrected["east"]], opened.messages("/north/ground_plane")
            how = {**made.metadata, "mcaptrack.input": "/north/ground_plane"}
            how["mcaptrack.input_digest"] = opened.channels["/north/ground_plane"].metadata["mcaptrack.digest"]
            with log.extend(opened) as writer:
                channel = writer.add_channel(topic, record_of(GROUND_PLANE, PROTOBUF), PROTOBUF, how)
                writer.add_message(channel, message.t_ns, message.sequence, message.payload)
        before = path.read_bytes()
        told = done("calibrate", path, "--dry-run").err
        assert f"would be dropped  {topic}: the camera agrees without it" in told
        assert path.read_bytes() == before
        with collected():
            assert mcaptrack.calibrate(path).dropped == (topic,)
        with log.read(path) as opened:
            assert topic not in opened.channels

    @thorough
    def test_fuse_proposes_to_calibrate_where_a_plane_is_too_far_off_to_compare(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "far.mcap", CAMERAS[:3], moved_m={"east": 3.0})
        told = done("fuse", path).err
        assert told.count(f"too few to compare it with the others; `mcaptrack calibrate {path} --dry-run` finds") == 3
        with collected():
            assert list(mcaptrack.calibrate(path, dry_run=True).corrected) == ["east"]

    def test_cameras_without_boxes_are_left_out_once_and_are_no_reference(self, wrong: Path, tmp_path: Path) -> None:
        path = Path(shutil.copy(wrong, tmp_path / "log.mcap"))
        with collected():
            mcaptrack.drop(path, ["/south/*"])
            with mcaptrack.open(path) as opened:
                opened.write("/west/detections", [], replace=True)
        told = call("calibrate", path)
        assert told.code == 1
        assert told.err.count("west is left out") == 1
        assert "of two cameras, east and north, the log doesn't say which is right" in told.err
        told = call("calibrate", path, "--reference", "west").err
        assert "--reference has west without any box; east, north have some" in told
        assert done("calibrate", path, "--reference", "north", "--dry-run").err.count("west is left out") == 1

    @pytest.mark.parametrize("rows", [0, 1])
    def test_a_damaged_plane_is_named(self, wrong: Path, tmp_path: Path, rows: int) -> None:
        path, topic = Path(shutil.copy(wrong, tmp_path / "log.mcap")), "/east/ground_plane"
        with log.read(path) as opened:
            (frame,) = opened.frames(topic, GROUND_PLANE)
            bad = frame.rows[:rows].copy()
            bad["h11"] = np.nan
            channel = opened.channels[topic]
            with log.extend(opened, drop={topic}) as writer:
                new = writer.add_channel(topic, record_of(GROUND_PLANE, PROTOBUF), PROTOBUF, channel.metadata)
                writer.add_message(new, frame.t_ns, 0, GROUND_PLANE.codec.encode(bad))
        what = "a homography is 9 finite numbers" if rows else "a ground plane message holds one row, not 0"
        for command in ("calibrate", "fuse"):
            told = call(command, path)
            assert (told.code, f"{path}: {topic}: {what}" in told.err) == (1, True)
