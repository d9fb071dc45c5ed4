"""The layouts of a camera, made for the channels of its log: tracking, tracks side by side, and forecasts."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from math import atan2, degrees, floor, hypot, isfinite, log10
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.choices import LAYOUTS
from mcaptrack.foxglove.views.styles import BEST, GROUND_TRUTH, KINDS, RETRACKED, TRACKED
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.plane import Planes, plane_at

#: The names of the layouts.
TRACKING, COMPARING, PREDICTIONS = LAYOUTS
#: The most cameras of a layout.
_MOST_CAMERAS: Final = 3
_TILT_DEG: Final = 45.0
#: The distance of the camera, in radii of the places of people: they are as large as can be, and all in sight.
_DISTANCE: Final = 2.0
#: The names of plots with known limits.
PEOPLE: Final = "people"
ERRORS: Final = "errors"
SPREAD: Final = "spread"
#: The suffix of the text of events, after the topic of tracks.
_EVENTS: Final = "/events/view/log"


# Layout files of Foxglove ("Import from file") and Lichtblick: panels, and how they divide the window.
#
# Topics of annotations and scenes are off until a layout switches them on. Pictures don't wait for annotations
# (``synchronize`` is off, for current and for earlier viewers), so the video always shows.


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
_GRID_SHARE: Final = 1.4
_GRID_COLOUR: Final = "#8080a028"
#: The width of the legend in px, beside the curves, which it would hide otherwise; thickness of curves of means, and of
#: those of ends.
_LEGEND_PX: Final = 170
_THIN, _THICK = 1.0, 2.5
#: Level of messages: from warnings on. Tracks begin and end all the time (INFO), which would bury the rest.
_WARNING, _ALL_LEVELS = 3, 1
#: Transforms are read before they are needed: without that, viewers ask for it in each panel. Names of frames would
#: cover people.
_TRANSFORMS: Final = {"enablePreloading": True, "showLabel": False}
#: The robot itself, as if it were a channel.
ROBOT: Final = "robot"


class PlotCurve(NamedTuple):
    """A curve of a plot: its label, colour and thickness."""

    label: str
    colour: str
    line_px: float = _THIN


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
    scene = {"transforms": _TRANSFORMS}
    synced = dict.fromkeys(annotations, False)
    return panel(title, {"imageMode": mode, "scene": scene, "synchronize": False, "syncedTopics": synced})


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
        "scene": {"transforms": {**_TRANSFORMS, "visible": False, **({"lineWidth": 0} if follow else {})}},
        "transforms": {},
        "topics": {topic: {"visible": is_on, **_scene_style(topic)} for topic, is_on in topics.items()},
        "layers": {"grid": grid},
        "imageMode": {},
    }
    return panel(title, scene)


def _scene_style(topic: str) -> Config:
    """The settings of a topic of scenes: the discs of forecasts are large, and white outlines would hide the rest."""
    return {"showOutlines": False} if "/predictions/" in topic else {}


def plot_panel(title: str, paths: Mapping[str, PlotCurve], most: float | None = None) -> dict[str, Any]:
    """A plot over time: curves by their message paths. Its axis ends at 0 and ``most``, if that is given.

    Without limits, viewers cut lines at the border of the panel.
    """
    curves = [
        {
            "value": value,
            "enabled": True,
            "timestampMethod": "receiveTime",
            "label": curve.label,
            "color": curve.colour,
            "lineSize": curve.line_px,
        }
        for value, curve in paths.items()
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


def log_panel(title: str, topic: str, level: int) -> dict[str, Any]:
    """A panel with the lines of a log topic, from a level on."""
    return panel(title, {"topicToRender": topic, "minLogLevel": level, "searchTerms": []})


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


class CameraChannels(NamedTuple):
    """The channels of a camera: the names of its topics below the prefix, the topic of pictures, the coordinate frame
    and the view of the ground, and whether errors of forecasts against ground truth are known.

    ``follow`` is the frame of the robot that recorded 3D boxes; ``recorded`` are topics that viewers draw in 3D
    themselves, and whether they are these boxes; ``seen_by`` are the topics of the pictures that boxes are drawn on.
    ``highest`` are the largest values that plots show, by name: those that are known.
    """

    prefix: str
    names: frozenset[str]
    pictures: str | None
    frame_id: str
    eye: Eye
    is_truth_known: bool = False
    follow: str = ""
    recorded: Mapping[str, bool] = {}
    seen_by: tuple[str, ...] = ()
    highest: Mapping[str, float] = {}

    def topics(self, suffix: str, on: Collection[str]) -> dict[str, bool]:
        """The topics of all views with a suffix, and whether each is on."""
        having = sorted(name.removesuffix(suffix) for name in self.names if name.endswith(suffix))
        return {f"{self.prefix}/{name}{suffix}": name in on for name in having}

    def has_view(self, name: str) -> bool:
        """Whether a channel has a view."""
        return bool({name + "/view/image", name + "/view/scene"} & self.names)

    def drawn(self) -> set[str]:
        """The names of what has a view."""
        ends = ("/view/image", "/view/scene")
        return {name.removesuffix(end) for end in ends for name in self.names if name.endswith(end)}


def best_channels(names: Collection[str], channels: Collection[str]) -> list[str]:
    """The channels to switch on, of those below the prefix that have views: the best tracks, and their forecasts.

    So are drawings of what was made of these tracks at the end, such as zones; ``channels`` are all below the prefix.
    """
    best = [name for name in BEST if name in names][:1]
    of_these = "retracks/predictions"
    forecasts = [of_these for name in best if name.startswith("retracks") and of_these in names]
    return best + forecasts + made_of(best, names, channels)


def made_of(tracks: Collection[str], names: Collection[str], channels: Collection[str]) -> list[str]:
    """The drawings, of these, that stand below chosen tracks and are no channels themselves."""
    return sorted(name for name in names if name.rpartition("/")[0] in tracks and name not in channels)


def eye_on(places_m: Floats, planes: Planes, t_ns: int) -> Eye:
    """A view of the positions of people (N, 2), from the side of the camera."""
    placed = places_m[np.isfinite(places_m).all(axis=1)]
    low, high = np.quantile(placed, [0.02, 0.98], axis=0) if len(placed) else (np.full(2, -5.0), np.full(2, 5.0))
    middle, radius = (low + high) / 2, max(2.5, float(np.hypot(*(high - low))) / 2)
    bearing, plane = 0.0, plane_at(planes, t_ns)
    if plane is not None:
        width, height = plane.width_px, plane.height_px
        sight = plane.pixels_to_metres(np.array([[width / 2, height], [width / 2, height * 0.9]]))
        ahead_x, ahead_y = (sight[1] - sight[0]).tolist()
        bearing = degrees(atan2(ahead_x, ahead_y)) if isfinite(ahead_x) and hypot(ahead_x, ahead_y) else 0.0
    x_m, y_m, distance_m = (round(float(value), 1) for value in (*middle, _DISTANCE * radius))
    return Eye(x_m, y_m, distance_m, _TILT_DEG, round(bearing, 1))


def make(camera: CameraChannels) -> dict[str, bytes]:
    """The layout files that are useful for a log, by their names; none if there is nothing to see."""
    if not camera.drawn():
        return {}
    files = {TRACKING: _tracking(camera)}
    if sum(any(map(camera.has_view, kind.names)) for kind in KINDS) > 1:
        files[COMPARING] = _comparing(camera)
    if camera.has_view("predictions") or camera.has_view("retracks/predictions"):
        files[PREDICTIONS] = _predictions(camera)
    return files


def _tracking(camera: CameraChannels) -> bytes:
    on = best_channels(camera.drawn(), camera.names)
    panels: dict[str, Any] = {}
    pictures = _pictures(camera, panels, "Video", on)
    scene = _ground(camera, panels, "ground", "Tracks" if camera.recorded else "Ground", on)
    left = [*(pictures or scene), *_plots(camera, panels)]
    right = [*(scene if pictures else ()), *_recorded(camera, panels), *_event_text_or_log(camera, panels)]
    return layout(panels, _columns(left, right, 55.0))


def _comparing(camera: CameraChannels) -> bytes:
    panels: dict[str, Any] = {}
    upper: list[Tree] = []
    shown = []
    for number, kind in enumerate(KINDS):
        title = kind.title.capitalize()
        shown_of_kind = [name for name in kind.names if camera.has_view(name)][:1]
        shown_of_kind += made_of(shown_of_kind, camera.drawn(), camera.names)
        if shown_of_kind:
            shown += shown_of_kind
            upper += _image(camera, panels, f"picture{number}", title, shown_of_kind) or _ground(
                camera, panels, f"ground{number}", title, shown_of_kind
            )
    all_of = ", ".join(f"{kind.sign} {kind.title}" for kind in KINDS if kind.sign and {*kind.names} & {*shown})
    lower = [*_ground(camera, panels, "ground", f"All ({all_of})", shown), *_plots(camera, panels)]
    events = [part for kind in KINDS for part in _events(camera, panels, kind.title.capitalize(), kind.names)]
    lower += [split(events, "column")] if events else []
    return layout(panels, ("column", split(upper), split(lower), 50.0) if lower else split(upper))


def _predictions(camera: CameraChannels) -> bytes:
    future = next(name for name in ("retracks/predictions", "predictions") if camera.has_view(name))
    past = "retracks/full" if future.startswith("retracks") else "tracks"
    on = [future, past, "truth"]
    panels: dict[str, Any] = {}
    events = "retracks" if future.startswith("retracks") else "tracks"
    left = [*_pictures(camera, panels, "Forecasts", on), *_errors(camera, panels)]
    beside = [*_spread(camera, panels, future), *_events(camera, panels, "Tracking", (events,))]
    right = _ground(camera, panels, "ground", "Forecasts on the ground", on) + ([split(beside)] if beside else [])
    return layout(panels, _columns(left, right, 50.0))


def _spread(camera: CameraChannels, panels: dict[str, Any], future: str) -> list[Tree]:
    """The spread of forecasts: mean and 90th percentile of each frame."""
    source, colour = f"{camera.prefix}/{future}", (RETRACKED if future.startswith("retracks") else TRACKED).curve
    if SPREAD not in camera.highest:
        return []
    paths = {
        f"{source}/scores.rows[:].spread_mean_m": PlotCurve("mean (m)", colour),
        f"{source}/scores.rows[:].spread_90_m": PlotCurve("90 % (m)", colour, _THICK),
    }
    panels["Plot!spread"] = plot_panel("Radius that holds 95 %", paths, limit_of(camera.highest[SPREAD]))
    return ["Plot!spread"]


def limit_of(highest: float | None, is_count: bool = False) -> float | None:
    """The round number at which an axis ends, above a value; None if that is not known."""
    if highest is None or not isfinite(highest) or highest <= 0:
        return None
    unit = 10.0 ** floor(log10(highest / 10))
    step = next(k * unit for k in (1, 2, 5, 10) if k * unit >= highest / 10 * (1 - 1e-9))
    step = max(step, 1.0) if is_count else step
    return float(f"{(floor(highest / step) + 1) * step:.6g}")


def _errors(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """Errors of forecasts: against ground truth, or without it against the later tracks."""
    front = "" if camera.is_truth_known else "later_"
    paths = {
        f"{camera.prefix}/{name}/scores.rows[:].{front}{measure.lower()}_m": PlotCurve(
            f"{measure}, {kind.title}", kind.curve, px
        )
        for measure, px in (("ADE", _THIN), ("FDE", _THICK))
        for name, kind in (("retracks/predictions", RETRACKED), ("predictions", TRACKED))
        if f"{name}/scores" in camera.names
    }
    if not paths:
        return []
    text = "ground truth" if camera.is_truth_known else "later tracks"
    most = limit_of(camera.highest.get(ERRORS))
    panels["Plot!errors"] = plot_panel(f"Prediction errors (m), against {text}", paths, most)
    return ["Plot!errors"]


def _image(camera: CameraChannels, panels: dict[str, Any], name: str, title: str, on: Collection[str]) -> list[Tree]:
    if camera.pictures is None:
        return []
    panels[f"Image!{name}"] = image_panel(title, camera.pictures, camera.topics("/view/image", on))
    return [f"Image!{name}"]


def _pictures(camera: CameraChannels, panels: dict[str, Any], title: str, on: Collection[str]) -> list[Tree]:
    """The pictures of the camera, or those of several cameras with the objects on them, one above the other."""
    names: list[str] = []
    for number, pictures in enumerate(camera.seen_by[:_MOST_CAMERAS]):
        names.append(f"Image!camera{number}")
        annotations = camera.topics(f"/view/image{pictures}", on)
        panels[names[-1]] = image_panel(pictures, pictures, annotations)
    return [split(names, "column")] if names else _image(camera, panels, "picture", title, on)


def _ground(camera: CameraChannels, panels: dict[str, Any], name: str, title: str, on: Collection[str]) -> list[Tree]:
    topics = camera.topics("/view/scene", [*on, "ground_plane", ROBOT])
    if not topics:
        return []
    topics |= dict.fromkeys(camera.recorded, False)
    panels[f"3D!{name}"] = scene_panel(title, camera.frame_id, topics, camera.eye, camera.follow)
    return [f"3D!{name}"]


def _recorded(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The boxes that other software recorded, for comparison."""
    if not any(camera.recorded.values()):
        return []
    topics = {**camera.topics("/view/scene", (ROBOT,)), **camera.recorded}
    panels["3D!recorded"] = scene_panel("Recorded boxes", camera.frame_id, topics, camera.eye, camera.follow)
    return ["3D!recorded"]


def _plots(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The number of people, or of objects, if it is counted."""
    counted = {
        f"{camera.prefix}/{name}/counts.rows[:].tracked": PlotCurve(kind.title, kind.curve)
        for kind in KINDS
        for name in reversed(kind.names)
        if f"{name}/counts" in camera.names
    }
    if not counted:
        return []
    if "truth" in camera.names:
        counted[next(iter(counted)).replace(".tracked", ".people")] = PlotCurve(GROUND_TRUTH.title, GROUND_TRUTH.curve)
    title, most = "Objects" if camera.recorded else "People", camera.highest.get(PEOPLE)
    panels["Plot!people"] = plot_panel(title, counted, limit_of(most, is_count=True))
    return ["Plot!people"]


def _events(camera: CameraChannels, panels: dict[str, Any], title: str, names: Collection[str]) -> list[Tree]:
    """The text of events of the first of these channels that has any."""
    with_events = [f"{name}{_EVENTS}" for name in names if f"{name}{_EVENTS}" in camera.names][:1]
    for topic in with_events:
        # A tracker's tracks begin and end, and nothing else is known of them without ground truth.
        is_told = "truth" in camera.names or topic.startswith("retracks")
        level = _WARNING if is_told else _ALL_LEVELS
        panels[f"RosOut!{title}"] = log_panel(f"{title}: events", f"{camera.prefix}/{topic}", level)
    return [f"RosOut!{title}" for _ in with_events]


def _event_text_or_log(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The text of events, if there is any; otherwise the contents of the log."""
    events = _events(camera, panels, "Tracking", ("retracks/full", "retracks", "tracks"))
    if not events:
        panels["SourceInfo!log"] = panel("Log", {})
    return events or ["SourceInfo!log"]


def _columns(left: Sequence[Tree], right: Sequence[Tree], share: float) -> Tree:
    columns = [_column(parts) for parts in (left, right) if parts]
    return ("row", columns[0], columns[1], share) if len(columns) == 2 else columns[0]


def _column(parts: Sequence[Tree]) -> Tree:
    return ("column", parts[0], split(parts[1:], "column"), 65.0) if len(parts) > 1 else parts[0]
