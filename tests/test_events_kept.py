"""Which channels of tracks get events, by which options, and what is said where they get none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.events import EventOptions
from mcaptrack.pipeline import events
from mcaptrack.pipeline.checks import describe_origin
from mcaptrack.pipeline.write import Made, RunState, _floor_m
from mcaptrack.schema import COUNTS, EVENT_KINDS, EVENTS, TRACKS, EventKind, Frame
from mcaptrack.schema.provenance import INGEST, VIEW, Provenance
from tests.worlds import walk

WALK = walk(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 4.0)}, 10, 10)


def written(path: Path, *channels: tuple[str, Provenance | None, list[Frame]], encoding: str = "protobuf") -> Path:
    """A log of channels of tracks."""
    with log.create(path) as writer:
        for topic, made, frames in channels:
            metadata = made.to_metadata() if made else {}
            kind = (TRACKS.name, "protobuf", TRACKS.descriptor)
            number = writer.add_channel(topic, kind, encoding, metadata, another=True)
            for frame in frames:
                writer.add_message(number, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    return path


def watched(path: Path, **options: Any) -> pipeline.Report:
    with log.read(path) as opened, notices.listening(lambda _: None):
        return pipeline.run(opened, "/camera", [], watch=pipeline.Watch(**options))


TRACKED = ("/camera/tracks", Provenance(INGEST, {}, digest="y"), WALK)


@pytest.mark.parametrize("end", ["events", "events/view/log", "counts"])
def test_events_that_would_replace_something_are_left_out_with_a_warning_or_refused_if_asked_for(tmp_path, end):
    path = written(tmp_path / "a.mcap", TRACKED, (f"/camera/tracks/{end}", None, WALK))
    taken = f"would replace /camera/tracks/{end}, which was recorded by others (mcaptrack.Tracks)"
    report = watched(path)
    assert [(one.message, one.code) for one in report.warnings] == [
        (f"no events of /camera/tracks: they {taken}", "left-out")
    ]
    assert (report.stages, report.events, report.frames) == ([], {}, {})
    with pytest.raises(McaptrackError) as error:
        watched(path, topics=("/camera/tracks",), again=True)
    assert str(error.value) == f"{path}: events {taken}"


def test_tracks_without_heights_stand_on_a_floor_at_zero(tmp_path):
    high = [frame._replace(rows=frame.rows.copy()) for frame in WALK]
    for frame in high:
        frame.rows["z_m"], frame.rows["height_m"] = 3.0, 1.5
    for number, (frames, floor_m) in enumerate([(WALK, 0.0), (high, 2.2)]):
        with log.read(written(tmp_path / f"{number}.mcap", (*TRACKED[:2], frames))) as opened:
            assert _floor_m(opened, "/camera", {}) == floor_m


def test_of_two_channels_of_a_topic_the_recorded_one_is_named(tmp_path):
    ours, theirs = (("/camera/retracks", made, WALK) for made in (TRACKED[1], None))
    for number, channels in enumerate([(ours, theirs), (theirs, ours)]):
        path = written(tmp_path / f"{number}.mcap", TRACKED, *channels)
        with log.read(path) as opened:
            assert describe_origin(opened, "/camera/retracks") == "was recorded by others (mcaptrack.Tracks)"
            assert describe_origin(opened, "/camera/tracks") == "was ingested"


def test_the_usual_tracks_and_those_with_events_are_watched(tmp_path):
    made = Provenance("events", {}, "/camera/other")
    some = [
        (f"/camera/{name}", Provenance(INGEST, {}), WALK[:1])
        for name in ("zebra", "retracks", "other", "third", "tracks")
    ]
    beside = [
        ("/camera/zebra/events", made, []),
        ("/camera/other/events", made, []),
        ("/camera/third/events", None, []),
        ("/camera/gone/events", made, []),
    ]
    with log.read(written(tmp_path / "a.mcap", *some, *beside)) as opened:
        usual = ["/camera/tracks", "/camera/retracks"]
        assert events._default_topics(RunState(opened, "/camera", {})) == [*usual, "/camera/other", "/camera/zebra"]
        wrong = Made(COUNTS, [], Provenance("x", {}))
        assert events._default_topics(RunState(opened, "/camera", {"/camera/tracks": wrong})) == [
            "/camera/retracks",
            "/camera/other",
            "/camera/zebra",
        ]
    with log.read(written(tmp_path / "b.mcap", some[-1], encoding="json")) as opened:
        assert events._default_topics(RunState(opened, "/camera", {})) == []


#: What the provenance of events says, and the options that they are made again with.
ASKED: list[tuple[Any, tuple[Any, Any, Any]]] = [
    ({"similarity": "iou", "min_iou": 0.4}, ("iou", None, 0.4)),
    ({"similarity": "metres", "gate_m": 2, "min_iou": 0.5}, ("metres", 2, 0.5)),
    ({"similarity": "iou", "min_iou": 0.4}, ("iou", None, 0.4)),
    ({"similarity": "strange", "gate_m": 2.0}, (None, 2.0, None)),
    ({"gate_m": True, "min_iou": 0}, (None, None, None)),
    ({"gate_m": 0.001, "min_iou": -1.0}, (None, 0.001, None)),
    ({"gate_m": "1"}, (None, None, None)),
    (["iou"], (None, None, None)),
    (None, (None, None, None)),
]


@pytest.mark.parametrize(("asked", "wanted"), ASKED)
def test_events_are_made_again_as_they_were_asked_for_unless_something_else_is(tmp_path, asked, wanted):
    for stage, is_read in (("events", True), (VIEW, False)):
        made = Provenance(stage, {"asked": asked})
        with log.read(written(tmp_path / "a.mcap", TRACKED, ("/camera/tracks/events", made, []))) as opened:
            assert events._options_for(opened, "/camera/tracks", EventOptions()) == (
                EventOptions(*wanted) if is_read else EventOptions()
            )
            assert events._options_for(opened, "/camera/tracks", EventOptions("iou")) == EventOptions("iou")
            assert events._options_for(opened, "/camera/other", EventOptions()) == EventOptions()


def test_events_are_tallied_by_kind_for_each_channel():
    kinds = [EventKind.BIRTH, EventKind.BIRTH, EventKind.MISS, EventKind.PARTED]
    rows = EVENTS.empty(len(kinds))
    rows["kind"] = kinds
    made = Made(EVENTS, [Frame(0, 0, rows[:1]), Frame(1, 1, rows[1:])], Provenance("events", {}))
    text = made._replace(drawn="foxglove.Log")
    found = events.tally(
        {"/a/events": made, "/a/events/view/log": text, "/a/counts": Made(COUNTS, [], made.provenance)}
    )
    counted = {"birth": 2, "miss": 1, "parted": 1}
    assert found == {"/a": dict.fromkeys(EVENT_KINDS.values(), 0) | counted}
