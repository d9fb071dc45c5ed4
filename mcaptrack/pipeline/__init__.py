"""Stages in order: which channel feeds which transform, what has to run first, and what it leaves in the log.

A stage runs on a log that stands and adds its channels to it, with what they were made from and how.
"""

from mcaptrack.pipeline.events import Watch, camera_of
from mcaptrack.pipeline.plan import (
    DEFAULT_CAMERA,
    ROUTES,
    Job,
    Route,
    find_camera,
    is_stale,
    picture_topic,
    plan_all,
    plan_stage,
)
from mcaptrack.pipeline.run import Report, input_of, read_planes, run
from mcaptrack.pipeline.write import LAYOUTS, attachment_of, find_views, layout_path

__all__ = [
    "DEFAULT_CAMERA",
    "LAYOUTS",
    "ROUTES",
    "Job",
    "Report",
    "Route",
    "Watch",
    "attachment_of",
    "camera_of",
    "find_camera",
    "find_views",
    "input_of",
    "is_stale",
    "layout_path",
    "picture_topic",
    "plan_all",
    "plan_stage",
    "read_planes",
    "run",
]
