"""List the channels of a log, and how they were made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from math import degrees
from typing import TYPE_CHECKING, Any, Literal

from mcaptrack.api.common import as_location, warnings_about
from mcaptrack.api.declared import declared
from mcaptrack.api.options import EachLog
from mcaptrack.location import Location
from mcaptrack.notices import Notice, warn

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack.geometry.transform_tree import TransformSeries
    from mcaptrack.schema.provenance import Provenance


@dataclass(frozen=True)
class ChannelInfo:
    """A channel of a log, and how it was made.

    Attributes
    ----------
    topic : str
        Its topic.
    id : int
        Its number in the file.
    part : {"log", "results"}
        Whether it is in the log or in LOG.results.mcap beside it.
    replaced : bool
        Whether the results beside the log have a channel that replaces it.
    schema, encoding : str
        Name of its schema, and encoding of its messages.
    messages : int
        Number of messages.
    rate_hz : float or None
        Messages per second of the log; None for less than two messages, and for a log without length.
    transform, input, version : str or None
        What made it, from which channel, and with which version of mcaptrack; None if it was recorded by others.
    written_by : str or None
        The program that wrote it with ``Recording.write``; None for other channels.
    boxes : dict
        How boxes of other software that it was made from were read: their clock, classes, scale and fields, and what
        was chosen with ``map`` and ``class_map``; empty for other channels.
    plugins : dict or None
        Classes of other packages that made it, by the part that each is (transform, predictor): name, implementation,
        distribution and version.
    references : dict or None
        Topics that it was compared with, with their digests.
    parameters : dict or None
        The options it was made with.
    frame : str or None
        The frame of reference of its metres, for channels of mcaptrack that have one.
    stale : bool
        Whether it is out of date, because what it was made from has changed.
    camera : str or None
        The name of the camera, or of the scene of several cameras, that its pictures, boxes, tracks or views belong to.

    """

    topic: str
    id: int
    part: Literal["log", "results"]
    replaced: bool
    schema: str
    encoding: str
    messages: int
    rate_hz: float | None
    transform: str | None
    input: str | None
    version: str | None
    references: Mapping[str, str] | None
    plugins: Mapping[str, Mapping[str, str]] | None
    parameters: Mapping[str, Any] | None
    frame: str | None
    stale: bool
    camera: str | None = None
    written_by: str | None = None
    boxes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameInfo:
    """A frame of reference that a log has transforms of, and how it moves in its parent.

    Attributes
    ----------
    frame : str
        Its name.
    parent : str or None
        The frame that its poses are in; None for a root. The fields below are then None, 0 or empty.
    static : bool or None
        Whether it never moves in its parent: its transforms hold for all times.
    messages : int
        Number of its transforms.
    rate_hz : float or None
        Number of transforms in a second, from the usual time between two; None if it is static.
    start_ns, end_ns : int or None
        Stamps of the first and last transform, in nanoseconds.
    gaps : tuple of dict
        Times without transforms, over which it is not interpolated: ``start_ns``, ``end_ns``.
    jumps : tuple of dict
        Steps far beyond the speed around them, as when a localisation is reset: ``t_ns``, ``distance_m``,
        ``angle_deg``.
    namespace : str
        The namespace of its robot, as in "/robot1/", if several have frames of the same names.

    """

    frame: str
    parent: str | None = None
    static: bool | None = None
    messages: int = 0
    rate_hz: float | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    gaps: tuple[Mapping[str, int], ...] = ()
    jumps: tuple[Mapping[str, float], ...] = ()
    namespace: str = ""


@dataclass(frozen=True)
class LogInfo:
    """The contents of a log.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    bytes : int
        Its size.
    start_ns, end_ns : int
        Time of the first and last message, in nanoseconds.
    results : pathlib.Path, str or None
        The file with its results, if it stands beside the log.
    messages : int
        Number of messages.
    attachments : tuple of str
        Names of its attachments.
    channels : tuple of ChannelInfo
        Its channels by topic.
    frames : tuple of FrameInfo or None
        Its frames of reference, each after its parent; None unless they were asked for.
    warnings : tuple of mcaptrack.Notice
        What looks odd.

    """

    log: Location
    bytes: int
    start_ns: int
    end_ns: int
    results: Location | None
    messages: int
    attachments: tuple[str, ...]
    channels: tuple[ChannelInfo, ...]
    frames: tuple[FrameInfo, ...] | None
    warnings: tuple[Notice, ...]

    def __repr__(self) -> str:
        return f"LogInfo({str(self.log)!r}, {len(self.channels)} channels, {self.messages} messages)"

    def to_json(self) -> dict[str, Any]:
        """Return all but the warnings as values of JSON.

        Returns
        -------
        dict
            What ``mcaptrack info --json`` prints for a log.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.info("log.mcap").to_json()["log"]
        'log.mcap'

        """
        results = str(self.results) if self.results else None
        out = asdict(self) | {"log": str(self.log), "results": results, "attachments": list(self.attachments)}
        del out["warnings"]
        return out | {"channels": list(out["channels"]), "frames": None if self.frames is None else list(out["frames"])}


@declared(heading="Start here", printed_by="mcaptrack.cli.show:Info")
def info(log: EachLog, *, frames: bool = False) -> LogInfo:
    """Show the channels of a log, and what was made from what.

    Those of each camera are together, if there are several, under its name. Reads the summary only, unless ``frames``
    asks for more. On the command line -v shows also the parameters that channels were made with.

    Parameters
    ----------
    frames : bool, default False
        Also read the transforms between frames of reference, and draw the tree of frames.

    Returns
    -------
    LogInfo
        What is in it.

    Raises
    ------
    McaptrackError
        If it is no log, or damaged.

    Examples
    --------
    On the command line:

        mcaptrack info log.mcap

        mcaptrack info robot.mcap --frames

    >>> import mcaptrack
    >>> made = {channel.topic: channel.transform for channel in mcaptrack.info("log.mcap").channels}
    >>> made["/camera/tracks"]
    'track'
    >>> mcaptrack.info("log.mcap", frames=True).frames
    ()

    """
    from mcaptrack import log as logs
    from mcaptrack.sources.cameras import names_by_topic

    path = as_location(log)
    with warnings_about(path) as warnings, logs.read(path) as opened:
        if logs.clock_jumps(opened):
            from mcaptrack.pipeline import warn_clock_jumps

            warn_clock_jumps(opened)
        every = [(channel, part) for part in opened.parts for channel in part.recorded]
        every.sort(key=lambda pair: (pair[0].topic, pair[1] is opened, pair[0].id))
        names = names_by_topic(opened)
        channels = tuple(_channel(opened, part, channel, names.get(channel.topic)) for channel, part in every)
        return LogInfo(
            log=path,
            bytes=opened.size,
            start_ns=opened.start_ns,
            end_ns=opened.end_ns,
            results=opened.results.path if opened.results else None,
            messages=sum(sum(part.index.counts.values()) for part in opened.parts),
            attachments=tuple(listed.name for part in opened.parts for listed in part.index.attachments),
            channels=channels,
            frames=tuple(_frames(opened)) if frames else None,
            warnings=tuple(dict.fromkeys(warnings)),
        )


def _channel(opened: logs.Log, part: logs.Log, channel: logs.Channel, camera: str | None) -> ChannelInfo:
    from mcaptrack.schema.provenance import Provenance, frame_id_of

    provenance = Provenance.from_metadata(channel.metadata)
    replaced = opened.part(channel.topic) is not part
    return ChannelInfo(
        topic=channel.topic,
        id=channel.id,
        part="log" if part is opened else "results",
        replaced=replaced,
        schema=channel.schema_name,
        encoding=channel.message_encoding,
        messages=channel.messages,
        rate_hz=_rate(opened, channel.messages),
        transform=provenance.transform if provenance else None,
        input=provenance.input or None if provenance else None,
        version=provenance.version if provenance else None,
        references=dict(provenance.references) if provenance else None,
        plugins={part: plugin._asdict() for part, plugin in provenance.plugins.items()} if provenance else None,
        parameters=dict(provenance.parameters) if provenance else None,
        frame=frame_id_of(channel.metadata) or None,
        stale=not replaced and _is_stale(opened, channel.topic, provenance),
        camera=camera,
        written_by=provenance.written_by or None if provenance else None,
        boxes=dict(provenance.boxes) if provenance else {},
    )


def _is_stale(opened: logs.Log, topic: str, provenance: Provenance | None) -> bool:
    """Return whether a channel is out of date. Only one that was made of others can be: others need no pipeline."""
    if provenance is None or not (provenance.input or provenance.references):
        return False
    from mcaptrack.pipeline import is_stale

    return is_stale(opened, topic)


def _rate(opened: logs.Log, messages: int) -> float | None:
    """Return the messages per second of a log, rounded: the summary holds no times of a single channel."""
    from mcaptrack.geometry.clocks import NS_PER_S

    span_ns = opened.end_ns - opened.start_ns
    return round((messages - 1) / (span_ns / NS_PER_S), 3) if messages > 1 and span_ns > 0 else None


def _frames(opened: logs.Log) -> Iterator[FrameInfo]:
    """Yield the frames of a log, each after its parent, and warn of transforms that contradict or are missing."""
    from mcaptrack.sources.fixed_frame import namespaces_of, read_frames

    for namespace in namespaces_of(opened):
        read = read_frames(opened, namespace)
        for why in read.unread:
            warn(why, "lost")
        for remark in read.tree.remarks if read.tree else ():
            warn(f"{opened.path}: transforms: {remark.text}", "transforms")
        waiting = read.tree.roots()[::-1] if read.tree else []
        while read.tree and waiting:
            frame = waiting.pop()
            yield replace(_frame(frame, read.tree.series.get(frame)), namespace=namespace)
            waiting += read.tree.children_of(frame)[::-1]


def _frame(frame: str, series: TransformSeries | None) -> FrameInfo:
    if series is None:
        return FrameInfo(frame)
    t_ns = series.t_ns.tolist()
    sizes = zip(*series.step_sizes(series.jumps), strict=True)
    return FrameInfo(
        frame,
        series.parent,
        series.is_static,
        series.messages,
        None if series.is_static else round(1 / series.interval_s, 3),
        t_ns[0],
        t_ns[-1],
        tuple({"start_ns": t_ns[step], "end_ns": t_ns[step + 1]} for step in series.gaps.tolist()),
        tuple(
            {"t_ns": t_ns[step + 1], "distance_m": round(float(moved), 6), "angle_deg": round(degrees(turned), 6)}
            for step, (moved, turned) in zip(series.jumps.tolist(), sizes, strict=True)
        ),
    )
