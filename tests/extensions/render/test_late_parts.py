"""A late part of a video: as many pictures are decoded as it takes."""

from __future__ import annotations

import av
import numpy as np

from mcaptrack import log
from mcaptrack.extensions.render import video
from mcaptrack.extensions.render.video import RenderOptions, render
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.pictures import Pictures
from tests.test_pictures import COUNT, TOPIC, X264
from tests.worlds import write_clip


def test_a_late_part_is_rendered_without_decoding_what_is_before_it(tmp_path, monkeypatch):
    write_clip(tmp_path / "a.mkv", frames=COUNT, options=X264)
    ingest(tmp_path / "a.mkv", tmp_path / "a.mcap", IngestOptions())
    used = []

    class Counted(Pictures):
        def __init__(self, *given):
            super().__init__(*given)
            used.append(self)

    monkeypatch.setattr(video, "Pictures", Counted)
    with log.read(tmp_path / "a.mcap") as opened:
        options = RenderOptions(start_s=4.4, end_s=4.95)
        assert render(opened, TOPIC, (), tmp_path / "late.mp4", options) == 6
        assert used[-1].decoded == 10  # 40 to 49: the key picture, and four that are not shown
        assert render(opened, TOPIC, (), tmp_path / "all.mp4", RenderOptions()) == COUNT
        assert used[-1].decoded == COUNT
        thin = RenderOptions(max_fps=1.0)
        assert render(opened, TOPIC, (), tmp_path / "thin.mp4", thin) == 6
        assert used[-1].decoded == 6
    with av.open(str(tmp_path / "late.mp4")) as late, av.open(str(tmp_path / "all.mp4")) as whole:
        wanted = [frame.to_ndarray(format="gray") for frame in whole.decode(video=0)][44:50]
        found = [frame.to_ndarray(format="gray") for frame in late.decode(video=0)]
    assert len(found) == 6
    for one, other in zip(found, wanted, strict=True):
        assert np.abs(one.astype(int) - other).mean() < 2
