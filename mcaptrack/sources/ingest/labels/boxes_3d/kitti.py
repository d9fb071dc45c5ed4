"""Read 3D boxes of KITTI tracking labels. Letters: N rows."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.boxes_3d.rows import BoxRows3D
from mcaptrack.sources.ingest.labels.formats import ClassNames
from mcaptrack.sources.ingest.labels.number_table import NumberTable, lines_of

_REGION: Final = "dontcare"
_COLUMNS: Final = (
    "frame id type truncated occluded alpha left top right bottom height width length x y z rotation score"
)
#: The frame of reference: of the camera, with z up.
FRAME: Final = "camera_link"


def read_kitti_3d(path: Path) -> BoxRows3D:
    """Read a file of one sequence.

    In the file, x is right, y down and z forward, the position is the centre of the box's bottom, and the rotation
    about y is 0 for an object that faces right. Here x is forward, y left and z up.
    """
    names = ClassNames()

    def parse(parts: list[str]) -> list[float]:
        if len(parts) not in (17, 18):
            raise ValueError(f"{len(parts)} columns")
        score = float(parts[17]) if len(parts) == 18 else np.nan
        return [float(parts[0]), float(parts[1]), names.number(parts[2]), *map(float, parts[10:17]), score]

    table = NumberTable(path, lines_of(path), f"KITTI tracking ({_COLUMNS})", 11, parse)
    frame, track_id = table.whole(0, "the frame (a count of pictures, no time)", 0), table.whole(1, "the id", -1)
    kind = table.values[:, 2].astype(np.int64)
    is_region = np.array([name.lower() == _REGION for name in names.names], bool)[kind] if len(kind) else kind == -2
    has_no_box = ~is_region & (table.values[:, 3:6] <= 0).any(axis=1)  # results of detectors in pictures
    kept = np.flatnonzero(~is_region & ~has_no_box)
    if not len(kept):
        raise McaptrackError(f"{path} holds no 3D boxes")
    height, width, length, x, y, z, rotation = table.values[kept, 3:10].T
    heading = -rotation - np.pi / 2
    left = [f"{int(is_region.sum())} regions (DontCare)"] if is_region.any() else []
    left += [f"{int(has_no_box.sum())} rows without a 3D box"] if has_no_box.any() else []
    axes = "x is forward, y left, z up (in the file x is right, y down, z forward); positions are centres of boxes"
    return BoxRows3D(
        path,
        "kitti-3d",
        lambda row: f"{path}:{table.line[kept[row]]}",
        np.stack([z, -x, -y + height / 2, length, width, height, heading], axis=-1),
        track_id[kept],
        kind[kept],
        names.names,
        table.values[kept, 10],
        np.full((len(kept), 2), np.nan),
        frame=frame[kept],
        labelled=np.unique(frame),
        frame_id=FRAME,
        left_out=" and ".join(left),
        remarks=[f"{path}: {axes}"],
    )
