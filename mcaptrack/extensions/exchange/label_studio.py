"""Videos of Label Studio, as JSON: results of the type ``videorectangle``, with boxes at some frames (``sequence``).

Sizes are percents of the picture's, frames count from 1. Between two boxes of a sequence the box is interpolated, as
Label Studio shows it, and after the last one it stays to the end of the video, unless the one before isn't ``enabled``.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import Any, Final

import numpy as np

from mcaptrack.extensions.exchange.gathered import GatheredRows, chosen_part, is_number
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import MAX_FRAME, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_ROWS

_TYPE: Final = "videorectangle"
_BOX: Final = ("frame", "x", "y", "width", "height")


class LabelStudio(Format):
    """The boxes of a task with a video."""

    title = "Label Studio"
    row = "JSON of tasks with `annotations` or `predictions`, of which results are of the type `videorectangle`"
    takes = ("scene",)

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON is a list of tasks with annotations of a video, or one of these."""
        return bool({"annotations", "predictions", "result"} & {*file.keys}) and any(_results(file))

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a task."""
        tasks = {str(task.get("id", number)): task for number, task in enumerate(_tasks(file)) if [*_regions(task)]}
        task = chosen_part(file.path, tasks, asked.scene, "task", " with boxes in a video")
        facts = LabelFacts(file.path, first_frame=1, is_normalised=True)
        rows, count, duration, filled = GatheredRows(facts, "result"), 0, 0.0, 0
        for order, region in enumerate(_regions(task)):
            value = region["value"]
            stated = [value.get(key) for key in ("framesCount", "duration")]
            if all(is_number(number) and 0 < number <= MAX_FRAME for number in stated):
                count, duration = max(count, int(stated[0])), max(duration, float(stated[1]))
            labels = value.get("labels")
            name = labels[0] if isinstance(labels, list) and labels else None
            for frame, box, is_stated in _boxes(rows, str(order), value["sequence"], count):
                rows.add(str(order), frame, box, str(region.get("id", order)), name, observed=is_stated)
                filled += not is_stated
        table = rows.table()
        if 0 < count <= MAX_ROWS:
            facts.labelled, facts.states_labelled = np.arange(1, count + 1), True
        if count and duration > 0:
            facts.fps = Fraction(count / duration).limit_denominator(1001)
            facts.clock_of = "framesCount and duration"
        if filled:
            table.remark(f": {filled} boxes are interpolated between others of their tracks")
        return table


def _tasks(file: LabelFile) -> list[dict[str, Any]]:
    content = file.json if isinstance(file.json, list) else [file.json]
    return [task for task in content if isinstance(task, dict)]


def _results(file: LabelFile) -> Iterator[dict[str, Any]]:
    for task in _tasks(file):
        yield from _regions(task)


def _regions(task: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The sequences of the first annotation of a task that wasn't cancelled, or of its first prediction."""
    for key in ("annotations", "predictions"):
        entries = task[key] if isinstance(task.get(key), list) else []
        kept = [entry for entry in entries if isinstance(entry, dict) and not entry.get("was_cancelled")]
        if kept:
            break
    else:
        kept = [task]
    results = kept[0].get("result")
    for region in results if isinstance(results, list) else ():
        value = region.get("value") if isinstance(region, dict) and region.get("type") == _TYPE else None
        if isinstance(value, dict) and isinstance(value.get("sequence"), list):
            yield region


def _boxes(
    rows: GatheredRows, place: str, sequence: list[Any], count: int
) -> Iterator[tuple[int, tuple[float, ...], bool]]:
    """The frame, the box in shares of the picture, and whether it is stated, of a sequence."""
    keys = sorted((tuple(rows.numbers(place, entry, _BOX)), entry.get("enabled", True)) for entry in sequence)
    if any(not 0 <= frame <= MAX_FRAME for (frame, *_), _ in keys):
        raise rows.refuse(place, f"has a frame that is not from 0 to {MAX_FRAME}")
    for number, ((frame, *box), is_enabled) in enumerate(keys):
        first, start = int(frame), np.array(box) / 100
        yield first, tuple(start), True
        is_last = number == len(keys) - 1
        until = count + 1 if is_last else int(keys[number + 1][0][0])
        end = start if is_last else np.array(keys[number + 1][0][1:]) / 100
        if is_enabled and until - first > MAX_ROWS:
            raise rows.refuse(place, f"would be interpolated over {until - first} frames; at most {MAX_ROWS} are")
        for between in range(first + 1, until) if is_enabled else ():
            share = (between - first) / (until - first)
            yield between, tuple(start + share * (end - start)), False
