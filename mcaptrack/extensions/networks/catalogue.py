"""The catalogue of detectors by other authors: origin, licence and digest of their weights, and their folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final

from mcaptrack.environment import cache_folder, variable
from mcaptrack.errors import McaptrackError, call, offer

_YOLOX: Final = "https://github.com/Megvii-BaseDetection/YOLOX"
_RELEASE: Final = f"{_YOLOX}/releases/download/0.1.1rc0"
_SAMPLE: Final = "Kazuhito00/YOLOX-ONNX-TFLite-Sample"
_ZOO: Final = "opencv/opencv_zoo/c79d9191ff792df933d348bd1c4de05edf77ddf9/models/object_detection_yolox"


@dataclass(frozen=True, kw_only=True)
class Model:
    """A detector of the catalogue.

    Attributes
    ----------
    name : str
        Its name, as in `--detector yolox-nano`.
    urls : tuple of str
        Where its file can be fetched, tried in this order.
    sha256 : str
        The digest that the file has to have.
    size_bytes : int
        The size of the file, in bytes.
    licence : str
        The licence of the weights.
    source : str
        The page of its authors.
    trained_on : str
        The data it was trained on.
    good_for : str
        What it is good for.

    """

    name: str
    urls: tuple[str, ...]
    sha256: str
    size_bytes: int
    licence: str
    source: str
    trained_on: str
    good_for: str

    @property
    def path(self) -> Path:
        """Where its file is kept, whether or not it is there."""
        return folder() / f"{self.name}-{self.sha256[:12]}.onnx"


_yolox = partial(Model, licence="Apache-2.0", source=_YOLOX, trained_on="COCO")
_MODELS: Final = (
    _yolox(
        name="yolox-nano",
        urls=(
            f"https://raw.githubusercontent.com/{_SAMPLE}/3d4f111/model/yolox_nano.onnx",
            f"https://github.com/{_SAMPLE}/raw/3d4f111/model/yolox_nano.onnx",
        ),
        sha256="695e750a5d5754bb5a8d5325643b59282191a7e7a564e435a415fd3c578eab14",
        size_bytes=3_660_092,
        good_for="people and vehicles on a CPU, at any multiple of 32 pixels",
    ),
    _yolox(
        name="yolox-tiny",
        urls=(f"{_RELEASE}/yolox_tiny.onnx",),
        sha256="427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7",
        size_bytes=20_219_662,
        good_for="the same with more certainty, several times slower; not measured with mcaptrack",
    ),
    _yolox(
        name="yolox-s",
        urls=(
            f"https://media.githubusercontent.com/media/{_ZOO}/object_detection_yolox_2022nov.onnx",
            f"{_RELEASE}/yolox_s.onnx",
        ),
        sha256="c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063",
        size_bytes=35_858_002,
        good_for="the same on a GPU; not measured with mcaptrack",
    ),
)
#: The models by name.
CATALOGUE: Final[Mapping[str, Model]] = MappingProxyType({model.name: model for model in _MODELS})


def find(name: str) -> Model:
    """Return the model of this name. Raises McaptrackError if there is none."""
    if name not in CATALOGUE:
        raise McaptrackError(f"there is no model {name}; {offer(name, CATALOGUE, 'there are')}")
    return CATALOGUE[name]


def check(model: Model, sha256: str, size: int, where: Path) -> None:
    """Raise McaptrackError if a file with this digest and size, in bytes, is not a model's file."""
    if sha256 != model.sha256:
        again = f"; {call('get_model', model.name)} fetches it again" if where == model.path else ""
        is_other = size != model.size_bytes
        has = f"{size:,} bytes, not {model.size_bytes:,}" if is_other else f"SHA-256 {sha256[:12]}..."
        expected = "" if is_other else f", not {model.sha256[:12]}..."
        raise McaptrackError(f"{where} is not the file of {model.name}: it has {has}{expected}{again}")


def stored(model: Model) -> Path:
    """Return the path of a model's file, which isn't read. Raises McaptrackError if it was not fetched."""
    if not model.path.is_file():
        raise McaptrackError(
            f"the weights of {model.name} are not here yet; {call('get_model', model.name)} fetches them "
            f"({model.size_bytes / 1e6:.1f} MB, {model.licence})"
        )
    return model.path


def folder() -> Path:
    """Return the folder of fetched files: ``MCAPTRACK_MODELS``, or one in the user's folder of caches."""
    chosen = variable("MCAPTRACK_MODELS")
    return Path(chosen) if chosen else cache_folder() / "models"
