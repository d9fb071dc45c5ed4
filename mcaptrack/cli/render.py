"""``mcaptrack render``: draw the annotated video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from mcaptrack.cli import common
from mcaptrack.cli.many import LogWork, many_options, process, takes_many

if TYPE_CHECKING:
    from mcaptrack import RenderResult

_PICTURE: Final = "Pictures"


@common.one_line
@takes_many()
def render(
    logs: common.Logs,
    topic: Annotated[
        list[str] | None,
        common.option(
            "--topic",
            panel=_PICTURE,
            help="Draw these views.",
            show_default="as in the layout",
        ),
    ] = None,
    compare: Annotated[
        bool,
        common.option(
            "--compare",
            panel=_PICTURE,
            help="Draw SORT, re-tracked and ground truth side by side, with counters of identity switches.",
        ),
    ] = False,
    heatmap: Annotated[
        bool,
        common.option(
            "--heatmap", panel=_PICTURE, help="Draw one picture of where people spend their time: LOG.heatmap.png."
        ),
    ] = False,
    blur: Annotated[
        Literal["people"] | None,
        common.option(
            "--blur",
            panel=_PICTURE,
            help="Hide people: in a video, or with -o OUT.mcap in a copy of the log.",
            show_default="off",
        ),
    ] = None,
    width: Annotated[
        int | None,
        common.option(
            "--width",
            panel=_PICTURE,
            least=16,
            most=16384,
            tuning=True,
            help="Width in pixels.",
            show_default="as the video",
        ),
    ] = None,
    max_fps: Annotated[
        float | None,
        common.option(
            "--max-fps",
            panel=_PICTURE,
            least=0.01,
            most=1000,
            tuning=True,
            help="Largest number of pictures per second.",
            show_default="all; GIF 10",
        ),
    ] = None,
    start_s: Annotated[
        float,
        common.option(
            "--start-s",
            panel=_PICTURE,
            least=0,
            most=1e9,
            tuning=True,
            help="Begin at this time of the log, in seconds.",
        ),
    ] = 0.0,
    end_s: Annotated[
        float | None,
        common.option(
            "--end-s",
            panel=_PICTURE,
            least=0,
            most=1e9,
            tuning=True,
            help="End at this time of the log, in seconds.",
            show_default="the end",
        ),
    ] = None,
    gif: Annotated[
        bool, common.option("--gif", panel=_PICTURE, help="Write LOG.gif instead of LOG.mp4, if -o names no file.")
    ] = False,
    camera: common.Camera = None,
    output: Annotated[Path | None, common.output("LOG.mp4 or LOG.gif beside the log")] = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Draw boxes, trails and predictions on the video of a log: LOG.mp4, or a GIF.

    Draws the views that Foxglove and Lichtblick show, in the same colours. Tracks of 3D boxes are drawn on the pictures
    of a calibrated camera; without one, they are seen from above, as with --topic /lidar/retracks/full/view/scene.

    With --compare SORT's tracks, re-tracked ones and the ground truth stand side by side. With --heatmap this is a
    picture (.png, .jpg) of where people spend their time.

    With --blur people all people in the log's detections, tracks and labels are hidden, and nothing is drawn unless
    --topic names it. What may still show people is listed: other cameras, point clouds, attachments.

    Example: mcaptrack render log.mcap -o walk.gif --width 480 --start-s 2 --end-s 8
    """
    import mcaptrack
    from mcaptrack.api.rendering import default_suffix
    from mcaptrack.fleet import find_logs

    def line(done: RenderResult) -> str:
        if heatmap:
            return f"where people of {', '.join(done.views)} spend their time"
        drawn = f" with {', '.join(done.views)}" if done.views else ""
        hidden = f", people hidden in {', '.join(done.blurred)}" if done.blurred else ""
        return f"{done.pictures} picture{'' if done.pictures == 1 else 's'}{drawn}{hidden}"

    def data(done: RenderResult) -> dict[str, object]:
        written = {"log": str(done.log), "output": str(done.video), "pictures": done.pictures}
        return written | {"views": list(done.views), "blurred": list(done.blurred)}

    given: dict[str, Any] = {
        "topic": topic,
        "compare": compare,
        "heatmap": heatmap,
        "blur": blur,
        "width": width,
        "max_fps": max_fps,
    }
    given |= {"start_s": start_s, "end_s": end_s}
    is_named = many_options().output_dir is not None  # by a name that says what is written
    given |= {"gif": gif and not is_named, "camera": camera, "force": force}
    with common.Talk(quiet, verbose).open() as talk:
        suffix = default_suffix(compare=compare, heatmap=heatmap, blur=blur, gif=gif)
        work = LogWork(
            "render",
            mcaptrack.render,
            given,
            show=lambda _, one: talk.say(f"{one.video}: {line(one)}"),
            data=data,
            line=line,
            suffix=suffix,
        )
        results, totals = process(find_logs(logs), work, talk, output)
    if json:
        common.print_json({"results": [data(one) for one in results], **totals})
