"""Draw a scene with known ground truth, run everything on it, and compare SORT with re-tracking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from mcaptrack.api.common import Notes, as_path
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.ingesting import ingest
from mcaptrack.api.options import FILES, Force, PathLike, Progress, Reports, no_progress
from mcaptrack.api.run import run
from mcaptrack.api.scoring import Scores, evaluate
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import Notice, collected
from mcaptrack.sources import demo as drawing
from mcaptrack.sources.demo import PLACES, SCENES, SyntheticScene
from mcaptrack.tables.export import default_folder

SceneName = Literal["square", "walkers", "crowd", "side-by-side", "standing", "three-cameras"]
#: Largest distance in metres at which ground truth and a track match in the scores.
GATE_M: Final = 1.0


@dataclass(frozen=True)
class DemoResult:
    """A drawn scene with all results.

    Attributes
    ----------
    log, video, truth, ground_plane : pathlib.Path
        The log, and what it was made of: the video, label file and homography. With several cameras the first video
        and homography, and the table of positions in metres.
    tables : pathlib.Path
        The folder with the tables.
    layouts : tuple of pathlib.Path
        Layout files for Foxglove and Lichtblick.
    scores : mcaptrack.Scores
        Scores of SORT (the samples of its tracks) and of re-tracking, matched within 1 m; with several cameras those
        of the scene that they are fused to.
    notes : tuple of str
        What was done.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd.

    """

    log: Path
    video: Path
    truth: Path
    ground_plane: Path
    tables: Path
    layouts: tuple[Path, ...]
    scores: Scores
    notes: tuple[str, ...]
    warnings: tuple[Notice, ...]


@declared(heading="Start here", printed_by="mcaptrack.cli.demo:Demo")
def demo(
    output: Annotated[PathLike, Option(FILES, short="o", shown=True)] = "mcaptrack-demo",
    *,
    scene: SceneName = "square",
    seed: Annotated[int, Option("", 0, 2**31 - 1)] = 2,
    force: Force = False,
    progress: Reports = no_progress,
) -> DemoResult:
    """Draw a scene, run everything on it, and compare the trackers.

    SORT is compared with re-tracking; the ground truth of a drawn scene is known. The scene has what makes tracking
    fail: people who cross, meet and part, occlusion behind a kiosk, a tree that sways, a camera that shakes a little.
    Writes a video, a log, tables and layouts. Scores of one seed are a random sample, so the mean and the range over
    ten seeds of each scene are printed, too.

    Parameters
    ----------
    output : path, default "mcaptrack-demo"
        Folder for the video, the log, the tables and the layouts.
    scene : {"square", "walkers", "crowd", "side-by-side", "standing", "three-cameras"}, default "square"
        Scene to draw: people who cross, meet and part on a square; 10 walkers or a crowd of 20 on random routes; three
        pairs side by side; people who stand still for a while; 8 walkers seen by three cameras.
    seed : int, default 2
        Random seed of the noise, the shaking and the routes.
    force : bool, default False
        Replace the demonstration in the folder.

    Returns
    -------
    DemoResult
        The files, and the scores of SORT and of re-tracking.

    Raises
    ------
    McaptrackError
        If the folder holds a demonstration, or cannot be written to.

    Examples
    --------
    On the command line:

        mcaptrack demo --scene crowd --seed 7 -o crowd

    >>> import mcaptrack
    >>> result = mcaptrack.demo("crowd", scene="crowd", seed=7)
    >>> 0 < result.scores.score("IDF1", "retracks") <= 1
    True

    """
    folder, notes = as_path(output), Notes()
    if folder.exists() and not folder.is_dir():
        raise McaptrackError(f"{folder} is a file; the demonstration needs a folder")
    target = folder / "demo.mcap"
    if target.exists() and not force:
        raise McaptrackError(f"{target} exists; give another folder with `output=`, or `force=True` to replace it")
    with collected() as warnings:
        if scene in PLACES:
            footage, truth = _several(PLACES[scene](seed), folder, target, force, notes, progress)
            result = run(target, progress=progress)
            name = "world"
        else:
            drawn = SCENES[scene](seed)
            notes.say(f"drawing {drawn.seconds:g} seconds of the scene {scene} ...")
            footage = drawing.draw(drawn, folder, progress)
            ingest(
                footage.video,
                target,
                ground_plane=footage.ground_plane,
                truth=footage.ground_truth,
                force=force,
                progress=progress,
            )
            result, name, truth = run(target, progress=progress), "camera", footage.ground_truth
        topics = (f"/{name}/samples", f"/{name}/retracks")
        scores = evaluate(target, similarity="metres", gate_m=GATE_M, topic=topics, camera=name)
    return DemoResult(
        log=target,
        video=footage.video,
        truth=truth,
        ground_plane=footage.ground_plane,
        tables=default_folder(target),
        layouts=result.layouts,
        scores=scores,
        notes=(*notes, *result.notes),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _several(
    cameras: Mapping[str, SyntheticScene], folder: Path, target: Path, force: bool, notes: Notes, progress: Progress
) -> tuple[drawing.Footage, Path]:
    """Draw a scene that several cameras see, and ingest it; returns the footage of the first, and the positions."""
    seconds = next(iter(cameras.values())).seconds
    notes.say(f"drawing {seconds:g} seconds for each of the cameras {', '.join(cameras)} ...")
    footage, positions = drawing.draw_place(cameras, folder, progress)
    for name, drawn in footage.items():
        where = {"output": target, "force": force} if drawn is next(iter(footage.values())) else {"into": target}
        ingest(drawn.video, ground_plane=drawn.ground_plane, camera=name, progress=progress, **where)
    ingest(positions, into=target, role="truth", camera="world", frame="map")
    return next(iter(footage.values())), positions
