"""The annotated video: what the views say, drawn where and as they say it."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.rendering import draw
from mcaptrack.video import write_clip
from mcaptrack.video.decode import Encoded, colours
from mcaptrack.video.encode import encode_image
from mcaptrack.video.raw import Layout
from tests.test_cli import call, done, finished, footage  # noqa: F401

GREY = np.full((100, 200, 3), 100, np.uint8)


def annotations(boxes, ids=None, paths=(), **options):
    payload = foxglove.pack_annotations(1, np.array(boxes, float).reshape(-1, 4), ids, paths, **options)
    return foxglove.unpack(foxglove.ANNOTATIONS, payload)


def clip(path: Path) -> list[tuple[float, np.ndarray]]:
    with av.open(str(path)) as container:
        return [(float(f.pts * f.time_base), f.to_ndarray(format="bgr24")) for f in container.decode(video=0)]


def test_a_box_is_drawn_on_its_edges_in_the_colour_of_its_identity_and_nowhere_else():
    image = draw(GREY, annotations([[20, 30, 60, 40]], [3]))
    red, green, blue, _ = foxglove.colour(3)
    wanted = np.array([blue, green, red]) * 255
    for x, y in ((50, 70), (80, 50), (20, 55)):
        assert abs(image[y, x] - wanted).max() <= 2
    assert (image[35:65, 45:75] == 100).all()  # inside, right of the id
    assert (image[75:, :] == 100).all()
    assert (image[:, 90:] == 100).all()
    assert not np.array_equal(image[20:30, 20:28], GREY[20:30, 20:28])  # the id, above its corner
    assert (GREY == 100).all()


def test_lines_fade_as_their_points_say():
    path = foxglove.Path(0, np.array([[10.0, 50], [60, 50], [110, 50]]), [0.0, 0.2, 0.8])
    image = draw(GREY, annotations([], None, [path])).astype(float)
    red, green, blue, _ = foxglove.colour(0)
    wanted = np.array([blue, green, red]) * 255
    assert abs(image[50, 35] - (0.2 * wanted + 0.8 * 100)).max() <= 2
    assert abs(image[50, 85] - (0.8 * wanted + 0.2 * 100)).max() <= 2


def test_what_is_drawn_is_scaled_with_the_picture():
    large, small = np.zeros((200, 400, 3), np.uint8), np.zeros((100, 200, 3), np.uint8)
    both = draw(large, annotations([[40, 60, 120, 80]])), draw(small, annotations([[40, 60, 120, 80]]), 0.5)
    spans = [[np.flatnonzero(image.any(axis=2).any(axis=axis))[[0, -1]] for axis in (0, 1)] for image in both]
    assert abs(np.array(spans[0]) / 2 - np.array(spans[1])).max() <= 2


def test_a_picture_where_nothing_is_stays_as_it_is():
    assert np.array_equal(draw(GREY, annotations([])), GREY)
    assert np.array_equal(draw(GREY, annotations([[np.nan] * 4], [1])), GREY)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_clip_keeps_the_times_and_colours_of_its_pictures(tmp_path, suffix):
    times = [5_000_000_000, 5_100_000_000, 5_300_000_000, 5_400_000_000]
    shades = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (120, 120, 120)]
    images = [np.full((64, 96, 3), shade, np.uint8) for shade in shades]
    path = tmp_path / f"a{suffix}"
    assert write_clip(path, zip(times, images, strict=True), Fraction(10)) == 4
    found = clip(path)
    assert [t for t, _ in found] == pytest.approx([0, 0.1, 0.3, 0.4], abs=0.011)
    for (_, image), shade in zip(found, shades, strict=True):
        assert abs(image.astype(int).mean(axis=(0, 1)) - shade).max() < 8


def test_pictures_of_every_kind_are_read_in_colour():
    image = np.zeros((16, 16, 3), np.uint8)
    image[:, :8], image[:, 8:] = (250, 20, 20), (20, 20, 250)
    rgb = image[:, :, ::-1].tobytes()
    grey = np.full((16, 16), 77, np.uint8)
    pictures = [
        Encoded(0, 0, "png", encode_image(image, "png")),
        Encoded(1, 1, "bgr8", image.tobytes(), Layout(16, 16)),
        Encoded(2, 2, "rgb8", rgb, Layout(16, 16)),
        Encoded(3, 3, "mono8", grey.tobytes(), Layout(16, 16)),
    ]
    found = [frame.rows for frame in colours(pictures)]
    assert all(np.array_equal(rows, image) for rows in found[:3])
    assert np.array_equal(found[3], np.repeat(grey[..., None], 3, axis=2))


def test_a_log_becomes_a_video_of_its_pictures(finished, tmp_path):  # noqa: F811
    out, _ = done("render", finished, "-o", tmp_path / "all.mp4", "--json")
    (result,) = json.loads(out)["results"]
    assert result["views"] == ["/camera/retracks/full/view/image", "/camera/retracks/predictions/view/image"]
    found = clip(tmp_path / "all.mp4")
    assert len(found) == result["pictures"]
    done(
        "render",
        finished,
        "--topic",
        "/camera/truth",
        "--width",
        160,
        "--gif",
        "--end-s",
        1.05,
        "--force",
        "-o",
        tmp_path / "a.gif",
    )
    small = clip(tmp_path / "a.gif")
    assert [t for t, _ in small] == pytest.approx(np.arange(len(small)) / 10, abs=0.06)
    assert 9 <= len(small) <= 11
    assert small[0][1].shape[1] == 160


MISTAKES = {
    "another suffix": (["-o", "a.avi"], "a video is rendered to .mp4 or .gif, not to .avi"),
    "no such view": (["--topic", "/camera/none"], "has no channel /camera/none/view/image"),
    "no such second": (["--start-s", "5000"], "no picture lies in the seconds that were asked for; there are "),
    "a width of nothing": (["--width", "0"], "--width is a number from 16 to 16384, not 0"),
}


@pytest.mark.parametrize("words", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_said_in_a_line(finished, tmp_path, words):  # noqa: F811
    code, out, err = call(
        "render", finished, *(["-o", "b.mp4"] if "-o" not in words[0] else []), *words[0], folder=tmp_path
    )
    assert (code, out) == (1, "")
    assert words[1] in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_log_without_views_says_what_makes_them(footage, tmp_path):  # noqa: F811
    path = tmp_path / "a.mcap"
    done("ingest", footage.video, "-o", path)
    code, _, err = call("render", path)
    assert (code, "has no views of /camera yet; `mcaptrack run" in err) == (1, True)
    done("ingest", footage.truth, "--as", "truth", "--fps", 10, "-o", tmp_path / "labels.mcap")
    code, _, err = call("render", tmp_path / "labels.mcap")
    assert (code, "has no pictures of /camera to draw on" in err) == (1, True)


def test_nothing_is_left_of_a_clip_that_fails(tmp_path):
    def broken():
        yield 0, np.zeros((64, 64, 3), np.uint8)
        raise McaptrackError("half way")

    for suffix in (".mp4", ".gif"):
        with pytest.raises(McaptrackError, match="half way"):
            write_clip(tmp_path / f"a{suffix}", broken(), Fraction(10))
    assert not list(tmp_path.iterdir())
