"""A detector's network: opened for pictures of a size, tried once, and run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.environment import threads
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks import catalogue
from mcaptrack.extensions.networks.layouts import NetworkSignature, Outputs
from mcaptrack.extensions.networks.network import (
    Device,
    NetworkFile,
    NetworkLimitError,
    NetworkLimits,
    OnnxNetwork,
    Value,
)
from mcaptrack.extensions.networks.nms import Size

#: What the sides of an input are multiples of, unless a network was made for another size.
_STEP: Final = 32
_GREY: Final = 114.0
_TYPES: Final = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_SIZE_TYPES: Final = {**_TYPES, "tensor(int64)": np.int64, "tensor(int32)": np.int32}
#: The input of RT-DETR and D-FINE for the size of the picture that boxes are given in.
_SIZES: Final = "orig_target_sizes"
#: So many pictures go through a GPU together.
_CUDA_BATCH: Final = 8


class DetectorNetwork:
    """A network for pictures of one size, ready to run; several threads may run it."""

    def __init__(self, file: NetworkFile, size: Size | None, device: Device, limits: NetworkLimits) -> None:
        """Open it, and run it once on a grey picture.

        ``size`` is width and height of the input; None for the file's own. Raises McaptrackError if that can't be done.
        """
        self._file, self._limits = file, limits
        is_trusted = any(model.sha256 == file.sha256 for model in catalogue.CATALOGUE.values())
        self._network = OnnxNetwork(file, limits, device=device, is_trusted=is_trusted, lanes=workers())
        try:
            self._prepare(size)
        except BaseException:
            self.close()
            raise

    def _prepare(self, size: Size | None) -> None:
        facts = self._network.facts
        inputs = facts["inputs"]
        self._image, self._shape, self._type = self._image_input(inputs)
        width, height = facts["sizes"][self._image]
        own = (width, height)
        wanted = size or _known(own)
        if wanted is None:
            raise McaptrackError(f"{self._file.path} takes pictures of any size; choose one with `input_size='WxH'`")
        #: Width and height of the input.
        self.size: Size = wanted
        is_other = any(mine is not None and mine != two for mine, two in zip(own, wanted, strict=True))
        self._check_size(is_other or _known(own) is None)
        if is_other and (old := _known(own)):
            try:
                self._network.open((self._image, old, wanted))
            except NetworkLimitError:
                raise
            except McaptrackError as error:
                raise self._refused_size(old) from error
        self._sizes = next(((name, kind) for name, _, kind in inputs if name == _SIZES and kind in _SIZE_TYPES), None)
        unknown = [name for name, _, _ in inputs if name not in (self._image, self._sizes and self._sizes[0])]
        if unknown:
            raise McaptrackError(f"{self._describe(inputs)}; an input {unknown[0]} is not known")
        #: The names of classes by index, as the file has them.
        self.names = {int(index): name for index, name in facts["names"].items()}
        #: Whether it runs on a GPU.
        self.is_on_gpu = facts["is_on_gpu"]
        is_open = not isinstance(self._shape[0], int)
        #: How many pictures it takes at a time: one on the CPU, where several run beside one another instead.
        self.batch = _CUDA_BATCH if is_open and self.is_on_gpu else 1
        grey = np.full((1, 3, wanted[1], wanted[0]), _GREY / 255, np.float32)
        try:
            outputs = self.run(grey)
        except McaptrackError as error:
            if is_other and not isinstance(error, NetworkLimitError):
                raise self._refused_size(_known(own)) from error
            raise
        #: The inputs and outputs of the network.
        self.signature = NetworkSignature(tuple(name for name, _, _ in inputs), outputs, wanted, len(self.names))

    def run(self, blob: NDArray[np.float32]) -> Outputs:
        """The outputs by name for pictures (B, 3, height, width). Raises McaptrackError if they can't be computed."""
        feeds: dict[str, Any] = {self._image: blob.astype(_TYPES[self._type], copy=False)}
        if self._sizes:
            name, kind = self._sizes
            feeds[name] = np.tile(np.array([self.size], _SIZE_TYPES[kind]), (len(blob), 1))
        out = {}
        for (name, _, kind), values in zip(self._network.facts["outputs"], self._network.run(feeds), strict=True):
            if values.dtype.kind not in "fiu":
                raise McaptrackError(f"{self._file.path} gives {kind} in {name}; no detector does")
            out[name] = values.astype(np.float32, copy=False) if values.dtype == np.float16 else values
        return out

    def close(self) -> None:
        """End it, and what it is at work on."""
        self._network.close()

    def _image_input(self, inputs: Sequence[Value]) -> Value:
        pictures = [value for value in inputs if len(value[1]) == 4 and _are_channels_first(value[1])]
        if not pictures or pictures[0][2] not in _TYPES:
            raise McaptrackError(f"{self._describe(inputs)}; it needs pictures B x 3 x H x W of floats")
        batch = pictures[0][1][0]
        if isinstance(batch, int) and batch != 1:
            raise McaptrackError(
                f"{self._file.path} takes {batch} pictures at a time; export it for one, or for any number"
            )
        return pictures[0]

    def _describe(self, inputs: Sequence[Value]) -> str:
        takes = ", ".join(f"{name} {_shape(shape)} {kind}" for name, shape, kind in inputs[:4])
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
        if needed > self._limits.memory_bytes // 4:
            raise McaptrackError(
                f"{self._file.path}: an input of {_text(self.size)} alone takes {needed / 1e6:,.0f} MB, and a network "
                f"may take {self._limits.memory_bytes / 1e6:,.0f} MB in all (`max_memory_mb=`)"
            )


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
