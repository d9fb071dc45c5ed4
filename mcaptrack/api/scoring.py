"""Score tracks and predictions against ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api import labels
from mcaptrack.api.common import Notes, as_path, detail, locations_of, names_of, paths_of, warn_unused
from mcaptrack.api.declared import Argument, Option, checked, declared
from mcaptrack.api.options import (
    LABELS,
    SCORES,
    Camera,
    GroundPlane,
    MinIou,
    PathLike,
    PointOfBox,
    Progress,
    Reports,
    gate_m,
    no_progress,
    similarity,
)
from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError, call, offer
from mcaptrack.evaluation import (
    COMBINED,
    DEFAULT_GATES_M,
    FULL,
    Candidate,
    EvaluateOptions,
    EvaluationInput,
    EvaluationRow,
    Labelled,
    sequence_of_files,
    sequence_of_log,
)
from mcaptrack.evaluation import evaluate as score_sequences
from mcaptrack.evaluation.against import Difference, candidates_of_log, differences, repeats
from mcaptrack.evaluation.aligned import IOU_THRESHOLD
from mcaptrack.evaluation.forecasts import smoothed_predictions
from mcaptrack.evaluation.metrics import Rules
from mcaptrack.files import place_of, publish_bytes, refuse_overwrite
from mcaptrack.geometry.arrays import Floats
from mcaptrack.location import Location, distinct_names
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.tables.compared import compare_files, pair_files
from mcaptrack.transforms import STAGES, Predict

#: Ends of names of files of tracks: of tables, which hold several channels, and of all.
_TABLES: Final = (".parquet", ".pq")
_FILES: Final = (".txt", ".csv", *_TABLES)
#: The scores that a limit can be set for.
LIMITS: Final = ("MOTA", "IDF1", "IDP", "IDR", "HOTA", "DetA", "AssA", "LocA", "AMOTA", "sAMOTA")


# The result of an evaluation: its scores, by name, as rows and as curves.


#: What notebooks show of a result: what was compared, and its scores.
_KEYS: Final = ("sequence", "tracks", "similarity", "gate")
_SHOWN: Final = ("HOTA", "MOTA", "IDF1")


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of tracks and predictions against ground truth.

    Attributes
    ----------
    results : tuple of mcaptrack.evaluation.EvaluationRow
        One for each sequence, channel of tracks, similarity and gate; with several sequences also one for all of them
        together, with the ``sequence`` "COMBINED". Where ground truth and tracks have several classes, each is followed
        by one for each class, with the name of the class in ``of_class``.
    notes : tuple of str
        How files were paired and read.
    labelled : dict of str to mcaptrack.evaluation.Labelled
        For each sequence which frames of its ground truth were labelled, and how that is known; others count in no
        score.
    warnings : tuple of mcaptrack.Notice
        What was assumed, and what could not be compared.
    against : str
        The channel that tracks were compared with in place of ground truth; "" if there is ground truth.
    differences : tuple of mcaptrack.evaluation.against.Difference
        How the channels differ by it, each two of them; there are no ``results`` then.

    """

    results: tuple[EvaluationRow, ...]
    notes: tuple[str, ...]
    warnings: tuple[Notice, ...]
    labelled: Mapping[str, Labelled] = field(default_factory=dict)
    against: str = ""
    differences: tuple[Difference, ...] = ()

    def __repr__(self) -> str:
        if self.against:
            return f"Scores(no ground truth; `differences` has {len(self.differences)})"
        return f"Scores({len(self.results)} results; `rows` returns them)"

    def _repr_html_(self) -> str:
        """Return the main scores as a table, for notebooks."""
        cells = [
            [str(row[name]) for name in _KEYS] + [f"{row.get(name, float('nan')):.4f}" for name in _SHOWN]
            for row in self.rows()
        ]
        lines = ["".join(f"<td>{escape(cell)}</td>" for cell in line) for line in cells]
        head = "".join(f"<th>{name}</th>" for name in (*_KEYS, *_SHOWN))
        return f"<table><tr>{head}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"

    def rows(self) -> list[dict[str, Any]]:
        """Return the results as dictionaries, for a ``pandas.DataFrame``.

        Returns
        -------
        list of dict
            One for each result: scores as shares from 0 to 1, counts, lengths in metres.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.evaluate("log.mcap", gate_m=1.0).rows()[0]["sequence"]
        'log'

        """
        return [result.to_json() for result in self.results]

    def score(
        self, name: str, tracks: str = "", similarity: str = "", gate: float | None = None, of_class: str | None = None
    ) -> float:
        """Return one score, of the only result that fits.

        Parameters
        ----------
        name : str
            The score, such as "IDF1".
        tracks : str, optional
            Topic of the tracks, or its end: "retracks" for /camera/retracks.
        similarity : {"iou", "metres", "bev-iou", "3d-iou"}, optional
            How ground truth and tracks were matched.
        gate : float, optional
            Largest distance of a match in metres, or least overlap.
        of_class : str, optional
            Name of a class; by default all classes together.

        Returns
        -------
        float
            The score; with several sequences that of all together.

        Raises
        ------
        McaptrackError
            If no result fits, or more than one.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", gate_m=1.0)
        >>> 0.5 < scores.score("IDF1", "retracks", "metres") <= 1.0
        True

        """
        final = self.final(of_class)
        rows = [row for row in final if row["tracks"].endswith(tracks) and row["similarity"].startswith(similarity)]
        rows = [row for row in rows if gate in (None, row["gate"])]
        whole = [row for row in rows if row["tracks"] == tracks or row["tracks"].endswith(f"/{tracks}")]
        rows = whole or rows
        if len(rows) != 1:
            choices = ", ".join(f"{row['tracks']} {row['similarity']} {row['gate']:g}" for row in rows or final)
            raise McaptrackError(
                f"{len(rows) or 'no'} results fit `tracks={tracks!r}`, `similarity={similarity!r}` and `gate={gate}`; "
                f"choose one of: {choices}"
            )
        _check_name(name, rows[0])
        return float(rows[0][name])

    def final(self, of_class: str | None = None) -> list[dict[str, Any]]:
        """Return the rows of all sequences together.

        Parameters
        ----------
        of_class : str, optional
            Name of a class; by default all classes together.

        Returns
        -------
        list of dict
            Of ``rows``, those of all sequences together, or of the only sequence.

        Raises
        ------
        McaptrackError
            If no such class was scored, or if there is no ground truth.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", gate_m=1.0)
        >>> scores.final() == scores.rows()
        True

        """
        if self.against:
            raise McaptrackError(f"there is no ground truth, only {self.against}: there are differences, and no scores")
        rows = [row for row in self.rows() if row["class"] == of_class]
        if not rows and of_class is not None:
            scored = ", ".join(dict.fromkeys(result.of_class for result in self.results if result.of_class is not None))
            raise McaptrackError(f"no class {of_class!r:.60} was scored by itself; there are {scored or 'none'}")
        return [row for row in rows if row["sequence"] == COMBINED] or rows

    @checked
    def draw_curves(self, output: PathLike, force: bool = False) -> Path:
        """Draw the error of predictions (ADE) over recall, in metres and squared, as an SVG.

        Parameters
        ----------
        output : path
            The file to write.
        force : bool, default False
            Replace the file if it exists.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        McaptrackError
            If no predictions were scored, or if the file exists.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", smoothed=True)
        >>> scores.draw_curves("curves.svg").name
        'curves.svg'

        """
        from mcaptrack.viewing.formatting import curves_svg

        whole = [result for result in self.results if result.of_class is None and result.displacement is not None]
        whole = [result for result in whole if result.sequence == COMBINED] or whole
        displacements = {result.tracks: result.displacement for result in whole if result.displacement is not None}
        if not displacements:
            raise McaptrackError("no predictions were scored; there are no curves to draw")
        path = as_path(output)
        refuse_overwrite(path, force)
        publish_bytes(path, curves_svg(displacements).encode())
        return path

    def below(self, limits: Mapping[str, float]) -> list[str]:
        """Return the scores that are below a limit.

        Parameters
        ----------
        limits : mapping of str to float
            Least scores by name.

        Returns
        -------
        list of str
            A line for each score of ``final`` that is lower.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.evaluate("log.mcap").below({"IDF1": 0.0})
        []

        """
        for name in limits:
            _check_name(name, *self.final()[:1])
        return [
            f"{row['sequence']} {row['tracks']} {row['similarity']} {row['gate']:g}: "
            f"{name} {row[name]:.4f} is under {least:g}"
            for name, least in limits.items()
            for row in self.final()
            if row[name] < least
        ]


def _check_name(name: str, row: Mapping[str, Any]) -> None:
    """Raise McaptrackError if a row has no score of this name."""
    scores = [key for key, value in row.items() if isinstance(value, int | float) and key != "gate"]
    if name not in scores:
        raise McaptrackError(f"there is no score {name}; {offer(name, scores, 'there are')}")


#: Several distances are one text on the command line: 0.5,1,2.
_Gates = Annotated[float | Sequence[float] | Floats, replace(gate_m(), commas=True, tuning=r"[0-9.eE+, -]+")]


@declared(settable=("rules", "smoothed", "point"), heading="Results", printed_by="mcaptrack.cli.evaluate:Evaluate")
def evaluate(
    tracks: Annotated[
        PathLike | Sequence[PathLike],
        Argument("inputs", "LOG|TRACKS", "Logs, folders of logs, patterns, or files of tracks."),
    ],
    *,
    truth: Annotated[PathLike | Sequence[PathLike] | None, Option(LABELS, shown=False)] = None,
    against: Annotated[str | None, Option(SCORES, metavar="TOPIC", shown=False)] = None,
    similarity: Annotated[Similarity | None, similarity("both, as far as there are boxes and metres")] = None,
    gate_m: _Gates = DEFAULT_GATES_M,
    min_iou: MinIou = 0.5,
    rules: Annotated[Rules, Option(SCORES, tuning=True)] = "trackeval",
    smoothed: Annotated[bool, Option(SCORES, tuning=True)] = False,
    topic: Annotated[str | Sequence[str] | None, Option(SCORES)] = None,
    label_format: labels.Format = "auto",
    columns: labels.Columns = None,
    classes: labels.Classes = None,
    class_map: labels.ClassNames = None,
    first_frame: labels.FirstFrame = None,
    frames: labels.LabelledFrames = None,
    fps: labels.LabelFps = None,
    size: labels.Size = None,
    camera: Camera = None,
    ground_plane: GroundPlane = None,
    point: PointOfBox = "foot",
    progress: Reports = no_progress,
) -> Scores:
    """Score tracks and predictions against ground truth.

    Reads /camera/truth and the tracks of a log; or files of tracks, with ``truth``: MOTChallenge (by the rules of
    MOT15, or of MOT16 and later where the truth names classes), KITTI tracking, Parquet as `mcaptrack export` writes
    it, and the label files that `mcaptrack ingest` reads. Distances are on the ground, overlaps are those of boxes.

    Parameters
    ----------
    tracks : path or sequence of paths
        Logs, which hold their ground truth; or, with ``truth``, files of tracks. 3D boxes of files are compared by
        their times.
    truth : path or sequence of paths, optional
        Ground truth for files of tracks: one file for each, matched by name or in order.
    against : str, optional
        Without ground truth, compare trackers of logs, two or more ``topic``, by this channel of offline re-tracking:
        differences only.
    gate_m : float or sequence of float, default (0.5, 1, 2)
        Gate: largest distance in metres at which ground truth and a track match.

        Scores are given for each of several.
    rules : {"trackeval", "motmetrics"}, default "trackeval"
        Rules for counting switches and fragments.
    smoothed : bool, default False
        Of logs: score predictions from smoothed samples, too (SORT + smoothing).

        They are called "samples, smoothed"; the paper names them SORT + smoothing.
    topic : str or sequence of str, optional
        Score these channels; by default tracks, samples, retracks, retracks/online; of 3D boxes retracks/full, too.

    Returns
    -------
    Scores
        A result for each channel, similarity and gate.

    Raises
    ------
    McaptrackError
        If there is no ground truth, or if nothing can be compared.

    Examples
    --------
    On the command line:

        mcaptrack evaluate log.mcap --similarity metres --gate-m 1

        mcaptrack evaluate tracks.txt --truth gt.txt --fail-under idf1=0.7

        mcaptrack evaluate log.mcap --against /camera/retracks/full --topic /a/tracks --topic /b/tracks

    >>> import mcaptrack
    >>> scores = mcaptrack.evaluate("log.mcap", similarity="metres", gate_m=1.0)
    >>> 0.5 < scores.score("IDF1", "retracks") <= 1.0
    True

    """
    topics, notes = names_of(topic), Notes()
    gates = tuple(np.asarray(gate_m, float).reshape(-1).tolist())
    options = EvaluateOptions((similarity,) if similarity else (), gates, min_iou, rules, topics)
    how = labels.label_options(
        label_format=label_format, columns=columns, classes=classes, class_map=class_map, first_frame=first_frame,
        frames=frames, fps=fps, size=size, ground_plane=ground_plane, point=point,
    )  # fmt: skip
    paths = locations_of(tracks)
    if against is not None:
        chosen = {"similarity": similarity is not None, "gate_m": gates != DEFAULT_GATES_M, "smoothed": smoothed}
        chosen |= {"min_iou": min_iou != IOU_THRESHOLD, "rules": rules != "trackeval"}
        return _differences(paths, camera, topics, (against, truth), how, chosen, progress)
    with collected() as warnings:
        if truth is None:
            sequences = _from_logs(paths, camera, topics, smoothed)
        else:
            sequences = _from_files([as_path(path) for path in paths], paths_of(truth), how, topics, notes)
        total, counter = sum(len(sequence.candidates) for sequence in sequences), count()

        def tell(candidate: str) -> None:
            progress("evaluate", next(counter), total)
            detail(candidate)

        outcome = score_sequences(sequences, options, tell)
        progress("evaluate", total, total)
        for note in outcome.notes:
            warn(note, "not-compared")
        if truth is None:
            labels.warn_of_unused(how, "it is about label files; logs have theirs inside", "classes")
            warn_unused("logs are scored by all classes that they have", classes=classes is not None)
        else:
            warn_unused("files of tracks are of no camera", camera=camera is not None)
            warn_unused("files hold no samples with predictions", smoothed=smoothed)
            warn_unused("there is no ground plane", point=point != "foot" and ground_plane is None)
            is_unused = classes is not None and any(map(holds_tables, [*paths, *paths_of(truth)]))
            warn_unused("tables are compared as a whole", classes=is_unused)
            warn_unused("only tables hold several channels", topic=bool(topics) and not any(map(holds_tables, paths)))
        compared = {result.similarity for result in outcome.results}
        if "metres" not in compared:
            warn_unused("nothing is compared by distance on the ground", gate_m=gates != DEFAULT_GATES_M)
        if compared <= {"metres"}:
            warn_unused("nothing is compared by overlap", min_iou=min_iou != IOU_THRESHOLD)
    labelled = {sequence.name: sequence.labelled for sequence in sequences}
    return Scores(tuple(outcome.results), tuple(notes), tuple(dict.fromkeys(warnings)), labelled)


def holds_tables(path: Location) -> bool:
    """Return whether a file is a table of tracks, which may hold several channels."""
    return path.suffix.lower() in _TABLES


def _from_logs(
    paths: Sequence[Location], camera: str | None, topics: tuple[str, ...], smoothed: bool
) -> list[EvaluationInput]:
    sequences = []
    names = distinct_names([path.stem for path in paths], [place_of(path) for path in paths])
    for name, path in zip(names, paths, strict=True):
        if path.suffix.lower() in _FILES:
            raise McaptrackError(f"{path} is not a log; to score a file of tracks give the ground truth with `truth=`")
        with logs.read(path) as opened:
            prefix = pipeline.find_camera(opened, camera)
            sequence = sequence_of_log(opened, prefix, topics)
            _refuse_own(opened, prefix, sequence.ground_truth)
            if how := provenance_of(opened, camera_at(opened, prefix).truth):
                how.warn_again()
            if smoothed:
                sequence.candidates = [*sequence.candidates, _smoothed(opened, prefix)]
            sequence.name = name
            sequences.append(sequence)
    return sequences


def _differences(
    paths: Sequence[Location],
    camera: str | None,
    topics: tuple[str, ...],
    references: tuple[str, Any],
    how: IngestOptions,
    chosen: Mapping[str, bool],
    progress: Progress,
) -> Scores:
    """Compare the channels of tracks of logs by one of them; ``chosen`` says which options of scores were given."""
    against, truth = references
    if truth is not None:
        raise McaptrackError("`against=` compares without ground truth; leave `truth=` out")
    members = []
    with collected() as warnings:
        warn_unused("without ground truth trackers are compared by IDF1 and distance, at one gate", **chosen)
        labels.warn_of_unused(how, "there are no labels", "classes")
        for number, path in enumerate(paths):
            progress("evaluate", number, len(paths))
            with logs.read(path) as opened:
                members.append(candidates_of_log(opened, pipeline.find_camera(opened, camera), against, topics))
        progress("evaluate", len(paths), len(paths))
        compared = tuple(differences(members))
    return Scores((), (), tuple(dict.fromkeys(warnings)), against=against, differences=compared)


def _refuse_own(opened: logs.Log, prefix: str, ground_truth: Sequence[Frame]) -> None:
    """Raise McaptrackError if the ground truth of a log is its own re-tracking."""
    full, retracked, samples = (
        f"{prefix}/{name}" for name in (FULL, STAGES["retrack"].output_topic, STAGES["retrack"].input_topic)
    )

    def is_truth(topic: str) -> bool:
        return topic in opened.channels and repeats(ground_truth, opened.frames(topic, TRACKS))

    for topic in (full, retracked):
        if is_truth(topic) and not is_truth(samples):  # of a drawn scene without noise both may be
            raise McaptrackError(
                f"{opened.path}: the ground truth is {topic} itself, row by row, so scores would say nothing; "
                "`against=` compares other trackers by it"
            )


def _smoothed(opened: logs.Log, prefix: str) -> Candidate:
    """The samples of a log with predictions from their smoothed pasts, by the predictor of its predictions."""
    stage = STAGES["predict"]
    samples, forecasts = (f"{prefix}/{name}" for name in (stage.input_topic, stage.output_topic))
    if forecasts not in opened.channels or samples not in opened.channels:
        raise McaptrackError(f"{opened.path} has no {forecasts}; {call('run', opened.path)} makes them")
    how = Provenance.from_metadata(opened.channel(forecasts).metadata)
    transform = rebuild(stage, how, {}) if how is not None and how.transform == stage.name else None
    if how is None or not isinstance(transform, Predict):
        raise McaptrackError(f"{forecasts} of {opened.path} is recorded: how it was predicted is not known")
    names = class_names(opened.channel(samples).metadata)
    class_of = tuple(names.items())
    rate_hz = float(how.parameters.get("rate_hz", transform.rate_hz))
    frames = opened.frames(samples, TRACKS)
    predictions = list(smoothed_predictions(frames, replace(transform, rate_hz=rate_hz, class_names=class_of)))
    name = f"{samples}, smoothed"
    return Candidate(name, None, frames, predictions, name, classes=names)


def _from_files(
    tracks: Sequence[Path], truths: Sequence[Path], how: IngestOptions, topics: tuple[str, ...], notes: Notes
) -> list[EvaluationInput]:
    pairs, note_on_pairs = pair_files(tracks, truths)
    if note_on_pairs:
        notes.say(note_on_pairs)
    sequences = []
    for name, path, truth in pairs:
        both = compare_files(path, truth, how, topics)
        if holds_tables(truth) and repeats(both.ground_truth, both.tracks):
            raise McaptrackError(
                f"{truth} has the tracks of {path}, row by row, so scores would say nothing; give ground truth, or "
                "compare trackers in a log without it (`against=`)"
            )
        for note in both.notes:
            notes.say(note)
        sequence = sequence_of_files(
            name, path, both.ground_truth, both.tracks, len(pairs), both.classes, both.labelled
        )
        sequences.append(sequence)
    return sequences
