"""What a report says of uncertain decisions and of corrected tracks."""

from __future__ import annotations

import shutil
from pathlib import Path

import mcaptrack
from mcaptrack import log
from mcaptrack.extensions.report.identity_events import Doubt, IdentityEvent, find_doubtful_tracks
from mcaptrack.extensions.report.page import gather
from mcaptrack.schema import DECISIONS, Frame


def test_the_least_likely_tracks_come_first_and_sure_ones_not_at_all():
    rows = DECISIONS.rows(
        kind=[1, 2, 2, 3, 3], track_id=[1, 1, 2, -1, -1], previous_id=[5, -1, -1, -1, -1], source_id=[6, 5, 6, 7, 8],
        probability=[0.1, 0.95, 0.6, 0.55, 0.9], alternative_id=[-1] * 5, duration_s=[0.4, 9.0, 8.0, 7.0, 6.0],
        frames=[0, 20, 19, 18, 17],
    )  # fmt: skip
    rows["additional"][3] = 0.15
    found = find_doubtful_tracks([Frame(0, 0, rows)])
    assert [one.text("a person").replace("\N{NO-BREAK SPACE}", " ") for one in found] == [
        "the tracker's 7 is left out, seen for 7.0 s: the probability of being a person is 45 %, "
        "15 % for an additional one",
        "track 2 is kept, seen for 8.0 s: the probability of being a person is 60 %",
    ]


def test_what_would_be_otherwise_is_said_of_the_track_before():
    event = IdentityEvent(0, {"previous_id": 606}, 1.0, "track 3 joins the tracker's 606 and 605")
    for other, said in ((8, "606 goes on as 8"), (606, "606 goes on as it did"), (-1, "606 ended, and another came")):
        assert Doubt(event, 0.0, "", None, 0.02, other).text().endswith(f"; otherwise {said}.")


def test_tracks_that_people_corrected_are_named_so(template, tmp_path):
    path = Path(shutil.copy(template, tmp_path / "a.mcap"))
    boxes = mcaptrack.export(path, tmp_path / "a.xml", form="cvat").folder
    mcaptrack.ingest(boxes, role="corrections", into=path)
    mcaptrack.run(path)
    with log.read(path) as opened:
        names = {role: tracks.name for role, tracks in gather(opened, None).track_sets.items()}
    assert (names["samples"], names["tracks"]) == ("SORT, corrected", "SORT, every picture")
