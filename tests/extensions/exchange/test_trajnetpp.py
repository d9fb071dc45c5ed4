"""Files of trajnet++."""

from __future__ import annotations

import json

from tests.label_cases import Row, Writer, text


def trajnetpp(row: Row) -> str:
    return json.dumps({"track": {"f": row.frame, "p": row.id, "x": row.xy[0], "y": row.xy[1]}})


WRITERS = {
    "trajnet++": Writer(
        text(trajnetpp, '{"scene": {"id": 0, "p": 1, "s": 0, "e": 9, "fps": 2.5}}', "a.ndjson"),
        "score kind",
        "xy",
        first="stated",
    ),
}
