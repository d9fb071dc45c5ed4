"""What is said without ground truth, on drawn scenes that have it: signs of comparisons, and intervals from worlds.

    .venv/bin/python tools/without_truth.py signs --seeds 9001 9101
    .venv/bin/python tools/without_truth.py worlds --seeds 7101 --scenes 24

``signs`` makes five trackers of each scene (``crowds.py``), with faults of their own or with those of the tracker that
the reference is re-tracked from, and prints how often better and worse are right, by the difference that is seen.
``worlds`` prints how often the intervals of ``query --worlds`` and of ``zones`` hold the true number, in the shape of
scenes where they do so least, and how wide they are; and how wide intervals around the median are that hold as often in
the same scenes and are made of their truth (conformal ones).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import STEP_S, Rows, corrupt
from crowds import SHAPES, faults, scenes
from reproduce import on_clock

import mcaptrack
from mcaptrack.evaluation.against import Candidates, compare, copied
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import person_scores
from mcaptrack.schema import Frame
from mcaptrack.transforms import Retrack, Sample

STEPS = 300
RULE = MatchRule("metres", 1.0)


def frames(rows: Rows) -> list[Frame]:
    return on_clock(rows, np.arange(STEPS))


def samples(rows: Rows) -> list[Frame]:
    return [frame for (frame,) in Sample(start_ns=0)(frames(rows))]


def worse(rows: Rows, rng: np.random.Generator) -> Rows:
    """A tracker with the same detections, that breaks ids, loses people or rows, or places them badly."""
    rows, kind = rows.copy(), rng.integers(4)
    ids, of = np.unique(rows[:, 1], return_inverse=True)
    if kind == 0:
        breaks = rng.random(len(rows)) < 10 ** rng.uniform(-2.5, -1)
        for track in range(len(ids)):
            rows[of == track, 1] = ids[track] + 1e4 * np.cumsum(breaks[of == track])
    elif kind == 1:
        rows = rows[(rng.random(len(ids)) > rng.uniform(0.03, 0.5))[of]]
    elif kind == 2:
        rows = rows[rng.random(len(rows)) > rng.uniform(0.02, 0.4)]
    else:
        rows[:, 2:] += rng.normal(0, rng.uniform(0.05, 0.6), (len(rows), 2))
    return rows


def signs(seeds: list[int], count: int) -> None:
    table = defaultdict(list)
    for seed in seeds:
        for number, truth in enumerate(scenes(seed, STEPS, count)):
            rng = np.random.default_rng([seed, number])
            source, other, third = (corrupt(truth, faults(rng), rng) for _ in range(3))
            (true, reference) = frames(truth), [parts[0] for parts in Retrack()(samples(source))]
            trackers = {"other": other, "third": third, "worse": worse(other, rng), "same 1": worse(source, rng)}
            trackers["same 2"] = worse(source, rng)
            made = {name: samples(rows) for name, rows in trackers.items()}
            made["re-tracked"] = [parts[0] for parts in Retrack()(made["other"])]
            by_truth, by_reference = (
                {name: person_scores(side, tracks, RULE) for name, tracks in made.items()} for side in (true, reference)
            )
            related = {name: how for name, tracks in made.items() if (how := copied(reference, tracks, RULE))}
            for names in combinations(made, 2):
                row = compare(*names, [Candidates(by_reference, related)])
                wanted = by_truth[names[1]].idf1() - by_truth[names[0]].idf1()
                kind = f"{sum(name.startswith('same') for name in names)} on the reference's detections"
                table[kind, int(np.digitize(abs(row.idf1), [0.05, 0.1, 0.2]))].append(
                    (row.verdict != "undecided", row.idf1 * wanted > 0)
                )
    for (kind, size), rows in sorted(table.items()):
        decided, right = np.array(rows).T
        span = ("under 5", "5 to 10", "10 to 20", "over 20")[size]
        of_decided = f"{right[decided].mean():7.1%}" if decided.any() else "      -"
        print(f"{kind:32} {span:>9} points: {len(rows):5} pairs, sign right {right.mean():6.1%}, "
              f"decided {decided.sum():5}, of these right {of_decided}")  # fmt: skip


def rectangles(low: Rows, size: Rows) -> dict[str, list[float]]:
    """Two zones in a scene of this size: x from and to, y from and to, in m."""
    shares = {"A": (0.1, 0.6, 0.2, 0.7), "B": (0.45, 0.9, 0.55, 0.95)}
    return {name: [low[at // 2] + some[at] * size[at // 2] for at in range(4)] for name, some in shares.items()}


def geometry(zones: dict[str, list[float]]) -> dict:
    """The same as GeoJSON."""
    rings = {name: [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]] for name, (x0, x1, y0, y1) in zones.items()}
    shapes = [
        {"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        for name, ring in rings.items()
    ]
    return {"type": "FeatureCollection", "units": "metres", "features": shapes}


def questions(zones: dict[str, list[float]]) -> dict[str, str]:
    """What is asked of zones A and B."""
    a, b = ("x_m between {} and {} and y_m between {} and {}".format(*zone) for zone in zones.values())
    return {
        "people": "select count(distinct track_id) from tracks",
        "visitors of A": f"select count(distinct track_id) from tracks where {a}",
        "visitors of B": f"select count(distinct track_id) from tracks where {b}",
        "A -> B": f"select count(*) from (select min(t_ns) filter ({a}) as a, max(t_ns) filter ({b}) as b "
        "from tracks group by track_id) where a < b",
        "dwell in A": f"select count(*) * {STEP_S} / count(distinct track_id) from tracks where {a}",
    }


#: The tracks that visited A before they came to B.
_THEN = """
select count(*) as n from (select min(t_ns) filter (zone = 'A') as a, max(t_ns) filter (zone = 'B') as b
                           from zone_visits group by track_id) where a < b
"""


def answers(seeds: list[int], count: int) -> Iterator[tuple[str, str, float, list[float]]]:
    """The shape of the scene, what was asked, the true answer, and that of worlds: median, from, to."""
    for seed in seeds:
        for number, truth in enumerate(scenes(seed, STEPS, count)):
            rng, shape = np.random.default_rng([seed, number, 8]), SHAPES[number % len(SHAPES)]
            made = {"scene": corrupt(truth, faults(rng), rng), "true": truth}
            with tempfile.TemporaryDirectory() as folder:
                for name, rows in made.items():
                    with mcaptrack.open(Path(folder, f"{name}.mcap"), create=True) as log:
                        log.write("/camera/tracks", [frame for frame in frames(rows) if len(frame.rows)])
                mcaptrack.retrack(Path(folder, "scene.mcap"), worlds=50)
                low = truth[:, 2:].min(axis=0)
                zones = rectangles(low, truth[:, 2:].max(axis=0) - low)
                asked = questions(zones)
                query = "select " + ", ".join(f'({part}) as "{name}"' for name, part in asked.items())
                (true,) = mcaptrack.query(Path(folder, "true.mcap"), query).to_pylist()
                (found,) = mcaptrack.query(Path(folder, "scene.mcap"), query, worlds=True).to_pylist()
                for name in asked:
                    yield shape, name, true[name], [found[name + end] for end in ("", "_from", "_to")]
                yield from ((shape, *row) for row in zone_answers(Path(folder), geometry(zones)))


def zone_answers(folder: Path, zones: dict) -> Iterator[tuple[str, float, list[float]]]:
    """As ``answers``, from ``zones``."""
    true = mcaptrack.zones(folder / "true.mcap", zones=zones).zones["/camera/tracks"]
    (then,) = mcaptrack.query(folder / "true.mcap", _THEN)["n"].to_pylist()
    retracked = mcaptrack.zones(folder / "scene.mcap", zones=zones).zones["/camera/retracks/full"]
    found = {total.zone: total.in_worlds for total in retracked}
    for total in true:
        yield f"zones: tracks in {total.zone}", total.tracks, found[total.zone].tracks
        yield f"zones: stay in {total.zone}", total.mean_dwell_s, found[total.zone].mean_dwell_s or (None,) * 3
    yield "zones: A -> B", then, found["A"].then["B"]


def worlds(seeds: list[int], count: int) -> None:
    table, shapes = defaultdict(list), defaultdict(list)
    for shape, name, true, (middle, low, high) in answers(seeds, count):
        if true and low is not None:
            table[name].append((low <= true <= high, (high - low) / true, middle / true))
            shapes[name, shape].append(low <= true <= high)
    for name, rows in table.items():
        held, wide, middle = np.array(rows, float).T
        least = min(np.mean(shapes[name, shape]) for shape in SHAPES if shapes[name, shape])
        conformal = 2 * np.quantile(np.abs(1 / middle[middle > 0] - 1), held.mean()) * middle.mean()
        print(
            f"{name:18} {len(rows):4} scenes, held {held.mean():.2f} (least {least:.2f}), width {wide.mean():.2f} "
            f"(conformal {conformal:.2f}), median {np.median(middle):.2f} of the truth"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("signs", "worlds"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[9101])
    parser.add_argument("--scenes", type=int, default=24)
    given = parser.parse_args()
    {"signs": signs, "worlds": worlds}[given.what](given.seeds, given.scenes)


if __name__ == "__main__":
    main()
