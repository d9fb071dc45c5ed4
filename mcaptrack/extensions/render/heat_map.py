"""A picture of where people spend their time: over the scene where its ground plane is known, or seen from above.

Letters: H rows, W columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.occupancy import Occupancy, occupancy
from mcaptrack.extensions.render.legend import INK
from mcaptrack.extensions.render.video import RenderOptions
from mcaptrack.files import publish_bytes
from mcaptrack.foxglove.views.styles import GROUND_TRUTH, RETRACKED, TRACKED
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.pipeline import read_planes
from mcaptrack.schema import TRACKS
from mcaptrack.schema.classes import UNKNOWN, class_name, class_names, is_person
from mcaptrack.schema.framing import joined_parts
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing import from_above
from mcaptrack.viewing.from_above import ABOVE_PX, sight_of
from mcaptrack.viewing.painting import BACKGROUND, draw, put_text, scaled, text_size

#: The formats of a heat map by the suffix of its file.
SUFFIXES: Final = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
#: Channels below the prefix of a camera, the best one first.
_BEST: Final = (*RETRACKED.names, *TRACKED.names, *GROUND_TRUTH.names)
#: The scene without people is the median of this many pictures.
_PICTURES: Final = 15
#: The heat is drawn over the picture with this opacity at most, and is faded below this share of the highest.
_OPACITY: Final = 0.8
_FADED: Final = 0.04
#: Pixels that are this many times as large on the ground as at the lower edge are near the horizon.
_FARTHEST: Final = 20.0
#: Narrower pictures are enlarged, so that their legend can be read.
_LEAST_PX: Final = 240
#: The size of text in heights of a line.
_TEXT: Final = 0.7


class HeatMap(NamedTuple):
    """A heat map: the topic of its tracks, and the person-seconds of all cells."""

    topic: str
    person_s: float


def draw_heat_map(
    opened: log.Log, prefix: str, topics: Sequence[str], pictures: str | None, output: Path, options: RenderOptions
) -> HeatMap:
    """Draw where people spend their time, and write a picture, .png or .jpg by the suffix of ``output``.

    Parameters
    ----------
    opened : Log
    prefix : str
        Of the camera.
    topics : sequence of str
        One channel of tracks; by default the best one of the camera.
    pictures : str, optional
        The topic of its pictures.
    output : Path
    options : RenderOptions
        Width and period. Seconds count from the first picture, or from the first row without pictures.

    Returns
    -------
    HeatMap

    Raises
    ------
    McaptrackError
        If there are no tracks of people in metres in the period.
    """
    if output.suffix.lower() not in SUFFIXES:
        raise McaptrackError(f"{output}: a heat map is a picture, .png or .jpg, not {output.suffix or 'no suffix'}")
    topic = _channel(opened, prefix, topics)
    heat = _heat(opened, topic, pictures, options)
    planes = read_planes(opened, prefix) or []
    if pictures is not None and len(planes) == 1:
        image = _over_picture(_scene(Pictures(opened, pictures), options.width_px), heat, planes[0][1])
    else:
        if pictures is not None:
            why = "the ground plane changes" if planes else "there is no ground plane"
            warn(f"{opened.path}: the heat map is drawn from above, because {why}", "other")
        image = _from_above(heat, options.width_px or ABOVE_PX)
    most = float(heat.person_s.max()) / heat.cell_m**2
    if options.width_px is None and image.shape[1] < _LEAST_PX:
        image = scaled(image, _LEAST_PX)
    image = _with_legend(image, most, float(heat.person_s.sum()), topic)
    data = encode_image(image, "jpeg" if SUFFIXES[output.suffix.lower()] == "jpeg" else "png")
    publish_bytes(output, data)
    return HeatMap(topic, float(heat.person_s.sum()))


def _channel(opened: log.Log, prefix: str, topics: Sequence[str]) -> str:
    """The channel of tracks to count."""
    if len(topics) > 1:
        raise McaptrackError(f"a heat map is of one channel of tracks, not of {', '.join(topics)}")
    if topics:
        channel = opened.channel(opened.find(topics[0], prefix))
        if not channel.holds(TRACKS):
            raise McaptrackError(f"{opened.path}: {topics[0]} holds {channel.schema_name}, not tracks to count")
        return channel.topic
    for topic in (f"{prefix}/{name}" for name in _BEST):
        if opened.holds(topic, TRACKS):
            return topic
    raise McaptrackError(f"{opened.path} has no tracks of {prefix} yet; {call('run', opened.path)} makes them")


def _heat(opened: log.Log, topic: str, pictures: str | None, options: RenderOptions) -> Occupancy:
    """The person-seconds of a channel in the period."""
    frames = opened.frame_columns(topic, TRACKS)
    names = class_names(opened.channels[topic].metadata)
    times = opened.times(pictures or topic)
    start_ns = int(times[0]) if len(times) else 0
    first = start_ns + seconds_to_ns(options.start_s)
    last = None if options.end_s is None else start_ns + seconds_to_ns(options.end_s)
    parts = []
    for _, _, joined in joined_parts(TRACKS, frames):
        rows, t_ns = joined.rows, joined.row_ns
        classes = rows["class_id"].astype(np.int64)
        wanted = [kind for kind in np.unique(classes).tolist() if kind == UNKNOWN or is_person(class_name(kind, names))]
        kept = np.isin(classes, wanted) & (t_ns >= first) & (t_ns <= (t_ns if last is None else last))
        parts.append((t_ns[kept], rows["track_id"][kept].astype(np.int64), rows["x_m"][kept], rows["y_m"][kept]))
    if not parts or not sum(len(part[0]) for part in parts):
        raise McaptrackError(f"{opened.path}: {topic} has no rows of people in that time to count")
    t_ns, ids, x_m, y_m = (np.concatenate([part[n] for part in parts]) for n in range(4))
    heat = occupancy(t_ns, ids, np.stack([x_m, y_m], axis=-1).astype(np.float64))
    if not heat.person_s.size or not heat.person_s.max():
        raise McaptrackError(f"{opened.path}: {topic} has no track with two positions in metres in that time")
    if heat.outside_s > 0.02 * heat.person_s.sum():
        warn(f"{opened.path}: {heat.outside_s:.0f} person-seconds are outside of the heat map", "left-out")
    return heat


def _scene(pictures: Pictures, width_px: int | None) -> Image:
    """The scene without people who move."""
    count = len(pictures.t_ns)
    numbers = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int)).tolist()
    seen = [np.asarray(frame.rows, np.uint8) for frame in pictures.readable(numbers)]
    alike = [image for image in seen if image.shape == seen[0].shape]
    return scaled(np.median(np.stack(alike), axis=0).astype(np.uint8), width_px)


def _smooth(heat: Occupancy) -> Floats:
    """The density (H, W) in shares of the highest, smoothed by about a cell, with a margin of two cells around."""
    import cv2

    padded = np.pad(heat.person_s, 2)
    smoothed = np.asarray(cv2.GaussianBlur(padded, (0, 0), 0.8), np.float64)
    return smoothed / max(float(smoothed.max()), 1e-12)


def _over_picture(scene: Image, heat: Occupancy, plane: GroundPlane) -> Image:
    import cv2

    height, width = scene.shape[:2]
    across = (np.arange(width) + 0.5) * plane.width_px / width
    x, y = np.meshgrid(across, (np.arange(height) + 0.5) * plane.height_px / height)
    at = np.stack([x.ravel(), y.ravel()], axis=-1)
    with np.errstate(all="ignore"):
        metres = plane.pixels_to_metres(at)
        depth = np.append(at, np.ones((len(at), 1)), axis=1) @ plane.matrix[2]
        near = float(plane.matrix[2] @ [plane.width_px / 2, plane.height_px, 1.0])
        is_ground = np.isfinite(metres).all(axis=1) & (depth / near > 1 / _FARTHEST)
        cells = (metres - np.array(heat.low_m)) / heat.cell_m + 1.5  # of the padded grid, from the middle of a cell
    cells[~is_ground] = -10
    grid = _smooth(heat)
    place = cells.astype(np.float32).reshape(height, width, 2)
    density = cv2.remap(grid.astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=0)
    return _painted((scene * 0.75).astype(np.uint8), np.asarray(density, np.float64))


def _from_above(heat: Occupancy, width_px: int) -> Image:
    import cv2

    low, high = np.array(heat.low_m), np.array(heat.high_m)
    sight = sight_of(low, high, np.maximum(high - low, 1.0) * 1.15, width_px)
    x = (np.arange(sight.width_px) + 0.5 - sight.width_px / 2) / sight.px_per_m + sight.x_m
    y = -(np.arange(sight.height_px) + 0.5 - sight.height_px / 2) / sight.px_per_m + sight.y_m
    across, up = (x - low[0]) / heat.cell_m + 1.5, (y - low[1]) / heat.cell_m + 1.5
    column, row = np.meshgrid(across.astype(np.float32), up.astype(np.float32))
    density = cv2.remap(_smooth(heat).astype(np.float32), column, row, cv2.INTER_LINEAR, borderValue=0)
    return draw(_painted(from_above.ground(sight), np.asarray(density, np.float64)), from_above.grid(sight))


def _painted(image: Image, share: Floats) -> Image:
    """Paint shares (H, W) from 0 to 1 over a picture; the square root of a share gives its colour."""
    import cv2

    level = np.sqrt(share.clip(0, 1))
    colours = np.asarray(
        cv2.applyColorMap(np.rint(55 + 200 * level).astype(np.uint8), cv2.COLORMAP_INFERNO), np.float64
    )
    opacity = (_OPACITY * np.clip(share / _FADED, 0, 1))[..., None]
    return np.rint(image * (1 - opacity) + colours * opacity).astype(np.uint8)


def _with_legend(image: Image, most: float, total_s: float, topic: str) -> Image:
    """The picture above a strip with the colours, their values and what was counted."""
    import cv2

    width = image.shape[1]
    line = round(np.clip(width / 45, 10, 40))
    strip = np.full((line * 4, width, 3), BACKGROUND, np.uint8)
    long = width // 3
    level = np.linspace(0, 1, long)
    colours = cv2.applyColorMap(np.rint(55 + 200 * level).astype(np.uint8)[None], cv2.COLORMAP_INFERNO)
    strip[line // 2 : line // 2 + line, line : line + long] = colours
    for share in (0.0, 0.5, 1.0) if long > line * 8 else (0.0, 1.0):
        text = f"{most * share**2:.2g}" + (" s/m2" if share == 1 else "")
        put_text(strip, text, (line + round(long * share * 0.96), round(line * 2.6)), line * _TEXT, INK)
    amount = f"{total_s:.0f} person-seconds" if total_s < 600 else f"{total_s / 60:.0f} person-minutes"
    text = f"{amount} of {topic}"
    size_px = line * _TEXT
    size_px *= min(1.0, (width - long - 4.5 * line) / max(text_size(text, size_px)[0], 1))
    put_text(strip, text, (round(long + 3.5 * line), round(line * 1.4)), size_px, INK)
    return np.concatenate([image, strip])
