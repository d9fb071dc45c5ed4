"""The calibration of one camera, from one file or several: the message for viewers, and the ground plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove
from mcaptrack.choices import LengthUnit, Point
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.sources.calibrations import calibration_of
from mcaptrack.sources.ingest.calibration.content import CameraFile, read_cameras

_METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
#: Heights of a camera, as numbers, that are taken for metres (up to), centimetres and millimetres (between).
_IN_M, _IN_CM, _IN_MM = 30.0, (30.0, 1500.0), (3000.0, 30_000.0)
#: Pictures were resized, not cropped, if their ratio of width to height differs by less than this share.
_SHAPE: Final = 0.02
#: A centre that is farther from the middle than this share of the picture's size is named.
_OFF_CENTRE: Final = 0.2
#: A centre that is farther away is outside of the picture.
_OUTSIDE: Final = 0.5
#: The ground is looked for at so many places of the picture along each axis, up to this distance in heights.
_PLACES, _FAR_HEIGHTS = 9, 1000.0


class Calibrated(NamedTuple):
    """The parts of a calibrated camera in a log: a message for viewers but for its time, and the ground plane or None.

    ``remarks`` are lines about both, ``parameters`` those of the provenance.
    """

    message: Any
    plane: GroundPlane | None
    remarks: tuple[str, ...]
    parameters: dict[str, Any]

    def at(self, t_ns: int) -> bytes:
        """Return the message at a time."""
        return foxglove.pack_stamped(self.message, t_ns)


class _Whole(NamedTuple):
    """The intrinsics of a camera for pictures of ``size``; the other fields are as in ``CameraFile``."""

    matrix: Floats
    size: tuple[int, int]
    model: str
    bent: tuple[float, ...]
    rectified: Floats | None
    projection: Floats | None


@dataclass(frozen=True)
class GivenCalibration:
    """The calibration that a user gave: intrinsics and, perhaps in another file, the pose of a camera.

    ``name`` chooses a camera of a file of several; ``unit`` is that of lengths.
    """

    files: tuple[tuple[CameraFile, ...], ...]
    name: str | None = None
    unit: LengthUnit = "auto"

    @classmethod
    def read(cls, paths: Sequence[Path], name: str | None = None, unit: LengthUnit = "auto") -> GivenCalibration:
        """Read the files. Raises McaptrackError for what can't be read, and if they don't go together."""
        out = cls(tuple(tuple(read_cameras(path)) for path in paths), name, unit)
        several = [cameras for cameras in out.files if len(cameras) > 1]
        if name is not None and not several:
            why = "no file has several cameras"
            warn(f"`calibration_name={name!r}` changes nothing here: {why}", "option-not-used")
        if name is not None:
            for cameras in several:
                out._named(cameras, name)
        out._joined([cameras[0] for cameras in out.files])
        return out

    @property
    def has_pose(self) -> bool:
        """Whether a ground plane follows from it."""
        return any(camera.rotation is not None for cameras in self.files for camera in cameras)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files."""
        return tuple(cameras[0].path for cameras in self.files)

    def calibrated(
        self,
        prefix: str,
        pictures: str,
        size: tuple[int, int],
        is_stated: bool,
        frame_id: str,
        point: Point,
        is_rectified: bool,
    ) -> Calibrated:
        """Return what goes into a log for the camera with this prefix and topic of pictures.

        ``size`` is the width and height of the pictures, and ``is_stated`` is false if that is no more than the extent
        of boxes; ``frame_id`` is that of their messages; ``is_rectified``: they have no distortion any more. Raises
        McaptrackError if the calibration is not of such pictures.
        """
        camera = self._joined([self._of_camera(cameras, prefix, pictures) for cameras in self.files])
        if not is_stated and camera.size is None and min(size) > 0:
            taken = f"{size[0]} x {size[1]} is taken, the extent of boxes; `size='WIDTHxHEIGHT'` sets it"
            warn(f"{camera.path} doesn't say the size of its pictures: {taken}")
        whole, remarks = _fitted(camera, size if is_stated or camera.size is None else camera.size)
        message = _message(whole, frame_id)
        read = calibration_of(message, is_rectified)
        names = ", ".join(path.name for path in self.paths)
        parameters: dict[str, Any] = {"files": [path.name for path in self.paths]}
        parameters |= {"name": camera.name} if camera.name else {}
        if camera.rotation is None or camera.translation is None:
            why = (
                f"the pose in it is relative to {camera.relative}"
                if camera.relative
                else "it has no pose of the camera"
            )
            warn(
                f"{names}: {why}, so that no ground plane follows; the calibration is kept. Give a pose in the world "
                "(rvec and tvec) with another `calibration=`, or a homography with `ground_plane=`",
                "transforms",
            )
            if self.unit != "auto":
                warn(f"`calibration_unit={self.unit!r}` changes nothing here: {why}", "option-not-used")
            return Calibrated(message, None, (*remarks, f"{names}: {_in_words(whole)}"), parameters)
        unit = _unit(camera.rotation, camera.translation, self.unit, names)
        rotation, translation = read.turn @ camera.rotation, read.turn @ camera.translation * _METRES[unit]
        plane = _plane(read.lens, rotation, translation, whole.size, point, names)
        height_m = float(-(rotation.T @ translation)[2])
        text = f"{names}: {_in_words(whole)}; the camera is {abs(height_m):.2f} m from the ground (lengths in {unit})"
        return Calibrated(message, plane, (*remarks, text), parameters | {"unit": unit})

    def _of_camera(self, cameras: Sequence[CameraFile], prefix: str, pictures: str) -> CameraFile:
        """The camera of a file that belongs to a camera of the log."""
        if len(cameras) == 1:
            return cameras[0]
        if self.name is not None:
            return self._named(cameras, self.name)
        camera = prefix.strip("/")
        for matching in (
            [file for file in cameras if file.topic and file.topic == pictures],
            [file for file in cameras if file.name == camera],
            [file for file in cameras if file.topic.strip("/").rpartition("/")[0] == camera],
        ):
            if len(matching) == 1:
                return matching[0]
        raise McaptrackError(
            f"{cameras[0].path} has {_listed(cameras)}, and none is of {prefix.strip('/')}; choose one with "
            f"`calibration_name={cameras[0].name!r}`"
        )

    @staticmethod
    def _named(cameras: Sequence[CameraFile], name: str) -> CameraFile:
        matching = [camera for camera in cameras if name in (camera.name, camera.topic)]
        if not matching:
            raise McaptrackError(f"{cameras[0].path} has no camera {name!r:.40}; it has {_listed(cameras)}")
        return matching[0]

    def _joined(self, parts: Sequence[CameraFile]) -> CameraFile:
        """One camera from the parts that are in several files."""
        inner = [part for part in parts if part.matrix is not None]
        posed = [part for part in parts if part.rotation is not None]
        for what, several in (("camera matrices", inner), ("poses", posed)):
            if len(several) > 1:
                names = " and ".join(str(part.path) for part in several)
                raise McaptrackError(f"{names} both hold {what}; give the files of one camera")
        if not inner:
            raise McaptrackError(
                f"{posed[0].path} holds a pose and no camera matrix; give the file with the intrinsics, too, with "
                "another `calibration=`"
            )
        if not posed:
            return inner[0]
        return replace(inner[0], rotation=posed[0].rotation, translation=posed[0].translation)


def _listed(cameras: Sequence[CameraFile]) -> str:
    return ", ".join(camera.name + (f" ({camera.topic})" if camera.topic else "") for camera in cameras)


def _in_words(whole: _Whole) -> str:
    bent = f"{len(whole.bent)} coefficients of distortion ({whole.model})" if any(whole.bent) else "no distortion"
    return f"focal length {whole.matrix[0, 0]:.0f} px in pictures of {whole.size[0]} x {whole.size[1]}, {bent}"


def _fitted(camera: CameraFile, final: tuple[int, int]) -> tuple[_Whole, tuple[str, ...]]:
    """The calibration for pictures of this size, and what was done.

    Raises McaptrackError if it is for pictures of another shape, or if no size is known.
    """
    matrix, projection, remarks = camera.matrix, camera.projection, tuple[str, ...]()
    assert matrix is not None  # ``_joined`` has checked it
    if min(final) <= 0:
        raise McaptrackError(
            f"{camera.path} doesn't say the size of its pictures, and there are none; "
            "give it with `size='WIDTHxHEIGHT'`"
        )
    if camera.size is not None and camera.size != final:
        width, height = camera.size
        across, down = final[0] / width, final[1] / height
        was = f"{camera.path} is for pictures of {width} x {height}, and these are {final[0]} x {final[1]}"
        if abs(across / down - 1) > _SHAPE:
            raise McaptrackError(f"{was}: they are of another shape, so that they show another part; calibrate these")
        scale = np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5], [0, 0, 1.0]])
        matrix, projection = scale @ matrix, None if projection is None else scale @ projection
        remarks += (f"{was}: its focal lengths and centre are scaled by {across:.4g}",)
    off = np.abs(matrix[:2, 2] / final - 0.5).max()
    if off > _OFF_CENTRE:
        said = f"{camera.path}: the optical axis is at ({matrix[0, 2]:.0f}, {matrix[1, 2]:.0f}) of pictures of"
        text = f"{said} {final[0]} x {final[1]}, far from their middle"
        if off > _OUTSIDE and camera.size is None:
            raise McaptrackError(f"{text}: the calibration, which states no size, is for pictures of another one")
        warn(text + ("; it may be for pictures of another size, which it doesn't state" if camera.size is None else ""))
    return _Whole(matrix, final, camera.model, camera.bent, camera.rectified, projection), remarks


def _message(whole: _Whole, frame_id: str) -> Any:
    """The message for viewers, without its time."""
    message = foxglove.message_class(foxglove.CALIBRATION)(frame_id=frame_id, distortion_model=whole.model)
    message.width, message.height = whole.size
    message.D.extend(whole.bent)
    message.K.extend(whole.matrix.ravel().tolist())
    projection, rectified = np.column_stack([whole.matrix, np.zeros(3)]), np.eye(3)
    if whole.projection is not None and whole.projection[0, 0] > 0:
        projection, rectified = whole.projection, rectified if whole.rectified is None else whole.rectified
    message.R.extend(rectified.ravel().tolist())
    message.P.extend(projection.ravel().tolist())
    return message


def _unit(rotation: Floats, translation: Floats, unit: LengthUnit, names: str) -> str:
    """The unit of lengths of a pose: the given one, or that in which the camera has a usual height, with a warning."""
    if unit != "auto":
        return unit
    height = abs(float((rotation.T @ translation)[2]))
    if height <= _IN_M:
        return "m"
    guess = next((name for name, (low, high) in (("cm", _IN_CM), ("mm", _IN_MM)) if low < height <= high), "")
    if not guess:
        raise McaptrackError(
            f"{names}: the camera would be {height:,.0f} m above the ground, {height / 100:,.1f} m if lengths are in "
            f"cm and {height / 1000:,.2f} m if they are in mm; say which with `calibration_unit='cm'`"
        )
    warn(
        f"{names}: lengths of the pose are taken to be in {guess}, so that the camera is "
        f"{height * _METRES[guess]:.2f} m above the ground, and not {height:,.0f} m; `calibration_unit=` sets the unit",
        "transforms",
    )
    return guess


def _plane(
    lens: Lens, rotation: Floats, translation: Floats, size: tuple[int, int], point: Point, names: str
) -> GroundPlane:
    """The plane z = 0 of the world in metres. Raises McaptrackError if the camera doesn't see it."""
    seen = lens.matrix @ np.column_stack([rotation[:, :2], translation])
    height_m = float(-(rotation.T @ translation)[2])
    if abs(np.linalg.det(seen)) < 1e-9 or height_m == 0:
        raise McaptrackError(f"{names}: the camera is in the plane z = 0, which is to be the ground")
    plane = GroundPlane(tuple(np.linalg.inv(seen).ravel().tolist()), *size, point, lens=lens)
    across, down = (np.linspace(0, length - 1, _PLACES) for length in size)
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    below_m = -(rotation.T @ translation)[:2]
    away = np.hypot(*(plane.pixels_to_metres(places) - below_m).T)
    if not (away < _FAR_HEIGHTS * abs(height_m)).any():
        raise McaptrackError(
            f"{names}: the camera sees no ground: it is {abs(height_m):.2f} m from z = 0 and looks away from it. Poses "
            "map the world to the camera, as OpenCV has them (x right, y down, z ahead), not the camera to the world"
        )
    if height_m < 0:
        warn(
            f"{names}: the camera is at z = {height_m:.2f} m, so that z of the world points down; x and y are taken as "
            "they are, and look mirrored from above",
            "transforms",
        )
    return plane
