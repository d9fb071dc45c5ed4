"""A square, a ring and a line, as GeoJSON has them."""

from __future__ import annotations

SQUARE = [[-2.0, 9.0], [2.0, 9.0], [2.0, 13.0], [-2.0, 13.0], [-2.0, 9.0]]
LINE = [[0.0, 5.0], [0.0, 20.0]]
HOLED = [[[-4, 8], [4, 8], [4, 15], [-4, 15], [-4, 8]], [[-1, 10], [1, 10], [1, 12], [-1, 12], [-1, 10]]]


def feature(name: str | None, kind: str, coordinates: object, **own: object) -> dict:
    properties = ({"name": name} if name is not None else {}) | own
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def collection(*features: dict, **top: object) -> dict:
    return {"type": "FeatureCollection", "units": "metres", "features": list(features)} | top


ZONES = collection(
    feature("square", "Polygon", [SQUARE]), feature("ring", "Polygon", HOLED), feature("gate", "LineString", LINE)
)
