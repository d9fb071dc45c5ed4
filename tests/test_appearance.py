"""The colours of clothes in re-tracking: histograms, how a log calibrates them, and what they decide."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.cli.running import _lines_of_summary
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.pipeline.pictures import with_descriptors
from mcaptrack.pipeline.summary import summarise
from mcaptrack.schema import APPEARANCE, TRACKS, Frame
from mcaptrack.sources.cameras import provenance_of
from mcaptrack.sources.demo import Pedestrian, SyntheticFrame, SyntheticScene
from mcaptrack.sources.pictures import Pictures
from mcaptrack.transforms import Retrack, RetrackByConsistency, Sample
from mcaptrack.transforms.retrack.appearance import (
    BINS,
    LENGTH,
    Appearance,
    Descriptors,
    Sides,
    at_border,
    describe,
    is_clear,
    mean_shares,
)
from mcaptrack.transforms.retrack.motion_model import Tracks
from tests.commands import call, done

# Two people in coloured clothes, drawn, as samples and as what is seen of them


WIDTH, HEIGHT = 208, 117
RED, BLUE = (30, 30, 200), (200, 60, 20)
HIDDEN_S, UNTIL_S = 14.0, 15.8


def side(way: float) -> tuple[tuple[float, float, float], ...]:
    """A route to and fro on one side (-1 or 1): to the middle, and after a while in which nobody is seen, back again."""
    turns = [(0.0, 3.7), (3.0, 0.8), (6.0, 3.7), (9.0, 0.8), (12.0, 3.7), (HIDDEN_S, 0.4)]
    turns += [(UNTIL_S, 0.4), (UNTIL_S + 2.0, 3.7), (21.0, 0.8), (24.0, 3.7), (27.0, 0.8), (30.0, 3.7)]
    return tuple((seconds, way * x_m, 9.0) for seconds, x_m in turns)


#: The ids of both people, from these seconds on.
NEW_IDS = ((0.0, (1, 2)), (UNTIL_S, (11, 12)))


@cache
def _shots(*colours: tuple[int, int, int]) -> list[SyntheticFrame]:
    """Pictures, 2.5 a second, of two people in clothes of these colours, who turn back where they meet."""
    people = tuple(
        Pedestrian(n + 1, side(way), one) for n, (way, one) in enumerate(zip((-1.0, 1.0), colours, strict=True))
    )
    scene = SyntheticScene(people, 30.0, fps=5, width_px=WIDTH, height_px=HEIGHT, mast_m=4.0, tilt_deg=20.0)
    return list(scene.shots())[::2]


@cache
def two_who_turn_back(first, second, ids_since=NEW_IDS) -> tuple[tuple[Frame, ...], Descriptors]:
    """Samples of two people in clothes of these colours, and what is seen of them.

    They walk towards each other, aren't detected for 1.8 s, and walk away from each other under other ids: by their
    motion they have passed each other, but each has turned back.
    """
    frames, seen = [], []
    for number, shot in enumerate(_shots(first, second)):
        t_ns = round(shot.seconds * 1e9)
        there = not HIDDEN_S - 0.1 < shot.seconds < UNTIL_S + 0.1
        ids = np.array(shot.ids if there else [], np.int64)
        ids = np.array([own for since, own in ids_since if shot.seconds >= since][-1])[ids - 1]
        x_m, y_m = shot.places_m[: len(ids)].T
        boxes = shot.boxes[: len(ids)]
        columns = dict(zip(("x_px", "y_px", "w_px", "h_px"), boxes.T, strict=True))
        of_track = {"track_id": ids, "observed": np.ones(len(ids), bool), "source_id": np.full(len(ids), -1)}
        frames.append(Frame(t_ns, number, TRACKS.rows(**of_track, x_m=x_m, y_m=y_m, **columns)))
        clear = is_clear(boxes, WIDTH, HEIGHT)
        values = np.zeros((len(ids), LENGTH), np.uint8)
        values[clear] = describe(shot.image, boxes[clear])
        seen.append(Descriptors(np.full(len(ids), t_ns), ids, values, clear, at_border(boxes, WIDTH, HEIGHT)))
    return tuple(frames), Descriptors(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))


def identities(transform: Retrack, frames) -> set[frozenset[int]]:
    found: dict[int, set[int]] = {}
    for offline, *_ in transform(frames):
        for track, source in zip(offline.rows["track_id"].tolist(), offline.rows["source_id"].tolist(), strict=True):
            found.setdefault(track, set()).update([source] if source >= 0 else [])
    return {frozenset(ids) for ids in found.values()}


PASSED, TURNED = {frozenset({1, 12}), frozenset({2, 11})}, {frozenset({1, 11}), frozenset({2, 12})}


def test_people_in_different_clothes_are_told_apart_where_motion_is_wrong():
    frames, descriptors = two_who_turn_back(RED, BLUE)
    assert identities(Retrack(), frames) == TURNED
    assert identities(Retrack(descriptors=descriptors), frames) == TURNED
    looks = Retrack(descriptors=exchanged(descriptors, 11, 12))
    assert identities(looks, frames) == PASSED
    facts = looks.model_card().facts
    assert (facts["appearance"], facts["tracks"]) == ("used", "4")
    assert float(facts["separation"]) > 0.95
    assert identities(replace(looks, appearance=False), frames) == TURNED


def test_tracks_at_the_border_of_the_picture_are_not_joined_for_looking_alike():
    _, descriptors = two_who_turn_back(RED, BLUE)
    t_ns, track = descriptors.t_ns, descriptors.track_id
    step, nowhere = np.rint(t_ns / 4e8).astype(np.int64), np.zeros((len(t_ns), 2))
    ratios = []
    for is_there in (False, True):
        placed = descriptors._replace(at_border=np.full(len(t_ns), is_there))
        tracks = Tracks(step, track, track, np.arange(len(step)), nowhere, placed.find(t_ns, track), track)
        seen = Sides(Appearance.of(placed, tracks, 0.4), tracks)
        ratios.append(seen.of_tracks(np.array([0, 0]), np.array([2, 3])).tolist())  # 1 goes on as 11, and as 12
    (alike, different), (alike_at_border, different_at_border) = ratios
    assert alike > 1.5
    assert alike_at_border == 0
    assert different == different_at_border < -1.5


def assert_same(one: Frame, other: Frame) -> None:
    for name in one.rows.dtype.names:
        np.testing.assert_array_equal(one.rows[name], other.rows[name])


def test_people_in_the_same_clothes_are_judged_by_motion_alone():
    frames, descriptors = two_who_turn_back(BLUE, BLUE)
    looks = Retrack(descriptors=descriptors)
    for one, other in zip(looks(frames), Retrack()(frames), strict=True):
        for seen, moved in zip(one, other, strict=True):
            assert_same(seen, moved)
    facts = looks.model_card().facts
    assert facts["appearance"] == "not used"
    assert float(facts["separation"]) < 0.75


def sides(transform: Retrack, frames) -> list[list[int]]:
    """The tracks from left to right some time before and some time after they met."""
    tracks = [offline.rows for offline, *_ in transform(frames) if len(offline.rows) == 2]
    at = tracks[15], tracks[-15]
    return [rows["track_id"][np.argsort(rows["x_m"])].tolist() for rows in at]


def test_input_ids_that_were_exchanged_are_put_right_by_colours():
    """A tracker keeps ids 1 and 2 for two who turn back, but the one looks like the other then. It loses both later."""
    frames, descriptors = two_who_turn_back(RED, BLUE, ((0.0, (5, 6)), (4.8, (1, 2)), (22.8, (7, 8))))
    before, turned = sides(Retrack(), frames)
    assert turned == before
    values, is_late = descriptors.values.copy(), descriptors.t_ns > UNTIL_S * 1e9
    values[is_late] = values[is_late].reshape(-1, 2, LENGTH)[:, ::-1].reshape(-1, LENGTH)
    (left, right), passed = sides(Retrack(descriptors=descriptors._replace(values=values)), frames)
    assert passed == [right, left]


def patch(*colours: tuple[int, int, int]) -> np.ndarray:
    """A picture of 40x80 px that is divided from top to bottom into as many parts as there are colours."""
    return np.concatenate([np.full((80 // len(colours), 40, 3), colour, np.uint8) for colour in colours])


WHOLE = np.array([[0.0, 0.0, 40.0, 80.0]])


def test_a_histogram_of_one_colour_by_hand():
    """Mid-grey 119 has L* = 50.03, in 8 bits 128, and a = b = 128: in bin (128 - 20) / 215 * 7 = 3.516 of 8, and in bin
    30 / 60 * 9 = 4.5 of 10. Six histograms share 1, so a bin with a share s of its histogram is 255 * sqrt(s / 6)."""
    (found,) = describe(patch((119, 119, 119)), WHOLE)
    light, axis = np.zeros(8), np.zeros(10)
    light[3:5], axis[4:6] = (1 - 0.516, 0.516), 0.5
    wanted = np.concatenate([light, axis, axis] * 2)
    np.testing.assert_allclose(found, np.rint(255 * np.sqrt(wanted / 6)), atol=1)


def test_boxes_are_clear_by_hand():
    for boxes, wanted in (
        ([[50, 20, 20, 50]], [True]),
        ([[0, 20, 20, 50]], [False]),  # cut off by the border
        ([[50, 31, 20, 50], [150, 20, 3, 50], [150, 20, 20, 7]], [False] * 3),  # so is this; two are too small
        ([[50, 20, 20, 50], [57, 20, 20, 50]], [False, False]),  # 65 % of each
        ([[50, 20, 20, 50], [64, 20, 20, 50]], [True, True]),  # 30 %
        ([[50, 20, 20, 50], [50, 20, 10, 25]], [True, False]),  # a quarter of the first, all of the second
        (np.empty((0, 4)), []),
    ):
        assert is_clear(np.array(boxes, float), 200, 80).tolist() == wanted


def test_boxes_at_a_border_by_hand():
    boxes = [[15, 20, 20, 30], [25, 20, 20, 30], [170, 20, 20, 30], [100, 5, 20, 30], [100, 45, 20, 30]]
    assert at_border(np.array(boxes, float), 200, 80).tolist() == [True, False, True, True, True]


def test_samples_find_their_descriptors():
    ids = [(t, one) for t in (10, 20, 40) for one in (3, 7, 9) if (t, one) != (20, 7)]
    t_ns, track_id = np.array(ids).T
    nothing = np.zeros((len(ids), LENGTH), np.uint8), np.ones(len(ids), bool), np.zeros(len(ids), bool)
    descriptors = Descriptors(t_ns, track_id, *nothing)
    wanted = [(t, one) for t in (0, 10, 20, 30, 40, 50) for one in (2, 3, 7, 8, 9, 10)]
    found = descriptors.find(*np.array(wanted).T).tolist()
    assert found == [ids.index(one) if one in ids else -1 for one in wanted]


@pytest.fixture(scope="module")
def log_of_run(finished):
    with log.Log(finished) as opened:
        yield opened


def test_a_run_looks_at_every_clear_box_and_says_what_it_found(log_of_run):
    frames = log_of_run.frame_columns("/camera/samples", TRACKS)
    reports = []
    made = with_descriptors(Retrack(), log_of_run, "/camera", frames, lambda *one: reports.append(one))
    seen = made.descriptors
    observed = [(f.t_ns, one) for f in frames for one in sorted(f.rows["track_id"][f.rows["observed"]].tolist())]
    assert list(zip(seen.t_ns.tolist(), seen.track_id.tolist(), strict=True)) == observed
    assert seen.values[seen.is_clear].any(axis=1).all()
    assert not seen.values[~seen.is_clear].any()
    assert reports == [("appearance", n + 1, len(reports)) for n in range(len(frames))]
    list(made(frames))
    provenance = provenance_of(log_of_run, "/camera/retracks")
    assert provenance.model == made.model_card().facts
    looks = summarise(log_of_run, "/camera").appearance
    assert asdict(looks) == {
        "used": provenance.model["appearance"] == "used",
        "separation": float(provenance.model["separation"]),
        "tracks": int(provenance.model["tracks"]),
    }


def test_samples_without_a_picture_take_none_of_the_others_away(log_of_run, monkeypatch):
    monkeypatch.setattr("mcaptrack.pipeline.pictures._NEAR_NS", 1_000_000)
    frames = list(log_of_run.frame_columns("/camera/samples", TRACKS))[:12]

    def seen(given):
        return with_descriptors(Retrack(), log_of_run, "/camera", given).descriptors

    def unseen(part):
        return [frame._replace(t_ns=frame.t_ns + 5_000_000) for frame in part]

    wanted = seen(frames[:3] + frames[8:10])
    assert len(np.unique(wanted.t_ns)) == 5
    found = seen(frames[:3] + unseen(frames[3:8]) + frames[8:10] + unseen(frames[10:]))  # a hole, and no end
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def test_too_few_people_to_compare_are_said(log_of_run, monkeypatch):
    frames = [frame._replace(rows=frame.rows[:1]) for frame in log_of_run.frame_columns("/camera/samples", TRACKS)][:8]
    made = with_descriptors(Retrack(), log_of_run, "/camera", frames)
    assert made.model_card().facts == {}  # before a run
    list(made(frames))
    assert made.model_card().facts == {"appearance": "not used"}
    provenance = replace(provenance_of(log_of_run, "/camera/retracks"), model=made.model_card().facts)
    monkeypatch.setattr("mcaptrack.pipeline.summary.provenance_of", lambda *_: provenance)
    summary = summarise(log_of_run, "/camera")
    assert asdict(summary.appearance) == {"used": False, "separation": None, "tracks": 0}
    (words,) = [words for name, words in _lines_of_summary(summary) if name == "colours"]
    assert words.startswith("not compared: too few people")


def test_what_does_not_compare_colours_has_none(log_of_run):
    frames = log_of_run.frame_columns("/camera/samples", TRACKS)
    for transform in (Retrack(appearance=False), Retrack(poor_scale=True, link_s=0), RetrackByConsistency(), Sample()):
        assert with_descriptors(transform, log_of_run, "/camera", frames) is transform
    in_metres = [frame._replace(rows=frame.rows.copy()) for frame in frames]
    for frame in in_metres:
        frame.rows["x_px"] = np.nan
    for given in (in_metres, [frame._replace(t_ns=frame.t_ns + 10**12) for frame in frames]):
        assert with_descriptors(Retrack(), log_of_run, "/camera", given).descriptors is None
    assert Retrack().model_card().facts == {}


def test_pictures_that_cannot_be_decoded_are_a_warning(log_of_run, monkeypatch):
    def damaged(*_):
        raise McaptrackError("the picture can't be decoded")

    monkeypatch.setattr(Pictures, "frames", damaged)
    frames = log_of_run.frame_columns("/camera/samples", TRACKS)
    with collected() as warnings:
        assert with_descriptors(Retrack(), log_of_run, "/camera", frames).descriptors is None
    assert [(one.code, "can't be decoded" in one.message) for one in warnings] == [("option-not-used", True)]


def stored(transform: Retrack, frames) -> list[tuple[int, np.ndarray]]:
    """The times and rows of what is stored of the appearance of tracks, where there are any."""
    return [(looks.t_ns, looks.rows) for *_, looks in transform(frames) if len(looks.rows)]


def test_stored_colours_are_the_mean_of_the_clear_pictures_of_each_track():
    """Of track 1 in red, which goes on as 11, and of track 2 in blue, which goes on as 12."""
    frames, descriptors = two_who_turn_back(RED, BLUE)
    assert {len(outputs) for outputs in Retrack(descriptors=descriptors)(frames)} == {4}
    found = stored(Retrack(descriptors=descriptors, store_appearance=True), frames)
    rows = np.concatenate([rows for _, rows in found])
    assert sorted(rows[["track_id", "body_part"]].tolist()) == [(1, 1), (1, 2), (2, 1), (2, 2)]
    bins = [name for name in rows.dtype.names if name.rstrip("0123456789").endswith("_")]
    assert len(bins) == LENGTH / 2
    for track, ids in ((1, (1, 11)), (2, (2, 12))):
        mine = np.isin(descriptors.track_id, ids) & descriptors.is_clear
        t_ns = descriptors.t_ns[mine]
        wanted = np.square(descriptors.values[mine] / 255.0).mean(axis=0).reshape(2, -1) * 6  # six histograms share 1
        (at,) = {t for t, some in found if track in some["track_id"]}
        assert at == t_ns.max()
        for part, shares in enumerate(wanted, 1):
            (row,) = rows[(rows["track_id"] == track) & (rows["body_part"] == part)]
            assert row["pictures"] == mine.sum()
            assert row["duration_s"] == pytest.approx((t_ns.max() - t_ns.min()) / 1e9)
            np.testing.assert_allclose([row[name] for name in bins], shares, atol=0.01)
            for axis in ("lightness", "green_red", "blue_yellow"):
                assert sum(row[name] for name in bins if name.startswith(axis)) == pytest.approx(1)


def test_the_bins_of_stored_colours_are_where_the_schema_says():
    """The histogram of a picture of the colour of each bin's centre, by OpenCV, is that bin alone, but for rounding."""
    import cv2

    for column in APPEARANCE.columns[4:]:
        axis, centre = column.name.rsplit("_", 1)[0], float(re.search(r"near (-?[\d.]+)", column.doc)[1])
        at = ["lightness", "green_red", "blue_yellow"].index(axis)
        lab = np.array([60.0, 0.0, 0.0], np.float32)
        lab[at] = centre
        colour = cv2.cvtColor(lab.reshape(1, 1, 3), cv2.COLOR_LAB2BGR).reshape(3) * 255
        values = describe(patch(tuple(np.clip(np.rint(colour), 0, 255).astype(int).tolist())), WHOLE)
        (upper, legs) = mean_shares(values, np.zeros(1, int), 1)[0]
        for part in (upper, legs):
            shares = dict(zip(BINS, part.tolist(), strict=True))
            own = {name: share for name, share in shares.items() if name.startswith(axis)}
            assert max(own, key=own.get) == column.name, own
            assert own[column.name] > 0.7


def exchanged(descriptors: Descriptors, one: int, other: int) -> Descriptors:
    """The same, but that two tracks, which are seen at the same times, look like each other."""
    values = descriptors.values.copy()
    of_one, of_other = (descriptors.track_id == track for track in (one, other))
    values[of_one], values[of_other] = descriptors.values[of_other], descriptors.values[of_one]
    return descriptors._replace(values=values)


IN_PICTURES = Retrack(poor_scale=True)


@pytest.mark.parametrize(("second", "least", "tell_apart"), [(BLUE, 0.6, True), (RED, 0.6, False), (BLUE, 1.1, False)])
def test_links_in_the_picture_look_at_colours_where_these_tell_people_apart(monkeypatch, second, least, tell_apart):
    """After 2.4 s motion alone is not enough for a link."""
    monkeypatch.setattr("mcaptrack.transforms.retrack.appearance.LEAST_SEPARATION", least)
    frames, descriptors = two_who_turn_back(RED, second)
    linked, alone = {frozenset({1, 11}), frozenset({2, 12})}, {frozenset({one}) for one in (1, 2, 11, 12)}
    for looks, wanted in ((None, alone), (descriptors, linked), (exchanged(descriptors, 11, 12), alone)):
        found: dict[int, set[int]] = {}
        for offline, *_ in replace(IN_PICTURES, descriptors=looks)(frames):
            for one, source in offline.rows[["track_id", "source_id"]].tolist():
                found.setdefault(one, {one}).update([source] if source >= 0 else [])
        assert set(map(frozenset, found.values())) == (wanted if tell_apart else alone)


def test_stored_colours_of_tracks_that_are_linked_in_the_picture_have_their_ids():
    frames, descriptors = two_who_turn_back(RED, BLUE)
    looks = replace(IN_PICTURES, descriptors=descriptors, store_appearance=True)
    rows = np.concatenate([rows for _, rows in stored(looks, frames)])
    clear = descriptors.track_id[descriptors.is_clear]
    both = [int(np.isin(clear, ids).sum()) for ids in ((1, 11), (2, 12))]
    assert rows[["track_id", "pictures"]].tolist() == [(1, both[0])] * 2 + [(2, both[1])] * 2
    assert looks.model_card().facts["appearance"] == "used"
    unlinked = stored(replace(looks, link_s=0.0), frames)
    assert {one for _, rows in unlinked for one in rows["track_id"].tolist()} == {1, 2, 11, 12}


# Colours of clothes in a run: what is stored on request, and what is said where nothing can be looked at


TOPIC = "/camera/retracks/appearance"


@pytest.fixture
def there(template, tmp_path) -> Path:
    return Path(shutil.copyfile(template, tmp_path / "walk.mcap"))


def test_colours_are_stored_only_on_request_and_go_with_the_next_run_without_it(there):
    with log.Log(there) as opened:
        assert TOPIC not in opened.channels
    done("retrack", there, "--set", "store_appearance=true", "-q")
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
        "--set store_appearance finds nothing to write: the log has no"
        in call("retrack", there, "--set", "store_appearance=true").err
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
