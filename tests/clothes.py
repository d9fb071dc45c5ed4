"""People in coloured clothes, drawn, as samples and as what is seen of them."""

from __future__ import annotations

from functools import cache

import numpy as np

from mcaptrack.geometry.colour_histograms import LENGTH, at_border, describe, is_clear
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.sources.demo import Pedestrian, SyntheticFrame, SyntheticScene
from mcaptrack.transforms.retrack.appearance import Descriptors

WIDTH, HEIGHT = 208, 117
RED, BLUE = (30, 30, 200), (200, 60, 20)
HIDDEN_S, UNTIL_S = 14.0, 15.8


def side(way: float) -> tuple[tuple[float, float, float], ...]:
    """A route to and fro on one side (-1 or 1): to the middle, and after a while in which nobody is seen, back again."""
    turns = [(0.0, 3.7), (3.0, 0.8), (6.0, 3.7), (9.0, 0.8), (12.0, 3.7), (HIDDEN_S, 0.4)]
    turns += [(UNTIL_S, 0.4), (UNTIL_S + 2.0, 3.7), (21.0, 0.8), (24.0, 3.7), (27.0, 0.8), (30.0, 3.7)]
    return tuple((seconds, way * x_m, 9.0) for seconds, x_m in turns)


#: The ids of both people, from these seconds on.
NEW_IDS = ((0.0, (1, 2)), (UNTIL_S, (11, 12)))


@cache
def _shots(*colours: tuple[int, int, int]) -> list[SyntheticFrame]:
    """Pictures, 2.5 a second, of two people in clothes of these colours, who turn back where they meet."""
    people = tuple(
        Pedestrian(n + 1, side(way), one) for n, (way, one) in enumerate(zip((-1.0, 1.0), colours, strict=True))
    )
    scene = SyntheticScene(people, 30.0, fps=5, width_px=WIDTH, height_px=HEIGHT, mast_m=4.0, tilt_deg=20.0)
    return list(scene.shots())[::2]


@cache
def two_who_turn_back(first, second, ids_since=NEW_IDS) -> tuple[tuple[Frame, ...], Descriptors]:
    """Samples of two people in clothes of these colours, and what is seen of them.

    They walk towards each other, aren't detected for 1.8 s, and walk away from each other under other ids: by their
    motion they have passed each other, but each has turned back.
    """
    frames, seen = [], []
    for number, shot in enumerate(_shots(first, second)):
        t_ns = round(shot.seconds * 1e9)
        there = not HIDDEN_S - 0.1 < shot.seconds < UNTIL_S + 0.1
        ids = np.array(shot.ids if there else [], np.int64)
        ids = np.array([own for since, own in ids_since if shot.seconds >= since][-1])[ids - 1]
        x_m, y_m = shot.places_m[: len(ids)].T
        boxes = shot.boxes[: len(ids)]
        columns = dict(zip(("x_px", "y_px", "w_px", "h_px"), boxes.T, strict=True))
        of_track = {"track_id": ids, "observed": np.ones(len(ids), bool), "source_id": np.full(len(ids), -1)}
        frames.append(Frame(t_ns, number, TRACKS.rows(**of_track, x_m=x_m, y_m=y_m, **columns)))
        clear = is_clear(boxes, WIDTH, HEIGHT)
        values = np.zeros((len(ids), LENGTH), np.uint8)
        values[clear] = describe(shot.image, boxes[clear])
        seen.append(Descriptors(np.full(len(ids), t_ns), ids, values, clear, at_border(boxes, WIDTH, HEIGHT)))
    return tuple(frames), Descriptors(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))
