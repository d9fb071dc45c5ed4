"""Arithmetic of boxes, the ground plane, clocks, filters and assignment: arrays in, arrays out."""
