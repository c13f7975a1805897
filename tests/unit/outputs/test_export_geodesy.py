"""From the scene's frame to WGS 84 and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockopt import Origin
from flockopt.outputs.devices.geodesy import ECCENTRICITY_2, RADIUS_M, geographic, local

DELFT = Origin(51.9990, 4.3735, 3.0)


@pytest.mark.parametrize(
    "origin", [DELFT, Origin(-33.9, 151.2, 60.0, 2.1), Origin(0, -180, 0), Origin(89.9, 10, 5, -0.4), Origin(-90, 0, 0)]
)
@pytest.mark.parametrize("place", [(0, 0, 0), (500.0, -300.0, 35.0), (-4000.0, 9000.0, 1000.0)])
def test_there_and_back(origin, place):
    np.testing.assert_allclose(local(origin, *geographic(origin, place)), place, atol=2e-6)


def test_the_origin_is_where_it_says():
    assert geographic(DELFT, (0.0, 0.0, 0.0)) == pytest.approx((DELFT.latitude, DELFT.longitude, DELFT.altitude), abs=1e-9)
    assert geographic(DELFT, (0.0, 0.0, 12.5))[2] == pytest.approx(15.5, abs=1e-8)


def test_on_the_equator_in_closed_form():
    latitude, longitude, altitude = geographic(Origin(0, 20, 0), (1000.0, 0.0, 0.0))
    assert latitude == pytest.approx(0.0, abs=1e-12)
    assert longitude == pytest.approx(20 + math.degrees(math.atan2(1000.0, RADIUS_M)), abs=1e-12)
    assert altitude == pytest.approx(math.hypot(1000.0, RADIUS_M) - RADIUS_M, abs=1e-6)


def test_short_ways_follow_the_radii_of_curvature():
    """A metre north is 1 / M radians of latitude, a metre east 1 / (N cos latitude) of longitude."""
    sin_2 = math.sin(math.radians(DELFT.latitude)) ** 2
    across = RADIUS_M / math.sqrt(1 - ECCENTRICITY_2 * sin_2) + DELFT.altitude
    along = RADIUS_M * (1 - ECCENTRICITY_2) / (1 - ECCENTRICITY_2 * sin_2) ** 1.5 + DELFT.altitude
    north, east = geographic(DELFT, (0.0, 1.0, 0.0)), geographic(DELFT, (1.0, 0.0, 0.0))
    assert math.radians(north[0] - DELFT.latitude) * along == pytest.approx(1.0, abs=1e-6)
    assert math.radians(east[1] - DELFT.longitude) * across * math.cos(math.radians(DELFT.latitude)) == pytest.approx(
        1.0, abs=1e-6
    )
    assert north[1] == pytest.approx(DELFT.longitude, abs=1e-12)


def test_the_heading_turns_clockwise_from_north():
    """With a heading of a quarter turn the y axis points east and the x axis south."""
    turned = Origin(51.9990, 4.3735, 3.0, math.pi / 2)
    assert geographic(turned, (0.0, 80.0, 0.0)) == pytest.approx(geographic(DELFT, (80.0, 0.0, 0.0)), abs=1e-9)
    assert geographic(turned, (80.0, 0.0, 0.0)) == pytest.approx(geographic(DELFT, (0.0, -80.0, 0.0)), abs=1e-9)


def test_the_level_surface_curves_away():
    assert geographic(DELFT, (0.0, 1000.0, 0.0))[2] - DELFT.altitude == pytest.approx(1e6 / (2 * 6.38e6), abs=1e-3)
