"""Running stages on logs, and what is said of it at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from mcaptrack import notices
from mcaptrack.cli import common
from mcaptrack.errors import McaptrackError, command

if TYPE_CHECKING:
    from mcaptrack.log import Log
    from mcaptrack.pipeline import Job, Report, Summary, Watch

#: What to do on a log, once it is open: from its camera's prefix, and with what says a line.
MakePlan = Callable[["Log", str, Callable[[str], None]], "list[Job]"]


def run_on_logs(
    given: Mapping[str, Any], make_plan: MakePlan, watch: Watch | None = None, is_run: bool = False
) -> None:
    """Plan and run on every log, and say and print what came of it.

    With ``is_run`` tables are written if ``given`` says so, and the summary is of all that the log holds.
    """
    paths = common.expand(given["logs"])
    common.only_one_output(paths, given["output"])
    if given["output"] and given["sidecar"] is not None:
        flag = "--sidecar" if given["sidecar"] else "--in-place"
        raise McaptrackError(f"{flag} and -o are two places for the same results; give one of them")
    results = []
    with common.Talk(given["quiet"], given["verbose"]).open() as talk:
        for path in paths:
            with talk.attempt(path, paths), notices.about(given["output"] or path):
                results.append(_run_on_log(path, given, make_plan, watch, is_run, talk))
    if given["json"]:
        common.print_json({"results": results})


def _run_on_log(
    path: Path, given: Mapping[str, Any], make_plan: MakePlan, watch: Watch | None, is_run: bool, talk: common.Talk
) -> dict[str, Any]:
    """Plan and run on one log; what came of it, for programs."""
    from mcaptrack import log, pipeline
    from mcaptrack.files import is_same_file, publish_bytes, refuse_overwrite
    from mcaptrack.sources.ingest.sidecar import SidecarChoice

    began = monotonic()
    output: Path | None = given["output"]
    target = output or path
    if output is not None:
        if is_same_file(output, path):
            raise McaptrackError(f"{path} is both input and output; leave -o out to add to it in place")
        refuse_overwrite(output, given["force"])
    place = SidecarChoice(given["sidecar"])
    with log.read(path, sidecar=None if output else place) as opened:
        if output is None:
            opened.lock()  # a second writer is turned away before it computes anything
        topics = watch.topics if watch else ()
        prefix = pipeline.find_camera(opened, given["camera"], given["topic"] or next(iter(topics), None))
        jobs = make_plan(opened, prefix, talk.say)
        report = pipeline.run(opened, prefix, jobs, output, talk.progress, watch)
        written_to = output or opened.parts[-1].path
    for name, content in report.layouts.items():
        publish_bytes(pipeline.layout_path(target, name), content)
    for topic, count in report.frames.items():
        talk.detail(f"{target}: {topic} {count} frames")
    for topic, kinds in report.events.items():
        words = ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count) or "nothing happened"
        (talk.say if watch and watch.again else talk.detail)(f"{topic}: {words}")
    for topic in report.stale:
        again = command("run", target)
        talk.warn(f"{topic} was made from what has just been replaced; {again} brings it up to date", "out-of-date")
    data: dict[str, Any] = {
        "log": str(target),
        "stages": report.stages,
        "frames": report.frames,
        "events": report.events,
        "written_to": str(written_to) if report.stages else None,
        "written_there_because": place.why or None,
    }
    if is_run:
        data["tables"] = _export(target, given, talk) if given["tables"] else {}
        with notices.collected() as warnings, log.read(target) as opened:
            summary = pipeline.summarise(opened, prefix)
        report.warnings += warnings
        data["summary"] = summary.to_json()
        lines = [*_lines_of_run(summary), *_lines_of_warnings(report)]
        steps = ["view"] + (["evaluate"] if summary.scores else []) if summary.tracks else ["info"]
    else:
        data |= {"rows": report.rows, "tracks": report.tracks}
        lines = list(_lines_of_stage(report))
        steps = ["view"] if watch else ["run"]
    data |= {"seconds": round(monotonic() - began, 3), "next": [command(step, target).strip("`") for step in steps]}
    did = f"{', '.join(report.stages)} in {data['seconds']:.1f} s" if report.stages else _UP_TO_DATE
    talk.say(f"{target}: {did}")
    if place.why and report.stages:
        lines.append(("written", place.words(written_to)))
    lines.append(("next", "    ".join(data["next"])))
    width = max(len(name) for name, _ in lines)
    for name, words in lines:
        talk.say(f"  {name:<{width}}  {words}")
    return data


def _export(target: Path, given: Mapping[str, Any], talk: common.Talk) -> dict[str, int]:
    """Write the tables beside a log; how many rows each has."""
    from mcaptrack import log
    from mcaptrack.tables.export import default_folder, export

    folder = default_folder(target)
    with log.read(target) as opened:
        exported = export(opened, folder, talk.progress, force=given["force"])
    for words in exported.notes:
        talk.warn(words, "left-out")
    talk.detail(f"{folder}: {', '.join(f'{name} {rows}' for name, rows in exported.rows.items())}")
    return exported.rows


def _lines_of_run(summary: Summary) -> Iterator[tuple[str, str]]:
    """What a log holds, a line a thing: its name, and the words."""
    if summary.boxes is not None:
        where = "" if summary.pictures is None else f" in {summary.pictures:,} pictures"
        yield "boxes", f"{summary.boxes:,}{where}"
    if summary.tracks is not None:
        yield "tracks", f"{summary.tracks:,}"
    if summary.repair is not None:
        done = (("joined", "gaps closed"), ("parted", "taken apart"), ("left_out", "left out"))
        words = ", ".join(f"{getattr(summary.repair, name):,} {word}" for name, word in done)
        count = summary.repair.tracks
        yield "re-tracked", f"{count:,} {'track' if count == 1 else 'tracks'}: {words}"
    if summary.scores is not None:
        (was, now), (before, after) = summary.scores.idf1, summary.scores.switches
        words = f"IDF1 {was:.1%} before re-tracking, {now:.1%} after; identity switches {before:,}, then {after:,}"
        yield "ground truth", f"{words} (matched {summary.scores.by})"
    if summary.forecasts is not None:
        ahead = "" if summary.horizon_s is None else f", {summary.horizon_s:g} s ahead"
        yield "forecasts", f"{summary.forecasts:,}{ahead}"
    if summary.ground_plane == "assumed":
        yield "assumed", "the scale of the ground, from the heights of boxes"


def _lines_of_warnings(report: Report) -> Iterator[tuple[str, str]]:
    codes = [notice.code for notice in report.warnings]
    if codes:
        yield "warnings", f"{len(codes)}, see above: {', '.join(dict.fromkeys(codes))}"


def _lines_of_stage(report: Report) -> Iterator[tuple[str, str]]:
    """What stages made, a line a channel."""
    for topic, rows in report.rows.items():
        tracks = f"{report.tracks[topic]:,} tracks, " if topic in report.tracks else ""
        yield topic, f"{tracks}{rows:,} rows in {report.frames[topic]:,} frames"


_UP_TO_DATE = "nothing to do, everything is up to date"
