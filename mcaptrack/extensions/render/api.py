"""Draw videos of logs, and hide people in their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import Camera, EachLog, Force, PathLike, Reports, no_progress, output
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.notices import Notice

if TYPE_CHECKING:
    from mcaptrack import log as logs

_PICTURE: Final = "Pictures"


@dataclass(frozen=True)
class RenderResult:
    """A video with what was drawn on it, or a log or video in which people are hidden.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    video : pathlib.Path
        The video, GIF or log that was written.
    pictures : int
        Number of pictures.
    views : tuple of str
        Topics of the views that were drawn.
    warnings : tuple of mcaptrack.Notice
        What looks odd.
    blurred : tuple of str
        Topics of the pictures in which people are hidden.

    """

    log: Location
    video: Path
    pictures: int
    views: tuple[str, ...]
    warnings: tuple[Notice, ...]
    blurred: tuple[str, ...] = ()


@declared(
    heading="Results",
    printed_by="mcaptrack.extensions.render.command:Render",
    most_used=("output", "topic", "compare", "heatmap", "blur", "width", "start_s", "end_s", "force"),
)
def render(
    log: EachLog,
    output: Annotated[PathLike | None, output("LOG.mp4 or LOG.gif beside the log")] = None,
    *,
    topic: Annotated[str | Sequence[str] | None, Option(_PICTURE, shown="as in the layout")] = None,
    compare: Annotated[bool, Option(_PICTURE)] = False,
    heatmap: Annotated[bool, Option(_PICTURE)] = False,
    blur: Annotated[Literal["people"] | None, Option(_PICTURE, shown="off")] = None,
    width: Annotated[int | None, Option(_PICTURE, 16, 16384, tuning=True)] = None,
    max_fps: Annotated[float | None, Option(_PICTURE, 0.01, 1000, tuning=True)] = None,
    start_s: Annotated[float, Option(_PICTURE, 0, 1e9, tuning=True)] = 0.0,
    end_s: Annotated[float | None, Option(_PICTURE, 0, 1e9, tuning=True)] = None,
    gif: Annotated[bool, Option(_PICTURE)] = False,
    camera: Camera = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> RenderResult:
    """Draw boxes, trails and predictions on the video of a log.

    Writes LOG.mp4, or a GIF. Draws the views that Foxglove and Lichtblick show, in the same colours. Tracks of 3D boxes
    are drawn on the pictures of a calibrated camera; without one, they are seen from above in their frame of reference,
    around the robot.

    With ``compare`` SORT's tracks, re-tracked ones and the ground truth stand side by side. With ``heatmap`` it is a
    picture (.png, .jpg) of where people spend their time.

    With ``blur`` people all people that any channel of the log has boxes of are hidden, also while they are missed for
    a few pictures, and nothing is drawn unless ``topic`` names it. To a name that ends with .mcap this writes a copy of
    the log with such pictures, in which everything else is as before. What may still show people is listed: other
    cameras, point clouds, attachments.

    Parameters
    ----------
    output : path, optional
        Write to this file: a video (.mp4 or .gif), with ``blur`` also a log (.mcap), with ``heatmap`` a picture. Of
        several logs, to this folder.

        By default LOG.mp4 beside the log, LOG.compared.mp4 with ``compare``, LOG.blurred.mp4 with ``blur``,
        LOG.heatmap.png with ``heatmap``.
    topic : str or sequence of str, optional
        Draw these views.

        By default those that the layout shows, or none with ``blur``. With ``heatmap``, count these tracks.
    compare : bool, default False
        Draw SORT, re-tracked and ground truth side by side, with counters of identity switches.
    heatmap : bool, default False
        Draw one picture of where people spend their time: LOG.heatmap.png.
    blur : {"people"}, optional
        Hide people: in a video, or with an ``output`` that ends with .mcap in a copy of the log.
    width : int, optional
        Width in pixels; by default that of the video, or 960 from above.
    max_fps : float, optional
        Largest number of pictures per second; by default all, in a GIF 10.
    start_s : float, default 0
        Begin at this time of the log, in seconds.
    end_s : float, optional
        End at this time of the log, in seconds; by default the end.
    gif : bool, default False
        Write LOG.gif instead of LOG.mp4, if ``output`` names no file.
    camera : str, optional
        Which camera, if the log has several.

        A log is written with the people hidden in the pictures of all cameras.

    Returns
    -------
    RenderResult
        The video, and what was drawn.

    Raises
    ------
    McaptrackError
        If the log has no pictures and no scenes, no boxes to hide people in, or if the output exists.

    Examples
    --------
    On the command line:

        mcaptrack render log.mcap -o walk.gif --width 480 --start-s 2 --end-s 8

    >>> import mcaptrack
    >>> mcaptrack.render("log.mcap", "walk.gif", width=160, end_s=1.0).pictures > 1
    True
    >>> mcaptrack.render("log.mcap", "anonymous.mcap", blur="people").blurred
    ('/camera/video',)

    """
    from functools import partial

    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.api.common import log_location, names_of, optional_path, warn_unused, warnings_about
    from mcaptrack.extensions.render import comparing, video
    from mcaptrack.extensions.render.blur.recording import blurrable, write_blurred_log
    from mcaptrack.extensions.render.heat_map import draw_heat_map
    from mcaptrack.files import is_same_file, refuse_overwrite
    from mcaptrack.location import local_name
    from mcaptrack.sources.cameras import camera_at

    path = log_location(log)
    refuse_both(compare=compare, heatmap=heatmap, blur=blur is not None)
    suffix = default_suffix(compare=compare, heatmap=heatmap, blur=blur, gif=gif)
    target = optional_path(output) or local_name(path, suffix)
    is_log = target.suffix.lower() == ".mcap"
    if is_same_file(target, path):
        raise McaptrackError(f"{target} is the log itself; give another name, so that the pictures aren't lost")
    if is_log and blur is None:
        raise McaptrackError(f"{target}: a log is written only with `blur=`; a video is rendered to .mp4 or .gif")
    refuse_overwrite(target, force)
    options = video.RenderOptions(width_px=width, max_fps=max_fps, start_s=start_s, end_s=end_s)
    views: Sequence[str] = ()
    blurred: Sequence[str] = ()
    with warnings_about(path) as warnings, ExitStack() as stack:
        opened = stack.enter_context(logs.read(path))
        if not is_log:
            opened, _ = stack.enter_context(pipeline.with_views(opened))
        warn_unused("the name of the output says what is written", gif=gif and output is not None)
        if is_log:
            of_video = {"topic": bool(topic), "width": width is not None, "max_fps": max_fps is not None}
            warn_unused("the whole log is written", **of_video, start_s=bool(start_s), end_s=end_s is not None)
            counts = write_blurred_log(opened, blurrable(opened, camera), target, progress).pictures
            count, blurred = sum(counts.values()), tuple(counts)
        elif blur is not None:
            hidden = blurrable(opened, camera)
            pictures = _one_of(opened, list(hidden), camera)
            if topic:
                views = pipeline.find_views(opened, pipeline.find_camera(opened, camera), names_of(topic)).views
            count = video.render(opened, pictures, views, target, options, progress, hidden[pictures])
            blurred = (pictures,)
        else:
            prefix = pipeline.find_camera(opened, camera)
            own_pictures = camera_at(opened, prefix).pictures
            if heatmap:
                warn_unused("a heat map is one picture", max_fps=max_fps is not None, gif=gif and output is None)
                heat = draw_heat_map(opened, prefix, names_of(topic), own_pictures, target, options)
                count, views = 1, (heat.topic,)
            elif compare:
                warn_unused("SORT's tracks, re-tracked ones and ground truth are drawn", topic=bool(topic))
                panels = comparing.find_panels(opened, prefix, own_pictures)
                follow = partial(pipeline.robot_path, opened, prefix, panels[1].view)
                count = comparing.compare(opened, own_pictures, panels, target, options, follow, progress)
                views = [panel.view for panel in panels]
            else:
                views, pictures = pipeline.find_views(opened, prefix, names_of(topic))
                follow = partial(pipeline.robot_path, opened, prefix, views[0])
                if pictures:
                    count = video.render(opened, pictures, views, target, options, progress)
                else:
                    count = video.render_from_above(opened, views, target, options, follow, progress)
    return RenderResult(path, target, count, tuple(views), tuple(dict.fromkeys(warnings)), tuple(blurred))


def _one_of(opened: logs.Log, pictures: Sequence[str], camera: str | None) -> str:
    """Return the channel of pictures of a video: the only one, or that of the camera with results."""
    from mcaptrack import pipeline
    from mcaptrack.sources.cameras import camera_at

    if len(pictures) == 1 or camera is not None:
        return pictures[0]
    chosen = camera_at(opened, pipeline.find_camera(opened)).pictures
    if chosen is not None and chosen in pictures:
        return chosen
    raise McaptrackError(
        f"{opened.path} has people to hide in {', '.join(pictures)}; choose a camera with `camera=`, or write a log"
    )


def refuse_both(**flags: bool) -> None:
    """Raise McaptrackError if more than one of some parameters is given."""
    chosen = [f"`{name}=`" for name, is_given in flags.items() if is_given]
    if len(chosen) > 1:
        raise McaptrackError(f"{' and '.join(chosen)} make different files; give one of them")


def default_suffix(*, compare: bool, heatmap: bool, blur: str | None, gif: bool) -> str:
    """Return the end of the name of an output that is not named, after that of the log."""
    if heatmap:
        return ".heatmap.png"
    return (".compared" if compare else "" if blur is None else ".blurred") + (".gif" if gif else ".mp4")
