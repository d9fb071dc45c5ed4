"""Layout files, as Foxglove ("Import from file") and Lichtblick read them: panels, and how they share the window.

Topics of annotations and scenes are off until a layout switches them on. Pictures don't wait for annotations
(``synchronize`` is off, in the way of today's viewers and in that of earlier ones), so the video always shows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

Config = Mapping[str, Any]
#: A panel's name, or two parts beside each other ("row") or one above the other ("column"), and the share of the first.
Tree = str | tuple[str, "Tree", "Tree", float]

#: How the frames of a camera that looks at the ground stand in a layout.
_CAMERA: Final = {
    "perspective": True,
    "target": [0, 0, 0],
    "targetOrientation": [0, 0, 0, 1],
    "fovy": 45,
    "near": 0.1,
    "far": 5000,
}
#: Grids have cells of a metre, or of ten where there would be too many.
_MOST_CELLS: Final = 100


class Eye(NamedTuple):
    """From where a scene is seen: towards a point (metres), from how far, how steeply, and from which side.

    ``tilt_deg`` is 0 straight from above; ``bearing_deg`` is the direction of sight, clockwise from the second axis.
    """

    x_m: float
    y_m: float
    distance_m: float
    tilt_deg: float
    bearing_deg: float


def panel(title: str, config: Config) -> dict[str, Any]:
    """A panel's settings with its title, under the name that each viewer has for it."""
    return {**config, "foxglovePanelTitle": title, "lichtblickPanelTitle": title}


def image_panel(title: str, image_topic: str, annotations: Mapping[str, bool]) -> dict[str, Any]:
    """The pictures of a topic with annotations of these topics, on or off."""
    mode = {
        "imageTopic": image_topic,
        "synchronize": False,
        "annotations": {topic: {"visible": is_on} for topic, is_on in annotations.items()},
    }
    return panel(title, {"imageMode": mode, "synchronize": False, "syncedTopics": dict.fromkeys(annotations, False)})


def scene_panel(title: str, frame_id: str, topics: Mapping[str, bool], eye: Eye) -> dict[str, Any]:
    """Scenes of these topics, on or off, in a frame, over a grid."""
    size = max(10, round(eye.distance_m / 10) * 10 * 2)
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": "Grid",
        "visible": True,
        "frameId": frame_id,
        "size": size,
        "divisions": size if size <= _MOST_CELLS else max(1, size // 10),
        "lineWidth": 1,
        "color": "#4a4a6a80",
        "position": [round(eye.x_m), round(eye.y_m), 0],
        "rotation": [0, 0, 0],
    }
    camera = {
        **_CAMERA,
        "distance": eye.distance_m,
        "phi": eye.tilt_deg,
        "thetaOffset": eye.bearing_deg,
        "targetOffset": [eye.x_m, eye.y_m, 0],
    }
    scene = {
        "cameraState": camera,
        "followMode": "follow-pose",
        "followTf": frame_id,
        "scene": {"transforms": {"visible": False}},
        "transforms": {},
        "topics": {topic: {"visible": is_on} for topic, is_on in topics.items()},
        "layers": {"grid": grid},
        "imageMode": {},
    }
    return panel(title, scene)


def plot_panel(title: str, paths: Mapping[str, str]) -> dict[str, Any]:
    """Curves over time: message paths with their labels."""
    curves = [
        {"value": value, "enabled": True, "timestampMethod": "receiveTime", "label": label}
        for value, label in paths.items()
    ]
    plot = {
        "paths": curves,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }
    return panel(title, plot)


def log_panel(title: str, topic: str) -> dict[str, Any]:
    """The lines of a log topic."""
    return panel(title, {"topicToRender": topic, "minLogLevel": 1, "searchTerms": []})


def beside(parts: Sequence[Tree], direction: str = "row") -> Tree:
    """Parts that share a row, or a column, in equal shares."""
    if len(parts) == 1:
        return parts[0]
    return direction, parts[0], beside(parts[1:], direction), 100 / len(parts)


def layout(panels: Mapping[str, Config], tree: Tree) -> bytes:
    """The layout file of panels by their names, such as "Image!picture", where the tree puts them."""
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
