"""Pictures -> detections.

``background`` and ``median`` have the motion detectors, for cameras that stand still or nearly; ``background`` also
registers the pictures of a shaking camera. ``people`` learns how people look and separates those who are one region.
"""

from __future__ import annotations

from mcaptrack.transforms.detect.background import KnnDetector
from mcaptrack.transforms.detect.median import MedianDetector

__all__ = ["KnnDetector", "MedianDetector"]
