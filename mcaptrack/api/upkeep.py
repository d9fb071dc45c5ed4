"""Check and repair logs, and remove channels from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.common import log_file, log_location, log_output, names_of, warnings_about
from mcaptrack.api.declared import Argument, OneOfMany, Option, declared
from mcaptrack.api.options import FILES, EachLog, Force, Output, PathLike, Reports, no_progress, output
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_overwrite
from mcaptrack.location import Location, local_name
from mcaptrack.notices import Notice

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack.log import CheckResult, Finding

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
