"""A command line for every option of every command in which the option can be seen."""

from __future__ import annotations

from dataclasses import dataclass

from tests.extension_cases import of_extensions


@dataclass(frozen=True)
class Case:
    """How to see an option: a command line without it, and what it adds."""

    base: str
    words: str


def cases(base: str, **words: str | tuple[str, str]) -> dict[str, Case]:
    """Options by name: words that are added to ``base``, or another base and words."""
    pairs = {
        name.replace("_", "-"): given if isinstance(given, tuple) else (base, given) for name, given in words.items()
    }
    return {name: Case(*pair) for name, pair in pairs.items()}


def common(base: str, **others: str | tuple[str, str]) -> dict[str, Case]:
    """The options that all commands have."""
    return cases(base, json="--json", quiet=(f"{base} -v", "-q"), verbose="-v") | cases(base, **others)


def stage(command: str, **others: str | tuple[str, str]) -> dict[str, Case]:
    """The options of a stage that its transform doesn't declare."""
    base = f"{command} a.mcap"
    return common(
        base, topic="--topic /other/detections" if command == "track" else "--topic /none", to="--to /camera/others",
        camera="--camera other", output="-o b.mcap", force=(f"{base} -o fresh.mcap", "--force"),
        **({"sidecar": "--sidecar"} if command in ("detect", "track", "retrack") else {}), **others,
    )  # fmt: skip


_OF_OTHERS = "run --no-tables things.mcap --topic /things"
_FIELDS = "left=things[].top,top=things[].left,w=things[].right,h=things[].bottom"
SCORED = "evaluate tall.txt --truth truth.txt"


#: For every option of every command, but parameters of transforms: a command line that it changes.
CASES: dict[str, dict[str, Case]] = {
    "ingest": common(
        "ingest clip.mp4",
        output="-o b.mcap",
        camera="--camera left",
        fps="--fps 5",
        start_time="--start-time 2026-05-01T12:00:00Z",
        image_format="--image-format jpeg",
        quality="--quality 40",
        stream="--stream 0",
        set="--set keyframe_interval_s=0.5",
        ground_plane="--ground-plane plane.txt",
        calibration="--calibration pose.yml",
        calibration_name=("ingest clip.mp4 --camera cam0 --calibration camchain.yaml", "--calibration-name cam1"),
        point=("ingest clip.mp4 --ground-plane plane.txt", "--point center"),
        detections="--detections truth.txt",
        tracks="--tracks truth.txt",
        truth="--truth truth.txt",
        motion="--motion motion.txt",
        format=("ingest truth.txt --fps 10", "--format sdd"),
        columns=("ingest table.csv --fps 10 --as tracks", "--columns x=y,y=x"),
        size=("ingest shares.csv --fps 10", "--size 640x480"),
        classes=("ingest kinds.csv --fps 10 --as tracks", "--classes person,cart"),
        frame=("ingest cubes.csv --as tracks", "--frame odom"),
        scene=("ingest truth.txt --fps 10", "--scene b"),
        class_map=("ingest kinds.csv --fps 10 --as tracks", "--class-map cart=person"),
        first_frame=("ingest truth.txt --fps 10", "--first-frame 0"),
        frames=("ingest truth.txt --fps 10", "--frames 500"),
        **{"as": ("ingest truth.txt --fps 10", "--as truth")},
        into=("ingest truth.txt --fps 10 --as tracks", "--into a.mcap"),
        definitions=("ingest bare.mcap -o b.mcap", "--definitions src"),
        sidecar=("ingest truth.txt --fps 10 --as truth --camera left --into a.mcap", "--sidecar"),
        force=("ingest clip.mp4 -o a.mcap", "--force"),
    ),
    "detect": stage("detect", detector="--detector knn", set="--set max_pixels=1000"),
    "motion": stage("motion"),
    "track": stage("track", tracker="--tracker ocsort", set="--set class_id=9"),
    "sample": stage("sample"),
    "predict": stage("predict", set="--set min_history=6"),
    "retrack": stage(
        "retrack",
        retracker="--retracker none",
        profile="--profile paper",
        set="--set mode=online --set track_confidence=1",
    ),
    "run": common(
        "run fresh.mcap --no-tables",
        fit_plane="--no-fit-plane",
        person_height_m="--person-height-m 1.5",
        frame="--frame map",
        topic="--topic /none",
        camera="--camera other",
        output="-o b.mcap",
        definitions=("run bare.mcap --no-tables --topic /t", "--definitions src"),
        map=(_OF_OTHERS, f"--map {_FIELDS}"),
        class_map=(_OF_OTHERS, "--class-map 7=person"),
        sidecar="--sidecar",
        events="--no-events",
        **of_extensions("OPTIONS_OF_RUN"),
        tables=("run a.mcap", "--no-tables"),
        force=("run a.mcap", "--force"),
        detector=("run a.mcap --no-tables", "--detector knn"),
        tracker=("run a.mcap --no-tables", "--tracker ocsort"),
        predictor=("run a.mcap --no-tables", "--predictor cv"),
        retracker=("run a.mcap --no-tables", "--retracker none"),
        camera_motion=("run a.mcap --no-tables", "--camera-motion on"),
        across_classes=("run a.mcap --no-tables", "--across-classes"),
        class_limits=("run a.mcap --no-tables", "--class-limits car=40"),
        ground_frame="--ground-frame base_link",
        **{"continue": "--continue"},
    ),
    "events": common(
        "events a.mcap",
        topic="--topic /camera/tracks",
        similarity="--similarity metres",
        gate_m=("events a.mcap --similarity metres", "--gate-m 0.01"),
        min_iou=("events a.mcap --similarity iou", "--min-iou 0.99"),
        camera="--camera other",
        output="-o b.mcap",
        force=("events a.mcap -o fresh.mcap", "--force"),
    ),
    "evaluate": common(
        "evaluate a.mcap",
        against="--against /camera/retracks",
        set=("evaluate a.mcap --json", "--set rules=motmetrics"),
        truth=("evaluate truth.txt", "--truth truth.txt"),
        similarity="--similarity iou",
        gate_m="--gate-m 0.01",
        min_iou=("evaluate a.mcap --all", "--min-iou 0.99"),
        curves="--curves curves.svg",
        topic="--topic /camera/samples",
        classes=("evaluate kinds.csv --truth kinds.csv", "--classes all"),
        format=(SCORED, "--format sdd"),
        columns=("evaluate table.csv --truth kinds.csv", "--columns x=y,y=x"),
        class_map=("evaluate kinds.csv --truth kinds.csv --classes all", "--class-map cart=dog"),
        first_frame=(SCORED, "--first-frame tracks=0"),
        frames=(SCORED, "--frames 2:4"),
        size=("evaluate shares.csv --truth shares.csv", "--size 40x40"),
        camera="--camera other",
        ground_plane=(SCORED, "--ground-plane plane.txt"),
        fps=("evaluate truth.txt --truth walk.txt --ground-plane plane.txt", "--fps 10"),
        fail_under="--fail-under idf1=1",
        csv="--csv",
        all="--all",
        output="-o scores.txt",
        force=("evaluate a.mcap -o clip.mp4", "--force"),
    ),
    "export": common(
        "export a.mcap",
        output="-o b",
        format="--format csv",
        topic="--topic /others",
        blobs=("export a.mcap --topic /others", "--blobs"),
        all=("export a.mcap", "--all"),
        columns=("export a.mcap --topic /others", "--columns header"),
        start_s=("export a.mcap --topic /others", "--start-s 1"),
        end_s=("export a.mcap --topic /others", "--end-s 0.5"),
        definitions=("export bare.mcap --topic /t", "--definitions src"),
        force=("export a.mcap -o taken", "--force"),
    ),
    "info": common("info a.mcap", frames="--frames"),
    "view": common(
        "view a.mcap",
        at=("view eventful.mcap --links", "--at 1"),
        event=("view eventful.mcap --links", "--event 2"),
        links=("view eventful.mcap", "--links"),
        port="--port 1",
        host="--host 127.0.0.2",
        lichtblick=("view a.mcap --links", "--lichtblick http://localhost:1"),
        layout=("view a.mcap --links", "--layout tracking"),
        open="--open",
    ),
    "check": common("check a.mcap"),
    "recover": common("recover a.mcap", output="-o b.mcap", force=("recover a.mcap -o fresh.mcap", "--force")),
    "cut": common(
        "cut a.mcap",
        output="-o c.mcap",
        start_s="--start-s 1",
        end_s="--end-s 1",
        around=("cut eventful.mcap", "--around 1"),
        margin_s=("cut eventful.mcap -o b.mcap --around 1", "--margin-s 0.1"),
        topic="--topic /camera/video",
        exclude="--exclude /camera/video",
        force=("cut a.mcap -o fresh.mcap", "--force"),
    ),
    "drop": common(
        "drop a.mcap /camera/retracks",
        output="-o b.mcap",
        in_place=("drop robot.mcap /a", "--in-place"),
        force=("drop a.mcap /camera/retracks -o fresh.mcap", "--force"),
    ),
    "demo": common("demo", output="-o b", force=("demo -o taken", "--force"), scene="--scene crowd", seed="--seed 3"),
    "doctor": common("doctor"),
    "docs": common("docs"),
} | {name: common(seen[0], **seen[1]) for name, seen in of_extensions("EFFECTS").items() if seen}
