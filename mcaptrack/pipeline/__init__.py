"""Run stages on a log: plan them, check their inputs and outputs, run their transforms, and write the results.

A stage reads a channel of an existing log and adds its own channels to the log, with their provenance: the input, the
transform and its parameters.
"""

from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.events import Watch
from mcaptrack.pipeline.findings import warn_clock_jumps
from mcaptrack.pipeline.following import Before, Continued, begins_here
from mcaptrack.pipeline.fusing import fusable, fuse_again, fuse_cameras
from mcaptrack.pipeline.plan import plan_all, plan_stage
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, read_planes
from mcaptrack.pipeline.run import Report, input_of, outdated_by, run
from mcaptrack.pipeline.several import begins_with, choose_cameras
from mcaptrack.pipeline.shown import RobotPath, Shown, find_views, robot_path
from mcaptrack.pipeline.staleness import is_stale
from mcaptrack.pipeline.summary import Summary, summarise
from mcaptrack.pipeline.write import LAYOUTS, attachment_of, layout_path
from mcaptrack.pipeline.zones import CountedZones, ZoneWatch, counted_zones
from mcaptrack.sources.cameras import Camera, camera_at, camera_to_name, find_camera, scenes_of

__all__ = [
    "AS_BEFORE",
    "LAYOUTS",
    "Before",
    "Camera",
    "Continued",
    "CountedZones",
    "Job",
    "PlaneChoice",
    "Report",
    "RobotPath",
    "Shown",
    "Summary",
    "Watch",
    "ZoneWatch",
    "attachment_of",
    "begins_here",
    "begins_with",
    "camera_at",
    "camera_to_name",
    "choose_cameras",
    "counted_zones",
    "find_camera",
    "find_views",
    "fusable",
    "fuse_again",
    "fuse_cameras",
    "input_of",
    "is_stale",
    "layout_path",
    "outdated_by",
    "plan_all",
    "plan_stage",
    "read_planes",
    "robot_path",
    "run",
    "scenes_of",
    "summarise",
    "warn_clock_jumps",
]
