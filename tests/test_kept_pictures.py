"""Pictures that are read twice: the same both times, decoded once if there is room for them, in a thread."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.pipeline.pictures import KeptPictures
from mcaptrack.schema import Frame


def pictures() -> list[Frame]:
    """Noise that partly stays, in colour and in grey, of two sizes, with lines that lie apart in memory."""
    rng = np.random.default_rng(0)
    still = rng.integers(0, 256, (40, 64, 3)).astype(np.uint8)
    changed = [still.copy() for _ in range(4)]
    for n, image in enumerate(changed):
        image[10 : 10 + 5 * n, 20:40] = rng.integers(0, 256, (5 * n, 20, 3))
    rows = [still, *changed, still[:, ::2], still[..., 0], still]
    return [Frame(100 * n + 7, 2 * n, one) for n, one in enumerate(rows)]


class Decoder:
    """Decodes anew each time it is called; ``begun`` counts that."""

    def __init__(self) -> None:
        self.begun = 0

    def __call__(self):
        self.begun += 1
        for frame in pictures():
            yield frame._replace(rows=frame.rows.copy())


def check(found: list[Frame]) -> None:
    assert [frame[:2] for frame in found] == [frame[:2] for frame in pictures()]
    for frame, wanted in zip(found, pictures(), strict=True):
        np.testing.assert_array_equal(frame.rows, wanted.rows)


def test_pictures_are_decoded_once_and_the_same_each_time():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    for _ in range(3):
        check(list(kept))
    assert decoder.begun == 1


def test_drawing_into_a_picture_changes_no_other():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    for _ in range(2):
        for frame in kept:
            frame.rows[:] = 0
    check(list(kept))


@pytest.mark.parametrize(("max_bytes", "begun"), [(0, 2), (9_000, 2), (60_000, 1)])
def test_what_takes_too_much_memory_is_decoded_again(max_bytes, begun):
    """The first picture alone is 7,680 bytes of noise, all together are less than 60,000."""
    decoder = Decoder()
    kept = KeptPictures(decoder, max_bytes)
    check(list(kept))
    check(list(kept))
    assert decoder.begun == begun
    assert sum(one.difference.stored for one in kept._kept) <= max_bytes


def test_a_reading_that_was_left_is_begun_again():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    next(iter(kept))
    check(list(kept))
    check(list(kept))
    assert decoder.begun == 2
