"""The layouts of a camera, made for the channels of its log: tracking, tracks side by side, and forecasts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import atan2, degrees, floor, hypot, isfinite, log10
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.foxglove import layouts
from mcaptrack.foxglove.layouts import Eye, Tree, split
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.plane import Planes, plane_at

#: The names of the layouts, and the suffix of each file.
TRACKING, COMPARING, PREDICTIONS = "tracking", "comparing", "predictions"
FILES: Final[Mapping[str, str]] = {
    TRACKING: ".layout.json",
    COMPARING: ".comparing.layout.json",
    PREDICTIONS: ".predictions.layout.json",
}
#: The channels that a layout switches on, below the prefix: the first that exists.
_BEST: Final = ("retracks/full", "retracks", "tracks", "detections")
#: The kinds of tracks that are compared: title, and channels of which the first that exists is shown.
_KINDS: Final = (
    ("Tracker", ("tracks",)),
    ("Re-tracked", ("retracks/full", "retracks")),
    ("Truth", ("truth",)),
)
#: The most pictures of a layout that are side by side.
_MOST_CAMERAS: Final = 3
_TILT_DEG: Final = 45.0
#: The distance of the camera, in radii of the places of people: discs and labels at the border are whole.
_DISTANCE: Final = 3.4
#: The names of plots with known limits.
PEOPLE, ERRORS, SPREAD = "people", "errors", "spread"
#: The suffix of the text of events, after the topic of tracks.
_EVENTS: Final = "/events/view/log"
#: The suffix of zones, after the topic of tracks.
_ZONES: Final = "/zones"


class CameraChannels(NamedTuple):
    """The channels of a camera: the names of its topics below the prefix, the topic of pictures, the coordinate frame
    and the view of the ground, the number of steps of forecasts, and whether their errors against ground truth are
    known.

    ``follow`` is the frame of the robot that recorded 3D boxes; ``recorded`` are topics that viewers draw in 3D
    themselves, and whether they are these boxes; ``seen_by`` are the topics of the pictures that boxes are drawn on.
    ``highest`` are the largest values that plots show, by name: those that are known.
    """

    prefix: str
    names: frozenset[str]
    pictures: str | None
    frame_id: str
    eye: Eye
    last_step: int
    is_truth_known: bool = False
    follow: str = ""
    recorded: Mapping[str, bool] = {}
    seen_by: tuple[str, ...] = ()
    highest: Mapping[str, float] = {}

    def topics(self, suffix: str, on: Collection[str]) -> dict[str, bool]:
        """The topics of all views with a suffix, and whether each is on."""
        found = sorted(name.removesuffix(suffix) for name in self.names if name.endswith(suffix))
        return {f"{self.prefix}/{name}{suffix}": name in on for name in found}

    def has_view(self, name: str) -> bool:
        """Whether a channel has a view."""
        return bool({name + "/view/image", name + "/view/scene"} & self.names)

    def has_any_view(self) -> bool:
        """Whether there is any view."""
        return any(name.endswith(("/view/image", "/view/scene")) for name in self.names)


def best_channels(names: Collection[str]) -> list[str]:
    """The channels to switch on, of those below the prefix: the best tracks, and their forecasts."""
    found = [name for name in _BEST if name in names][:1]
    of_these = "retracks/predictions"
    forecasts = [of_these for name in found if name.startswith("retracks") and of_these in names]
    return found + forecasts + zones_of(found, names)


def zones_of(chosen: Collection[str], names: Collection[str]) -> list[str]:
    """The zones of chosen channels of tracks, of those below the prefix."""
    return [f"{name}{_ZONES}" for name in chosen if f"{name}{_ZONES}" in names]


def eye_on(places_m: Floats, planes: Planes, t_ns: int) -> Eye:
    """A view of the positions of people (N, 2), from the side of the camera."""
    known = places_m[np.isfinite(places_m).all(axis=1)]
    low, high = np.quantile(known, [0.02, 0.98], axis=0) if len(known) else (np.full(2, -5.0), np.full(2, 5.0))
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
    if not camera.has_any_view():
        return {}
    made = {TRACKING: _tracking(camera)}
    if sum(any(camera.has_view(name) for name in names) for _, names in _KINDS) > 1:
        made[COMPARING] = _comparing(camera)
    if camera.has_view("predictions") or camera.has_view("retracks/predictions"):
        made[PREDICTIONS] = _predictions(camera)
    return made


def _tracking(camera: CameraChannels) -> bytes:
    channels = {name.removesuffix("/view/image").removesuffix("/view/scene") for name in camera.names}
    on = best_channels([name for name in channels if camera.has_view(name)])
    panels: dict[str, Any] = {}
    picture = _seen_by(camera, panels, on) or _image(camera, panels, "picture", "Video", on)
    scene = _ground(camera, panels, "ground", "Tracks" if camera.recorded else "Ground", on)
    left = [*(picture or scene), *_plots(camera, panels)]
    right = [*(scene if picture else ()), *_recorded(camera, panels), *_event_text_or_log(camera, panels)]
    return _file(panels, _columns(left, right, 55.0))


def _comparing(camera: CameraChannels) -> bytes:
    panels: dict[str, Any] = {}
    upper: list[Tree] = []
    shown = []
    for number, (title, names) in enumerate(_KINDS):
        found = [name for name in names if camera.has_view(name)][:1]
        found += [f"{name}{_ZONES}" for name in found if camera.has_view(f"{name}{_ZONES}")]
        if found:
            shown += found
            upper += _image(camera, panels, f"picture{number}", title, found) or _ground(
                camera, panels, f"ground{number}", title, found
            )
    lower = [*_ground(camera, panels, "ground", "All", shown), *_plots(camera, panels)]
    events = [part for title, names in _KINDS for part in _events(camera, panels, title, names)]
    lower += [split(events, "column")] if events else []
    return _file(panels, ("column", split(upper), split(lower), 50.0) if lower else split(upper))


def _predictions(camera: CameraChannels) -> bytes:
    future = next(name for name in ("retracks/predictions", "predictions") if camera.has_view(name))
    past = "retracks/full" if future.startswith("retracks") else "tracks"
    on = [future, past, "truth"]
    panels: dict[str, Any] = {}
    panels["Plot!spread"] = _spread(camera, future)
    events = "retracks" if future.startswith("retracks") else "tracks"
    left = [*_image(camera, panels, "picture", "Forecasts", on), *_errors(camera, panels)]
    right = [*_ground(camera, panels, "ground", "Forecasts on the ground", on)]
    beside = _events(camera, panels, "Tracking", (events,))
    right.append(("row", "Plot!spread", beside[0], 60.0) if beside else "Plot!spread")
    return _file(panels, _columns(left, right, 50.0))


def _spread(camera: CameraChannels, future: str) -> dict[str, Any]:
    """The spread of forecasts: mean and 90th percentile of each frame, or the variances of all people."""
    source = f"{camera.prefix}/{future}"
    if SPREAD in camera.highest:
        paths = {
            f"{source}/scores.rows[:].spread_mean_m": "mean (m)",
            f"{source}/scores.rows[:].spread_90_m": "90 % (m)",
        }
        return layouts.plot_panel("Radius that holds 95 %", paths, limit_of(camera.highest[SPREAD]))
    last = f"{source}.rows[:]{{step=={camera.last_step}}}"
    paths = {f"{last}.cov_{axis}_m2": f"{axis[0]} variance (m2)" for axis in ("xx", "yy")}
    return layouts.plot_panel("Uncertainty of forecasts", paths)


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
    labels = {"retracks/predictions": "re-tracked", "predictions": "tracker"}
    paths = {
        f"{camera.prefix}/{name}/scores.rows[:].{front}{measure.lower()}_m": f"{measure}, {label}"
        for measure in ("ADE", "FDE")
        for name, label in labels.items()
        if f"{name}/scores" in camera.names
    }
    if not paths:
        return []
    words = "ground truth" if camera.is_truth_known else "later tracks"
    most = limit_of(camera.highest.get(ERRORS))
    panels["Plot!errors"] = layouts.plot_panel(f"Prediction errors (m), against {words}", paths, most)
    return ["Plot!errors"]


def _image(camera: CameraChannels, panels: dict[str, Any], name: str, title: str, on: Collection[str]) -> list[Tree]:
    if camera.pictures is None:
        return []
    panels[f"Image!{name}"] = layouts.image_panel(title, camera.pictures, camera.topics("/view/image", on))
    return [f"Image!{name}"]


def _seen_by(camera: CameraChannels, panels: dict[str, Any], on: Collection[str]) -> list[Tree]:
    """The pictures of calibrated cameras, side by side, with the 3D boxes on them."""
    names = []
    for number, pictures in enumerate(camera.seen_by[:_MOST_CAMERAS]):
        names.append(f"Image!camera{number}")
        annotations = camera.topics(f"/view/image{pictures}", on)
        panels[names[-1]] = layouts.image_panel(pictures, pictures, annotations)
    return [split(names)] if names else []


def _ground(camera: CameraChannels, panels: dict[str, Any], name: str, title: str, on: Collection[str]) -> list[Tree]:
    topics = camera.topics("/view/scene", [*on, "ground_plane"])
    if not topics:
        return []
    topics |= dict.fromkeys(camera.recorded, False)
    panels[f"3D!{name}"] = layouts.scene_panel(title, camera.frame_id, topics, camera.eye, camera.follow)
    return [f"3D!{name}"]


def _recorded(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The boxes that other software recorded, for comparison."""
    if not any(camera.recorded.values()):
        return []
    topics = {**camera.topics("/view/scene", ()), **camera.recorded}
    panels["3D!recorded"] = layouts.scene_panel("Recorded boxes", camera.frame_id, topics, camera.eye, camera.follow)
    return ["3D!recorded"]


def _plots(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The number of people, or of objects, if it is counted; otherwise their positions."""
    labels = {"tracks": "tracker", "retracks": "re-tracked", "retracks/full": "re-tracked", "truth": "truth"}
    counted = {
        f"{camera.prefix}/{name}/counts.rows[:].tracked": label
        for name, label in labels.items()
        if f"{name}/counts" in camera.names
    }
    places = {
        f"{camera.prefix}/{name}.rows[:].x_m": f"{label}, x (m)"
        for name, label in labels.items()
        if name in camera.names and name != "retracks/full"
    }
    if counted and "truth" in camera.names:
        counted[next(iter(counted)).replace(".tracked", ".people")] = "truth"
    if not counted and not places:
        return []
    title = ("Objects" if camera.recorded else "People") if counted else "Places"
    most = limit_of(camera.highest.get(PEOPLE), is_count=True) if counted else None
    panels["Plot!people"] = layouts.plot_panel(title, counted or places, most)
    return ["Plot!people"]


def _events(camera: CameraChannels, panels: dict[str, Any], title: str, names: Collection[str]) -> list[Tree]:
    """The text of events of the first of these channels that has any."""
    found = [f"{name}{_EVENTS}" for name in names if f"{name}{_EVENTS}" in camera.names][:1]
    for topic in found:
        panels[f"RosOut!{title}"] = layouts.log_panel(f"{title}: events", f"{camera.prefix}/{topic}")
    return [f"RosOut!{title}" for _ in found]


def _event_text_or_log(camera: CameraChannels, panels: dict[str, Any]) -> list[Tree]:
    """The text of events, if there is any; otherwise the contents of the log."""
    found = _events(camera, panels, "Tracking", ("retracks/full", "retracks", "tracks"))
    if not found:
        panels["SourceInfo!log"] = layouts.panel("Log", {})
    return found or ["SourceInfo!log"]


def _columns(left: Sequence[Tree], right: Sequence[Tree], share: float) -> Tree:
    columns = [_column(parts) for parts in (left, right) if parts]
    return ("row", columns[0], columns[1], share) if len(columns) == 2 else columns[0]


def _column(parts: Sequence[Tree]) -> Tree:
    return ("column", parts[0], split(parts[1:], "column"), 65.0) if len(parts) > 1 else parts[0]


def _file(panels: Mapping[str, Any], tree: Tree) -> bytes:
    return layouts.layout(panels, tree)
