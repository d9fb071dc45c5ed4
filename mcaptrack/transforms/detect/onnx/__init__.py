"""Learned detectors: networks in ONNX format, run by ONNX Runtime.

``detector`` is the transform; ``session`` opens and runs the network, ``graph`` reads its file, ``layouts`` knows what
families of networks take and give, ``convention`` tells the family, ``placing`` puts pictures and tiles into the input,
``nms`` suppresses boxes of the same object, and ``classes`` names classes. ``catalogue`` says where weights come from,
and ``catalogued`` has their detectors.
"""

from __future__ import annotations

from mcaptrack.transforms.detect.onnx.detector import OnnxDetector

__all__ = ["OnnxDetector"]
