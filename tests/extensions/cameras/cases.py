"""Cases of ``fuse`` and ``calibrate`` for the tests of the core."""

from pathlib import Path
from typing import Any

import mcaptrack
from tests import places
from tests.commands import run_result

READING = {"fuse": lambda log, out: [log, "-o", out / "other.mcap"], "calibrate": None}
DEEDS = {"fuse": []}  # it has no log of several cameras there
_RIGHT = "calibrate two.mcap --reference left"
EFFECTS = {
    "fuse": (
        "fuse two.mcap",
        {
            "set": "--set max_sigma=0",
            "cameras": "--cameras left",
            "clock_offset_s": "--clock-offset-s left=2",
            "min_score": "--min-score 0.99",
            "to": "--to plaza",
            "fuser": "--fuser grid",
            "output": "-o b.mcap",
            "force": ("fuse two.mcap -o fresh.mcap", "--force"),
        },
    ),
    "calibrate": (
        _RIGHT,
        {
            "cameras": "--cameras left",
            "reference": ("calibrate two.mcap", "--reference left"),
            "clock_offset_s": "--clock-offset-s left=2",
            "dry_run": "--dry-run",
            "output": "-o b.mcap",
            "force": (f"{_RIGHT} -o fresh.mcap", "--force"),
        },
    ),
}
OPTIONS_OF_RUN = {
    "fuse": ("run two.mcap --no-tables", "--no-fuse"),
    "fuser": ("run two.mcap --no-tables", "--fuser grid"),
}


def _printed(to: Any) -> None:
    to.run("fuse x.mcap", fuse=run_result(stages=("fuse",), frames={"/yard/detections": 4, "/other/x": 2}))
    line = "people walk on one line"
    cameras = {
        "few": ("", 0.0, 0, None, None, None, None, "too few pairs", "", 0.0),
        "agrees": ("", 0.0, 1200, 0.1, 0.3, None, None, "it agrees with the others", "", -0.5),
        "off": ("rigid", 2.5, 90, 1.0, 2.0, 0.1, 0.2, "", line, 0.25),
        "before": ("full", 2.5, 90, None, 2.0, 0.1, None, "", "", 0.0),
    }
    found = {name: mcaptrack.CameraCorrection(*one, homography=None) for name, one in cameras.items()}
    given = Path("a.mcap"), found, {"off": "/off/plane", "before": "/before/plane"}, ("before",), ("/agrees/plane",)
    for is_dry_run in (False, True):
        result = mcaptrack.CalibrateResult(
            *given, is_dry_run, (), None if is_dry_run else Path("b.mcap"), "why", (), 1.26
        )
        to.run("calibrate x.mcap", calibrate=result)


def _with_a_plane_off(scene: Any) -> str:
    """Replace the log by one of three cameras, one of them with a ground plane that is 3 m off."""
    scene.path.unlink()
    places.write_log(scene.path.resolve(), places.CAMERAS[:3], moved_m={"east": 3.0})
    return scene.says("fuse", "LOG")


PRINTED = {"cameras": _printed}
PROPOSALS = {
    "extensions/cameras/command.py:next_commands:run": lambda s: s.says("fuse", "LOG"),
    "extensions/cameras/fusing.py:warn_disagreeing:calibrate": _with_a_plane_off,
    "extensions/cameras/fusing.py:_lack:detect": lambda s: s.without("/camera/[!vg]*").says("fuse", "LOG"),
}
#: Modules of the core that aren't public, which this extension alone needs, and the reason.
DEEP = {
    "cameras": (
        "it writes a scene as the channels of a stage are written, and finds fusers as transforms are found",
        "api.running cli.many cli.running foxglove.views.people geometry.assignment geometry.neighbours "
        "geometry.pinhole pipeline.checks pipeline.pictures pipeline.rebuild "
        "pipeline.several pipeline.staleness pipeline.write schema.frame_columns schema.as_rows "
        "sources.fixed_frame transforms.guarded",
    )
}
