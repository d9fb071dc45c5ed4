"""Pictures -> detections.

``background`` and ``median`` have the motion detectors, for cameras that stand still or nearly. ``registration``
registers pictures of a shaking camera, ``median_background`` compares a picture with its background,
``person_model`` learns how people look, ``people`` separates those who are one region, ``steadiness`` warns where the
camera moves. ``onnx`` has learned detectors.
"""

from __future__ import annotations

from mcaptrack.transforms.detect.background import KnnDetector
from mcaptrack.transforms.detect.median import MedianDetector
from mcaptrack.transforms.detect.onnx import OnnxDetector

__all__ = ["KnnDetector", "MedianDetector", "OnnxDetector"]
