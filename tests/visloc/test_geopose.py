from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import Geodetic
from visloc.archive.places import GeoCircle, circle_of
from visloc.archive.schema import Anchor, Extent, PlaceError, World
from visloc.geodesy import ecef_from_geodetic, enu_from_ecef, geodetic_from_enu
from visloc.geometry import Pose, rotation_angle
from visloc.geopose import accuracy_of, earth_covariance, geopose_of

# Camera axes right, down, forward as columns of world_from_cam, level, looking along a bearing.
ANCHOR = Geodetic(latitude_deg=48.2741, longitude_deg=2.6973, altitude_m=90.0)


def level_camera(bearing_deg: float, center: Any = (0.0, 0.0, 0.0)) -> Pose:
    """cam_from_enu of a level camera that looks along a compass bearing."""
    a = math.radians(bearing_deg)
    right, down = [math.cos(a), -math.sin(a), 0.0], [0.0, 0.0, -1.0]
    forward = [math.sin(a), math.cos(a), 0.0]
    rotation = np.array([right, down, forward])
    return Pose(rotation, -rotation @ np.array(center))


def turn(axis: str, degrees: float) -> NDArray[np.float64]:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = cos
    matrix[first, second], matrix[second, first] = -sin, sin
    return matrix


def body_to_camera(enu_from_body: NDArray[np.float64]) -> Pose:
    """cam_from_enu of a camera at the origin whose body is turned so."""
    body_from_cam = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return Pose((enu_from_body @ body_from_cam).T, np.zeros(3))


def anchored(geodetic: Geodetic, rms: float | None = None) -> Anchor:
    return Anchor(kind="correspondences", images=0, rms=rms, geodetic=geodetic)


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    return Pose.from_quaternion(rng.normal(size=4), np.zeros(3)).rotation


def test_a_camera_that_was_worked_out_by_hand_has_its_geopose() -> None:
    cam_from_world = Pose.from_quaternion(
        [0.6830127, 0.6830127, -0.1830127, 0.1830127], [1.339746, 1.6, -22.320508]
    )
    found = geopose_of(cam_from_world, ANCHOR)
    assert found.latitude == pytest.approx(48.274279860, abs=1e-9)
    assert found.longitude == pytest.approx(2.697434716, abs=1e-9)
    assert found.height == pytest.approx(91.600039, abs=1e-6)
    expected = [0.866026, 0.000001, -0.000001, 0.499999]
    np.testing.assert_allclose(found.quaternion_wxyz, expected, atol=1e-6)
    np.testing.assert_allclose(found.angles_deg, [59.9999, -0.0002, 0.0], atol=1e-4)


@pytest.mark.parametrize(
    ("bearing", "quaternion_wxyz", "yaw"),
    [
        (0, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], 90),
        (90, [1, 0, 0, 0], 0),
        (180, [math.sqrt(0.5), 0, 0, -math.sqrt(0.5)], -90),
        (270, [0, 0, 0, 1], 180),
    ],
)
def test_level_cameras_look_where_their_yaw_says(
    bearing: float, quaternion_wxyz: list[float], yaw: float
) -> None:
    found = geopose_of(level_camera(bearing), ANCHOR)
    assert abs(found.quaternion_wxyz @ quaternion_wxyz) == pytest.approx(1, abs=1e-12)
    assert found.angles_deg == pytest.approx((yaw, 0, 0), abs=1e-9) or (
        yaw == 180 and found.angles_deg == pytest.approx((-yaw, 0, 0), abs=1e-9)
    )
    assert (found.latitude, found.longitude, found.height) == pytest.approx(
        (48.2741, 2.6973, 90.0), abs=1e-9
    )


def test_positive_pitch_looks_down_and_positive_roll_lowers_the_right() -> None:
    down = geopose_of(body_to_camera(turn("y", 10)), ANCHOR)
    assert down.angles_deg == pytest.approx((0, 10, 0), abs=1e-9)
    assert down.enu_from_body[2, 0] == pytest.approx(-math.sin(math.radians(10)))
    rolled = geopose_of(body_to_camera(turn("x", 10)), ANCHOR)
    assert rolled.angles_deg == pytest.approx((0, 0, 10), abs=1e-9)
    assert rolled.enu_from_body[2, 1] == pytest.approx(math.sin(math.radians(10)))  # left goes up


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_looking_straight_down_or_up_has_no_roll_and_the_right_rotation(pitch: float) -> None:
    turned = turn("z", 30) @ turn("y", pitch)
    yaw, found_pitch, roll = geopose_of(body_to_camera(turned), ANCHOR).angles_deg
    assert (found_pitch, roll) == pytest.approx((pitch, 0), abs=1e-6)
    again = turn("z", yaw) @ turn("y", found_pitch) @ turn("x", roll)
    np.testing.assert_allclose(again, turned, atol=1e-7)


def test_angles_and_quaternion_are_the_same_rotation_anywhere() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        geodetic = Geodetic(
            latitude_deg=rng.uniform(-90, 90),
            longitude_deg=rng.uniform(-180, 180),
            altitude_m=rng.uniform(-100, 5000),
        )
        pose = Pose(random_rotation(rng), rng.uniform(-1e4, 1e4, 3))
        found = geopose_of(pose, geodetic)
        yaw, pitch, roll = found.angles_deg
        assert -180 < yaw <= 180
        assert -90 <= pitch <= 90
        assert -180 < roll <= 180
        again = turn("z", yaw) @ turn("y", pitch) @ turn("x", roll)
        np.testing.assert_allclose(again, found.enu_from_body, atol=1e-9)
        w, *_ = found.quaternion_wxyz
        assert w >= 0
        turned = Pose.from_quaternion(found.quaternion_wxyz, np.zeros(3)).rotation
        np.testing.assert_allclose(turned, found.enu_from_body, atol=1e-9)


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(0, 0), (90, 0), (-90, 135), (12, 180), (12, -180), (-33.9, 151.2)]
)
def test_the_direction_on_earth_is_that_in_the_map_wherever_it_lies(
    latitude: float, longitude: float
) -> None:
    """Checked in the Earth's own frame, by a point that the camera looks at."""
    rng = np.random.default_rng(7)
    rotation = random_rotation(rng)
    quaternion = Pose(rotation, np.zeros(3)).rotation_wxyz.tolist()
    geodetic = Geodetic(
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=50,
        scale=2.5,
        rotation_wxyz=tuple(quaternion),
        translation=(100.0, -200.0, 30.0),
    )
    origin = np.array([latitude, longitude, 50.0])

    def on_earth(points: NDArray[np.float64]) -> NDArray[np.float64]:
        local = 2.5 * points @ rotation.T + [100.0, -200.0, 30.0]
        return ecef_from_geodetic(geodetic_from_enu(local, origin))

    cam_from_world = Pose(random_rotation(rng), rng.uniform(-5000, 5000, 3))
    center = cam_from_world.center
    ahead = center + cam_from_world.rotation[2] * 4.0  # 10 m on Earth
    found = geopose_of(cam_from_world, geodetic)
    here = np.array([found.latitude, found.longitude, found.height])
    np.testing.assert_allclose(
        ecef_from_geodetic(here[None])[0], on_earth(center[None])[0], atol=1e-6
    )
    seen = on_earth(np.array([center, ahead]))
    direction = enu_from_ecef(here) @ (seen[1] - seen[0])
    np.testing.assert_allclose(direction, 10.0 * found.enu_from_body[:, 0], atol=1e-5)


def test_far_from_the_anchor_east_is_east_there() -> None:
    """10 km east at 48 degrees north, the tangent plane is 7.8 m too high and turned 0.135 deg."""
    geodetic = Geodetic(latitude_deg=48, longitude_deg=2, altitude_m=0)
    found = geopose_of(level_camera(90, (10_000.0, 0.0, 0.0)), geodetic)
    assert found.height == pytest.approx(7.8, abs=0.1)
    assert math.degrees(rotation_angle(found.enu_from_body)) == pytest.approx(0.135, abs=0.001)


def test_accuracy_is_the_mean_of_the_deviations_in_metres_and_degrees() -> None:
    sigma = np.array([0.002, 0.004, 0.006, 0.1, 0.1, 0.1])
    identity = Pose.identity()
    found = accuracy_of(identity, np.diag(sigma**2), anchored(ANCHOR))
    assert found.position == pytest.approx(0.1)
    assert found.orientation == pytest.approx(math.degrees(0.004))
    scaled = ANCHOR.model_copy(update={"scale": 3.0})
    assert accuracy_of(identity, np.diag(sigma**2), anchored(scaled)).position == pytest.approx(0.3)
    # 3 m off in all, so 1.73 m along each axis.
    with_alignment = accuracy_of(identity, np.diag(sigma**2), anchored(ANCHOR, 3.0))
    assert with_alignment.position == pytest.approx(math.hypot(0.1, math.sqrt(3)))


def test_accuracy_does_not_depend_on_where_the_worlds_origin_is() -> None:
    """An exact position covariance, told for a camera a kilometre away."""
    rotation = random_rotation(np.random.default_rng(5))
    center = np.array([1000.0, 2000.0, 3.0])
    translation = -rotation @ center
    # The camera turns about its centre by 0.01 rad and moves 5 cm: w, then t = -R c moves too.
    jacobian = np.eye(6)
    x, y, z = translation
    jacobian[3:, :3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    about_center = np.diag([1e-4] * 3 + [0.0025] * 3)
    covariance = jacobian @ about_center @ jacobian.T
    found = accuracy_of(Pose(rotation, translation), covariance, anchored(ANCHOR))
    assert found.position == pytest.approx(0.05, rel=1e-6)
    assert found.orientation == pytest.approx(math.degrees(0.01))


def test_the_error_of_the_place_grows_away_from_the_fixes_and_turns_the_device() -> None:
    sigma = np.array([0.01, 0.01, 0.01, 0.2, 0.2, 0.3, 0.02])  # w, t and the scale
    error = PlaceError.model_validate(
        {"middle": (5, 0, 0), "covariance": np.diag(sigma**2).tolist(), "level": 0.4, "up": 0.7}
    )
    anchor = anchored(ANCHOR.model_copy(update={"error": error}), 99.0)
    near, far = (
        earth_covariance(level_camera(0, (5.0, north, 0.0)), np.zeros((6, 6)), anchor)
        for north in (0.0, 100.0)
    )
    np.testing.assert_allclose(near, np.diag([0.2, 0.2, 0.58]), atol=1e-12)
    # 100 m north: 0.01 rad are 1 m east and up, 2 % are 2 m north.
    np.testing.assert_allclose(far - near, np.diag([1.0, 4.0, 1.0]), atol=1e-9)
    turned = accuracy_of(level_camera(0, (5.0, 0, 0)), np.zeros((6, 6)), anchor)
    assert turned.orientation == pytest.approx(math.degrees(0.01))
    assert turned.position == pytest.approx(np.sqrt([0.2, 0.2, 0.58]).mean())


def test_the_circle_of_a_map_holds_it() -> None:
    quaternion = Pose(turn("z", 30), np.zeros(3)).rotation_wxyz.tolist()
    geodetic = Geodetic(
        latitude_deg=-12.0,
        longitude_deg=179.9999,
        altitude_m=20,
        scale=2.0,
        rotation_wxyz=tuple(quaternion),
        translation=(500.0, 0.0, 0.0),
    )
    world = World(
        metric=False,
        origin=(0, 0, 0),
        extent=Extent(min=(-10, -20, 0), max=(30, 10, 5)),
        anchor=Anchor(kind="gnss", images=3, geodetic=geodetic),
    )
    circle = circle_of(world)
    assert circle is not None
    assert circle.radius == pytest.approx(50.0, rel=1e-3)  # half of the diagonal, twice
    assert circle.longitude < -179.99  # beyond the antimeridian
    assert circle.distance_to(circle.latitude, circle.longitude) == 0
    north = circle.latitude + 1000 / 110_600
    assert circle.distance_to(north, circle.longitude) == pytest.approx(950, abs=2)
    assert circle_of(world.model_copy(update={"anchor": None})) is None


def test_distances_reach_across_the_antimeridian_and_round_the_pole() -> None:
    assert GeoCircle(0.0, 179.9999, 0.0).distance_to(0.0, -179.9999) == pytest.approx(22.3, abs=0.1)
    assert GeoCircle(89.9999, 0.0, 0.0).distance_to(89.9999, 180.0) == pytest.approx(22.3, abs=0.1)
    # Half of the Earth's girth.
    assert GeoCircle(0.0, 0.0, 0.0).distance_to(0.0, 180.0) == pytest.approx(20.0e6, rel=0.01)
