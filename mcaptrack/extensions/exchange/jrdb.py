"""JRDB: ``labels`` by the name of a picture or point cloud, each with ``label_id`` ("pedestrian:12") and a ``box``:
left, top, width, height in a picture, or ``cx``, ``cy``, ``cz``, ``l``, ``w``, ``h``, ``rot_z`` in space.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, frame_numbers
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, LabelFacts

_IN_SPACE: Final = ("cx", "cy", "cz", "l", "w", "h", "rot_z")


class Jrdb(Format):
    """Labels of pictures, or of point clouds."""

    title = "JRDB"
    row = 'JSON: `{"labels": {"000000.jpg": [{"box": [x, y, w, h], "label_id": "pedestrian:12"}]}}`; also in space'

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON has labels by names of files, with a box and a label_id."""
        first = _first(file)
        return isinstance(first, dict) and {"box", "label_id"} <= first.keys()

    def holds_3d(self, file: LabelFile, columns: Mapping[str, str]) -> bool:
        """Whether the first box is one in space."""
        first = _first(file)
        return isinstance(first, dict) and isinstance(first.get("box"), dict)

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        if not self.recognises(file):
            raise McaptrackError(f"{file.path} is no JSON of labels by names of files, as JRDB has")
        labels: dict[str, Any] = file.json["labels"]
        numbers, _ = frame_numbers([*labels])
        facts = LabelFacts(file.path, first_frame=0, states_labelled=True, not_counting="no_eval")
        facts.labelled = np.array(sorted(numbers), np.int64)
        rows, in_space = GatheredRows(facts, "label"), self.holds_3d(file, {})
        for number, (name, entries) in zip(numbers, labels.items(), strict=True):
            for order, entry in enumerate(entries if isinstance(entries, list) else ()):
                place = f"{order} of {name[:60]}"
                if not isinstance(entry, dict) or not isinstance(entry.get("label_id"), str):
                    raise rows.refuse(place, "has no label_id")
                kind, _, track = entry["label_id"].rpartition(":")
                attributes = entry["attributes"] if isinstance(entry.get("attributes"), dict) else entry
                rows.add(
                    place, number, rows.numbers(place, entry.get("box"), _IN_SPACE if in_space else range(4)),
                    track, kind, entry.get("score"), observed=not attributes.get("interpolated"),
                    counts=not attributes.get("no_eval"),
                )  # fmt: skip
        return rows.table()


def _first(file: LabelFile) -> Any:
    """The first label of a file; None if it has none."""
    labels = file.json.get("labels") if "labels" in file.keys and isinstance(file.json, dict) else None
    entries = labels.values() if isinstance(labels, dict) else ()
    return next(chain.from_iterable(part for part in entries if isinstance(part, list)), None)
