"""Samples -> re-tracked tracks: re-tracking by prediction (Yu and Zhou, IROS 2021).

Read ``methods`` first: it makes an online pass of each class (``passes``), offline tracks of what that leaves
(``offline``), and all outputs. Two methods associate observations online: ``Retrack``, by likelihood
(``online_tracker``), and ``RetrackByConsistency``, Algorithm 1 of the paper (``consistency``). ``offline`` decides
about identities (``hypotheses``, by the motion before and after gaps: ``linking``), resolves identity swaps
(``identity_swaps``), leaves out false tracks (``false_tracks``) and smooths (``motion_model``). ``decisions`` says how
likely that is right, draws worlds, and obeys answers of people. All of this is in metres: where their scale is guessed
and can't be right (``poor_scale``), ``in_pictures`` cuts tracks at gaps and links them over these by their boxes.
"""

from __future__ import annotations

from mcaptrack.transforms.retrack.methods import PROFILES, Retrack, RetrackByConsistency, Retracking
from mcaptrack.transforms.retrack.options import RetrackOptions

__all__ = ["PROFILES", "Retrack", "RetrackByConsistency", "RetrackOptions", "Retracking"]
