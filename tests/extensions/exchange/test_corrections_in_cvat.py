"""Tracks that people correct in CVAT come back, and runs keep the corrections."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import TRACKS
from mcaptrack.schema.framing import join_frames
from tests.commands import done


def test_corrections_made_in_cvat_come_back_and_run_keeps_them(template, tmp_path):
    path = Path(shutil.copy(template, tmp_path / "a.mcap"))
    boxes = mcaptrack.export(path, tmp_path / "a.xml", form="cvat").folder
    text = boxes.read_text()
    unchanged = mcaptrack.ingest(boxes, role="corrections", into=path)
    assert list(unchanged.messages) == ["/camera/corrected"]
    assert unchanged.changes["of"] == "/camera/retracks/full"
    assert [unchanged.changes[name] for name in ("moved", "added", "removed")] == [0, 0, 0]
    # A person draws another one, who nobody found: there in the first 10 pictures, and again from the 21st to the 28th.
    corner = 'xtl="50" ytl="2" xbr="58" ybr="12" occluded="0"'
    drawn = f'<track id="9" label="person"><box frame="0" keyframe="1" outside="0" {corner}/>'
    drawn += "".join(f'<box frame="{k}" outside="{int(k != 20)}" {corner}/>' for k in (10, 20, 28)) + "</track>"
    boxes.write_text(text.replace("</annotations>", drawn + "</annotations>"))
    out = done("ingest", boxes, "--as", "corrections", "--into", path, "--force")
    assert "18 added, new tracks" in " ".join((out.out + out.err).split())
    (new,) = mcaptrack.ingest(boxes, role="corrections", into=path, force=True).changes["new_tracks"]
    assert mcaptrack.info(path).to_json()["channels"]
    with log.read(path) as opened:
        before = len(np.unique(opened.rows("/camera/retracks", TRACKS).rows["track_id"]))
    said = done("run", path, "--no-tables")
    told = said.out + said.err
    assert "corrections of /camera/tracks have changed: running sample again" in " ".join(told.split())
    assert re.search(r"corrected +\d+ boxes of \d+ tracks by people, in 30 pictures", told)
    assert re.search(r"re-tracked .* 0 left out", told)
    assert "/camera/samples  sample  with /camera/corrected" in done("info", path).out
    with log.read(path) as opened:
        topics = "/camera/corrected", "/camera/retracks/full"
        corrected, full = (join_frames(TRACKS, opened.frame_columns(topic, TRACKS)) for topic in topics)
        after = len(np.unique(opened.rows("/camera/retracks", TRACKS).rows["track_id"]))
    assert after == before + 1
    owner: dict[int, set[int]] = {}
    for row, t_ns in zip(corrected.rows, corrected.row_ns, strict=True):
        same = (full.row_ns == t_ns) & (np.abs(full.rows["x_px"] - row["x_px"]) < 1e-6)
        owner.setdefault(int(row["track_id"]), set()).update(full.rows["track_id"][same].tolist())
    assert len(owner[new]) == 1
    assert sorted(len(one) for one in owner.values()) == [1] * len(owner)
    assert len(full.rows) == len(corrected.rows)  # and nothing else
    assert mcaptrack.run(path, tables=False).stages == ()
    (tmp_path / "part.txt").write_text("3,1,2,3,4,5,1,1,1\n4,1,2,3,4,5,1,1,1\n")
    part = mcaptrack.ingest(tmp_path / "part.txt", role="corrections", into=path, force=True)
    assert ["/camera/corrected covered 28 pictures more" in one.message for one in part.warnings] == [True]
    mcaptrack.drop(path, ["/camera/corrected"])
    mcaptrack.run(path, tables=False)
    with log.read(path) as opened, log.read(template) as first:
        assert opened.rows("/camera/retracks", TRACKS).rows.tobytes() == (
            first.rows("/camera/retracks", TRACKS).rows.tobytes()
        )
