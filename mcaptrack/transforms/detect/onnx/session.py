"""A detector's network in ONNX Runtime: opened, bounded, tried once, and run.

The file may be hostile: it is read as bytes, so that it can't refer to other files, and what it takes is limited.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.environment import threads
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.transforms.detect.onnx import graph
from mcaptrack.transforms.detect.onnx.layouts import NetworkSignature
from mcaptrack.transforms.detect.onnx.outputs import Outputs
from mcaptrack.transforms.detect.onnx.placing import Size

Device = Literal["auto", "cpu", "cuda"]

#: What the sides of an input are multiples of, unless a network was made for another size.
_STEP: Final = 32
_GREY: Final = 114.0
_TYPES: Final = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_SIZE_TYPES: Final = {**_TYPES, "tensor(int64)": np.int64, "tensor(int32)": np.int32}
#: The input of RT-DETR and D-FINE for the size of the picture that boxes are given in.
_SIZES: Final = "orig_target_sizes"
_CUDA: Final = "CUDAExecutionProvider"
#: So many pictures go through a GPU together.
_CUDA_BATCH: Final = 8


@dataclass(frozen=True)
class NetworkFile:
    """An ONNX file: its bytes, their digest, and what the graph says."""

    path: Path
    data: bytes = field(repr=False)
    sha256: str
    names: dict[int, str]


def digest_of(path: Path) -> str:
    """The SHA-256 of a file. Raises McaptrackError if it can't be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None


def read_file(path: Path, most_bytes: int, check: Callable[[str, int], None] = lambda *_: None) -> NetworkFile:
    """Read an ONNX file, once.

    ``check`` gets its digest and size in bytes, and raises McaptrackError if they are wrong. So does this function if
    the file is none in ONNX format, a part of one, or refers to other files.
    """
    try:
        if path.stat().st_size > most_bytes:
            raise McaptrackError(
                f"{path} holds {path.stat().st_size / 1e6:,.0f} MB; a network may take {most_bytes / 1e6:,.0f} MB "
                "(`max_memory_mb=`)"
            )
        data = path.read_bytes()
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    sha256 = hashlib.sha256(data).hexdigest()
    check(sha256, len(data))
    try:
        model = graph.parse(data)
    except graph.NotOnnxError:
        raise McaptrackError(f"{path} is no ONNX file, or is damaged or incomplete") from None
    if graph.is_split(model):
        raise McaptrackError(
            f"{path} keeps weights in other files (external data), which are not read; save it as one file with "
            "onnx.save(onnx.load(path), path)"
        )
    return NetworkFile(path, data, sha256, graph.class_names(model))


class _MemoryLimitError(McaptrackError):
    """A network takes more memory than it may."""


class DetectorNetwork:
    """A network for pictures of one size, ready to run; several threads may run it."""

    def __init__(self, file: NetworkFile, size: Size | None, device: Device, most_bytes: int) -> None:
        """Open it, and run it once on a grey picture.

        ``size`` is width and height of the input; None for the file's own. Raises McaptrackError if that can't be done.
        """
        self._file, self._most_bytes = file, most_bytes
        self._alone = Lock()
        self._session = self._open(file.data, device)
        inputs = self._session.get_inputs()
        self._image = self._image_input(inputs)
        own = graph.input_size(graph.parse(file.data), self._image.name)
        wanted = size or _known(own)
        if wanted is None:
            raise McaptrackError(f"{file.path} takes pictures of any size; choose one with `input_size='WxH'`")
        #: Width and height of the input.
        self.size: Size = wanted
        is_other = any(one is not None and one != two for one, two in zip(own, wanted, strict=True))
        self._check_size(is_other or _known(own) is None)
        if is_other and (old := _known(own)):
            self._session = self._open(graph.resized(file.data, self._image.name, old, wanted), device, old)
        self._sizes = next((one for one in inputs if one.name == _SIZES and one.type in _SIZE_TYPES), None)
        unknown = [one.name for one in inputs if one.name != self._image.name and one is not self._sizes]
        if unknown:
            raise McaptrackError(f"{self._describe(inputs)}; an input {unknown[0]} is not known")
        #: Whether it runs on a GPU.
        self.is_on_gpu = _CUDA in self._session.get_providers()
        is_open = not isinstance(self._image.shape[0], int)
        #: How many pictures it takes at a time: one on the CPU, where several run beside one another instead.
        self.batch = _CUDA_BATCH if is_open and self.is_on_gpu else 1
        grey = np.full((1, 3, wanted[1], wanted[0]), _GREY / 255, np.float32)
        try:
            outputs = self.run(grey)
        except McaptrackError as error:
            if is_other and not isinstance(error, _MemoryLimitError):
                raise self._refused_size(_known(own)) from error
            raise
        #: What it takes and gives.
        self.signature = NetworkSignature(tuple(one.name for one in inputs), outputs, wanted, len(file.names))

    def run(self, blob: NDArray[np.float32]) -> Outputs:
        """The outputs by name for pictures (B, 3, height, width). Raises McaptrackError if they can't be computed."""
        given: dict[str, Any] = {self._image.name: blob.astype(_TYPES[self._image.type], copy=False)}
        if self._sizes:
            given[self._sizes.name] = np.tile(np.array([self.size], _SIZE_TYPES[self._sizes.type]), (len(blob), 1))
        try:
            arrays = self._session.run(None, given)
        except Exception as error:  # ONNX Runtime has no common base class of its errors
            if "memory" not in str(error):
                raise McaptrackError(f"{self._file.path} can't be run: {_short(error)}") from None
            arrays = self._run_alone(given)
        out = {}
        for declared, array in zip(self._session.get_outputs(), arrays, strict=True):
            values = np.asarray(array)
            if values.dtype.kind not in "fiu":
                raise McaptrackError(f"{self._file.path} gives {values.dtype} in {declared.name}; no detector does")
            out[declared.name] = values.astype(np.float32, copy=False) if values.dtype == np.float16 else values
        return out

    def _run_alone(self, given: dict[str, Any]) -> list[Any]:
        """Run while no other thread does, after all of them together took too much memory."""
        with self._alone:
            try:
                return list(self._session.run(None, given))
            except Exception as error:
                if "memory" not in str(error):
                    raise McaptrackError(f"{self._file.path} can't be run: {_short(error)}") from None
        raise _MemoryLimitError(
            f"{self._file.path} needs more than {self._most_bytes / 1e6:,.0f} MB at {_text(self.size)}; a smaller "
            "`input_size=` takes less, and `max_memory_mb=` allows more"
        )

    def _open(self, data: bytes, device: Device, old: Size | None = None) -> Any:
        try:
            import onnxruntime
        except ImportError:
            raise McaptrackError(
                f"{self._file.path} needs ONNX Runtime, which is not installed; `pip install 'mcaptrack[onnx]'` "
                "installs it"
            ) from None
        providers = ["CPUExecutionProvider"]
        if device != "cpu" and _CUDA in onnxruntime.get_available_providers():
            providers.insert(0, _CUDA)
        elif device == "cuda":
            there = ", ".join(onnxruntime.get_available_providers())
            raise McaptrackError(
                f"ONNX Runtime has no CUDA here, only {there}; `pip install onnxruntime-gpu` brings it"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # pictures run beside one another, which takes less time in all
        options.log_severity_level = 4
        options.add_session_config_entry("session.use_env_allocators", "1")
        info = onnxruntime.OrtMemoryInfo(
            "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
        )
        limits = onnxruntime.OrtArenaCfg({"max_mem": self._most_bytes, "arena_extend_strategy": 1})
        with _OPENING:  # the next session takes the allocator that was registered last
            onnxruntime.create_and_register_allocator(info, limits)
            try:
                session = onnxruntime.InferenceSession(data, options, providers=providers)
            except Exception as error:  # as above
                if old is not None:
                    raise self._refused_size(old) from error
                raise McaptrackError(f"{self._file.path} can't be run by ONNX Runtime: {_short(error)}") from None
        if device == "cuda" and _CUDA not in session.get_providers():
            raise McaptrackError(f"{self._file.path} can't be run on CUDA here; see what ONNX Runtime's CUDA needs")
        if providers[0] == _CUDA and _CUDA not in session.get_providers():
            warn("ONNX Runtime has CUDA but can't use it here; detecting on the CPU", "device")
        return session

    def _image_input(self, inputs: Sequence[Any]) -> Any:
        found = [one for one in inputs if len(one.shape) == 4 and _are_channels_first(one.shape)]
        if not found or found[0].type not in _TYPES:
            raise McaptrackError(f"{self._describe(inputs)}; it needs pictures B x 3 x H x W of floats")
        batch = found[0].shape[0]
        if isinstance(batch, int) and batch != 1:
            raise McaptrackError(
                f"{self._file.path} takes {batch} pictures at a time; export it for one, or for any number"
            )
        return found[0]

    def _describe(self, inputs: Sequence[Any]) -> str:
        takes = ", ".join(f"{one.name} {_shape(one.shape)} {one.type}" for one in inputs[:4])
        return f"{self._file.path} is no detector of pictures: it takes {takes or 'nothing'}"

    def _refused_size(self, own: Size | None) -> McaptrackError:
        return McaptrackError(
            f"{self._file.path} is made for pictures of {_text(own)} and can't take {_text(self.size)}; leave "
            "`input_size=` out, or export it again for that size"
        )

    def _check_size(self, is_chosen: bool) -> None:
        near = tuple(max(_STEP, round(side / _STEP) * _STEP) for side in self.size)
        if is_chosen and near != self.size:
            raise McaptrackError(
                f"{self._file.path} can't take pictures of {_text(self.size)}: the sides of an input have to be "
                f"multiples of {_STEP}, as in {near[0]}x{near[1]}"
            )
        needed = 3 * 4 * self.size[0] * self.size[1]
        if needed > self._most_bytes // 4:
            raise McaptrackError(
                f"{self._file.path}: an input of {_text(self.size)} alone takes {needed / 1e6:,.0f} MB, and a network "
                f"may take {self._most_bytes / 1e6:,.0f} MB in all (`max_memory_mb=`)"
            )


_OPENING: Final = Lock()


def providers() -> tuple[str, ...]:
    """The providers of ONNX Runtime, such as "CPUExecutionProvider"; () if it can't be imported."""
    try:
        import onnxruntime
    except ImportError:
        return ()
    return tuple(onnxruntime.get_available_providers())


def workers() -> int:
    """The number of pictures to detect in at a time: one for each thread that this process may use."""
    return threads()


def _known(size: tuple[int | None, int | None]) -> Size | None:
    width, height = size
    return (width, height) if width and height else None


def _are_channels_first(shape: Sequence[Any]) -> bool:
    return shape[1] == 3 or (not isinstance(shape[1], int) and shape[3] != 3)


def _shape(shape: Sequence[Any]) -> str:
    return " x ".join(str(size) if size else "?" for size in shape) or "a number"


def _text(size: Size | None) -> str:
    return "x".join(map(str, size)) if size else "any size"


def _short(error: Exception) -> str:
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 200 else words[:200] + " ..."
