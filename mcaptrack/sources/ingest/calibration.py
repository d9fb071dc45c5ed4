"""The content of calibration files: intrinsics, distortion, the size of pictures, and the pose of a camera.

Three families are understood: OpenCV's FileStorage, in which names are free and the usual ones are known; ROS's
``camera_info``, as camera_calibration and camera_info_manager write it, and as ``ros2 topic echo`` prints it; and
Kalibr's camchain.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove
from mcaptrack.choices import LengthUnit, Point
from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.sources.calibrations import SHAPE, calibration_of
from mcaptrack.sources.ingest.plain_yaml import UnsupportedYamlError, XmlReader, load

#: Names of values in files of OpenCV, in small letters and without "_", "-" and blanks.
_MATRIX: Final = ("cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx", "k", "m1")
_BENT: Final = (
    "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoefs", "distortion", "dist", "d", "d1",
)  # fmt: skip
_RVEC: Final = ("rvec", "rotationvector", "rvecs", "rodrigues")
_TVEC: Final = ("tvec", "translationvector", "tvecs", "translation", "t")
_ROTATION: Final = ("rotationmatrix", "rotation", "r", "rmat")
_POSE: Final = ("extrinsicmatrix", "extrinsics", "extrinsic", "tcamworld", "tcw", "rt")
#: Names that are of one camera of two, and those of the other one.
_SECOND: Final = ("m2", "cameramatrix2", "d2")
_FISHEYE: Final = ("fisheyemodel", "fisheye", "isfisheye")
#: Models of distortion, as ROS, Kalibr and Foxglove name them, and what Foxglove's messages call them.
POLYNOMIAL, RATIONAL, EQUIDISTANT = "plumb_bob", "rational_polynomial", "kannala_brandt"
_MODELS: Final = {
    "plumb_bob": POLYNOMIAL, "radtan": POLYNOMIAL, "radial-tangential": POLYNOMIAL, "brown_conrady": POLYNOMIAL,
    "rational_polynomial": RATIONAL, "radtan8": RATIONAL,
    "equidistant": EQUIDISTANT, "equi": EQUIDISTANT, "kannala_brandt": EQUIDISTANT, "fisheye": EQUIDISTANT,
    "none": POLYNOMIAL, "": POLYNOMIAL,
}  # fmt: skip
_READ: Final = "plumb_bob (radtan), rational_polynomial and equidistant (kannala_brandt) are read"
#: Numbers of coefficients that the models have in messages.
_COUNTS: Final = {POLYNOMIAL: 5, RATIONAL: 8, EQUIDISTANT: 4}
_MOST_PX: Final = 1e5
#: R is a rotation if R R^T differs from the identity by less than this.
_ORTHONORMAL: Final = 1e-3
_NAMED: Final = 12


@dataclass(frozen=True)
class CameraFile:
    """The calibration of one camera, as far as a file has it; the rest is None, or "".

    ``matrix`` (3, 3) and ``bent``, the coefficients of ``model``, are its intrinsics, for pictures of ``size`` (width,
    height). ``rectified`` (3, 3) and ``projection`` (3, 4) are those of rectified pictures. ``rotation`` (3, 3) and
    ``translation`` (3,) map points of the world to the camera. ``relative`` names a pose that is relative to another
    sensor instead. ``topic`` is that of its pictures.
    """

    path: Path
    name: str = ""
    matrix: Floats | None = None
    bent: tuple[float, ...] = ()
    model: str = POLYNOMIAL
    size: tuple[int, int] | None = None
    rectified: Floats | None = None
    projection: Floats | None = None
    rotation: Floats | None = None
    translation: Floats | None = None
    relative: str = ""
    topic: str = ""


# Read XML, YAML and JSON of calibrations as plain trees: maps, lists and text, within limits.
#
# OpenCV's FileStorage is XML below ``<opencv_storage>``, YAML that begins with ``%YAML:1.0`` and has matrices
# tagged as ``!!opencv-matrix``, or JSON; ROS and Kalibr write plain YAML. Document types, entities and other tags
# are refused.


#: The root of OpenCV's XML.
_ROOT: Final = "opencv_storage"
_MAX_BYTES: Final = 2**20
_MAX_DEPTH: Final = 16
_MAX_NODES: Final = 20_000
#: OpenCV's tags, which are ignored: their content says as much.
_TAGS: Final = tuple(f"tag:yaml.org,2002:opencv-{kind}" for kind in ("matrix", "nd-matrix"))
#: The first line of OpenCV's YAML, which YAML itself doesn't allow, and the line that ends a document.
_HEAD: Final = re.compile(rb"\A(\xef\xbb\xbf)?%YAML[: ]1\.[0-9][^\n]*\n")
_END: Final = re.compile(rb"\n---[ \t\r\n]*\Z")
#: What tells a calibration from labels: a word that it has, within its first bytes.
_WORDS: Final = re.compile(
    rb"<opencv_storage|%YAML:1\.|camera_matrix|distortion_model|distortion_coefficients|opencv-matrix", re.IGNORECASE
)
_BEGIN: Final = 4096


def is_calibration(path: Path) -> bool:
    """Return whether a file looks like a calibration of a camera."""
    refuse_special(path)
    if path.is_dir() or path.suffix.lower() not in (".xml", ".yaml", ".yml", ".json", ".txt", ""):
        return False
    head = read_beginning(path, _BEGIN)
    return b"\0" not in head and _WORDS.search(head) is not None


def read_tree(path: Path) -> dict[str, Any]:
    """Return the content of a file: a map of maps, lists and text.

    Raises McaptrackError if it is none, or too large.
    """
    data = read_beginning(path, _MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise McaptrackError(f"{path} has more than {_MAX_BYTES} bytes; a calibration is a small file")
    if not data.strip():
        raise McaptrackError(f"{path} is empty; a calibration is XML or YAML of OpenCV, ROS or Kalibr")
    if data.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"<":
        return _Xml(path).read(data)
    try:
        tree = load(_END.sub(b"\n", _HEAD.sub(b"", data)), _TAGS)
    except UnsupportedYamlError as error:
        raise McaptrackError(f"{path} can't be read as YAML: {error}") from None
    if not isinstance(tree, dict):
        raise McaptrackError(
            f"{path} holds no calibration: that is a map with names such as camera_matrix; a homography of 3 x 3 "
            "numbers is given with `ground_plane=`"
        )
    return tree


class _Xml(XmlReader):
    """Reads OpenCV's XML: elements with elements become maps (or lists, if they are named ``_``), others text."""

    writer = "OpenCV"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._nodes = 0
        self._open: list[tuple[str, list[tuple[str, Any]], list[str]]] = [("", [], [])]

    def read(self, data: bytes) -> dict[str, Any]:
        self.parse([data])
        ((name, tree),) = self._open[0][1]
        if name != _ROOT:
            raise McaptrackError(f"{self.path} is XML of <{name:.40}>; calibrations of OpenCV are of <{_ROOT}>")
        return tree if isinstance(tree, dict) else {}

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._nodes += 1
        if self._nodes > _MAX_NODES or len(self._open) > _MAX_DEPTH:
            self.fail(f"it has more than {_MAX_NODES} elements, or is nested more than {_MAX_DEPTH} deep")
        self._open.append((name, [], []))

    def text(self, text: str) -> None:
        self._open[-1][2].append(text)

    def end(self, name: str) -> None:
        _, inner, text = self._open.pop()
        value: Any = "".join(text).strip().strip('"')
        if inner and all(key == "_" for key, _ in inner):
            value = [item for _, item in inner]
        elif inner:
            value = dict(inner)
            if len(value) != len(inner):
                twice = next(key for number, (key, _) in enumerate(inner) if key in dict(inner[:number]))
                self.fail(f"<{twice:.40}> is there twice")
        self._open[-1][1].append((name, value))


def read_cameras(path: Path) -> list[CameraFile]:
    """Return the cameras of a file. Raises McaptrackError, with what is wrong, if it holds no calibration."""
    tree = read_tree(path)
    chain = {name: cam for name, cam in tree.items() if re.fullmatch(r"cam\d+", name) and isinstance(cam, dict)}
    if chain:
        return [_of_kalibr(path, name, cam) for name, cam in chain.items()]
    by_plain_name = {_plain(name): value for name, value in tree.items()}
    if "camerainfo" in by_plain_name and isinstance(by_plain_name["camerainfo"], dict):
        by_plain_name = {_plain(name): value for name, value in by_plain_name["camerainfo"].items()}
    if "distortionmodel" in by_plain_name and ({"cameramatrix", "k"} & by_plain_name.keys()):
        return [_of_ros(path, by_plain_name)]
    return [_of_opencv(path, by_plain_name, tree)]


def _of_ros(path: Path, fields: Mapping[str, Any]) -> CameraFile:
    width = fields.get("imagewidth", fields.get("width"))
    height = fields.get("imageheight", fields.get("height"))
    bent = fields.get("distortioncoefficients", fields.get("d", []))
    model, coefficients = _distortion(path, str(fields["distortionmodel"]), _numbers(path, "distortion", bent))
    rectified = fields.get("rectificationmatrix", fields.get("r"))
    projection = fields.get("projectionmatrix", fields.get("p"))
    is_binned = any(_is_set(fields.get(name)) and fields[name] != "1" for name in ("binningx", "binningy"))
    if is_binned or _is_cropped(fields.get("roi")):
        raise McaptrackError(
            f"{path} is for pictures that are binned or a region of others; give that of whole pictures"
        )
    matrix = fields.get("cameramatrix", fields.get("k"))
    name = fields.get("cameraname", "")
    header = fields.get("header")
    name = (
        name if isinstance(name, str) and name else str(header.get("frame_id", "")) if isinstance(header, dict) else ""
    )
    return CameraFile(
        path, name,
        matrix=_camera_matrix(path, _matrix(path, "camera_matrix", matrix, (3, 3))),
        bent=coefficients,
        model=model,
        size=_size(path, width, height),
        rectified=None if rectified is None else _matrix(path, "rectification_matrix", rectified, (3, 3)),
        projection=None if projection is None else _matrix(path, "projection_matrix", projection, (3, 4)),
    )  # fmt: skip


def _of_kalibr(path: Path, name: str, fields: Mapping[str, Any]) -> CameraFile:
    where = f"{path}: {name}"
    kind = str(fields.get("camera_model", ""))
    if kind != "pinhole":
        raise McaptrackError(f"{where} is of the camera model {kind or 'unknown'!r:.40}; pinhole is read")
    inner = _numbers(where, "intrinsics", fields.get("intrinsics"))
    if len(inner) != 4:
        raise McaptrackError(f"{where} has {len(inner)} intrinsics; a pinhole camera has 4: fu, fv, pu, pv")
    fu, fv, pu, pv = inner
    bent = _numbers(where, "distortion_coeffs", fields.get("distortion_coeffs", []))
    model, coefficients = _distortion(where, str(fields.get("distortion_model", "")), bent)
    sizes = fields.get("resolution")
    width, height = sizes if isinstance(sizes, list) and len(sizes) == 2 else (None, None)
    poses = [key for key in ("T_cam_imu", "T_cn_cnm1") if key in fields]
    for key in poses:
        pose = _matrix(where, key, fields[key], (4, 4))
        _check_rigid(where, key, pose[:3, :3], pose[3])
    relative = {"T_cam_imu": "the IMU", "T_cn_cnm1": "the camera before it"}
    return CameraFile(
        path, name,
        matrix=_camera_matrix(where, np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1.0]])),
        bent=coefficients,
        model=model,
        size=_size(where, width, height),
        relative=" and ".join(f"{relative[key]} ({key})" for key in poses),
        topic=str(fields.get("rostopic", "")),
    )  # fmt: skip


def _of_opencv(path: Path, fields: Mapping[str, Any], tree: Mapping[str, Any]) -> CameraFile:
    matrix, bent = _first(fields, _MATRIX), _first(fields, _BENT)
    names = ", ".join(list(tree)[:_NAMED]) + (" ..." if len(tree) > _NAMED else "") or "nothing"
    if (second := _first(fields, _SECOND)) is not None and matrix is not None:
        raise McaptrackError(f"{path} holds two cameras ({names}), of which {second[0]} is one; save each to a file")
    model, coefficients = POLYNOMIAL, tuple[float, ...]()
    if bent is not None:
        is_fisheye = any(_is_set(fields.get(name)) for name in _FISHEYE)
        named = str(fields.get("distortionmodel", "")) or ("equidistant" if is_fisheye else "")
        model, coefficients = _distortion(path, named, _numbers(path, bent[0], bent[1]), is_open=not named)
    size = fields.get("imagesize")
    width, height = size if isinstance(size, list) and len(size) == 2 else _words(size)
    width = fields.get("imagewidth", fields.get("width", width))
    height = fields.get("imageheight", fields.get("height", height))
    rotation, translation = _pose(path, fields)
    if matrix is None and rotation is None:
        raise McaptrackError(
            f"{path} holds {names}; a calibration has a camera matrix (camera_matrix), a pose (rvec and tvec, or R and "
            "T), or both"
        )
    return CameraFile(
        path,
        matrix=None if matrix is None else _camera_matrix(path, _matrix(path, *matrix, (3, 3))),
        bent=coefficients,
        model=model,
        size=_size(path, width, height),
        rotation=rotation,
        translation=translation,
    )


def _pose(path: Path, fields: Mapping[str, Any]) -> tuple[Floats | None, Floats | None]:
    """The rotation and the translation of a file of OpenCV; None if it has neither."""
    rvec, tvec, turn, both = (_first(fields, names) for names in (_RVEC, _TVEC, _ROTATION, _POSE))
    if rvec is None and turn is None and both is not None:
        name, value = both
        numbers = _numbers(path, name, value)
        if len(numbers) not in (12, 16):
            raise McaptrackError(f"{path}: {name} has {len(numbers)} numbers; a pose is a matrix of 3 x 4 or 4 x 4")
        pose = np.reshape(numbers, (-1, 4))
        _check_rigid(path, name, pose[:3, :3])
        return pose[:3, :3], pose[:3, 3]
    if rvec is None and turn is None and tvec is None:
        return None, None
    if tvec is None or (rvec is None and turn is None):
        has, lacks = ("a rotation", "translation (tvec)") if tvec is None else ("a translation", "rotation (rvec)")
        raise McaptrackError(f"{path} has {has} and no {lacks}; a pose is both")
    translation = np.array(_numbers(path, *tvec))
    stated = rvec or turn
    assert stated is not None
    numbers = _numbers(path, *stated)
    if len(translation) != 3 or len(numbers) not in (3, 9):
        raise McaptrackError(
            f"{path}: {stated[0]} has {len(numbers)} numbers and {tvec[0]} {len(translation)}; the pose of a camera is "
            "3 (or a matrix of 9) and 3. Poses of pictures of a board aren't that of the camera in the world"
        )
    if len(numbers) == 3:
        import cv2

        return np.asarray(cv2.Rodrigues(np.array(numbers))[0], np.float64), translation
    rotation = np.reshape(numbers, (3, 3))
    _check_rigid(path, stated[0], rotation)
    return rotation, translation


def _check_rigid(where: object, name: str, turn: Floats, last: Sequence[float] | Floats = (0, 0, 0, 1)) -> None:
    """Raise McaptrackError unless a matrix (3, 3) is a rotation, and the last row (4,) of a pose is as it has to be."""
    is_one = np.abs(turn @ turn.T - np.eye(3)).max() < _ORTHONORMAL and np.linalg.det(turn) > 0
    if not is_one or np.abs(np.subtract(last, [0, 0, 0, 1])).max() > 0:
        raise McaptrackError(f"{where}: {name} is not a rotation and a translation")


def _camera_matrix(where: object, k: Floats) -> Floats:
    fx, fy, skew = float(k[0, 0]), float(k[1, 1]), float(k[0, 1])
    if not (0 < fx < _MOST_PX and 0 < fy < _MOST_PX):
        raise McaptrackError(f"{where} isn't calibrated: its focal lengths are {fx:g} and {fy:g} pixels")
    if np.abs([k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1]).max() > 1e-9 or np.abs(k).max() > _MOST_PX:
        raise McaptrackError(f"{where}: its camera matrix is not fx 0 cx, 0 fy cy, 0 0 1")
    if abs(skew) > 1e-3 * fx:
        raise McaptrackError(f"{where}: its camera matrix has a skew of {skew:g}, which isn't supported")
    return k


def _distortion(where: object, model: str, bent: list[float], is_open: bool = False) -> tuple[str, tuple[float, ...]]:
    """The model as messages name it, and its coefficients; ``is_open``: the count says which polynomial it is."""
    kind = _MODELS.get(model.strip().lower())
    if kind is None:
        if not any(bent):
            return POLYNOMIAL, ()
        raise McaptrackError(f"{where} has distortion by {model!r:.40}; {_READ}")
    while len(bent) > _COUNTS[RATIONAL] and not bent[-1]:
        bent = bent[:-1]
    if len(bent) > _COUNTS[RATIONAL]:
        raise McaptrackError(
            f"{where} has {len(bent)} coefficients of distortion, with thin prisms or a tilted sensor; {_READ}"
        )
    if kind == POLYNOMIAL and len(bent) > _COUNTS[POLYNOMIAL] and (is_open or any(bent[5:])):
        kind = RATIONAL
    if kind == EQUIDISTANT and len(bent) > _COUNTS[EQUIDISTANT] and not any(bent[4:]):
        bent = bent[:4]
    if len(bent) not in (0, 4, *([] if kind == EQUIDISTANT else [5, 8])):
        raise McaptrackError(f"{where} has {len(bent)} coefficients of distortion; {kind} has {_COUNTS[kind]}")
    wanted = _COUNTS[kind] if bent else 0
    return kind, tuple((bent + [0.0] * wanted)[:wanted])


def _size(where: object, width: Any, height: Any) -> tuple[int, int] | None:
    """Width and height, if both are given. Raises McaptrackError for what is no size."""
    if width is None or height is None:
        return None
    try:
        values = float(str(width)), float(str(height))
    except ValueError:
        values = (0.0, 0.0)
    if not all(value.is_integer() and 0 < value < _MOST_PX for value in values):
        raise McaptrackError(f"{where}: {width!s:.20} x {height!s:.20} is no size of pictures in pixels")
    return int(values[0]), int(values[1])


def _matrix(where: object, name: str, value: Any, shape: tuple[int, int]) -> Floats:
    numbers = _numbers(where, name, value)
    if len(numbers) != shape[0] * shape[1]:
        raise McaptrackError(f"{where}: {name} has {len(numbers)} numbers, and needs {shape[0]} x {shape[1]}")
    return np.reshape(np.array(numbers), shape)


def _numbers(where: object, name: str, value: Any) -> list[float]:
    """The numbers of a matrix of OpenCV or ROS (rows, cols, data), of a list, of lists of them, or of text."""
    is_matrix = isinstance(value, dict) and "data" in value
    data = value["data"] if is_matrix else value
    try:
        numbers = [float(part) for part in _flat(data)]
    except (TypeError, ValueError):
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise McaptrackError(f"{where}: {name} holds something else than finite numbers")
    counts = [value.get(key) for key in ("rows", "cols")] if is_matrix else []
    if all(isinstance(count, str) and count.isascii() and count.isdigit() for count in counts) and counts:
        rows, columns = (int(count[:9]) for count in counts)
        if rows * columns != len(numbers):
            raise McaptrackError(f"{where}: {name} has {len(numbers)} numbers, and says that it is {rows} x {columns}")
    return numbers


def _flat(data: Any) -> Iterable[str]:
    if isinstance(data, str):
        yield from data.replace(",", " ").split()
    elif isinstance(data, list):
        for item in data:
            yield from _flat(item)
    else:
        raise ValueError("no numbers")


def _words(value: Any) -> list[str | None]:
    parts = value.split() if isinstance(value, str) else []
    return [*parts] if len(parts) == 2 else [None, None]


def _plain(name: str) -> str:
    return re.sub(r"[_\-\s]", "", name).lower()


def _first(fields: Mapping[str, Any], names: Iterable[str]) -> tuple[str, Any] | None:
    """The first of these names that is known, and its value."""
    return next(((name, fields[name]) for name in names if name in fields), None)


def _is_set(value: Any) -> bool:
    """Whether a flag or a number is given and isn't 0 or false."""
    return isinstance(value, str) and value.strip().lower() not in ("", "0", "0.0", "false", "no")


def _is_cropped(roi: Any) -> bool:
    return isinstance(roi, dict) and any(_is_set(roi.get(key)) for key in ("x_offset", "y_offset", "width", "height"))


# The calibration of one camera, from one file or several: the message for viewers, and the ground plane.


_METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
#: Heights of a camera, as numbers, that are taken for metres (up to), centimetres and millimetres (between).
_IN_M, _IN_CM, _IN_MM = 30.0, (30.0, 1500.0), (3000.0, 30_000.0)
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
        assert whole.size is not None
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


def _in_words(whole: CameraFile) -> str:
    assert whole.matrix is not None
    assert whole.size is not None
    bent = f"{len(whole.bent)} coefficients of distortion ({whole.model})" if any(whole.bent) else "no distortion"
    return f"focal length {whole.matrix[0, 0]:.0f} px in pictures of {whole.size[0]} x {whole.size[1]}, {bent}"


def _fitted(camera: CameraFile, final: tuple[int, int]) -> tuple[CameraFile, tuple[str, ...]]:
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
        if abs(across / down - 1) > SHAPE:
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
    return replace(camera, matrix=matrix, size=final, projection=projection), remarks


def _message(whole: CameraFile, frame_id: str) -> Any:
    """The message for viewers, without its time."""
    assert whole.matrix is not None
    assert whole.size is not None
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
