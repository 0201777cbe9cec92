"""Places on the Earth, on the ellipsoid WGS 84, and directions there."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.names import AXES
from rigidfleet.typing import Floats

#: Latitude, longitude [deg] and height above mean sea level [m] of a place on the Earth.
Geodetic = tuple[float, float, float]
#: Equatorial radius [m] and square of the eccentricity of WGS 84.
_RADIUS, _ECCENTRICITY = 6_378_137.0, 6.694_379_990_14e-3


def turn_to_enu(vectors: ArrayLike, axes: str) -> Floats:
    """Vectors (..., 3) along three directions, such as "ned", in east, north, up.

    What is not finite along one axis stays there. From "ned" and back is the same.
    """
    along, signs = zip(*(AXES[letter] for letter in axes), strict=True)
    return np.multiply(vectors, signs)[..., np.argsort(along)] + 0.0  # no -0 of what lies at 0


def enu_of(geodetic: ArrayLike, origin: Geodetic) -> Floats:
    """Places (K, 3) of latitude, longitude [deg] and height [m], in east, north, up about an origin [m]."""
    lat, lon, height = np.vstack([geodetic, origin]).T
    lat, lon = np.radians(lat), np.radians(lon)
    n = _RADIUS / np.sqrt(1.0 - _ECCENTRICITY * np.sin(lat) ** 2)
    flat, up = (n + height) * np.cos(lat), ((1.0 - _ECCENTRICITY) * n + height) * np.sin(lat)
    x, y, z = (q[:-1] - q[-1] for q in (flat * np.cos(lon), flat * np.sin(lon), up))
    (sin, cos), (sine, cosine) = ((np.sin(q[-1]), np.cos(q[-1])) for q in (lat, lon))
    out = cosine * x + sine * y
    return np.stack([cosine * y - sine * x, cos * z - sin * out, sin * z + cos * out], axis=1)
