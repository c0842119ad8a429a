from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from mapping.frames.anchor import GNSS_ERROR_M, align_positions
from mapping.frames.anchor_error import place_error
from visloc.archive import Anchor, Geodetic
from visloc.archive.places import enu_of
from visloc.geometry import Pose, Similarity
from visloc.geopose import earth_covariance

LEVEL, UP = 0.8, 1.6
DRAWS = 200
# Where photos were taken, metres, and places that are asked for: among them, and 60 m outside.
TAKEN = np.random.default_rng(0).uniform([-40, -30, 0], [40, 30, 12], (25, 3))
ASKED = np.array([[5.0, -3.0, 4.0], [95.0, 20.0, 30.0]])
WORLD_FROM_ENU = Similarity(
    0.21, Rotation.from_euler("xyz", [0.3, -0.9, 1.8]).as_matrix(), np.array([3.0, -8.0, 1.0])
)


def placed(fixes: NDArray[np.float64], *, fits_scale: bool = True) -> Geodetic:
    """The place that a fit to fixes (n, 3) gives the world, with its error."""
    found = align_positions(WORLD_FROM_ENU.apply(TAKEN), fixes, GNSS_ERROR_M)
    assert not isinstance(found, str)
    similarity = found.similarity
    assert found.agrees.all()
    pose = Pose(similarity.rotation, similarity.translation)
    geodetic = Geodetic.model_validate(
        {
            "latitude_deg": 48.0,
            "longitude_deg": 11.0,
            "altitude_m": 500.0,
            "scale": similarity.scale,
            "rotation_wxyz": pose.rotation_wxyz.tolist(),
            "translation": pose.translation.tolist(),
        }
    )
    error = place_error(geodetic, WORLD_FROM_ENU.apply(TAKEN), fixes, fits_scale=fits_scale)
    return geodetic.model_copy(update={"error": error})


def stated(geodetic: Geodetic, asked: NDArray[np.float64]) -> NDArray[np.float64]:
    camera = Pose(np.eye(3), -asked)  # exactly known in the map
    anchor = Anchor(kind="gnss", images=len(TAKEN), geodetic=geodetic)
    return earth_covariance(camera, np.zeros((6, 6)), anchor)


@pytest.mark.parametrize("is_shared", [False, True])
def test_positions_on_earth_lie_within_what_is_stated(is_shared: bool) -> None:
    """Nineteen in twenty, over draws of fixes whose errors are independent, or also shared."""
    rng = np.random.default_rng(1)
    sigma = np.array([LEVEL, LEVEL, UP])
    inside = np.zeros(len(ASKED))
    for _ in range(DRAWS):
        shift = rng.normal(size=3) * sigma if is_shared else np.zeros(3)
        geodetic = placed(TAKEN + shift + rng.normal(size=TAKEN.shape) * sigma)
        error = geodetic.error
        assert error is not None
        for row, place in enumerate(ASKED):
            world = WORLD_FROM_ENU.apply(place[None])
            off = enu_of(world, geodetic)[0] - place
            covariance = stated(geodetic, world[0])
            if not is_shared:
                covariance = covariance - np.diag([error.level**2, error.level**2, error.up**2])
            inside[row] += off @ np.linalg.solve(covariance, off) <= chdtri(3, 0.05)
    # 0.95, three deviations of a share of 200 off at the most.
    assert (inside / DRAWS > 0.9).all(), inside
    assert (inside / DRAWS < 0.995).all(), inside


def test_the_scatter_of_fixes_is_found_level_and_up() -> None:
    rng = np.random.default_rng(2)
    errors = [
        placed(TAKEN + rng.normal(size=TAKEN.shape) * [LEVEL, LEVEL, UP]).error for _ in range(50)
    ]
    assert np.sqrt(np.mean([e.level**2 for e in errors if e])) == pytest.approx(LEVEL, rel=0.08)
    assert np.sqrt(np.mean([e.up**2 for e in errors if e])) == pytest.approx(UP, rel=0.1)


def test_a_scale_that_was_not_fitted_has_no_error() -> None:
    fixes = TAKEN + np.random.default_rng(3).normal(size=TAKEN.shape)
    fitted, kept = placed(fixes).error, placed(fixes, fits_scale=False).error
    assert fitted is not None
    assert kept is not None
    assert fitted.covariance[6][6] > 0
    assert np.array(kept.covariance)[6].tolist() == [0.0] * 7


def test_the_same_fix_for_several_photos_counts_once() -> None:
    """Two photos of a rig at each fix tell no more than one."""
    geodetic = Geodetic(latitude_deg=0, longitude_deg=0, altitude_m=0)
    fixes = TAKEN + np.random.default_rng(4).normal(size=TAKEN.shape)
    once = place_error(geodetic, TAKEN, fixes)
    twice = place_error(geodetic, np.repeat(TAKEN, 2, axis=0), np.repeat(fixes, 2, axis=0))
    assert once is not None
    assert twice is not None
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-6, atol=1e-12)
    assert (twice.level, twice.up) == pytest.approx((once.level, once.up))


def test_two_fixes_leave_too_little_to_tell() -> None:
    geodetic = Geodetic(latitude_deg=0, longitude_deg=0, altitude_m=0)
    fixes = np.repeat(TAKEN[:2], 3, axis=0)
    assert place_error(geodetic, fixes + 0.1, fixes) is None
