"""Detections in metres -> tracks: association on the ground plane of a fixed frame, a class at a time.

``state`` keeps the tracks as arrays, with their filters; ``association`` finds pairs of detections and tracks,
``fast_starts`` those of fast objects that are new; ``lost_tracks`` finds the lost tracks that new ones continue;
``output`` delays rows, so that false births can be taken back; ``tracker`` runs them.
"""

from __future__ import annotations

from mcaptrack.transforms.ground.tracker import GroundTracker

__all__ = ["GroundTracker"]
