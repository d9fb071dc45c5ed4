"""Detections -> tracks: SORT, and two trackers that grew out of it, all written from their papers.

They share their parameters and the life of a track (``tracker``), the state of tracks (``tracks``) and what makes a box
and a track alike (``affinity``); each adds how boxes and tracks are paired.
"""

from __future__ import annotations

from mcaptrack.transforms.sort.bytetrack import ByteTrack
from mcaptrack.transforms.sort.ocsort import OcSort
from mcaptrack.transforms.sort.tracker import Sort

__all__ = ["ByteTrack", "OcSort", "Sort"]
