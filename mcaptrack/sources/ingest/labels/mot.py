"""MOTChallenge: ``frame, id, left, top, width, height[, score[, class[, ...]]]``, 6 to 10 columns, comma separated.

Ground truth has the class of a box in column 8 since MOT16, and a score of 0 for boxes that aren't scored. MOT15, with
10 columns, has a position from column 8 on; VisDrone, and trackers that write 10 columns, have a class there, too.

Letters: N rows.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.sources.ingest.labels.delimited import is_table
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import FORGIVEN, NO_CLASS, OCCUPIED, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import check_columns, name_classes, read_numbers, states_number

#: The classes of MOT16, 17 and 20, and of VisDrone.
_NAMES: Final = (
    "pedestrian,person on vehicle,car,bicycle,motorbike,non motorized vehicle,static person,distractor,occluder,"
    "occluder on the ground,occluder full,reflection,crowd"
)
MOT_CLASSES: Final = dict(enumerate(_NAMES.split(","), start=1))
_VISDRONE_NAMES: Final = (
    "ignored regions,pedestrian,people,bicycle,car,van,truck,tricycle,awning-tricycle,bus,motor,others"
)
_VISDRONE: Final = dict(enumerate(_VISDRONE_NAMES.split(",")))
#: Distractor classes of MOT16, 17 and 20: person on a vehicle, static person, distractor, reflection.
_DISTRACTORS: Final = (2, 7, 8, 12)
#: So many rows tell what columns 9 and 10 hold.
_SAMPLE: Final = 10_000
#: Truncation and occlusion in columns 9 and 10 are no larger.
_TRUNCATED, _OCCLUDED = 1, 2


class Mot(Format):
    """Rows of MOTChallenge."""

    title = "MOTChallenge"
    row = "`frame,id,left,top,width,height,score,class,visibility` or with 10 columns"
    in_parts = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has commas and 6 to 10 columns, or is 10 numbers, and isn't that of a table."""
        if "," not in file.row:
            return len(file.cells) == 10 and all(map(states_number, file.cells))
        return 6 <= len(file.cells) <= 10 and states_number(file.cells[2]) and not is_table(file)

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        sample = list[list[float]]()

        def parse(parts: list[str]) -> list[float]:
            count = len(parts)
            if count >= 8:
                check_columns(parts, 6, 10)
                if count == 10 and len(sample) < _SAMPLE:
                    sample.append([*map(float, parts[8:])])
                return [*map(float, parts[:8])]
            check_columns(parts, 6, 10)
            return [*map(float, parts), *[np.nan] * (8 - count)]

        what = "MOTChallenge (frame, id, left, top, width, height, score, ...)"
        values, at = read_numbers(file.path, file.lines(), what, 8, parse, _split)
        score, kind = values[:, 6], values[:, 7]
        facts = LabelFacts(file.path, first_frame=0 if (values[:, 0] == 0).any() else 1, named_by="format")
        facts.is_first_assumed = facts.first_frame == 1  # some programs number frames from 0 in this format, too
        facts.not_counting, facts.scores_truth = "score 0", False
        table = BoxTable(
            facts=facts, at=at, frame=values[:, 0], id=values[:, 1], boxes_px=values[:, 2:6], score=score,
            class_id=np.full(len(values), NO_CLASS), counts=score != 0,
        )  # fmt: skip
        tens = np.array(sample).reshape(-1, 2)
        kind = np.where(np.isfinite(kind) & (kind < 2**31), kind, NO_CLASS)
        if (kind != NO_CLASS).any() and (not len(tens) or _are_classes(kind, tens)):
            table.refuse(
                (kind != np.rint(kind)) | (kind < NO_CLASS),
                lambda row: f"a class (column 8) is a whole number from -1 (none) on, not {kind[row]:g}",
            )
            _name(table, kind.astype(np.int64), tens)
        return table


def _split(line: str) -> list[str]:
    return line.split(",") if "," in line else line.split()


def _are_classes(kind: Floats, tens: Floats) -> bool:
    """Whether column 8 of rows with 10 columns holds classes, by what is in it and in the last two (K, 2)."""
    if (kind != np.rint(kind)).any() or (kind < NO_CLASS).any():
        return False
    if (tens == -1).all():
        return True
    truncated, occluded = tens.T
    are_flags = (truncated >= 0) & (truncated <= _TRUNCATED) & np.isin(occluded, range(_OCCLUDED + 1))
    return bool(are_flags.all() and (kind > 0).any())


def _name(table: BoxTable, kind: Ints, tens: Floats) -> None:
    """Classes by a file beside the rows, or by the numbers of the data set, as far as these have them all."""
    facts, stated = table.facts, kind[kind != NO_CLASS]
    facts.named_by, table.class_id, table.aside = "", kind, np.full(len(kind), OCCUPIED)
    name_classes(table, [table.path.parent], first=int(stated.min() > 0))
    is_visdrone = len(tens) > 0 and bool((tens >= 0).all())
    are_people = bool((stated == PERSON).all())
    names = _VISDRONE if is_visdrone and not are_people else MOT_CLASSES if are_people or not len(tens) else {}
    if facts.names is None and np.isin(stated, [*names]).all():
        facts.names, facts.named_by = names, "format"
        table.class_id = np.where(kind == NO_CLASS, PERSON, kind)
        if without := int((kind == NO_CLASS).sum()):
            table.find(": {0} boxes without a class (-1 in column 8) are taken as people", "classes", without)
        table.aside[(kind == 0) if is_visdrone else np.isin(kind, _DISTRACTORS)] = REGION if is_visdrone else FORGIVEN
        facts.region = "ignored regions" if is_visdrone else ""
    people = [number for number, name in (facts.names or {}).items() if is_person(name)]
    if people:  # ground truth has a score of 0 for whatever isn't people
        table.counts = (table.score != 0) | ~np.isin(table.class_id, people)
