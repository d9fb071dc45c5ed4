"""Ask about the identities that re-tracking is least sure of, keep the answers in the log, and solve it again."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np

import mcaptrack
from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import log_file, optional_path
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import Camera, PathLike, Reports, no_progress
from mcaptrack.errors import McaptrackError, offer
from mcaptrack.extensions.review import questions as asking
from mcaptrack.extensions.review.crops import crops
from mcaptrack.extensions.review.page import Answer, ReviewServer
from mcaptrack.extensions.review.questions import Question
from mcaptrack.files import unreadable
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.pipeline.write import Made
from mcaptrack.registry import blamed, find
from mcaptrack.schema import DECISIONS, TRACKS, Frame
from mcaptrack.schema.framing import join_frames
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.corrections import ANSWERS
from mcaptrack.sources.sidecar import SidecarChoice, encoding_for
from mcaptrack.viewing.serving import LOOPBACK

_ASKED: Final = "What is asked"
_SERVED: Final = "Page"
#: A judge is never certain: its log odds count up to this.
_MOST_LOG_ODDS: Final = 10.0


@dataclass(frozen=True)
class ReviewResult:
    """The changes that answers made.

    Attributes
    ----------
    answers : dict of str to float
        The probability of yes by question: 1 and 0 of a person, others of a judge.
    identities : tuple of int
        The number of identities before and after.
    rows : int
        The samples that have another identity now.
    run : RunResult or None
        What was made again; None without answers.

    """

    answers: Mapping[str, float]
    identities: tuple[int, int]
    rows: int
    run: mcaptrack.RunResult | None


@dataclass
class Review:
    """Questions about a log, and their answers so far; made by ``mcaptrack.review``.

    A context manager that serves the page that asks.

    Attributes
    ----------
    log : pathlib.Path
    camera : str
    questions : dict of str to Question
        The questions by name, the most valuable first. A name says which input track ends when, and which one begins,
        in seconds of the log: ``31@50.800-32@51.600``.
    answers : dict of str to float
        The probability of yes by question; what is skipped is missing.
    result : ReviewResult or None
        What the answers changed, once the log was solved again (``finish``).
    address : str
        The page that asks, while it is served.

    Examples
    --------
    >>> import mcaptrack
    >>> review = mcaptrack.review("log.mcap", questions=3)
    >>> len(review.questions) <= 3
    True

    """

    log: Path
    camera: str
    questions: Mapping[str, Question]
    solved: asking.Solved = field(repr=False)
    start_ns: int = field(repr=False)
    answers: dict[str, float] = field(default_factory=dict)
    result: ReviewResult | None = None
    address: str = ""
    host: str = field(default=LOOPBACK, repr=False)
    port: int = field(default=0, repr=False)
    #: Set when every question was answered or skipped.
    is_done: threading.Event = field(default_factory=threading.Event, repr=False)
    _touched: set[tuple[int, int, int, int]] = field(default_factory=set, repr=False)
    _server: ReviewServer | None = field(default=None, repr=False)

    def answer(self, name: str, yes: Answer | float) -> None:
        """Keep an answer in the log at once; "skip" takes an earlier one back.

        Parameters
        ----------
        name : str
            The question.
        yes : {"yes", "no", "skip"} or float
            The answer; or the probability of yes.

        Raises
        ------
        McaptrackError
            If there is no such question or answer, or if the log can't be written.

        """
        if name not in self.questions:
            raise McaptrackError(f"{self.log} has no question {name}; {offer(name, list(self.questions))}")
        words: Mapping[Any, float | None] = {"yes": 1.0, "no": 0.0, "skip": None}
        if not isinstance(yes, float) and yes not in words:
            raise McaptrackError(f"the answer to {name} is yes, no or skip, not {yes!r:.40}")
        probability = yes if isinstance(yes, float) else words[yes]
        before = dict(self.answers)
        self._touched.add(self.questions[name].key)
        self.answers.pop(name, None)
        if probability is not None:
            self.answers[name] = probability
        if self.answers != before:
            self._keep()

    def described(self) -> list[dict[str, Any]]:
        """Return the questions as values of JSON: name, probability of yes, decision, rows, and the answer so far."""
        return [
            {
                "name": name,
                "probability": round(question.probability, 3),
                "decided": "yes" if question.decided else "no",
                "rows": question.rows,
                "answer": self.answers.get(name),
            }
            for name, question in self.questions.items()
        ]

    def _keep(self) -> None:
        """Write the answers into the log: those of this review in place of earlier ones to the same questions."""
        with logs.read(self.log, sidecar=SidecarChoice(None)) as opened:
            earlier = asking.read_answers(opened, self.camera)
            kept = [row for row in earlier if not {*asking.keys_of(*row)} & self._touched]
            new = [
                asking.answer_row(self.questions[name], yes, self.solved.samples) for name, yes in self.answers.items()
            ]
            topic = f"{self.camera}/{ANSWERS}"
            frames = asking.in_frames([*kept, *new])
            made = Made.of(DECISIONS, frames, Provenance("review", {}))
            logs.refuse_to_replace_recorded(opened, [topic], "rename it")
            encoding = encoding_for(opened)
            with logs.extend(opened, drop=[topic]) as writer:
                if frames:
                    metadata = made.provenance.to_metadata()
                    number = writer.add_channel(topic, made.record_in(encoding), encoding, metadata, group="review")
                    for t_ns, sequence, payload in made.messages_in(encoding):
                        writer.add_message(number, t_ns, sequence, payload)

    def finish(self, progress: Reports = no_progress) -> ReviewResult:
        """Solve the log again with the answers, and say what they changed."""
        before, run = self.solved.tracks, None
        with logs.read(self.log) as opened:
            topic = f"{self.camera}/retracks"
            if pipeline.is_stale(opened, topic):
                run = mcaptrack.run(self.log, camera=self.camera, tables=False, progress=progress)
        with logs.read(self.log) as opened:
            after = opened.frame_columns(topic, TRACKS)
            self.result = ReviewResult(dict(self.answers), *_changes(before, after), run)
        return self.result

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> Self:
        """Serve the page that asks, from another thread until ``close``.

        Raises
        ------
        McaptrackError
            If the log has no pictures, or if the port is taken.

        """
        with logs.read(self.log) as opened:
            topic = camera_at(opened, self.camera).pictures
            if not topic:
                raise McaptrackError(
                    f"{self.log} has no pictures of {self.camera} to show; `--print` lists the questions, and "
                    "`answers=` takes a file of answers"
                )
            shown = crops(opened, topic, self.solved.samples, [*self.questions.values()])
        self._server = ReviewServer(self, shown)
        self.address = self._server.address
        return self

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._server.close()
            self._server, self.address = None, ""


@declared(
    heading="Improve and repair",
    printed_by="mcaptrack.extensions.review.command:ReviewCommand",
    most_used=("questions", "answers", "judge", "camera"),
)
def review(
    log: Annotated[PathLike, Argument("path", "LOG", "The log.", help="The log.")],
    *,
    questions: Annotated[int, Option(_ASKED, 1, 1000)] = 10,
    answers: Annotated[PathLike | None, Option(_ASKED, metavar="FILE", shown="a page asks")] = None,
    judge: Annotated[str | None, Option(_ASKED, metavar="NAME", shown="a person")] = None,
    camera: Camera = None,
    port: Annotated[int | None, Option(_SERVED, 0, 65535, shown="any that is free")] = None,
    host: Annotated[str, Option(_SERVED)] = LOOPBACK,
    progress: Reports = no_progress,
) -> Review:
    """Answer what re-tracking is least sure of, and solve it again.

    A page shows two tracks and asks whether they are one person, or whether a track is a person, where the answer
    would change most. Keys are y, n, s (skip) and u (undo). Each answer is kept in the log at once, in
    /camera/answers; after the last one, or Ctrl-C, re-tracking is done again, and obeys. `mcaptrack drop` of this
    channel and `mcaptrack run` take all answers back.

    Parameters
    ----------
    questions : int, default 10
        Ask so many questions at most.
    answers : path, optional
        Take answers of a JSON file: yes, no or skip by the name of each question, as `--print --json` gives them.
    judge : str, optional
        Ask this judge of an installed package, or module:Class; it weighs the pictures, and is never certain.
    port : int, optional
        Port to serve the page at.
    host : str, default "127.0.0.1"
        Address to serve it at; 0.0.0.0 lets every machine of the network look and answer.

    Returns
    -------
    Review
        The questions; a context manager that serves the page. With answers or a judge, what they changed.

    Raises
    ------
    McaptrackError
        If the log has no re-tracked tracks with probabilities, or if an answer has no question.

    Examples
    --------
    On the command line:

        mcaptrack review log.mcap

        mcaptrack review log.mcap --print --json

    >>> import mcaptrack
    >>> review = mcaptrack.review("log.mcap")
    >>> for name in review.questions:
    ...     review.answer(name, "skip")
    >>> review.finish().rows
    0

    """
    if answers is not None and judge is not None:
        raise McaptrackError("`answers=` and `judge=` both answer; leave one out")
    path, file = log_file(log), optional_path(answers)
    given = None if file is None else _read(file)
    with logs.read(path) as opened:
        prefix = pipeline.find_camera(opened, camera)
        solved = asking.solve(opened, prefix)
        asked = asking.questions(solved, asking.read_answers(opened, prefix), questions)
        named = {question.name(opened.start_ns): question for question in asked}
        out = Review(path, prefix, named, solved, opened.start_ns, host=host, port=port or 0)
        judged = {} if judge is None else _judged(judge, opened, out)
    for name, yes in {**(given or {}), **judged}.items():
        out.answer(name, yes)
    if given is not None or judge is not None:
        out.finish(progress)
    return out


def _read(file: Path) -> dict[str, Any]:
    """Return the answers in a file. Raises McaptrackError for another file, and for two answers to one question."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        if again := [name for name in names if names.count(name) > 1]:
            raise McaptrackError(f"{file} has two answers to {again[0]}; keep one")
        return dict(pairs)

    try:
        content = json.loads(file.read_bytes(), object_pairs_hook=once)
    except OSError as error:
        raise unreadable(file, error) from None
    except (ValueError, RecursionError):
        raise McaptrackError(f"{file} has no answers: it is not JSON") from None
    if not isinstance(content, dict) or not all(answer in ("yes", "no", "skip") for answer in content.values()):
        raise McaptrackError(f'{file} has no answers; it holds them by question, as in {{"31@50.8-32@51.6": "yes"}}')
    return content


def _judged(name: str, opened: logs.Log, review: Review) -> dict[str, float]:
    """Return the probability of yes that a judge gives for each question about two tracks."""
    entry = find("judge", name)
    judge, topic = entry.made("__call__"), camera_at(opened, review.camera).pictures
    if not topic:
        raise McaptrackError(f"{review.log} has no pictures of {review.camera} for {entry}")
    about = {key: question for key, question in review.questions.items() if question.after}
    out = {}
    for key, (before, after) in zip(about, crops(opened, topic, review.solved.samples, [*about.values()]), strict=True):
        if before and after:
            with blamed(entry, "failed"):
                log_odds = float(judge(before, after))
            if not np.isfinite(log_odds):
                raise McaptrackError(f"{entry} gives {log_odds} as log odds for {key}; give a finite number")
            out[key] = float(1 / (1 + np.exp(-np.clip(log_odds, -_MOST_LOG_ODDS, _MOST_LOG_ODDS))))
    return out


def _changes(before: Sequence[Frame], after: Sequence[Frame]) -> tuple[tuple[int, int], int]:
    """Return the numbers of identities before and after, and of the samples with another one."""
    old, new = (join_frames(TRACKS, frames) for frames in (before, after))
    seen = [joined.rows["source_id"] >= 0 for joined in (old, new)]
    at = find_rows(
        (old.row_ns[seen[0]], old.rows["source_id"][seen[0]]), (new.row_ns[seen[1]], new.rows["source_id"][seen[1]])
    )
    was = np.where(at >= 0, old.rows["track_id"][seen[0]][at], -1)
    pairs, count = np.unique(np.stack([new.rows["track_id"][seen[1]], was]), axis=1, return_counts=True)
    kept = {(name, then): number for name, then, number in zip(*pairs.tolist(), count.tolist(), strict=True)}
    same = 0
    while kept:  # the largest shares first, each identity once
        name, then = max(kept, key=lambda pair: kept[pair])
        same += kept[name, then] if then >= 0 else 0
        kept = {pair: number for pair, number in kept.items() if pair[0] != name and (pair[1] != then or then < 0)}
    gone = int(seen[0].sum()) - int((at >= 0).sum())
    identities = tuple(len(np.unique(joined.rows["track_id"])) for joined in (old, new))
    return (identities[0], identities[1]), len(was) - same + gone
