"""Zones in worlds of re-tracking."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack.evaluation.intervals import WIDER, WIDER_MEAN
from mcaptrack.notices import collected
from tests.commands import done
from tests.extension_cases import needs
from tests.worlds import noisy_tracks, write_channels

RIGHT = {"type": "Polygon", "coordinates": [[[2, -99], [99, -99], [99, 99], [2, 99], [2, -99]]]}
LEFT = {"type": "Polygon", "coordinates": [[[2, -99], [-99, -99], [-99, 99], [2, 99], [2, -99]]]}
SIDES = {
    "type": "FeatureCollection",
    "units": "metres",
    "features": [
        {"type": "Feature", "properties": {"name": name}, "geometry": shape}
        for name, shape in (("right", RIGHT), ("left", LEFT))
    ],
}
#: The visits of the right side in each world, the mean of their times, and the tracks that went from right to left.
OF_SIDES = """
with steps as (select world, track_id, x_m >= 2 as is_in, t_ns, lead(t_ns) over track as next_ns,
                      coalesce(lag(x_m >= 2) over track, x_m < 2) != (x_m >= 2) as is_new
               from world_tracks window track as (partition by world, track_id order by t_ns)),
     stays as (select world, track_id, min(t_ns) filter (is_in and is_new) as first_in,
                      max(t_ns) filter (not is_in and is_new) as last_out,
                      sum(next_ns - t_ns) filter (is_in) / 1e9 as s, count(*) filter (is_in and is_new) as visits
               from steps group by all)
select world, count(*) filter (visits > 0) as tracks, coalesce(sum(s) / sum(visits), 'nan') as stay,
       count(*) filter (first_in < last_out) as then_left from stays group by world order by world
"""


@needs("query")
def test_zones_have_the_medians_and_intervals_of_what_sql_counts_in_each_world(with_worlds, tmp_path):
    there = Path(shutil.copyfile(with_worlds, tmp_path / "log.mcap"))
    made = mcaptrack.zones(there, zones=SIDES, margin_m=0, max_gap_s=1.3).zones["/camera/retracks"]
    (right,) = (total.in_worlds for total in made if total.zone == "right")
    wanted = mcaptrack.query(there, OF_SIDES).to_pydict()
    assert len(set(wanted["tracks"])) > 1
    assert len(set(wanted["stay"])) > 1
    assert len(set(wanted["then_left"])) > 1
    for found, name, is_count in (
        (right.tracks, "tracks", True),
        (right.mean_dwell_s, "stay", False),
        (right.then["left"], "then_left", True),
    ):
        low, middle, high = np.percentile(wanted[name], [5, 50, 95])
        wider = (WIDER if is_count else WIDER_MEAN) * middle
        ends = max(low - wider, 0), high + wider
        ends = (np.floor(ends[0]), np.ceil(ends[1])) if is_count else ends
        assert found == pytest.approx((middle, *ends)), name


def test_zones_of_few_people_have_no_interval_and_those_of_logs_without_worlds_say_nothing(tmp_path):
    there = tmp_path / "log.mcap"
    write_channels(there, samples=noisy_tracks(np.random.default_rng(5), people=3, ticks=80))
    done("retrack", there, "--worlds", "9", "-q")
    with collected() as warnings:
        total, _ = mcaptrack.zones(there, zones=SIDES).zones["/camera/retracks"]
    assert (total.in_worlds.tracks.low, total.in_worlds.tracks.high) == (None, None)
    assert ["no interval" in warning.message for warning in warnings] == [True]
    assert "in 9 worlds: medians\n" in done("zones", there, "-q").out
    done("retrack", there, "-q")
    total, _ = mcaptrack.zones(there).zones["/camera/retracks"]
    assert (total.in_worlds, "in_worlds" in total.to_json()) == (None, False)
