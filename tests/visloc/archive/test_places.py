from __future__ import annotations

import numpy as np

from visloc.archive import Geodetic
from visloc.archive.places import enu_of, origin_of, similarity_on_earth
from visloc.geodesy import ecef_from_geodetic, geodetic_from_enu

HALF = np.sqrt(0.5)
A = Geodetic(
    latitude_deg=48.0,
    longitude_deg=8.0,
    altitude_m=400.0,
    scale=0.5,
    rotation_wxyz=(HALF, 0.0, 0.0, HALF),
    translation=(3.0, -2.0, 1.0),
)
B = Geodetic(latitude_deg=48.02, longitude_deg=8.03, altitude_m=450.0, scale=2.0)


def on_earth(points: np.ndarray, geodetic: Geodetic) -> np.ndarray:
    return ecef_from_geodetic(geodetic_from_enu(enu_of(points, geodetic), origin_of(geodetic)))


def test_worlds_are_tied_to_each_other_on_earth() -> None:
    # Kilometres apart, where east, north and up of both anchors differ by the Earth's curvature.
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))

    a_from_b = similarity_on_earth(A, B)

    assert np.allclose(on_earth(a_from_b.apply(points), A), on_earth(points, B), atol=1e-6)
    assert np.allclose(similarity_on_earth(B, A).apply(a_from_b.apply(points)), points, atol=1e-6)
    assert a_from_b.scale == 4.0
