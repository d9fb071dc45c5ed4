"""Run stages on a log: plan them, check their inputs and outputs, run their transforms, and write the results.

A stage reads a channel of an existing log and adds its own channels to the log, with their provenance: the input, the
transform and its parameters. Names are imported when they are first used, so that asking whether a channel is out of
date loads neither transforms nor views.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mcaptrack import _lazily

if TYPE_CHECKING:
    from mcaptrack.pipeline.checks import Job
    from mcaptrack.pipeline.choice_of_cameras import SCENE, UNREAD, ChosenCameras, begins_with, choose_cameras
    from mcaptrack.pipeline.drawing import RobotPath, find_views, robot_path, views_from_above
    from mcaptrack.pipeline.events import Watch
    from mcaptrack.pipeline.following import Before, Continued, begins_here
    from mcaptrack.pipeline.plan import plan_all, plan_stage
    from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice
    from mcaptrack.pipeline.runner import Report, input_of, outdated_by, run
    from mcaptrack.pipeline.staleness import is_outdated, is_stale, missing_finisher, read_planes, warn_clock_jumps
    from mcaptrack.pipeline.summary import Summary, summarise
    from mcaptrack.pipeline.views import with_views
    from mcaptrack.pipeline.write import LAYOUTS, Made, RunState, attachment_of, layout_path
    from mcaptrack.sources.cameras import Camera, camera_at, camera_to_name, find_camera, scenes_of

_NAMES: Final = {
    "mcaptrack.pipeline.checks": "Job",
    "mcaptrack.pipeline.choice_of_cameras": "SCENE UNREAD ChosenCameras begins_with choose_cameras",
    "mcaptrack.pipeline.drawing": "RobotPath find_views robot_path views_from_above",
    "mcaptrack.pipeline.events": "Watch",
    "mcaptrack.pipeline.following": "Before Continued begins_here",
    "mcaptrack.pipeline.plan": "plan_all plan_stage",
    "mcaptrack.pipeline.planes": "AS_BEFORE PlaneChoice",
    "mcaptrack.pipeline.runner": "Report input_of outdated_by run",
    "mcaptrack.pipeline.staleness": "is_outdated is_stale missing_finisher read_planes warn_clock_jumps",
    "mcaptrack.pipeline.summary": "Summary summarise",
    "mcaptrack.pipeline.views": "with_views",
    "mcaptrack.pipeline.write": "LAYOUTS Made RunState attachment_of layout_path",
    "mcaptrack.sources.cameras": "Camera camera_at camera_to_name find_camera scenes_of",
}
_MODULES: Final = {name: module for module, names in _NAMES.items() for name in names.split()}

if not TYPE_CHECKING:  # with it a type checker would take any name for one of this package
    __getattr__ = _lazily(__name__, _MODULES)
