"""Zones and lines: counts against a slow implementation that walks along each person, and laws."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, notices, testing
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.world_tracks import WIDER, WIDER_MEAN
from mcaptrack.extensions.zones import api
from mcaptrack.extensions.zones.geojson import parse_zones, read_zones, zones_from_json, zones_to_json
from mcaptrack.extensions.zones.section import section
from mcaptrack.extensions.zones.shapes import Paths, Shape, crossings, visits
from mcaptrack.extensions.zones.visits import (
    ZoneOptions,
    find_zone_events,
    ground_height_m,
    place_zone,
    positions_of,
    zone_totals,
)
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS, Frame
from tests.commands import call, done
from tests.extension_cases import needs
from tests.extensions.zones.shapes import HOLED, LINE, SQUARE, ZONES, collection, feature
from tests.tiers import thorough
from tests.worlds import noisy_tracks, ns, walk, write_channels

# A slow implementation, one person at a time


def is_inside(rings: list, x: float, y: float) -> bool:
    """By the angles that the edges are seen under."""
    turns = 0
    for ring in rings:
        total = 0.0
        for (ax, ay), (bx, by) in zip(ring, [*ring[1:], ring[0]], strict=True):
            one, two = np.arctan2(ay - y, ax - x), np.arctan2(by - y, bx - x)
            total += (two - one + np.pi) % (2 * np.pi) - np.pi
        turns += abs(round(total / (2 * np.pi)))
    return turns % 2 == 1


def distance(points: list, x: float, y: float, is_closed: bool) -> float:
    best = np.inf
    ends, p = np.array([*points, *(points[:1] if is_closed else [])], float), np.array([x, y])
    for a, b in pairwise(ends):
        share = 0.0 if (a == b).all() else np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        best = min(best, float(np.linalg.norm(p - a - share * (b - a))))
    return best


def slow_visits(rings: list, path: list[tuple[int, float, float]], margin: float, gap_ns: int) -> list[tuple]:
    """Visits of one person as (first time, time until, began inside, ended inside); ``path`` has time, x and y."""
    rings = [ring[:-1] for ring in rings]
    pieces, out = [[path[0]]], []
    for one in path[1:]:
        pieces.append([one]) if one[0] - pieces[-1][-1][0] > gap_ns else pieces[-1].append(one)
    for piece in pieces:
        sides = [is_inside(rings, x, y) for _, x, y in piece]
        deep = [min(distance(ring, x, y, True) for ring in rings) for _, x, y in piece]
        state, crossed = sides[0], 0
        entered = (0, True) if state else None
        for number in range(1, len(piece)):
            if sides[number] != sides[number - 1]:
                crossed = number
            is_sure = deep[number] > margin or number == len(piece) - 1
            if is_sure and sides[number] != state:
                state = sides[number]
                if state:
                    entered = (crossed, False)
                else:
                    out.append((piece[entered[0]][0], piece[crossed][0], entered[1], False))
                    entered = None
        if entered:
            out.append((piece[entered[0]][0], piece[-1][0], entered[1], True))
    return out


def slow_crossings(points: list, path: list[tuple[int, float, float]], margin: float, gap_ns: int) -> list[tuple]:
    """Crossings of one person as (time, forward)."""

    def side(a, b, x, y):
        return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])

    out, pending = [], []
    for before, now in pairwise(path):
        if now[0] - before[0] > gap_ns:
            out += settle(pending)
            pending = []
            continue
        for a, b in pairwise(points):
            was, is_left = side(a, b, *before[1:]) > 0, side(a, b, *now[1:]) > 0
            apart = side(before[1:], now[1:], *a) > 0, side(before[1:], now[1:], *b) > 0
            if was != is_left and apart[0] != apart[1]:
                pending.append((now[0], was))
        if distance(points, *now[1:], False) > margin:
            out += settle(pending)
            pending = []
    return out + settle(pending)


def settle(pending: list[tuple]) -> list[tuple]:
    net = sum(1 if forward else -1 for _, forward in pending)
    return [[one for one in pending if one[1] == (net > 0)][-1]] if net else []


def paths_of(frames: list[Frame]) -> dict[int, list[tuple[int, float, float]]]:
    out: dict[int, list[tuple[int, float, float]]] = {}
    for frame in frames:
        for row in frame.rows:
            if np.isfinite(row["x_m"]):
                out.setdefault(int(row["track_id"]), []).append((frame.t_ns, float(row["x_m"]), float(row["y_m"])))
    return out


def expected(frames: list[Frame], features: list[dict], margin_m: float, gap_s: float = 4.0) -> tuple[set, set]:
    """All visits and crossings, by number of the zone and track."""
    visited, crossed = set(), set()
    for number, one in enumerate(features, start=1):
        rings = one["geometry"]["coordinates"]
        for track, path in paths_of(frames).items():
            if one["geometry"]["type"] == "Polygon":
                edges = [np.hypot(*(np.diff(np.array(ring, float), axis=0)).T).sum() for ring in rings]
                areas = [abs(cv2.contourArea(np.array(ring[:-1], np.float32))) for ring in rings]
                margin = min(margin_m, (areas[0] - sum(areas[1:])) / sum(edges) / 2)
                visited |= {(number, track, *some) for some in slow_visits(rings, path, margin, ns(gap_s))}
            else:
                crossed |= {(number, track, *some) for some in slow_crossings(rings, path, margin_m, ns(gap_s))}
    return visited, crossed


def told(visited: list[Frame], crossed: list[Frame]) -> tuple[set, set]:
    """The same, of rows."""
    return (
        {
            (int(row["zone_id"]), int(row["track_id"]), frame.t_ns, frame.t_ns + round(float(row["dwell_s"]) * 1e9),
             bool(row["began_inside"]), bool(row["ended_inside"]))
            for frame in visited for row in frame.rows
        },
        {
            (int(row["zone_id"]), int(row["track_id"]), frame.t_ns, bool(row["forward"]))
            for frame in crossed for row in frame.rows
        },
    )  # fmt: skip


def count(frames: list[Frame], content: dict, margin_m: float = 0.25, gap_s: float = 4.0):
    """Zones of rows in metres, with the totals."""
    zones = parse_zones(content)
    placed = [place_zone(zone, ()) for zone in zones]
    found = find_zone_events(frames, positions_of(frames, (), None), placed, ZoneOptions(margin_m, gap_s), "tracks")
    return found, zone_totals(zones, found.visits, found.crossings, found.counts)


def wandering(seed: int, people: int = 6, ticks: int = 120, jitter: float = 0.3) -> list[Frame]:
    """Random walks about the zones, with jitter and gaps."""
    chance = np.random.default_rng(seed)
    at = np.cumsum(chance.normal(0, 0.4, (ticks, people, 2)), axis=0) + chance.uniform(-3, 3, (people, 2)) + [0, 11]
    at += chance.normal(0, jitter, at.shape)
    seen = chance.random((ticks, people)) < 0.9
    return walk(lambda t: {p + 1: tuple(at[t, p]) for p in range(people) if seen[t, p]}, ticks, 5)


class TestAgainstASlowImplementation:
    @pytest.mark.parametrize("margin", [0.0, 0.25])
    def test_random_walks(self, margin):
        frames = wandering(1)
        found, _ = count(frames, ZONES, margin, gap_s=0.5)
        wanted = expected(frames, ZONES["features"], margin, 0.5)
        assert told(found.visits, found.crossings) == wanted
        assert min(map(len, wanted)) > 3


class TestGeometry:
    def test_depth_is_the_distance_that_opencv_has(self):
        chance = np.random.default_rng(2)
        for corners in (3, 5, 12):
            angle = np.sort(chance.uniform(0, 2 * np.pi, corners))
            ring = (np.stack([np.cos(angle), np.sin(angle)], 1) * chance.uniform(1, 9, (corners, 1))).astype(np.float32)
            points = chance.uniform(-10, 10, (200, 2)).astype(np.float32)
            wanted = [cv2.pointPolygonTest(ring, tuple(map(float, one)), measureDist=True) for one in points]
            found = Shape(((ring.astype(float),),)).depth(points.astype(float))
            np.testing.assert_allclose(found, wanted, atol=1e-4)

    def test_in_a_narrow_zone_the_margin_is_half_the_area_by_the_circumference(self):
        # 0.4 m wide and 3.6 m long: 1.44 / 8 / 2 = 0.09, so that 0.1 m inside is a visit and 0.05 m is none
        content = collection(feature("strip", "Polygon", [[[0, 0], [0.4, 0], [0.4, 3.6], [0, 3.6], [0, 0]]]))
        for inside, wanted in ((0.1, 1), (0.05, 0)):
            at = [-1.0, inside, -1.0]
            (strip,) = count(walk(lambda tick, at=at: {1: (at[tick], 2.0)}, 3, 1), content)[1]
            assert strip.visits == wanted

    def test_paths_through_the_corners_of_a_line_count_once(self):
        line = Shape(((np.array([[0.0, 0], [1, 0], [2, 0], [2, 2]]),),), is_line=True)
        for x in (0.5, 1.0, 1.5):
            points = np.array([[x, -1.0], [x, 0.0], [x, 1.0]])
            paths = Paths.of(points, np.arange(3), np.zeros(3, np.int64), 10)
            assert [part.tolist() for part in crossings(paths, line, 0.0)] == [[1], [-1]]

    def test_nothing_in_gives_nothing_out(self):
        empty = [Frame(0, 0, TRACKS.empty())]
        found, totals = count(empty, ZONES)
        assert [one.tracks for one in totals] == [0, 0, 0]
        assert found.counts[0].rows["inside"].tolist() == [0, 0, 0]
        assert totals[0].mean_dwell_s is None
        paths = Paths.of(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0, np.int64), 1)
        assert [len(one) for one in visits(paths, np.zeros(0), 0.1)] == [0, 0, 0, 0]


class TestPixels:
    PLANE = GroundPlane((0.05, 0.0, -8.0, 0.0, -0.05, 10.0, 0.0, 0.0, 1.0), 320, 200)
    BOX = [[100, 50], [200, 50], [200, 150], [100, 150]]

    def test_forward_is_what_a_person_sees_in_the_picture_and_on_the_ground(self):
        feet = [[140.0, 100.0], [160.0, 100.0]]  # to the right of a line upwards in the picture, seen from its start
        line = collection(feature("up", "LineString", [[150, 200], [150, 0]]), units="pixels")
        ways = []
        mirrored = GroundPlane((0.05, 0.0, -8.0, 0.0, 0.05, 1.0, 0.0, 0.0, 1.0), 320, 200)
        for planes in ((), [(0, self.PLANE)], [(0, mirrored)]):
            rows = [
                TRACKS.rows(track_id=[1], x_px=[x - 5], y_px=[y - 30], w_px=[10], h_px=[30], observed=[True],
                            source_id=[-1])
                for x, y in feet
            ]  # fmt: skip
            frames = [Frame(ns(n), n, row) for n, row in enumerate(rows)]
            placed = [place_zone(zone, planes) for zone in parse_zones(line)]
            found = find_zone_events(frames, positions_of(frames, planes, None), placed, ZoneOptions(0.0), "tracks")
            ways.append([bool(way) for frame in found.crossings for way in frame.rows["forward"]])
        assert ways == [[True]] * 3

    def test_a_zone_above_the_horizon_is_refused(self):
        plane = GroundPlane((0.05, 0.0, -8.0, 0.0, -0.05, 10.0, 0.0, 0.01, -0.9), 320, 200)
        (zone,) = parse_zones(collection(feature("sky", "Polygon", [self.BOX]), units="px"))
        with pytest.raises(McaptrackError, match=r"^zone sky reaches above the horizon, at \(100, 50\) px"):
            place_zone(zone, [(0, plane)])


BOWTIE = [[0, 0], [2, 2], [2, 0], [0, 2], [0, 0]]
WRONG = {
    "crosses or touches itself at \\(1, 1\\)": collection(feature("a", "Polygon", [BOWTIE])),
    "touches itself": collection(feature("a", "Polygon", [[[0, 0], [4, 0], [4, 4], [2, 0], [0, 4], [0, 0]]])),
    'add "units": "metres"': collection(feature("a", "Polygon", [SQUARE]), units=None) | {"units": "degrees"},
    "has no units": {k: v for k, v in ZONES.items() if k != "units"},
    "are these degrees": collection(feature("a", "Polygon", [[[13.4, 52.5], [13.40001, 52.5], [13.4, 52.50001]]])),
    "the coordinate nan": collection(feature("a", "Polygon", [[[0, 0], [1, float("nan")], [2, 0]]])),
    "the coordinate inf": collection(feature("a", "LineString", [[0, 0], [1, float("inf")]])),
    "the coordinate 'x'": collection(feature("a", "LineString", [[0, "x"], [1, 1]])),
    "no zones": collection(),
    "zones 1 and 2 are both called a": collection(feature("a", "Polygon", [SQUARE]), feature("a", "LineString", LINE)),
    "has 2 different points": collection(feature("a", "Polygon", [[[0, 0], [1, 1], [0, 0]]])),
    "not nested as its type needs": collection(feature("a", "Polygon", SQUARE[0][0])),
    "where a point of two numbers is needed": collection(feature("a", "Polygon", SQUARE)),
    "not GeoJSON": {"zones": []},
    "a list without a type": [1, 2],
    "is a 'Circle'": collection(feature("a", "Circle", [0, 0])),
    "feature 1 is a number": collection() | {"features": [5]},
    "needs a list of features": {"type": "FeatureCollection", "features": 3},
    "more than 2000 points": collection(feature("a", "LineString", [[n, n % 2] for n in range(2001)])),
    "has a hole outside of its outline, at \\(9, 9\\)": collection(
        feature("a", "Polygon", [SQUARE, [[9, 9], [8, 9], [8, 8], [9, 9]]])
    ),
    "has a hole outside of its outline, at \\(-2, 9\\)": collection(feature("a", "Polygon", [HOLED[1], SQUARE])),
    "has a hole inside another one": collection(
        feature("a", "Polygon", [*HOLED, [[0, 10.5], [0.5, 10.5], [0.5, 11], [0, 10.5]]])
    ),
    "a list as its name": collection(feature(["a"], "Polygon", [SQUARE])),
    "classes that are no list of names": collection(feature("a", "Polygon", [SQUARE], classes=["car", 3])),
    "1 to 100 printable characters": collection(feature("a\nb", "Polygon", [SQUARE])),
    "not valid JSON": "{",
    "is not a text file": b"\xff\xfe\x00",
    "of GeoJSON are read: give it in parts": b" " * (8 * 2**20 + 1),
}


class TestClasses:
    """A car drives through the square beside a person and a child; classes by number, and their names."""

    NAMES = {1: "pedestrian", 2: "car", 4: "person"}

    def tracks(self) -> list[Frame]:
        frames = walk(lambda tick: {n: (tick - 4.0, 10.0 + n / 2) for n in (1, 2, 4)}, 9, 1)
        for frame in frames:
            frame.rows["class_id"] = frame.rows["track_id"]
            frame.rows["z_m"], frame.rows["height_m"] = -20.0 + frame.rows["x_m"], 2.0
        return frames

    @pytest.mark.parametrize(
        ("classes", "wanted"), [(None, [1, 2, 4]), ("Car", [2]), (["person"], [1, 4]), (["car", "person"], [1, 2, 4])]
    )
    def test_a_zone_counts_the_classes_that_it_names(self, classes, wanted):
        frames = self.tracks()
        zones = parse_zones(
            collection(feature("a", "Polygon", [SQUARE]), feature("b", "LineString", LINE), classes=classes)
        )
        found = positions_of(frames, (), None, self.NAMES)
        events = find_zone_events(frames, found, [place_zone(one, ()) for one in zones], ZoneOptions(), "tracks")
        for some in (events.visits, events.crossings):
            assert sorted(int(row["track_id"]) for frame in some for row in frame.rows) == wanted
        assert not events.notes
        assert zones_from_json(json.loads(json.dumps(zones_to_json(zones)))) == zones

    def test_a_class_that_no_track_has_is_said(self):
        frames = self.tracks()
        (zone,) = parse_zones(collection(feature("a", "Polygon", [SQUARE], classes=["bus"])))
        found = positions_of(frames, (), None, self.NAMES)
        events = find_zone_events(frames, found, [place_zone(zone, ())], ZoneOptions(), "/t")
        assert events.notes == ["zone a counts bus; /t has none of these, but pedestrian, car, person"]

    def test_the_ground_is_where_objects_stand(self):
        found = positions_of(self.tracks(), (), None)
        (zone,) = parse_zones(collection(feature("a", "Polygon", [[[1, 9], [3, 9], [3, 14], [1, 14]]])))
        assert ground_height_m(found, zone.shape()) == -20.0 + 2.0 - 1.0
        assert ground_height_m(positions_of(wandering(1), (), None), zone.shape()) == 0.0


class TestFiles:
    @pytest.mark.parametrize("words", WRONG)
    def test_a_file_that_cannot_be_read_is_one_line(self, tmp_path, words):
        path, content = tmp_path / "zones.json", WRONG[words]
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            path.write_text(content if isinstance(content, str) else json.dumps(content))
        words = "has units 'degrees'" if words.startswith("add") else words
        with pytest.raises(McaptrackError, match=words) as error:
            read_zones(path)
        assert str(error.value).startswith(str(path))
        assert len(str(error.value).splitlines()) == 1
        assert len(str(error.value)) < 300 + len(str(path))

    def test_what_a_provenance_has_is_read_back(self):
        content = collection(
            feature("square", "Polygon", [SQUARE]), feature("ring", "Polygon", HOLED), feature("gate", "LineString", LINE),
            feature("two", "MultiPolygon", [[SQUARE], [[[20, 20], [21, 20], [21, 21], [20, 20]]]], units="px", camera="/a"),
        )  # fmt: skip
        zones = parse_zones(content)
        assert zones_from_json(json.loads(json.dumps(zones_to_json(zones)))) == zones
        assert [(zone.units, zone.camera, len(zone.parts)) for zone in zones[2:]] == [
            ("metres", "", 1),
            ("pixels", "a", 2),
        ]

    def test_zones_have_a_limit(self):
        squares = [feature(None, "Polygon", [SQUARE])] * 501
        assert len(parse_zones(collection(*squares[1:]))) == 500
        with pytest.raises(McaptrackError, match="it holds 501 features; at most 500 zones and lines are counted"):
            parse_zones(collection(*squares))

    def test_made_names_are_not_those_of_others_and_a_reference_system_is_said(self):
        content = collection(feature("zone 2", "Polygon", [SQUARE]), feature(None, "Polygon", [SQUARE]), crs={})
        with notices.collected() as said:
            assert [zone.name for zone in parse_zones(content)] == ["zone 2", "zone 2 (2)"]
        assert ['"crs" is not read' in one.message for one in said] == [True]

    def test_points_are_left_out_with_a_warning_and_names_are_made(self):
        content = collection(feature("tree", "Point", [1, 1]), feature(None, "Polygon", [SQUARE]))
        with notices.collected() as said:
            (zone,) = parse_zones(content)
        assert zone.name == "zone 1"
        assert [one.message for one in said] == ["zone tree is left out: it is a Point, not a Polygon or LineString"]


class TestRun:
    @pytest.fixture
    def place(self, finished, tmp_path) -> Path:
        (tmp_path / "zones.geojson").write_text(json.dumps(ZONES))
        mcaptrack.zones(finished, zones=ZONES, output=tmp_path / "a.mcap")
        return tmp_path

    def test_later_runs_count_again_what_has_changed(self, place):
        path = place / "a.mcap"
        assert mcaptrack.run(path, tables=False).stages == ()
        mcaptrack.drop(path, "/camera/tracks/zones/visits")
        assert mcaptrack.run(path, tables=False).stages == ("zones",)
        before = mcaptrack.zones(path)
        assert before.stages == ()
        made = mcaptrack.sample(path, rate_hz=5.0)
        assert not any("/tracks/zones" in topic for topic in made.stale)
        result = mcaptrack.run(path, tables=False)
        assert result.stages[-2:] == ("zones", "views")
        assert all("/retracks/full/zones/" in topic for topic in result.channels if "/zones/" in topic)
        assert result.zones["/camera/truth"] == before.zones["/camera/truth"]
        assert mcaptrack.run(path, tables=False).is_up_to_date

    def test_the_finisher_and_the_section_obey_their_laws(self, place, finished):
        testing.check_finisher(api.count, finished, name="zones", zones=ZONES)
        testing.check_report_section(section, place / "a.mcap")

    @thorough
    def test_other_zones_replace_those_of_before(self, place):
        path = place / "a.mcap"
        one = mcaptrack.zones(path, zones={"type": "LineString", "coordinates": LINE, "units": "m"})
        assert [[total.zone for total in some] for some in one.zones.values()] == [["line 1"]] * 3
        assert mcaptrack.zones(path, margin_m=0.5).stages == ("zones",)
        with log.read(path) as opened:
            metadata = opened.channel("/camera/truth/zones/visits").metadata
        assert json.loads(metadata["mcaptrack.zones"]) == {"1": "line 1"}
        assert json.loads(metadata["mcaptrack.parameters"])["margin_m"] == 0.5

    def test_mistakes_are_one_line(self, finished, tmp_path):
        (tmp_path / "other.json").write_text(json.dumps(collection(feature("a", "Polygon", [SQUARE], camera="front"))))
        for words, why in (
            (("zones", finished), "was not counted yet; give a file of GeoJSON with --zones"),
            (("zones", finished, "--zones", tmp_path / "no.json"), "does not exist"),
            (
                ("zones", finished, "--zones", tmp_path / "other.json"),
                "all zones are of front, not of camera; --camera",
            ),
        ):
            outcome = call(*words, "-o", tmp_path / "b.mcap")
            assert (outcome.code, outcome.out) == (1, "")
            assert why in outcome.err
            assert len(outcome.err.splitlines()) == 1

    def test_a_zone_that_nobody_could_reach_is_named(self, finished, tmp_path):
        content = collection(feature("moon", "Polygon", [[[900, 900], [901, 900], [901, 901]]]))
        result = mcaptrack.zones(finished, zones=content, output=tmp_path / "b.mcap")
        assert {one.code for one in result.warnings} == {"not-compared"}
        assert "zone moon, (900, 900) to (901, 901) m, is beyond all of /camera/tracks" in result.warnings[0].message


def test_labels_of_zones_in_one_place_stand_below_each_other(finished, tmp_path):
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

    box = [[10, 20], [50, 20], [50, 40], [10, 20]]
    features = [feature(str(n), "Polygon", [box]) for n in range(3)] + [
        feature("far", "Polygon", [[[10, 60], [50, 60], [50, 80]]])
    ]
    mcaptrack.zones(finished, zones=collection(*features, units="px"), output=tmp_path / "a.mcap")
    with log.read(tmp_path / "a.mcap") as opened:
        drawn = ImageAnnotations.FromString(next(iter(opened.messages("/camera/tracks/zones/view/image"))).payload)
    texts = sorted((one.text[:3], one.position.x, one.position.y) for one in drawn.texts)
    assert len({x for _, x, _ in texts[:3]}) == 1
    assert np.diff([y for *_, y in texts[:3]]).tolist() == [15.0, 15.0]
    assert texts[3][2] > texts[2][2]


class TestDrawing:
    """The page itself was looked at in a browser; here are the numbers that it begins with."""

    @staticmethod
    def data_of(page: Path) -> dict:
        text = page.read_text()
        assert "Content-Security-Policy" in text
        assert not re.search(r"(src|href)=\"(?!data:)", text)
        return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])

    def test_a_page_in_pixels_begins_with_the_zones_of_the_log(self, finished, tmp_path):
        box = [[10, 100], [60, 100], [60, 160], [10, 100]]
        content = collection(
            feature("</script>", "Polygon", [box], classes="person"),
            feature("b", "LineString", [[5, 105], [9, 159]]),
            units="px",
        )
        mcaptrack.zones(finished, zones=content, output=tmp_path / "a.mcap")
        said = done("zones", "draw", tmp_path / "a.mcap").err
        assert said.startswith(f"{tmp_path / 'a.zones.html'}: open it in a browser")
        data = self.data_of(tmp_path / "a.zones.html")
        assert (data["units"], data["scale"], data["x0"], data["y0"], data["up"]) == ("pixels", 1.0, 0.0, 0.0, 1)
        assert [(one["name"], one["line"], one["points"]) for one in data["zones"]] == [
            ("</script>", False, [[10, 100], [60, 100], [60, 160]]), ("b", True, [[5, 105], [9, 159]])
        ]  # fmt: skip
        assert [one.get("classes") for one in data["zones"]] == [["person"], None]
        again = call("zones", "draw", tmp_path / "a.mcap")
        assert (again.code, len(again.err.splitlines())) == (1, 1)
        done("zones", "draw", tmp_path / "a.mcap", "--force", "-q")

    def test_zones_that_the_page_cannot_change_are_named_and_not_in_its_file(self, finished, tmp_path):
        outline, hole = [[0, 0], [9, 0], [9, 9], [0, 9]], [[4, 4], [5, 4], [5, 5]]
        content = collection(feature("ring", "Polygon", [outline, hole]), feature("b", "LineString", [[0, 0], [9, 9]]))
        content["features"].append(feature("seen", "LineString", [[5, 105], [9, 159]], units="px"))
        mcaptrack.zones(finished, zones=content, output=tmp_path / "a.mcap")
        outcome = call("zones", "draw", tmp_path / "a.mcap")
        assert outcome.err.splitlines()[0].endswith("they are not in the file that it downloads: ring, b")
        page = tmp_path / "a.zones.html"
        assert [one["name"] for one in self.data_of(page)["zones"]] == ["seen"]
        assert "not in the file: ring, b</p>" in page.read_text()

    def test_without_pictures_it_is_the_ground_in_metres_with_the_second_axis_upwards(self, finished, tmp_path):
        mcaptrack.drop(finished, "/camera/video", output=tmp_path / "a.mcap")
        data = self.data_of(mcaptrack.draw_zones(tmp_path / "a.mcap", output=tmp_path / "b.html"))
        seen = np.array(data["seen"])
        assert (data["units"], data["up"], len(seen) > 10) == ("metres", -1, True)
        across = (seen[:, 0] - data["x0"]) * data["scale"]
        down = (seen[:, 1] - data["y0"]) * data["scale"] * data["up"]
        assert 0 < across.min() < across.max() < 800
        assert down.min() > 0

    def test_what_drawing_does_not_take_is_refused_in_one_line(self, finished):
        for words in (("--margin-m", "1"), (finished,)):
            outcome = call("zones", "draw", finished, *words)
            assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
            assert "takes one log" in outcome.err


class TestPlaces:
    """Where tracks and zones are, by hand: two ground planes, of 0.1 and then 0.2 m to a pixel."""

    PLANES = tuple((ns(start), GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 640, 480)) for start, s in ((0, 0.1), (3, 0.2)))

    def test_positions_are_those_that_are_known_or_those_of_the_plane_of_their_time(self, monkeypatch):
        nan, frames = np.nan, []
        for n in range(6):
            rows = TRACKS.rows(
                track_id=[7, 3, 5], class_id=[1, 2, 3], observed=[True] * 3, source_id=[-1] * 3,
                x_px=[10.0 * n, nan, 100.0], y_px=[20.0, nan, 100.0], w_px=[4.0, nan, 10.0], h_px=[30.0, nan, 40.0],
                x_m=[nan, 1.0, 8.0], y_m=[nan, 2.0, 9.0], z_m=[nan, 1.5, 0.5], height_m=[nan, 2.0, nan],
            )  # fmt: skip
            frames.append(Frame(ns(n), n, rows))
        for part_rows in (1 << 16, 3):
            monkeypatch.setattr("mcaptrack.schema.framing.PART_ROWS", part_rows)
            found = positions_of(frames, self.PLANES, None, {1: "person"})
            assert found.track.tolist() == [3] * 6 + [5] * 6 + [7] * 6
            assert found.frame.tolist() == [*range(6)] * 3
            assert found.t_ns.tolist() == [ns(n) for n in range(6)] * 3
            assert found.class_id.tolist() == [2] * 6 + [3] * 6 + [1] * 6
            feet = [[10 * n + 2, 50] for n in range(6)]
            scale = [0.1] * 3 + [0.2] * 3
            on_ground = [[x * s, y * s] for (x, y), s in zip(feet, scale, strict=True)]
            np.testing.assert_allclose(found.at["metres"], [[1, 2]] * 6 + [[8, 9]] * 6 + on_ground)
            np.testing.assert_allclose(found.at["pixels"], [[nan, nan]] * 6 + [[105, 140]] * 6 + feet)
            np.testing.assert_allclose(found.picture_px, found.at["pixels"])
            np.testing.assert_allclose(found.low_m, [0.5] * 12 + [nan] * 6)  # a height that isn't known is none
            assert found.height_px == 35.0
        without = positions_of(frames, (), None)
        assert np.isnan(without.at["metres"][12:]).all()
        np.testing.assert_allclose(without.at["pixels"][12:], feet)
        nothing = positions_of([], self.PLANES, None, {4: "car"})
        assert (nothing.at["metres"].shape, nothing.picture_px.shape, nothing.low_m.shape) == ((0, 2), (0, 2), (0,))
        assert (len(nothing.track), nothing.classes) == (0, {4: "car"})
        assert np.isnan(nothing.height_px)

    def test_a_zone_in_pixels_is_compared_on_the_ground_where_one_plane_holds(self):
        (zone,) = parse_zones(
            collection(feature("a", "Polygon", [[[0, 0], [10, 0], [10, 20], [0, 0]]]), units="pixels")
        )
        placed = place_zone(zone, self.PLANES[1:])
        assert (placed.units, placed.forward) == ("metres", -1)
        assert {tuple(point) for point in placed.shape.parts[0][0].tolist()} == {(0, 0), (2, 0), (2, 4)}
        assert (place_zone(zone, self.PLANES).units, place_zone(zone, self.PLANES).forward) == ("pixels", -1)
        mirrored = GroundPlane((0.1, 0, 0, 0, -0.1, 48, 0, 0, 1), 640, 480)  # y grows away from the camera
        assert place_zone(zone, ((0, mirrored),)).forward == 1
        (own,) = parse_zones(collection(feature("a", "LineString", LINE)))
        placed = place_zone(own, self.PLANES[1:])
        assert (placed.zone, placed.units, placed.forward) == (own, "metres", 1)
        assert placed.shape.parts[0][0].tolist() == LINE

    def test_edges_below_a_lens_are_in_sixteen_pieces(self):
        """Of a triangle all three edges; of a line of three points two, and its end."""
        corners = [[0.0, 0.0], [32.0, 0.0], [32.0, 16.0]]
        plane = GroundPlane((2.0, 0, 0, 0, 2.0, 0, 0, 0, 1), 640, 480, lens=Lens((500.0, 500.0), (320.0, 240.0)))
        for kind, coordinates, count in (("Polygon", [[*corners, corners[0]]], 48), ("LineString", corners, 33)):
            (zone,) = parse_zones(collection(feature("a", kind, coordinates), units="pixels"))
            ring = place_zone(zone, ((0, plane),)).shape.parts[0][0]
            assert len(ring) == count
            np.testing.assert_allclose(ring[:16], np.stack([np.arange(16) * 4.0, np.zeros(16)], axis=1), atol=1e-9)
            np.testing.assert_allclose(ring[16:33:16], [[64.0, 0.0], [64.0, 32.0]], atol=1e-9)


# Zones in worlds of re-tracking


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
