"""Count visits of zones and crossings of lines, and draw zones on a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import mcaptrack
from mcaptrack.api.common import as_path, log_location, names_of, optional_path
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import Camera, EachLog, Force, Output, PathLike, Reports, Sidecar, no_progress
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes, refuse_overwrite
from mcaptrack.location import local_name

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.extensions.zones.counting import ZoneWatch
    from mcaptrack.extensions.zones.shapes import Zone

#: Heading in the help, and the zones that are counted by default.
_COUNT: Final = "Counting"
_BEFORE: Final = "those that were counted before"
_PAGE: Final = ".zones.html"

#: Zones and lines: a file of GeoJSON, or its content.
ZonesLike = PathLike | Mapping[str, Any]


def zones_of(source: ZonesLike | None) -> tuple[Zone, ...]:
    """Return the zones of a file, or of GeoJSON; none of None. Raises McaptrackError if they can't be read."""
    from mcaptrack.extensions.zones.geojson import parse_zones, read_zones

    if source is None:
        return ()
    if isinstance(source, Mapping):
        try:
            return parse_zones(dict(source))
        except McaptrackError as error:
            raise McaptrackError(f"`zones=`: {error}") from None
    return read_zones(as_path(source))


@declared(most_used=("zones",))
def count(
    *,
    zones: Annotated[
        ZonesLike | None,
        Option(
            "After the stages",
            metavar="FILE",
            shown=_BEFORE,
            help="Count visits of zones and crossings of lines, as `mcaptrack zones` does.\n\n"
            "Of a file of GeoJSON, or of its content, also in later runs. By default those that the log was counted "
            "with before, if any.",
        ),
    ] = None,
    force: Force = False,
) -> ZoneWatch:
    """Count zones at the end of a run."""
    from mcaptrack.extensions.zones.counting import ZoneWatch
    from mcaptrack.extensions.zones.visits import ZoneOptions

    wanted = zones_of(zones)
    return ZoneWatch(wanted, options=ZoneOptions() if wanted else None, force=force)


@declared(
    most_used=("zones", "topic", "camera", "output", "force"),
    python_only=("sidecar",),
    heading="Results",
    printed_by="mcaptrack.extensions.zones.command:Zones",
)
def zones(
    log: EachLog,
    *,
    zones: Annotated[ZonesLike | None, Option(_COUNT, metavar="FILE", shown=_BEFORE)] = None,
    topic: Annotated[str | Sequence[str] | None, Option(_COUNT, shown="tracks, re-tracked tracks, truth")] = None,
    margin_m: Annotated[float | None, Option(_COUNT, 0, 100, shown="0.25")] = None,
    max_gap_s: Annotated[float | None, Option(_COUNT, 0, 1e6)] = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> mcaptrack.RunResult:
    """Count visits of zones and crossings of lines by tracks.

    Beside each channel of tracks, such as /camera/retracks/full, go .../zones/visits, .../zones/crossings, and counts
    for each frame in .../zones/counts. `mcaptrack run --zones FILE` does this, too, and later runs count again where
    tracks have changed. `mcaptrack docs zones` says what the file holds.

    With `draw` before the log, a page is written on which zones are drawn over a picture of the scene, in a browser.

    Parameters
    ----------
    zones : path or mapping, optional
        Zones (Polygons) and lines (LineStrings) of GeoJSON, in metres or pixels.

        A file, or its content, with "units" of "metres" or "pixels". By default those that the log was counted with
        before.
    topic : str or sequence of str, optional
        Count these channels of tracks.

        By default /camera/tracks, the re-tracked tracks at the rate of the video, /camera/truth, and those that were
        counted before.
    margin_m : float, optional
        A track changes sides where it is farther than so many metres from an edge: noise there counts once.

        By default 0.25, at most half of what a narrow zone has room for.
    max_gap_s : float, optional
        A track that is not seen for more seconds than this ends its visit; by default 4.
    force : bool, default False
        Count again also what is up to date, and overwrite the output file if it exists.

    Returns
    -------
    RunResult
        What was made; ``zones`` has the totals by the topic of the tracks.

    Raises
    ------
    McaptrackError
        If the log or the zones cannot be read, if there are no tracks, or none with positions in the units of a zone.

    Examples
    --------
    On the command line:

        mcaptrack zones log.mcap --zones zones.geojson

        mcaptrack zones draw log.mcap

    >>> import mcaptrack
    >>> square = [[-2, -2], [2, -2], [2, 2], [-2, 2], [-2, -2]]
    >>> geometry = {"type": "Polygon", "coordinates": [square], "units": "metres"}
    >>> result = mcaptrack.zones("log.mcap", zones=geometry)
    >>> [total.zone for total in result.zones["/camera/tracks"]]
    ['zone 1']

    """
    from mcaptrack.api.running import Where, work
    from mcaptrack.extensions.zones.counting import ZoneWatch, counted_zones
    from mcaptrack.extensions.zones.visits import ZoneOptions

    wanted = zones_of(zones)
    limits = {"margin_m": margin_m, "max_gap_s": max_gap_s}
    changed = {name: value for name, value in limits.items() if value is not None}
    options = ZoneOptions(**changed) if changed or zones is not None else None

    def plan(opened: logs.Log, prefix: str, *_: object) -> list[pipeline.Job]:
        if not wanted and not counted_zones(opened, prefix):
            raise McaptrackError(f"{opened.path} was not counted yet; give a file of GeoJSON with `zones=`")
        return []

    watch = ZoneWatch(wanted, names_of(topic), options, force)
    return work(Where(log, camera, None, output, sidecar, force), plan, progress, finishing=(watch,), views=True)


@declared()
def draw_zones(
    log: PathLike,
    *,
    camera: Camera = None,
    output: Output = None,
    force: Force = False,
) -> Path:
    """Write a page on which zones and lines are drawn in a browser, over a picture of the scene.

    The page needs no other file and no network. It downloads the zones as GeoJSON, in pixels of the picture; or in
    metres where the log has no pictures, over the places of its tracks.

    Parameters
    ----------
    log : path
        The log.
    output : path, optional
        Write to this file; by default LOG.zones.html beside the log.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    McaptrackError
        If the log cannot be read, or has neither pictures nor tracks.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.draw_zones("log.mcap").name
    'log.zones.html'

    """
    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.extensions.zones.page import zones_page

    path = log_location(log)
    page = optional_path(output) or local_name(path, _PAGE)
    if page.suffix.lower() not in (".html", ".htm"):
        raise McaptrackError(f"{page} is not a name for a page; give one that ends with .html")
    refuse_overwrite(page, force)
    with logs.read(path) as opened:
        prefix = pipeline.find_camera(opened, camera)
        content = zones_page(opened, prefix, f"{path.stem}.geojson")
    publish_bytes(page, content.encode())
    return page
