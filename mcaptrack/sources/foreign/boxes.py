"""Convert boxes of other detectors to rows of detections, and their class names to class ids.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from itertools import islice
from math import cos, isfinite, nan, sin
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, Rows
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person
from mcaptrack.sources.foreign.decoding import MessageType, decoder_with_errors, number, plain_name

#: Schemas of boxes of other software.
DETECTIONS_READ: Final = ("vision_msgs/Detection2DArray",)

_NUMBER: Final = re.compile(r"[0-9]{1,10}")
_NAME: Final = re.compile(r"[^\W\d_]")
#: The maximum number of class names of a channel; ids from ``_FIRST_NAME`` on are placeholders until all names are
#: known.
_MAX_NAMES: Final = 1024
_FIRST_NAME: Final = 2**32 - _MAX_NAMES
_SHOWN: Final = 12
_PERSON: Final = "person"


class Classes:
    """The classes of one channel: numeric classes keep their id, people are 1, and other names get new ids.

    New ids follow the largest id of the channel in alphabetical order, so that they don't depend on the order of
    messages.
    """

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._people: set[str] = set()
        self._largest = PERSON

    def class_id(self, name: str) -> int:
        """The id of a class; for a name a placeholder, which ``numbers`` maps to the final id."""
        if is_person(name):
            self._people.add(name)
            return PERSON
        if _NUMBER.fullmatch(name):
            number = int(name) if int(name) < _FIRST_NAME else UNKNOWN
            self._largest = max(self._largest, number)
            return number
        if not _NAME.search(name) or (name not in self._names and len(self._names) == _MAX_NAMES):
            return UNKNOWN
        return self._names.setdefault(name, _FIRST_NAME + len(self._names))

    def numbers(self) -> dict[int, int]:
        """The final id of each class name, by the placeholder from ``class_id``."""
        order = enumerate(sorted(self._names), start=self._largest + 1)
        return {self._names[name]: number for number, name in order}

    def names_by_id(self) -> dict[int, str]:
        """The names of all classes by their final id; of people only where all have one name other than "person"."""
        people = {PERSON: min(self._people)} if len(self._people) == 1 and self._people != {_PERSON} else {}
        return people | dict(enumerate(sorted(self._names), start=self._largest + 1))

    def nameless(self, used: Collection[int]) -> list[int]:
        """The final ids among ``used`` that messages state as numbers, without a name; 0 is no class."""
        named = set(self.numbers().values()) | ({PERSON} if self._people else set()) | {UNKNOWN}
        return sorted(set(used) - named)

    def named(self) -> list[tuple[str, int]]:
        """The first class names in alphabetical order, with their ids."""
        return list(islice(zip(sorted(self._names), range(self._largest + 1, 2**32), strict=False), _SHOWN))


def boxes_decoder(kind: MessageType, classes: Classes) -> Callable[[bytes], Rows]:
    """A function that decodes payloads of a channel to rows of detections (N,); raises as ``picture_decoder`` does.

    ``classes`` collects the class names.
    """
    if plain_name(kind.name) not in DETECTIONS_READ:
        raise McaptrackError(
            f"it holds {kind.name or 'no schema'}, not detections; {', '.join(DETECTIONS_READ)} is read"
        )
    return decoder_with_errors(kind, lambda message: _boxes(message, classes))


def _boxes(message: Any, classes: Classes) -> Rows:
    rows = [_box(detection, classes) for detection in message.detections]
    *numbers, class_id = np.array(rows, float).reshape(-1, 6).T
    columns = dict(zip(("x_px", "y_px", "w_px", "h_px", "score"), numbers, strict=True))
    return DETECTIONS.rows(class_id=class_id.astype(np.uint32), **columns)


def _box(detection: Any, classes: Classes) -> tuple[float, float, float, float, float, int]:
    """Left, top, width and height of the upright box around a detection, its best score, and its class id."""
    centre = detection.bbox.center
    place = getattr(centre, "position", centre)  # a Point2D in vision_msgs 4, a Pose2D in version 3
    x, y, theta, w, h = (
        float(value)
        for value in (place.x, place.y, getattr(centre, "theta", 0.0), detection.bbox.size_x, detection.bbox.size_y)
    )
    if not all(isfinite(value) for value in (x, y, theta, w, h)) or w < 0 or h < 0:
        raise ValueError(f"a box can't be {w:g} x {h:g} at ({x:g}, {y:g})")
    if theta:
        w, h = (abs(w * cos(theta)) + abs(h * sin(theta)), abs(w * sin(theta)) + abs(h * cos(theta)))
    name, score = best_hypothesis(detection.results)
    return x - w / 2, y - h / 2, w, h, score, UNKNOWN if name is None else classes.class_id(name)


def best_hypothesis(results: Any) -> tuple[str | None, float]:
    """The class with the highest score of results of vision_msgs, None if there is none, and its score, or NaN.

    Before ROS 2 Humble a result is its own hypothesis, with ``id`` in the place of ``class_id``.
    """
    guesses = [getattr(result, "hypothesis", result) for result in results]
    scored = [(number(guess.score), guess) for guess in guesses]
    finite = [(score, guess) for score, guess in scored if isfinite(score)]
    score, best = max(finite or scored, key=lambda pair: pair[0], default=(nan, None))
    if best is None:
        return None, nan
    return str(best.class_id if hasattr(best, "class_id") else best.id).strip(), score if finite else nan
