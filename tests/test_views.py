"""Drawings on pictures: one annotation message for each picture, with its time."""

from __future__ import annotations

import resource
import shutil
import tempfile
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st
from mcap_protobuf.schema import build_file_descriptor_set

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import Drawing, label_places
from mcaptrack.foxglove.views.image import clipped
from mcaptrack.foxglove.views.people import ellipse_points, ellipses
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath, poses_of
from mcaptrack.geometry.plane import GroundPlane, moved_planes
from mcaptrack.pipeline import with_views
from mcaptrack.pipeline.staleness import is_finished
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import VIEW, Provenance
from tests.bounded import limited
from tests.logs import our_messages
from tests.worlds import FORECAST, PICTURES, PLANE, boxed, boxes_at, ns, tracks_at

LOOP, LIST = 2, 4
#: The squared size, in standard deviations, of an ellipse that holds half of a normal distribution.
HALF = 2 * np.log(2)
#: Coordinates are written to a quarter of a pixel.
PX = 0.126


def view(topic, schema, frames, picture_ns, planes, stamp_ns=None, is_retracked=False, path=None):
    drawing = Drawing(topic, schema, frames, planes, is_retracked, path=path)
    return drawing.on_pictures(picture_ns, picture_ns if stamp_ns is None else stamp_ns)


def messages(topic, schema, frames, planes=PLANE, **options) -> list[ImageAnnotations]:
    out = []
    found = view(topic, schema, frames, PICTURES, planes, **options)
    for (t_ns, index, payload), wanted in zip(found, PICTURES, strict=True):
        message = ImageAnnotations.FromString(payload)
        assert t_ns == wanted
        assert PICTURES[index] == wanted
        for part in (message, *message.points, *message.texts):
            assert part.timestamp.ToNanoseconds() == wanted
        assert message.points, "a viewer that waits for annotations would show no picture"
        out.append(message)
    return out


def drawn(message) -> list:
    return [line for line in message.points if line.outline_color.a > 0]


def xy(line) -> list[tuple[float, float]]:
    return [(p.x, p.y) for p in line.points]


CHANNELS = {
    "detections": ("/c/detections", DETECTIONS, [Frame(int(PICTURES[4]), 4, boxes_at([(50, 60)]))]),
    "tracks": ("/c/tracks", TRACKS, [Frame(int(PICTURES[n]), n, boxed({2: (n, 5)})) for n in range(3, 6)]),
    "retracks": ("/c/retracks", TRACKS, [Frame(ns(0.4 * n), n, boxed({2: (40 * n, 5)})) for n in range(1, 4)]),
    "truth": ("/c/truth", TRACKS, [Frame(int(PICTURES[4]), 4, boxed({2: (1, 5)}))]),
    "predictions": ("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, FORECAST)]),
    "nothing": ("/c/tracks", TRACKS, []),
    "no detections": ("/c/detections", DETECTIONS, []),
    "no predictions": ("/c/predictions", PREDICTIONS, []),
}


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_every_picture_has_a_message_with_its_time_and_never_an_empty_one(channel):
    found = messages(*channel)
    assert len(found) == len(PICTURES)
    empty = [message for message in found if not drawn(message)]
    assert empty
    assert all(line.type == 1 and len(line.points) == 1 for message in empty for line in message.points)


def test_repaired_tracks_have_one_style_under_any_topic():
    _, schema, frames = CHANNELS["retracks"]

    def thickness(topic: str, **options) -> set[float]:
        return {line.thickness for message in messages(topic, schema, frames, **options) for line in drawn(message)}

    assert thickness("/c/other", is_retracked=True) == thickness("/c/retracks") != thickness("/c/other")
    assert thickness("/c/other") == thickness("/c/tracks")


def test_boxes_stand_where_the_rows_say():
    (box,) = drawn(messages(*CHANNELS["detections"])[4])
    assert box.type == LOOP
    assert xy(box) == [(40, 40), (60, 40), (60, 80), (40, 80)]


def test_tracks_move_with_the_pictures_between_the_ticks_of_their_clock():
    found = messages(*CHANNELS["retracks"])
    lefts = {n: drawn(message)[0].points[0].x for n, message in enumerate(found) if drawn(message)}
    for number, left in lefts.items():
        assert left == pytest.approx(100 * number / 7, abs=PX)  # 40 px a tick of 0.4 s
    assert sorted(lefts) == list(range(3, 9))


def test_a_trail_leads_to_the_box_and_fades_into_the_past():
    message = messages(*CHANNELS["retracks"])[8]
    box, trail = drawn(message)
    assert trail.type == LIST
    ends = xy(trail)
    assert ends[-1] == pytest.approx((box.points[0].x + 5, 25), abs=2 * PX)
    assert ends[1:-1:2] == ends[2::2]  # one line begins where the last ended
    assert [x for x, _ in ends] == sorted(x for x, _ in ends)
    opacity = [colour.a for colour in trail.outline_colors]
    assert len(opacity) == len(ends) / 2
    assert opacity == sorted(opacity)
    assert opacity[0] < opacity[-1]
    assert message.texts[0].text == "2"


def test_trails_stay_where_they_are_while_people_go_on_and_end_after_two_seconds():
    frames = [Frame(int(PICTURES[n]), n, boxed({2: (10 * n, 5), 30: (5, 10 * n)})) for n in range(20)]
    found = messages("/c/retracks/full", TRACKS, frames)
    for earlier, later in pairwise(found[15:]):
        before, after = (set(xy(drawn(message)[-1])) for message in (earlier, later))
        assert len(before & after) >= len(before) - 4  # of each person the tip, and now and then the end
    for number, message in enumerate(found):
        oldest = min(x for x, y in xy(drawn(message)[-1]) if y == 25) if number else None
        assert oldest is None or 10 * (number - 14) <= oldest - 5 <= 10 * number


@pytest.mark.parametrize("name", ["retracks", "predictions"])
def test_drawings_follow_a_camera_that_sways(name):
    """A law: what is drawn before a camera that moves is what is drawn before a still one, moved picture by picture."""
    topic, schema, frames = CHANNELS[name]
    if schema is PREDICTIONS:  # in the middle, where nothing is cut off at the border
        frames = [frame._replace(rows=frame.rows.copy()) for frame in frames]
        for frame in frames:
            frame.rows["x_m"] += 30
            frame.rows["y_m"] += 20
    shift = [round(30 * float(np.sin(2 * n))) if n else 0 for n in range(len(PICTURES))]
    motions = np.array([[[1.0, 0, now - then], [0, 1, 0]] for then, now in pairwise([0, *shift])])
    path = CameraPath(PICTURES, poses_of(motions, 640, 480))
    seen = frames
    if schema is TRACKS:
        seen = [frame._replace(rows=frame.rows.copy()) for frame in frames]
        for frame in seen:
            boxes = path.to_pictures(columns_to_boxes(frame.rows), np.full(len(frame.rows), frame.t_ns))
            frame.rows["x_px"] = boxes[:, 0]
    still, moved = messages(topic, schema, frames), messages(topic, schema, seen, moved_planes(PLANE, path), path=path)
    count = 0
    for by, first, second in zip(shift, still, moved, strict=True):
        assert len(drawn(first)) == len(drawn(second))
        for one, other in zip(drawn(first), drawn(second), strict=True):
            wanted = np.array(xy(one)) + [by, 0]
            assert np.array(xy(other)) == pytest.approx(wanted, abs=2 * PX)
            count += 1
    assert count > 5


def test_interpolated_positions_are_fainter():
    for name in ("tracks", "retracks/full"):
        rows = [Frame(int(PICTURES[n]), n, boxed({2: (n, 5)}, observed=n != 4)) for n in range(6)]
        alpha = []
        for message in messages(f"/c/{name}", TRACKS, rows)[3:6]:
            part = drawn(message)[0]
            alpha.append(part.outline_color.a)
        assert alpha[0] == alpha[2] == 1
        assert 0.1 < alpha[1] < 0.6


def test_a_place_without_a_box_is_marked_with_its_number():
    message = messages("/c/retracks", TRACKS, [Frame(int(PICTURES[3]), 3, tracks_at({7: (2.0, 3.0)}))])[3]
    (mark,) = drawn(message)
    assert np.mean(xy(mark), axis=0).tolist() == [20, 30]
    assert [text.text for text in message.texts] == ["7"]


def test_numbers_of_any_length_are_written():
    people = {-4: (0, 0), 7: (10, 0), 12345: (20, 0), 2**40: (30, 0)}
    message = messages("/c/tracks", TRACKS, [Frame(int(PICTURES[3]), 3, boxed(people))])[3]
    assert sorted(text.text for text in message.texts) == sorted(map(str, people))


def test_wide_pictures_get_thick_lines_and_large_text():
    wide = [(0, GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 3840, 2160))]
    small, large = (messages(*CHANNELS["retracks"], planes)[5] for planes in (PLANE, wide))
    assert drawn(large)[0].thickness > 3 * drawn(small)[0].thickness
    assert large.texts[0].font_size > 3 * small.texts[0].font_size


def test_forecasts_come_back_to_pixels_and_fade_into_the_future():
    found = messages(*CHANNELS["predictions"])
    ellipse, line = drawn(found[3])
    assert (line.type, xy(line)) == (LIST, [(10, 30), (20, 40)])
    assert ellipse.type == LOOP
    assert not drawn(found[2])  # not made yet
    assert not drawn(found[12])  # a second old
    far = PREDICTIONS.rows(
        track_id=np.repeat([3, 4], 6),
        step=np.tile(np.arange(1, 7), 2),
        ahead_s=np.tile(np.arange(1, 7) * 0.4, 2),
        x_m=np.arange(12.0),
        y_m=np.ones(12),
    )
    (both,) = drawn(messages("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, far)])[3])  # no covariance, no ellipse
    opacity = [colour.a for colour in both.outline_colors]
    assert opacity[:3] == opacity[3:] == sorted(opacity[:3], reverse=True)
    assert xy(both)[0] == (0, 10)
    assert xy(both)[5] == (50, 10)


def test_an_ellipse_of_a_plane_in_perspective_is_mapped_point_by_point():
    matrix = np.array([[0.05, 0.004, -12], [0.002, -0.08, 31], [0.0001, -0.0021, 1.0]])
    planes = [(0, GroundPlane(tuple(matrix.ravel()), 640, 400))]
    spread = np.array([[0.5, 0.2], [0.2, 0.3]])
    centre = matrix @ [320, 300, 1]
    centre = centre[:2] / centre[2]
    rows = FORECAST.copy()
    rows["x_m"], rows["y_m"] = centre
    rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"] = 0.5, 0.2, 0.3
    ellipse = drawn(messages("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, rows)], planes)[3])[0]
    back = np.append(xy(ellipse), np.ones((len(ellipse.points), 1)), axis=1) @ matrix.T
    away = back[:, :2] / back[:, 2:] - centre
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", away, np.linalg.inv(spread), away), HALF, rtol=0.08)


@given(
    st.floats(0.01, 20), st.floats(0.01, 20), st.floats(-np.pi, np.pi), st.floats(-50, 50), st.floats(-50, 50)
)  # fmt: skip
def test_points_of_an_ellipse_lie_as_far_out_as_its_matrix_says(long, short, turn, x, y):
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    spread = rotation @ np.diag([long, short]) @ rotation.T
    half, found = ellipses(spread[None])
    assert half[0, 0] >= half[0, 1]
    points = ellipse_points(np.array([[x, y]]), half, found, 9)[0] - [x, y]
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points, np.linalg.inv(spread), points), 1.0, rtol=1e-6)


@given(
    st.lists(st.tuples(*[st.floats(-150, 250)] * 2, *[st.floats(1, 200)] * 2, st.floats(0, 3)), min_size=1, max_size=5)
)
def test_ellipses_end_at_the_border_of_the_picture_or_are_left_out(shapes):
    """A law, by OpenCV's intersection of convex polygons: what is drawn is the part in the picture, if that is at least
    half of it.
    """
    at, half, turn = (
        np.array([s[:2] for s in shapes]),
        np.array([s[2:4] for s in shapes]),
        np.array([s[4] for s in shapes]),
    )
    rings = ellipse_points(at, half, turn, 10)
    picture = np.array([[0, 0], [100, 0], [100, 80], [0, 80]], np.float32)
    found = {
        int(one): ring
        for of, points in clipped(rings, np.array([100.0, 80.0]))
        for one, ring in zip(of, points, strict=True)
    }
    for number, ring in enumerate(rings.astype(np.float32)):
        whole, inside = cv2.contourArea(ring), cv2.intersectConvexConvex(ring, picture)[0]
        if number in found:
            assert cv2.contourArea(found[number].astype(np.float32)) == pytest.approx(inside, rel=1e-3, abs=0.5)
            assert (found[number] >= -1e-9).all()
            assert (found[number] <= [100 + 1e-9, 80 + 1e-9]).all()
        assert (number in found) == (2 * inside >= whole) or inside == pytest.approx(whole / 2, rel=1e-3, abs=0.5)


def test_an_invalid_covariance_has_no_ellipse():
    spread = np.array([[[np.nan, 0], [0, 1]], [[1, 5], [5, 1]], [[0, 0], [0, 0]]], float)
    half, turn = ellipses(spread)
    assert np.isnan(half[:2]).all()
    assert np.isnan(turn[:2]).all()
    assert half[2].tolist() == [0, 0]  # no uncertainty


def test_without_a_plane_there_are_no_forecasts_to_draw():
    assert not any(drawn(message) for message in messages(*CHANNELS["predictions"], planes=()))


def test_stamps_are_those_of_the_pictures_where_they_differ_from_the_log():
    stamps = PICTURES + 1_600_000_000_123_456_789
    found = list(view(*CHANNELS["retracks"], PICTURES, PLANE, stamps))
    assert [t_ns for t_ns, _, _ in found] == PICTURES.tolist()
    for (_, _, payload), stamp in zip(found, stamps.tolist(), strict=True):
        message = ImageAnnotations.FromString(payload)
        assert {part.timestamp.ToNanoseconds() for part in (message, *message.points, *message.texts)} == {stamp}


def test_drawings_are_independent_of_batches():
    pictures = np.arange(600) * ns(0.1)
    frames = [Frame(int(t), n, boxed({2: (n, 5), 5: (5, n)})) for n, t in enumerate(pictures)]
    whole = list(view("/c/tracks", TRACKS, frames, pictures, PLANE))
    part = list(view("/c/tracks", TRACKS, frames[200:330], pictures[200:330], PLANE))
    assert [payload for _, _, payload in whole[230:330]] == [payload for _, _, payload in part[30:]]
    assert [index for _, index, _ in whole] == list(range(600))


def test_one_identity_has_one_colour_and_neighbours_differ():
    assert foxglove.colour(5) == foxglove.colour(5)
    many = [foxglove.colour(identity) for identity in range(21)]
    assert len(set(many)) == 21
    assert all(0 <= part <= 1 for rgba in many for part in rgba)
    first = [foxglove.colour(n)[:3] for n in range(7)]
    assert min(sum(abs(a - b) for a, b in zip(x, y, strict=True)) for x in first for y in first if x != y) > 0.25
    numbers = np.array([-1, 0, 5, 20, 21, 2**40])
    assert foxglove.colours(numbers).tolist() == [list(foxglove.colour(int(n))[:3]) for n in numbers]


@pytest.mark.parametrize("name", ["ImageAnnotations", "CompressedVideo", "CompressedImage", "SceneUpdate"])
def test_schema_records_are_those_of_the_stock_library(name):
    schema_name, encoding, data = foxglove.schema_record(f"foxglove.{name}")
    wanted = build_file_descriptor_set(foxglove.message_class(f"foxglove.{name}"))
    assert (schema_name, encoding) == (f"foxglove.{name}", "protobuf")
    assert {f.name: f for f in FileDescriptorSet.FromString(data).file} == {f.name: f for f in wanted.file}


def test_forecasts_stay_in_the_world_while_planes_of_pictures_move():
    """A camera that moves 1 m a picture: the point on the ground goes 10 px to the left."""
    planes = [(int(t), GroundPlane((0.1, 0, n, 0, 0.1, 0, 0, 0, 1), 640, 480)) for n, t in enumerate(PICTURES)]
    found = messages(*CHANNELS["predictions"], planes=planes)
    for number in range(3, 6):
        (line,) = (one for one in drawn(found[number]) if one.type == LIST)
        assert xy(line) == [pytest.approx((10 * (x - number), y), abs=PX) for x, y in ((1, 30), (2, 40))]


# Views that a log lacks are drawn for those who look at it, in a temporary file, and the log stays as it is


@pytest.fixture(scope="module")
def without_views(template, tmp_path_factory) -> Path:
    """A log as stages that run alone leave it: nothing is drawn, and no events are found."""
    path = tmp_path_factory.mktemp("stages") / "walk.mcap"
    with log.read(template) as opened:
        hows = {topic: Provenance.from_metadata(channel.metadata) for topic, channel in opened.channels.items()}
    finished = [topic for topic, how in hows.items() if how and (how.transform == VIEW or is_finished(topic, how))]
    assert finished
    mcaptrack.drop(template, finished, output=path)
    return path


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_views_are_those_that_run_writes(without_views, temporary, tmp_path):
    mcaptrack.run(without_views, output=tmp_path / "run.mcap", events=False, tables=False)
    kept = our_messages(tmp_path / "run.mcap")
    with log.read(without_views) as opened, with_views(opened) as (shown, layouts):
        drawn = {topic: [(m.t_ns, m.sequence, m.payload) for m in shown.messages(topic)] for topic in shown.channels}
        assert layouts
    assert drawn == kept
    assert list(temporary.iterdir()) == []


def test_logs_of_the_longest_names_are_shown_where_their_tracks_are(without_views, temporary, tmp_path):
    path = tmp_path / ("a" * 250 + ".mcap")
    content = Path(shutil.copyfile(without_views, path)).read_bytes()
    with log.read(path) as opened:
        most = max(len(frame.rows) for frame in opened.frames("/camera/retracks", TRACKS))
    with mcaptrack.view(path) as server:
        assert any(f"of at most {most} tracks" in note for note in server.notes)
        assert len(server.logs) == 2
        assert len(list(temporary.iterdir())) == 1
    assert path.read_bytes() == content
    assert list(temporary.iterdir()) == []


def test_pictures_that_come_later_are_drawn_on_once(template, tmp_path):
    """Of a log without image views, as one has that was run before it had pictures, run makes what it makes of others."""
    path = tmp_path / "a.mcap"
    images = [topic for topic in our_messages(template) if topic.endswith("/view/image")]
    mcaptrack.drop(template, images, output=path)
    assert len(images) > 2
    mcaptrack.run(path, tables=False)
    assert our_messages(path) == our_messages(template)
    content = path.read_bytes()
    assert mcaptrack.run(path, tables=False).is_up_to_date
    assert path.read_bytes() == content


def test_no_file_is_served_for_a_view_that_others_recorded(template, temporary, tmp_path):
    path, topic = tmp_path / "a.mcap", "/camera/detections/view/image"
    mcaptrack.drop(template, [topic], output=path)
    with log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel(topic, ("of.Others", "jsonschema", b'{"type": "object"}'), "json", {})
        writer.add_message(number, opened.start_ns, 0, b"{}")
    with mcaptrack.view(path) as server:
        assert len(server.logs) == 1
        assert [str(warning) for warning in server.warnings] == [
            f"no view at {topic}, which was recorded by others (of.Others)"
        ]


@pytest.mark.parametrize("lacks", ["a folder", "room"])
def test_no_room_for_temporary_files_is_said_in_one_line(without_views, temporary, lacks):
    if lacks == "a folder":
        temporary.rmdir()
    with (
        limited(resource.RLIMIT_FSIZE, 1000) if lacks == "room" else nullcontext(),
        pytest.raises(McaptrackError, match=r"walk\.mcap lacks can't be drawn .* TMPDIR names another") as refused,
    ):
        mcaptrack.view(without_views)
    assert "\n" not in str(refused.value)
    assert not temporary.exists() or list(temporary.iterdir()) == []


# Labels of people who are close to each other can all be read, and don't jump to and fro.


FULL = "/camera/retracks/full"


def drawn_paths(topic: str, paths: dict[int, np.ndarray], fps: float = 10.0) -> list[dict[str, tuple[float, float]]]:
    """The places of labels in each picture; ``paths`` are boxes (T, 4) by id, NaN where nobody is."""
    count = len(next(iter(paths.values())))
    at = np.array([ns(n / fps) for n in range(count)], np.int64)
    frames = []
    for n in range(count):
        there = {one: path[n] for one, path in sorted(paths.items()) if np.isfinite(path[n]).all()}
        place = dict(
            zip(("x_px", "y_px", "w_px", "h_px"), np.array(list(there.values())).reshape(-1, 4).T, strict=True)
        )
        some = {"observed": np.ones(len(there), bool), "source_id": [-1] * len(there)}
        frames.append(Frame(int(at[n]), n, TRACKS.rows(track_id=list(there), **place, **some)))
    found = [
        ImageAnnotations.FromString(one) for _, _, one in views.Drawing(topic, TRACKS, frames, ()).on_pictures(at, at)
    ]
    return [{text.text: (text.position.x, text.position.y) for text in one.texts} for one in found]


def standing(x: float, y: float, count: int = 1) -> np.ndarray:
    return np.tile([x, y, 30.0, 80.0], (count, 1))


@pytest.mark.parametrize(("topic", "sign"), [(FULL, -1), ("/camera/tracks", 1), ("/camera/truth", 1)])
def test_the_label_of_the_higher_id_moves_by_a_line_and_the_lower_one_stays(topic, sign):
    alone = [drawn_paths(topic, {one: standing(*at)})[0][str(one)] for one, at in ((3, (100, 100)), (8, (104, 104)))]
    both = drawn_paths(topic, {3: standing(100, 100), 8: standing(104, 104)})[0]
    assert both["3"] == alone[0]
    assert both["8"][0] == alone[1][0]
    assert sign * (both["8"][1] - both["3"][1]) == pytest.approx(1.5 * 12, abs=0.25)
    apart = drawn_paths(topic, {3: standing(100, 100), 8: standing(160, 104)})[0]
    assert apart["8"] == drawn_paths(topic, {8: standing(160, 104)})[0]["8"]


def test_labels_at_one_place_stand_in_the_order_of_their_ids():
    found = drawn_paths(FULL, {one: standing(100, 200) for one in (2, 4, 6)})[0]
    assert [found[name][1] for name in ("2", "4", "6")] == [200.0, 182.0, 164.0]


def test_labels_of_a_crowd_do_not_overlap_but_where_they_would_be_far_from_their_boxes():
    rng = np.random.default_rng(5)
    paths = {n + 1: standing(*rng.uniform((100, 100), (500, 260)), 1) for n in range(30)}
    found = drawn_paths(FULL, paths)[0]

    def overlaps(places):
        boxes = [(x, y - 12, x + 8 * len(name), y) for name, (x, y) in places.items()]
        pairs = [(a, b) for n, a in enumerate(boxes) for b in boxes[:n]]
        return sum(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for a, b in pairs)

    assert overlaps({str(one): (path[0, 0], path[0, 1]) for one, path in paths.items()}) >= 4
    assert overlaps(found) == 0
    same = drawn_paths(FULL, {n + 1: standing(100, 100) for n in range(12)})[0]
    assert all(abs(y - 100) <= 4 * 1.5 * 12 for _, y in same.values())


def test_a_label_that_moved_away_stays_there_while_boxes_tremble_and_comes_back():
    """Two labels meet in every third picture only; half a second after they last did, in picture 18, the higher one
    begins to come back, and a second after it is in its place.
    """
    count = 40
    one, other = standing(100, 100, count), standing(100, 100, count)
    other[:, 0] = np.where((np.arange(count) % 3 == 0) & (np.arange(count) < 20), 105, 112)
    high = [places["12"][1] for places in drawn_paths(FULL, {5: one, 12: other})]
    assert set(high[:24]) == {82.0}
    assert set(high[28:]) == {100.0}
    assert 3 < np.diff(high[23:29]).min() < np.diff(high[23:29]).max() < 4


def test_places_depend_on_the_past_alone_and_not_on_what_is_drawn_at_once(monkeypatch):
    rng = np.random.default_rng(2)
    paths = {n + 1: standing(0, 0, 60) + np.cumsum(rng.normal(0, 6, (60, 4)) * [1, 1, 0, 0], axis=0) for n in range(8)}
    for path in paths.values():
        path[:, :2] += 100
        path[rng.random(60) < 0.2] = np.nan
    whole = drawn_paths(FULL, paths)
    assert drawn_paths(FULL, {one: path[:35] for one, path in paths.items()}) == whole[:35]
    monkeypatch.setattr("mcaptrack.foxglove.views.image.BATCH", 16)
    monkeypatch.setattr("mcaptrack.foxglove.views.people._PART_ROWS", 64)
    assert drawn_paths(FULL, paths) == whole
    moved = sum(abs(y - paths[int(name)][n, 1]) > 5 for n, one in enumerate(whole) for name, (_, y) in one.items())
    assert moved > 10


def test_the_extent_of_labels_follows_from_their_characters():
    found = label_places.extents(np.array([7, 12345]), 12.0)
    assert found.tolist() == [[9.0, 18.0], [45.0, 18.0]]
