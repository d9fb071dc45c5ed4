"""A recording of Rerun, written to a stand-in for its library: what is logged when, expected by hand."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, testing
from mcaptrack.extensions.rerun import recording
from mcaptrack.foxglove.palette import colours
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame
from mcaptrack.sources import foreign
from tests.logs import add_rows

NAN, SECOND = float("nan"), 10**9
#: The last second whose times are durations; dates begin with the next one.
START_NS = (10**9 - 1) * SECOND


class Made:
    """An object of the library: what it is, and what it was made of."""

    def __init__(self, kind: str, values: dict[str, Any]) -> None:
        self.kind, self.values = kind, values

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


class Maker:
    """A class of the library; its names are constants, or other ways of making one."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return f"{self.kind}.{name}" if name.isupper() or name[:-1].isupper() else Maker(self.kind)

    def __call__(self, *args: Any, **named: Any) -> Made:
        return Made(self.kind, dict(enumerate(args)) | named)


class Stream:
    """A recording: the calls that it got, each with the time that was set before."""

    made: list[Stream] = []

    def __init__(self, application: str, recording_id: str, send_properties: bool) -> None:
        self.about = application, recording_id, send_properties
        self.said: list[tuple[str, Any, Any]] = []
        self.now: dict[str, Any] = {}
        self.ended: list[str] = []
        Stream.made.append(self)

    def save(self, path: Path, default_blueprint: Made) -> None:
        Path(path).write_bytes(b"RRF2")
        self.blueprint = default_blueprint

    def set_time(self, timeline: str, **when: Any) -> None:
        self.now = self.now | {timeline: when}

    def log(self, entity: str, what: Any, static: bool = False) -> None:
        self.said.append((entity, "static" if static else self.now, what))

    def flush(self) -> None:
        self.ended.append("flush")

    def disconnect(self) -> None:
        self.ended.append("disconnect")

    def of(self, entity: str) -> list[tuple[Any, Any]]:
        return [(when, what) for name, when, what in self.said if name == entity]


@pytest.fixture
def rerun(monkeypatch) -> None:
    """A stand-in for the library, which keeps what it is told."""
    module, views = ModuleType("rerun"), ModuleType("rerun.blueprint")
    for one in (module, views):
        one.__getattr__ = Maker
    module.RecordingStream, module.blueprint = Stream, views
    monkeypatch.setitem(sys.modules, "rerun", module)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", views)
    monkeypatch.setattr(Stream, "made", [])


def exported(path: Path, **options) -> tuple[Stream, Any]:
    """What was recorded of a log, and the result."""
    steps: list[tuple[str, int, int]] = []
    result = mcaptrack.export(
        path, path.parent / "out.rrd", form="rerun", progress=lambda *step: steps.append(step), **options
    )
    (stream,) = Stream.made
    stream.steps = steps
    return stream, result


def rows(*people: tuple[int, int, float, float, float], solid: tuple[int, ...] = ()) -> np.ndarray:
    """Tracks: id, class, left edge of the box in px, position in m; those of ``solid`` have sizes in space."""
    ids, kinds, left, x, y = (np.array(column) for column in zip(*people, strict=True))
    big = np.where(np.isin(ids, solid), 1.0, NAN)
    return TRACKS.rows(
        track_id=ids, class_id=kinds, x_px=left, y_px=left + 1, w_px=left + 2, h_px=left + 3, x_m=x, y_m=y,
        observed=np.ones(len(ids), bool), source_id=np.full(len(ids), -1),
        z_m=big * 0.5, length_m=big * 4, width_m=big * 2, height_m=big * 1.5, heading_rad=big * 0.25,
    )  # fmt: skip


#: One picture a second: both, one leaves the picture and the ground, then the other alone, a pause, and the first.
WALK = [
    rows((4, 1, 10.0, 1.0, 2.0), (9, 2, 50.0, 5.0, 6.0), solid=(9,)),
    rows((4, 1, NAN, NAN, NAN), (9, 7, 51.0, 5.5, 6.0)),
    rows((9, 2, 52.0, 6.0, 6.0)),
    TRACKS.empty(),
    rows((4, 1, 14.0, 2.0, 2.0)),
]
FORMATS = ["jpeg", "tiff", "png", "jpeg", "tiff"]


@pytest.fixture
def walked(tmp_path) -> Path:
    """A log with encoded pictures, tracks in pictures and in space, predictions, and boxes without identities."""
    path = tmp_path / "walk.mcap"
    times = [START_NS + n * SECOND for n in range(len(WALK))]
    ahead = PREDICTIONS.rows(
        track_id=[9, 4, 9], step=[1, 1, 2], ahead_s=[0.4, 0.4, 0.8], x_m=[6.0, 1.5, 7.0], y_m=[6.5, 2.5, 7.5]
    )
    boxes = DETECTIONS.rows(
        x_px=[1.0, 2.0], y_px=[3.0, 4.0], w_px=[5.0, 6.0], h_px=[7.0, 8.0], score=[1, 1], class_id=[1, 0]
    )
    with log.create(path) as writer:
        seen = writer.add_channel("/camera/image", ("foxglove.CompressedImage", "jsonschema", b"{}"), "json", {})
        for n, (t_ns, form) in enumerate(zip(times, FORMATS, strict=True)):
            data = base64.b64encode(b"picture %d" % n).decode()
            stamp = {"sec": t_ns // SECOND, "nsec": 0}
            words = {"timestamp": stamp, "frame_id": "eye", "format": form, "data": data}
            writer.add_message(seen, t_ns, n, json.dumps(words).encode())
        named = {"mcaptrack.classes": json.dumps({"2": "car"})}
        made = {"mcaptrack.transform": "track", "mcaptrack.input": "/camera/image"}
        number = writer.add_channel(
            "/camera/tracks", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", named | made, group="t"
        )
        for n, (t_ns, some) in enumerate(zip(times, WALK, strict=True)):
            writer.add_message(number, t_ns, n + 40, TRACKS.codec.encode(some))
        frames = [Frame(times[0], 0, ahead), Frame(times[2], 1, PREDICTIONS.empty())]
        add_rows(writer, "/camera/predictions", PREDICTIONS, frames, "predict", "/camera/tracks")
        add_rows(writer, "/camera/detections", DETECTIONS, [Frame(times[0], 3, boxes)], "detect", "/camera/image")
    return path


def near(found: Any, wanted: Any) -> None:
    np.testing.assert_allclose(np.asarray(found, float), np.asarray(wanted, float), rtol=0, atol=1e-6)


def test_boxes_positions_and_trails_of_each_picture(rerun, walked):
    stream, result = exported(walked, topic="/camera/tracks")
    assert result.rows == {"/camera/tracks": 6}
    assert stream.about == ("mcaptrack", "walk", False)
    assert stream.ended == ["flush", "disconnect"]
    assert (walked.parent / "out.rrd").read_bytes() == b"RRF2"
    # Five pictures, five messages of tracks and two of forecasts, of ten that were expected.
    assert stream.steps[-12:] == [("export", min(n, 10), 10) for n in range(1, 13)]

    boxes = stream.of("camera/boxes")
    last = np.timedelta64(START_NS, "ns")
    assert boxes[0][0] == {"time": {"duration": last}, "frame": {"sequence": 40}}
    assert boxes[1][0] == {"time": {"timestamp": np.datetime64(10**18, "ns")}, "frame": {"sequence": 41}}
    near(boxes[0][1]["array"], [[10, 11, 12, 13], [50, 51, 52, 53]])
    near(boxes[1][1]["array"], [[51, 52, 53, 54]])
    assert boxes[0][1]["array_format"] == "Box2DFormat.XYWH"
    assert [box["labels"] for _, box in boxes] == [["4", "9 car"], ["9 class 7"], ["9 car"], [], ["4"]]
    near(boxes[0][1]["colors"], colours(np.array([4, 9])))
    near(boxes[1][1]["colors"], colours(np.array([9])))

    points = stream.of("ground/tracks")
    for (_, point), at, who in zip(
        points, ([[1, 2, 0], [5, 6, 0.5]], [[5.5, 6, 0]], [[6, 6, 0]], np.empty((0, 3)), [[2, 2, 0]]),
        ([4, 9], [9], [9], [], [4]), strict=True,
    ):  # fmt: skip
        near(point[0], at)
        near(point["colors"], colours(np.array(who, int)))
        assert point["radii"] == 0.15
    assert [point["labels"] for _, point in points] == [["4", "9 car"], ["9 class 7"], ["9 car"], [], ["4"]]

    ((when, solid),) = stream.of("ground/tracks/boxes")
    assert when == boxes[0][0]
    near(solid["centers"], [[5, 6, 0.5]])
    near(solid["sizes"], [[4, 2, 1.5]])
    near(solid["colors"], colours(np.array([9])))
    assert solid["labels"] == ["9 car"]
    assert [(turn["axis"], turn["radians"]) for turn in solid["rotation_axis_angles"]] == [([0, 0, 1], 0.25)]

    # The last three seconds, of tracks with two places or more; the third and the fifth second of 9 are its last ones.
    trails = [trail for _, trail in stream.of("ground/trails")]
    assert [len(trail[0]) for trail in trails] == [0, 1, 1, 1, 1]
    near(trails[1][0][0], [[5, 6, 0.5], [5.5, 6, 0]])
    near(trails[3][0][0], [[5, 6, 0.5], [5.5, 6, 0], [6, 6, 0]])
    near(trails[4][0][0], [[5.5, 6, 0], [6, 6, 0]])
    near(trails[4]["colors"], colours(np.array([9])))


def test_pictures_forecasts_and_views(rerun, walked):
    with collected() as warnings:
        stream, _ = exported(walked, topic="/camera/tracks")
    pictures = stream.of("camera")
    assert [(one["contents"], one["media_type"]) for _, one in pictures] == [
        (b"picture 0", "image/jpeg"), (b"picture 2", "image/png"), (b"picture 3", "image/jpeg"),
    ]  # fmt: skip
    assert [when["frame"]["sequence"] for when, _ in pictures] == [0, 2, 3]
    words = "/camera/image: 2 pictures that are neither video, JPEG, PNG nor WebP are left out"
    assert [one.message for one in warnings] == [words]
    ((when, first), (_, second)) = stream.of("ground/forecasts")
    assert when["time"] == {"duration": np.timedelta64(START_NS, "ns")}
    near(first[0][0], [[1.5, 2.5, 0]])
    near(first[0][1], [[6, 6.5, 0], [7, 7.5, 0]])
    near(first["colors"], np.column_stack([colours(np.array([4, 9])), [0.5, 0.5]]))
    assert list(second[0]) == []
    assert stream.of("ground") == [("static", "ViewCoordinates.RIGHT_HAND_Z_UP")]
    across, panel = stream.blueprint[0], stream.blueprint[1]
    assert [(one.kind, one["origin"]) for one in (across[0], across[1])] == [
        ("Spatial2DView", "camera"), ("Spatial3DView", "ground"),
    ]  # fmt: skip
    assert across["column_shares"] == [3, 2]
    assert panel["timeline"] == "time"
    assert stream.blueprint["collapse_panels"] is True


def test_boxes_without_identities_have_no_trails_and_colours_of_their_classes(rerun, walked):
    stream, result = exported(walked, topic="/camera/detections")
    assert result.rows == {"/camera/detections": 2}
    ((_, boxes),) = stream.of("camera/boxes")
    near(boxes["array"], [[1, 3, 5, 7], [2, 4, 6, 8]])
    near(boxes["colors"], colours(np.array([1, 0])))
    assert boxes["labels"] == ["", "unknown"]
    assert stream.of("ground/trails") == []


def test_a_video_stays_one(rerun, template, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(template.read_bytes())
    with collected() as warnings:
        stream, _ = exported(path)
    with log.read(path) as opened:
        wanted = [(message.t_ns, picture.data) for message, picture in foreign.pictures(opened, "/camera/video")]
        forecasts = opened.channels["/camera/retracks/predictions"].messages
    head, *pictures = stream.of("camera")
    assert (head[0], head[1]["codec"]) == ("static", "VideoCodec.H264")
    assert [one["sample"] for _, one in pictures] == [data for _, data in wanted]
    assert [next(iter(when["time"].values())).astype(np.int64) for when, _ in pictures] == [t for t, _ in wanted]
    assert len(stream.of("ground/forecasts")) == forecasts
    assert len(stream.of("camera/boxes")) == len(pictures) == 30
    assert not warnings


def test_the_viewer_keeps_the_laws(rerun, template, monkeypatch):
    monkeypatch.setattr(recording, "version", lambda _: "0.41.0")
    testing.check_viewer(recording.viewer, template)
