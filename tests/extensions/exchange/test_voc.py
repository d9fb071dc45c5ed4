"""Files of voc."""

from __future__ import annotations

from tests.label_cases import Row, Writer, corners, per_frame


def voc(frame: int, rows: list[Row]) -> str:
    """Ids are attributes, as LabelMe has them."""
    parts = [f"<annotation><filename>{frame}.jpg</filename><size><width>640</width><height>480</height></size>"]
    for row in rows:
        ends = "".join(
            f"<{key}>{end}</{key}>" for key, end in zip(("xmin", "ymin", "xmax", "ymax"), corners(row), strict=True)
        )
        own = "" if row.id is None else f"<attributes>track_id={row.id}</attributes>"
        parts.append(f"<object><name>{row.kind or ''}</name><bndbox>{ends}</bndbox>{own}</object>")
    return "".join(parts) + "</annotation>"


WRITERS = {
    "voc": Writer(per_frame("{}.xml", voc), "score", size=True, first="listed"),
}
