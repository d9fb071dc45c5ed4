"""Every public name of mcaptrack, as the script of a user has it: type checkers read it, and nobody runs it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import mcaptrack
from mcaptrack.schema import Frame
from mcaptrack.transforms import ByteTrack, Retrack


def say(stage: str, done: int, total: int) -> None:
    print(f"{stage}: {100 * done // total} %")


def say_roughly(stage: str, done: float, total: float | None) -> None:
    print(stage, done, total)


def make(folder: Path) -> str:
    drawn: mcaptrack.DemoResult = mcaptrack.demo(folder / "demo", scene="walkers", seed=1, force=True, progress=say)
    made: mcaptrack.IngestResult = mcaptrack.ingest(
        "video.mp4", folder / "log.mcap", fps=25, ground_plane=folder / "h.txt", classes=None
    )
    print(drawn)
    return str(made.log)


def compute(log: str) -> mcaptrack.RunResult:
    steps: list[mcaptrack.RunResult] = [
        mcaptrack.detect(log, detector="knn", progress=say_roughly),
        mcaptrack.motion(log),
        mcaptrack.track(log, tracker=ByteTrack(max_age_s=1.0), output="a.mcap", force=True),
        mcaptrack.track(log, tracker="sort", max_age_s=1.0, stages={"track": ByteTrack()}),
        mcaptrack.sample(log, rate_hz=2.5),
        mcaptrack.stage("speed", log, output="speeds.mcap", max_gap_s=0.5),
        mcaptrack.predict(log, predictor="social"),
        mcaptrack.retrack(log, retracker=Retrack(), mode="offline"),
        mcaptrack.events(log, similarity="metres", gate_m=1.0),
    ]
    whole: mcaptrack.RunResult = mcaptrack.run(log, tracker=ByteTrack(), class_limits=None, tables=True, progress=say)
    people = 0 if whole.summary is None else whole.summary.tracks
    said: tuple[mcaptrack.Notice, ...] = tuple(notice for step in (*steps, whole) for notice in step.warnings)
    print(people, [(notice.code, notice.message) for notice in said], whole.tracks["/camera/tracks"])
    return whole


def read(log: str) -> None:
    with mcaptrack.open(log) as recording:
        opened: mcaptrack.Recording = recording
        print(opened.name, opened.path, opened.tables, opened.topics)
        steps = np.diff(opened.array("tracks", "/camera/tracks")["x_m"])
        rows = opened.table("tracks").to_pylist()
        picture: Frame = next(opened.frames("video", times=[0], colour="rgb"))
        message: mcaptrack.FetchedMessage = opened.fetch(opened.table("frames").to_pylist()[0])
        boxes = [(t_ns, found.xyxy) for t_ns, found in opened.supervision("detections")]
        box: Frame = mcaptrack.detections([[10, 20, 30, 40]], [0.9], [1], picture.t_ns, box_format="xyxy")
        opened.write("/own/detections", [box])
        speeds = mcaptrack.schema_of("Speed", [("track_id", "i8"), ("speed", "f4")], units={"speed": "m/s"})
        opened.write("/own/speeds", [box._replace(rows=speeds.rows(track_id=[1], speed=[1.4]))], schema=speeds)
        decoded: list[mcaptrack.DecodedMessage] = list(opened.messages(["/own/speeds"], decoder_factories=[]))
        for schema, channel, newest, content in opened.messages("tracks", np.datetime64(0, "ns"), reverse=True):
            print(schema and schema.name, channel.topic, newest.log_time, content)
        print(steps.max(), rows, message.payload, boxes, [each.decoded_message for each in decoded])
    about: mcaptrack.LogInfo = mcaptrack.info(log, frames=True)
    channels: list[mcaptrack.ChannelInfo] = list(about.channels)
    frames: list[mcaptrack.FrameInfo] = list(about.frames or ())
    print(channels, frames)


def use(log: str) -> None:
    scores: mcaptrack.Scores = mcaptrack.evaluate(log, similarity="metres", gate_m=1.0)
    idf1: float = scores.score("IDF1", "retracks")
    tables: mcaptrack.ExportResult = mcaptrack.export(log, form="parquet")
    server: mcaptrack.LogServer = mcaptrack.view(log).start()
    server.close()
    print(idf1, [row["MOTA"] for row in scores.rows()], tables, server.links["Lichtblick"])


def repair(log: str) -> None:
    health: mcaptrack.DoctorResult = mcaptrack.doctor()
    dropped: mcaptrack.DropResult = mcaptrack.drop(log, ["/camera/tracks"], output="less.mcap")
    cut: mcaptrack.CutResult = mcaptrack.cut(log, "moment.mcap", start_s=1.0, end_s=2.0)
    found: mcaptrack.LogCheck = mcaptrack.check(log, progress=say)
    kept: mcaptrack.LogRecovery | None = None if found.is_sound else mcaptrack.recover(log, "sound.mcap")
    print(health.to_json(), dropped, cut.messages, [finding.words for finding in found.findings], kept)


if __name__ == "__main__":
    try:
        whole = compute(make(Path("out")))
        for step in (read, use, repair):
            step(str(whole.log))
    except mcaptrack.McaptrackError as error:
        raise SystemExit(str(error)) from mcaptrack.McaptrackWarning("it failed")
