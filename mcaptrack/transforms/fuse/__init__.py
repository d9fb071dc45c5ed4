"""Detections of one scene from those of several cameras."""

from mcaptrack.transforms.fuse.agreement import Offset, Shared, compare
from mcaptrack.transforms.fuse.fuser import FootFuser
from mcaptrack.transforms.fuse.view import CameraView, Joined

__all__ = ["CameraView", "FootFuser", "Joined", "Offset", "Shared", "compare"]
