"""Training data: label files, Parquet tables, tracks of logs, or synthetic walks.

Letters: I tracks, S steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import log, pipeline, tables
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError, call
from mcaptrack.extensions.training.recipe import Recipe
from mcaptrack.extensions.training.windows import Windows
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes
from mcaptrack.location import sibling
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import join_frames
from mcaptrack.sources.ingest import IngestOptions, label_frames
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import ONLY_PEOPLE
from mcaptrack.sources.walks import walks
from mcaptrack.transforms import Sample

SYNTHETIC: Final = "synthetic"
#: The channels of a log to train on, the best first.
_BEST: Final = ("truth", "retracks", "samples", "tracks")


@dataclass(frozen=True)
class Scene:
    """Tracks on a regular clock: ``xy_m`` (I, S, 2), NaN where they were not observed."""

    name: str
    xy_m: Floats

    def cut(self, recipe: Recipe, number: int) -> Windows:
        """The windows of a recipe; ``number`` is that of the scene."""
        return Windows.cut(self.xy_m, recipe.past, recipe.steps, recipe.least, recipe.stride, number)


@dataclass(frozen=True)
class SourceOptions:
    """Options of label files, and the channel of logs and tables."""

    labels: IngestOptions = IngestOptions()
    topic: str | None = None


def read_scenes(paths: Sequence[Path], options: SourceOptions, step_s: float) -> list[Scene]:
    """The scenes in files and folders: one per label file or channel of tracks. Raises McaptrackError."""
    scenes: list[Scene] = []
    for path in paths:
        members = _files(path)
        for file in members:
            scenes += _READERS.get(file.suffix.lower(), _from_labels)(file, options, step_s)
    return scenes


def _files(path: Path) -> list[Path]:
    """The files of a folder that can be read, or the file itself."""
    if not path.is_dir():
        log.refuse_non_mcap(path)
        return [path]
    kinds = (".txt", ".parquet", ".mcap")
    files = sorted(file for file in path.rglob("[!.]*") if file.suffix.lower() in kinds and file.is_file())
    # Only tables of tracks, and none that repeat the log beside them.
    logs = {sibling(file, ".tables") for file in files if file.suffix.lower() == ".mcap"}
    files = [file for file in files if not logs & set(file.parents)]
    files = [file for file in files if file.suffix.lower() != ".parquet" or tables.holds_tracks(file)]
    if not files:
        log.refuse_non_mcap(path)
        raise McaptrackError(f"{path} has no {', '.join(kinds)} to train on")
    return files


def _from_labels(path: Path, options: SourceOptions, step_s: float) -> list[Scene]:
    given = options.labels
    wanted = given.classes or ONLY_PEOPLE
    role: Role = "truth"
    how = (given.label_format, role, given.first_of(role), given.columns, wanted)
    labels = read_labels(path, *how, class_map=given.class_map)
    if not labels.has_ids:
        raise McaptrackError(f"{path} has boxes without track ids; predictors learn from tracks")
    fps = given.fps
    if fps is None:
        fps = labels.facts.fps
    if fps is None and labels.facts.interval_s is None:
        raise McaptrackError(f"{path}: how many frames a second? Say it with `fps=`")
    if fps is None:  # annotated at the rate of prediction
        fps = Fraction(labels.step / step_s).limit_denominator(1000)
    if labels.xy_m is None and given.ground_plane is None:
        raise McaptrackError(f"{path} is in pixels; give its homography with `ground_plane=`")
    frames = label_frames({"truth": path}, replace(given, fps=fps))["truth"]
    first = next((number for number, frame in enumerate(frames) if len(frame.rows)), 0)
    return [_scene(path.stem, frames[first:], step_s, ())]  # windows begin with the first label


def _from_log(path: Path, options: SourceOptions, step_s: float) -> list[Scene]:
    with log.read(path) as opened:
        prefix = pipeline.find_camera(opened, None, options.topic)
        topics = [opened.find(options.topic, prefix)] if options.topic else [f"{prefix}/{name}" for name in _BEST]
        filled = [topic for topic in topics if topic in opened.channels and opened.channels[topic].messages]
        if not filled:
            raise McaptrackError(f"{path} has none of {', '.join(topics)}; {call('run', path)} makes tracks")
        if (schema_name := opened.channels[filled[0]].schema_name) != TRACKS.name:
            raise McaptrackError(f"{path}: {filled[0]} holds {schema_name}, not {TRACKS.name}")
        planes = pipeline.read_planes(opened, prefix) or ()
        return [_scene(f"{path.stem}{filled[0]}", opened.frames(filled[0], TRACKS), step_s, planes)]


def _from_parquet(path: Path, options: SourceOptions, step_s: float) -> list[Scene]:
    channels = tables.read_tracks(path)
    if options.topic:
        named = log.find_topic(options.topic, channels, path)
        channels = {topic: frames for topic, frames in channels.items() if topic == named}
        if not channels:
            raise McaptrackError(f"{path} has no rows of {options.topic}")
    else:
        best = min(channels, key=_rank)
        channels = {best: channels[best]}
    return [_scene(f"{path.parent.name or path.stem}{topic}", frames, step_s, ()) for topic, frames in channels.items()]


def _rank(topic: str) -> int:
    name = topic.rpartition("/")[2]
    return _BEST.index(name) if name in _BEST else len(_BEST)


def _scene(name: str, frames: Iterable[Frame], step_s: float, planes: Planes) -> Scene:
    """Frames of tracks as a scene; interpolated positions count as not observed."""
    sampled = [frame for (frame,) in Sample(rate_hz=1 / step_s, ground_planes=tuple(planes))(frames)]
    if not sampled:
        return Scene(name, np.empty((0, 0, 2)))
    start = sampled[0].t_ns
    step = [round((frame.t_ns - start) / (step_s * NS_PER_S)) for frame in sampled]
    joined = join_frames(TRACKS, sampled)
    rows, at = joined.rows, np.array(step, np.int64)[joined.frame]
    observed = rows["observed"] & np.isfinite(rows["x_m"])
    ids, track = np.unique(rows["track_id"][observed], return_inverse=True)
    xy_m = np.full((len(ids), step[-1] + 1, 2), np.nan)
    xy_m[track, at[observed]] = np.stack([rows["x_m"][observed], rows["y_m"][observed]], axis=-1)
    return Scene(name, xy_m)


_READERS: Final[dict[str, Callable[[Path, SourceOptions, float], list[Scene]]]] = {
    ".mcap": _from_log,
    ".parquet": _from_parquet,
}


def synthetic(recipe: Recipe, count: int, seed: int) -> Windows:
    """Windows of synthetic walks."""
    paths, scene = walks(count, recipe.past + recipe.steps, recipe.step_s, seed)
    return Windows.of(paths, recipe.past, scene)


def windows_of(scenes: Sequence[Scene], recipe: Recipe) -> Windows:
    """All windows of several scenes. Raises McaptrackError if there are none."""
    windows = Windows.join([scene.cut(recipe, number) for number, scene in enumerate(scenes)])
    if len(windows) == 0:
        seconds = (recipe.least + recipe.steps) * recipe.step_s
        raise McaptrackError(f"no track lasts {seconds:g} s without a gap in {', '.join(s.name for s in scenes)}")
    return windows


def split(windows: Windows, share: float, seed: int) -> tuple[Windows, Windows]:
    """Split windows by scenes into those to train on and those to validate on, about ``share`` of all.

    A single scene is split by the order of its windows, which is that of tracks.
    """
    scenes, count = np.unique(windows.scene, return_counts=True)
    if len(scenes) == 1:
        last = np.arange(len(windows)) >= round((1 - share) * len(windows))
        return windows[~last], windows[last]
    order = np.random.default_rng(seed).permutation(len(scenes))
    kept = np.cumsum(count[order]) <= share * len(windows)
    kept[0] = True
    kept[-1] = False
    held = np.isin(windows.scene, scenes[order[kept]])
    return windows[~held], windows[held]
