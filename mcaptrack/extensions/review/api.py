"""Ask about the identities that re-tracking is least sure of, keep the answers in the log, and solve it again."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from mcaptrack.extensions.review.page import Answer, ReviewServer, crops
from mcaptrack.extensions.review.questions import Key, Question
from mcaptrack.files import read_json
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.registry import blamed, find
from mcaptrack.schema import DECISIONS, TRACKS, Frame
from mcaptrack.schema.framing import join_frames
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.corrections import ANSWERS
from mcaptrack.sources.sidecar import SidecarChoice
from mcaptrack.viewing.serving import LOOPBACK

_ASKED: Final = "What is asked"
_SERVED: Final = "Page"
#: A judge is never certain: its log odds count up to this.
_MOST_LOG_ODDS: Final = 10.0
#: The brightness of what is around the box in pictures that a person sees.
_AROUND: Final = 0.55
#: A file of answers is at most so large.
_MOST_BYTES: Final = 2**20
_PROBABILITIES: Final[Mapping[str, float | None]] = {"yes": 1.0, "no": 0.0, "skip": None}


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

    def __init__(
        self,
        log: Path,
        camera: str,
        questions: Mapping[str, Question],
        keys: Mapping[str, Key],
        solved: asking.Solved,
        start_ns: int,
        address: tuple[str, int],
    ) -> None:
        self.log, self.camera, self.questions = log, camera, questions
        self.solved, self.start_ns = solved, start_ns
        self.answers: dict[str, float] = {}
        self.result: ReviewResult | None = None
        self.address, (self.host, self.port) = "", address
        self.is_done = threading.Event()  # set when the page says that no more answers follow
        self._keys = keys  # what each question is about: also those that were answered before, and can be again
        self._lock = threading.Lock()
        self._server: ReviewServer | None = None

    def answer(self, name: str, yes: Answer | float) -> None:
        """Keep an answer in the log at once, in place of an earlier one; "skip" takes that back.

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

        Examples
        --------
        >>> import mcaptrack
        >>> review = mcaptrack.review("log.mcap", questions=3)
        >>> for name, question in review.questions.items():
        ...     review.answer(name, "yes" if question.probability > 0.9 else "skip")

        """
        self._keep({name: yes})

    def described(self) -> list[dict[str, Any]]:
        """Describe the questions for JSON.

        Returns
        -------
        list of dict
            Name, probability of yes, decision, number of rows, and the answer so far, of each.

        Examples
        --------
        >>> import mcaptrack
        >>> all(0 <= question["probability"] <= 1 for question in mcaptrack.review("log.mcap").described())
        True

        """
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

    def _keep(self, answers: Mapping[str, Answer | float]) -> None:
        """Write answers into the log, in place of earlier ones to the same questions."""
        kept: dict[str, float | None] = {}
        for name, yes in answers.items():
            if name not in self._keys:
                raise McaptrackError(f"{self.log} has no question {name}; {offer(name, list(self.questions))}")
            if not (isinstance(yes, str) and yes in _PROBABILITIES) and not (isinstance(yes, float) and 0 <= yes <= 1):
                raise McaptrackError(f"the answer to {name} is yes, no, skip or a probability, not {yes!r:.40}")
            kept[name] = _PROBABILITIES[yes] if isinstance(yes, str) else yes
        with self._lock:
            with logs.read(self.log, sidecar=SidecarChoice(None)) as opened:
                opened.lock()
                topic, earlier = f"{self.camera}/{ANSWERS}", asking.read_answers(opened, self.camera)
                new = [(self._keys[name], yes) for name, yes in kept.items()]
                if frames := asking.with_answers(earlier, new, self.solved.samples):
                    made = Made.of(DECISIONS, frames, Provenance("review", {}))
                    write(RunState(opened, self.camera, {topic: made}), None)
                elif earlier:
                    with logs.extend(opened, drop=[topic]):
                        pass
            self.answers = {name: yes for name, yes in {**self.answers, **kept}.items() if yes is not None}

    def finish(self, progress: Reports = no_progress) -> ReviewResult:
        """Solve the log again with the answers.

        Parameters
        ----------
        progress : callable, optional
            Called with the name of a stage, the number of finished steps, and their total.

        Returns
        -------
        ReviewResult
            The changes that the answers made.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.review("log.mcap").finish().rows
        0

        """
        run, topic = None, f"{self.camera}/retracks"
        with self._lock:
            with logs.read(self.log) as opened:
                is_stale = pipeline.is_stale(opened, topic)
            if is_stale:
                run = mcaptrack.run(self.log, camera=self.camera, tables=False, progress=progress)
            with logs.read(self.log) as opened:
                after = opened.frame_columns(topic, TRACKS)
                self.result = ReviewResult(dict(self.answers), *_changes(self.solved.tracks, after), run)
        return self.result

    def __enter__(self) -> Self:
        """Serve the page that asks, from another thread. Raises McaptrackError without pictures, or a free port."""
        with logs.read(self.log) as opened:
            topic = camera_at(opened, self.camera).pictures
            if not topic:
                raise McaptrackError(
                    f"{self.log} has no pictures of {self.camera} to show; `--print` lists the questions, and "
                    "`answers=` takes a file of answers"
                )
            shown = crops(opened, topic, self.solved.samples, [*self.questions.values()], _AROUND)
        self._server = ReviewServer(self, shown)
        self.address = self._server.root
        return self

    def __exit__(self, *_: object) -> None:
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
    """Answer what re-tracking is least sure of, and re-track again.

    A page shows two tracks and asks whether they are one person, or whether a track is a person, where the answer
    would change most. Keys are y, n, s (skip), u (undo) and f (finish). Each answer is kept in the log at
    once, in /camera/answers; after `finish`, or Ctrl-C, re-tracking is done again, and obeys. `mcaptrack drop` of this
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
    given = {} if file is None else read_json(file, "a file of answers", _MOST_BYTES, is_unique=True)
    if not isinstance(given, dict) or not all(isinstance(yes, str) and yes in _PROBABILITIES for yes in given.values()):
        raise McaptrackError(
            f'{file} has no answers; it holds them by question, as yes, no or skip: {{"31@50.800-32@51.600": "yes"}}'
        )
    with logs.read(path) as opened:
        prefix = pipeline.find_camera(opened, camera)
        solved = asking.solve(opened, prefix)
        answered = asking.read_answers(opened, prefix)
        asked = {question.key: question for question in asking.questions(solved, answered, questions)}
        keys = {asking.name_of(key, opened.start_ns): key for key in (*asked, *asking.keys_of(answered))}
        named = {name: asked[key] for name, key in keys.items() if key in asked}
        out = Review(path, prefix, named, keys, solved, opened.start_ns, (host, port or 0))
        given |= {} if judge is None else _judged(judge, opened, out)
    if file is not None or judge is not None:
        out._keep(given)
        out.finish(progress)
    return out


def _judged(name: str, opened: logs.Log, review: Review) -> dict[str, float]:
    """Return the probability of yes that a judge gives for each question about two tracks."""
    entry = find("judge", name)
    judge, topic = entry.made("__call__"), camera_at(opened, review.camera).pictures
    if not topic:
        raise McaptrackError(f"{review.log} has no pictures of {review.camera} for {entry}")
    about = {key: question for key, question in review.questions.items() if question.before}
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
    sides = []
    for joined in (join_frames(TRACKS, frames) for frames in (before, after)):
        is_sample = joined.rows["source_id"] >= 0
        sides.append([joined.row_ns[is_sample], *(joined.rows[name][is_sample] for name in ("source_id", "track_id"))])
    (*key, was), (*new_key, name) = sides
    at = find_rows((key[0], key[1]), (new_key[0], new_key[1]))
    is_both = at >= 0
    pairs, count = np.unique(np.stack([name[is_both], was[at[is_both]]]), axis=1, return_counts=True)
    same, taken = 0, set[tuple[int, int]]()
    for number in np.argsort(-count, kind="stable").tolist():  # the largest shares first, each identity once
        pair = {*enumerate(pairs[:, number].tolist())}
        if not pair & taken:
            same, taken = same + int(count[number]), taken | pair
    rows = len(was) + len(name) - int(is_both.sum()) - same
    return (len(np.unique(was)), len(np.unique(name))), rows
