"""Passing a video on against encoding it again, and any picture against all before it.

Draws a clip of H.264 without B-frames, makes a log of it both ways in turn, and holds the hash of every picture in the
log that was passed on against that of the same picture decoded from the clip itself by FFmpeg. Prints seconds and
ratios, the best of several rounds.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from pathlib import Path
from time import perf_counter

import av
import cv2
import numpy as np

from mcaptrack import log
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.pictures import Pictures

TOPIC, FPS, ROUNDS = "/camera/video", 30, 3


def draw(path: Path, seconds: int, size: tuple[int, int]) -> None:
    """People-sized spots that wander over a noisy square."""
    width, height = size
    rng = np.random.default_rng(1)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (height, width, 3), np.uint8), (0, 0), 2)
    at, step = rng.uniform(0, 1, (20, 2)) * size, rng.normal(0, 2, (20, 2))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"bf": "0", "g": str(FPS), "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for _ in range(seconds * FPS):
            image = cv2.add(ground, rng.integers(0, 6, ground.shape, np.uint8))
            at = (at + step) % size
            for x, y in at:
                cv2.ellipse(image, (int(x), int(y)), (12, 30), 0, 0, 360, (30, 30, 120), -1)
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)


def timed(clip: Path, output: Path, options: IngestOptions) -> float:
    """Seconds to make the log."""
    start = perf_counter()
    ingest(clip, output, options)
    return perf_counter() - start


def hashes_of_clip(clip: Path) -> list[str]:
    """Of every picture, decoded from the clip."""
    with av.open(str(clip)) as container:
        return [hashlib.sha256(f.to_ndarray(format="bgr24").tobytes()).hexdigest() for f in container.decode(video=0)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        clip, passed, encoded = (Path(folder) / name for name in ("clip.mp4", "passed.mcap", "encoded.mcap"))
        draw(clip, given.seconds, tuple(given.size))
        count = given.seconds * FPS
        print(f"{count} pictures of {given.size[0]} x {given.size[1]}, {clip.stat().st_size / 2**20:.1f} MiB")
        times = [
            (timed(clip, passed, IngestOptions()), timed(clip, encoded, IngestOptions(quality=23)))
            for _ in range(ROUNDS)
        ]
        pass_s, encode_s = (min(column) for column in zip(*times, strict=True))
        print(f"passed on      {pass_s:8.3f} s  {count / pass_s:8.0f} pictures/s")
        print(f"encoded again  {encode_s:8.3f} s  {count / encode_s:8.0f} pictures/s")
        print(f"ratio          {encode_s / pass_s:8.1f}")
        with log.read(passed) as opened:
            pictures = Pictures(opened, TOPIC)
            start = perf_counter()
            ours = [hashlib.sha256(frame.rows.tobytes()).hexdigest() for frame in pictures.frames(range(count))]
            all_s = perf_counter() - start
            assert ours == hashes_of_clip(clip), "a picture in the log is not that of the clip"
            print(f"all {len(ours)} pictures of the log are those of the clip, to the bit")
            start = perf_counter()
            (_,) = pictures.frames([count - 1])
            print(f"last picture: {1e3 * (perf_counter() - start):.1f} ms; all: {1e3 * all_s:.0f} ms")
            spent, decoded = [], []
            for number in np.random.default_rng(2).permutation(count)[:40].tolist():
                one = Pictures(opened, TOPIC)
                start = perf_counter()
                (frame,) = one.frames([number])
                spent.append(perf_counter() - start)
                decoded.append(one.decoded)
                assert hashlib.sha256(frame.rows.tobytes()).hexdigest() == ours[number]
            print(
                f"any picture: {1e3 * np.mean(spent):.1f} ms on average, {1e3 * max(spent):.1f} ms at most, "
                f"{np.mean(decoded):.1f} and at most {max(decoded)} decoded for it"
            )


if __name__ == "__main__":
    main()
