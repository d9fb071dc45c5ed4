"""Ingest the motion of a camera alone, for the pictures or the detections of an existing log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS
from mcaptrack.sources.ingest.job import IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.camera import boxes_extent, camera_of, picture_size, timeline_of

_BOXES: Final = "detections"


class MotionJob(IngestJob):
    """The motion of the camera of a log: a file that is itself the input."""

    def __init__(self, source: Path, options: IngestOptions, into: log.Log | None) -> None:
        if options.motion is not None:
            raise McaptrackError(f"{source} and {options.motion} are both the motion of the camera; give one")
        if into is None:
            raise McaptrackError(
                f"{source}: the motion of a camera belongs to a log with its pictures or boxes; name it with `into=`"
            )
        if options.calibration:
            raise McaptrackError(f"{source} is the motion of a camera; its calibration is added in a call of its own")
        super().__init__(source, replace(options, motion=source), into)
        self.prefix, self.pictures = camera_of(into, options.camera)
        boxes = into.channels.get(f"{self.prefix}/{_BOXES}")
        if self.pictures:
            self._timeline, self._size = timeline_of(into, self.pictures), picture_size(into, self.pictures)
        elif boxes is not None and boxes.messages and boxes.schema_name == DETECTIONS.name:
            self._timeline = timeline_of(into, boxes.topic)
            self._size = boxes_extent(into, boxes.topic)
        else:
            raise McaptrackError(f"{into.path}: {self.prefix} has no pictures or detections that {source} is about")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the motion."""
        self.write_motion(writer, self._timeline, self._size)
