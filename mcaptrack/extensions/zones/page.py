"""A page on which zones and lines are drawn over the scene, and downloaded as GeoJSON; it needs no other file."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from typing import Any, Final

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError, call
from mcaptrack.extensions.zones.counting import counted_zones
from mcaptrack.extensions.zones.shapes import Units, Zone
from mcaptrack.geometry.arrays import Floats
from mcaptrack.notices import warn
from mcaptrack.pipeline.motion import moves
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import TRACKS
from mcaptrack.schema.framing import join_frames, thinned
from mcaptrack.sources.pictures import Pictures
from mcaptrack.transforms import FULL
from mcaptrack.viewing.formatting import render
from mcaptrack.viewing.painting import background_picture

#: The channels of tracks with the places that are shown without pictures.
_PLACES: Final = (f"retracks{FULL}", "retracks", "tracks", "truth")
_MOST_PLACES: Final = 1500
_WIDTH_PX: Final = 800
#: The part of the ground around all places, in their extent.
_AROUND: Final = 1.15


def zones_page(opened: log.Log, prefix: str, file: str) -> str:
    """Return the page for a camera, which downloads ``file``: in pixels of its pictures, or on the ground without any.

    It begins with the zones that the log was counted with. Raises McaptrackError if there are neither pictures nor
    places of tracks.
    """
    topic = pipeline.camera_at(opened, prefix).pictures
    # Where the camera moves, zones in pixels are those of its first picture.
    is_still = not moves(RunState(opened, prefix, {}))
    background = background_picture(Pictures(opened, topic), is_still) if topic else None
    if background is not None:
        units: Units = "pixels"
        width, height, scale, low = background.width, background.height, background.scale, (0.0, 0.0)
        seen, up = np.zeros((0, 2)), 1
    else:
        seen = _places(opened, prefix)
        if not len(seen):
            raise McaptrackError(
                f"{opened.path} has no pictures of {prefix} to draw on, and no tracks in metres; "
                f"{call('run', opened.path)} makes tracks"
            )
        units, up = "metres", -1
        least, most = seen.min(axis=0), seen.max(axis=0)
        extent = np.maximum((most - least) * _AROUND, 2.0)
        scale = _WIDTH_PX / float(extent[0])
        width, height = _WIDTH_PX, max(1, round(float(extent[1]) * scale))
        middle = (least + most) / 2
        low = (float(middle[0] - extent[0] / 2), float(middle[1] + extent[1] / 2))
    counted = counted_zones(opened, prefix)
    before = counted[0].zones if counted else ()
    zones = [zone for zone in before if zone.units == units and [*map(len, zone.parts)] == [1]]  # of one outline
    left_out = [zone.name for zone in before if zone not in zones]
    if left_out:
        names = ", ".join(left_out)
        warn(
            f"{opened.path}: the page can't change zones that have holes or several parts, or that are not in {units}; "
            f"they are not in the file that it downloads: {names}"
        )
    data = {
        "units": units, "unit": "px" if units == "pixels" else "m", "scale": scale, "x0": low[0], "y0": low[1],
        "up": up, "digits": 1 if units == "pixels" else 2, "camera": prefix.strip("/"), "file": file,
        "seen": seen.round(2).tolist(), "zones": _drawn(zones),
    }  # fmt: skip
    return render(
        "draw_zones.html",
        __package__ or "",
        title=opened.path.name,
        log=opened.path.name,
        file=file,
        width=width,
        height=height,
        jpeg=background.jpeg if background else b"",
        data=data,
        left_out=left_out,
        nonce=b64encode(sha256(os.fsencode(opened.path.name)).digest()[:12]).decode(),
    )


def _drawn(zones: Sequence[Zone]) -> list[dict[str, Any]]:
    drawn = ({"name": zone.name, "line": zone.is_line, "points": zone.parts[0][0]} for zone in zones)
    return [
        shape | ({"classes": zone.classes} if zone.classes else {}) for shape, zone in zip(drawn, zones, strict=True)
    ]


def _places(opened: log.Log, prefix: str) -> Floats:
    """Places of tracks on the ground (N, 2) in m, some of them."""
    for name in _PLACES:
        topic = f"{prefix}/{name}"
        if not opened.holds(topic, TRACKS):
            continue
        rows = join_frames(TRACKS, thinned(opened.frame_columns(topic, TRACKS), _MOST_PLACES)).rows
        xy = np.stack([rows["x_m"], rows["y_m"]], axis=1)
        xy = xy[np.isfinite(xy).all(axis=1)]
        if len(xy):
            return np.asarray(xy)
    return np.zeros((0, 2))
