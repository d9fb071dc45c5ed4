"""Ingest a video or a folder of images as a camera, with labels for its pictures."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.schema.provenance import CLOCK, Provenance
from mcaptrack.sources.ingest.job import IngestJob, IngestOptions, Progress
from mcaptrack.sources.ingest.labels.timeline import Timeline, labels_of
from mcaptrack.sources.video import Video, open_video

_FOXGLOVE_ALONE: Final = {"vp9": "VP9", "av1": "AV1"}
#: Frame rates with a smaller relative difference are equal: 29.97 and 30000/1001.
_SAME_FPS: Final = Fraction(1, 1000)


class VideoJob(IngestJob):
    """A video or image folder, with its labels."""

    drops_clock = True
    other_camera = "{camera}2"

    def __init__(self, source: Path, options: IngestOptions, progress: Progress, into: log.Log | None) -> None:
        super().__init__(source, options, into)
        self._progress = progress
        if options.role:
            raise McaptrackError(f"{source} is not a label file; `role=` applies to those")
        if options.frames is not None:
            raise McaptrackError(f"{source} is not a label file; `frames=` applies to labels without pictures")
        self.video: Video = open_video(source, options.video_options)
        if self.video.images and not (options.fps or self.video.fps):
            raise McaptrackError(f"{source}: a folder of images has no clock; give the frames per second with `fps=`")
        self.fit_to_pictures(lambda: (self.video.width_px, self.video.height_px))
        self._plane = self.plane(self.video.width_px, self.video.height_px)
        self.pictures = f"{self.prefix}/video"
        self._existing_labels = {} if into is None else labels_of(into, self.prefix)

    def topics(self) -> Iterator[str]:
        """The topics of pictures and labels."""
        yield self.pictures
        yield from super().topics()

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the pictures, then the labels at the times of their pictures."""
        options, video, keep = self.options, self.video, self.options.video_options
        start_ns = video.start_ns if options.start_ns is None else options.start_ns
        start_ns = 0 if start_ns is None else start_ns
        schema_name = foxglove.IMAGE if keep.is_still else foxglove.VIDEO
        parameters: dict[str, str | int | float] = {"file": video.path.name, "image_format": video.format}
        if options.fps is not None:
            parameters["fps"] = str(options.fps)
            self._warn_fps(options.fps)
        if video.every > 1:
            parameters["every"] = video.every
        if video.why_transcode:
            parameters |= {"encoded_again_because": video.why_transcode}
            parameters |= {"crf": keep.crf, "keyframe_interval_s": keep.key_every_s}
            self.report.remarks.append(f"{video.path} is encoded again, as H.264: {video.why_transcode}")
        elif video.format in _FOXGLOVE_ALONE:
            kept = f"{video.path} is kept as {_FOXGLOVE_ALONE[video.format]}, which Foxglove plays"
            self.report.remarks.append(f"{kept} and Lichtblick does not (`image_format='h264'` is for both)")
        elif video.format == "jpeg":
            parameters["quality"] = keep.jpeg_quality
        channel = writer.add_channel(
            self.pictures,
            foxglove.record_in(schema_name, self.encoding),
            self.encoding,
            Provenance("ingest", parameters).to_metadata(),
            kind="media",
        )
        writer.add_metadata(CLOCK, {"start_ns": str(start_ns)})
        times, numbers = array("q"), array("q")
        frame_id = self.prefix.lstrip("/")
        packed = (
            (
                picture.t_ns,
                picture.index,
                foxglove.pack_picture(schema_name, picture.t_ns, frame_id, video.format, picture.data),
            )
            for picture in video.pictures(start_ns)
        )
        for t_ns, index, data in foxglove.messages_in(schema_name, packed, self.encoding):
            writer.add_message(channel, t_ns, index, data)
            times.append(t_ns)
            numbers.append(index)
            self._progress("ingest", len(times), max(video.frames, len(times)))
        if not times:
            raise McaptrackError(f"{video.path} is a video without frames")
        self.report.messages[self.pictures] = len(times)
        self.report.remarks += video.notes
        self.report.lost += video.lost
        of = f"the pictures of {video.path}"
        timeline = Timeline(np.array(numbers), np.array(times), of, not video.lost, video.every)
        self._check_existing(timeline)
        self.write_plane(writer, self._plane, times[0])
        self.write_labels(writer, self._plane, timeline)
        self.write_motion(writer, timeline, (self.video.width_px, self.video.height_px))

    def _warn_fps(self, fps: Fraction) -> None:
        """Warn if the given frame rate differs from that of the video."""
        own = self.video.fps
        if own and abs(fps - own) > _SAME_FPS * own:
            text = f"{self.video.path} has {float(own):g} frames a second; its pictures are written at {float(fps):g}"
            warn(f"{text} by `fps=`", "clock")

    def _check_existing(self, timeline: Timeline) -> None:
        """Check that existing labels in the log have the times of these pictures."""
        for topic, labels in self._existing_labels.items():
            if self.into and topic not in self.topics() and not np.isin(labels.t_ns, timeline.t_ns).all():
                advice = (
                    f"give `fps={str(labels.fps)!r}`"
                    if labels.fps
                    else "give the `fps=` and `start_time=` that they have"
                )
                raise McaptrackError(
                    f"{self.into.path}: {topic} has labels at other times than {timeline.of}; {advice}, or `camera=` "
                    "for another camera"
                )
