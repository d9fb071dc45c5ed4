"""A network in ONNX Runtime, in whichever process: checked, opened and run. No other module imports ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from threading import Lock
from typing import Any, Final, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from mcaptrack.extensions.networks import graph

Limit = Literal["", "memory", "time"]
Device = Literal["auto", "cpu", "cuda"]
#: Name of an input or output, its shape (a text or None is an open dimension), and its type in ONNX Runtime's words.
Value = tuple[str, list[int | str | None], str]

_CPU: Final = "CPUExecutionProvider"
_CUDA: Final = "CUDAExecutionProvider"
#: Longer texts of the metadata are not passed on; networks with longer names are refused, since messages have them.
_LONGEST: Final = 1000


class SessionError(Exception):
    """A network can't be opened or run: why, in words that follow its name, or the limit that it exceeds."""

    def __init__(self, message: str, limit: Limit = "") -> None:
        super().__init__(message)
        self.limit: Limit = limit


class Facts(TypedDict):
    """Facts of an open network, which can be written as JSON."""

    inputs: list[Value]
    outputs: list[Value]
    #: Width and height of the pictures that each input with four dimensions takes; None where that is open.
    sizes: dict[str, tuple[int | None, int | None]]
    #: The names of classes by index, written as text, from the metadata.
    names: dict[str, str]
    metadata: dict[str, str]
    is_on_gpu: bool
    #: Whether a GPU is there that can't be used.
    is_without_gpu: bool


#: The name of an input, and its old and new width and height.
Resize = tuple[str, tuple[int, int], tuple[int, int]]


class Session:
    """An open network; several threads may run it.

    Raises SessionError if the bytes are no network, reach out of the file, or can't be opened.
    """

    def __init__(self, data: bytes, device: Device, memory_bytes: int, resize: Resize | None = None) -> None:
        import onnxruntime

        try:
            model = graph.parse(data)
        except graph.NotOnnxError:
            raise SessionError("is no ONNX file, or is damaged or incomplete") from None
        if fault := graph.reach(model):
            raise SessionError(fault)
        if resize is not None:
            data = graph.resized(data, *resize)
            model = graph.parse(data)
        providers = _providers(device)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # pictures run beside one another; the tracks of one frame are too few
        options.log_severity_level = 4
        options.add_session_config_entry("session.use_env_allocators", "1")
        options.add_session_config_entry("session.load_model_format", "ONNX")  # what was checked
        info = onnxruntime.OrtMemoryInfo(
            "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
        )
        arena = onnxruntime.OrtArenaCfg({"max_mem": memory_bytes, "arena_extend_strategy": 1})
        with _OPENING:  # the next session takes the allocator that was registered last
            try:
                onnxruntime.create_and_register_allocator(info, arena)
            except RuntimeError as error:  # ONNX Runtime 1.19 keeps the first one that a process has registered
                if "already been registered" not in str(error):
                    raise
            try:
                self._session = onnxruntime.InferenceSession(data, options, providers=providers)
            except Exception as error:  # ONNX Runtime has no common base class of its errors
                raise SessionError(f"can't be run by ONNX Runtime: {_short(error)}") from None
        is_on_gpu = _CUDA in self._session.get_providers()
        if device == "cuda" and not is_on_gpu:
            raise SessionError("can't be run on CUDA here; see what ONNX Runtime's CUDA needs")
        inputs, outputs = (
            [(tensor.name, list(tensor.shape or []), tensor.type) for tensor in tensors]
            for tensors in (self._session.get_inputs(), self._session.get_outputs())
        )
        names = [part for name, shape, _ in (*inputs, *outputs) for part in (name, *shape) if isinstance(part, str)]
        if len(longest := max(names, key=len, default="")) > _LONGEST:
            raise SessionError(f"has a name of {len(longest):,} characters, {longest[:20]}...; give it a shorter one")
        self._alone = Lock()
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.facts: Facts = {
            "inputs": inputs,
            "outputs": outputs,
            "sizes": {name: graph.input_size(model, name) for name, shape, _ in inputs if len(shape) == 4},
            "names": {str(index): name for index, name in graph.class_names(model).items()},
            "metadata": {key: text for key, text in metadata.items() if len(key) + len(text) < _LONGEST},
            "is_on_gpu": is_on_gpu,
            "is_without_gpu": providers[0] == _CUDA and not is_on_gpu,
        }

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """The outputs, in order; one that holds no numbers is empty, of type object. Raises SessionError."""
        try:
            outputs = self._run(inputs)
        except SessionError as error:
            if not error.limit:
                raise
            with self._alone:  # while no other thread runs it, after all of them together took too much
                outputs = self._run(inputs)
        return [_numbers(output) for output in outputs]

    def _run(self, inputs: Mapping[str, NDArray[Any]]) -> list[Any]:
        try:
            return list(self._session.run(None, inputs))
        except Exception as error:
            limit: Limit = "memory" if "memory" in str(error) else ""
            raise SessionError(f"can't be run: {_short(error)}", limit) from None


def is_installed() -> bool:
    """Whether ONNX Runtime is there."""
    return find_spec("onnxruntime") is not None


def providers() -> tuple[str, ...]:
    """The providers of ONNX Runtime, such as "CPUExecutionProvider"; () if it can't be imported."""
    try:
        import onnxruntime
    except ImportError:
        return ()
    return tuple(onnxruntime.get_available_providers())


def uses_gpu(device: Device) -> bool:
    """Whether a network that is to run on this device may open a GPU."""
    return device != "cpu" and _CUDA in providers()


_OPENING: Final = Lock()


def _providers(device: Device) -> list[str]:
    if device == "cuda" and not uses_gpu(device):
        raise SessionError(
            f"can't be run on CUDA: ONNX Runtime has no CUDA here, only {', '.join(providers())}; "
            "`pip install onnxruntime-gpu` brings it"
        )
    return [_CUDA, _CPU] if uses_gpu(device) else [_CPU]


def _numbers(output: Any) -> NDArray[Any]:
    try:
        array = np.asarray(output)
    except ValueError:  # a sequence of arrays of several shapes
        return np.empty(0, object)
    return array if array.dtype.kind in "fiub" else np.empty(0, object)


def _short(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else text[:200] + " ..."
