"""From a scene's frame to WGS 84: its plane z = 0 touches the level surface at the origin.

A place x, y, z has east, north and up from the origin's heading; rotated to the Earth's axes and added to the origin's own
position there, it has latitude, longitude and altitude by Bowring's formula ("Transformation from spatial to geographical
coordinates", 1976), whose error within 10 km of the ground is below a nanometre. docs/export.md has the formulas.
"""

from __future__ import annotations

import math

import numpy as np

from flockopt.records.arrays import FloatArray
from flockopt.scene import Origin, Point

__all__ = ["geographic", "local"]

#: The ellipsoid: its equatorial radius and flattening.
RADIUS_M, FLATTENING = 6378137.0, 1 / 298.257223563
POLAR_RADIUS_M = RADIUS_M * (1 - FLATTENING)
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)


def geographic(origin: Origin, place: Point) -> Point:
    """Latitude and longitude in degrees and altitude in metres of a place in the scene."""
    x, y, z = _from_origin(origin) + _axes(origin) @ np.asarray(place, dtype=np.float64)
    flat = math.hypot(x, y)
    parametric = math.atan2(z * RADIUS_M, flat * POLAR_RADIUS_M)
    second_2 = ECCENTRICITY_2 / (1 - ECCENTRICITY_2)
    latitude = math.atan2(
        z + second_2 * POLAR_RADIUS_M * math.sin(parametric) ** 3, flat - ECCENTRICITY_2 * RADIUS_M * math.cos(parametric) ** 3
    )
    # along the normal: the two terms are well conditioned where the other is not
    normal = RADIUS_M / math.sqrt(1 - ECCENTRICITY_2 * math.sin(latitude) ** 2)
    altitude = flat * math.cos(latitude) + z * math.sin(latitude) - RADIUS_M**2 / normal
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), altitude


def local(origin: Origin, latitude: float, longitude: float, altitude: float) -> Point:
    """Where in the scene a geographic place is: the inverse of `geographic`."""
    there = _from_earth(math.radians(latitude), math.radians(longitude), altitude)
    x, y, z = (_axes(origin).T @ (there - _from_origin(origin))).tolist()
    return x, y, z


def _from_origin(origin: Origin) -> FloatArray:
    return _from_earth(math.radians(origin.latitude), math.radians(origin.longitude), origin.altitude)


def _from_earth(latitude: float, longitude: float, altitude: float) -> FloatArray:
    """Earth-centred, earth-fixed coordinates (3,) m."""
    normal = RADIUS_M / math.sqrt(1 - ECCENTRICITY_2 * math.sin(latitude) ** 2)
    flat = (normal + altitude) * math.cos(latitude)
    up = (normal * (1 - ECCENTRICITY_2) + altitude) * math.sin(latitude)
    return np.array([flat * math.cos(longitude), flat * math.sin(longitude), up])


def _axes(origin: Origin) -> FloatArray:
    """The scene's axes as columns (3, 3), earth-centred."""
    latitude, longitude = math.radians(origin.latitude), math.radians(origin.longitude)
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
    east = np.array([-sin_lon, cos_lon, 0.0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    cos, sin = math.cos(origin.heading), math.sin(origin.heading)
    return np.column_stack([cos * east - sin * north, sin * east + cos * north, up])
