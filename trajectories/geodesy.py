"""Geodetic positions on the WGS-84 ellipsoid as metres east, north and up of an origin."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EQUATOR, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS-84 ellipsoid: semi-major axis, m, and flattening."""


def earth_centred(latitude: Array, longitude: Array, height: Array) -> Array:
    """Earth-centred coordinates (n, 3), m, of WGS-84 latitude, longitude (deg) and height (m)."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    square = FLATTENING * (2.0 - FLATTENING)  # e^2
    normal = EQUATOR / np.sqrt(1.0 - square * np.sin(phi) ** 2)  # N(phi)
    return np.column_stack(
        [
            (normal + height) * np.cos(phi) * np.cos(lam),
            (normal + height) * np.cos(phi) * np.sin(lam),
            ((1.0 - square) * normal + height) * np.sin(phi),
        ]
    )


def east_north_up(
    latitude: Array, longitude: Array, height: Array, origin: tuple[float, float, float]
) -> Array:
    """Coordinates (n, 3), m, in the plane that touches the ellipsoid at an origin (deg, deg, m)."""
    offset = earth_centred(latitude, longitude, height)
    offset = offset - earth_centred(*(np.array([value]) for value in origin))
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    turned: Array = offset @ axes.T
    return turned
