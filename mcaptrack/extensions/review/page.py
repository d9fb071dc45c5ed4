"""The page that asks: pictures of both sides of a question, a few crops of each, and a key for each answer."""

from __future__ import annotations

import threading
from base64 import b64encode
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, get_args

import numpy as np

from mcaptrack import log
from mcaptrack.extensions.review.questions import Question, Tracklet
from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame, Rows
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing.formatting import policy, render
from mcaptrack.viewing.serving import Page, Server

if TYPE_CHECKING:
    from mcaptrack.extensions.review.api import Review

Answer = Literal["yes", "no", "skip"]
_POLICY: Final = policy("review.js", "connect-src 'self'", __package__ or "")


class ReviewServer(Server):
    """Serves the page of a review to the browsers of this machine, and keeps what it answers.

    An answer is posted to an address with a secret word, that other origins can't know.
    """

    def __init__(self, review: Review, shown: Sequence[Sequence[Sequence[Image]]]) -> None:
        self._review, self._shown = review, shown
        pages = {
            f"{answer}-{number}": Page(partial(review.answer, name, answer), is_action=True)
            for number, name in enumerate(review.questions)
            for answer in get_args(Answer)
        }
        pages["finish"] = Page(review.is_done.set, is_action=True)
        super().__init__(pages, review.port, host=review.host, index=Page(self._index, _POLICY))
        self._thread = threading.Thread(target=self.serve_forever, args=(0.2,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self.shutdown()
        self._thread.join()
        self.server_close()

    def _index(self) -> bytes:
        review = self._review
        asked = []
        for question, shown in zip(review.questions.values(), self._shown, strict=True):
            edges = [(f"from {self._at(question.after.begin_ns)}", shown[1])]
            if question.before:
                edges.insert(0, (f"until {self._at(question.before.end_ns)}", shown[0]))
            sides = [
                {"when": when, "jpegs": [b64encode(encode_image(crop, "jpeg")).decode() for crop in crops]}
                for when, crops in edges
            ]
            asked.append({"text": "Are these one person?" if question.before else "Is this a person?", "sides": sides})
        first = next((n for n, name in enumerate(review.questions) if name not in review.answers), len(asked))
        data = {"root": self.path("").decode(), "questions": asked, "first": first}
        return render("review.html", __package__ or "", title=review.log.name, data=data, policy=_POLICY).encode()

    def _at(self, t_ns: int) -> str:
        return f"{(t_ns - self._review.start_ns) / NS_PER_S:.1f} s"


#: Crops of each side at most, of samples at most so many seconds from the gap.
_CROPS: Final = 4
_WITHIN_NS: Final = 4 * NS_PER_S
#: A crop shows so much around its box, as a share of the box on either side.
_AROUND: Final = 0.25


def crops(
    opened: log.Log, topic: str, samples: Sequence[Frame], asked: Sequence[Question], around: float = 1.0
) -> list[tuple[list[Image], list[Image]]]:
    """The crops of both sides of each question, in order of time: (height, width, 3), blue, green, red.

    Pictures of ``topic`` are decoded once, in order. A question about one tracklet has crops of its whole length after
    the gap. Crops of pictures that can't be decoded are left out. ``around`` is the brightness outside of the box.
    """
    out: list[tuple[list[Image], list[Image]]] = [([], []) for _ in asked]
    times = np.array([frame.t_ns for frame in samples])
    pictures = Pictures(opened, topic)
    wanted: dict[int, list[tuple[list[Image], Rows]]] = {}
    for question, sides in zip(asked, out, strict=True):
        for tracklet, side in zip((question.before, question.after), sides, strict=True):
            if tracklet is None:
                continue
            for number in _chosen(times, tracklet, question):
                rows = samples[number].rows
                shown = int(max(np.searchsorted(pictures.t_ns, times[number], "right") - 1, 0))
                wanted.setdefault(shown, []).append((side, rows[rows["track_id"] == tracklet.source_id]))
    for picture in pictures.readable(wanted):
        for side, rows in wanted[picture.index]:
            boxes = columns_to_boxes(rows)
            if len(boxes) and np.isfinite(boxes).all() and (crop := _crop(picture.rows, boxes[0], around)).size:
                side.append(crop)
    return out


def _chosen(times: Ints, tracklet: Tracklet, question: Question) -> list[int]:
    """The numbers of the samples that are shown of a tracklet."""
    low, high = tracklet.begin_ns, tracklet.end_ns
    if tracklet is question.before:
        low = max(low, high - _WITHIN_NS)
    elif question.before:
        high = min(high, low + _WITHIN_NS)
    inside = np.flatnonzero((times >= low) & (times <= high))
    places = np.linspace(0, len(inside) - 1, min(_CROPS, len(inside))).round().astype(int)
    return [int(number) for number in inside[places]]


def _crop(picture: Image, box: Floats, around: float) -> Image:
    """The part of a picture around a box, darker outside of it."""
    corner, size = box[1::-1], box[:1:-1]  # down, and to the right

    def cut(share: float) -> Ints:
        ends = np.stack([corner - share * size, corner + (1 + share) * size])
        return np.asarray(np.maximum(ends, 0).astype(np.int64) + np.array([[0], [1]]))

    outer, inner = cut(_AROUND), cut(0)
    shown = picture[outer[0, 0] : outer[1, 0], outer[0, 1] : outer[1, 1]]
    (top, left), (bottom, right) = inner - outer[0]
    crop = (shown * around).astype(np.uint8)
    crop[top:bottom, left:right] = shown[top:bottom, left:right]
    return crop
