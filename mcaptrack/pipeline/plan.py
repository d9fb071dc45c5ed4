"""Plan the jobs of a run: the stages that have to run, their order, and the input of each.

Missing inputs are made first. A channel that is out of date, because its input has changed, is made again by the same
transform with the same parameters, or left as it is, with a warning, if that isn't possible.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.plane import is_assumed
from mcaptrack.notices import Say, warn
from mcaptrack.pipeline import motion
from mcaptrack.pipeline.checks import Job, check_inputs, describe_origin, first_stage, main_topic, superseded
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, is_plane_due, warn_unused
from mcaptrack.pipeline.rebuild import MissingPluginError, OlderVersionError, differing, rebuild
from mcaptrack.pipeline.scenes import Scenes
from mcaptrack.pipeline.staleness import changed_source, is_of_corrections, is_stale, read_planes
from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO
from mcaptrack.schema.framing import joined_parts
from mcaptrack.schema.provenance import FUSE, Provenance, frame_id_of
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import holds_calibrations
from mcaptrack.sources.camera_motion import motion_topic
from mcaptrack.sources.cameras import USUAL, camera_at, is_made_by_stage, provenance_of
from mcaptrack.sources.foreign import holds_boxes, reading_of, uncertain_boxes
from mcaptrack.sources.foreign.boxes import is_chosen_otherwise
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.protocol import Space, traits_of


def plan_stage(
    opened: log.Log,
    prefix: str,
    stage: str,
    transform: Transform | None,
    source: str | None = None,
    target: str | None = None,
    keep: tuple[str, ...] | None = None,
    say: Say = lambda _: None,
    defaults: Mapping[str, Transform] = {},
    frame_id: str = "",
    make: Callable[[str], Transform] | None = None,
) -> list[Job]:
    """Plan one stage, even if its channel is up to date, and before it all inputs that are missing or out of date.

    ``source`` and ``target`` are topics that replace the usual ones; ``defaults`` are transforms by stage that replace
    the default ones for missing inputs. ``say`` is called with a line for each job. ``frame_id`` is the frame that 3D
    boxes are brought to. ``make`` makes the transform by the name of the one that suits its input, or the default one
    by "", where ``transform`` is None. Raises McaptrackError if there is no input, or if the stage would replace
    channels that it did not make.
    """
    planner = _Planner(opened, prefix, defaults=defaults, frame_id=frame_id)
    usual = f"{prefix}/{STAGES[stage].output_topic}"
    source = opened.find(source, prefix) if source else planner.source_of(stage)
    planner.ensure(source)
    if transform is None:
        suited = planner.suited_tracker(stage, source)
        transform = make(suited) if make else STAGES[stage].make(suited)
    planner.ensure_motion(transform, source)
    planner.add(Job(stage, transform, source, target or usual, keep, frame_id=frame_id))
    return planner.checked(say)


def plan_all(
    opened: log.Log,
    prefix: str,
    say: Say = lambda _: None,
    source: str | None = None,
    defaults: Mapping[str, Transform] = {},
    force: bool = False,
    chosen: Collection[str] = (),
    shared: Mapping[str, object] = {},
    plane: PlaneChoice = AS_BEFORE,
    frame_id: str = "",
    changed: Collection[str] = (),
    renewed: Collection[str] = (),
) -> list[Job]:
    """Plan the jobs that bring all results of a camera up to date; empty if they are.

    ``source`` is the topic of pictures or of recorded detections to begin with; ``defaults`` as in ``plan_stage``. With
    ``force``, channels that are up to date are made again, too, by the transform in ``defaults`` or else the same one.
    ``shared`` are options of several stages that the user gave ("camera_motion"), where they differ from before.
    ``plane`` says how to make a ground plane where none is given; where it was made otherwise, it is made again.
    ``chosen`` are options that the user gave for ``defaults`` ("tracker"): a channel that was made with another choice
    is made again; so are tracks of 3D boxes in another frame than ``frame_id``, and topics in ``renewed``.
    ``changed`` are topics that were made again already, and are not written yet. Raises McaptrackError as
    ``plan_stage`` does, and if the class that made a channel is not installed.
    """
    source = opened.find(source, prefix) if source else None
    sources = {first_stage(opened, source): source} if source else {}
    changes = dict.fromkeys(changed, True)
    planner = _Planner(opened, prefix, sources, defaults, force, chosen, shared, plane, frame_id, renewed, changes)
    warn_unused(opened, prefix, plane)
    read = {stage.input_topic for stage in STAGES.values()}
    for stage in STAGES.values():
        if stage.output_topic not in read and not stage.on_demand:
            planner.ensure(f"{prefix}/{stage.output_topic}")
    for topic in sorted(camera_at(opened, prefix).topics):  # including results at other topics than the usual ones
        planner.ensure(topic)
    return planner.checked(say)


# Which tracker suits boxes: one for boxes in pictures, or one for positions in metres.


_BOXES: Final = {"picture": "boxes in pixels", "ground": "positions in metres"}


def spaces_of_boxes(opened: log.Log, topic: str) -> frozenset[Space]:
    """Return in which spaces the boxes of a channel are; empty if it has no boxes or isn't there."""
    channel = opened.channels.get(topic)
    if channel is None:
        return frozenset()
    if channel.schema_name != DETECTIONS.name:
        reading = reading_of(opened, topic)
        return frozenset({"ground" if reading and reading.in_space else "picture"})
    if not frame_id_of(channel.metadata) and is_made_by_stage(channel):
        return frozenset({"picture"})
    columns: dict[Space, str] = {"picture": "x_px", "ground": "x_m"}
    spaces_seen = set[Space]()
    for _, _, part in joined_parts(DETECTIONS, opened.frame_columns(topic, DETECTIONS)):
        spaces_seen |= {space for space, column in columns.items() if np.isfinite(part.rows[column]).any()}
        if len(spaces_seen) == len(columns):
            break
    return frozenset(spaces_seen)


def tracker_of(space: str) -> str:
    """Return the name of the first built-in tracker of a space."""
    return next(name for name, cls in STAGES["track"].built_in().items() if traits_of(cls).space == space)


def check_spaces(opened: log.Log, prefix: str, jobs: Sequence[Job], frame_id: str = "") -> None:
    """Raise McaptrackError if a tracker can't take the boxes of its channel.

    Warns if a frame is named and no boxes can be brought to it.
    """
    sources = {job.source for job in jobs if job.source in opened.channels}
    is_calibrated = any(map(holds_calibrations, opened.channels.values()))
    has_boxes = camera_at(opened, prefix).in_space or any(
        holds_boxes(opened, source, in_space=True) for source in sources
    )
    if frame_id and not has_boxes and not is_calibrated:
        warn("`frame=` has no effect: only recorded 3D boxes are brought to a frame", "option-not-used")
    for job in jobs:
        if job.transform.reads is not DETECTIONS or job.transform.writes.get("") is not TRACKS:
            continue
        spaces, space = spaces_of_boxes(opened, job.source), traits_of(job.transform).space
        if spaces and space not in spaces:
            has = " and ".join(_BOXES[name_of_space] for name_of_space in sorted(spaces))
            name, other = STAGES["track"].choice(job.transform), tracker_of(min(spaces))
            raise McaptrackError(
                f"{opened.path}: {job.source} has {has}, and the tracker {name} takes {_BOXES[space]}; "
                f"`tracker={other!r}` takes these"
            )


class _Result(NamedTuple):
    """A channel that a stage made from ``had``, and makes from ``source`` now; ``main`` is its main output.

    ``before`` is the transform that made it, None if it can't be used again, and ``wanted`` that of now: another one
    where ``is_replaced``. ``is_projected`` says that the ground plane is made otherwise now.
    """

    stage: Stage
    topic: str
    main: str
    provenance: Provenance
    had: str
    source: str
    before: Transform | None
    wanted: Transform | None
    is_replaced: bool = False
    is_projected: bool = False


@dataclass
class _Planner:
    """Collects the jobs that make missing channels, and those that are out of date.

    ``sources`` gives inputs and ``defaults`` transforms of stages that differ from the usual ones. With ``force`` all
    stages run, also those that are up to date. A stage also runs if an option in ``chosen`` differs from the one that
    its channel was made with, or one in ``shared``, and if its channel is in ``renewed``. ``changes`` says which
    channels will change.
    """

    opened: log.Log
    prefix: str
    sources: Mapping[str, str] = field(default_factory=dict)
    defaults: Mapping[str, Transform] = field(default_factory=dict)
    force: bool = False
    chosen: Collection[str] = ()
    shared: Mapping[str, object] = field(default_factory=dict)
    plane: PlaneChoice = AS_BEFORE
    frame_id: str = ""
    renewed: Collection[str] = ()
    changes: dict[str, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.jobs: list[Job] = []
        self._gone: set[str] = set()
        self._notes: list[str] = []
        self._unnamed: dict[str, MissingPluginError] = {}
        self._differing: set[str] = set()
        self._is_of_older_version = False

    def checked(self, say: Say) -> list[Job]:
        """Check the jobs and return them; only after that report which run and why."""
        if self._unnamed:
            raise McaptrackError(self._refusal())
        check_inputs(self.opened, self.prefix, self.jobs)
        check_spaces(self.opened, self.prefix, self.jobs, self.frame_id)
        for note in self._notes:
            say(note)
        return self.jobs

    def source_of(self, stage: str) -> str:
        """Return the topic that a stage reads if it has not run before."""
        usual = f"{self.prefix}/{STAGES[stage].input_topic}"
        if STAGES[stage].on_demand and (begun := self._given_pictures()):
            return begun
        if stage in self.sources or usual in self.opened.channels:
            return self.sources.get(stage, usual)
        camera = camera_at(self.opened, self.prefix)
        reads = STAGES[stage].reads
        depth = foreign.depth_of(self.opened, camera.pictures) if camera.pictures else ""
        if reads is VIDEO and camera.pictures:
            if depth:
                text = f"{camera.pictures} has depths ({depth}), in which people are not detected"
                raise McaptrackError(f"{self.opened.path}: {text}; `topic=` looks for them there all the same")
            self._notes.append(f"{usual} is missing: taking the pictures of {camera.pictures}")
            self._notes += self._other_boxes(camera.boxes)
            return camera.pictures
        if reads is DETECTIONS and camera.boxes and (depth or not camera.pictures):
            self._notes.append(f"{usual} is missing: taking the boxes of {camera.boxes}")
            return camera.boxes
        return usual

    def _other_boxes(self, boxes: str | None) -> Iterator[str]:
        """Notes on channels with boxes, or with what may be people, that are not read."""
        if boxes and boxes not in self.sources.values():
            yield f"boxes that others detected are in {boxes}; `topic=` takes them instead"
        for topic, name in uncertain_boxes(self.opened).items():
            yield f"{topic} ({name}) has positions that may be of people; `topic=` takes them instead"

    def suited_tracker(self, stage: str, source: str) -> str:
        """Return the tracker for boxes that the default one can't take; "" for others, and for other stages."""
        if STAGES[stage].kind != "tracker":
            return ""
        spaces = spaces_of_boxes(self.opened, source)
        if not spaces or traits_of(STAGES["track"].default).space in spaces:
            return ""
        name = tracker_of(min(spaces))
        self._notes.append(f"{source} has boxes in space: tracking by {name}")
        return name

    def ensure(self, topic: str) -> bool:
        """Plan the jobs that make ``topic``, if any are needed. Returns whether the topic will change."""
        if topic not in self.changes:
            self.changes[topic] = False  # ends the search at a channel that names itself as an input
            self.changes[topic] = self._plan(topic)
        return self.changes[topic]

    def _plan(self, topic: str) -> bool:
        usual = USUAL.get(topic.removeprefix(self.prefix + "/"), "") if topic.startswith(self.prefix + "/") else ""
        provenance = provenance_of(self.opened, topic)
        if topic not in self.opened.channels:
            sibling = self._sibling(usual, topic)
            return self._make_again(sibling, usual, topic) if sibling else bool(usual) and self._make(usual, topic)
        if provenance is None or provenance.transform not in STAGES:
            if usual in self.sources and topic != self.sources[usual]:
                raise McaptrackError(self._not_made(usual, topic))
            if provenance and "transform" in provenance.plugins:
                self._warn_of_package(provenance, topic)
            return False  # no stage makes recorded and ingested channels
        return self._make_again(provenance, provenance.transform, topic)

    def _warn_of_package(self, provenance: Provenance, topic: str) -> None:
        """Warn of a channel that is, or will be, out of date, if the package with its stage is not installed."""
        changed = [self.ensure(used) for used in (provenance.input, *provenance.references)]
        if any(changed) or is_stale(self.opened, topic):
            plugin = provenance.plugins["transform"]
            package = f"{plugin.distribution} {plugin.version}".strip() or "the package that has it"
            why = f"the stage {provenance.transform} made it, which is not installed; install {package}"
            warn(f"{topic} is out of date and stays as it is: {why}", "out-of-date")

    def _sibling(self, stage: str, topic: str) -> Provenance | None:
        """Return the provenance of another output of the stage that makes ``topic``; None if there is none."""
        topics = STAGES[stage].outputs(main_topic(self.opened, stage, topic)) if stage else ()
        provenances = (provenance_of(self.opened, output) for output in topics)
        return next((provenance for provenance in provenances if provenance and provenance.transform == stage), None)

    def _replace_older(self, provenance: Provenance, stage: str, topic: str) -> bool:
        """With ``force`` plan the stage of a channel of an older version by its defaults; or else say that it stays."""
        if self.force:
            return self._make(stage, topic, f"was made by version {provenance.version}")
        if not self._is_of_older_version:
            self._is_of_older_version = True
            force = call("run", self.opened.path, force=True)
            text = f"made by an older version ({provenance.version}), and left as it is; {force} makes all again"
            warn(f"{topic} was {text}", "out-of-date")
        return False

    def _make(self, stage: str, topic: str, why: str = "is missing") -> bool:
        """Plan the job for a missing channel. Returns True: the channel will change."""
        source = self.source_of(stage)
        self.ensure(source)
        self._notes.append(f"{topic} {why}: running {stage}")
        chosen = self.defaults.get(stage) or self._suited(stage, source) or STAGES[stage].default()
        transform = self._with_choice(chosen)
        self.ensure_motion(transform, source)
        self.add(Job(stage, transform, source, main_topic(self.opened, stage, topic), frame_id=self.frame_id))
        return True

    def _suited(self, stage: str, source: str) -> Transform | None:
        """Create the transform that the maker of a stage's input recommends for the stage; None if it names none."""
        option = STAGES[stage].option
        made_by, maker = self._maker_of(source) or (None, None)
        suited = traits_of(maker).suited(option)
        if made_by is None or maker is None or suited is None:
            name = self.suited_tracker(stage, source)
            return STAGES[stage].make(name) if name else None
        named = f"{made_by.option} {made_by.choice(maker)}"
        parameters, planes = dict(suited.parameters), read_planes(self.opened, self.prefix)
        if planes and not is_assumed(planes):
            parameters |= suited.on_ground
        try:
            transform = STAGES[stage].make(suited.name, **parameters)
        except McaptrackError as error:
            raise McaptrackError(
                f"{made_by.entry(type(maker))} suits {suited.name}, but {error}; `{option}=` chooses another"
            ) from None
        values = ", ".join(f"{key} {value}" for key, value in parameters.items())
        by = suited.name + (f" ({values})" if values else "")
        self._notes.append(f"{stage} by {by}, which suits the {named}; `{option}=` chooses")
        return transform

    def _maker_of(self, topic: str) -> tuple[Stage, Transform] | None:
        """Return the stage and the transform that make a channel now, or made it; None if they aren't known."""
        for job in self.jobs:
            if topic in job.outputs():
                return STAGES[job.stage], job.transform
        how = provenance_of(self.opened, topic)
        if how and how.transform == FUSE:
            return Scenes().maker_of(how)
        maker = self._before(how.transform, how)[0] if how and how.transform in STAGES else None
        return (STAGES[how.transform], maker) if how and maker else None

    def _is_made_by_another(self, topic: str) -> bool:
        """Return whether this run makes a channel by another class of transforms than before."""
        provenance = provenance_of(self.opened, topic)
        jobs = [job for job in self.jobs if topic in job.outputs()]
        if not jobs or provenance is None or provenance.transform not in STAGES:
            return False
        stage, before = STAGES[provenance.transform], self._before(provenance.transform, provenance)[0]
        return before is None or stage.choice(before) != stage.choice(jobs[0].transform)

    def _make_again(self, provenance: Provenance, stage: str, topic: str) -> bool:
        """Plan the stage of a channel again if the channel is missing, out of date, or gets another input now."""
        had = provenance.input or self.source_of(stage)
        source = self.sources.get(stage, had)
        changed = [self.ensure(used) for used in (source, *provenance.references)]
        is_moved = any(changed) or source != had
        if not is_moved and self._is_kept(provenance, stage, topic):
            return False
        before, why_not = self._before(stage, provenance)
        if isinstance(why_not, OlderVersionError):
            return self._replace_older(provenance, stage, topic)
        main = main_topic(self.opened, stage, topic)
        result = self._with_choices(_Result(STAGES[stage], topic, main, provenance, had, source, before, before))
        is_due = is_moved or self._is_due(result)
        if result.is_replaced or self.force:
            return self._run_again(result, result.wanted, why_not, is_due)
        self._warn_settings(result, why_not)
        return is_due and self._run_again(result, before, why_not, is_due)

    def _is_due(self, result: _Result) -> bool:
        """Return whether a channel is missing or out of date, or gets another input, plane or log before now."""
        is_other = result.source != result.had or result.topic in self.renewed or result.is_projected
        return is_other or result.topic not in self.opened.channels or is_stale(self.opened, result.topic)

    def _run_again(
        self, result: _Result, transform: Transform | None, why_not: McaptrackError | None, is_due: bool
    ) -> bool:
        """Plan the stage of a channel with a transform, None if it can't be used; return if the channel will change."""
        stage, topic, source, main = result.stage.name, result.topic, result.source, result.main
        is_missing = topic not in self.opened.channels
        if transform and is_missing and topic not in Job(stage, transform, source, main).kept():
            return False  # a class of another package doesn't make all outputs of the built-in ones
        if source in self._gone or (source not in self.opened.channels and not self.changes[source]):
            warn(f"{topic} stays as it is: {source}, which it was made from, is gone", "out-of-date")
            return False
        if transform is None:
            return self._not_made_again(result, why_not, is_due)
        self.ensure_motion(transform, source)
        self._notes += filter(None, [self._reason(result, transform, is_due)])
        self.add(Job(stage, transform, source, main, self._kept(result, transform), frame_id=self.frame_id))
        return True

    def _is_kept(self, provenance: Provenance, stage: str, topic: str) -> bool:
        """Return whether a channel of the log is up to date, and no option asks for another one.

        Then the transform that made it need not be made again, nor imported.
        """
        is_asked = self.force or self.shared or self.frame_id or stage in self.defaults or topic in self.renewed
        if (
            is_asked
            or is_chosen_otherwise(self.opened, provenance.input)
            or provenance.is_of_older_version
            or provenance.plugins
            or topic not in self.opened.channels
        ):
            return False
        is_usual = main_topic(self.opened, stage, topic) == f"{self.prefix}/{STAGES[stage].output_topic}"
        is_projected = is_usual and "scale" in STAGES[stage].before
        is_projected = is_projected and is_plane_due(self.opened, self.prefix, provenance.input, self.plane)
        return not (is_projected or is_stale(self.opened, topic))

    def _with_choices(self, result: _Result) -> _Result:
        """Return a result with the transform of now; one at another topic than the usual one keeps its parameters."""
        stage, before, frame_id = result.stage, result.before, result.provenance.frame_id
        is_moved = self.frame_id not in ("", frame_id or self.frame_id)
        is_moved |= result.had in self.opened.channels and is_chosen_otherwise(self.opened, result.had)
        if result.main != f"{self.prefix}/{stage.output_topic}":
            return result._replace(is_replaced=is_moved)
        is_open = stage.name not in self.defaults and self._is_made_by_another(result.source)
        suited = self._suited(stage.name, result.source) if is_open else None
        wanted = self._with_choice(self.defaults.get(stage.name, suited or before))
        is_replaced = is_moved or suited is not None or self._is_replaced(stage, before, wanted)
        is_projected = "scale" in stage.before and is_plane_due(self.opened, self.prefix, result.source, self.plane)
        return result._replace(wanted=wanted, is_replaced=is_replaced, is_projected=is_projected)

    def _reason(self, result: _Result, transform: Transform, is_due: bool) -> str:
        """Return why a channel is made again; "" if it is only because all are."""
        stage, topic, source = result.stage, result.topic, result.source
        again = f"running {stage.name} again"
        if topic not in self.opened.channels:
            return f"{topic} is missing: running {stage.name}, as for what it made beside it"
        if source != result.had:
            return f"{topic} was made from {result.had}: {again}, from {source}"
        if result.is_replaced:
            is_other = result.before is None or stage.choice(result.before) != stage.choice(transform)
            others = " or ".join(f"`{name}=`" for name in (*self.shared, "frame", "map", "class_map"))
            return f"{topic} was made {f'by another {stage.option}' if is_other else f'with another {others}'}: {again}"
        if result.is_projected:
            return f"{topic} was made with another ground plane: {again}, as before"
        if topic in self.renewed:
            return f"{topic} goes on from another log: {again}"
        if not is_due or self.force:
            return ""
        if is_of_corrections(self.opened, self.prefix, result.provenance):
            changed = "answers about" if stage.kind == "retracker" else "corrections of"
            return f"{changed} {source} have changed: {again}, as before"
        return f"{topic} was made from an earlier {self._changed(result)}: {again}, as before"

    def _changed(self, result: _Result) -> str:
        """Return the topic that a channel was made from and that this run changes, or that has changed since then."""
        made_again = next((name for name in result.provenance.made_from() if self.changes.get(name)), "")
        return made_again or changed_source(self.opened, result.topic) or result.source

    def _kept(self, result: _Result, transform: Transform) -> tuple[str, ...] | None:
        """Return the outputs that are written: those that the log has, and those that belong beside them."""
        topic, main, channels = result.topic, result.main, self.opened.channels
        beside = result.stage.beside if topic == main or main in channels else ()
        possible = result.before.writes if result.before else (*transform.writes,)[:1]
        keep = tuple(
            suffix
            for suffix in transform.writes
            if f"{main}/{suffix}".rstrip("/") in {topic, *channels}
            or suffix in beside
            or suffix not in possible  # what the former class didn't make is new
        )
        return None if len(keep) == len(transform.writes) else keep

    def _not_made_again(self, result: _Result, why_not: McaptrackError | None, is_due: bool) -> bool:
        """Say that a channel stays as it is, because what made it can't be used. Raises McaptrackError if it has to be.

        Returns whether the channel will change nevertheless, which ``checked`` refuses.
        """
        topic, is_missing = result.topic, result.topic not in self.opened.channels
        if isinstance(why_not, MissingPluginError) and why_not.options:
            self._unnamed[topic] = why_not
            return True
        if is_missing or result.source != result.had or isinstance(why_not, MissingPluginError):
            raise McaptrackError(f"{self.opened.path}: {topic} can't be made from {result.source}: {why_not}")
        why = "is out of date and" if is_due else "is not made again, it"
        warn(f"{topic} {why} stays as it is: {why_not}", "out-of-date" if is_due else "left-out")
        return False

    def _is_replaced(self, stage: Stage, before: Transform | None, wanted: Transform | None) -> bool:
        """Return whether the user chose another class for a stage than the one that made its channel."""
        if any(hasattr(wanted, name) and getattr(before, name, None) != now for name, now in self.shared.items()):
            return True
        if wanted is None or stage.option not in self.chosen:
            return False
        return before is None or stage.choice(before) != stage.choice(wanted)

    def _before(self, stage: str, provenance: Provenance) -> tuple[Transform | None, McaptrackError | None]:
        """Return the transform that made a channel, with the same parameters; or None, and the reason why not."""
        try:
            return rebuild(STAGES[stage], provenance, self.defaults), None
        except McaptrackError as error:
            return None, error

    def _refusal(self) -> str:
        """Return the message for channels that can't be made again: all classes to name, and a call that names them."""
        options: dict[str, Any] = {"force": True} if self.force else {}
        for name, transform in self.defaults.items():
            if (option := STAGES[name].option) and option in self.chosen:
                options[option] = STAGES[name].choice(transform)
        topic_by_fault: dict[str, str] = {}  # by what has to be named, the first channel that it made
        for topic, error in self._unnamed.items():
            topic_by_fault.setdefault(str(error), topic)
            options |= error.options
        why = "; ".join(f"{topic} can't be made again: {error}" for error, topic in topic_by_fault.items())
        again = call("run", self.opened.path, **options)
        return f"{self.opened.path}: {why}, as in {again}; another name replaces what it made"

    def _warn_settings(self, result: _Result, why_not: McaptrackError | None) -> None:
        """Warn, once for all outputs of a stage, that they were made with other settings."""
        main, before, wanted = result.main, result.before, result.wanted
        if wanted is None or main in self._differing:
            return
        if difference := differing(before, wanted) if before else str(why_not):
            self._differing.add(main)
            force = call("run", self.opened.path, force=True)
            warn(f"{main} was made with other settings than now ({difference}); {force} takes these", "other-settings")

    def ensure_motion(self, transform: Transform, source: str) -> None:
        """Plan the motion of the camera if a stage that reads boxes at ``source`` is better with it."""
        pictures = self._given_pictures() or camera_at(self.opened, self.prefix).pictures
        if pictures and motion.is_motion_wanted(self.opened, transform, source, self.jobs):
            count = len(self.jobs)
            self.ensure(motion_topic(self.prefix))
            is_asked = getattr(transform, "camera_motion", "") == "on"
            self.jobs[count:] = [job._replace(is_optional=not is_asked) for job in self.jobs[count:]]

    def _given_pictures(self) -> str:
        """The topic of the pictures that a run begins with, if it was told which."""
        return next((topic for name, topic in self.sources.items() if STAGES[name].reads is VIDEO), "")

    def _with_choice(self, transform: Any) -> Any:
        """Return a transform with those of the shared options that it has."""
        chosen = {name: value for name, value in self.shared.items() if hasattr(transform, name)}
        return replace(transform, **chosen) if chosen else transform

    def add(self, job: Job) -> None:
        """Plan a job, and say which earlier results go because it makes none of them."""
        self.jobs.append(job)
        gone, entry = superseded(self.opened, job), STAGES[job.stage].choice(job.transform)
        self.changes |= dict.fromkeys((*job.kept(), *gone), True)
        self._gone |= {*gone}
        self._notes += [f"{topic} is removed: {job.stage} by {entry} makes none" for topic in gone]

    def _not_made(self, stage: str, topic: str) -> str:
        source = self.sources[stage]
        other = call(stage, self.opened.path, topic=source, to=f"{topic}_again")
        return (
            f"{self.opened.path}: {topic} is there and {describe_origin(self.opened, topic)}; leave `topic=` out to "
            f"go on from it, or run {other}"
        )
