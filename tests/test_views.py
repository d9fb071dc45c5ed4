"""What a person sees: one annotation message for every picture, at its very time."""

from __future__ import annotations

import json

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap_protobuf.schema import build_file_descriptor_set

from mcaptrack import foxglove
from mcaptrack.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame
from mcaptrack.views import view
from tests.worlds import boxes_at, ns

PLANE = [(0, GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 640, 480))]
PICTURES = np.array([ns(n / 7) for n in range(20)])


def track_rows(people):
    """{id: (left, top)} with boxes of 10 x 20."""
    xy = np.array(list(people.values()), float).reshape(-1, 2)
    return TRACKS.rows(
        track_id=np.array(list(people), np.int64),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        w_px=np.full(len(xy), 10.0),
        h_px=np.full(len(xy), 20.0),
        observed=np.ones(len(xy), bool),
        source_id=np.full(len(xy), -1),
    )


def messages(topic, schema, frames, planes=PLANE) -> list[ImageAnnotations]:
    out = []
    for (t_ns, index, payload), wanted in zip(view(topic, schema, frames, PICTURES, planes), PICTURES, strict=True):
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


FORECAST = PREDICTIONS.rows(
    track_id=[3, 3],
    step=[1, 2],
    ahead_s=[0.4, 0.8],
    x_m=[1.0, 2.0],
    y_m=[3.0, 4.0],
    cov_xx_m2=[1.0, 1],
    cov_xy_m2=[0.0, 0],
    cov_yy_m2=[1.0, 1],
)
CHANNELS = {
    "detections": ("/c/detections", DETECTIONS, [Frame(int(PICTURES[4]), 4, boxes_at([(50, 60)]))]),
    "tracks": ("/c/tracks", TRACKS, [Frame(int(PICTURES[n]), n, track_rows({2: (n, 5)})) for n in range(3, 6)]),
    "retracks": ("/c/retracks", TRACKS, [Frame(ns(0.4 * n), n, track_rows({2: (40 * n, 5)})) for n in range(1, 4)]),
    "truth": ("/c/truth", TRACKS, [Frame(int(PICTURES[4]), 4, track_rows({2: (1, 5)}))]),
    "predictions": ("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, FORECAST)]),
    "nothing": ("/c/tracks", TRACKS, []),
}


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_every_picture_has_a_message_with_its_time_and_never_an_empty_one(channel):
    found = messages(*channel)
    assert len(found) == len(PICTURES)
    empty = [message for message in found if not drawn(message)]
    assert empty
    assert all(line.type == 1 and len(line.points) == 1 for message in empty for line in message.points)


def test_boxes_stand_where_the_rows_say():
    (box,) = drawn(messages(*CHANNELS["detections"])[4])
    assert box.type == 2  # a closed line
    assert [(p.x, p.y) for p in box.points] == [(40, 40), (60, 40), (60, 80), (40, 80)]


def test_tracks_move_with_the_pictures_between_the_ticks_of_their_clock():
    found = messages(*CHANNELS["retracks"])
    lefts = {n: drawn(message)[0].points[0].x for n, message in enumerate(found) if drawn(message)}
    for number, left in lefts.items():
        assert left == pytest.approx(100 * number / 7, abs=0.01)  # 40 px a tick of 0.4 s
    assert sorted(lefts) == list(range(3, 9))


def test_a_trail_leads_to_the_box_and_fades_into_the_past():
    message = messages(*CHANNELS["retracks"])[8]
    box, trail = drawn(message)
    assert trail.type == 3
    assert (trail.points[-1].x, trail.points[-1].y) == pytest.approx((box.points[0].x + 5, 25), abs=0.01)
    opacity = [colour.a for colour in trail.outline_colors]
    assert opacity == sorted(opacity)
    assert message.texts[0].text == "2"


def test_forecasts_come_back_to_pixels_and_fade_into_the_future():
    found = messages(*CHANNELS["predictions"])
    line = drawn(found[3])[0]
    assert [(p.x, p.y) for p in line.points] == [(10, 30), (20, 40)]
    assert [colour.a for colour in line.outline_colors] == pytest.approx([0.9, 0.1])
    assert not drawn(found[2])  # not made yet
    assert not drawn(found[12])  # a second old


def test_without_a_plane_there_are_no_forecasts_to_draw():
    assert not any(drawn(message) for message in messages(*CHANNELS["predictions"], planes=()))


def test_one_identity_has_one_colour_and_neighbours_differ():
    assert foxglove.colour(5) == foxglove.colour(5)
    many = [foxglove.colour(identity) for identity in range(21)]
    assert len(set(many)) == 21
    assert all(0 <= part <= 1 for rgba in many for part in rgba)
    first = [foxglove.colour(n)[:3] for n in range(7)]
    assert min(sum(abs(a - b) for a, b in zip(x, y, strict=True)) for x in first for y in first if x != y) > 0.25


@pytest.mark.parametrize("name", ["ImageAnnotations", "CompressedVideo", "CompressedImage"])
def test_schema_records_are_those_of_the_stock_library(name):
    schema_name, encoding, data = foxglove.schema_record(f"foxglove.{name}")
    wanted = build_file_descriptor_set(foxglove._message_class(f"foxglove.{name}"))
    assert (schema_name, encoding) == (f"foxglove.{name}", "protobuf")
    assert {f.name: f for f in FileDescriptorSet.FromString(data).file} == {f.name: f for f in wanted.file}


def test_the_layout_names_the_topics_and_switches_them_on():
    layout = json.loads(foxglove.layout("/c/video", {"/c/a": True, "/c/b": False}, ["/c/x.rows[:].x_m"]))
    image = layout["configById"]["Image!picture"]
    assert image["imageMode"]["imageTopic"] == "/c/video"
    assert image["imageMode"]["annotations"] == {"/c/a": {"visible": True}, "/c/b": {"visible": False}}
    assert image["synchronize"] is False

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
