"""Arithmetic of boxes, the ground plane, clocks, filters, assignment and ragged arrays: arrays in, arrays out."""
