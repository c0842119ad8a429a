from __future__ import annotations

import numpy as np

from visloc.geodesy import (
    ecef_from_geodetic,
    enu_from_geodetic,
    geodetic_from_ecef,
    geodetic_from_enu,
)


def test_poles_and_equator_lie_where_the_ellipsoid_has_them() -> None:
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 10.0], [90.0, 0.0, 0.0], [-90.0, 45.0, 5.0]])
    expected = [
        [6378137.0, 0, 0],
        [0, 6378147.0, 0],
        [0, 0, 6356752.314245],
        [0, 0, -6356757.314245],
    ]
    np.testing.assert_allclose(ecef_from_geodetic(positions), expected, atol=1e-6)


def test_east_north_and_up_are_metres_from_the_origin() -> None:
    origin = np.array([48.2741, 2.6973, 90.0])
    # Worked with the same ellipsoid elsewhere: 10 m east, 20 m north, 1.6 m up.
    position = np.array([[48.274279860, 2.697434716, 91.600039]])
    np.testing.assert_allclose(enu_from_geodetic(position, origin), [[10, 20, 1.6]], atol=1e-3)


def test_the_origin_is_the_origin() -> None:
    origin = np.array([-33.9, 151.2, 12.0])
    np.testing.assert_allclose(enu_from_geodetic(origin[None], origin), np.zeros((1, 3)), atol=1e-9)


def test_everywhere_on_the_earth_conversions_are_undone_to_micrometres() -> None:
    random = np.random.default_rng(0)
    latitude = np.concatenate([random.uniform(-90, 90, 500), [90.0, -90.0, 0.0]])
    positions = np.column_stack(
        [latitude, random.uniform(-180, 180, 503), random.uniform(-400, 9000, 503)]
    )
    points = ecef_from_geodetic(positions)
    np.testing.assert_allclose(ecef_from_geodetic(geodetic_from_ecef(points)), points, atol=1e-6)

    local = random.uniform(-1e4, 1e4, (100, 3))
    for origin in positions[::50]:
        back = enu_from_geodetic(geodetic_from_enu(local, origin), origin)
        np.testing.assert_allclose(back, local, atol=1e-6)
