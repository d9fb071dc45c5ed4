"""Cut moments out of logs, merge logs, and choose channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.common import locations_of, log_location, log_output, names_of
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import FILES, LOGS, Force, PathLike, Reports, no_progress, output
from mcaptrack.api.upkeep import fitting_topics
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, refuse_overwrite
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.location import Location, local_name
from mcaptrack.notices import Notice, collected

if TYPE_CHECKING:
    from mcaptrack.log import Log

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
