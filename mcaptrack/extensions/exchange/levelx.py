"""Tracks of highD, and of inD, rounD, exiD and uniD: CSV of vehicles and people seen by a drone, in metres."""

from __future__ import annotations

import csv
from typing import Final

import numpy as np

from mcaptrack.sources.ingest.labels.delimited import header_of, opened, read_table_3d
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_CLASS, Asked, BoxTable
from mcaptrack.sources.ingest.labels.text import ClassNames, lines_of

_COMMON: Final = {"frame", "xVelocity", "yVelocity", "width"}
_OTHERS: Final = {
    "frame": "frame",
    "id": "trackId",
    "x_m": "xCenter",
    "y_m": "yCenter",
    "heading_deg": "heading",
    "length_m": "length",
    "width_m": "width",
    "vx_m_per_s": "xVelocity",
    "vy_m_per_s": "yVelocity",
}
#: x and y are the upper left corner of a box that lies along x, width its length and height its width.
_HIGHD: Final = _OTHERS | {"id": "id", "x_m": "x", "y_m": "y", "length_m": "width", "width_m": "height"}


class LevelX(Format):
    """Files named ..._tracks.csv, with the classes in ..._tracksMeta.csv beside them."""

    title = "highD, inD, rounD, exiD or uniD"
    row = "`..._tracks.csv` with `frame`, `xVelocity`, and `xCenter` or, of highD, `x`"
    in_space = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether the columns are theirs."""
        names = set(header_of(file.path, file.row)) if file.row else set()
        return names >= _COMMON and (names >= {"trackId", "xCenter"} or names >= {"id", "x", "height", "laneId"})

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file; positions are the centres of boxes."""
        table = opened(file)
        is_highd = "xCenter" not in table.header
        names = {key: name for key, name in (_HIGHD if is_highd else _OTHERS).items() if name in table.header}
        out = read_table_3d(table, names)
        out.facts.first_frame = int(is_highd)
        meta = file.path.with_name(file.path.name.replace("_tracks.", "_tracksMeta."))
        if meta != file.path and meta.is_file():
            names_of, id_name = ClassNames(), names["id"]
            rows = csv.DictReader(line for _, line in lines_of(meta))
            kinds = {row.get(id_name): names_of.number(row.get("class") or "") for row in rows}
            out.class_id = np.array([kinds.get(str(own), NO_CLASS) for own in out.id.astype(int).tolist()], np.int64)
            out.facts.name(names_of.names, by=str(meta))
        if is_highd and out.boxes_m is not None:
            out.boxes_m[:, :2] += out.boxes_m[:, 3:5] / 2
            out.remark(": x and y are the upper left corners of boxes in highD; positions are their centres")
        return out
