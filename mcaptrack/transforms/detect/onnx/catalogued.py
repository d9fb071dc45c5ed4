"""The detectors of the catalogue, each with the settings that suit it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

from mcaptrack.transforms.detect.onnx.detector import NETWORK, LayoutChoice, OnnxDetector
from mcaptrack.transforms.detect.onnx.session import check, find, stored
from mcaptrack.transforms.protocol import Suited, option


@dataclass(frozen=True, kw_only=True)
class CataloguedDetector(OnnxDetector):
    """Base of the detectors of the catalogue: YOLOX, with an input of about the size of the picture."""

    layout: LayoutChoice = option("yolox", "family of the network", theme=NETWORK)
    input_size: str = option(
        "picture",
        "width and height of the network's input, as in 416x416, or `picture` for about those of the picture",
        theme=NETWORK,
    )

    #: False boxes score up to 0.6 and begin no tracks, so that those that begin need no confirmation.
    suits: ClassVar[Mapping[str, Suited]] = MappingProxyType(
        {
            "tracker": OnnxDetector.suits["tracker"]._replace(
                parameters=MappingProxyType({"new_score": 0.7, "min_hits_frames": 1})
            )
        }
    )
    #: Its name in the catalogue.
    model: ClassVar[str]

    def weights(self) -> Path:
        """The file of the network. Raises McaptrackError if it was not fetched."""
        return super().weights() if self.file else stored(find(self.model))

    def check_weights(self, sha256: str, size: int) -> None:
        """Raise McaptrackError if a file with this digest and size, in bytes, is not that of the catalogue."""
        check(find(self.model), sha256, size, self.weights())

    def weights_sha256(self) -> str:
        """The digest of the network's file."""
        return find(self.model).sha256


@dataclass(frozen=True, kw_only=True)
class YoloxNano(CataloguedDetector):
    """With `--detector yolox-nano` a small network finds people and other objects in each picture.

    Reads video, writes detections. `mcaptrack models get yolox-nano` fetches its weights once.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-nano"


@dataclass(frozen=True, kw_only=True)
class YoloxTiny(CataloguedDetector):
    """With `--detector yolox-tiny` a larger network does the same more slowly.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-tiny"


@dataclass(frozen=True, kw_only=True)
class YoloxS(CataloguedDetector):
    """With `--detector yolox-s` a network for GPUs does the same.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-s"
