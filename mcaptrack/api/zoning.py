"""Count visits of zones and crossings of lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.checked import checked
from mcaptrack.api.common import as_path, log_location, names_of, optional_path
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.running import RunResult, Where, work
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.zones import ZoneOptions
from mcaptrack.files import publish_bytes, refuse_overwrite
from mcaptrack.geometry.zones import Zone
from mcaptrack.location import local_name
from mcaptrack.pipeline import Job, ZoneWatch
from mcaptrack.sources.zones import parse_zones, read_zones
from mcaptrack.viewing.zones_page import zones_page

_PAGE: Final = ".zones.html"

#: Zones and lines: a file of GeoJSON, or its content.
ZonesLike = PathLike | Mapping[str, Any]


def zones_of(given: ZonesLike | None) -> tuple[Zone, ...]:
    """Return the zones of a file, or of GeoJSON; none of None. Raises McaptrackError if they can't be read."""
    if given is None:
        return ()
    if isinstance(given, Mapping):
        try:
            return parse_zones(dict(given))
        except McaptrackError as error:
            raise McaptrackError(f"`zones=`: {error}") from None
    return read_zones(as_path(given))


@checked(margin_m=(0, 100), max_gap_s=(0, 1e6))
def zones(
    log: PathLike,
    *,
    zones: ZonesLike | None = None,
    topic: str | Sequence[str] | None = None,
    margin_m: float | None = None,
    max_gap_s: float | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> RunResult:
    """Count visits of zones and crossings of lines by the tracks of a log, and write them into the log.

    Parameters
    ----------
    log : path
        The log.
    zones : path or mapping, optional
        A file of GeoJSON, or its content: Polygons are zones, LineStrings are lines, in "units" of "metres" or
        "pixels". By default those that the log was counted with before.
    topic : str or sequence of str, optional
        Count these channels of tracks. By default /camera/tracks, the re-tracked tracks at the rate of the video,
        /camera/truth, and those that were counted before.
    margin_m : float, optional
        A track changes sides where it is farther than this from an edge, so that noise at the edge counts once; by
        default 0.25, at most half of what a narrow zone has room for.
    max_gap_s : float, optional
        A track that is not seen for longer ends its visit; by default 4.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    force : bool, default False
        Count again also what is up to date, and overwrite ``output`` if it exists.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

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
    >>> import mcaptrack
    >>> square = [[-2, -2], [2, -2], [2, 2], [-2, 2], [-2, -2]]
    >>> geometry = {"type": "Polygon", "coordinates": [square], "units": "metres"}
    >>> result = mcaptrack.zones("log.mcap", zones=geometry)
    >>> [total.zone for total in result.zones["/camera/tracks"]]
    ['zone 1']

    """
    found, usual = zones_of(zones), ZoneOptions()
    options = None
    if margin_m is not None or max_gap_s is not None:
        given = {"margin_m": margin_m, "max_gap_s": max_gap_s}
        options = ZoneOptions(**{name: getattr(usual, name) if one is None else one for name, one in given.items()})
    elif zones is not None:
        options = usual

    def plan(opened: logs.Log, prefix: str, *_: object) -> list[Job]:
        if not found and not pipeline.counted_zones(opened, prefix):
            raise McaptrackError(f"{opened.path} was not counted yet; give a file of GeoJSON with `zones=`")
        return []

    watch = ZoneWatch(found, names_of(topic), options, force)
    return work(Where(log, camera, None, output, sidecar, force), plan, None, progress, None, zones=watch)


@checked()
def draw_zones(
    log: PathLike,
    *,
    camera: str | None = None,
    output: PathLike | None = None,
    force: bool = False,
) -> Path:
    """Write a page on which zones and lines are drawn in a browser, over a picture of the scene.

    The page needs no other file and no network. It downloads the zones as GeoJSON, in pixels of the picture; or in
    metres where the log has no pictures, over the places of its tracks.

    Parameters
    ----------
    log : path
        The log.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file; by default LOG.zones.html beside the log.
    force : bool, default False
        Overwrite the page if it exists.

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
