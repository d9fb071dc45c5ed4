"""Learned detectors: networks in ONNX format, run by ONNX Runtime.

``detector`` is the transform, with those of the catalogue; ``session`` opens and runs the network, and says where
weights come from; ``layouts`` knows what families of networks take and give; ``nms`` puts pictures and tiles into the
input, and suppresses boxes of the same object.
"""

from __future__ import annotations

from mcaptrack.transforms.detect.onnx.detector import OnnxDetector

__all__ = ["OnnxDetector"]
