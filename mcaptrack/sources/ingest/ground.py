"""The ground plane and the calibration that a user gave for a camera: read, fitted to its pictures, and written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcaptrack import foxglove, log
from mcaptrack.choices import Point
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema.encodings import Encoding
from mcaptrack.schema.provenance import INGEST, Provenance, digest
from mcaptrack.sources.calibrations import is_rectified_topic
from mcaptrack.sources.ingest.calibration import Calibrated, GivenCalibration
from mcaptrack.sources.ingest.labels.reading import read_homography

#: The last parts of the topics.
PLANE, CALIBRATION = "ground_plane", "calibration"


class GivenGround:
    """A homography, or a calibration, or neither. Raises McaptrackError for files that can't be read."""

    def __init__(self, homography: Path | None, calibration: GivenCalibration | None, point: Point) -> None:
        self._path, self._calibration, self._point = homography, calibration, point
        self._homography = read_homography(homography) if homography else None
        self._calibrated: Calibrated | None = None
        if homography and calibration and calibration.has_pose:
            raise McaptrackError(
                f"{homography} and {', '.join(map(str, calibration.paths))} are both a ground plane; give one"
            )

    @property
    def is_given(self) -> bool:
        """Whether there is a homography or a calibration."""
        return self._homography is not None or self._calibration is not None

    @property
    def has_plane(self) -> bool:
        """Whether there is a ground plane."""
        return self._homography is not None or (self._calibration is not None and self._calibration.has_pose)

    def suffixes(self) -> Iterator[str]:
        """The last parts of the topics that will be written."""
        if self._calibration is not None:
            yield CALIBRATION
        if self.has_plane:
            yield PLANE

    def plane(
        self, size: tuple[int, int], prefix: str, pictures: str, frame_id: str, is_stated: bool, remarks: list[str]
    ) -> GroundPlane | None:
        """The ground plane for pictures of this size in this topic; None if none follows from what was given.

        ``is_stated`` is false if the size is no more than the extent of boxes. Lines about it are added to ``remarks``.
        """
        if self._calibration is not None:
            is_rectified = is_rectified_topic(pictures)
            self._calibrated = self._calibration.calibrated(
                prefix, pictures, size, is_stated, frame_id, self._point, is_rectified
            )
            remarks += self._calibrated.remarks
            if self._calibrated.plane is not None:
                return self._calibrated.plane
        if self._homography is None:
            return None
        try:
            return GroundPlane(self._homography, *size, self._point)
        except McaptrackError as error:
            raise McaptrackError(f"{self._path}: {error}") from None

    def parameters(self) -> dict[str, Any]:
        """The parameters of the ground plane in its provenance."""
        if self._path is not None:
            return {"file": self._path.name, "point": self._point}
        return {**(self._calibrated.parameters if self._calibrated else {}), "point": self._point}

    def write_calibration(
        self, writer: log.LogWriter, prefix: str, pictures: str, t_ns: int, encoding: Encoding
    ) -> dict[str, int]:
        """Write the calibration as viewers read it, from a time on. Returns the number of messages by topic."""
        if self._calibrated is None:
            return {}
        topic, message = f"{prefix}/{CALIBRATION}", (t_ns, 0, self._calibrated.at(t_ns))
        made = Provenance(INGEST, self._calibrated.parameters, pictures, digest=digest(iter([message])))
        record = foxglove.record_in(foxglove.CALIBRATION, encoding)
        channel = writer.add_channel(topic, record, encoding, made.to_metadata())
        for one in foxglove.messages_in(foxglove.CALIBRATION, [message], encoding):
            writer.add_message(channel, *one)
        return {topic: 1}
