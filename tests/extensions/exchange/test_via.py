"""Files of via."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, by_frame, read


def via(rows: Sequence[Row]) -> Any:
    out = {}
    for frame, mine in by_frame(rows).items():
        regions = [
            {"shape_attributes": {"name": "rect", **dict(zip(("x", "y", "width", "height"), row.box, strict=True))},
             "region_attributes": {"class": row.kind, "track": row.id}} for row in mine
        ]  # fmt: skip
        out[f"{frame}.jpg9"] = {"filename": f"{frame}.jpg", "regions": regions}
    return out


WRITERS = {
    "via": Writer(as_json(via), "score", first="listed"),
}


def test_kinds_are_ticked_or_the_only_attribute_that_is_no_track(tmp_path):
    place = {"name": "rect", "x": 1, "y": 2, "width": 3, "height": 4}
    attributes = [{"a": {"cat": False, "dog": True}, "id": 1}, {"id": 2, "kind": "cow"}, {"a": "x", "b": "y"}]
    regions = [{"shape_attributes": place, "region_attributes": more} for more in attributes]
    labels = read(tmp_path, {"1.jpg9": {"filename": "1.jpg", "regions": regions}})
    kinds = [labels.classes.get(number, "") for number in labels.class_id.tolist()]
    assert dict(zip(labels.id.tolist(), kinds, strict=True)) == {1: "dog", 2: "cow", -1: ""}
