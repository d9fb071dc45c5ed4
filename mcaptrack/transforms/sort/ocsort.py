"""OC-SORT (Cao et al., CVPR 2023): observation-centric SORT, which trusts observations more than the filter.

It adds three things to SORT. Observation-centric momentum (OCM): pairs that keep the track's direction of motion are
more similar. Observation-centric recovery (OCR): tracks and detections that remain are associated once more, by the
last detections of the tracks. Observation-centric re-update (ORU): when a track is detected again after a gap, its
filter is recomputed along the straight line from its last detection, which removes the errors of coasting.

Letters: N detections, K tracks, P pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from mcaptrack.geometry import kalman
from mcaptrack.geometry.affine import move_boxes, move_points
from mcaptrack.geometry.arrays import Floats, Indices
from mcaptrack.transforms.protocol import parameters, setting
from mcaptrack.transforms.sort.tracker import (
    SHARED_ROWS,
    AssociationInput,
    BoxTracks,
    CandidatePairs,
    Measurements,
    Sort,
    associate,
    iou_pairs,
)

# Rows of the table below the shared ones: corners of the last detection; state of the filter after it; frames since
# then; and centres of the detections in the last frames, oldest first, NaN where the track was missed.
_LAST_BOX: Final = slice(SHARED_ROWS, SHARED_ROWS + 4)
_LAST_STATE: Final = slice(_LAST_BOX.stop, _LAST_BOX.stop + kalman.STATE_ROWS)
_FRAMES_SINCE: Final = _LAST_STATE.stop
_CENTRES: Final = _FRAMES_SINCE + 1


@dataclass(frozen=True, kw_only=True)
@parameters
class OcSort(Sort):
    """OC-SORT: observations count for more than the filter.

    Matches that keep a track's direction of motion are preferred, lost tracks are matched once more by their last
    detection, and a track that is found again has its filter recomputed over the gap.

    Parameters
    ----------
    inertia : float
        Weight of the direction of motion, beside overlap.
    direction_frames : int
        Number of frames over which the direction of motion is measured.
    recover : bool
        Match lost tracks once more by their last detection.
    reupdate : bool
        Recompute the filter over the gap when a track is found again.

    Examples
    --------
    A person walks, is missed for half a second, and keeps the track:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(t):
    ...     box = {"x_px": [100.0 + 3 * t], "y_px": [50.0], "w_px": [40.0], "h_px": [120.0]}
    ...     return DETECTIONS.rows(class_id=[1], **box)
    >>> frames = [Frame(t * 100_000_000, t, DETECTIONS.empty() if 10 <= t < 15 else row(t)) for t in range(20)]
    >>> {id for (tracks,) in OcSort()(frames) for id in tracks.rows["track_id"].tolist()}
    {1}

    References
    ----------
    J. Cao et al., "Observation-Centric SORT: Rethinking SORT for Robust Multi-Object Tracking", CVPR 2023.
    """

    inertia: float = setting(0.2, least=0.0, search=(0.0, 0.6))
    direction_frames: int = setting(3, least=2, most=100, search=(2, 10))
    recover: bool = setting(True)
    reupdate: bool = setting(True)

    def _empty_tracks(self) -> BoxTracks:
        return BoxTracks(_CENTRES - SHARED_ROWS + 2 * (self.direction_frames + 1))

    def _associate(self, step: AssociationInput) -> tuple[Indices, Indices]:
        table = step.tracks.table
        centres = table[_CENTRES:]
        for _ in range(min(step.frames, self.direction_frames + 1)):
            centres[:-2] = centres[2:].copy()
            centres[-2:] = np.nan
        table[_FRAMES_SINCE] += step.frames

        pairs, min_similarity = self._candidate_pairs(step, self.min_iou)
        near = pairs.select(pairs.similarity >= min_similarity)
        if self.inertia > 0 and len(near.detection):
            bonus = self.inertia * (0.5 + self._direction_consistency(step, near))
            near = near._replace(similarity=near.similarity + bonus)
        detection, track = associate(near, 0.0)
        if not self.recover or len(detection) == min(len(step.detections), len(step.tracks)):
            return detection, track
        remaining = self._recovery_pairs(step, detection, track)
        recovered_detection, recovered_track = associate(remaining, self.min_iou)
        return np.concatenate([detection, recovered_detection]), np.concatenate([track, recovered_track])

    def _direction_consistency(self, step: AssociationInput, pairs: CandidatePairs) -> Floats:
        """Consistency of pairs (P,) with the track's direction: 0.5 straight on, -0.5 straight back, 0 unknown (OCM).

        Weighted by the score of the detection, as in the paper's program.
        """
        table, detections = step.tracks.table, step.detections
        centres, tracks = table[_CENTRES:].reshape(-1, 2, table.shape[1]), np.arange(table.shape[1])
        is_known = np.isfinite(centres[:, 0])
        # The oldest and the newest known centre: if they are the same or NaN, the direction is unknown.
        oldest = centres[is_known.argmax(axis=0), :, tracks].T
        newest = centres[-1 - is_known[::-1].argmax(axis=0), :, tracks].T
        before = (newest - oldest)[:, pairs.track]
        now = detections.measured[:2, pairs.detection] - oldest[:, pairs.track]
        length = np.hypot(before[0], before[1]) * np.hypot(now[0], now[1])
        has_direction = length > 0  # False for NaN
        cosine = (before * now).sum(axis=0) / np.where(has_direction, length, 1.0)
        angle = np.arccos(np.clip(np.where(has_direction, cosine, 0.0), -1.0, 1.0))
        score = detections.score[pairs.detection]
        weight: Floats = (0.5 - angle / np.pi) * np.where(np.isnan(score), 1.0, np.clip(score, 0.0, 1.0))
        return weight

    def _recovery_pairs(self, step: AssociationInput, detection: Indices, track: Indices) -> CandidatePairs:
        """The pairs of detections and tracks that remain, by the last detections of the tracks (OCR)."""
        detection_left, track_left = np.ones(len(step.detections), bool), np.ones(len(step.tracks), bool)
        detection_left[detection], track_left[track] = False, False
        detections, tracks = np.flatnonzero(detection_left), np.flatnonzero(track_left)
        last = step.tracks.table[_LAST_BOX][:, tracks]
        area = (last[2] - last[0]) * (last[3] - last[1])
        near = iou_pairs(step.detections.corners[:, detections], last, step.detections.measured[2, detections], area)
        shape = (len(detection_left), len(track_left))
        pairs = CandidatePairs(detections[near.detection], tracks[near.track], near.similarity, shape)
        return self._of_same_class(step, pairs)

    def _move(self, tracks: BoxTracks, motion: Floats) -> None:
        super()._move(tracks, motion)
        table = tracks.table
        kalman.move(table[_LAST_STATE], motion)
        box = table[_LAST_BOX].T
        moved = move_boxes(motion, np.concatenate([box[:, :2], box[:, 2:] - box[:, :2]], axis=1))
        table[_LAST_BOX] = np.concatenate([moved[:, :2], moved[:, :2] + moved[:, 2:]], axis=1).T
        for row in range(_CENTRES, len(table), 2):
            table[row : row + 2] = move_points(motion, table[row : row + 2].T).T

    def _initiate(self, tracks: BoxTracks, first_id: int, detections: Measurements) -> None:
        tracks.initiate(first_id, detections)
        new = np.arange(len(tracks) - len(detections), len(tracks))
        self._store(tracks, new, detections)

    def _update(
        self, tracks: BoxTracks, at: Indices, detections: Measurements, hit: Floats | float, frames: int
    ) -> None:
        frames_since = tracks.table[_FRAMES_SINCE, at]
        lost = np.flatnonzero(frames_since > frames) if self.reupdate else at[:0]
        if len(lost):
            tracks.state[:, at[lost]] = _reupdate(tracks.table[:, at[lost]], detections.corners[:, lost])
        tracks.update(at, detections, hit)
        self._store(tracks, at, detections)

    @staticmethod
    def _store(tracks: BoxTracks, at: Indices, detections: Measurements) -> None:
        table = tracks.table
        table[_LAST_BOX, at] = detections.corners
        table[_LAST_STATE, at] = table[: kalman.STATE_ROWS, at]
        table[_FRAMES_SINCE, at] = 0.0
        table[-2:, at] = detections.measured[:2]


def _reupdate(table: Floats, corners: Floats) -> Floats:
    """The predicted states (17, K) of tracks that are detected again in boxes with these corners (4, K) (ORU).

    They start from the states after the last detections, and are corrected with virtual boxes on the straight line from
    these to the new ones, in each frame of the gap.
    """
    state, last, frames_since = table[_LAST_STATE].copy(), table[_LAST_BOX], table[_FRAMES_SINCE].astype(int)
    for frame in range(1, int(frames_since.max()) + 1):
        running = frames_since >= frame
        part = state[:, running]
        kalman.predict(part)
        between = running & (frames_since > frame)
        if between.any():
            share = frame / frames_since[between]
            virtual = last[:, between] + share * (corners[:, between] - last[:, between])
            inner = between[running]
            corrected = part[:, inner]
            kalman.correct(corrected, kalman.measure(np.concatenate([virtual[:2], virtual[2:] - virtual[:2]])))
            part[:, inner] = corrected
        state[:, running] = part
    return state
