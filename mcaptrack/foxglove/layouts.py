"""Layout files of Foxglove ("Import from file") and Lichtblick: panels, and how they divide the window.

Topics of annotations and scenes are off until a layout switches them on. Pictures don't wait for annotations
(``synchronize`` is off, for current and for earlier viewers), so the video always shows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

Config = Mapping[str, Any]
#: The name of a panel, or two parts in a "row" or a "column" and the share of the first in percent.
Tree = str | tuple[str, "Tree", "Tree", float]

#: The camera settings of a 3D panel, without its position.
_CAMERA: Final = {
    "perspective": True,
    "target": [0, 0, 0],
    "targetOrientation": [0, 0, 0, 1],
    "fovy": 45,
    "near": 0.1,
    "far": 5000,
}
#: Grids have cells of 1 m, or of 10 m if there would be more cells than this.
_MOST_CELLS: Final = 100
#: Grids are as wide as this part of the distance of the camera; their lines are faint, so that tracks stand out.
_GRID_SHARE: Final = 0.8
_GRID_COLOUR: Final = "#8080a028"
#: The width of the legend in px, beside the curves, which it would hide otherwise.
_LEGEND_PX: Final = 130


class Eye(NamedTuple):
    """The position from which a scene is seen: the target in metres, distance, tilt and bearing.

    ``tilt_deg`` is 0 straight from above; ``bearing_deg`` is the direction of sight, clockwise from the second axis.
    ``z_m`` is the height of the ground.
    """

    x_m: float
    y_m: float
    distance_m: float
    tilt_deg: float
    bearing_deg: float
    z_m: float = 0.0


#: The view of a robot from behind, in its own frame: the first axis points ahead.
_BEHIND: Final = Eye(0.0, 0.0, 50.0, 60.0, 90.0)


def panel(title: str, config: Config) -> dict[str, Any]:
    """The settings of a panel with its title, under the name of each viewer for it."""
    return {**config, "foxglovePanelTitle": title, "lichtblickPanelTitle": title}


def image_panel(title: str, image_topic: str, annotations: Mapping[str, bool]) -> dict[str, Any]:
    """An image panel for a topic, with the topics of annotations that are on or off."""
    mode = {
        "imageTopic": image_topic,
        "synchronize": False,
        "annotations": {topic: {"visible": is_on} for topic, is_on in annotations.items()},
    }
    return panel(title, {"imageMode": mode, "synchronize": False, "syncedTopics": dict.fromkeys(annotations, False)})


def scene_panel(title: str, frame_id: str, topics: Mapping[str, bool], eye: Eye, follow: str = "") -> dict[str, Any]:
    """A 3D panel for a coordinate frame with a grid, with the topics of scenes that are on or off.

    The camera stands at ``eye`` in that frame, or moves with the frame of a robot, ``follow``.
    """
    size = max(10, round(_GRID_SHARE * eye.distance_m / 10) * 10)
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": "Grid",
        "visible": True,
        "frameId": frame_id,
        "size": size,
        "divisions": size if size <= _MOST_CELLS else max(1, size // 10),
        "lineWidth": 1,
        "color": _GRID_COLOUR,
        "position": [round(eye.x_m), round(eye.y_m), eye.z_m or 0],
        "rotation": [0, 0, 0],
    }
    seen = _BEHIND if follow else eye
    camera = {
        **_CAMERA,
        "distance": seen.distance_m,
        "phi": seen.tilt_deg,
        "thetaOffset": seen.bearing_deg,
        "targetOffset": [seen.x_m, seen.y_m, seen.z_m or 0],
    }
    scene = {
        "cameraState": camera,
        "followMode": "follow-pose",
        "followTf": follow or frame_id,
        # Lines to the parents of frames end at the origin of the map, which may be far away.
        "scene": {"transforms": {"visible": False, **({"lineWidth": 0} if follow else {})}},
        "transforms": {},
        "topics": {topic: {"visible": is_on, **_scene_style(topic)} for topic, is_on in topics.items()},
        "layers": {"grid": grid},
        "imageMode": {},
    }
    return panel(title, scene)


def _scene_style(topic: str) -> Config:
    """The settings of a topic of scenes: the discs of forecasts are large, and white outlines would hide the rest."""
    return {"showOutlines": False} if "/predictions/" in topic else {}


def plot_panel(title: str, paths: Mapping[str, str], most: float | None = None) -> dict[str, Any]:
    """A plot over time: message paths with their labels. Its axis ends at 0 and ``most``, if that is given.

    Without limits, viewers cut lines at the border of the panel.
    """
    curves = [
        {"value": value, "enabled": True, "timestampMethod": "receiveTime", "label": label}
        for value, label in paths.items()
    ]
    plot = {
        "paths": curves,
        "showLegend": True,
        "legendDisplay": "left",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": _LEGEND_PX,
    }
    if most is not None:
        plot |= {"minYValue": 0, "maxYValue": most}
    return panel(title, plot)


def log_panel(title: str, topic: str) -> dict[str, Any]:
    """A panel with the lines of a log topic."""
    return panel(title, {"topicToRender": topic, "minLogLevel": 1, "searchTerms": []})


def split(parts: Sequence[Tree], direction: str = "row") -> Tree:
    """Parts in a row, or a column, with equal shares."""
    if len(parts) == 1:
        return parts[0]
    return direction, parts[0], split(parts[1:], direction), 100 / len(parts)


def layout(panels: Mapping[str, Config], tree: Tree) -> bytes:
    """The layout file of panels by their names, such as "Image!picture", arranged by the tree."""
    whole = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _mosaic(tree),
    }
    return json.dumps(whole, indent=1, sort_keys=True).encode() + b"\n"


def _mosaic(tree: Tree) -> str | dict[str, Any]:
    if isinstance(tree, str):
        return tree
    direction, first, second, share = tree
    return {
        "direction": direction,
        "first": _mosaic(first),
        "second": _mosaic(second),
        "splitPercentage": round(share, 1),
    }
