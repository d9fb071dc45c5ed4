"""OC-SORT (Cao et al., CVPR 2023): trust what was observed more than what the filter made of it.

Three things beside SORT. Observation-centric momentum (OCM): pairs in which a track would go on in its direction
are more alike. Recovery (OCR): tracks and boxes that are left over are paired once more, by where the tracks were seen
last. Re-update (ORU): a track that is seen again after a while has its filter run anew along the straight line from
where it was seen last, so that what it dreamt in between does no harm.

Letters: N boxes, K tracks, P pairs, T frames remembered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from mcaptrack.geometry import kalman
from mcaptrack.geometry.arrays import Floats, Indices
from mcaptrack.transforms.protocol import option
from mcaptrack.transforms.sort.affinity import Pairs, by_overlap, pair
from mcaptrack.transforms.sort.tracker import Moment, Sort
from mcaptrack.transforms.sort.tracks import SHARED_ROWS, Seen, Tracks

# Rows below the shared ones: the corners of the box seen last; the filter's state then; how many frames ago that was;
# and the centres seen in the last frames, oldest first, NaN where there was none.
_LAST: Final = slice(SHARED_ROWS, SHARED_ROWS + 4)
_THEN: Final = slice(_LAST.stop, _LAST.stop + kalman.STATE_ROWS)
_AGO: Final = _THEN.stop
_PATH: Final = _AGO + 1


@dataclass(frozen=True, kw_only=True)
class OcSort(Sort):
    """OC-SORT: observations count for more than the filter.

    Matches that keep a track's direction of motion are preferred, lost tracks are matched once more by their last
    detection, and a track that is found again has its filter recomputed over the gap.
    """

    inertia: float = option(0.2, "weight of the direction of motion, beside overlap", least=0.0, search=(0.0, 0.6))
    direction_frames: int = option(
        3, "number of frames over which the direction of motion is measured", least=2, most=100, search=(2, 10)
    )
    recover: bool = option(True, "match lost tracks once more by their last detection")
    reupdate: bool = option(True, "recompute the filter over the gap when a track is found again")

    def _no_tracks(self) -> Tracks:
        return Tracks(_PATH - SHARED_ROWS + 2 * (self.direction_frames + 1))

    def _pair(self, moment: Moment) -> tuple[Indices, Indices]:
        table = moment.tracks.table
        path = table[_PATH:]
        for _ in range(min(moment.steps, self.direction_frames + 1)):
            path[:-2] = path[2:].copy()
            path[-2:] = np.nan
        table[_AGO] += moment.steps

        pairs, least = self._likeness(moment, self.min_iou)
        near = pairs.where(pairs.likeness >= least)
        if self.inertia > 0 and len(near.box):
            near = near._replace(likeness=near.likeness + self.inertia * (0.5 + self._momentum(moment, near)))
        box, track = pair(near, 0.0)
        if not self.recover or len(box) == min(len(moment.seen), len(moment.tracks)):
            return box, track
        rest = self._where_last_seen(moment, box, track)
        more_box, more_track = pair(rest, self.min_iou)
        return np.concatenate([box, more_box]), np.concatenate([track, more_track])

    def _momentum(self, moment: Moment, pairs: Pairs) -> Floats:
        """How well a pair (P,) goes on in the track's direction: 0.5 straight on, -0.5 straight back, 0 unknown.

        Weighted by the score of the box, as in the paper's program.
        """
        table, seen = moment.tracks.table, moment.seen
        path, tracks = table[_PATH:].reshape(-1, 2, table.shape[1]), np.arange(table.shape[1])
        there = np.isfinite(path[:, 0])
        # The oldest and the newest place that is remembered: the same one has no direction, and neither has NaN.
        before = path[there.argmax(axis=0), :, tracks].T
        last = path[-1 - there[::-1].argmax(axis=0), :, tracks].T
        was, now = (last - before)[:, pairs.track], seen.measured[:2, pairs.box] - before[:, pairs.track]
        length = np.hypot(was[0], was[1]) * np.hypot(now[0], now[1])
        known = length > 0  # False for NaN
        cosine = (was * now).sum(axis=0) / np.where(known, length, 1.0)
        angle = np.arccos(np.clip(np.where(known, cosine, 0.0), -1.0, 1.0))
        score = seen.score[pairs.box]
        weight: Floats = (0.5 - angle / np.pi) * np.where(np.isnan(score), 1.0, np.clip(score, 0.0, 1.0))
        return weight

    def _where_last_seen(self, moment: Moment, box: Indices, track: Indices) -> Pairs:
        """The pairs of boxes and tracks that are left over, by the tracks' last boxes."""
        box_left, track_left = np.ones(len(moment.seen), bool), np.ones(len(moment.tracks), bool)
        box_left[box], track_left[track] = False, False
        boxes, tracks = np.flatnonzero(box_left), np.flatnonzero(track_left)
        last = moment.tracks.table[_LAST][:, tracks]
        area = (last[2] - last[0]) * (last[3] - last[1])
        found = by_overlap(moment.seen.corners[:, boxes], last, moment.seen.measured[2, boxes], area)
        pairs = Pairs(boxes[found.box], tracks[found.track], found.likeness, (len(box_left), len(track_left)))
        return self._of_one_class(moment, pairs)

    def _begin(self, tracks: Tracks, first_id: int, seen: Seen) -> None:
        tracks.add(first_id, seen)
        new = np.arange(len(tracks) - len(seen), len(tracks))
        self._remember(tracks, new, seen)

    def _see(self, tracks: Tracks, at: Indices, seen: Seen, hit: float, steps: int) -> None:
        ago = tracks.table[_AGO, at]
        lost = np.flatnonzero(ago > steps) if self.reupdate else at[:0]
        if len(lost):
            tracks.state[:, at[lost]] = _run_anew(tracks.table[:, at[lost]], seen.corners[:, lost])
        tracks.see(at, seen, hit)
        self._remember(tracks, at, seen)

    @staticmethod
    def _remember(tracks: Tracks, at: Indices, seen: Seen) -> None:
        table = tracks.table
        table[_LAST, at] = seen.corners
        table[_THEN, at] = table[: kalman.STATE_ROWS, at]
        table[_AGO, at] = 0.0
        table[-2:, at] = seen.measured[:2]


def _run_anew(table: Floats, corners: Floats) -> Floats:
    """The states (17, K) of tracks that are found again in boxes with these corners (4, K), just before they see them.

    From the state when they were seen last, along boxes on the straight line in between, all frames as if seen.
    """
    state, last, ago = table[_THEN].copy(), table[_LAST], table[_AGO].astype(int)
    for frame in range(1, int(ago.max()) + 1):
        going = ago >= frame
        part = state[:, going]
        kalman.predict(part)
        between = going & (ago > frame)
        if between.any():
            share = frame / ago[between]
            seen = last[:, between] + share * (corners[:, between] - last[:, between])
            inner = between[going]
            corrected = part[:, inner]
            kalman.correct(corrected, kalman.measure(np.concatenate([seen[:2], seen[2:] - seen[:2]])))
            part[:, inner] = corrected
        state[:, going] = part
    return state
