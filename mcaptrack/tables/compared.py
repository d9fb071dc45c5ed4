"""Two files to be compared, tracks and ground truth, as frames; and pairs of files that belong together.

Files with frame numbers are compared by these; tables and files with times of their own, by time.

Letters: N boxes of the ground truth, K boxes of the tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log, tables
from mcaptrack.choices import Point, Role
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.geometry.assignment import solve
from mcaptrack.geometry.boxes import iou
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.log.recording_files import is_mcap
from mcaptrack.notices import warn
from mcaptrack.schema import Frame
from mcaptrack.schema.classes import PERSON
from mcaptrack.schema.framing import split_rows
from mcaptrack.sources.ingest.job import IngestOptions, fitted
from mcaptrack.sources.ingest.label_job import FRAME, Boxes3DJob, LabelJob
from mcaptrack.sources.ingest.labels.frames import Described, described, share_numbers, warn_of_firsts
from mcaptrack.sources.ingest.labels.reading import is_3d, read_homography
from mcaptrack.sources.ingest.labels.roles import ONLY_PEOPLE
from mcaptrack.sources.ingest.labels.table import BoxTable, IgnoredBoxes, LabelFacts
from mcaptrack.sources.ingest.labels.timeline import Placed, label_rows

#: Formats that give the frame number of each row.
_COUNTING: Final = ("mot", "kitti", "parquet")
_ALIKE: Final = 0.5
#: The largest size of a file that can be blank.
_BLANK_BYTES: Final = 4096
_DEFAULTS: Final = IngestOptions()
_EPS: Final = float(np.finfo(float).eps)


@dataclass
class AlignedFiles:
    """Ground truth and tracks as frames at the same times, and notes for people.

    ``classes`` are the names of the classes of the ground truth and of the tracks; ``labelled`` are the frames that
    were labelled, None for all, and how that is known.
    """

    ground_truth: list[Frame]
    tracks: list[Frame]
    notes: list[str] = field(default_factory=list)
    classes: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {})
    labelled: tuple[str | None, str | None] = (None, None)


def pair_files(tracks: Sequence[Path], ground_truths: Sequence[Path]) -> tuple[list[tuple[str, Path, Path]], str]:
    """Pair files of tracks and of ground truth: a name and both paths for each pair, and a note on how they were
    paired.

    Files are paired by names, if these are the same (that of the file or of a folder above: ``SEQ/gt/gt.txt``),
    otherwise in order. Raises McaptrackError if there are not as many of one as of the other, and for logs, which hold
    their own ground truth.
    """
    for path in tracks:
        if is_mcap(path):
            labels = ground_truths[0] if len(ground_truths) == 1 else "LABELS"
            add = call("ingest", labels, role="truth", into=path)
            raise McaptrackError(
                f"{path} is a log, not a file of labels; logs hold their own ground truth: add it with {add}"
            )
    if len(tracks) != len(ground_truths):
        raise McaptrackError(
            f"{len(tracks)} files of tracks and {len(ground_truths)} of ground truth; give one of ground truth for each"
        )
    track_names, ground_truth_names = _names(tracks), _names(ground_truths)
    if len(tracks) == 1:
        return [(tracks[0].stem, tracks[0], ground_truths[0])], ""
    if set(track_names) == set(ground_truth_names):
        truth_by_name = dict(zip(ground_truth_names, ground_truths, strict=True))
        return [(name, path, truth_by_name[name]) for name, path in zip(track_names, tracks, strict=True)], ""
    pairs = list(zip(track_names, tracks, ground_truths, strict=True))
    text = ", ".join(f"{path} with {other}" for _, path, other in pairs)
    return pairs, f"names of tracks and ground truth differ: taken in the order given, {text}"


def _names(paths: Sequence[Path]) -> list[str]:
    """The part of each path that distinguishes it: the name of the file, or of a folder above."""
    parts = [[path.stem, *(folder.name for folder in path.absolute().parents)] for path in paths]
    for level in zip(*parts, strict=False):
        if len(set(level)) == len(paths):
            return list(level)
    return [path.stem for path in paths]


def compare_files(
    tracks: Path, ground_truth: Path, options: IngestOptions = _DEFAULTS, topics: Sequence[str] = ()
) -> AlignedFiles:
    """Tracks and ground truth as frames, read as ``options`` say.

    Classes are those of ``options``, by default people, and of 3D boxes all. Tables have no classes, and are compared
    as a whole. Raises McaptrackError if the files can't be read or compared.
    """
    have_3d = [
        not _is_exported(path) and is_3d(path, options.label_format, options.columns) for path in (tracks, ground_truth)
    ]
    if all(have_3d):
        return _boxes_3d(tracks, ground_truth, options)
    if any(have_3d):
        text = f"{tracks if have_3d[0] else ground_truth} holds 3D boxes, and {tracks if have_3d[1] else ground_truth}"
        raise McaptrackError(f"{text} does not; they can't be compared")
    both: dict[Role, BoxTable] = {
        "truth": _read(ground_truth, "truth", topics, options),
        "tracks": _read(tracks, "tracks", topics, options),
    }
    formats = [labels.format for labels in both.values()]
    if not all(name in _COUNTING for name in formats) and len(set(formats)) > 1:
        if "parquet" in formats:
            raise McaptrackError(f"{tracks} and {ground_truth} share no clock: one counts frames, the other does not")
        files: list[tuple[Role | None, Path]] = [("tracks", tracks), ("truth", ground_truth)]
        with LabelJob(files, _may_lack(options), default_fps=Fraction(1)) as job:
            job.report_assumptions()
            truth, placed = job.placed_frames("truth")
            return AlignedFiles(truth, job.all_frames("tracks"), [], _names_of(both), _labelled(placed))
    for labels in both.values():
        if len(labels.frame) and (least := int(labels.labelled[0])) < labels.first_frame:
            raise McaptrackError(
                f"{labels.path}: its first frame is {least}, before `first_frame={labels.first_frame}`"
            )
    share_numbers(both)
    warn_of_firsts(labels for labels in both.values() if len(labels.frame))
    for text, code in (doubt for labels in both.values() for doubt in labels.doubts):
        warn(text, code)
    notes = [f"{labels.path} also holds {labels.left_out}" for labels in both.values() if labels.left_out]
    if options.fps is not None:
        notes.append("frames are compared by their numbers, whatever the frames per second")
    if options.frames is not None:
        text = "`frames=` with a number of frames changes nothing here: frames are compared by their numbers"
        warn(f"{text}; `frames=':'` says that all were labelled", "option-not-used")
    return _by_number(both, options, notes)


def _labelled(shown: Placed | Described) -> tuple[str | None, str | None]:
    """Which frames were labelled, and how that is known."""
    return (None if shown.ranges is None else str(shown.ranges), shown.by or None)


def _may_lack(options: IngestOptions) -> IngestOptions:
    """Options by which files may lack some of the classes that are wanted."""
    return replace(options, classes=options.classes and replace(options.classes, may_lack=True))


def _names_of(both: Mapping[Role, BoxTable]) -> tuple[Mapping[int, str], Mapping[int, str]]:
    """The names of the classes of ground truth and tracks."""
    return both["truth"].classes, both["tracks"].classes


def _boxes_3d(tracks: Path, ground_truth: Path, options: IngestOptions) -> AlignedFiles:
    """3D boxes of two files, taken as being in one frame of reference."""
    together = replace(_may_lack(options), frame_id=FRAME)
    with Boxes3DJob([("tracks", tracks), ("truth", ground_truth)], together) as job:
        job.report_assumptions()
        classes = _names_of(job.labels)
        ranges = options.frame_ranges
        labelled = (str(ranges), "frames") if ranges else (None, None)
        frames = job.all_frames("truth"), job.all_frames("tracks")
        return AlignedFiles(*frames, job.report.remarks, classes, labelled)


def detections_and_ground_truth(
    detections: Path, ground_truth: Path, options: IngestOptions
) -> tuple[list[Frame], list[Frame], tuple[tuple[int, GroundPlane], ...]]:
    """A file of detections and one of ground truth as frames, at the times that the frame rate gives; and the ground
    plane, if there is one.

    Raises McaptrackError if they can't be read, or if the frame rate is not known.
    """
    with _PairJob([("detections", detections), ("truth", ground_truth)], options) as job:
        if not all(labels.boxes_px is not None for labels in job.labels.values()):
            raise McaptrackError(f"{detections} and {ground_truth} have to hold boxes in pixels, both")
        planes = ((0, job.ground),) if job.ground else ()
        return job.all_frames("detections"), job.all_frames("truth"), planes


class _PairJob(LabelJob):
    """Labels of detections and of ground truth, which may be a table."""

    def read(self, path: Path, role: Role | None) -> BoxTable:
        return _read(path, role, (), self.options) if role == "truth" else super().read(path, role)


def _read(path: Path, role: Role, topics: Sequence[str], options: IngestOptions) -> BoxTable:
    if _is_exported(path):
        return _read_parquet(path, role, topics)
    is_short = role == "tracks" and path.is_file() and path.stat().st_size < _BLANK_BYTES
    if is_short and not path.read_bytes().strip():
        return _no_tracks(path)
    labels = options.read(path, role, replace(options.classes or ONLY_PEOPLE, may_lack=role == "tracks"))
    if options.size is not None and labels.boxes_px is not None:
        labels = fitted(labels, options.size)
    if labels.times_s is not None or labels.is_normalised:
        what = "times instead of frames" if labels.times_s is not None else "boxes in shares of the picture's size"
        raise McaptrackError(f"{path} has {what}; make a log of it with {call('ingest', path)}, and compare that")
    if not labels.has_ids:
        raise McaptrackError(f"{path} has no ids (all are -1); {role} need ids")
    return labels


def _is_exported(path: Path) -> bool:
    """Whether a file is a table of ``mcaptrack export``, and not of other software."""
    if path.suffix.lower() not in (".parquet", ".pq") or not path.is_file():
        return False
    metadata = tables.file_metadata(path, "parquet")
    return metadata is None or "table_version" in metadata  # what can't be read is refused as such a table


def _no_tracks(path: Path) -> BoxTable:
    """A file of tracks without rows: of a tracker that found no people."""
    none = np.empty(0, np.int64)
    kinds = np.empty(0, np.uint32)
    facts = LabelFacts(path, "mot", first_frame=1)
    return BoxTable(
        facts=facts, frame=none, id=none, boxes_px=np.empty((0, 4)), score=np.empty(0), class_id=kinds, role="tracks"
    )


def _read_parquet(path: Path, role: Role, topics: Sequence[str]) -> BoxTable:
    """A table of tracks in the format of ``mcaptrack export``: the rows of one topic."""
    columns = ("topic", "frame", "track_id", "x_px", "y_px", "w_px", "h_px", "x_m", "y_m", "score")
    table = tables.read_columns(path, columns)
    file_topics = sorted(set(table["topic"].tolist()))
    named = [log.find_topic(topic, file_topics, path) for topic in topics]
    wanted = [topic for topic in named if topic in file_topics] or [
        t for t in file_topics if t.endswith("/truth") == (role == "truth")
    ]
    if role == "truth" and not wanted and len(file_topics) == 1:
        wanted = file_topics
    if len(wanted) != 1:
        raise McaptrackError(
            f"{path} holds {', '.join(file_topics) or 'no rows'}; "
            + ("choose one with `topic=`" if wanted else f"none of them is {role}")
        )
    mine = table["topic"] == wanted[0]
    frame, track_id = table["frame"][mine], table["track_id"][mine]
    boxes = np.stack([table[name][mine] for name in columns[3:7]], axis=-1)
    xy_m = np.stack([table["x_m"][mine], table["y_m"][mine]], axis=-1)
    people = np.full(len(frame), PERSON, np.uint32)
    facts = LabelFacts(path, "parquet", labelled=np.unique(frame))
    return BoxTable(
        facts=facts, frame=frame, id=track_id, boxes_px=boxes, xy_m=xy_m, score=table["score"][mine], class_id=people,
        role=role,
    ).in_order()  # fmt: skip


def _by_number(both: dict[Role, BoxTable], options: IngestOptions, notes: list[str]) -> AlignedFiles:
    """The frames with rows in either file that the ground truth describes, by their numbers, both counted from 0."""
    ground_truth, tracks = both["truth"], both["tracks"]
    plane = _plane(options.ground_plane, options.point, ground_truth, tracks)
    numbers_of = {role: labels.frame - labels.first_frame for role, labels in both.items()}
    if len(tracks.frame):
        spans = {role: (int(numbers.min()), int(numbers.max())) for role, numbers in numbers_of.items()}
        (a, b), (c, d) = spans["truth"], spans["tracks"]
        if b < c or d < a:
            spans_as_text = [f"{both[role].path} ({low} to {high})" for role, (low, high) in spans.items()]
            raise McaptrackError(f"the frames of {' and '.join(spans_as_text)} never overlap, counted from 0")
    numbers = np.unique(np.concatenate([*numbers_of.values()]))  # frames without rows do not change any score
    if len(tracks.frame) and tracks.step > ground_truth.step:
        numbers = numbers[(numbers - numbers_of["tracks"][0]) % tracks.step == 0]
    own, at = numbers + ground_truth.first_frame, ground_truth.labelled
    shown = described(ground_truth, "truth", own, at, options.frame_ranges, f"the tracks of {tracks.path}")
    numbers = numbers[shown.pictures]
    frames = {role: _frames(labels, numbers, numbers_of[role], plane, role) for role, labels in both.items()}
    if ground_truth.ignored is not None and ground_truth.boxes_px is not None:
        frames["tracks"], gone = _without_ignored(frames["truth"], frames["tracks"], ground_truth)
        if gone:
            notes.append(f"{gone} boxes of {both['tracks'].path} match labels that don't count; they are ignored")
    return AlignedFiles(frames["truth"], frames["tracks"], notes, _names_of(both), _labelled(shown))


def _plane(path: Path | None, point: Point, ground_truth: BoxTable, tracks: BoxTable) -> GroundPlane | None:
    if path is None:
        return None
    boxes = np.concatenate(
        [np.zeros((1, 4)), *(part.boxes_px for part in (ground_truth, tracks) if part.boxes_px is not None)]
    )
    width, height = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    try:
        return GroundPlane(read_homography(path), int(np.ceil(width)), int(np.ceil(height)), point)
    except McaptrackError as error:
        raise McaptrackError(f"{path}: {error}") from None


def _frames(
    labels: BoxTable, numbers: NDArray[np.int64], row_frames: NDArray[np.int64], plane: GroundPlane | None, role: Role
) -> list[Frame]:
    """The rows of labels in the frames ``numbers``; ``row_frames`` are the frame numbers of all rows, rising."""
    rows = label_rows(labels, role, plane)
    kept = np.isin(row_frames, numbers)
    return split_rows(numbers * NS_PER_S, numbers, rows[kept], np.searchsorted(row_frames[kept], numbers, "right"))


def _without_ignored(
    ground_truth: Sequence[Frame], tracks: Sequence[Frame], labels: BoxTable
) -> tuple[list[Frame], int]:
    """Remove boxes that match labels which don't count, as MOTChallenge and KITTI do; returns their number, too."""
    assert labels.ignored is not None
    ignored = labels.ignored
    order = np.argsort(ignored.frame, kind="stable")
    ignored = _rows(ignored, order)
    at = ignored.frame - labels.first_frame
    out, gone = [], 0
    for true, track in zip(ground_truth, tracks, strict=True):
        low, high = np.searchsorted(at, [true.index, true.index + 1])
        kept = ~_is_ignored(_boxes(true), _boxes(track), _rows(ignored, slice(low, high)), labels.facts.least_height_px)
        gone += int((~kept).sum())
        out.append(track if kept.all() else track._replace(rows=track.rows[kept]))
    return out, gone


def _rows(ignored: IgnoredBoxes, at: slice | NDArray[np.intp]) -> IgnoredBoxes:
    return IgnoredBoxes(ignored.frame[at], ignored.boxes_px[at], ignored.forgiven[at], ignored.region[at])


def _boxes(frame: Frame) -> Floats:
    return np.stack([frame.rows[name] for name in ("x_px", "y_px", "w_px", "h_px")], axis=-1)


def _is_ignored(true: Floats, tracked: Floats, ignored: IgnoredBoxes, least_height_px: float) -> Bools:
    """Mark the boxes of tracks (K,) to ignore, given true boxes (N, 4) and labels that don't count."""
    forgiven = np.zeros(len(tracked), bool)
    if not len(tracked):
        return forgiven
    other = ~ignored.region
    alike = iou(np.concatenate([true, ignored.boxes_px[other]]), tracked)
    alike[alike < _ALIKE - _EPS] = 0
    matched = forgiven.copy()
    if alike.size:
        rows, columns = solve(-alike)
        real = alike[rows, columns] > _EPS
        rows, columns = rows[real], columns[real]
        matched[columns] = True
        of_aside = rows >= len(true)
        forgiven[columns[of_aside]] = ignored.forgiven[other][rows[of_aside] - len(true)]
    if least_height_px:
        forgiven |= ~matched & (tracked[:, 3] <= least_height_px + _EPS)
        for region in ignored.boxes_px[ignored.region]:
            low, high = (
                np.maximum(tracked[:, :2], region[:2]),
                np.minimum(tracked[:, :2] + tracked[:, 2:], region[:2] + region[2:]),
            )
            inside = np.clip(high - low, 0, None).prod(axis=1) > _ALIKE * tracked[:, 2:].prod(axis=1)
            forgiven |= ~matched & inside
    return forgiven
