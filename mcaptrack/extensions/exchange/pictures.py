"""Formats that describe pictures one by one share this: each has a name, perhaps a size, and boxes.

Letters: N rows.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, frame_numbers
from mcaptrack.files import visible
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NOTHING, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_NAME
from mcaptrack.sources.video.image_folder import natural_order

_MAX_PICTURES: Final = 1_000_000
#: The name of regions in which boxes don't count.
_REGION: Final = "dontcare"
_BY: Final = {"names": "the numbers in their names", "order": "their order"}
_WHOLE: Final = re.compile(r"-?\d{1,15}")


@dataclass
class LabelledShape:
    """A box of a picture: corners or size in ``box`` as left, top, width, height, px, and what is known of it."""

    box: Sequence[Any]
    label: Any = None
    score: Any = None
    id: Any = None


@dataclass
class LabelledPicture:
    """A picture: its name, or its number; its width and height in px, if they are known; what is in it; and the number
    of shapes by kind that are no boxes.
    """

    name: str
    shapes: list[LabelledShape]
    size: tuple[Any, Any] | None = None
    other: Counter[str] = field(default_factory=Counter)


def around(points: Sequence[Any]) -> list[float]:
    """The box of left, top, width, height around points (K, 2). Raises ValueError if there are none."""
    xy = np.asarray(points, float).reshape(-1, 2)
    if not len(xy) or not np.isfinite(xy).all():
        raise ValueError("a shape without points, or with one that is missing")
    return [*xy.min(axis=0).tolist(), *np.ptp(xy, axis=0).tolist()]


def files_in(folder: Path, suffix: str) -> list[Path]:
    """The files of a folder with this ending, in natural order. Raises McaptrackError if there are too many."""
    files = sorted((path for path in visible(folder.iterdir()) if path.suffix.lower() == suffix), key=natural_order)
    if len(files) > _MAX_PICTURES:
        raise McaptrackError(f"{folder} holds {len(files)} label files; at most {_MAX_PICTURES} are read")
    return files


class PictureFormat(Format):
    """Base of formats that describe pictures one by one: a subclass yields these.

    ``is_normalised``: boxes are in shares of the picture's size; None: the numbers tell. ``where`` is the place that is
    read, if it isn't the file as a whole.
    """

    is_normalised: ClassVar[bool | None] = None
    where: str = ""

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file or a folder. KeyError, TypeError, ValueError and AttributeError say what is wrong."""
        raise NotImplementedError

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The boxes of all pictures. The numbers in their names are those of frames, otherwise their order."""
        facts = LabelFacts(file.path, is_normalised=self.is_normalised, states_labelled=True)
        rows, pictures, other = GatheredRows(facts, "picture"), list[LabelledPicture](), Counter[str]()
        try:
            for picture in self.pictures(file):
                for shape in picture.shapes:
                    name = None if shape.label in (None, "") else str(shape.label)
                    aside = REGION if name is not None and name.lower() == _REGION else NOTHING
                    score = None if shape.score is None else float(shape.score)
                    left, top, width, height = (float(number) for number in shape.box)
                    box, place = (left, top, width, height), self.where or picture.name[:MAX_NAME]
                    rows.add(place, len(pictures), box, _track(shape.id), name, score, aside=aside)
                other.update(picture.other)
                picture.shapes = []
                if picture.size is not None:
                    picture.size = float(picture.size[0]), float(picture.size[1])
                pictures.append(picture)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            text = f"no {error}" if isinstance(error, KeyError) else str(error)
            where = f"{file.path}: {self.where}" if self.where else f"{file.path}"
            raise McaptrackError(f"{where}: not {self.title} ({self.row.strip('`')}): {text[:200]}") from None
        table = rows.table()
        numbers, by = frame_numbers([picture.name for picture in pictures])
        frames = np.array(numbers, np.int64)
        table.frame, facts.labelled = frames[table.frame.astype(np.int64)], np.unique(frames)
        facts.first_frame, facts.is_first_assumed = int(frames.min()), int(frames.min()) > 0
        facts.is_in_order = by == "order"
        facts.region = "DontCare" if table.aside is not None else ""
        sizes = ((frame, picture.size) for frame, picture in zip(frames.tolist(), pictures, strict=True))
        facts.measure({frame: size for frame, size in sizes if size is not None}, len(pictures))
        table.remark(f": {len(pictures)} pictures, frames are numbered by {_BY[by]}")
        if other:
            counted = ", ".join(f"{count} {kind}" for kind, count in other.most_common())
            table.find(f": left out are shapes that are no boxes: {counted}")
        return table


def _track(value: Any) -> Any:
    """The id of a track, as a number if a text is one."""
    return int(value) if isinstance(value, str) and _WHOLE.fullmatch(value) else value
