"""Read zones and lines from GeoJSON (RFC 7946) in metres of the ground or in pixels of a picture.

Polygons (and MultiPolygons) are zones, LineStrings are lines. GeoJSON means longitude and latitude, which a log doesn't
have, so that a file has to say what its numbers are: "units": "metres" or "pixels", at the top or for each feature.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.zones.shapes import Shape, Units, Zone, first_crossing
from mcaptrack.files import read_json
from mcaptrack.notices import warn

_UNITS: Final[Mapping[str, Units]] = {
    "metres": "metres", "meters": "metres", "metre": "metres", "meter": "metres", "m": "metres",
    "pixels": "pixels", "pixel": "pixels", "px": "pixels",
}  # fmt: skip
_KINDS: Final = ("Polygon", "MultiPolygon", "LineString")
#: Geometries that are known, and are no zones.
_OTHERS: Final = ("Point", "MultiPoint", "MultiLineString", "GeometryCollection")
_MAX_BYTES: Final = 8 * 2**20
_MAX_ZONES: Final = 500
_MAX_POINTS: Final = 2000
_MAX_NAME: Final = 100
#: Larger coordinates are neither metres of a map nor pixels.
_FARTHEST: Final = 1e8
#: A zone of less area in square metres, or of a shorter line in metres, is taken to be in degrees.
_LEAST_M2, _LEAST_M = 0.01, 0.01


def read_zones(path: Path) -> tuple[Zone, ...]:
    """Read the zones and lines of a file, numbered from 1 in its order.

    Features of other kinds are left out, with a warning. Raises McaptrackError, in one line, for a file that can't be
    read, is no GeoJSON, says no units, or has a polygon that crosses itself.
    """
    try:
        return parse_zones(read_json(path, "GeoJSON", _MAX_BYTES))
    except McaptrackError as error:
        raise McaptrackError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


def parse_zones(content: Any) -> tuple[Zone, ...]:
    """Return the zones and lines of GeoJSON, as ``read_zones``."""
    top = content if isinstance(content, dict) else {}
    kind = top.get("type")
    if kind == "FeatureCollection":
        features = top.get("features")
        if not isinstance(features, list):
            raise McaptrackError("a FeatureCollection needs a list of features")
    elif kind == "Feature":
        features = [top]
    elif kind in (*_KINDS, *_OTHERS):
        features = [{"type": "Feature", "properties": {}, "geometry": top}]
    else:
        content_type = f"an object of type {kind!r:.40}" if kind is not None else f"{_words(content)} without a type"
        raise McaptrackError(
            f"it holds {content_type}, not GeoJSON; a FeatureCollection with Polygons and LineStrings is read"
        )
    zones: list[Zone] = []
    taken = {str(name).strip() for name in map(_given_name, features) if name is not None}
    for place, feature in enumerate(features, start=1):
        zone = _zone(feature, top, place, len(zones) + 1, taken)
        if zone is not None:
            zones.append(zone)
        if len(zones) > _MAX_ZONES:
            raise McaptrackError(f"it holds {len(features)} features; at most {_MAX_ZONES} zones and lines are counted")
    if "crs" in top:
        warn('"crs" is not read: the numbers of zones are taken in the "units" of the file', "left-out")
    if not zones:
        raise McaptrackError("it holds no zones (Polygons) and no lines (LineStrings)")
    names: dict[str, int] = {}
    for zone in zones:
        if zone.name in names:
            raise McaptrackError(
                f"zones {names[zone.name]} and {zone.number} are both called {zone.name}; give each a name of its own"
            )
        names[zone.name] = zone.number
    return tuple(zones)


def _given_name(feature: Any) -> Any:
    """Return what a feature gives as its name; None if it has none."""
    own = feature.get("properties") if isinstance(feature, dict) else None
    return own.get("name", feature.get("id")) if isinstance(own, dict) else None


def _made_name(kind: str, number: int, taken: Collection[str]) -> str:
    """Return a name that no other zone has."""
    names = (f"{kind} {number}{more}" for more in ("", *(f" ({k})" for k in range(2, len(taken) + 3))))
    return next(name for name in names if name not in taken)


def _zone(feature: Any, top: Mapping[str, Any], place: int, number: int, taken: Collection[str]) -> Zone | None:
    """Return the zone of one feature; None for a feature that is no zone. ``taken`` are the names of others."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise McaptrackError(f"feature {place} is {_words(feature)}, not a Feature")
    own = feature.get("properties") or {}
    geometry = feature.get("geometry") or {}
    if not isinstance(own, dict) or not isinstance(geometry, dict):
        raise McaptrackError(f"feature {place} needs objects as its properties and geometry")
    kind = geometry.get("type")
    is_line = kind == "LineString"
    stated = own.get("name", feature.get("id"))
    if stated is not None and not isinstance(stated, str | int | float):
        raise McaptrackError(f"feature {place} has {_words(stated)} as its name; it needs a text")
    name = _made_name("line" if is_line else "zone", number, taken) if stated is None else str(stated).strip()
    called = f"zone {name}" if name and own.get("name") is not None else f"feature {place}"
    if not name or len(name) > _MAX_NAME or not name.isprintable():
        raise McaptrackError(f"feature {place} needs a name of 1 to {_MAX_NAME} printable characters, not {name!r:.60}")
    if kind not in _KINDS:
        if kind is not None and kind not in _OTHERS:
            raise McaptrackError(f"{called} is a {kind!r:.40}; zones are Polygons, and lines are LineStrings")
        how = "; give each line a feature of its own" if kind == "MultiLineString" else ""
        warn(f"{called} is left out: it is a {kind or 'feature without geometry'}, not a Polygon or LineString{how}",
             "left-out")  # fmt: skip
        return None
    units = _units(own, geometry, top, called)
    camera = _camera(own, top, called)
    levels = {"LineString": 1, "Polygon": 2, "MultiPolygon": 3}[kind]
    nested: Any = geometry.get("coordinates")
    parts = nested if levels == 3 else [nested] if levels == 2 else [[nested]]
    flat = tuple(tuple(tuple(_points(ring, called)) for ring in _list(part, called)) for part in _list(parts, called))
    if sum(len(ring) for part in flat for ring in part) > _MAX_POINTS:
        raise McaptrackError(f"{called} has more than {_MAX_POINTS} points; simplify it")
    flat = tuple(tuple(_distinct(ring, is_line) for ring in part) for part in flat)
    zone = Zone(number, name, units, flat, is_line, camera, _classes(own, top, called))
    _check(zone, called)
    return zone


def _units(own: Mapping[str, Any], geometry: Mapping[str, Any], top: Mapping[str, Any], called: str) -> Units:
    for holder in (own, geometry, top):
        for key in ("units", "unit"):
            if key in holder:
                units = _UNITS.get(str(holder[key]).lower())
                if units is None:
                    raise McaptrackError(f"{called} has units {holder[key]!r:.40}; there are metres and pixels")
                return units
    raise McaptrackError(
        f"{called} has no units. Numbers of GeoJSON are longitude and latitude, which a log does not have: add "
        '"units": "metres" (of the ground) or "units": "pixels" (of the picture) to the file'
    )


def _camera(own: Mapping[str, Any], top: Mapping[str, Any], called: str) -> str:
    """Return the camera that a zone names, by its name or by a topic."""
    for holder in (own, top):
        for key in ("camera", "topic"):
            if holder.get(key) is not None:
                if not isinstance(holder[key], str):
                    raise McaptrackError(f"{called} has the {key} {holder[key]!r:.40}; it needs a name")
                return str(holder[key]).strip("/")
    return ""


def _classes(own: Mapping[str, Any], top: Mapping[str, Any], called: str) -> tuple[str, ...]:
    """Return the names of the classes that a zone counts; none for all."""
    stated: Any = next((holder["classes"] for holder in (own, top) if holder.get("classes") is not None), [])
    names = stated if isinstance(stated, list) else [stated]
    if not all(isinstance(name, str) and 0 < len(name) <= _MAX_NAME and name.isprintable() for name in names):
        raise McaptrackError(f"{called} has classes that are no list of names: {stated!r:.60}")
    return tuple(dict.fromkeys(name.strip() for name in names))


def _list(value: Any, called: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise McaptrackError(f"{called} has no coordinates, or coordinates that are not nested as its type needs")
    return value


def _points(ring: Any, called: str) -> Iterator[tuple[float, float]]:
    for point in _list(ring, called):
        if not isinstance(point, list) or not 2 <= len(point) <= 4:  # heights are allowed, and not needed
            raise McaptrackError(f"{called} has {_words(point)} where a point of two numbers is needed")
        x, y = point[:2]
        for value in (x, y):
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _FARTHEST:
                raise McaptrackError(f"{called} has the coordinate {value!r:.30}; it needs numbers up to {_FARTHEST:g}")
        yield float(x), float(y)


def _distinct(ring: Sequence[tuple[float, float]], is_line: bool) -> tuple[tuple[float, float], ...]:
    """Return the points of a ring without repetitions, and without the first one at the end of a closed ring."""
    out = [point for number, point in enumerate(ring) if not number or point != ring[number - 1]]
    return tuple(out[:-1] if not is_line and len(out) > 1 and out[0] == out[-1] else out)


def _check(zone: Zone, called: str) -> None:
    """Raise McaptrackError for a shape without area or length, or with edges that cross."""
    needed = 2 if zone.is_line else 3
    for part in zone.parts:
        for ring in part:
            if len(ring) < needed:
                raise McaptrackError(f"{called} has {len(ring)} different points; it needs {needed}")
    shape = zone.shape()
    if not zone.is_line:
        for rings in shape.parts:
            at = first_crossing(rings)
            if at is not None:
                x, y = (f"{value:.6g}" for value in at)
                raise McaptrackError(f"{called} crosses or touches itself at ({x}, {y}); draw it without")
            for number, hole in enumerate(rings[1:], start=1):
                others = rings[1:number] + rings[number + 1 :]
                depths = [Shape(((ring,),)).depth(hole[:1])[0] for ring in (rings[0], *others)]
                if depths[0] < 0 or any(depth > 0 for depth in depths[1:]):
                    x, y = (f"{value:.6g}" for value in hole[0])
                    where = "outside of its outline" if depths[0] < 0 else "inside another one"
                    raise McaptrackError(f"{called} has a hole {where}, at ({x}, {y})")
    size, least, unit = (shape.length, _LEAST_M, "m") if zone.is_line else (shape.area, _LEAST_M2, "m²")
    if zone.units == "metres" and size < least:
        x, y = shape.box[0]
        degrees = "; are these degrees?" if abs(x) <= 180 and abs(y) <= 90 else ""
        raise McaptrackError(f"{called} at ({x:.6g}, {y:.6g}) is only {size:.2g} {unit} large{degrees}")
    if not np.isfinite(size) or size <= 0:
        raise McaptrackError(f"{called} has no extent")


def zones_to_json(zones: Sequence[Zone]) -> list[dict[str, Any]]:
    """Return zones as values of JSON, for the provenance of channels."""
    return [
        {"name": zone.name, "units": zone.units, "line": zone.is_line, "camera": zone.camera, "parts": zone.parts}
        | ({"classes": list(zone.classes)} if zone.classes else {})
        for zone in zones
    ]


def zones_from_json(values: object) -> tuple[Zone, ...]:
    """Return the zones of a provenance; none if they can't be read."""
    if not isinstance(values, list):
        return ()
    try:
        return tuple(
            Zone(
                number,
                str(value["name"]),
                _UNITS[value["units"]],
                tuple(tuple(tuple((float(x), float(y)) for x, y in ring) for ring in part) for part in value["parts"]),
                bool(value["line"]),
                str(value["camera"]),
                tuple(map(str, value.get("classes", ()))),
            )
            for number, value in enumerate(values, start=1)
        )
    except (TypeError, ValueError, KeyError):
        return ()


def _words(value: object) -> str:
    """Describe a value of JSON."""
    for kind, text in ((dict, "an object"), (list, "a list"), (str, "a text"), (bool, "true or false")):
        if isinstance(value, kind):
            return text
    return "nothing" if value is None else "a number"
