"""Pictures -> H.264, JPEG, PNG; and a video file of pictures."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.atomic import publish
from mcaptrack.errors import McaptrackError

ImageFormat = Literal["h264", "jpeg", "png"]
Image = NDArray[np.uint8]

_JPEG_QUALITY: Final = 90
# No B-frames, a key picture every second with its parameter sets, four slices whatever the machine's cores: the same
# input gives the same bytes everywhere.
_X264: Final = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "crf": "23",
    "bf": "0",
    "x264-params": "scenecut=0:threads=4:sliced-threads=1",
}
_IN_MESSAGES: Final = {"x264-params": _X264["x264-params"] + ":repeat-headers=1:annexb=1"}


class H264Encoder:
    """Pictures -> H.264 in Annex B form, one access unit a picture, without B-frames."""

    def __init__(self, width_px: int, height_px: int, fps: Fraction) -> None:
        import av

        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = width_px, height_px, "yuv420p"
        codec.time_base, codec.framerate = 1 / fps, fps
        codec.options = _X264 | _IN_MESSAGES | {"g": str(max(1, round(fps)))}
        self._codec = codec
        self._index = 0

    def encode(self, image: Image) -> bytes:
        """One picture, BGR (height, width, 3)."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
        frame.pts = self._index
        self._index += 1
        packets = self._codec.encode(frame)
        return b"".join(bytes(packet) for packet in packets)


def encode_image(image: Image, image_format: ImageFormat) -> bytes:
    """One picture, BGR, as JPEG or PNG."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if image_format == "jpeg" else []
    ok, data = cv2.imencode(f".{image_format}", image, options)
    if not ok:
        raise McaptrackError(f"a picture of {image.shape[1]} x {image.shape[0]} can't be encoded as {image_format}")
    return data.tobytes()


def write_mp4(path: Path, images: Iterable[Image], fps: int) -> int:
    """Write pictures, BGR of one even size, as an H.264 file, there once it is complete. Returns how many."""
    import av

    count = 0
    with publish(path) as part, av.open(str(part), "w", format="mp4") as container:
        stream: Any = None
        for image in images:
            if stream is None:
                stream = container.add_stream("libx264", rate=fps, options=_X264 | {"g": str(fps)})
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")):
                container.mux(packet)
            count += 1
        if stream is not None:
            for packet in stream.encode(None):
                container.mux(packet)
    return count
