"""One log of a robot in every form of messages: the same tracks; and limits of motion, which all stages take."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack import McaptrackError, log
from mcaptrack.schema import PREDICTIONS, TRACKS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES
from tests.space_logs import NAMES, WAYS, Robot, Seen, write

TRACKED = ("/lidar/tracks", "/lidar/samples", "/lidar/retracks", "/lidar/retracks/online", "/lidar/retracks/full")
PREDICTED = ("/lidar/predictions", "/lidar/retracks/predictions")
FORMS = {
    "detections since humble": "ros",  # behind a static transform, with TFMessage
    "markers": "ros",
    "json": "protobuf",
    "scene updates": "protobuf",
}
LIMITS = "car=5:0.5:0.1:1,pedestrian=2"


class Street(Robot):
    """The robot among objects that keep their velocity in the map; some are occluded for a while."""

    def __init__(self, shots: int = 45) -> None:
        super().__init__(shots=shots, boxes=0)
        rng = np.random.default_rng(6)
        middle = self.place[len(self.place) // 2]
        for number in range(8):
            start, name = middle + [*rng.uniform(-25, 25, 2), rng.uniform(-1, 1)], NAMES[number % 4]
            velocity = np.array([*rng.normal(0, 1 if name == "pedestrian" else 4, 2), 0.0]) * (number != 5)
            ahead = Rotation.from_euler("z", rng.uniform(-3, 3))
            size = np.sort(rng.uniform(0.5, 5, 3))[::-1]
            hidden = range(0) if number % 3 else range(12 + number, 30 + 2 * number)
            for at, shot in enumerate(self.shots):
                if at in hidden or rng.random() < 0.1:
                    continue
                rotation, shift = self.pose(shot.stamp_ns)
                centre = start + velocity * (at / 10) + rng.normal(0, 0.1, 3) - shift
                score = round(float(rng.uniform(0.4, 0.9)), 3)
                turn = (rotation.inv() * ahead).as_quat()
                shot.boxes.append(Seen(rotation.inv().apply(centre), turn, size, name, score, 10 + number))


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> dict[str, Path]:
    """A finished log for each form."""
    folder, robot, out = tmp_path_factory.mktemp("street"), Street(), {}
    for number, (form, moving) in enumerate(FORMS.items()):
        out[form] = write(folder / f"{number}.mcap", robot, WAYS[form], moving)
        mcaptrack.run(out[form], topic="/lidar/boxes", tables=False, events=False, sidecar=False)
    return out


def rows_of(path: Path) -> dict[str, np.ndarray]:
    """The rows of each channel of tracks and predictions, by name of the class, which every log numbers by itself."""
    with log.read(path) as opened:
        found = {topic: opened.rows(topic, TRACKS) for topic in TRACKED}
        found |= {topic: opened.rows(topic, PREDICTIONS) for topic in PREDICTED}
    return {topic: rows.rows for topic, rows in found.items()}


def test_every_form_of_a_log_gives_the_same_tracks(street):
    first, *others = (rows_of(path) for path in street.values())
    assert len(np.unique(first["/lidar/retracks/full"]["track_id"])) >= 8
    assert not first["/lidar/retracks/full"]["observed"].all()
    for topic, rows in first.items():
        assert len(rows), topic
        for other in (found[topic] for found in others):
            assert other["track_id"].tolist() == rows["track_id"].tolist(), topic
            for name in set(rows.dtype.names) - {"source_id", "class_id"}:
                kind = rows[name].dtype.kind
                tolerance = 1e-6 if kind == "f" else 0
                np.testing.assert_allclose(other[name], rows[name], atol=tolerance, rtol=0, err_msg=f"{topic} {name}")


def test_limits_of_motion_reach_every_stage_and_are_recorded(street, tmp_path):
    """Channels that were made with other limits are made again; without the option, they stay as they are."""
    path = tmp_path / "a.mcap"
    path.write_bytes(street["markers"].read_bytes())
    before = rows_of(path)
    run = {"tables": False, "events": False, "sidecar": False}
    assert mcaptrack.run(path, **run).stages == ()
    made = mcaptrack.run(path, class_limits=LIMITS, **run)
    taken = {name for name, stage in STAGES.items() if "class_limits" in {f.name for f in fields(stage.default)}}
    assert {"retrack", "predict"} <= taken
    assert {*taken, "track", "sample"} <= set(made.stages)
    with log.read(path) as opened:
        for topic in {*TRACKED, *PREDICTED} - {"/lidar/samples"}:
            how = Provenance.from_metadata(opened.channel(topic).metadata)
            assert how is not None
            assert how.parameters["class_limits"] == LIMITS, topic
    after = rows_of(path)
    for topic, rows in before.items():
        assert rows.tobytes() != after[topic].tobytes(), topic
    assert mcaptrack.run(path, **run).stages == ()
    assert mcaptrack.run(path, class_limits=LIMITS, **run).stages == ()
    assert "track" in mcaptrack.run(path, class_limits="", **run).stages
    for topic, rows in rows_of(path).items():
        assert rows.tobytes() == before[topic].tobytes(), topic


def test_limits_in_another_form_are_refused_in_one_line(street):
    for stage in ("track", "retrack", "predict", "run"):
        more = {"tracker": "ground"} if stage == "track" else {}
        with pytest.raises(McaptrackError, match=r"class_limits has 'car'; it is NAME=SPEED:DRIFT:NOISE:GATE"):
            getattr(mcaptrack, stage)(street["json"], class_limits="car", **more)
