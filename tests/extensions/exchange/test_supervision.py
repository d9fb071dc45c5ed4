"""Files of supervision."""

from __future__ import annotations

from tests.label_cases import Writer, corners, number, read, refused, text

SUPERVISION = "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame_index"
WRITERS = {
    "supervision": Writer(
        text(
            lambda row: ",".join(
                [
                    *map(number, corners(row)),
                    {"person": "0"}.get(row.kind, row.kind or ""),
                    number(row.score),
                    number(row.id, "-1"),
                    f"{row.frame}",
                ]
            ),
            SUPERVISION,
            "a.csv",
        ),
        names=False,
        first="stated",
    ),
}


def test_rows_of_json_say_which_one_is_wrong(tmp_path):
    good = {"x_min": 1, "y_min": 2, "x_max": 3, "y_max": 4, "class_id": 0, "confidence": 0.5, "tracker_id": 1}
    row = good | {"frame_index": 0}
    assert read(tmp_path, [row]).boxes_px.tolist() == [[1, 2, 2, 2]]
    assert refused(tmp_path, [row, row | {"more": 1}]).startswith(
        ": row 2 has other keys than the first one: {'x_min': 1"
    )
    assert "the column of frames holds names without a number" in refused(tmp_path, [row, good])
    assert refused(tmp_path, [row, 5]).startswith(" holds no rows: a list of objects")
    assert refused(tmp_path, [good]).startswith(":1: no column for the frame or the time of boxes")
    assert refused(tmp_path, [row, row | {"x_min": "a"}]).startswith(":2: not a row of x_min, y_min, ")
    assert read(tmp_path, [row | {"frame_index": 9}]).first_frame == 0
    assert refused(tmp_path, [row | {f"k{n}": 0 for n in range(1017)}]) == ":1: more than 1024 columns"
    assert len(read(tmp_path, [row | {f"k{n}": 0 for n in range(1016)}]).frame) == 1
