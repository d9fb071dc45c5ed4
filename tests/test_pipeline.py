"""Stages on logs: what runs first, what is replaced, what a log says of its making. And the whole line, end to end."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import EvaluateOptions, evaluate, sequence_of_log
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, PREDICTIONS, TRACKS
from mcaptrack.schema.ground_plane import rows_to_plane
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import demo
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.transforms import (
    PROFILES,
    STAGES,
    KnnDetector,
    Retrack,
    Sort,
)
from tests.worlds import small_scene

ROWS = (
    *("detections", "tracks", "samples", "predictions", "retracks"),
    *(f"retracks/{one}" for one in ("online", "predictions", "decisions")),
)


@pytest.fixture(scope="module")
def footage(tmp_path_factory) -> demo.Footage:
    return demo.draw(small_scene(9.0), tmp_path_factory.mktemp("footage"))


@pytest.fixture
def fresh(footage, tmp_path) -> Path:
    """Write a log with a video, its ground plane and its ground truth."""
    options = IngestOptions(ground_plane=footage.ground_plane, labels={"truth": footage.ground_truth})
    ingest(footage.video, tmp_path / "a.mcap", options)
    return tmp_path / "a.mcap"


@pytest.fixture(scope="module")
def finished(footage, tmp_path_factory) -> Path:
    """Write the same log with the results of all stages; tests must not change it."""
    path = tmp_path_factory.mktemp("finished") / "a.mcap"
    ingest(
        footage.video, path, IngestOptions(ground_plane=footage.ground_plane, labels={"truth": footage.ground_truth})
    )
    run_all(path)
    return path


def run_all(path: Path) -> tuple[pipeline.Report, list[str]]:
    said: list[str] = []
    with log.read(path) as opened:
        return pipeline.run(opened, "/camera", pipeline.plan_all(opened, "/camera", said.append), views=True), said


def run_stage(
    path: Path, name: str, transform, output: Path | None = None, **topics
) -> tuple[pipeline.Report, list[str]]:
    said: list[str] = []
    with log.read(path) as opened:
        jobs = pipeline.plan_stage(opened, "/camera", name, transform, say=said.append, **topics)
        return pipeline.run(opened, "/camera", jobs, output, views=True), said


def digests(path: Path) -> dict[str, str]:
    """Return the SHA-256 of times and payloads of each channel, by topic."""
    with log.read(path) as opened:
        return {
            topic: hashlib.sha256(
                b"".join(m.t_ns.to_bytes(8, "big") + m.payload for m in opened.messages(topic))
            ).hexdigest()
            for topic in opened.channels
        }


def test_missing_inputs_are_made_first_and_reported(fresh):
    report, said = run_stage(fresh, "retrack", Retrack())
    assert report.stages == ["detect", "track", "sample", "retrack", "views"]
    assert said == [
        "/camera/detections is missing: running detect",
        "/camera/tracks is missing: running track",
        "/camera/samples is missing: running sample",
    ]
    with log.read(fresh) as opened:
        assert {"/camera/retracks", "/camera/retracks/online", "/camera/retracks/predictions"} <= set(opened.channels)
        assert "/camera/predictions" not in opened.channels


def test_running_a_stage_again_replaces_only_its_channels(fresh):
    run_all(fresh)
    before = digests(fresh)
    run_stage(fresh, "retrack", PROFILES["paper"])
    after = digests(fresh)
    assert set(after) == set(before) - {"/camera/retracks/decisions"}
    changed = {topic for topic in after if after[topic] != before[topic]}
    assert changed <= {topic for topic in after if topic.startswith("/camera/retracks")}
    assert "/camera/retracks/predictions" in changed
    run_stage(fresh, "retrack", Retrack())
    assert digests(fresh) == before


def test_outdated_channels_are_reported_and_made_again_with_their_parameters(fresh):
    run_stage(fresh, "track", Sort(max_age_s=0.7))
    run_all(fresh)
    report, _ = run_stage(fresh, "detect", KnnDetector())
    assert report.stale == ["/camera/tracks"]
    with log.read(fresh) as opened:
        assert pipeline.is_stale(opened, "/camera/tracks")
        assert not pipeline.is_stale(opened, "/camera/samples")  # not yet: it still comes from the tracks there are
    report, said = run_all(fresh)
    assert report.stages == ["track", "sample", "predict", "retrack", "views"]
    assert said[0] == "/camera/tracks was made from an earlier /camera/detections: running track again, as before"
    with log.read(fresh) as opened:
        made = {topic: Provenance.from_metadata(c.metadata) for topic, c in opened.channels.items()}
        assert made["/camera/tracks"].parameters["max_age_s"] == 0.7
        assert made["/camera/detections"].parameters["detector"] == "knn"
        assert [topic for topic in opened.channels if pipeline.is_stale(opened, topic)] == []


def test_writing_to_another_file_leaves_the_log_unchanged(fresh, tmp_path):
    before = fresh.read_bytes()
    run_stage(fresh, "detect", KnnDetector(), output=tmp_path / "b.mcap")
    assert fresh.read_bytes() == before
    with log.read(tmp_path / "b.mcap") as opened:
        assert "/camera/detections" in opened.channels


def test_a_missing_input_error_lists_channels_and_a_remedy(fresh, tmp_path):
    with log.create(tmp_path / "empty.mcap") as writer:
        writer.add_channel("/imu", ("x", "jsonschema", b"{}"), "json", {})
    with pytest.raises(
        McaptrackError, match=r"has no channel /camera/video for detect; it has /imu \(x\)\. add pictures with"
    ):
        run_stage(tmp_path / "empty.mcap", "retrack", Retrack())
    with pytest.raises(
        McaptrackError, match=r"has no channel /nope for track; it has .*/camera/video.*mcaptrack\.info"
    ):
        run_stage(fresh, "track", Sort(), source="/nope")
    with pytest.raises(
        McaptrackError, match=r"/camera/video holds foxglove\.CompressedVideo; track reads mcaptrack\.Detections"
    ):
        run_stage(fresh, "track", Sort(), source="/camera/video")


def test_two_cameras_share_a_log(footage, fresh):
    with log.read(fresh) as opened:
        ingest(footage.video, fresh, IngestOptions(camera="gate"), into=opened)
    with log.read(fresh) as opened:
        assert pipeline.find_camera(opened, None) == "/camera"
        assert pipeline.find_camera(opened, "gate") == "/gate"
        assert pipeline.find_camera(opened, None, "/gate/video") == "/gate"
        pipeline.run(opened, "/gate", pipeline.plan_stage(opened, "/gate", "detect", KnnDetector()))
    with log.read(fresh) as opened:
        assert "/gate/detections" in opened.channels
        assert "/camera/detections" not in opened.channels


class TestCompleteRun:
    def test_the_log_has_all_channels(self, finished):
        with log.read(finished) as opened:
            pictures = opened.times("/camera/video").tolist()
            for name in ROWS:
                assert f"/camera/{name}" in opened.channels
            on_pictures = ("tracks", "predictions", "retracks/full", "retracks/predictions", "truth")
            drawn = {"detections/view/image", "ground_plane/view/scene", "view/tf"}
            drawn |= {f"{name}/view/{kind}" for name in on_pictures for kind in ("image", "scene")}
            assert {topic for topic in opened.channels if "/view/" in topic} == {f"/camera/{name}" for name in drawn}
            for name in ("detections", *on_pictures):
                assert opened.times(f"/camera/{name}/view/image").tolist() == pictures
            assert [f.t_ns for f in opened.frames("/camera/detections", DETECTIONS)] == pictures
            ticks = opened.times("/camera/samples").tolist()
            assert ticks == [round(0.4e9 * n) for n in range(len(ticks))]
            assert opened.times("/camera/retracks").tolist() == opened.times("/camera/predictions").tolist() == ticks
            assert [listed.name for listed in opened.index.attachments] == [
                "mcaptrack.layout.json",
                "mcaptrack.comparing.layout.json",
                "mcaptrack.predictions.layout.json",
            ]

    def test_the_mcap_library_reads_the_same_messages(self, finished):
        with log.read(finished) as opened, finished.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            frames = {topic: iter(opened.frames(topic, TRACKS)) for topic in ("/camera/tracks", "/camera/retracks")}
            for _, _, message, decoded in reader.iter_decoded_messages(topics=list(frames)):
                topic = next(t for t in frames if opened.channels[t].id == message.channel_id)
                frame = next(frames[topic])
                assert (message.log_time, message.sequence) == (frame.t_ns, frame.index)
                assert [row.track_id for row in decoded.rows] == frame.rows["track_id"].tolist()
                np.testing.assert_array_equal([row.x_m for row in decoded.rows], frame.rows["x_m"])
            assert all(next(rest, None) is None for rest in frames.values())

    def test_every_channel_has_its_provenance(self, finished):
        with log.read(finished) as opened:
            for topic, channel in opened.channels.items():
                made = Provenance.from_metadata(channel.metadata)
                assert made.version
                if made.transform not in ("ingest",):
                    assert made.input in opened.channels
                if made.transform in STAGES:
                    source = Provenance.from_metadata(opened.channel(made.input).metadata)
                    assert made.input_digest == source.digest or made.input == "/camera/video"
                    json.dumps(made.parameters)
                assert str(finished.parent) not in str(channel.metadata), topic

    def test_the_same_video_gives_the_same_bytes(self, finished, fresh):
        run_all(fresh)
        assert fresh.read_bytes() == finished.read_bytes()

    def test_detected_positions_match_the_ground_truth(self, finished):
        with log.read(finished) as opened:
            outcome = evaluate([sequence_of_log(opened, "/camera", [])], EvaluateOptions(gates_m=(1.0,)))
        rows = {(r.tracks, r.similarity): r.to_json() for r in outcome.results}
        assert rows["/camera/tracks", "iou"]["MOTA"] > 0.4
        assert rows["/camera/samples", "metres"]["MOTA"] > 0.5
        assert rows["/camera/retracks", "metres"]["MOTA"] > 0.5
        assert rows["/camera/retracks", "metres"]["mode"] == "offline"
        assert rows["/camera/retracks/online", "metres"]["mode"] == "online"
        assert rows["/camera/retracks/online", "metres"]["displacement"]["ADE_m"] < 1.5


def test_new_detections_give_a_new_estimate_of_the_scale(footage, tmp_path):
    path = tmp_path / "a.mcap"
    ingest(footage.video, path, IngestOptions())
    report, _ = run_all(path)
    assert "assumed-ground-plane" in [notice.code for notice in report.warnings]
    run_stage(path, "detect", KnnDetector(threshold=400.0))
    run_all(path)
    with log.read(path) as opened:
        (frame,) = opened.frames("/camera/ground_plane", GROUND_PLANE)
        assert rows_to_plane(frame.rows).assumed
        assert any(len(f.rows) for f in opened.frames("/camera/predictions", PREDICTIONS))
        heights = np.concatenate([f.rows["h_px"] for f in opened.frames("/camera/detections", DETECTIONS)])
        assert rows_to_plane(frame.rows).homography[0] == pytest.approx(1.7 / np.median(heights))
        assert [topic for topic in opened.channels if pipeline.is_stale(opened, topic)] == []


def test_a_log_of_many_channels_is_refused_in_few_words(tmp_path):
    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        for number in range(1000):
            writer.add_channel(f"/sensor/{number:04}", ("", "", b""), "raw", {})
    for stage in (mcaptrack.run, mcaptrack.track):
        with pytest.raises(McaptrackError, match="/sensor/0029 and 970 more") as error:
            stage(path)
        assert len(str(error.value)) < 1000


def test_what_an_older_version_made_is_left_as_it_is_until_all_is_made_again(fresh, monkeypatch):
    written = Provenance.to_metadata
    with monkeypatch.context() as before:
        before.setattr(Provenance, "to_metadata", lambda self: written(replace(self, version="0.2.0")))
        run_stage(fresh, "track", Sort(max_age_s=0.7))
        run_all(fresh)
    was = fresh.read_bytes()
    with collected() as warnings:
        assert run_all(fresh)[0].stages == []
    assert fresh.read_bytes() == was
    (words,) = [one.message for one in warnings if one.code == "out-of-date"]
    assert "was made by an older version (0.2.0)" in words
    assert "force=True)` makes all again" in words
    with log.read(fresh) as opened:
        jobs = pipeline.plan_all(opened, "/camera", force=True)
        assert [job.stage for job in jobs] == ["detect", "track", "sample", "predict", "retrack"]
        assert jobs[1].transform == Sort()
