"""Convert WGS-84 positions to metres east, north and up of an origin, and back."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# WGS-84 ellipsoid: semi-major axis (m), flattening, and the square of the eccentricity.
EQUATOR, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
LATITUDE_ITERATIONS = 8
"""Each leaves e^2 = 0.0067 of the error: enough to reach rounding for points near the ground."""


def earth_centred(latitude: Array, longitude: Array, height: Array) -> Array:
    """Earth-centred coordinates (n, 3), m, of WGS-84 latitude, longitude (deg) and height (m)."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    normal = _normal_radius(phi)
    return np.column_stack(
        [
            (normal + height) * np.cos(phi) * np.cos(lam),
            (normal + height) * np.cos(phi) * np.sin(lam),
            ((1.0 - ECCENTRICITY_SQUARED) * normal + height) * np.sin(phi),
        ]
    )


def _normal_radius(phi: Array) -> Array:
    """Radius of curvature N (m) of the ellipsoid across the meridian, at latitudes phi (rad)."""
    radius: Array = EQUATOR / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    return radius


def _plane(origin: tuple[float, float, float]) -> tuple[Array, Array]:
    """Earth-centred place of an origin (1, 3), m, and directions east, north, up there (3, 3)."""
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    return earth_centred(*(np.array([value]) for value in origin)), axes


def east_north_up(
    latitude: Array, longitude: Array, height: Array, origin: tuple[float, float, float]
) -> Array:
    """Coordinates (n, 3), m, in the plane that touches the ellipsoid at an origin (deg, deg, m)."""
    place, axes = _plane(origin)
    turned: Array = (earth_centred(latitude, longitude, height) - place) @ axes.T
    return turned


def geodetic(points: Array, origin: tuple[float, float, float]) -> tuple[Array, Array, Array]:
    """Latitude, longitude (deg) and height (m), each (n,): the inverse of `east_north_up`.

    `points` are (n, 3) m east, north and up of an origin (deg, deg, m), within some 1000 km of it.
    """
    place, axes = _plane(origin)
    at = points @ axes + place
    across = np.hypot(at[:, 0], at[:, 1])
    latitude = np.arctan2(at[:, 2], across * (1.0 - ECCENTRICITY_SQUARED))
    for _ in range(LATITUDE_ITERATIONS):
        lift = ECCENTRICITY_SQUARED * _normal_radius(latitude) * np.sin(latitude)
        latitude = np.arctan2(at[:, 2] + lift, across)
    # Without a division by cos(phi) or sin(phi), which vanish at the poles and the equator.
    height = across * np.cos(latitude) + at[:, 2] * np.sin(latitude)
    height = height - EQUATOR**2 / _normal_radius(latitude)
    return np.degrees(latitude), np.degrees(np.arctan2(at[:, 1], at[:, 0])), height
