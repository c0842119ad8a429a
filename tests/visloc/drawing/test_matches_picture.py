from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import Map, MapStore
from visloc.drawing.matches_picture import draw_overlay
from visloc.errors import MapCorrupt
from visloc.features import make_local_features
from visloc.geometry import Camera
from visloc.localization.localizer import Localizer
from visloc.localization.solving import Look, Matches
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import Photo, read_photo
from visloc.types import CameraSource, Evidence, Localized, NotLocalized, Reason, RetrievedImage

OPTIONS = LocalizeOptions()
CAMERA = Camera("PINHOLE", 256, 192, (200.0, 200.0, 128.0, 96.0))
# Where the query lies on the canvas: left, top, pixels of the canvas per pixel.
LEFT, TOP, SCALE = 16, 106, 900 / 256
GREY = np.full((192, 256, 3), 128, np.uint8)


class Query(Protocol):
    image: bytes
    camera: Camera


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


@pytest.fixture
def opened(localizer: Localizer) -> Map:
    return localizer.map


def decoded(overlay: bytes) -> NDArray[np.uint8]:
    assert overlay.startswith(b"\xff\xd8\xff")
    return np.asarray(cv2.imdecode(np.frombuffer(overlay, np.uint8), cv2.IMREAD_COLOR_RGB))


def look_of(
    opened: Map, pixels: list[tuple[float, float]], image: int = 0, **evidence: Any
) -> Look:
    """A look whose matches are the first landmarks that a photo of the map sees."""
    landmarks = np.unique(opened.observations(image)[0])[: len(pixels)].astype(np.int64)
    found = Evidence(
        CAMERA,
        CameraSource.GIVEN,
        1,
        ReadAs.STORED,
        num_keypoints=len(pixels),
        num_correspondences=len(pixels),
        retrieved=(RetrievedImage(opened.images[image].name, 0.5, {}),),
    )
    matches = Matches(
        np.array(pixels, dtype=np.float64).reshape(-1, 2),
        opened.landmarks[landmarks].astype(np.float64),
    )
    return Look(replace(found, **evidence), matches, landmarks, Matches.none())


def refused(look: Look) -> NotLocalized:
    return NotLocalized(look.evidence, "gate", Reason.TOO_FEW_INLIERS, "is this the place?")


def greenness(canvas: NDArray[np.uint8], x: float, y: float) -> float:
    """How much more green than red is about a place of the query."""
    column, row = LEFT + x * SCALE - 0.5, TOP + y * SCALE - 0.5
    around = canvas[round(row) - 5 : round(row) + 6, round(column) - 5 : round(column) + 6]
    return float((around[..., 1].astype(float) - around[..., 0]).mean())


def test_inliers_are_green_and_outliers_red_where_they_were_seen(opened: Map) -> None:
    pixels = [(30.5, 40.5), (200.25, 40.5), (30.5, 160.0), (200.25, 160.0)]
    look = look_of(opened, pixels)
    inliers = np.array([True, False, False, True])

    overlay = draw_overlay(Photo(GREY), opened, look, refused(look), inliers)

    canvas = decoded(overlay)
    assert canvas.shape[1] == 1600
    for (x, y), right in zip(pixels, inliers, strict=True):
        assert (greenness(canvas, x, y) > 10) == right
        assert (greenness(canvas, x, y) < -10) != right
    assert abs(greenness(canvas, 115, 100)) < 3


def test_real_answers_are_drawn_with_all_that_was_matched(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    look = localizer.look(photo, query.camera, OPTIONS)
    answer, inliers = localizer.solve_look(look, OPTIONS)

    canvas = decoded(draw_overlay(photo, localizer.map, look, answer, inliers))

    assert isinstance(answer, Localized)
    assert inliers.sum() == answer.evidence.num_inliers
    np.testing.assert_array_equal(
        look.matches.pixels[inliers].astype(np.float32), answer.inlier_keypoints
    )
    np.testing.assert_array_equal(
        localizer.map.landmarks[look.landmarks].astype(np.float64), look.matches.points
    )
    # Lines lead over the gap between the query and the photos of the map.
    gap = canvas[TOP : TOP + 600, LEFT + 902 : LEFT + 914].astype(int)
    assert (gap.max(axis=2) - gap.min(axis=2) > 60).any()


def test_a_refused_pose_still_tells_its_inliers(
    localizer: Localizer, photos_of_another_room: list[Path]
) -> None:
    photo = read_photo(photos_of_another_room[0].read_bytes())
    look = localizer.look(photo, None, OPTIONS)
    answer, inliers = localizer.solve_look(look, OPTIONS)

    assert isinstance(answer, NotLocalized)
    assert inliers.shape == (len(look.matches.pixels),)
    assert inliers.sum() == answer.evidence.num_inliers
    assert draw_overlay(photo, localizer.map, look, answer, inliers)


def test_a_photo_that_shows_nothing_is_drawn_alone(localizer: Localizer) -> None:
    photo = Photo(np.zeros((48, 64, 3), np.uint8))
    look = localizer.look(photo, None, OPTIONS)
    answer, inliers = localizer.solve_look(look, OPTIONS)

    assert isinstance(answer, NotLocalized)
    assert len(inliers) == 0
    assert decoded(draw_overlay(photo, localizer.map, look, answer, inliers)).shape[1] == 1600


@pytest.mark.parametrize("exif_orientation", range(1, 9))
def test_a_photo_that_was_read_upright_is_drawn_upright(opened: Map, exif_orientation: int) -> None:
    rgb = GREY.copy()
    rgb[20:40, 30:50] = (0, 160, 0)  # stored pixels
    photo = Photo(rgb, exif_orientation)
    look = look_of(opened, [(40.0, 30.0)], read_as=ReadAs.UPRIGHT)

    overlay = draw_overlay(photo, opened, look, refused(look), np.zeros(1, dtype=np.bool_))

    query = decoded(overlay)[TOP:, : LEFT + 900].astype(int)
    red_over_green = query[..., 0] - query[..., 1]
    square, cross = np.argwhere(red_over_green < -60), np.argwhere(red_over_green > 30)
    middle = (square.min(axis=0) + square.max(axis=0)) / 2
    assert np.all(np.abs(cross.mean(axis=0) - middle) < 2)
    turned = exif_orientation >= 5
    assert (len(query) > 950) == turned  # portrait


@pytest.mark.parametrize("size", [(1, 1), (5000, 3), (3, 5000), (2000, 3000)])
def test_photos_of_any_shape_fit(opened: Map, size: tuple[int, int]) -> None:
    photo = Photo(np.zeros((size[1], size[0], 3), np.uint8))
    look = look_of(opened, [(0.5, 0.5)])

    canvas = decoded(draw_overlay(photo, opened, look, refused(look), np.ones(1, dtype=np.bool_)))

    assert canvas.shape[1] == 1600
    assert canvas.shape[0] < 1300


@pytest.mark.parametrize("name", ["a" * 5000, "\x1b[31m\n\0.jpg", "фото/写真.jpg", "%s{}", ""])
def test_names_of_photos_may_be_anything(opened: Map, name: str) -> None:
    renamed = replace(opened, images=(replace(opened.images[0], name=name),))
    look = look_of(renamed, [(10, 10)])

    assert draw_overlay(Photo(GREY), renamed, look, refused(look), np.ones(1, dtype=np.bool_))


def test_keypoints_outside_of_their_photo_do_no_harm(opened: Map) -> None:
    keypoints = opened.observation_keypoints.copy()
    keypoints[::2] = 32767
    keypoints[1::4] = -32768
    damaged = replace(opened, observation_keypoints=keypoints)
    look = look_of(damaged, [(10, 10), (20, 20), (30, 30)])

    assert draw_overlay(Photo(GREY), damaged, look, refused(look), np.ones(3, dtype=np.bool_))


class Kept:
    """A map that keeps photos, as far as drawing goes."""

    def __init__(self, opened: Map, data: bytes) -> None:
        self._opened, self._data = opened, data

    def photo(self, _: int) -> bytes:
        return self._data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._opened, name)


def test_a_photo_that_the_map_keeps_is_the_ground_of_what_it_sees(opened: Map) -> None:
    yellow = np.zeros((192, 256, 3), np.uint8)
    yellow[..., 1:] = 220  # as OpenCV has it: blue, green, red
    kept: Any = Kept(opened, cv2.imencode(".jpg", yellow)[1].tobytes())
    look = look_of(opened, [(10, 10)])

    canvas = decoded(draw_overlay(Photo(GREY), kept, look, refused(look), np.ones(1, np.bool_)))

    first = canvas[TOP : TOP + 230, LEFT + 920 : LEFT + 1220].reshape(-1, 3)
    np.testing.assert_allclose(np.median(first, axis=0), [154, 154, 0], atol=8)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no picture",
        cv2.imencode(".jpg", np.zeros((2000, 2000, 3), np.uint8))[1].tobytes(),
        cv2.imencode(".jpg", GREY)[1].tobytes()[:200],
    ],
    ids=["empty", "text", "large", "cut off"],
)
def test_a_kept_photo_that_is_none_is_a_damaged_map(opened: Map, data: bytes) -> None:
    kept: Any = Kept(opened, data)
    look = look_of(opened, [(10, 10)])

    with pytest.raises(MapCorrupt) as caught:
        draw_overlay(Photo(GREY), kept, look, refused(look), np.ones(1, dtype=np.bool_))

    assert caught.value.code == "map.photo"
    assert opened.images[0].name in str(caught.value.field)
