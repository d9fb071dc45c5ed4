"""Planning and writing of logs that were put together by hand: what runs and why, what is said, what is drawn."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from mcaptrack import foxglove, log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.camera_path import CameraPose, Verdict
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.pipeline.plan import check_spaces
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import DECISIONS, DETECTIONS, GROUND_PLANE, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.as_rows import plane_to_rows
from mcaptrack.schema.provenance import INGEST, VIEW, Provenance
from mcaptrack.transforms import (
    STAGES,
    KnnDetector,
    MedianDetector,
    OcSort,
    Predict,
    Retrack,
    Sample,
    Sort,
    Transform,
    motion,
)
from mcaptrack.transforms.ground import GroundTracker
from mcaptrack.transforms.motion import EstimateMotion
from mcaptrack.transforms.predict import own_options
from mcaptrack.transforms.protocol import option
from mcaptrack.transforms.retrack.options import longest_track_s
from tests.logs import write_channels
from tests.worlds import ns, tracks_at, walk

steps = sys.modules["mcaptrack.pipeline.steps"]
run = sys.modules["mcaptrack.pipeline.runner"]  # the package has a function of this name
PLANE = GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 640, 480)
Channels = Mapping[str, tuple[Schema, Provenance | None, Sequence[Frame]]]


def parameters_of(stage: str, transform: Transform) -> dict[str, Any]:
    kind = STAGES[stage].kind
    choice = {kind: STAGES[stage].entry(type(transform)).name} if kind else {}
    kept: dict[str, Any] = json.loads(json.dumps(asdict(transform) | choice))
    return kept


def made_by(stage: str, transform: Transform, source: str, said: str, own: str) -> Provenance:
    return Provenance(stage, parameters_of(stage, transform), f"/camera/{source}", said, own)


def finished(**changed: Any) -> dict[str, tuple[Schema, Provenance | None, Sequence[Frame]]]:
    """A camera with boxes that were ingested, after all stages; ``changed`` are other values of a provenance."""
    making = {
        "detections": (DETECTIONS, Provenance(INGEST, {}, "", "", "d")),
        "tracks": (TRACKS, made_by("track", Sort(), "detections", "d", "t")),
        "samples": (TRACKS, made_by("sample", Sample(), "tracks", "t", "s")),
        "predictions": (PREDICTIONS, made_by("predict", Predict(), "samples", "s", "p")),
        "retracks": (TRACKS, made_by("retrack", Retrack(), "samples", "s", "r")),
        "retracks/online": (TRACKS, made_by("retrack", Retrack(), "samples", "s", "o")),
        "retracks/predictions": (PREDICTIONS, made_by("retrack", Retrack(), "samples", "s", "q")),
        "retracks/decisions": (DECISIONS, made_by("retrack", Retrack(), "samples", "s", "h")),
        "retracks/full": (TRACKS, made_by("retrack", Retrack(), "samples", "s", "f")),
    }
    return {
        f"/camera/{name}": (schema, replace(made, **changed.get(name, {})), [Frame(ns(1), 0, schema.empty())])
        for name, (schema, made) in making.items()
    }


def planned(
    path: Path, channels: Channels, **options: Any
) -> tuple[list[pipeline.Job], list[str], list[tuple[str, str]]]:
    """The jobs that everything takes, what is said of them, and warnings with their codes."""
    said: list[str] = []
    with log.read(write_channels(path, channels)) as opened, notices.collected() as warned:
        jobs = pipeline.plan_all(opened, "/camera", said.append, **options)
    return jobs, said, [(one.message, one.code) for one in warned]


def stages_of(jobs: Iterable[pipeline.Job]) -> list[str]:
    return [job.stage for job in jobs]


EARLIER = "/camera/{} was made from an earlier /camera/{}: running {} again, as before".format
STAGES_OF_ALL = ["track", "sample", "predict", "retrack"]
AGAIN = [
    EARLIER("tracks", "detections", "track"),
    EARLIER("samples", "tracks", "sample"),
    EARLIER("predictions", "samples", "predict"),
    EARLIER("retracks", "samples", "retrack"),
]


class Plan(NamedTuple):
    """What differs, the options of the plan, the stages that run, what is said, and what is warned of."""

    changed: dict[str, Any] = {}
    options: dict[str, Any] = {}
    stages: Sequence[str] = ()
    said: Sequence[str] = ()
    warned: str = ""
    code: str = "other-settings"


def other_settings(words: str, **defaults: Transform) -> Plan:
    """Nothing runs, but what a channel was made with is said to be other than the defaults now."""
    topic, _, differs = words.partition(": ")
    message = f"/camera/{topic} was made with other settings than now ({differs}); {{force}} takes these"
    return Plan(options={"defaults": defaults}, warned=message)


NEW_BOXES, NEW_SAMPLES = {"detections": {"digest": "D"}}, {"samples": {"digest": "S"}}
WITHOUT = "it was made with strange, which {} does not have".format
MANY_OTHERS = Retrack(min_history=3, drift_ratio=0.5, link_s=1.0, smooth=False, max_age_s=1.0)
PLANS = {
    "nothing": Plan(),
    "other boxes": Plan(NEW_BOXES, {}, STAGES_OF_ALL, AGAIN),
    "other samples": Plan(NEW_SAMPLES, {}, STAGES_OF_ALL[2:], AGAIN[2:]),
    "force": Plan({}, {"force": True}, STAGES_OF_ALL),
    "force, though due": Plan(NEW_BOXES, {"force": True}, STAGES_OF_ALL),
    "another tracker, chosen": Plan(
        {},
        {"defaults": {"track": OcSort()}, "chosen": ("tracker",)},
        STAGES_OF_ALL,
        ["/camera/tracks was made by another tracker: running track again", *AGAIN[1:]],
    ),
    "another predictor, chosen": Plan(
        {},
        {"defaults": {"predict": Predict(predictor="kalman")}, "chosen": ("predictor",)},
        ["predict"],
        ["/camera/predictions was made by another predictor: running predict again"],
    ),
    "the same tracker, chosen": Plan(options={"defaults": {"track": Sort()}, "chosen": ("tracker",)}),
    "another tracker, not chosen": other_settings("tracks: OcSort, not Sort", track=OcSort()),
    "one other setting": other_settings("tracks: max_age_s 2.0, not 1.4", track=Sort(max_age_s=2.0)),
    "three other settings": other_settings(
        "tracks: max_age_s 2.0, not 1.4; min_hits_s 0.5, not 0.3; min_iou 0.25, not 0.2",
        track=Sort(max_age_s=2.0, min_hits_s=0.5, min_iou=0.25),
    ),
    "a setting that is empty": other_settings("predictions: class_limits car=4, not ''", predict=Predict(class_limits="car=4")),
    "five other settings, said once": other_settings(
        "retracks: min_history 3, not 2; drift_ratio 0.5, not 0.08; max_age_s 1.0, not 2.0; and 2 more",
        retrack=MANY_OTHERS,
    ),
    "other settings, where it runs as before": other_settings(
        "samples: max_gap_s 3.0, not 2.0", sample=Sample(max_gap_s=3.0)
    )._replace(changed=NEW_BOXES, stages=STAGES_OF_ALL, said=AGAIN),
    "a parameter that is gone": Plan(
        {"predictions": {"parameters": {"strange": 1, "more": 2}}, **NEW_SAMPLES},
        {},
        ["retrack"],
        AGAIN[3:],
        "/camera/predictions is out of date and stays as it is: it was made with more, strange, which Predict does not "
        "have",
        "out-of-date",
    ),
    "a parameter that is gone, and force": Plan(
        {"tracks": {"parameters": {"strange": 1}}},
        {"force": True},
        STAGES_OF_ALL[1:],
        [],
        f"/camera/tracks is not made again, it stays as it is: {WITHOUT('Sort')}",
        "left-out",
    ),
    "a parameter that is gone, and another setting": other_settings(
        f"predictions: {WITHOUT('Predict')}", predict=Predict()
    )._replace(changed={"predictions": {"parameters": {"strange": 1}}}),
    "compared with something that is gone": Plan({"predictions": {"references": {"/camera/truth": "x"}}}, {}, ["predict"], [EARLIER("predictions", "truth", "predict")]),
    "compared with nothing, as now": Plan({"predictions": {"references": {"/camera/truth": ""}}}),
    "compared with something else": Plan({"predictions": {"references": {"/camera/tracks": "T"}}}, {}, ["predict"], [EARLIER("predictions", "tracks", "predict")]),
    "a plane that is gone": Plan(
        {"tracks": {"parameters": parameters_of("track", Sort(ground_planes=((0, PLANE),)))}}, {}, STAGES_OF_ALL,
        [EARLIER("tracks", "ground_plane", "track"), *AGAIN[1:]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_what_runs_why_and_what_is_said_of_it(plan, tmp_path):
    path = tmp_path / "a.mcap"
    jobs, said, warned = planned(path, finished(**plan.changed), **plan.options)
    assert (stages_of(jobs), said) == (list(plan.stages), list(plan.said))
    message = plan.warned.replace("{force}", f"`mcaptrack.run('{path}', force=True)`")
    assert warned == ([(message, plan.code)] if message else [])


def test_a_stage_runs_with_what_is_asked_or_else_as_before(tmp_path):
    before, now = Sort(max_age_s=0.5), Sort(max_age_s=2.5)
    channels = finished(tracks={"parameters": parameters_of("track", before), "input_digest": "other"})
    (first, *_), *_ = planned(tmp_path / "a.mcap", channels, defaults={"track": now})
    assert first.transform == before
    (first, *_), *_ = planned(tmp_path / "b.mcap", channels, defaults={"track": now}, force=True)
    assert first.transform == now
    (first, *_), *_ = planned(tmp_path / "c.mcap", channels, force=True)
    assert first.transform == before
    del channels["/camera/tracks"]
    (first, *_), said, _ = planned(tmp_path / "d.mcap", channels, defaults={"track": now})
    assert (first.transform, said[0]) == (now, "/camera/tracks is missing: running track")


def test_another_input_is_taken_and_said(tmp_path):
    channels = finished() | {
        "/camera/others": (DETECTIONS, Provenance(INGEST, {}, "", "", "o"), [Frame(0, 0, DETECTIONS.empty())])
    }
    jobs, said, _ = planned(tmp_path / "a.mcap", channels, source="/camera/others")
    assert next((job.stage, job.source, job.target) for job in jobs) == ("track", "/camera/others", "/camera/tracks")
    assert said[0] == "/camera/tracks was made from /camera/detections: running track again, from /camera/others"
    assert planned(tmp_path / "b.mcap", channels, source="/camera/detections")[:2] == ([], [])
    with pytest.raises(McaptrackError) as error:
        planned(tmp_path / "c.mcap", channels, source="/camera/samples")
    assert re.match(r".*c\.mcap: /camera/samples holds mcaptrack\.Tracks; run begins with one of ", str(error.value))


def test_only_outputs_that_are_there_are_made_again(tmp_path):
    channels = finished(samples={"digest": "S"})
    kept = (((), None), (("online",), ("", "predictions", "decisions")), (("online", "predictions"), ("", "decisions")))
    for gone, keep in kept:
        left = {topic: one for topic, one in channels.items() if topic.rpartition("retracks/")[2] not in gone}
        jobs, *_ = planned(tmp_path / "a.mcap", left)
        assert jobs[-1].keep == keep
        assert jobs[-1].kept() == {f"/camera/retracks/{one}".rstrip("/") for one in keep or Retrack().writes} | {
            "/camera/retracks/full"
        }


def test_an_output_that_is_missing_is_made_as_the_others_beside_it(tmp_path):
    retrack = Retrack(link_s=7.0)
    channels = finished(
        **{f"retracks{end}": {"parameters": parameters_of("retrack", retrack)} for end in ("", "/full", "/predictions")}
    )
    del channels["/camera/retracks/online"]
    said: list[str] = []
    with log.read(write_channels(tmp_path / "a.mcap", channels)) as opened:
        jobs = pipeline.plan_stage(
            opened, "/camera", "predict", Predict(), "/camera/retracks/online", "/camera/more", say=said.append
        )
    assert [(job.stage, job.source, job.target) for job in jobs] == [
        ("retrack", "/camera/samples", "/camera/retracks"),
        ("predict", "/camera/retracks/online", "/camera/more"),
    ]
    assert (jobs[0].transform, jobs[0].keep) == (retrack, None)
    assert said == ["/camera/retracks/online is missing: running retrack, as for what it made beside it"]


def test_channels_made_from_what_was_replaced_are_stale(tmp_path):
    channels = finished() | {
        "/camera/tracks/events": (
            TRACKS,
            Provenance("events", {}, "/camera/tracks", "t", references={"/camera/truth": "u"}),
            [],
        ),
        "/camera/tracks/view/image": (TRACKS, Provenance(VIEW, {}, "/camera/tracks", "t"), []),
    }
    with log.read(write_channels(tmp_path / "a.mcap", channels)) as opened:
        assert pipeline.outdated_by(opened, {"/camera/tracks": "t"}) == []
        assert pipeline.outdated_by(opened, {"/camera/tracks": "T"}) == ["/camera/samples", "/camera/tracks/events"]
        assert pipeline.outdated_by(opened, {"/camera/tracks": "T", "/camera/samples": "s"}) == [
            "/camera/tracks/events"
        ]
        assert pipeline.outdated_by(opened, {"/camera/truth": "U"}) == ["/camera/tracks/events"]
        assert pipeline.outdated_by(opened, {"/camera/detections": "D"}) == ["/camera/tracks"]


# What a stage knows of the log


def paced(rate_hz: float, count: int = 9) -> list[Frame]:
    return walk(lambda n: {1: (n * 0.1, 0.0)}, count, rate_hz)


@pytest.mark.parametrize(("rate_hz", "is_said"), [(2.5, False), (5.0, False), (6.25, True)])
def test_the_rate_of_other_inputs_is_known_and_a_high_one_is_said(tmp_path, rate_hz, is_said):
    ingested = Provenance(INGEST, {}, digest="x")
    channels = {
        "/camera/tracks": (TRACKS, ingested, paced(rate_hz)),
        "/camera/samples": (TRACKS, ingested, paced(rate_hz)),
    }
    words = (
        "/camera/tracks has 6.25 frames a second, and retrack takes steps at that rate; /camera/samples has 2.5 unless it "
        "was made otherwise"
    )
    with log.read(write_channels(tmp_path / "a.mcap", channels)) as opened:
        for source in ("/camera/tracks", None):
            with notices.collected() as said:
                frames, known = pipeline.input_of(opened, "/camera", "retrack", Retrack(), source)
            people = {"class_names": ((1, "person"),), "fixed_ids": (), "answers": ()}
            assert known == {
                "rate_hz": rate_hz,
                "ground_planes": (),
                "poor_scale": False,
                "descriptors": None,
                "boxes": None,
                **people,
            }
            assert [frame.t_ns for frame in frames] == [frame.t_ns for frame in paced(rate_hz)]
            assert [(one.message, one.code) for one in said] == [(words, "clock")] * (is_said and source is not None)


@pytest.mark.parametrize(("clock", "start_ns"), [("70", 70), ("0", 0), ("", None), ("soon", None)])
def test_the_clock_begins_as_the_log_says(tmp_path, clock, start_ns):
    channels = {"/camera/tracks": (TRACKS, Provenance(INGEST, {}), paced(10.0))}
    with log.read(write_channels(tmp_path / "a.mcap", channels, clock)) as opened:
        known = pipeline.input_of(opened, "/camera", "sample", Sample())[1]
    assert known == {"start_ns": start_ns, "ground_planes": ()}


def plane_at(t_ns: int, plane: GroundPlane = PLANE) -> Frame:
    return Frame(t_ns, 0, plane_to_rows(plane))


def test_re_tracked_people_are_carried_to_the_rate_of_the_tracks_they_come_from(tmp_path):
    tracks = walk(lambda n: {1: (n * 0.05, 0.0), 2: (n * 0.05, 6.0)}, 60, 10.0)
    ingested = Provenance(INGEST, {}, digest="x")
    with log.read(write_channels(tmp_path / "a.mcap", {"/camera/tracks": (TRACKS, ingested, tracks)})) as opened:
        pipeline.run(opened, "/camera", pipeline.plan_all(opened, "/camera"))
    with log.read(tmp_path / "a.mcap") as opened:
        assert [f.t_ns for f in opened.frames("/camera/retracks/full", TRACKS)] == [f.t_ns for f in tracks]
        assert pipeline.plan_all(opened, "/camera") == []
        samples = opened.frames("/camera/samples", TRACKS)
        made = Provenance.from_metadata(opened.channel("/camera/samples").metadata)
    for how, is_known in ((made, True), (ingested, False)):  # samples that stand, and others of unknown tracks
        there = {"/camera/samples": (TRACKS, how, samples), "/camera/tracks": (TRACKS, ingested, tracks)}
        with log.read(write_channels(tmp_path / "b.mcap", there)) as opened:
            pipeline.run(opened, "/camera", pipeline.plan_stage(opened, "/camera", "retrack", Retrack()))
        with log.read(tmp_path / "b.mcap") as opened:
            assert ("/camera/retracks/full" in opened.channels) is is_known


# What is odd


GUESSED = (
    "no ground plane is known: taking 20 px for a metre, since people are 1.7 m high; distances, speeds and re-tracking "
    "go by it. Give one with `mcaptrack.ingest('INPUT', ground_plane='HOMOGRAPHY')`"
)


@pytest.mark.parametrize(
    ("stage", "assumed", "is_said"),
    [("track", True, True), ("track", False, False), ("detect", True, False), (INGEST, True, False)],
)
def test_a_guessed_scale_is_said_of_what_is_in_metres(tmp_path, stage, assumed, is_said):
    plane = GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 64, 48, assumed=assumed)
    with log.read(write_channels(tmp_path / "a.mcap", finished())) as opened, notices.collected() as said:
        run.warn_findings(
            RunState(opened, "/camera", {}), {"/camera/other": Provenance(stage, {})}, [(0, plane)], is_all=False
        )
    assert [(one.message, one.code) for one in said] == [(GUESSED, "assumed-ground-plane")] * is_said


@pytest.mark.parametrize(
    ("parameters", "done"),
    [
        ({"poor_scale": True, "retracker": "consistency"}, "not re-tracked but passed on"),
        ({"poor_scale": True, "link_s": 0.0}, "not re-tracked but passed on"),
        ({"poor_scale": True}, "only linked over gaps, by their boxes in the picture"),
        ({"poor_scale": True, "side_view": True}, ""),
        ({"side_view": False}, ""),
    ],
)
def test_tracks_that_are_only_linked_or_passed_on_are_said(tmp_path, parameters, done):
    path = write_channels(tmp_path / "a.mcap", finished())
    words = (
        f"tracks were {done}: without a measured ground plane, more needs a camera that looks down, and this one looks "
        f"along the ground. To insist: `mcaptrack.retrack('{path}', side_view=True)`"
    )
    with log.read(path) as opened, notices.collected() as said:
        run.warn_findings(
            RunState(opened, "/camera", {}), {"/camera/x": Provenance("retrack", parameters)}, (), is_all=False
        )
    assert [(one.message, one.code) for one in said] == [(words, "held-back")] * bool(done)


@pytest.mark.parametrize(
    ("files", "free"),
    [
        ({"meminfo": "MemTotal: 9 kB\nMemAvailable:  7 kB\n", "memory.max": "5000\n", "memory.current": "900\n"}, 4100),
        ({"meminfo": "MemAvailable: 3 kB\n", "memory.max": "5000\n", "memory.current": "900\n"}, 3072),
        ({"meminfo": "MemAvailable: 3 kB\n", "memory.max": "max\n", "memory.current": "900\n"}, 3072),
        ({"meminfo": "MemAvailable: 3 kB\n"}, 3072),
        ({"meminfo": "MemFree: 3 kB\n"}, None),
        ({}, None),
    ],
)
def test_free_memory_is_the_least_that_linux_grants(monkeypatch, files, free):
    def read_text(path: Path) -> str:
        if path.name not in files:
            raise FileNotFoundError
        return files[path.name]

    monkeypatch.setattr(steps.Path, "read_text", read_text)
    assert steps.free_memory() == free


# What is drawn


def at(x: float, frames: int = 2) -> list[Frame]:
    return [Frame(ns(n), n, tracks_at({1: (x, 0.0), 2: (float("nan"), 0.0)})) for n in range(frames)]


def forecast(*steps: int) -> list[Frame]:
    """A frame of the first of these steps, and one of the others."""
    frames = []
    for number, some in enumerate((steps[:1], steps[1:])):
        rows = PREDICTIONS.empty(len(some))
        for name in rows.dtype.names:
            rows[name] = some if name == "step" else 0
        frames.append(Frame(ns(number), number, rows))
    return frames


def test_a_view_that_others_recorded_stays_and_that_is_said(tmp_path):
    ingested = Provenance(INGEST, {}, digest="x")
    channels = {"/camera/truth": (TRACKS, ingested, at(1.0)), "/camera/truth/view/scene": (TRACKS, None, at(2.0))}
    path = write_channels(tmp_path / "a.mcap", channels)
    with log.read(path) as opened:
        before = [message.payload for message in opened.messages("/camera/truth/view/scene")]
        report = pipeline.run(opened, "/camera", [], tmp_path / "b.mcap", views=True)
    words = "no view at /camera/truth/view/scene, which was recorded by others (mcaptrack.Tracks)"
    assert [(one.message, one.code) for one in report.warnings] == [(words, "left-out")]
    with log.read(tmp_path / "b.mcap") as opened:
        assert [message.payload for message in opened.messages("/camera/truth/view/scene")] == before
        assert "/camera/view/tf" in opened.channels


def test_views_are_found_by_what_is_best_or_by_name(tmp_path):
    path = tmp_path / "a.mcap"

    def found(names: Sequence[str], *topics: str) -> list[str]:
        with log.create(path) as writer:
            writer.add_channel("/camera/video", foxglove.schema_record(foxglove.VIDEO), "protobuf", {})
            for name in names:
                writer.add_channel(f"/{name}", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", {})
        with log.read(path) as opened:
            shown = pipeline.find_views(opened, "/camera", topics)
        assert shown.pictures == "/camera/video"
        return shown.views

    image = "/view/image"
    names = [f"camera/{name}{image}" for name in ("detections", "tracks", "retracks/full", "retracks/predictions")]
    assert found(names) == [f"/camera/retracks/full{image}", f"/camera/retracks/predictions{image}"]
    assert found(names[:2]) == [f"/camera/tracks{image}"]
    assert found([*names[:1], f"other/tracks{image}"]) == [f"/camera/detections{image}"]
    assert found(names, "/camera/retracks") == [f"/camera/retracks/full{image}"]
    assert found([*names, f"camera/retracks{image}"], "/camera/retracks") == [f"/camera/retracks{image}"]
    assert found(names, f"/camera/tracks{image}", "/camera/detections") == [
        f"/camera/tracks{image}",
        f"/camera/detections{image}",
    ]
    with pytest.raises(McaptrackError) as error:
        found([f"other/tracks{image}", "camera/tracks/view/scene"])
    assert str(error.value) == f"{path} has no views of /camera yet; `mcaptrack.run('{path}')` makes them"
    with pytest.raises(McaptrackError, match="/camera/samples/view/image"):
        found(names, "/camera/samples")
    names += ["camera/tracks/view/scene"]
    with pytest.raises(McaptrackError, match="views on /camera/video, scenes can't be drawn in one video; name those"):
        found(names, "/camera/tracks", "/camera/tracks/view/scene")
    with log.read(write_channels(path, {f"/{name}": (TRACKS, None, []) for name in names})) as opened:
        assert pipeline.find_views(opened, "/camera") == (["/camera/tracks/view/scene"], "")


# What a log holds, in numbers


def test_forecasts_and_planes_are_counted(tmp_path):
    def summary(channels: Channels) -> pipeline.Summary:
        with log.read(write_channels(tmp_path / "a.mcap", channels)) as opened:
            return pipeline.summarise(opened, "/camera")

    ingested = Provenance(INGEST, {})
    ahead = forecast(1, 1, 2, 3)
    for frame in ahead:
        frame.rows["ahead_s"] = frame.rows["step"] * 0.40004
    channels: dict[str, Any] = {"/camera/predictions": (PREDICTIONS, ingested, ahead)}
    found = summary(channels)
    assert (found.forecasts, found.horizon_s, found.ground_plane, found.tracks) == (2, 1.2, None, None)
    found = summary(channels | {"/camera/retracks/predictions": (PREDICTIONS, ingested, forecast(1, 1))})
    assert (found.forecasts, found.horizon_s) == (2, 0.0)
    assert summary(channels | {"/camera/retracks/predictions": (PREDICTIONS, ingested, [])}).horizon_s is None
    for assumed, word in (((True, True), "assumed"), ((True, False), "given"), ((), None)):
        planes = [plane_at(n, replace(PLANE, assumed=one)) for n, one in enumerate(assumed)]
        assert summary({"/camera/ground_plane": (GROUND_PLANE, ingested, planes)}).ground_plane == word


@pytest.mark.parametrize(("frame_id", "is_said"), [("map", True), ("", False)])
def test_a_frame_without_boxes_in_space_has_no_effect(tmp_path, frame_id, is_said):
    channels = {"/camera/tracks": (TRACKS, Provenance(INGEST, {}), paced(2.5))}
    with log.read(write_channels(tmp_path / "a.mcap", channels)) as opened, notices.collected() as said:
        check_spaces(opened, "/camera", [], frame_id)
    wanted = "`frame=` has no effect: only recorded 3D boxes are brought to a frame"
    assert [(one.code, one.message) for one in said] == ([("option-not-used", wanted)] if is_said else [])


# What is said where nothing comes of an input, or not what was wanted: reasons by hand, at their bounds


def rows(count: int) -> np.ndarray:
    return np.zeros(count)


@pytest.mark.parametrize(
    ("transform", "reason"),
    [
        (Sample(), "no track lasts for two sample times, or none stands on the ground plane"),
        (GroundTracker(), "no track of 7 detections is confirmed (confirm_score)"),
        (Sort(), "no track of 7 detections is confirmed (min_hits_s): too few pictures a second, perhaps"),
        (MedianDetector(), "nothing in its 2 pictures differs from their median by more than the threshold"),
        (KnnDetector(), "no motion in its 2 pictures exceeds the threshold"),
        (Predict(), "no track has the 1.2 s without a gap that a prediction needs (min_history)"),
        (
            Predict(rate_hz=10.0, min_history=3),
            "no track has the 0.2 s without a gap that a prediction needs (min_history)",
        ),
        (EstimateMotion(), "it has no pictures that can be decoded"),
    ],
)
def test_why_nothing_came_of_it(transform: Any, reason: str):
    given = [Frame(0, 0, rows(3)), Frame(1, 1, rows(0)), Frame(2, 2, rows(4))]
    assert transform.why_empty(given, given[:2]) == reason


@pytest.mark.parametrize(
    ("least_s", "confidence", "reason"),
    [
        (2.0, 0.0, "no track is likely enough to be a person (track_confidence)"),
        (2.5, 0.0, "the longest track lasts 2 s; those under 2.5 s are left out (min_track_s)"),
        (2.5, 0.5, "no track is likely enough to be a person (track_confidence)"),
    ],
)
def test_why_no_track_is_left(least_s: float, confidence: float, reason: str):
    """The second of three tracks, whose rows lie between those of others, lasts from 0.4 to 2.4 s."""
    frames = walk(lambda n: {4: (0, 0)} | ({7: (1, 0)} if 1 <= n <= 6 else {}) | ({9: (2, 0)} if n == 3 else {}), 7)
    for frame in frames:
        frame.rows["track_id"][frame.rows["track_id"] == 4] = 4 + 100 * frame.index  # each of one row
    assert longest_track_s(frames) == 2.0
    retrack = Retrack(min_track_s=least_s, track_confidence=confidence)
    assert retrack.why_empty(frames, []) == reason  # a third of 2.4 s is enough where how likely tracks are counts


class _Poses:
    def __init__(self, cut: set[int], lost: set[int]) -> None:
        self._number, self._cut, self._lost = 0, cut, lost

    def step(self, image: object, boxes: object) -> CameraPose:
        number, self._number = self._number, self._number + 1
        verdict = Verdict.CUT if number in self._cut else Verdict.LOST if number in self._lost else Verdict.STILL
        return CameraPose(IDENTITY, IDENTITY, 0, 9.0, verdict)


@pytest.mark.parametrize(
    ("count", "cut", "lost", "said"),
    [
        (10, set(), set(), []),
        (10, {4}, set(), ["there is a cut at 2.0 s: another scene begins there, and tracks end"]),
        (10, {7, 9}, set(), ["there is 2 cuts, the first at 3.5 s: another scene begins there, and tracks end"]),
        (50, set(), {3}, ["the motion of the camera is not known in 2% of the pictures; it is taken as none"]),
        (51, set(), {3}, []),
        (4, {1}, {2, 3}, ["there is a cut at 0.5 s: ", "not known in 50% of the pictures"]),
        (0, set(), set(), []),
    ],
)
def test_cuts_and_pictures_without_a_motion_are_said(count, cut, lost, said, monkeypatch):
    monkeypatch.setattr(motion, "MotionEstimator", lambda: _Poses(cut, lost))
    picture = np.zeros((48, 64), np.uint8)
    with collected() as notices:
        found = [one for (one,) in EstimateMotion()([Frame(ns(7 + n / 2), n + 5, picture) for n in range(count)])]
    assert [(frame.t_ns, frame.index) for frame in found] == [(ns(7 + n / 2), n + 5) for n in range(count)]
    assert {(int(row["width_px"]), int(row["height_px"])) for frame in found for row in frame.rows} <= {(64, 48)}
    assert [notice.code for notice in notices] == ["view-lost"] * len(said)
    for notice, words in zip(notices, said, strict=True):
        assert words in notice.message


def test_own_options_are_those_with_a_default_that_the_interface_does_not_have():
    def plain(steps, step_s=0.4, *rest, gain=2.0, name="x", depth: int | None = 3, unset=None, **more):
        raise NotImplementedError

    assert [(one.name, one.annotation, one.default, one.metadata) for one in own_options(plain)] == [
        ("gain", float, 2.0, {}),
        ("depth", int | None, 3, {}),
        ("unset", type(None) | None, None, {}),
    ]

    class Plain:
        past = 4

        def __init__(self, steps: int, step_s: float, needed, size: int = 4, *, mode: str = None):  # noqa: RUF013
            raise NotImplementedError

    assert [(one.name, one.annotation, one.default) for one in own_options(Plain)] == [
        ("size", int, 4),
        ("mode", str | None, None),
    ]

    @dataclass
    class Declared:
        steps: int
        step_s: float = 0.4
        width: float = option(1.5, "how wide", least=0.5)
        names: tuple[str, ...] = field(default_factory=lambda: ("a", "b"))

    width, names = own_options(Declared)
    assert (width.name, width.annotation, width.default, width.metadata["least"]) == ("width", float, 1.5, 0.5)
    assert (names.name, names.default) == ("names", ("a", "b"))
    assert own_options(len) == []  # nothing is known of its arguments' defaults
