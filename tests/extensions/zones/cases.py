"""Cases of ``zones`` for the tests of the core."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation.world_tracks import WorldInterval
from mcaptrack.extensions.zones.counting import finished
from mcaptrack.extensions.zones.visits import ZoneInWorlds, ZoneTotals
from mcaptrack.pipeline import Summary

#: A zone that both people of ``made_log`` walk through, and a line that one of them crosses.
_ZONES = (
    '{"type": "FeatureCollection", "units": "metres", "features": ['
    '{"type": "Feature", "properties": {"name": "room"}, "geometry": '
    '{"type": "Polygon", "coordinates": [[[1, 2], [3, 2], [3, 5], [1, 5], [1, 2]]]}}, '
    '{"type": "Feature", "properties": {"name": "door"}, "geometry": '
    '{"type": "LineString", "coordinates": [[4, 0], [4, 9]]}}]}'
)


def zones_file(folder: Path) -> Path:
    """A file of zones."""
    path = folder / "zones.geojson"
    path.write_text(_ZONES)
    return path


FILES = {"zones.geojson": _ZONES}
NEEDS = {"zones": ("--zones", "zones.geojson")}
NAMED = {"zones": ["zones", "draw"]}
READING = {"zones": lambda path, out: [path, "--zones", zones_file(out), "-o", out / "other.mcap"]}
EFFECTS = {
    "zones": (
        "zones a.mcap --zones zones.geojson",
        {
            "zones": ("zones a.mcap", "--zones zones.geojson"),
            "topic": "--topic /camera/tracks",
            "margin_m": "--margin-m 0.5",
            "max_gap_s": "--max-gap-s 1",
            "camera": "--camera other",
            "output": "-o b.mcap",
            "force": ("zones a.mcap --zones zones.geojson -o fresh.mcap", "--force"),
        },
    )
}
OPTIONS_OF_RUN = {"zones": ("run a.mcap --no-tables", "--zones zones.geojson")}


def _of_topic(path: Path, topic: str, folder: Path) -> Any:
    mcaptrack.zones(path, zones=zones_file(folder), topic=topic, output=folder / "copy.mcap")
    with log.read(folder / "copy.mcap") as opened:
        return {name: tuple(opened.times(name).tolist()) for name in opened.channels}


TOPICS = {"zones": ("tracks", _of_topic)}
PROPOSALS = {
    "extensions/zones/counting.py:make:run": lambda s: s.without("/camera/*tracks*", "/camera/truth*").says(
        "zones", "LOG", "--zones", str(zones_file(Path()))
    ),
    "extensions/zones/counting.py:finished:zones": lambda s: s.says(
        "run", "LOG", "--no-tables", "--zones", str(zones_file(Path()))
    ),
    "extensions/zones/page.py:zones_page:run": lambda s: s.ingested(
        "truth.txt", "--as", "detections", "--fps", "10"
    ).says("zones", "draw", "LOG"),
}


def _printed(to: Any) -> None:
    from tests.commands import run_result

    def result(totals: dict[str, list[ZoneTotals]], **changed: Any) -> mcaptrack.RunResult:
        return run_result(finished={"zones": finished(totals, Path("a b.mcap"))}, **changed)

    places = [(frame, person, frame + 20 * person) for frame in range(90) for person in (0, 1)]
    Path("truth.txt").write_text("".join(f"{f + 1},{p + 1},{x},24,8,8,1,1,1\n" for f, p, x in places))
    Path("plane.txt").write_text("0.1,0,0\n0,0.1,0\n0,0,1\n")
    zones_file(Path())
    to.run("ingest truth.txt --ground-plane plane.txt --fps 10 -o a.mcap")
    to.run("zones a.mcap --zones zones.geojson")
    room = ZoneTotals("room", False, 3, 4, 2, 1, 50.0, 12.54, 11.0, 2, 1.5)
    door = ZoneTotals("door", True, 7, forward=5, backward=6)
    counted = {"/a/tracks": [door, room], "/b/tracks": [ZoneTotals("room", False, 0)]}
    to.run("zones x.mcap --zones z", zones=result(counted, stages=("zones",), written_because="ROS reads it"))
    to.run("zones x.mcap --zones z", zones=result({"/a": [door]}, written_to=None, written_because="why"))
    to.run("zones x.mcap --zones z --json -q", zones=result({"/a": [room]}, stages=("zones",)))
    ways = {"hall": WorldInterval(2.5, 1.0, 4.0), "roof": WorldInterval(0.0, 0.0, 0.0)}
    sure = replace(
        room, in_worlds=ZoneInWorlds(50, WorldInterval(3.0, 2.0, 5.0), WorldInterval(12.54, 9.0, 17.26), ways)
    )
    alone = replace(room, zone="hall", in_worlds=ZoneInWorlds(50, WorldInterval(3.0, None, None), None, {}))
    in_worlds = result({"/a": [sure, alone, door]}, stages=("zones",))
    for more in ("", "--json"):
        to.run(f"zones x.mcap --zones z -q {more}".strip(), zones=in_worlds)
    to.run("run x.mcap", run=result({"/a": [room]}, summary=Summary()))


PRINTED = {"zones": _printed}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "zones": (
        "its counts are written, drawn and reported as those of the core are",
        "api.running cli.many foxglove.annotations foxglove.views.ground "
        "foxglove.views.image foxglove.views.people geometry.camera_path pipeline.checks pipeline.motion "
        "pipeline.pictures pipeline.staleness pipeline.write schema.frame_columns viewing.charts",
    )
}
