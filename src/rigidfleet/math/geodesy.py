"""Places on the Earth: latitude and longitude from local axes, and back, on the ellipsoid of WGS 84.

Source: EPSG Guidance Note 7-2, geographic/geocentric conversion (9602) and topocentric conversion (9836).
"""

from __future__ import annotations

import numpy as np

from rigidfleet.typing import Floats

#: Semi-major axis [m] and flattening of WGS 84.
_A, _F = 6_378_137.0, 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)


def geodetic(local: Floats, origin: Floats) -> Floats:
    """Latitude [rad], longitude [rad] and height [m] (K, 3) of points (K, 3) [m] in axes east, north, up at an origin.

    Latitude is found by iteration, to 1e-12 rad within 100 km of the ground.
    """
    x, y, z = (_geocentric(origin[None])[0] + local @ _axes(origin)).T
    p = np.hypot(x, y)
    latitude = np.arctan2(z, p * (1.0 - _E2))
    for _ in range(5):  # each step gains about two and a half digits
        n = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _E2 * n * np.sin(latitude), p)
    s, c = np.sin(latitude), np.cos(latitude)
    height = p * c + z * s - _A * np.sqrt(1.0 - _E2 * s**2)
    return np.column_stack([latitude, np.arctan2(y, x), height])


def local(places: Floats, origin: Floats) -> Floats:
    """Points (K, 3) [m] in axes east, north, up at an origin, of places (K, 3) [rad, rad, m]."""
    return (_geocentric(places) - _geocentric(origin[None])) @ _axes(origin).T


def _geocentric(places: Floats) -> Floats:
    """Points (K, 3) [m] in Earth-centred axes."""
    latitude, longitude, height = places.T
    n = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    out = (n + height) * np.cos(latitude)
    return np.column_stack(
        [
            out * np.cos(longitude),
            out * np.sin(longitude),
            (n * (1.0 - _E2) + height) * np.sin(latitude),
        ]
    )


def _axes(origin: Floats) -> Floats:
    """East, north and up (3, 3) at a place, as rows in Earth-centred axes."""
    s, c = np.sin(origin[:2]), np.cos(origin[:2])
    return np.array(
        [[-s[1], c[1], 0.0], [-s[0] * c[1], -s[0] * s[1], c[0]], [c[0] * c[1], c[0] * s[1], s[0]]]
    )
