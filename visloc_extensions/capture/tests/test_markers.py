from __future__ import annotations

import cv2
import numpy as np
import pytest

from mapping.stages.landmarks import View
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project
from visloc_extensions.capture.markers import Sighting, find_markers, marker_sides

CAMERA = Camera("SIMPLE_RADIAL", 800, 600, (700.0, 400.0, 300.0, -0.05))
SIDE = 0.16
CORNERS = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]) * SIDE
DICTIONARY = "DICT_APRILTAG_36h11"


def looking_at_origin(center: tuple[float, float, float]) -> Pose:
    """A camera whose y axis is as nearly the world's as can be."""
    forward = -np.array(center) / np.linalg.norm(center)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.array(center))


VIEWS = {
    f"{i}.jpg": View(CAMERA, looking_at_origin(center))
    for i, center in enumerate([(-0.3, 0.0, -1.0), (0.0, 0.1, -0.8), (0.4, -0.1, -1.2)])
}


def sightings(corners: np.ndarray = CORNERS, number: int = 7) -> list[Sighting]:
    return [
        Sighting(
            name, (DICTIONARY, number), project(view.camera, view.cam_from_world.apply(corners))
        )
        for name, view in VIEWS.items()
    ]


def photograph(view: View, number: int = 7) -> np.ndarray:
    """A grey photo of the marker on a white wall."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    print_px = cv2.aruco.generateImageMarker(dictionary, number, 400)
    quad = project(view.camera, view.cam_from_world.apply(CORNERS)) - 0.5
    # Outer corners of the print, as OpenCV counts.
    outer = np.array([[-0.5, -0.5], [399.5, -0.5], [399.5, 399.5], [-0.5, 399.5]])
    to_photo = cv2.getPerspectiveTransform(outer.astype(np.float32), quad.astype(np.float32))
    size = (CAMERA.width, CAMERA.height)
    return cv2.warpPerspective(
        print_px, to_photo, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT,
        borderValue=(230,),
    )  # fmt: skip


def test_the_side_of_a_marker_is_exact() -> None:
    assert marker_sides(sightings(), VIEWS) == {(DICTIONARY, 7): pytest.approx(SIDE, rel=1e-9)}


def test_a_wrong_sighting_is_left_out() -> None:
    good = sightings()
    wrong = Sighting("wrong.jpg", (DICTIONARY, 7), good[0].corners + 40.0)
    views = {**VIEWS, "wrong.jpg": VIEWS["0.jpg"]}
    assert marker_sides([*good, wrong], views)[DICTIONARY, 7] == pytest.approx(SIDE, rel=1e-9)


def test_what_is_no_square_is_left_out() -> None:
    assert marker_sides(sightings(CORNERS * [1.0, 1.2, 1.0]), VIEWS) == {}


def test_photos_that_are_not_in_the_map_do_not_count() -> None:
    assert marker_sides(sightings(), {"0.jpg": VIEWS["0.jpg"]}) == {}


def test_markers_are_found_in_photos_and_measured() -> None:
    photos = [(name, photograph(view)) for name, view in VIEWS.items()]
    steps = []
    found = find_markers(photos, len(photos), lambda done, total: steps.append((done, total)))
    assert {s.marker for s in found} == {(DICTIONARY, 7)}
    assert steps[-1] == (3, 3)
    assert marker_sides(found, VIEWS)[DICTIONARY, 7] == pytest.approx(SIDE, rel=0.01)


def test_a_marker_in_one_photo_tells_nothing() -> None:
    view = VIEWS["0.jpg"]
    assert find_markers([("0.jpg", photograph(view))], 1, lambda *_: None) == []
