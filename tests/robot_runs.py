"""A robot that passes a car and a pedestrian: a log with their boxes, and the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mcaptrack.geometry.clocks import NS_PER_S
from tests.space_logs import WAYS, Robot, Seen, write

#: Class, place at the start and velocity in the map, heading, and size of each object, by its id.
OBJECTS = {
    3: ("car", (5012.0, -296.0, 61.0), (6.0, 1.5, 0.0), np.arctan2(1.5, 6.0), (4.5, 1.8, 1.5)),
    8: ("pedestrian", (5016.0, -304.0, 60.5), (0.5, 1.2, 0.0), np.arctan2(1.2, 0.5), (0.6, 0.5, 1.75)),
}


def place(number: int, stamp_ns: int, start_ns: int) -> np.ndarray:
    _, at, velocity, _, _ = OBJECTS[number]
    return np.array(at) + np.array(velocity) * ((stamp_ns - start_ns) / NS_PER_S)


def passing_robot(shots: int = 25) -> Robot:
    """A robot that sees all objects at all times."""
    robot = Robot(shots=shots, boxes=0)
    for shot in robot.shots:
        turn, shift = robot.pose(shot.stamp_ns)
        for number, (name, _, _, heading, size) in OBJECTS.items():
            at = turn.inv().apply(place(number, shot.stamp_ns, robot.shots[0].stamp_ns) - shift)
            own = (turn.inv() * Rotation.from_euler("z", heading)).as_quat()
            shot.boxes.append(Seen(at, own, np.array(size), name, 0.9, number))
    return robot


def truth_of(robot: Robot) -> str:
    lines = ["t_ns,id,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad"]
    for shot in robot.shots:
        for number, (name, _, _, heading, size) in OBJECTS.items():
            at = place(number, shot.stamp_ns, robot.shots[0].stamp_ns)
            lines.append(",".join(map(str, (shot.stamp_ns, number, name, *at, *size, heading))))
    return "\n".join(lines) + "\n"


def write_passing(folder: Path, way: str = "detections since humble", shots: int = 25) -> tuple[Path, Path]:
    """A log and its truth."""
    robot = passing_robot(shots)
    moving = "protobuf" if way in ("scene updates", "json") else "ros"
    truth = folder / "truth.csv"
    truth.write_text(truth_of(robot))
    return write(folder / "robot.mcap", robot, WAYS[way], moving), truth
