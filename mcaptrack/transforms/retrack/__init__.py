"""Samples -> re-tracked tracks: re-tracking by prediction (Yu and Zhou, IROS 2021).

Two methods associate observations online: ``Retrack``, by likelihood (``likelihood``), and ``RetrackByConsistency``,
Algorithm 1 of the paper (``consistency``). Both leave assignments of samples to tracks, from which ``offline`` makes
the tracks of the whole log: it decides about identities (``hypotheses``), resolves identity swaps
(``identity_swaps``), leaves out false tracks (``false_tracks``) and smooths (``motion_model``); ``worlds`` decides
again, with noise. All of this is in metres: where their scale is guessed and can't be right (``poor_scale``),
``in_pictures`` cuts tracks at gaps and links them over these by their boxes.
"""

from __future__ import annotations

from mcaptrack.transforms.retrack.methods import PROFILES, Retrack, RetrackByConsistency, Retracking
from mcaptrack.transforms.retrack.options import RetrackOptions

__all__ = ["PROFILES", "Retrack", "RetrackByConsistency", "RetrackOptions", "Retracking"]
