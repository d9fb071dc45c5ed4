"""Ingest the calibration of a camera alone, for the pictures or the boxes of an existing log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.calibrations import frame_of
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.ingest.job import IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.camera import boxes_extent, camera_of, picture_size


class CalibrationJob(IngestJob):
    """The calibration of a camera of a log: a file that is itself the input, and those that were given beside it."""

    def __init__(self, source: Path, options: IngestOptions, into: log.Log | None) -> None:
        if into is None:
            raise McaptrackError(
                f"{source}: a calibration belongs to a log with pictures or boxes of the camera; name it with `into=`, "
                "or give the calibration with `calibration=` while the log is made"
            )
        if options.labels or options.motion is not None:
            raise McaptrackError(
                f"{source} is a calibration; add labels and motions of the camera in a call of their own"
            )
        super().__init__(source, replace(options, calibration=(source, *options.calibration)), into)
        self.prefix, self.pictures = camera_of(into, options.camera)
        below = [topic for topic in into.channels if topic.startswith(f"{self.prefix}/")]
        if not below:
            names = sorted({topic.strip("/").partition("/")[0] for topic in into.channels})
            raise McaptrackError(
                f"{into.path} has no camera {self.prefix[1:]} that {source} could be of (`camera=`); its topics begin "
                f"with {', '.join(names) or 'nothing'}"
            )
        # In the frame of what the camera recorded, as the transforms name it, the calibration replaces a recorded one.
        recorded = self.pictures or camera_at(into, self.prefix).boxes
        self.frame_id = frame_of(into, recorded) if recorded else ""
        size = picture_size(into, self.pictures) if self.pictures else options.size
        extent = size or boxes_extent(into, f"{self.prefix}/detections")
        self._plane = self.plane(*extent, is_stated=size is not None)
        self._t_ns = int(into.times(self.pictures)[0]) if self.pictures else into.start_ns

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the calibration, and the ground plane that follows from it."""
        self.write_plane(writer, self._plane, self._t_ns)
