"""Stages on logs: what runs first, what is replaced, what a log says of its making. And the whole line, end to end."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import EvaluateOptions, evaluate, sequence_of_log
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, PREDICTIONS
from mcaptrack.schema.as_rows import rows_to_plane
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.transforms import (
    PROFILES,
    STAGES,
    KnnDetector,
    Retrack,
    Sort,
)
from tests.tiers import thorough


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


class TestCompleteRun:
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
        mcaptrack.run(fresh, tables=False)
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


@thorough
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


@thorough
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
