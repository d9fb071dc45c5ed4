"""The main job with an installed mcaptrack, from encoded videos to a report; checks what comes out.

    PYTHON -I tools/main_job.py FOLDER [--only-extras]

PYTHON is an interpreter that has mcaptrack installed; ``-I`` keeps a checkout from being used in its place. What needs
an extra (sql, onnx, tune) is done where the extra is installed; ``--only-extras`` does nothing else, on the logs of a
run without it. Exits with a traceback where anything is wrong; clips, logs and results are left in FOLDER.
"""

from __future__ import annotations

import argparse
import base64
import json
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import av
import numpy as np

import mcaptrack
from mcaptrack.sources.demo import Pedestrian, SyntheticScene

ROOT = Path(__file__).resolve().parent.parent
FPS, SECONDS = 10, 12.0
PEOPLE = (
    Pedestrian(1, ((0.0, -6.0, 9.0), (SECONDS, 6.0, 11.0)), (30, 30, 30)),
    Pedestrian(2, ((0.0, 6.0, 14.0), (SECONDS, -6.0, 13.0)), (120, 40, 20)),
    Pedestrian(3, ((0.0, 5.0, 18.0), (SECONDS, -4.0, 17.5)), (20, 60, 20)),
)
#: What cameras and programs write: file, encoder, pixels, options. The first is what everything is run on.
CLIPS = (
    ("walk.mp4", "libx264", "yuv420p", {"bf": "2", "g": "30"}),
    ("passed on.mkv", "libx264", "yuv420p", {"bf": "0", "g": "10", "tune": "zerolatency"}),
    ("h265.mp4", "libx265", "yuv420p", {"x265-params": "log-level=error"}),
    ("vp9.webm", "libvpx-vp9", "yuv420p", {"g": "10", "lag-in-frames": "0", "deadline": "realtime"}),
    ("mpeg4.avi", "mpeg4", "yuv420p", {"q": "3"}),
    ("mjpeg.mov", "mjpeg", "yuvj420p", {}),
)
BIN = Path(sys.executable).parent


def mcaptrack_command(*words: object) -> str:
    """Run the installed command; what it prints."""
    done = subprocess.run([BIN / "mcaptrack", *map(str, words)], check=False, capture_output=True, text=True)
    line = "mcaptrack " + " ".join(map(str, words))
    assert done.returncode == 0, f"{line}: exit {done.returncode}\n{done.stdout}{done.stderr}"
    assert "Traceback" not in done.stderr, f"{line}\n{done.stderr}"
    return done.stdout


def data(*words: object) -> Any:
    return json.loads(mcaptrack_command(*words, "--json"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only-extras", action="store_true")
    options = parser.parse_args()
    folder: Path = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    assert Path(mcaptrack.__file__).is_relative_to(sys.prefix), f"this is not installed: {mcaptrack.__file__}"
    assert mcaptrack_command("--version").split() == ["mcaptrack", version("mcaptrack")]
    print(
        ", ".join(
            f"{name} {version(name)}"
            for name in ("av", "numpy", "opencv-python-headless", "pyarrow", "protobuf", "typer")
        )
    )
    log = folder / "walk.mcap"
    if not options.only_extras:
        everything(folder, log)
    extras(log)
    print("the main job is done")


def everything(folder: Path, log: Path) -> None:
    """What needs no extra."""
    images = footage(folder)
    for name, *_ in CLIPS:
        ingested(folder / name, images)
    mcaptrack_command("run", log)
    scored(log)
    tables(log)
    shown(log, len(images))


def footage(folder: Path) -> list[np.ndarray]:
    """Draw people who walk, and encode it in every way; the pictures, BGR (height, width, 3)."""
    scene = SyntheticScene(PEOPLE, SECONDS, fps=FPS, width_px=320, height_px=180, noise=1.5)
    shots = list(scene.shots())
    lines = [
        ",".join(map(str, [number, who, *np.round(box, 2).tolist(), 1, 1, 1]))
        for number, shot in enumerate(shots, start=1)
        for who, box in zip(shot.ids, shot.boxes, strict=True)
    ]
    (folder / "truth.txt").write_text("\n".join(lines) + "\n")
    rows = np.array(scene.ground_plane().homography).reshape(3, 3)
    (folder / "plane.txt").write_text("\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    for name, codec, pixels, options in CLIPS:
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=FPS, options=options)
            stream.height, stream.width = shots[0].image.shape[:2]
            stream.pix_fmt = pixels
            for shot in shots:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(shot.image, format="bgr24")))
            container.mux(stream.encode(None))
    return [shot.image for shot in shots]


def ingested(clip: Path, images: list[np.ndarray]) -> None:
    """A video becomes a log with all its pictures, as they were, at their times."""
    log = clip.with_suffix(".mcap")
    beside = ("--ground-plane", clip.parent / "plane.txt", "--truth", clip.parent / "truth.txt")
    mcaptrack_command("ingest", clip, *beside, "-o", log, "--force")
    mcaptrack_command("check", log)
    with mcaptrack.open(log) as opened:
        pictures = list(opened.frames("video"))
    assert [picture.t_ns for picture in pictures] == [k * 10**9 // FPS for k in range(len(images))], clip
    off = max(float(np.abs(p.rows.astype(float) - image).mean()) for p, image in zip(pictures, images, strict=True))
    assert off < 12, f"{clip}: pictures are off by {off}"
    print(f"{clip.name}: {len(pictures)} pictures, off by {off:.1f} of 255 at most")


def scored(log: Path) -> None:
    """People were found, and found again."""
    results = data("evaluate", log)["results"]
    best = {
        topic: max(r["IDF1"] for r in results if r["tracks"] == topic)
        for topic in {r["tracks"] for r in results}
        if topic
    }
    print("IDF1:", {topic: round(value, 3) for topic, value in sorted(best.items())})
    assert {"/camera/tracks", "/camera/retracks"} <= set(best), best
    assert best["/camera/tracks"] > 0.6, best
    assert best["/camera/retracks"] > 0.75, best
    assert all(result["GT"] == len(PEOPLE) for result in results if "GT" in result)


def tables(log: Path) -> None:
    """Tables are files that others read, with as many rows as are said."""
    import pyarrow.parquet as pq

    folder = log.with_suffix(".exported")
    (said,) = data("export", log, "-o", folder)["results"]
    assert {"detections", "tracks", "predictions", "events", "metrics"} <= set(said["rows"])
    for name, count in said["rows"].items():
        files = list((folder / name).glob("*/*.parquet"))
        assert sum(pq.read_metadata(file).num_rows for file in files) == count, name
        if count and find_spec("duckdb"):
            import duckdb

            assert duckdb.sql(f"select count(*) from '{folder}/{name}/*/*.parquet'").fetchall() == [(count,)], name
    with mcaptrack.open(log) as opened:
        assert opened.table("tracks").num_rows == said["rows"]["tracks"]
    print("tables:", said["rows"])


def shown(log: Path, pictures: int) -> None:
    """What people look at: a report, videos, the documentation."""
    page = log.with_suffix(".html")
    mcaptrack_command("report", log, "-o", page, "--force")
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert data("report", log)
    for name in ("walk.drawn.mp4", "walk.drawn.gif"):
        mcaptrack_command("render", log, "-o", log.with_name(name), "--width", 160, "--force")
        with av.open(str(log.with_name(name))) as container:
            assert sum(1 for _ in container.decode(video=0)) == pictures, name
    names = [page["name"] for page in data("docs")["pages"]]
    assert all(mcaptrack_command("docs", name).startswith("# ") for name in names), names
    topics = [channel["topic"] for channel in data("info", log)["results"][0]["channels"]]
    print(f"{len(topics)} channels, {len(names)} pages; report {page.stat().st_size} bytes")


def extras(log: Path) -> None:
    """SQL, networks in ONNX and the search for settings, where what they need is installed."""
    done = []
    if find_spec("duckdb"):
        (row,) = data(
            "query", log, "select count(distinct track_id) as n from tracks where topic = '/camera/retracks'"
        )["results"]
        assert 1 <= row["n"] <= 2 * len(PEOPLE), row
        done.append(f"sql (DuckDB {version('duckdb')})")
    if find_spec("onnxruntime"):
        network = log.with_name("line.onnx")
        network.write_bytes(
            base64.b64decode(
                json.loads((ROOT / "tests" / "extensions" / "networks" / "networks.json").read_text())["line"]
            )
        )
        mcaptrack_command("predict", log, "--predictor", f"onnx:{network}", "-o", log.with_name("onnx.mcap"), "--force")
        with mcaptrack.open(log.with_name("onnx.mcap")) as opened:
            assert opened.table("predictions").num_rows > 0
        done.append(f"onnx (ONNX Runtime {version('onnxruntime')})")
    if find_spec("optuna"):
        settings = log.with_name("best.toml")
        (found,) = data("tune", log, "--trials", 3, "-o", settings)["results"]
        assert settings.exists() == (found["best"] > 0), found  # the defaults may be the best
        assert not settings.exists() or "[track]" in settings.read_text()
        done.append(f"tune (Optuna {version('optuna')})")
    print("extras:", ", ".join(done) or "none is installed")


if __name__ == "__main__":
    main()
