"""Inputs: videos, logs, messages of other software, labels, drawn scenes; and the channels of each camera."""
