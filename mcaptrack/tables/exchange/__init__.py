"""One channel of boxes as a file of another program: MOTChallenge, KITTI, COCO, CVAT, Rerun, or a plain table.

Each format is a module that takes ``ExportedBoxes`` and yields the bytes of the file. What it can't hold is said once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, get_args

from mcaptrack import log
from mcaptrack.choices import ExchangeFormat
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_stream, refuse_overwrite
from mcaptrack.location import Location, local_name
from mcaptrack.registry import find
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.sources.cameras import cameras
from mcaptrack.tables.exchange import cvat, text
from mcaptrack.tables.exchange.boxes import ExportedBoxes, read_boxes
from mcaptrack.tables.exchange.rerun_file import write_recording

__all__ = ["FORMATS", "ExchangeFormat", "WrittenBoxes", "default_file", "ends_with", "write_boxes"]

FORMATS: Final[tuple[ExchangeFormat, ...]] = get_args(ExchangeFormat)
Progress = Callable[[str, int, int], None]


class _Format(NamedTuple):
    """The end of the name of a file, and what it holds beside frames, boxes and ids. The registry says what writes."""

    end: str
    holds: frozenset[str] = frozenset()


_FORMATS: Final[Mapping[str, _Format]] = {
    "mot": _Format(".mot.txt", frozenset({"scores"})),
    "kitti": _Format(".kitti.txt", frozenset({"scores", "names"})),
    "coco": _Format(".coco.json", frozenset({"scores", "names", "observed"})),
    "cvat": _Format(".cvat.xml", frozenset({"names", "observed"})),
    "boxes-csv": _Format(".boxes.csv", frozenset({"scores", "names", "observed", "metres"})),
    "rerun": _Format(".rrd"),
}


@dataclass(frozen=True)
class WrittenBoxes:
    """The channel that was written, its number of rows, and what was left out or assumed."""

    topic: str
    rows: int
    notes: tuple[str, ...]


def default_file(path: Location, form: ExchangeFormat) -> Path:
    """The default file for the boxes of a log: log.mcap -> log.cvat.xml beside it."""
    return local_name(path, _FORMATS[form].end)


def ends_with(form: str) -> str:
    """The end of the name of a file of this format; "" for others."""
    return _FORMATS[form].end if form in _FORMATS else ""


# Which channel of boxes is given to other programs.


#: Below the name of a camera, the best first: re-tracked boxes of every picture before those of the tracker.
_PREFERRED: Final = ("retracks/full", "tracks", "retracks", "detections")


def boxes_topic(opened: log.Log, topic: str | None = None) -> str:
    """The channel with this topic, or the best tracks of the only camera, or else its detections.

    Raises McaptrackError, with the channels that there are, if there is none or if there are several cameras.
    """
    with_boxes = sorted(
        channel.topic
        for channel in log.topics_with_schema(opened, [DETECTIONS.name, TRACKS.name])
        if channel.messages and any(channel.holds(schema) for schema in (DETECTIONS, TRACKS))
    )
    if topic is not None:
        topic = opened.find(topic)
        if topic in with_boxes:
            return topic
        opened.channel(topic)  # says what there is
        raise McaptrackError(f"{opened.path}: {topic} has no detections and no tracks; {_listed(with_boxes)} have")
    if not with_boxes:
        raise McaptrackError(f"{opened.path} has no detections and no tracks to write; run a stage first")
    best: list[str] = []
    for camera in cameras(opened):
        names = (f"{prefix}/{name}" for name in _PREFERRED for prefix in (camera.prefix, *camera.names))
        preferred = next((name for name in names if name in with_boxes), None)
        best += [preferred] if preferred else []
    best = best or with_boxes
    if len(best) > 1:
        raise McaptrackError(f"{opened.path} has boxes in {_listed(best)}; choose one with `topic=`")
    return best[0]


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "no channels"


def write_boxes(
    opened: log.Log,
    output: Path,
    form: ExchangeFormat,
    topic: str | None = None,
    progress: Progress = lambda *_: None,
    *,
    force: bool = False,
) -> WrittenBoxes:
    """Write one channel of boxes as a file.

    Parameters
    ----------
    opened : Log
    output : Path
        The file. It appears when it is complete.
    form : str
        The format.
    topic : str, optional
        The channel; by default the best tracks of the only camera, or its detections.
    progress : callable
        Called with a text, the number of finished rows and their total.
    force : bool
        Whether to replace a file that is there.

    Returns
    -------
    WrittenBoxes

    Raises
    ------
    McaptrackError
        If there is no such channel, if it has no boxes in pixels, if the file exists, or if Rerun is not installed.
    """
    refuse_overwrite(output, force)
    chosen = boxes_topic(opened, topic)
    write: Callable[[ExportedBoxes], Iterator[bytes]] = find("exporter", form).cls
    if form == "rerun":
        rows, notes = write_recording(opened, output, chosen, progress)
        return WrittenBoxes(chosen, rows, tuple(notes))
    boxes = read_boxes(opened, chosen)
    done = 0
    with publish_stream(output) as stream:
        progress("export", 0, len(boxes.frame))
        for part in write(boxes):
            stream.write(part)
            done = min(done + 1, len(boxes.frame))
            progress("export", done, len(boxes.frame))
        progress("export", len(boxes.frame), len(boxes.frame))
    lost = [boxes.left_out(form, _FORMATS[form].holds)]
    lost += [text.describe_mot_numbers(boxes.classes)] if form == "mot" else []
    lost += [text.describe_merged(form, boxes.classes)] if form in ("mot", "kitti") else []
    lost += [cvat.describe_classes(boxes)] if form == "cvat" else []
    return WrittenBoxes(chosen, len(boxes.frame), (*boxes.notes, *(f"{output}: {note}" for note in lost if note)))
