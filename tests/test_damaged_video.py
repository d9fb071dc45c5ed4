"""Videos with damaged pictures: FFmpeg makes up what it can't read, so that a stage has to say so."""

from __future__ import annotations

import json
import random

import numpy as np
import pytest
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.sources import foreign
from mcaptrack.sources.video import EncodedPicture, decode_bgr, decode_gray
from tests.commands import done
from tests.logs import recorder
from tests.worlds import write_clip

DAMAGED = (5, 6, 25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log with a video of 40 pictures, and one where bytes within some of them are others."""
    folder = tmp_path_factory.mktemp("damaged")
    write_clip(folder / "a.mp4", 40, size=(320, 240))
    done("ingest", folder / "a.mp4", "-o", folder / "whole.mcap", "-q")
    rng = random.Random(1)
    damaged = recorder(folder / "damaged.mcap", "ros2")
    with (folder / "whole.mcap").open("rb") as source, damaged as writer:
        topic = 0
        messages = make_reader(source).iter_messages(topics=["/camera/video"])
        for number, (schema, channel, message) in enumerate(messages):
            record = (schema.name, schema.encoding, schema.data)
            topic = topic or writer.add_channel(channel.topic, record, "protobuf")
            data = bytearray(message.data)
            for at in [rng.randrange(len(data) // 2, len(data) - 10) for _ in range(6 * (number in DAMAGED))]:
                data[at] ^= 0xFF
            writer.add_message(topic, message.log_time, bytes(data), message.publish_time, number)
    return folder


@pytest.mark.parametrize("decode", [decode_gray, decode_bgr])
def test_damaged_pictures_are_those_with_other_pixels(folder, decode):
    def pictures(name: str, damaged: list[int]) -> list[np.ndarray]:
        with log.read(folder / name) as opened:
            encoded = [
                EncodedPicture(message.t_ns, n, picture.format, picture.data, picture.layout)
                for n, (message, picture) in enumerate(foreign.pictures(opened, "/camera/video"))
            ]
        return [frame.rows for frame in decode(encoded, damaged=damaged)]

    whole, found = list[int](), list[int]()
    before, after = pictures("whole.mcap", whole), pictures("damaged.mcap", found)
    assert whole == []
    assert found
    assert set(found) <= set(DAMAGED)
    assert all(not np.array_equal(before[number], after[number]) for number in found)


@pytest.mark.parametrize("detector", ["knn", "median"])  # median reads them twice
def test_a_stage_says_that_pictures_are_damaged_and_once(folder, tmp_path, detector):
    for name, count in (("whole.mcap", 0), ("damaged.mcap", 1)):
        words = ("detect", folder / name, "--detector", detector, "-o", tmp_path / name, "--json", "-q")
        said = [one for one in json.loads(done(*words).out)["warnings"] if one["code"] == "lost"]
        assert len(said) == count
        assert all(" of 40 pictures are damaged, number 5 first; " in one["message"] for one in said)
