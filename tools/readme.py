"""Run the commands of README.md as they are written; make its pictures and numbers, and those of docs/.

    python3 tools/readme.py FOLDER
    .venv/bin/python tools/readme.py --write    # makes all pictures and numbers again
    .venv/bin/python tools/readme.py --check    # compares them with what is made now

FOLDER, which must not exist, gets a copy of the repository, an environment, and every file that the commands name:
videos, labels and recordings of one drawn scene. All ``sh`` blocks run in their order, then all ``sql`` and ``python``
blocks. The packages that the text asks for (`pip install "mcaptrack[sql]"`) are installed without constraints, so in
their newest releases. Needs nothing but Python 3.11 or later and a package registry. Prints what it leaves out, and
why; exits with 1 and the output of the first command that fails.

Pictures and numbers are of `mcaptrack demo` with its usual seed, and of ten seeds of each scene (demo_scores.json,
which `tools/bench/demo.py` measures). Screenshots need Chromium; without it they are left out. Three minutes
of one core.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from time import monotonic

ROOT = Path(__file__).resolve().parent.parent
#: What isn't run, and why.
LEFT_OUT = {
    r"make test": "it is run by itself",
    r"pip install git\+https://.*": "the copy of the repository is installed",
    r"pip install -c constraints\.txt .*": "it would replace the newest releases",
    r'pip install "mcaptrack\[train\]"|mcaptrack train .*': "torch is several gigabytes",
}
#: Exit codes besides 0 that the README announces.
ALSO_GOOD = {"recover": {3}}
PEOPLE, SECONDS, FPS = 3, 8, 10
T0_NS = 1_777_000_000_000_000_000
IMAGE, BOXES, IMU = "sensor_msgs/msg/CompressedImage", "vision_msgs/msg/Detection2DArray", "sensor_msgs/msg/Imu"
#: The messages of vision_msgs that Detection2DArray needs, as ROS 2 has defined them since Humble.
VISION = {
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--write", action="store_true", help="make pictures and numbers again")
    parser.add_argument("--check", action="store_true", help="compare pictures and numbers with what is made now")
    given = parser.parse_args()
    if given.write or given.check:
        return renew(given.write)
    if given.folder is None:
        parser.error("name a folder, or give --write or --check")
    folder = given.folder.resolve()
    folder.mkdir(parents=True)
    work = copy_of_the_repository(folder / "mcaptrack")
    subprocess.run([sys.executable, "-m", "venv", folder / "env"], check=True)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w+)\n(.*?)^```$", text, re.S | re.M)
    asked = re.findall(r"`(pip install [^`]+)`", text)
    lines = [line for kind, block in blocks if kind == "sh" for line in block.splitlines() if line.strip()]
    if not lines[0].startswith("pip install "):
        raise SystemExit("README.md doesn't begin with `pip install`")
    lines[1:1] = ["pip install .", *dict.fromkeys(asked)]
    for line in lines:
        why = next((why for pattern, why in LEFT_OUT.items() if re.fullmatch(pattern, line)), None)
        if why:
            print(f"not run: {line} ({why})", flush=True)
            continue
        words = shlex.split(line)
        for before, word in pairwise(words):
            if before != "-o" and word in FILES and not any(work.glob(word.rstrip("/"))):
                run([folder / "env" / "bin" / "python", Path(__file__).resolve(), "--make", word], work, folder)
        also = next((codes for name, codes in ALSO_GOOD.items() if line.startswith(f"mcaptrack {name} ")), set())
        run(["sh", "-c", line], work, folder, also)
    for kind, block in blocks:
        if kind in ("sql", "python"):
            code = f"import duckdb; print(duckdb.sql({block!r}))" if kind == "sql" else block
            run([folder / "env" / "bin" / "python", "-c", code], work, folder)
    print("all commands of README.md ran")
    return 0


def copy_of_the_repository(folder: Path) -> Path:
    """What a clone has, with what isn't committed yet."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    if (ROOT / ".git").exists():
        names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0")
        for name in filter(None, names):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
    else:  # an unpacked source distribution
        shutil.copytree(ROOT, folder)
    return folder


def run(words: list[object], work: Path, folder: Path, also_good: set[int] = frozenset()) -> None:  # type: ignore[assignment]
    """Run a command as if the environment were active."""
    env = {
        name: value for name, value in os.environ.items() if name not in ("PIP_CONSTRAINT", "PYTHONPATH", "PYTHONHOME")
    }
    env |= {"PATH": f"{folder / 'env' / 'bin'}{os.pathsep}{env['PATH']}", "VIRTUAL_ENV": str(folder / "env")}
    begun = monotonic()
    done = subprocess.run(
        [str(word) for word in words],
        cwd=work,
        env=env,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    said = str(words[-1]).strip().replace("\n", " ")
    print(f"{monotonic() - begun:6.1f} s  {said}", flush=True)
    if done.returncode not in {0, *also_good} or "Traceback (most recent" in done.stdout:
        raise SystemExit(f"exit {done.returncode}\n{done.stdout}")


# Pictures and numbers. What follows runs where mcaptrack and its dependencies are.

#: Pictures are alike if they differ by fewer grey levels in the mean: encoders and the fonts of Chromium differ.
ALIKE = {".gif": 3.0, ".jpg": 10.0}
#: Stills, which bring their fonts, are alike if no square of so many pixels differs by more grey levels in the mean.
TILE_PX, ALIKE_TILE = 16, 25.0
SCREENSHOTS = ("report", "player", "view", "curves")
#: Sentences with numbers, and the page that each is on.
SENTENCES = {
    "README.md": (
        "In {runs} runs of drawn scenes {before} identity switches become {after}; IDF1: {idf1_before} to {idf1_after}",
        "SORT switches identities {switches_tracks} times in the whole scene, re-tracked tracks {switches} times",
    ),
    "docs/tutorial.md": (
        "IDF1 rises from {was} to {now}, and identity switches fall from {switches_was} to {switches}.",
    ),
}


def renew(writes: bool) -> int:
    """Make all pictures and numbers, and write them, or say which differ; returns the exit code."""
    from pictures import pictures

    differ = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "mcaptrack-demo" / "demo.mcap"
        mcaptrack("demo", "-o", log.parent, "-q")
        for made, path in pictures(log, folder):
            if writes:
                path.parent.mkdir(exist_ok=True)
                shutil.copy2(made, path)
            elif not path.exists() or differs(made, path):
                differ.append(str(path.relative_to(ROOT)))
        for path, text in texts(log):
            if writes:
                path.write_text(text, encoding="utf-8")
            elif path.read_text(encoding="utf-8") != text:
                differ.append(str(path.relative_to(ROOT)))
    print("\n".join(f"{path} differs; `tools/readme.py --write` makes it" for path in differ) or "all is as it is made")
    return int(bool(differ))


def mcaptrack(*words: object) -> str:
    """What a command prints."""
    command = [sys.executable, "-m", "mcaptrack", *map(str, words)]
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout


def differs(made: Path, path: Path) -> bool:
    """Whether two pictures show something else, have another size, or another number of frames."""
    import av
    import numpy as np

    both = []
    for picture in (made, path):
        with av.open(str(picture)) as container:
            both.append(np.stack([frame.to_ndarray(format="gray") for frame in container.decode(video=0)]))
    if both[0].shape != both[1].shape:
        return True
    difference = np.abs(both[0].astype(int) - both[1])
    if path.stem in SCREENSHOTS or path.suffix == ".gif":
        return bool(difference.mean() > ALIKE[path.suffix])
    count, height, width = (size - size % TILE_PX if at else size for at, size in enumerate(difference.shape))
    tiles = difference[:, :height, :width].reshape(count, height // TILE_PX, TILE_PX, width // TILE_PX, TILE_PX)
    return bool(tiles.mean(axis=(2, 4)).max() > ALIKE_TILE)


def texts(log: Path) -> Iterator[tuple[Path, str]]:
    """Pages, and their text with the numbers of now."""
    import json

    from mcaptrack.sources.demo import mean_and_range, read_scores

    scenes = read_scores()["scenes"]
    evaluated = ("evaluate", log, "--similarity", "metres", "--gate-m", "1")
    rows = {row["tracks"]: row for row in json.loads(mcaptrack(*evaluated, "--json", "-q"))["results"]}
    tracks, samples, retracks = (rows[f"/camera/{name}"] for name in ("tracks", "samples", "retracks"))
    of_all = {
        (mode, score): [value for scene in scenes.values() for value in scene[mode][score]]
        for mode in ("SORT", "re-tracked")
        for score in ("IDF1", "IDSW")
    }
    mean = {mode: 100 * sum(of_all[mode, "IDF1"]) / len(of_all[mode, "IDF1"]) for mode in ("SORT", "re-tracked")}
    numbers = {
        "runs": len(of_all["SORT", "IDSW"]),
        "before": sum(of_all["SORT", "IDSW"]),
        "after": sum(of_all["re-tracked", "IDSW"]),
        "idf1_before": f"{mean['SORT']:.1f}",
        "idf1_after": f"{mean['re-tracked']:.1f}",
        "was": f"{100 * samples['IDF1']:.1f}",
        "now": f"{100 * retracks['IDF1']:.1f}",
        "switches_was": samples["IDSW"],
        "switches": retracks["IDSW"],
        "switches_tracks": tracks["IDSW"],
    }
    for name, sentences in SENTENCES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        for sentence in sentences:
            pattern = re.sub(r"\\\{\w+\\\}", r"[\\d.,]*\\d", re.escape(sentence))
            text, count = re.subn(pattern, sentence.format(**numbers), text)
            if not count:
                raise SystemExit(f"{name} has no sentence like: {sentence}")
        if name == "README.md":
            for scene, values in scenes.items():
                cells = [mean_and_range(values[mode]["IDF1"], 100) for mode in ("SORT", "re-tracked")]
                text = re.sub(rf"^\| `{scene}` \|.*$", f"| `{scene}` | {' | '.join(cells)} |", text, flags=re.M)
        else:
            # Tests print the block of another video, of which predictions may help more or less.
            printed = re.sub(r"(constant velocity [\d.]+ m).*", r"\1...", mcaptrack(*evaluated, "-q"))
            text = re.sub(r"```text\nwithin 1 m: .*?```", f"```text\n{printed}```", text, flags=re.S)
        yield ROOT / name, text


# The files that the commands name. What follows runs in the environment, where mcaptrack and its dependencies are.


@cache
def shots():
    """A scene of three people who walk, picture by picture."""
    from mcaptrack.sources.demo import Pedestrian, SyntheticScene

    people = (
        Pedestrian(1, ((0.0, -6.0, 9.0), (SECONDS, 6.0, 11.0)), (30, 30, 30)),
        Pedestrian(2, ((0.0, 6.0, 14.0), (SECONDS, -6.0, 13.0)), (120, 40, 20)),
        Pedestrian(3, ((0.0, 5.0, 18.0), (SECONDS, -4.0, 17.5)), (20, 60, 20)),
    )
    scene = SyntheticScene(people[:PEOPLE], SECONDS, fps=FPS, width_px=320, height_px=180, noise=1.5)
    return scene, list(scene.shots())


def video(path: Path) -> None:
    """An encoded video; with B-frames, as cameras and programs write them, where the container allows it."""
    import av

    _, pictures = shots()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4" if path.suffix == ".avi" else "libx264", rate=FPS)
        stream.height, stream.width = pictures[0].image.shape[:2]
        stream.pix_fmt = "yuv420p"
        for shot in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shot.image, format="bgr24")))
        container.mux(stream.encode(None))


def images(folder: Path) -> None:
    import cv2

    folder.mkdir()
    for number, shot in enumerate(shots()[1], start=1):
        cv2.imwrite(str(folder / f"{number}.jpg"), shot.image)


def homography(path: Path) -> None:
    rows = shots()[0].ground_plane().homography
    path.write_text("\n".join(",".join(map(repr, map(float, rows[k : k + 3]))) for k in (0, 3, 6)) + "\n")


def labels(path: Path) -> None:
    """MOTChallenge text: the truth, detections, or tracks one of whom gets another number half way."""
    what = "truth" if path.name.startswith("gt") else "detections" if path.name.startswith("det") else "tracks"
    lines = []
    for number, shot in enumerate(shots()[1], start=1):
        for who, box in zip(shot.ids, shot.boxes.tolist(), strict=True):
            name = {"truth": who, "detections": -1, "tracks": who + 10 * (who == 1 and number > 50)}[what]
            end = "1,1,1" if what == "truth" else "0.9,-1,-1,-1"
            lines.append(f"{number},{name},{','.join(f'{value:.2f}' for value in box)},{end}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def sequences(pattern: str) -> Callable[[Path], None]:
    """Label files for each name that a pattern may match, in folders as MOTChallenge has them."""

    def make(path: Path) -> None:
        for name in ("east", "west"):
            made = Path(str(path).replace("*", name))
            labels(made)
            if made.parent.name in ("gt", "det"):
                words = f"name={name}\nframeRate={FPS}\nseqLength={FPS * SECONDS}\nimWidth=320\nimHeight=180\n"
                (made.parent.parent / "seqinfo.ini").write_text(f"[Sequence]\n{words}")

    return make


def jpeg(image) -> object:
    import cv2

    return cv2.imencode(".jpg", image)[1]


def header(types, t_ns: int, is_ros1: bool = False):
    time = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    more = {"seq": 0} if is_ros1 else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id="front", **more)


def bag(path: Path) -> None:
    """A ROS 1 bag, or a rosbag2 folder, with pictures."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    with Writer1(path) if is_ros1 else Writer2(path, version=9) as writer:
        channel = writer.add_connection("/front/image", IMAGE, typestore=store)
        for number, shot in enumerate(shots()[1]):
            t_ns = T0_NS + number * 10**9 // FPS
            message = store.types[IMAGE](
                header=header(store.types, t_ns, is_ros1), format="jpeg", data=jpeg(shot.image)
            )
            writer.write(
                channel, t_ns, bytes((store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, IMAGE))
            )


def robot(path: Path) -> None:
    """A log as a robot writes it: pictures, boxes and an IMU, as ROS 2 messages."""
    import numpy as np
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from mcaptrack import log
    from mcaptrack.log import records

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in VISION.items():
        store.register(get_types_from_msg(text, name))
    types = store.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0), orientation=turn
        ),
        covariance=np.zeros(36),
    )
    of = {name.rpartition("/")[2]: types[name] for name in VISION}
    found = of["ObjectHypothesisWithPose"](hypothesis=of["ObjectHypothesis"](class_id="person", score=0.9), pose=pose)
    head = records.pack(records.Opcode.HEADER, records.text("ros2"), records.text("robot"))
    with log.create(path, header=head) as writer:
        channels = {}
        for topic, name in (("/robot/front/image", IMAGE), ("/robot/front/boxes", BOXES), ("/imu", IMU)):
            definition = store.generate_msgdef(name, ros_version=2)[0]
            channels[name] = writer.add_channel(topic, (name, "ros2msg", definition.encode()), "cdr", {})
        for number, shot in enumerate(shots()[1]):
            t_ns = T0_NS + number * 10**9 // FPS
            stamp = header(types, t_ns)
            boxes = [
                of["Detection2D"](
                    header=stamp, results=[found], id="",
                    bbox=of["BoundingBox2D"](
                        center=of["Pose2D"](position=of["Point2D"](x=x + w / 2, y=y + h / 2), theta=0.0),
                        size_x=w, size_y=h,
                    ),
                )
                for x, y, w, h in shot.boxes.tolist()
            ]  # fmt: skip
            zeros = vector(x=0.0, y=0.0, z=9.81)
            imu = {
                "orientation_covariance": np.zeros(9),
                "angular_velocity_covariance": np.zeros(9),
                "linear_acceleration_covariance": np.zeros(9),
            }
            messages = {
                IMAGE: types[IMAGE](header=stamp, format="jpeg", data=jpeg(shot.image)),
                BOXES: of["Detection2DArray"](header=stamp, detections=boxes),
                IMU: types[IMU](
                    header=stamp, orientation=turn, angular_velocity=zeros, linear_acceleration=zeros, **imu
                ),
            }
            for name, message in messages.items():
                writer.add_message(channels[name], t_ns, number, bytes(store.serialize_cdr(message, name)))


def logs(path: Path) -> None:
    """Two recordings that were run: log.mcap, twice."""
    path.parent.mkdir()
    for name in ("monday", "tuesday"):
        shutil.copy2("log.mcap", path.parent / f"{name}.mcap")


def broken(path: Path) -> None:
    whole = Path("log.mcap").read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def trained(path: Path) -> None:
    """What training gives, from the package: training itself needs torch."""
    from mcaptrack.predictors.weights import SHIPPED

    path.parent.mkdir()
    shutil.copy2(SHIPPED / "red.safetensors", path)


#: What makes each file that a command names.
FILES: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("video.mp4", "walk.mp4", "video.avi"), video),
    "frames/": images,
    "homography.txt": homography,
    **dict.fromkeys(("gt.txt", "det.txt", "tracks.txt"), labels),
    **{pattern: sequences(pattern) for pattern in ("train/*/gt/gt.txt", "train/*/det/det.txt", "tracks/*.txt")},
    **dict.fromkeys(("drive.bag", "rosbag2_2026_05_01/"), bag),
    **dict.fromkeys(("robot.mcap", "other.mcap"), robot),
    **dict.fromkeys(("logs/*.mcap", "runs/*.mcap"), logs),
    "logs/": lambda path: logs(path / "*.mcap"),
    "broken.mcap": broken,
    "red:trained/red.safetensors": lambda path: trained(Path("trained/red.safetensors")),
    "zones=zones.csv": lambda path: Path("zones.csv").write_text("track_id,zone\n1,door\n2,stairs\n") and None,
    "speed.sql": lambda path: (
        path.write_text("select recording, avg(mean_speed_m_s) from track_summary group by 1\n") and None
    ),
}

if __name__ == "__main__":
    if sys.argv[1:2] == ["--make"]:
        FILES[sys.argv[2]](Path(sys.argv[2]))
    else:
        sys.exit(main())
