"""Bring ground truth to the frame of reference of the tracks that are compared with it. Letters: N rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.angles import headings
from mcaptrack.geometry.transform_tree import plain_frame, turned
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.sources.frames import poses_at


def in_frame(opened: log.Log, topic: str, frames: Sequence[Frame], target: str, source: str) -> list[Frame]:
    """Return frames of tracks of a channel with positions in metres in another frame of reference.

    Frames at times at which the pose isn't known are left out, with a warning. Raises McaptrackError if it is never
    known.
    """
    if plain_frame(target) == plain_frame(source):
        return list(frames)
    joined = join_frames(TRACKS, frames)
    poses = poses_at(opened, topic, target, source, joined.t_ns, joined.t_ns)
    if not poses.is_known.any():
        raise McaptrackError(
            f"{opened.path}: {topic} is in the frame {source}, tracks are in {target}, and no transform between them "
            "is known; ingest the labels with the right `frame=`"
        )
    rotation, rows = poses.rotation[joined.frame], joined.rows.copy()
    shift = poses.translation[joined.frame]
    height = np.nan_to_num(rows["z_m"])  # a position without a height is taken as on the ground
    place = turned(rotation, np.stack([rows["x_m"], rows["y_m"], height], axis=1)) + shift
    rows["x_m"], rows["y_m"] = place[:, 0], place[:, 1]
    rows["z_m"] = np.where(np.isnan(rows["z_m"]), np.nan, place[:, 2])
    level = np.zeros(len(rows))
    ahead = np.stack([np.cos(rows["heading_rad"]), np.sin(rows["heading_rad"]), level], axis=1)
    rows["heading_rad"] = headings(turned(rotation, ahead))
    velocity = turned(rotation, np.stack([rows["vx_m_per_s"], rows["vy_m_per_s"], level], axis=1))
    rows["vx_m_per_s"], rows["vy_m_per_s"] = velocity[:, 0], velocity[:, 1]
    moved = split_rows(joined.t_ns, [frame.index for frame in frames], rows, joined.ends[1:])
    return [frame for frame, is_known in zip(moved, poses.is_known.tolist(), strict=True) if is_known]
