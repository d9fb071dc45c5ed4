"""Check and repair logs, remove channels from them, cut moments out of them, and merge them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.common import locations_of, log_file, log_location, log_output, names_of, warnings_about
from mcaptrack.api.declared import Argument, OneOfMany, Option, declared
from mcaptrack.api.options import FILES, LOGS, EachLog, Force, Output, PathLike, Reports, no_progress, output
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, refuse_overwrite
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.location import Location, local_name
from mcaptrack.notices import Notice, collected

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack.log import CheckResult, Finding, Log

_ONE_LOG: Final = "A log, a folder of logs, a pattern, or - for a list on stdin."
_TOPICS: Final = "Channels to remove, or patterns such as '/camera/*'."


@dataclass(frozen=True)
class LogCheck:
    """The findings in a log.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    files : tuple of mcaptrack.log.CheckResult
        What was found in each file: the log, and LOG.results.mcap if it stands beside it. Each has ``path``,
        ``messages``, ``chunks``, ``findings`` and ``is_sound``.
    warnings : tuple of mcaptrack.Notice
        What looks odd.

    """

    log: Location
    files: tuple[CheckResult, ...]
    warnings: tuple[Notice, ...]

    @property
    def is_sound(self) -> bool:
        """Whether there are no errors."""
        return all(file.is_sound for file in self.files)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Errors, and warnings about what could be better."""
        return tuple(finding for file in self.files for finding in file.findings)


@declared(heading="Improve and repair", printed_by="mcaptrack.cli.files:Check")
def check(log: EachLog, *, progress: Reports = no_progress) -> LogCheck:
    """Check every byte of a log.

    Structure, checksums, indexes, statistics and the order of messages are checked. The exit code is 1 if there are
    errors; warnings are about what could be better. `mcaptrack recover` saves what is intact. Results that stand beside
    a log are checked, too.

    Returns
    -------
    LogCheck
        Whether the log is sound, and what was found.

    Raises
    ------
    McaptrackError
        If there is no file to check. Damage is a finding, not an error.

    Examples
    --------
    On the command line:

        mcaptrack check log.mcap

    >>> import mcaptrack
    >>> mcaptrack.check("log.mcap").is_sound
    True

    """
    from mcaptrack import log as logs

    path = log_location(log)
    with warnings_about(path) as warnings:
        files = [logs.check(path, progress)]  # before its results, so that errors of a store name the log
        results = logs.find_results(path)
        if results is not None:
            files.append(logs.check(results, progress))
    return LogCheck(path, tuple(files), tuple(dict.fromkeys(warnings)))


@dataclass(frozen=True)
class LogRecovery:
    """The result of saving a damaged log.

    Attributes
    ----------
    log : pathlib.Path or str
        The damaged log; the URL of one in a store.
    output : pathlib.Path
        The log with what is intact.
    messages, chunks : int
        Number of messages and chunks that were saved.
    lost : tuple of str
        What was lost.
    warnings : tuple of mcaptrack.Notice
        What looks odd.

    """

    log: Location
    output: Path
    messages: int
    chunks: int
    lost: tuple[str, ...]
    warnings: tuple[Notice, ...]


@declared(heading="Improve and repair", printed_by="mcaptrack.cli.files:Recover")
def recover(
    log: EachLog,
    output: Annotated[PathLike | None, output("LOG.recovered.mcap beside the log")] = None,
    *,
    force: Force = False,
    progress: Reports = no_progress,
) -> LogRecovery:
    """Save what is intact in a damaged log.

    It goes to LOG.recovered.mcap; the damaged log stays unchanged. Every chunk that can be read and has the right
    checksum is copied, with new indexes. What is lost is printed, and the exit code is then 3.

    Returns
    -------
    LogRecovery
        What was saved and what was lost.

    Raises
    ------
    McaptrackError
        If nothing can be saved, or if ``output`` exists.

    Examples
    --------
    On the command line:

        mcaptrack recover broken.mcap -o saved.mcap

    >>> import mcaptrack
    >>> mcaptrack.recover("log.mcap", "saved.mcap").lost
    ()

    """
    from mcaptrack import log as logs

    path = log_location(log)
    target = local_name(path, ".recovered.mcap") if output is None else log_output(output, path)
    refuse_overwrite(target, force)
    with warnings_about(path) as warnings:
        done = logs.recover(path, target, progress)
    return LogRecovery(path, target, done.messages, done.chunks, tuple(done.lost), tuple(dict.fromkeys(warnings)))


@dataclass(frozen=True)
class DropResult:
    """The channels that were removed from a log.

    Attributes
    ----------
    log : pathlib.Path
        The log without the channels.
    dropped : tuple of str
        The topics of the channels that were removed.
    messages : int
        Number of messages that were removed.
    bytes_before, bytes : int
        Size of the log, with its results, before and after.
    warnings : tuple of mcaptrack.Notice
        What looks odd.

    """

    log: Path
    dropped: tuple[str, ...]
    messages: int
    bytes_before: int
    bytes: int
    warnings: tuple[Notice, ...]


@declared(heading="Improve and repair", printed_by="mcaptrack.cli.files:Drop")
def drop(
    log: Annotated[PathLike, OneOfMany("logs", "LOG", _ONE_LOG, is_one=True, help="The log.")],
    topics: Annotated[str | Sequence[str], Argument("topics", "TOPIC", _TOPICS, help=_TOPICS)],
    *,
    output: Output = None,
    in_place: Annotated[bool, Option(FILES)] = False,
    force: Force = False,
) -> DropResult:
    """Remove channels from a log.

    In place, or in a copy; all others stay unchanged, to the byte. Channels that only describe a removed one are
    removed with it: its `/view/`, `/events`, `/counts`, `/errors` and `/scores`. Results that stand beside the log are
    part of it, and of a copy.

    Parameters
    ----------
    in_place : bool, default False
        Also remove recorded channels in place, which nothing can make again.

    Returns
    -------
    DropResult
        What was removed.

    Raises
    ------
    McaptrackError
        If no channel fits one of the topics, or for recorded channels in place.

    Examples
    --------
    On the command line:

        mcaptrack drop log.mcap /camera/video -o small.mcap

    >>> import mcaptrack
    >>> mcaptrack.drop("log.mcap", "/camera/video", output="small.mcap").dropped
    ('/camera/video',)

    """
    from mcaptrack import log as logs

    path, patterns = log_file(log), names_of(topics)
    copy = None if output is None else log_output(output, path)
    if not patterns:
        raise McaptrackError("name the channels to remove with `topics=`")
    if in_place and copy is not None:
        raise McaptrackError("`in_place=True` and `output=` are two places for the same result; give one")
    with warnings_about(path) as warnings:
        with logs.read(path) as opened:
            dropped = _with_descriptions(opened, fitting_topics([opened], patterns))
            parts, before = [Path(part.path) for part in opened.parts], sum(part.size for part in opened.parts)
            if copy is None and not in_place:
                _refuse_recorded(opened, dropped)
        targets = parts
        if copy is not None:
            targets = [copy, logs.results_path(copy)][: len(parts)]
            for target in targets:
                refuse_overwrite(target, force)
        messages = sum(_remove(dropped, part, target) for part, target in zip(parts, targets, strict=True))
        after = sum(target.stat().st_size for target in targets)
    return DropResult(targets[0], tuple(sorted(dropped)), messages, before, after, tuple(dict.fromkeys(warnings)))


def _refuse_recorded(opened: logs.Log, dropped: set[str]) -> None:
    """Raise McaptrackError if channels that no command of this package made are among those to remove."""
    from mcaptrack.schema.provenance import Provenance

    own = [channel for channel in opened.parts[0].recorded if channel.topic in dropped]
    recorded = sorted({channel.topic for channel in own if Provenance.from_metadata(channel.metadata) is None})
    if recorded:
        raise McaptrackError(
            f"{opened.path}: {', '.join(recorded)} {'was' if len(recorded) == 1 else 'were'} recorded, and can't be "
            "made again; `output=` writes a copy without, `in_place=True` removes it all the same"
        )


def _remove(topics: set[str], part: Path, target: Path) -> int:
    """Write a file without some topics to ``target``, which may be the file itself; return the messages removed."""
    from mcaptrack import log as logs

    with logs.read(part, sidecar=False) as opened:
        channels = [channel for channel in opened.recorded if channel.topic in topics]
        if not channels and target == part:
            return 0
        with logs.extend(opened, None if target == part else target, drop=topics):
            pass
    logs.update_listing(target)
    return sum(channel.messages for channel in channels)


def fitting_topics(opened: Sequence[logs.Log], patterns: Sequence[str]) -> set[str]:
    """Return the topics of logs that fit any of the patterns. Raises McaptrackError for a pattern that fits none."""
    chosen: set[str] = set()
    for pattern in patterns:
        is_name = {*"*?["}.isdisjoint(pattern)  # most are, and there may be thousands
        fitting: set[str] = set()
        for each in opened:
            fitting |= {each.find(pattern)} & each.channels.keys()
            fitting |= set() if is_name else {topic for topic in each.channels if fnmatchcase(topic, pattern)}
        if not fitting:
            opened[0].channel(pattern)  # raises, with the channels that there are
        chosen |= fitting
    return chosen


def _with_descriptions(opened: logs.Log, topics: set[str]) -> set[str]:
    """Return the topics with those that only describe one of them."""
    from mcaptrack.foxglove.views import SCENE_SUFFIX
    from mcaptrack.schema.provenance import REFINE
    from mcaptrack.sources.cameras import provenance_of

    made = {topic: how for topic in opened.channels if (how := provenance_of(opened, topic))}
    # The outline of a corrected plane is drawn as the view of the plane that was given.
    planes = {made[topic].input for topic in topics & made.keys() if made[topic].transform == REFINE}
    out = topics | {plane + SCENE_SUFFIX for plane in planes} & made.keys()
    for transform in ("events", "view"):  # in this order: events have views
        out |= {topic for topic, how in made.items() if how.transform == transform and how.input in out}
    return out


_MOMENT: Final = "Moment"


@dataclass(frozen=True)
class CutResult:
    """The new log that ``cut`` wrote.

    Attributes
    ----------
    logs : tuple of pathlib.Path or str
        The logs; URLs of those in a store.
    output : pathlib.Path
        The new log.
    messages : int
        Number of its messages.
    topics : tuple of str
        Its topics.
    earlier : dict of str to int
        By topic, the number of messages from before the start that hold there.
    lost : tuple of str
        What was lost with damaged chunks.
    start_s, end_s : float or None
        The times in seconds of the log from which on and before which messages were taken.
    bytes : int
        Its size.
    warnings : tuple of mcaptrack.Notice
        What looks odd.

    """

    logs: tuple[Location, ...]
    output: Path
    messages: int
    topics: tuple[str, ...]
    earlier: Mapping[str, int]
    lost: tuple[str, ...]
    start_s: float | None
    end_s: float | None
    bytes: int
    warnings: tuple[Notice, ...]


@declared(
    most_used=("output", "start_s", "end_s", "around", "topic", "exclude", "force"),
    heading="Results",
    printed_by="mcaptrack.cli.files:Cut",
)
def cut(
    log: Annotated[PathLike | Sequence[PathLike], Argument("logs", "LOG", LOGS)],
    output: Annotated[PathLike | None, output("LOG.cut.mcap beside the log")] = None,
    *,
    start_s: Annotated[float | None, Option(_MOMENT, 0, 1e9)] = None,
    end_s: Annotated[float | None, Option(_MOMENT, 0, 1e9)] = None,
    around: Annotated[int | None, Option(_MOMENT, 1, 1e9, metavar="EVENT", shown="none")] = None,
    margin_s: Annotated[float, Option(_MOMENT, 0, 1e6)] = 3.0,
    topic: Annotated[str | Sequence[str] | None, Option(FILES, shown="all")] = None,
    exclude: Annotated[str | Sequence[str] | None, Option(FILES, shown="none")] = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> CutResult:
    """Cut a moment out of a log, choose channels, or merge logs.

    What viewers need from before the start is kept: latched messages, transforms, calibrations, ground planes and maps,
    each written again just before the start; and video from its key picture on. Results stay up to date with what they
    were made from. Attachments and metadata are kept.

    Several logs become one: channels with the same topic, schema and metadata are one channel. Results that each log
    has of its own are left out, since their ids mean other people; parts that were cut out of one log are joined with
    their results.

    Parameters
    ----------
    log : path or sequence of paths
        The log, or several to merge.
    output : path, optional
        Write to this file.

        In the working folder if the log is in a store. Several logs need a name.
    start_s : float, optional
        Take messages from this time of the log on, in seconds; by default all.

        Of several logs: seconds from the start of the earliest.
    end_s : float, optional
        Take messages before this time of the log, in seconds; by default all.
    around : int, optional
        Take what is around this event (an identity switch or a repair), by its number as in `mcaptrack view`.
    margin_s : float, default 3
        With ``around``: seconds before the track was lost, and after the event.
    topic : str or sequence of str, optional
        Take these channels only: topics, their ends, or patterns such as '/camera/*'.

        Results bring what they were compared with, and their ground planes.
    exclude : str or sequence of str, optional
        Leave these channels out: topics, their ends, or patterns.

    Returns
    -------
    CutResult
        What was written.

    Raises
    ------
    McaptrackError
        If a log cannot be read, no channel fits, there is nothing at that time, or if ``output`` exists.

    Examples
    --------
    On the command line:

        mcaptrack cut log.mcap -o moment.mcap --start-s 1 --end-s 2.5

        mcaptrack cut log.mcap -o moment.mcap --around 1 --exclude '/camera/retracks*'

        mcaptrack cut front.mcap lidar.mcap -o all.mcap

    >>> import mcaptrack
    >>> mcaptrack.cut("log.mcap", "moment.mcap", end_s=1.0, topic="tracks").topics
    ('/camera/ground_plane', '/camera/tracks')

    """
    from mcaptrack import log as logs
    from mcaptrack.pipeline.cutting import cut as write

    paths = [log_location(path) for path in locations_of(log)]
    if not paths:
        raise McaptrackError("there is no log to cut; give one, or several")
    if output is None and len(paths) > 1:
        raise McaptrackError(f"the log made of {len(paths)} logs needs a name; give one with `output=`")
    target = local_name(paths[0], ".cut.mcap") if output is None else log_output(output)
    _refuse_two_moments(around, start_s, end_s, len(paths))
    with collected() as warnings, ExitStack() as stack:
        opened = [stack.enter_context(logs.read(path)) for path in paths]
        for part in (part for each in opened for part in each.parts):
            if is_same_file(target, part.path):
                raise McaptrackError(f"{part.path} is both input and output; give another name with `output=`")
        refuse_overwrite(target, force)
        if around is not None:
            start_s, end_s = _around(opened[0], around, margin_s)
        span = _span(opened, start_s, end_s)
        topics = _chosen(opened, names_of(topic), names_of(exclude))
        done = write(opened, target, topics, span, progress)
    size, notices = target.stat().st_size, tuple(dict.fromkeys(warnings))
    return CutResult(tuple(paths), target, *done, start_s, end_s, size, notices)


def _refuse_two_moments(around: int | None, start_s: float | None, end_s: float | None, logs: int) -> None:
    if around is not None and (start_s is not None or end_s is not None):
        raise McaptrackError("`around=` and `start_s=` or `end_s=` both say what to cut; leave one out")
    if around is not None and logs > 1:
        raise McaptrackError("`around=` is an event of one log; give one log")


def _span(opened: Sequence[Log], start_s: float | None, end_s: float | None) -> tuple[int | None, int | None]:
    """Return the times in ns between which messages are taken. Raises McaptrackError if there are none."""
    zero_ns = min((each.start_ns for each in opened if each.channels), default=0)
    length_s = (max(each.end_ns for each in opened) - zero_ns) / NS_PER_S
    start_ns, end_ns = (None if s is None else zero_ns + round(s * NS_PER_S) for s in (start_s, end_s))
    if end_s is not None and end_ns is not None and end_ns <= (start_ns or zero_ns):
        raise McaptrackError(f"`end_s={end_s:g}` isn't after `start_s={start_s or 0:g}`")
    if start_s is not None and start_s > length_s:
        raise McaptrackError(f"{opened[0].path} lasts {length_s:.3f} s; there is nothing from {start_s:g} s on")
    return start_ns, end_ns


def _around(opened: Log, number: int, margin_s: float) -> tuple[float, float]:
    """Return the seconds of a log around an event: from before the track was lost. Raises McaptrackError if there is
    none.
    """
    from mcaptrack.viewing.links import event_of, find_moments, seconds_of

    event = event_of(opened, find_moments(opened), number)
    at_s = seconds_of(opened, event.t_ns)
    return max(0.0, at_s - event.unseen_s - margin_s), at_s + margin_s


def _chosen(opened: Sequence[Log], patterns: Sequence[str], excluded: Sequence[str]) -> set[str]:
    """Return the topics of logs that fit a pattern, with what their results need, without those that are excluded."""
    from mcaptrack.pipeline.cutting import needed

    every = {topic for each in opened for topic in each.channels}
    chosen = fitting_topics(opened, patterns) if patterns else {*every}
    for each in opened if patterns else ():
        chosen |= needed(each, chosen)
    chosen -= fitting_topics(opened, excluded)
    if every and not chosen:
        raise McaptrackError("all channels are excluded; `exclude=` has to leave some")
    return chosen
