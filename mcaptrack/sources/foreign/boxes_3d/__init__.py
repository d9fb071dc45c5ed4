"""Boxes in space of other software: as messages state them (``box``), and all of a channel as arrays (``recorded``)."""

from mcaptrack.sources.foreign.boxes_3d.box import BOXES_3D_READ, DRAWINGS, Message3d, boxes_3d_decoder

__all__ = ["BOXES_3D_READ", "DRAWINGS", "Message3d", "boxes_3d_decoder"]
