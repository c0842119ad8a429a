"""Kept GNSS fixes against the anchor of their map: the sample's fixes scatter by 0.8 m."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapping.frames.kept_fixes import contradiction_of_fixes
from visloc.archive import Anchor, Geodetic, Map, MapStore
from visloc.kapture import read_dataset

_NORTH_OF_EQUATOR_M = 111_000.0  # metres of a degree of latitude


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


@pytest.fixture(scope="module")
def anchor(sample: Path) -> Anchor:
    """The room, a few metres wide, where its first fix is."""
    fix = read_dataset(sample / "mapping").gnss[0]
    geodetic = Geodetic(latitude_deg=fix.y, longitude_deg=fix.x, altitude_m=fix.z)
    return Anchor(kind="correspondences", images=0, geodetic=geodetic)


def moved(anchor: Anchor, metres: float = 0.0, up: float = 0.0) -> Anchor:
    geodetic = anchor.geodetic
    assert geodetic is not None
    change = {
        "latitude_deg": geodetic.latitude_deg + metres / _NORTH_OF_EQUATOR_M,
        "altitude_m": geodetic.altitude_m + up,
    }
    return anchor.model_copy(update={"geodetic": geodetic.model_copy(update=change)})


def test_an_anchor_that_agrees_with_the_kept_fixes_is_not_doubted(
    room: Map, anchor: Anchor
) -> None:
    assert contradiction_of_fixes(room, anchor) is None
    # Receivers state heights above the sea or the ellipsoid.
    assert contradiction_of_fixes(room, moved(anchor, up=45.0)) is None


def test_an_anchor_that_the_kept_fixes_contradict_is_told(room: Map, anchor: Anchor) -> None:
    told = contradiction_of_fixes(room, moved(anchor, 600.0))
    assert told is not None
    assert "photos lie " in told


def test_an_anchor_that_states_a_large_error_is_not_contradicted(room: Map, anchor: Anchor) -> None:
    vague = moved(anchor, 600.0).model_copy(update={"rms": 200.0})
    assert contradiction_of_fixes(room, vague) is None
