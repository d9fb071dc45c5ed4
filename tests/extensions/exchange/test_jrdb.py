"""Files of jrdb."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, by_frame, number


def jrdb(rows: Sequence[Row]) -> Any:
    return {"labels": {
        f"{frame:06}.jpg": [
            {"box": list(row.box), "label_id": f"{row.kind or ''}:{number(row.id)}", "score": row.score} for row in mine
        ]
        for frame, mine in by_frame(rows).items()
    }}  # fmt: skip


WRITERS = {
    "jrdb": Writer(as_json(jrdb), "numbered", first="stated"),
}
