from __future__ import annotations

import numpy as np
import pytest

from visloc.archive import Anchor, Geodetic
from visloc.archive.places import enu_of, located, origin_of, similarity_on_earth
from visloc.archive.schema import World
from visloc.errors import InvalidInput
from visloc.geodesy import ecef_from_geodetic, geodetic_from_enu
from visloc.priors import NO_PRIORS, GnssPrior, Priors

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


def world_at(geodetic: Geodetic | None, rms: float | None = None) -> World:
    anchor = Anchor(kind="correspondences", images=3, rms=rms, geodetic=geodetic)
    box = {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)}
    return World(metric=True, origin=(0.0, 0.0, 0.0), extent=box, anchor=anchor)


def fix_at(point: np.ndarray, **accuracies: float) -> GnssPrior:
    """The fix of a receiver at a point of world A."""
    ((latitude, longitude, altitude),) = geodetic_from_enu(enu_of(point[None], A), origin_of(A))
    known = altitude if accuracies else None
    return GnssPrior(latitude, longitude, 2.0, known, **accuracies)


def test_a_fix_allows_a_cylinder_about_where_it_lies_in_the_world() -> None:
    # World A is turned by 90 degrees about the vertical, and a unit of it is half a metre.
    place = np.array([1000.0, -400.0, 30.0])
    away = np.array([[0.0, 0, 0], [11.9, 0, 0], [0, -16, 0], [12, 0, 500], [0, 0, 20]])

    fix = located(Priors(gnss=fix_at(place)), world_at(A)).gnss
    assert fix is not None
    # Three times the accuracy of 2 m are 12 units; what is unknown of the height allows any.
    assert fix.beyond(place + away) == pytest.approx([0.0, 0.0, 2.0, 0.0, 0.0], abs=0.01)

    fix = located(Priors(gnss=fix_at(place, vertical_accuracy=1.0)), world_at(A)).gnss
    assert fix is not None
    # Three metres up or down are six units.
    assert fix.beyond(place + away) == pytest.approx([0.0, 0.0, 2.0, 247.0, 7.0], abs=0.01)


def test_the_error_of_the_anchor_adds_to_that_of_the_fix() -> None:
    (fix,) = (located(Priors(gnss=fix_at(np.zeros(3))), world_at(A, rms=3.0)).gnss,)
    assert fix is not None
    assert fix.accuracy == pytest.approx(2.5)  # 2 m, and 3 units of half a metre
    again = located(Priors(gnss=fix), world_at(B)).gnss
    assert again is fix


def test_a_map_that_is_not_on_earth_takes_no_fix() -> None:
    assert located(NO_PRIORS, world_at(None)) is NO_PRIORS
    with pytest.raises(InvalidInput) as caught:
        located(Priors(gnss=fix_at(np.zeros(3))), world_at(None))
    assert (caught.value.code, caught.value.field) == ("priors.gnss", "priors.gnss")
