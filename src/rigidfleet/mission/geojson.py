"""Polygons of GeoJSON files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from rigidfleet.mission.text import text_error

#: Names of the one system of coordinates that GeoJSON has, as older files write it.
_WGS84 = "CRS84", "EPSG::4326", "EPSG:4326"


def read_geojson(data: bytes, name: str) -> tuple[list[list[list[list[float]]]], list[str]]:
    """The polygons of a GeoJSON file (RFC 7946) as the coordinates of a MultiPolygon, and notes on what was mended.

    Raises
    ------
    MissionError
        It is no GeoJSON, has no polygon, or another system of coordinates.
    """
    notes: list[str] = []
    try:
        root = json.loads(data.decode("utf-8-sig"))
        crs = (root.get("crs") or {}).get("properties", {}).get("name", _WGS84[0])
    except (ValueError, AttributeError, RecursionError):
        raise text_error(name, "is no GeoJSON", "give a file with a polygon") from None
    if not str(crs).endswith(_WGS84):
        remedy = "convert it to longitude and latitude (WGS 84), as GeoJSON asks"
        raise text_error(name, f"has the coordinate reference system {crs!r}", remedy)
    try:
        polygons = [[_mend_ring(ring, notes) for ring in rings] for rings in _polygons(root, notes)]
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError):
        remedy = "give polygons as lists of rings of [longitude, latitude], in degrees"
        raise text_error(name, "has coordinates that are no polygons", remedy) from None
    if not all(polygons) or not polygons:
        raise text_error(name, "has no polygon", "give a file with a Polygon or a MultiPolygon")
    return polygons, list(dict.fromkeys(notes))


def _polygons(node: dict[str, Any], notes: list[str]) -> Iterator[list[Any]]:
    """Rings of each polygon in a GeoJSON object."""
    kind = node["type"]
    inner = {"FeatureCollection": "features", "GeometryCollection": "geometries"}.get(kind)
    for part in node[inner] if inner else [node["geometry"]] if kind == "Feature" else ():
        if part is not None:
            yield from _polygons(part, notes)
    if kind in ("Polygon", "MultiPolygon"):
        yield from [node["coordinates"]] if kind == "Polygon" else node["coordinates"]
    elif not inner and kind != "Feature":
        notes.append(f"a {kind} is left out")


def _mend_ring(ring: list[Any], notes: list[str]) -> list[list[float]]:
    """Corners of a ring, each once."""
    if any(type(x) not in (int, float) for corner in ring for x in corner):
        raise TypeError
    corners = [[float(x) for x in corner] for corner in ring]
    if any(len(corner) > 2 for corner in corners):
        notes.append("altitudes are left out: floor and ceiling have the heights")
    flat = [[lon, lat] for lon, lat, *_ in corners]
    if not all(abs(lon) <= 180.0 and abs(lat) <= 90.0 for lon, lat in flat):
        raise ValueError
    if flat[0] != flat[-1]:
        notes.append("a ring that was not closed is closed")
    return [
        corner for corner, after in zip(flat, [*flat[1:], flat[0]], strict=True) if corner != after
    ]
