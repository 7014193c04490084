"""Geodetic positions on the WGS-84 ellipsoid as metres east, north and up of an origin."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EQUATOR, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS-84 ellipsoid: semi-major axis, m, and flattening."""
LATITUDE_ITERATIONS = 8
"""Each leaves e^2 = 0.0067 of the last one's error: to rounding for points near the ground."""


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


def geodetic(points: Array, origin: tuple[float, float, float]) -> tuple[Array, Array, Array]:
    """Latitude, longitude (deg) and height (m), each (n,): the inverse of `east_north_up`.

    `points` are (n, 3) m east, north and up of an origin (deg, deg, m), within some 1000 km of it.
    """
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    at = points @ axes + earth_centred(*(np.array([value]) for value in origin))
    square = FLATTENING * (2.0 - FLATTENING)  # e^2
    across = np.hypot(at[:, 0], at[:, 1])
    latitude = np.arctan2(at[:, 2], across * (1.0 - square))
    for _ in range(LATITUDE_ITERATIONS):
        normal = EQUATOR / np.sqrt(1.0 - square * np.sin(latitude) ** 2)  # N(phi)
        latitude = np.arctan2(at[:, 2] + square * normal * np.sin(latitude), across)
    normal = EQUATOR / np.sqrt(1.0 - square * np.sin(latitude) ** 2)
    # Without a division by cos(phi) or sin(phi), which vanish at the poles and the equator.
    height = (
        across * np.cos(latitude) + at[:, 2] * np.sin(latitude)
        - EQUATOR**2 / normal
    )  # fmt: skip
    return np.degrees(latitude), np.degrees(np.arctan2(at[:, 1], at[:, 0])), height
