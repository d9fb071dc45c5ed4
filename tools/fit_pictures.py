"""Fit what tells right links in pictures from wrong ones, on drawn crowds before drawn cameras (``pictured.py``).

Detections are tracked by SORT; its tracks are cut at gaps, and all pairs of pieces that may be one person are compared
with who was there. Right is the pair that is nearest in time from both sides. Prints the weights, and how reliable
links are in scenes of other seeds; ``fit_retrack.py`` writes them. No recording is used.

    .venv/bin/python tools/fit_pictures.py

Letters: K pieces, E pairs, F features.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from pictured import Pictured, drawn
from regression import logistic, show_reliability

from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.schema import TRACKS
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.framing import join_frames
from mcaptrack.transforms import Sort
from mcaptrack.transforms.retrack.in_pictures import (
    AMONG_OTHERS,
    FEATURES,
    BoxPieces,
    among_others,
    find_candidates,
    find_pieces,
)
from mcaptrack.transforms.retrack.linking import best_links
from mcaptrack.transforms.retrack.options import MAX_LINK_IN_PICTURE_S
from mcaptrack.transforms.retrack.weights import probability

SEEDS, HELD = (301, 302, 303, 304), (311,)
#: A piece begins and ends with the person who most of its boxes within so many seconds overlap by so much.
NEAR_S, MIN_IOU = 0.5, 0.4
#: Links of at least this probability are taken when probabilities of the best are fitted.
LEAST = 0.05


class Pairs(NamedTuple):
    """Pairs of a scene: pieces (E,), features (E, F) and which are right (E,); and how many pieces there are."""

    before: np.ndarray
    after: np.ndarray
    features: np.ndarray
    right: np.ndarray
    count: int

    def best(self, log_odds: np.ndarray) -> np.ndarray:
        """The pairs of the likeliest links, one on each side of a piece."""
        return best_links(self.before, self.after, log_odds - np.log(LEAST / (1 - LEAST)), self.count)


def pairs_of(scene: Pictured) -> Pairs:
    """The pairs of a scene of which one piece at least is of somebody."""
    tracks = collect(TRACKS, (frame for (frame,) in Sort()(scene.detected)))
    pieces = find_pieces(tracks, ())
    i, j, features = find_candidates(pieces, MAX_LINK_IN_PICTURE_S)
    owner = _owners(pieces, scene)
    ends, begins = _usual(pieces, owner, pieces.first[1:] - 1), _usual(pieces, owner, pieces.first[:-1])
    same = np.flatnonzero((ends[i] >= 0) & (ends[i] == begins[j]))
    right, gap_s = np.ones(len(i), bool), features[:, FEATURES.index("gap")]
    for side in (i, j):
        nearest = same[np.lexsort((gap_s[same], side[same]))]
        right &= np.isin(np.arange(len(i)), nearest[np.unique(side[nearest], return_index=True)[1]])
    counts = (ends[i] >= 0) | (begins[j] >= 0)
    return Pairs(i[counts], j[counts], features[counts], right[counts], len(pieces.source))


def _owners(pieces: BoxPieces, scene: Pictured) -> np.ndarray:
    """The person whom each box overlaps most, -1 for none."""
    true = join_frames(TRACKS, scene.true)
    low, high = (np.searchsorted(true.frame, pieces.frame, side) for side in ("left", "right"))
    which, row = group_index(high - low), ragged_range(low, high - low)
    a, b = pieces.boxes[which], columns_to_boxes(true.rows)[row]
    corner = np.minimum(a[:, :2] + a[:, 2:], b[:, :2] + b[:, 2:])
    both = np.clip(corner - np.maximum(a[:, :2], b[:, :2]), 0, None).prod(axis=1)
    iou = both / (a[:, 2:].prod(axis=1) + b[:, 2:].prod(axis=1) - both)
    order = np.lexsort((iou, which))
    out, best = np.full(len(pieces.frame), -1), np.zeros(len(pieces.frame))
    out[which[order]], best[which[order]] = true.rows["track_id"][row[order]], iou[order]
    return np.where(best >= MIN_IOU, out, -1)


def _usual(pieces: BoxPieces, owner: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The person (K,) of most boxes near one end of each piece, -1 for none."""
    near = np.abs(pieces.t_s - pieces.t_s[at][pieces.piece]) <= NEAR_S
    count = np.bincount(pieces.piece[near], minlength=len(at))
    pairs, times = np.unique(np.stack([pieces.piece[near], owner[near]]), axis=1, return_counts=True)
    out = np.full(len(at), -1)
    usual = times * 2 >= count[pairs[0]]
    out[pairs[0][usual]] = pairs[1][usual]
    return out


def read(seeds: Iterable[int]) -> list[Pairs]:
    """The pairs of all scenes of these seeds."""
    return [pairs_of(scene) for seed in seeds for scene in drawn(seed)]


def fitted(scenes: list[Pairs]) -> dict[str, dict[str, Any]]:
    """The weights of pairs by themselves, and of links among others.

    The best of competing links is right more often than its own odds say: that is fitted in a last step.
    """
    features, right = (np.concatenate([getattr(scene, name) for scene in scenes]) for name in ("features", "right"))
    pairs = logistic(features, right, np.ones(len(right)))
    among = [among_others(scene.before, scene.after, scene.features @ pairs[:-1] + pairs[-1]) for scene in scenes]
    links = logistic(np.concatenate(among), right, np.ones(len(right)))
    odds = [part @ links[:-1] + links[-1] for part in among]
    best = [scene.best(log_odds) for scene, log_odds in zip(scenes, odds, strict=True)]
    chosen = np.concatenate([log_odds[which] for log_odds, which in zip(odds, best, strict=True)])
    is_right = np.concatenate([scene.right[which] for scene, which in zip(scenes, best, strict=True)])
    scale, shift = logistic(chosen[:, None], is_right, np.ones(len(chosen)))
    return {
        "pairs in pictures": _named(FEATURES, pairs),
        "links in pictures": _named(AMONG_OTHERS, np.append(scale * links[:-1], scale * links[-1] + shift)),
    }


def _named(names: tuple[str, ...], weights: np.ndarray) -> dict[str, Any]:
    named = dict(zip(names, np.round(weights[:-1], 3).tolist(), strict=True))
    return {"weights": named, "bias": round(float(weights[-1]), 3)}


def log_odds(scene: Pairs, weights: dict[str, dict[str, Any]]) -> np.ndarray:
    """The log odds (E,) of links by these weights."""
    pairs, links = (np.append(list(each["weights"].values()), each["bias"]) for each in weights.values())
    among = among_others(scene.before, scene.after, scene.features @ pairs[:-1] + pairs[-1])
    return np.asarray(among @ links[:-1] + links[-1])


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    weights = fitted(read(SEEDS))
    print(json.dumps(weights, indent=1))
    parts = []
    for scene in read(HELD):
        odds = log_odds(scene, weights)
        which = scene.best(odds)
        parts.append((odds[which], scene.right[which]))
    odds, right = (np.concatenate(part) for part in zip(*parts, strict=True))
    show_reliability("links of other scenes", probability(odds), right)


if __name__ == "__main__":
    main()
