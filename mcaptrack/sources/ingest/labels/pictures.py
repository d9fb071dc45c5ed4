"""What formats share that describe pictures one by one: each has a name, perhaps a size, and boxes.

Letters: N rows.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_CLASS, NO_ID, NOTHING, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_ROWS, ClassNames, TrackIds, numbers_of_names
from mcaptrack.sources.video.image_folder import natural_order

_MAX_PICTURES: Final = 1_000_000
_MAX_NAME: Final = 256
#: The name that regions have whose boxes don't count.
_REGION: Final = "dontcare"
#: Numbers of a row: picture, left, top, width, height, score, class, id.
_COLUMNS: Final = 8


@dataclass
class Shape:
    """A box of a picture: corners or size in ``box`` as left, top, width, height, px, and what is known of it."""

    box: Sequence[Any]
    label: Any = None
    score: Any = None
    id: Any = None


@dataclass
class Picture:
    """A picture: its name, or its number; its width and height in px, if they are known; what is in it; and the number
    of shapes by kind that are no boxes.
    """

    name: str
    shapes: list[Shape]
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
    files = sorted((path for path in folder.iterdir() if path.suffix.lower() == suffix), key=natural_order)
    if len(files) > _MAX_PICTURES:
        raise McaptrackError(f"{folder} holds {len(files)} label files; at most {_MAX_PICTURES} are read")
    return files


class PictureFormat(Format):
    """Base of formats that describe pictures one by one: a subclass yields these. ``is_normalised``: boxes are in
    shares of the picture's size, and ``where`` is the place that is read, if it isn't the file.
    """

    name: ClassVar[str]
    is_normalised: ClassVar[bool] = False
    where: str = ""

    def pictures(self, file: LabelFile) -> Iterator[Picture]:
        """The pictures of a file or a folder. KeyError, TypeError, ValueError and AttributeError say what is wrong."""
        raise NotImplementedError

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The boxes of all pictures. The numbers in their names are those of frames, otherwise their order."""
        rows, places, pictures = array("d"), list[str](), list[Picture]()
        names, ids, other = ClassNames(), TrackIds(), Counter[str]()
        try:
            for picture in self.pictures(file):
                where = self.where or f"{file.path}: {picture.name[:_MAX_NAME]}"
                for shape in picture.shapes:
                    left, top, width, height = (float(number) for number in shape.box)
                    label = names.number(str(shape.label)) if shape.label not in (None, "") else NO_CLASS
                    score = math.nan if shape.score is None else float(shape.score)
                    rows.extend((len(pictures), left, top, width, height, score, label, _id(ids, shape.id)))
                    places.append(where)
                other.update(picture.other)
                picture.shapes = []
                pictures.append(picture)
                if max(len(places), len(pictures)) > MAX_ROWS:
                    raise McaptrackError(f"{file.path} has more than {MAX_ROWS} rows; give it in parts")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            text = f"no {error}" if isinstance(error, KeyError) else str(error)
            what = f"{self.title} ({self.row.strip('`')})"
            raise McaptrackError(f"{self.where or file.path}: not {what}: {text[:200]}") from None
        if not pictures:
            raise McaptrackError(f"{file.path} holds no labels of {self.title}")
        table = self._table(file.path, np.frombuffer(rows).reshape(-1, _COLUMNS), pictures, names.names, ids)
        table.at = places.__getitem__
        if other:
            counted = ", ".join(f"{count} {kind}" for kind, count in other.most_common())
            table.find(f": left out are shapes that are no boxes: {counted}")
        return table

    def _table(self, path: Path, rows: Any, pictures: list[Picture], names: dict[int, str], ids: TrackIds) -> BoxTable:
        numbers = numbers_of_names([picture.name for picture in pictures])
        by = "the numbers in their names" if numbers else "their order"
        frames = np.array(numbers or range(len(pictures)), np.int64)
        facts = LabelFacts(path, self.name, is_normalised=self.is_normalised, labelled=np.unique(frames))
        facts.states_labelled, facts.first_frame = True, int(frames.min())
        if names:
            facts.names, facts.numbering, facts.named_by = names, {}, "file"
        sizes = ((frame, picture.size) for frame, picture in zip(frames.tolist(), pictures, strict=True))
        stated = {frame: (float(size[0]), float(size[1])) for frame, size in sizes if size}
        facts.sizes = {frame: size for frame, size in stated.items() if min(size) > 0} or None
        if len(different := set(stated.values())) == 1 and facts.sizes:
            ((width, height),) = different
            facts.size = (int(width), int(height))
        track_id, said = ids.of(path, rows[:, 7])
        regions = [number for number, name in names.items() if name.lower() == _REGION]
        aside = np.where(np.isin(rows[:, 6], regions), REGION, NOTHING) if regions else None
        facts.region = "DontCare" if regions else ""
        remarks = [f"{path}: {len(pictures)} pictures, frames are numbered by {by}", *said]
        return BoxTable(
            facts=facts, frame=frames[rows[:, 0].astype(np.int64)], id=track_id, boxes_px=rows[:, 1:5],
            score=rows[:, 5], class_id=rows[:, 6], aside=aside, remarks=remarks,
        )  # fmt: skip


def _id(ids: TrackIds, value: Any) -> float:
    if value is None or value == "":
        return NO_ID
    try:
        return float(value)
    except ValueError:
        return ids.number(str(value)[:_MAX_NAME])
