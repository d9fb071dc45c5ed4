"""The pictures of README.md and docs/, of drawn scenes alone; `tools/readme.py` writes and compares them."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

import mcaptrack
from mcaptrack.sources.demo import demo_scene

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent))
from traffic import CLASSES, draw_traffic

from tests.browser import PROGRAM, browser

DOCS = Path(__file__).resolve().parent.parent / "docs"
#: How the picture of the README is drawn.
COMPARED = "--compare --width 800 --start-s 26.5 --end-s 33 --max-fps 3"
#: Width of a picture of one part, and of each of two beside each other (px).
WIDE, HALF = 800, 400
ZONES = {
    "type": "FeatureCollection",
    "units": "metres",
    "features": [
        {
            "type": "Feature",
            "properties": {"name": "square"},
            "geometry": {"type": "Polygon", "coordinates": [[[-2, 9], [2, 9], [2, 14], [-2, 14], [-2, 9]]]},
        },
        {
            "type": "Feature",
            "properties": {"name": "gate"},
            "geometry": {"type": "LineString", "coordinates": [[4, 8], [4, 17]]},
        },
    ],
}
Picture = np.ndarray


def pictures(log: Path, folder: Path) -> Iterator[tuple[Path, Path]]:
    """Pictures as they are made now, and where they stand. ``log`` is that of the demonstration."""
    command("render", log, "-o", folder / "demo.gif", *COMPARED.split())
    yield folder / "demo.gif", DOCS / "demo.gif"
    drawn = folder / "images"
    drawn.mkdir()
    for name, picture in stills(log, folder):
        cv2.imwrite(str(drawn / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        yield drawn / f"{name}.jpg", DOCS / "images" / f"{name}.jpg"
    if PROGRAM is None:
        print("left out: screenshots (there is no Chromium)")
        return
    for name, picture in screenshots(log, folder):
        path = (DOCS if name == "report" else DOCS / "images") / f"{name}.jpg"
        cv2.imwrite(str(drawn / path.name), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        yield drawn / path.name, path


def stills(log: Path, folder: Path) -> Iterator[tuple[str, Picture]]:
    """Pictures with drawings, by name."""
    with mcaptrack.open(log) as opened:
        stages = ("detections", "tracks", "predictions", "retracks/full")
        views = [f"/camera/retracks/{name}/view/image" for name in ("full", "predictions")]
        yield "stages", grid([still(opened, 13.0, topic) for topic in stages])
        yield "predictions", still(opened, 28.0, views, WIDE)
        yield "labels", still(opened, 28.0, "truth", WIDE)
        moments = [(topic, t_s) for topic in ("tracks", "retracks/full") for t_s in (20.5, 24.5)]
        yield "method", grid([still(opened, t_s, topic) for topic, t_s in moments])
        above = "/camera/retracks/full/view/scene"
        yield "ground-plane", grid([still(opened, 34.0, topic) for topic in ("retracks/full", above)])
    yield "zones", zones(log, folder)
    command("render", log, "--heatmap", "-o", folder / "heat.png", "--width", WIDE)
    yield "heatmap", cv2.imread(str(folder / "heat.png"))
    command("render", log, "--blur", "people", "-o", folder / "blurred.mp4", "--start-s", 28, "--end-s", 28.02)
    yield "blurred", cv2.resize(frames(folder / "blurred.mp4")[0], (WIDE, WIDE * 9 // 16), interpolation=cv2.INTER_AREA)
    yield "detectors", detectors(log, folder)
    yield "camera-motion", camera_motion(log, folder)
    yield "cameras", cameras(folder)
    yield "robots", robots(folder)


def screenshots(log: Path, folder: Path) -> Iterator[tuple[str, Picture]]:
    """Pages as Chromium shows them, by name."""
    command("report", log, "-o", folder / "report.html")
    yield "report", shown((folder / "report.html").as_uri(), folder, 800, 1077)
    with mcaptrack.open(log) as opened:
        opened.show(start_s=27.0, end_s=31.0).save(folder / "player.html")
    yield "player", shown((folder / "player.html").as_uri(), folder, 800, 600, "player.html")
    server = mcaptrack.view(log, port=0).start()
    yield "view", shown(server.address, folder, 1200, 760, "player-0.html")
    server.close()
    command("evaluate", log, "--set", "smoothed=true", "--curves", folder / "curves.svg")
    yield "curves", shown((folder / "curves.svg").as_uri(), folder, 560, 300)


def command(*words: object) -> None:
    """Run a command of mcaptrack."""
    line = [sys.executable, "-m", "mcaptrack", *map(str, words), "-q"]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL)


def still(opened: Any, t_s: float, topic: str | Sequence[str], width: int = HALF) -> Picture:
    """A picture of a log with a view drawn on it."""
    player = opened.show(t_s, topic=topic, width=WIDE)
    picture = cv2.imdecode(np.frombuffer(player.still, np.uint8), cv2.IMREAD_COLOR)
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def grid(parts: Sequence[Picture], columns: int = 2) -> Picture:
    """Pictures of one size in rows, with white lines between them."""
    framed = [cv2.copyMakeBorder(part, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255)) for part in parts]
    height = min(part.shape[0] for part in framed)
    framed = [part[:height] for part in framed]
    return np.vstack([np.hstack(framed[at : at + columns]) for at in range(0, len(framed), columns)])


def shown(address: str, folder: Path, width: int, height: int, player: str = "") -> Picture:
    """A screenshot of a page (px), once the player in its frame of this name is ready."""
    path = folder / "shown.png"
    with browser() as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        tab.open(address)
        tab.wait("document.readyState === 'complete'")
        if player:
            tab.wait("document.documentElement.classList.contains('ready')", player)
        tab.picture(path, width, height)
    return cv2.imread(str(path))


def frames(path: Path) -> list[Picture]:
    """The pictures of a video."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def copied(log: Path, folder: Path, name: str) -> Path:
    """A copy of a log, to write to."""
    return Path(shutil.copy2(log, folder / f"{name}.mcap"))


def zones(log: Path, folder: Path) -> Picture:
    """A zone and a line, with their counts."""
    path = copied(log, folder, "zones")
    (folder / "zones.geojson").write_text(json.dumps(ZONES))
    command("run", path, "--zones", folder / "zones.geojson")
    with mcaptrack.open(path) as opened:
        views = ["/camera/retracks/full/zones/view/image", "/camera/retracks/full/view/image"]
        return still(opened, 34.0, views, WIDE)


def detectors(log: Path, folder: Path) -> Picture:
    """Boxes of both motion detectors where people overlap."""
    path = copied(log, folder, "knn")
    command("detect", path, "--detector", "knn")
    parts = []
    for each in (log, path):
        with mcaptrack.open(each) as opened:
            part = still(opened, 28.8, "detections", WIDE)[70:400, :600]
            parts.append(cv2.resize(part, (HALF, HALF * part.shape[0] // part.shape[1]), interpolation=cv2.INTER_AREA))
    return grid(parts)


def camera_motion(log: Path, folder: Path, swing_px: int = 160) -> Picture:
    """Tracks of a camera that swings: as if it stood still, and with its motion taken out."""
    scene = demo_scene()
    crop = scene.width_px - 2 * swing_px
    shift = np.round(swing_px * (1 + np.sin(np.arange(scene.fps * 16) / scene.fps * 2.2))).astype(int)
    with av.open(str(folder / "swing.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=scene.fps)
        stream.width, stream.height, stream.pix_fmt = crop, scene.height_px, "yuv420p"
        for picture, left in zip(frames(log.parent / "demo.mp4"), shift, strict=False):
            cut = np.ascontiguousarray(picture[:, left : left + crop])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(cut, format="bgr24")))
        container.mux(stream.encode(None))
    lines = []
    with mcaptrack.open(log) as opened:
        for frame, left in zip(opened.frames("detections"), shift, strict=False):
            for row in frame.rows:
                box = [row["x_px"] - left, row["y_px"], row["w_px"], row["h_px"]]
                if box[0] > 0 and box[0] + box[2] < crop:
                    lines.append([frame.index + 1, -1, *box, 1])
    with (folder / "det.txt").open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    parts = []
    for mode in ("off", "on"):
        path = folder / f"swing-{mode}.mcap"
        command("ingest", folder / "swing.mp4", "--detections", folder / "det.txt", "-o", path)
        command("motion", path)
        command("track", path, "--set", f"camera_motion={mode}")
        with mcaptrack.open(path) as opened:
            parts.append(still(opened, 12.0, "tracks"))
    return grid(parts)


def cameras(folder: Path) -> Picture:
    """The scene of three cameras on the pictures of two of them."""
    command("demo", "--scene", "three-cameras", "-o", folder / "plaza")
    with mcaptrack.open(folder / "plaza" / "demo.mcap") as opened:
        names = ("left", "right")
        return grid([still(opened, 14.0, f"/world/retracks/full/view/image/{name}/video") for name in names])


def robots(folder: Path) -> Picture:
    """Tracks of drawn 3D boxes, from above."""
    boxes = draw_traffic(3, seconds=8.0, density=0.4).boxes
    names = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "score")
    with (folder / "boxes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_ns", "class", *names])
        for at in range(len(boxes["t_ns"])):
            kind = CLASSES[int(boxes["class_id"][at])]
            writer.writerow([boxes["t_ns"][at], kind, *(boxes[name][at] for name in names)])
    command("ingest", folder / "boxes.csv", "--as", "detections", "--frame", "map", "-o", folder / "drive.mcap")
    command("run", folder / "drive.mcap")
    with mcaptrack.open(folder / "drive.mcap") as opened:
        return still(opened, 5.0, "retracks/full", WIDE)
