"""Detections -> tracks: SORT and two trackers derived from it, written from their papers.

They share their parameters, and the state and the lifecycle of tracks (``tracker``). They differ in how they associate.
"""

from __future__ import annotations

from mcaptrack.transforms.sort.ocsort import OcSort
from mcaptrack.transforms.sort.tracker import ByteTrack, Sort

__all__ = ["ByteTrack", "OcSort", "Sort"]
