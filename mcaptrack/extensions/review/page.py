"""The page that asks: pictures of both sides of a question, and a key for each answer."""

from __future__ import annotations

import threading
from base64 import b64encode
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, get_args

from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import NS_PER_S
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
