"""Commands that run stages on logs, and what they print: ``run``, ``events`` (``stages`` has the others)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from mcaptrack.api.declared import Option
from mcaptrack.cli import common
from mcaptrack.cli.chosen import configured
from mcaptrack.cli.command import settings_of
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import counted, stdout_to_stderr, with_flags
from mcaptrack.errors import McaptrackError, command
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import RunResult
    from mcaptrack.pipeline import Summary
    from mcaptrack.pipeline.several import CameraResult

_UP_TO_DATE = "nothing to do, everything is up to date"
#: Parts of a run are listed that take at least this share of its time.
_SLOW_SHARE = 0.05


class RunsStages(EachLog["RunResult"]):
    """A command that runs stages on each log."""

    #: Whether the numbers of events are what is asked for.
    shows_events: ClassVar[bool] = False

    def show(self, log: Location, done: RunResult, talk: common.Talk) -> None:
        """Print what was made, and commands to run next."""
        for topic, count in done.frames.items():
            talk.detail(f"{done.log}: {topic} {count} frames")
        for topic, kinds in done.events.items():
            text = ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count) or "nothing happened"
            (talk.say if self.shows_events else talk.detail)(f"{topic}: {text}")
        if done.tables:
            talk.detail(f"{done.log}: {', '.join(f'{name} {rows}' for name, rows in done.tables.items())}")
        talk.say(f"{done.log}: {_did(done)}")
        is_run = done.summary is not None or done.cameras
        lines = [*_lines_of_run(done)] if is_run else [*_lines_of_stage(done)]
        if done.stages and (slow := _slow_parts(done)):
            lines.append(("time", slow))
        if done.written_because and done.written_to:
            lines.append(("written", f"results are in {done.written_to}: {done.written_because}"))
        lines.append(("next", "    ".join(self.next_commands(done))))
        width = max(len(name) for name, _ in lines)
        for name, text in lines:
            talk.say(f"  {name:<{width}}  {text}")

    def line(self, done: RunResult) -> str:
        """Return the result for one of many logs in one line."""
        parts = [_did(done)]
        if done.cameras:
            parts.append(counted(sum(not camera.is_scene for camera in done.cameras.values()), "camera"))
        if self.shows_events:
            counts = Counter({kind: n for kinds in done.events.values() for kind, n in kinds.items() if n})
            parts.append(", ".join(f"{kind} {count}" for kind, count in counts.items()) or "nothing happened")
        summary = done.summary
        if summary is not None and summary.tracks is not None:
            parts.append(counted(summary.tracks, "track"))
        if done.continued is not None:
            parts.append(done.continued.words()[-1])
        if codes := dict.fromkeys(notice.code for notice in done.warnings):
            parts.append(f"warnings: {', '.join(codes)}")
        return "; ".join(parts)

    def code(self, results: Sequence[RunResult]) -> int:
        """Return the exit code: 3 if no picture of a camera could be decoded."""
        is_lost = any(notice.code == "no-pictures" for done in results for notice in done.warnings)
        return common.LOST if is_lost else common.DONE

    def data(self, done: RunResult) -> dict[str, Any]:
        """Return the result of one log as values of JSON."""
        data: dict[str, Any] = {
            "log": str(done.log),
            "stages": list(done.stages),
            "frames": done.frames,
            "events": done.events,
            **{name: report.data for name, report in done.finished.items()},
            "written_to": str(done.written_to) if done.written_to else None,
            "written_there_because": with_flags(done.written_because) or None,
        }
        if done.cameras:
            data |= {
                "tables": done.tables,
                "summary": None if done.summary is None else done.summary.to_json(),
                "cameras": {name: _camera_as_json(camera) for name, camera in done.cameras.items()},
            }
        elif done.summary is not None:
            data |= {"tables": done.tables, "summary": done.summary.to_json()}
        else:
            data |= {"rows": done.rows, "tracks": done.tracks}
        data |= {"continued": done.continued.to_json()} if done.continued else {}
        data |= {"seconds": done.seconds, "seconds_by_part": dict(done.seconds_by_part)}
        if done.cameras or done.left_out:
            data |= {"left_out": dict(done.left_out), "not_fused": with_flags(done.not_fused) or None}
        return data | {"next": self.next_commands(done)}

    def next_commands(self, done: RunResult) -> list[str]:
        """Return commands to run next."""
        show = "view" if isinstance(done.log, Path) else "report"  # viewers open files
        if done.summary is None and not done.cameras:
            steps = [show] if done.stages == ("events",) else ["run"]
        elif done.summary is None:
            steps = [show if show == "view" else "info"]  # a report is on one camera
        elif not done.summary.tracks:
            steps = ["info"]
        else:
            steps = [show, "evaluate"] if done.summary.scores else [show]
        return [command(step, done.log).strip("`") for step in steps]


class Events(RunsStages):
    """Write events of tracks."""

    shows_events = True


class Run(RunsStages):
    """Run all stages that are missing or out of date."""

    class More:
        """Options that the function has in another form."""

        follows: Annotated[
            bool,
            Option(
                flag="continue",
                help="The logs follow one another, in this order, and are of one camera: people who are in the picture "
                "at a cut keep their ids. One log is done after the other.",
            ),
        ] = False

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: with the transforms that environment and files configure."""
        from mcaptrack.evaluation.events import EventOptions
        from mcaptrack.transforms import STAGES

        arguments = super().arguments(names)
        named = {str(stage.option): arguments.pop(stage.option) for stage in STAGES.values() if stage.option}
        chosen = {kind: name for kind, name in named.items() if name}
        with stdout_to_stderr():
            settings, stages = settings_of("events"), configured(chosen)
        arguments |= {s.option: stages.pop(s.name) for s in STAGES.values() if s.option in chosen}
        if self.values["follows"]:
            arguments["follows"] = self._in_order()
        watched = EventOptions(*(settings.get(name) for name in ("similarity", "gate_m", "min_iou")))
        return arguments | {"events": watched if arguments["events"] else False, "stages": stages}

    def _in_order(self) -> list[Location]:
        """Return logs that follow one another, as they were named.

        Raises McaptrackError for one log alone, and for options that don't go with an order.
        """
        many, logs = self.many, [log.path for log in self.inputs]
        order, place = "one log is done after the other", "ids go on in the logs themselves"
        refused: dict[str, tuple[object, str]] = {
            "--jobs": ((many.jobs or 1) > 1, order),
            "--ledger": (many.ledger, "it judges each log by itself, and a second run does only what is missing"),
            "--output": (self.values["output"], place),
        }
        for name, (is_given, why) in refused.items():
            if is_given:
                raise McaptrackError(f"--continue doesn't go with {name}: {why}; leave {name} out")
        if len(logs) < 2:
            raise McaptrackError("--continue needs several logs, in the order of their times; name the one before, too")
        return logs


def _camera_as_json(camera: CameraResult) -> dict[str, Any]:
    """Return the result for one of several cameras as values of JSON."""
    counts = {"frames": camera.frames, "rows": camera.rows, "tracks": camera.tracks}
    return {"is_scene": camera.is_scene, "stages": list(camera.stages), **counts, "summary": camera.summary.to_json()}


def _did(result: RunResult) -> str:
    """Return the stages that ran, and how long they took."""
    if result.stages:
        return f"{', '.join(dict.fromkeys(result.stages))} in {result.seconds:.1f} s"
    again = [*(path.name for path in result.layouts), *(["tables"] if result.written_tables else [])]
    return f"the log is up to date; made again from it: {', '.join(again)}" if again else _UP_TO_DATE


def _slow_parts(result: RunResult) -> str:
    """Return how long the slow parts of a run took, the slowest first; "" for a run of less than a second."""
    if result.seconds < 1:
        return ""
    slow = sorted(result.seconds_by_part.items(), key=lambda part: -part[1])
    return ", ".join(f"{name} {seconds:.1f} s" for name, seconds in slow if seconds >= _SLOW_SHARE * result.seconds)


def _lines_of_run(result: RunResult) -> Iterator[tuple[str, str]]:
    """Yield a line for each part of the result of ``run``: its name and its text."""
    for name, camera in result.cameras.items():
        if not camera.is_scene:
            yield name, _line_of_camera(camera)
    for name, why in result.left_out.items():
        yield name, f"left out: it {with_flags(why)}"
    if result.cameras:
        scenes = [f"{name}, the scene" for name, camera in result.cameras.items() if camera.is_scene]
        yield "fused", ", ".join(scenes) or f"no: {with_flags(result.not_fused)}"
    if result.summary is not None:
        yield from _lines_of_summary(result.summary)
    for name, report in result.finished.items():
        yield name, report.text
    for line in result.continued.words() if result.continued else ():
        yield "goes on", line
    codes = [notice.code for notice in result.warnings]
    if codes:
        yield "warnings", f"{len(codes)}, see above: {', '.join(dict.fromkeys(codes))}"


def _line_of_camera(camera: CameraResult) -> str:
    """Return what was made of one of several cameras, in one line."""
    summary, parts = camera.summary, []
    if summary.pictures is not None:
        parts.append(f"{summary.pictures:,} pictures")
    if summary.boxes is not None:
        parts.append(f"{summary.boxes:,} boxes")
    if summary.tracks is not None:
        parts.append(counted(summary.tracks, "track"))
    if summary.repair is not None:
        parts.append(f"{summary.repair.tracks:,} after re-tracking")
    if summary.appearance is not None:
        parts.append(f"colours {'' if summary.appearance.used else 'not '}compared")
    if summary.scores is not None:
        parts.append(f"IDF1 {summary.scores.idf1[1]:.1%}")
    if summary.ground_plane is not None:
        parts.append(f"ground plane {summary.ground_plane}")
    return ", ".join(parts)


def _lines_of_summary(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield a line for each part of a summary: its name and its text."""
    if summary.boxes is not None:
        where = "" if summary.pictures is None else f" in {summary.pictures:,} pictures"
        frame = "" if summary.frame_id is None else f", tracked in the frame {summary.frame_id}"
        yield "boxes", f"{summary.boxes:,}{where}{frame}"
    if summary.tracks is not None:
        yield "tracks", f"{summary.tracks:,}"
    if summary.corrected is not None:
        count, tracks, pictures = summary.corrected.boxes, summary.corrected.tracks, summary.corrected.pictures
        yield "corrected", f"{count:,} boxes of {tracks:,} tracks by people, in {pictures:,} pictures"
    if summary.repair is not None:
        repair = summary.repair
        text = f"{counted(repair.joined, 'gap')} closed, {repair.parted:,} split, {repair.left_out:,} left out"
        yield "re-tracked", f"{counted(repair.tracks, 'track')}: {text}"
    if summary.appearance is not None and summary.appearance.separation is None:
        yield "colours", "not compared: too few people were seen well before and after gaps"
    elif summary.appearance is not None:
        looks, share = summary.appearance, f"{summary.appearance.separation:.0%}"
        over = counted(looks.tracks, "track")
        text = f"compared: two people differ more than one does in {share} of cases ({over})"
        no = f"not compared: two people differ more than one does in only {share} of cases ({over})"
        yield "colours", text if looks.used else no
    if summary.scores is not None:
        (was, now), (before, after) = summary.scores.idf1, summary.scores.switches
        text = f"IDF1 {was:.1%} before re-tracking, {now:.1%} after; identity switches {before:,}, then {after:,}"
        yield "ground truth", f"{text} (matched {summary.scores.by})"
    if summary.forecasts is not None:
        ahead = "" if summary.horizon_s is None else f", {summary.horizon_s:g} s ahead"
        yield "forecasts", f"{summary.forecasts:,}{ahead}"
    if summary.camera_motion is not None:
        yield "camera", f"{summary.camera_motion}"
    if summary.ground_plane == "assumed":
        yield "assumed", "the scale of the ground, from the heights of boxes"
    if summary.ground_plane == "estimated":
        yield "estimated", "the ground plane, from the boxes of people"


def _lines_of_stage(result: RunResult) -> Iterator[tuple[str, str]]:
    """Yield a line for each channel that was written: its topic and its size."""
    for topic, rows in result.rows.items():
        tracks = f"{result.tracks[topic]:,} tracks, " if topic in result.tracks else ""
        yield topic, f"{tracks}{rows:,} rows in {result.frames[topic]:,} frames"
