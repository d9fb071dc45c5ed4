"""Videos that compare tracks, and heat maps."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, notices
from mcaptrack.evaluation.occupancy import Occupancy
from mcaptrack.extensions.render import comparing, heat_map
from mcaptrack.extensions.render.legend import LabelPlaces
from mcaptrack.foxglove import ANNOTATIONS
from mcaptrack.foxglove.messages import message_class
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from tests.commands import call, printed
from tests.logs import write_with_views
from tests.worlds import ns


def clip(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def is_below_title(picture: np.ndarray, panel: np.ndarray) -> bool:
    """Whether the same picture stands somewhere below the title of a panel."""
    high, panel = len(picture), panel.astype(int)
    return min(abs(panel[top : top + high] - picture).mean() for top in range(4, 40)) < 4


def test_three_panels_show_the_views_of_their_channels(finished, tmp_path):
    done = mcaptrack.render(finished, tmp_path / "a.mp4", compare=True, width=480, end_s=0.5)
    names = ("tracks", "retracks/full", "truth")
    assert done.views == tuple(f"/camera/{name}/view/image" for name in names)
    frames = clip(tmp_path / "a.mp4")
    assert len(frames) == done.pictures
    for number, view in enumerate(done.views):
        mcaptrack.render(finished, tmp_path / "one.mp4", topic=view, width=160, end_s=0.5, force=True)
        (single, *_) = clip(tmp_path / "one.mp4")
        assert is_below_title(single[:, 2:158], frames[0][:, 160 * number + 2 : 160 * (number + 1) - 2])


def crossing_log(path: Path) -> Path:
    """Boxes in space and no pictures: two people meet on a line at 2 s."""
    names = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")
    frames = []
    for n in range(40):
        at = [(-2 + n / 10, 0.0), (2 - n / 10, 0.1)]
        place = dict(zip(names, np.array([(x, y, 0.9, 0.6, 0.6, 1.8, 0.0) for x, y in at]).T, strict=True))
        which = {"track_id": [1, 2], "class_id": np.ones(2, np.uint32), "source_id": [-1, -1]}
        frames.append(Frame(ns(n / 10), n, TRACKS.rows(**which, **place, observed=np.ones(2, bool))))
    with log.create(path):
        pass
    made = {
        f"/lidar/{name}": Made.of(TRACKS, frames, Provenance(how, {}, frame_id="map"))
        for name, how in (("tracks", "track"), ("retracks", "retrack"))
    }
    with log.read(path) as opened, notices.listening(lambda _: None):
        write_with_views(opened, "/lidar", made)
    return path


def test_logs_without_pictures_are_compared_from_above(tmp_path):
    path = crossing_log(tmp_path / "a.mcap")
    done = mcaptrack.render(path, compare=True, width=400, start_s=1, end_s=2)
    assert done.views == tuple(f"/lidar/{name}/view/scene" for name in ("tracks", "retracks"))
    assert done.video == tmp_path / "a.compared.mp4"
    frames = clip(done.video)
    assert len(frames) == done.pictures == 11
    single = mcaptrack.render(path, topic=done.views[1], width=200, start_s=1, end_s=2)
    assert is_below_title(clip(single.video)[0][:, 4:196], frames[0][:, 204:396])
    with log.read(path) as opened:
        assert [one.title for one in comparing.find_panels(opened, "/lidar", None)][1:] == ["re-tracked"]


def test_labels_from_above_never_overlap():
    """Eight people walk at random in a narrow place; labels are boxes of their text, measured here."""
    rng, places = np.random.default_rng(3), LabelPlaces()
    at = rng.uniform(0, 60, (8, 2)) + 200
    before: dict[str, float] = {}
    moved = 0
    for _ in range(60):
        at += rng.normal(0, 1.0, (8, 2))
        places.next_picture()
        drawn = message_class(ANNOTATIONS)()
        for number, (x, y) in enumerate(at.tolist(), 1):
            text = drawn.texts.add(text=f"{number} car", font_size=12.0)
            text.position.x, text.position.y = x, y
        found = places.spread(drawn)
        boxes = []
        for text, (_, y) in zip(found.texts, at.tolist(), strict=True):
            (wide, high), below = cv2.getTextSize(text.text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
            low = text.position.y
            boxes.append((text.position.x, low - high - below, text.position.x + wide, low))
            moved += low < y - 1
            before[text.text] = low - y
        for n, a in enumerate(boxes):
            hits = [b for b in boxes[:n] if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] - 0.1 and b[1] < a[3] - 0.1]
            assert not hits or abs(before[f"{n + 1} car"]) < 1e-9  # too far away: it stays where it is
    assert moved > 60


def test_heat_stands_where_people_stood_in_the_picture_and_nowhere_beyond_the_horizon():
    """A camera that looks along the ground: 10 x 10 s in one cell, seen at its place by the plane."""
    plane = GroundPlane((0.01, 0.0, -3.2, 0.0, 0.0, 6.0, 0.0, 0.005, -0.2), 640, 480)
    at = np.array([0.25, 7.75])
    heat = Occupancy(np.zeros((20, 20)), (-5.0, 0.0), 0.5, 0.0)
    column, row = ((at - (-5.0, 0.0)) // 0.5).astype(int)
    heat.person_s[row, column] = 100.0
    # Ground farther than 54.5 m, above y = 62, is near the horizon: a pixel is 20 times as large as at the lower edge.
    far = Occupancy(np.full((1200, 1200), 1.0), (-300.0, 60.0), 0.5, 0.0)
    assert (heat_map._over_picture(np.full((480, 640, 3), 80, np.uint8), far, plane) == 60).all()
    image = heat_map._over_picture(np.full((480, 640, 3), 80, np.uint8), heat, plane)
    bright = np.unravel_index(image.astype(int).sum(axis=2).argmax(), (480, 640))
    wanted = plane.metres_to_pixels(at[None])[0]
    assert abs(np.array(bright[::-1]) - wanted).max() < 8
    assert (image[:40] == 60).all()  # above the horizon, y = 40
    above = heat_map._from_above(heat, 320)
    y, x = np.unravel_index(above.astype(int).sum(axis=2)[:200].argmax(), (200, 320))
    scale = min(320 / 11.5, 240 / 11.5)
    assert abs(x - (160 + (at[0] - 0.0) * scale)) < 8
    assert abs(y - (120 - (at[1] - 5.0) * scale)) < 8


def test_a_heat_map_says_how_much_it_counts(finished, tmp_path):
    done = mcaptrack.render(finished, tmp_path / "a.png", heatmap=True)
    assert done.views == ("/camera/retracks/full",)
    with log.read(finished) as opened:
        frames = opened.frames("/camera/retracks/full", TRACKS)
        times: dict[int, list[int]] = {}
        for frame in frames:
            for row in frame.rows:
                times.setdefault(int(row["track_id"]), []).append(frame.t_ns)
        wanted = sum(t[-1] - t[0] for t in times.values()) / 1e9
        options = heat_map.RenderOptions()
        found = heat_map.draw_heat_map(opened, "/camera", (), "/camera/video", tmp_path / "b.jpg", options)
    assert found.person_s == pytest.approx(wanted, rel=0.02)
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == cv2.imread(str(tmp_path / "b.jpg")).shape[1] == 320
    printed("render", finished, "--heatmap", "--topic", "/camera/truth", "-o", tmp_path / "c.png", "--width", 200)
    assert cv2.imread(str(tmp_path / "c.png")).shape[1] == 200


def test_mistakes_are_said_in_a_line(finished, footage, tmp_path):
    printed("ingest", footage.video, "-o", tmp_path / "bare.mcap")
    bare = tmp_path / "bare.mcap"
    for words, said in {
        (bare, "--compare"): "has no view /camera/tracks/view/image to compare; `mcaptrack run",
        (bare, "--heatmap"): "has no tracks of /camera yet; `mcaptrack run",
        (finished, "--heatmap", "-o", "a.mp4"): "a heat map is a picture, .png or .jpg, not .mp4",
        (finished, "--heatmap", "--topic", "/camera/detections"): "/camera/detections holds mcaptrack.Detections, not",
        (finished, "--heatmap", "--start-s", "900"): "no rows of people in that time",
        (finished, "--heatmap", "--compare"): "--compare and --heatmap make different files",
        (finished, "--compare", "-o", "a.png"): "a video is rendered to .mp4 or .gif",
    }.items():
        out = ("-o", "out.png" if "--heatmap" in words else "out.mp4") if "-o" not in words else ()
        code, _, err = call("render", *words, *out, folder=tmp_path)
        assert (code, said in err) == (1, True), err
        assert err.count("\n") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["bare.mcap"]
    shutil.copyfile(finished, tmp_path / "walk.mcap")
    printed("render", tmp_path / "walk.mcap", "--heatmap")
    assert (tmp_path / "walk.heatmap.png").exists()
