"""Colours of clothes in a run: what is stored on request, and what is said where nothing can be looked at."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.pipeline.pictures import with_descriptors
from mcaptrack.schema import APPEARANCE, TRACKS
from mcaptrack.sources.pictures import Pictures
from mcaptrack.transforms import Retrack
from tests.commands import call, done

TOPIC = "/camera/retracks/appearance"


@pytest.fixture
def there(template, tmp_path) -> Path:
    """A small log of two people after all stages."""
    return Path(shutil.copyfile(template, tmp_path / "walk.mcap"))


def test_colours_are_stored_only_on_request_and_go_with_the_next_run_without_it(there):
    with log.Log(there) as opened:
        assert TOPIC not in opened.channels
    done("retrack", there, "--store-appearance", "-q")
    with log.Log(there) as opened:
        rows = opened.frame_columns(TOPIC, APPEARANCE).rows()
        tracks = set(opened.frame_columns("/camera/retracks", TRACKS).rows()["track_id"].tolist())
        made = json.loads(opened.channel(TOPIC).metadata["mcaptrack.parameters"])
    assert made["store_appearance"] is True
    assert {(one, part) for one in tracks for part in (1, 2)} == set(rows[["track_id", "body_part"]].tolist())
    done("export", there, "-q")
    (file,) = there.with_suffix(".tables").glob("appearances/*/*.parquet")
    table = pq.read_table(file)
    assert table.num_rows == len(rows)
    assert "near 19.9" in table.schema.field("lightness_2").metadata[b"description"].decode()
    done("run", there, "--force", "--no-tables", "-q")  # as before
    with log.Log(there) as opened:
        assert TOPIC in opened.channels
    done("retrack", there, "-q")
    with log.Log(there) as opened:
        assert TOPIC not in opened.channels


@pytest.mark.parametrize(("mode", "is_written"), [("offline", True), ("online", False)])
def test_colours_belong_to_tracks_that_know_the_whole_log(there, monkeypatch, mode, is_written):
    looked_at = []
    real = Pictures.frames
    monkeypatch.setattr(Pictures, "frames", lambda *given: looked_at.append(1) or real(*given))
    result = mcaptrack.retrack(there, mode=mode, store_appearance=True, to="/camera/other")
    assert bool(looked_at) == is_written
    with log.Log(there) as opened:
        assert ("/camera/other/appearance" in opened.channels) == is_written
    assert [one.message for one in result.warnings if one.code == "option-not-used"] == (
        []
        if is_written
        else [
            "`store_appearance=` finds nothing to write: tracks that use the past alone (online) don't look at pictures"
        ]
    )


def test_a_comparison_that_the_user_asks_for_is_contradicted_where_there_are_no_pictures(there):
    done("drop", there, "/camera/video", "-q")
    asked, usual = call("retrack", there, "--appearance"), call("retrack", there)
    assert (asked.code, usual.code) == (0, 0)
    words = "--appearance changes nothing here: the log has no pictures of /camera"
    assert words in asked.err
    assert words not in usual.err
    assert (
        "--store-appearance finds nothing to write: the log has no" in call("retrack", there, "--store-appearance").err
    )


def test_a_damaged_picture_is_left_out_and_the_others_are_looked_at(there, monkeypatch):
    real = Pictures.frames

    def frames(pictures, numbers, *given):
        for number in sorted(numbers):
            if number in damaged:
                raise McaptrackError(f"picture {number} can't be decoded")
            yield from real(pictures, [number], *given)

    with log.Log(there) as opened:
        samples = list(opened.frame_columns("/camera/samples", TRACKS))
        wanted = with_descriptors(Retrack(), opened, "/camera", samples).descriptors
        times = np.unique(wanted.t_ns)
        numbers = np.searchsorted(Pictures(opened, "/camera/video").t_ns, times).tolist()
        damaged = {numbers[0], numbers[2], numbers[3], numbers[-1]}
        monkeypatch.setattr(Pictures, "frames", frames)
        with collected() as warnings:
            found = with_descriptors(Retrack(), opened, "/camera", samples).descriptors
    left = ~np.isin(wanted.t_ns, times[[0, 2, 3, -1]])
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other[left])
    (warning,) = warnings
    assert warning.code == "lost"
    assert (
        f"without 4 of {len(times)} pictures that can't be decoded, the first: picture {numbers[0]} " in warning.message
    )


def test_pictures_of_which_many_in_a_row_are_damaged_are_not_tried_to_the_end(there, monkeypatch):
    tried = []

    def frames(_, numbers):
        tried.append(numbers[0])
        raise McaptrackError("it can't be decoded")
        yield

    monkeypatch.setattr(Pictures, "frames", frames)
    monkeypatch.setattr("mcaptrack.sources.pictures._MOST_IN_A_ROW", 2)
    with log.Log(there) as opened, collected() as warnings:
        samples = opened.frame_columns("/camera/samples", TRACKS)
        assert with_descriptors(Retrack(), opened, "/camera", samples).descriptors is None
    assert len(tried) == 3
    assert [one.code for one in warnings] == ["option-not-used"]
