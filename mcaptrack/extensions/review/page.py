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


class ReviewServer:
    """Serves the page of a review to the browsers of this machine, and keeps what it answers.

    An answer is a request of an address with a secret word, that other origins can't know.
    """

    def __init__(self, review: Review, shown: Sequence[Sequence[Sequence[Image]]]) -> None:
        self._review, self._shown, self._lock = review, shown, threading.Lock()
        self._open = set(review.questions)
        names = [*review.questions]
        answers = {
            f"{answer}-{number}": Page(partial(self._answered, name, answer), kind="text/plain; charset=utf-8")
            for number, name in enumerate(names)
            for answer in get_args(Answer)
        }
        self._server = Server(answers, review.port, host=review.host, index=Page(self._index, _POLICY))
        self.address = self._server.root
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _answered(self, name: str, answer: Answer) -> bytes:
        with self._lock:
            self._review.answer(name, answer)
            self._open.discard(name)
            if not self._open:
                self._review.is_done.set()
        return b"kept"

    def _index(self) -> bytes:
        review = self._review
        asked = []
        for question, sides in zip(review.questions.values(), self._shown, strict=True):
            edges = (question.before.end_ns, question.after.begin_ns) if question.after else (question.before.begin_ns,)
            asked.append(
                {
                    "text": "Are these one person?" if question.after else "Is this a person?",
                    "when": [f"{(t_ns - review.start_ns) / NS_PER_S:.1f} s" for t_ns in edges],
                    "jpegs": [[b64encode(encode_image(crop, "jpeg")).decode() for crop in side] for side in sides],
                }
            )
        data = {"root": self._server.path("").decode(), "questions": asked}
        return render("review.html", __package__ or "", title=review.log.name, data=data, policy=_POLICY).encode()
