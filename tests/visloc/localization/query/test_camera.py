"""Which camera of a map took a photo."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from visloc.archive import Map
from visloc.geometry import Camera
from visloc.localization.query.camera import MapCamera, map_cameras, resolve_camera
from visloc.photos.reading import Photo
from visloc.types import CameraSource

LENS = Camera("SIMPLE_RADIAL", 400, 300, (330.0, 201.0, 149.0, -0.1))
NAMED = MapCamera(LENS, "Maker Phone", 320.0)
NAMELESS = MapCamera(LENS, "", None)
SHOT = Photo(np.zeros((300, 400, 3), np.uint8), focal_length_px=321.0, camera_name="Maker Phone")
BARE = replace(SHOT, focal_length_px=None, camera_name="")


@pytest.mark.parametrize(
    ("mapped", "photo"), [(NAMED, SHOT), (NAMELESS, BARE)], ids=["EXIF", "none"]
)
def test_photo_of_a_map_camera_gets_it(mapped: MapCamera, photo: Photo) -> None:
    assert resolve_camera(photo, None, [mapped]) == (LENS, CameraSource.MAP)


@pytest.mark.parametrize(
    "photo",
    [
        replace(SHOT, camera_name="Maker Tablet"),
        replace(SHOT, focal_length_px=340.0),
        replace(SHOT, focal_length_px=None),
        replace(SHOT, rgb=np.zeros((400, 300, 3), np.uint8)),
        BARE,
    ],
    ids=["model", "lens", "no lens", "size", "nothing"],
)
def test_photo_of_another_camera_does_not(photo: Photo) -> None:
    assert resolve_camera(photo, None, [NAMED])[1] is not CameraSource.MAP


def test_photo_of_a_rig_needs_more_than_its_size() -> None:
    assert resolve_camera(BARE, None, [NAMELESS], alone=False)[1] is CameraSource.GUESS
    assert resolve_camera(SHOT, None, [NAMED], alone=False)[1] is CameraSource.MAP


@pytest.mark.parametrize(
    "told",
    [
        None,
        "cameras",
        [],
        {"lens": None},
        {"lens": {"source": "exif", "name": "Maker Phone"}},
        *(
            {"lens": {"source": "exif", "name": "Maker Phone", "prior_px": prior}}
            for prior in (0.0, -1.0, math.nan, math.inf, "320", [320.0])
        ),
        {"lens": {"source": "exif", "name": 3, "prior_px": 320.0}},
        {"lens": {"source": "exif", "name": "Maker Phone", "prior_px": 320.0, "doubt": "moved"}},
    ],
)
def test_camera_that_a_map_says_nothing_sound_of_did_not_take_a_photo(told: object) -> None:
    assert not any(one.took(SHOT) for one in map_cameras(opened(told)))


def test_cameras_of_a_map_come_by_their_photos() -> None:
    origin = {"source": "exif", "name": "Maker Phone", "prior_px": 320}
    found = map_cameras(opened({"lens": origin}, other=LENS))
    assert found == (NAMED, MapCamera(LENS, "", None))
    assert found[0].took(SHOT)


def opened(told: object, **others: Camera) -> Map:
    """Return a map, as far as ``map_cameras`` reads it; two of its photos are of ``lens``."""
    cameras = {"lens": LENS, **others}
    images = [SimpleNamespace(camera=name) for name in ("lens", *cameras)]
    settings = {} if told is None else {"cameras": told}
    manifest = SimpleNamespace(method=SimpleNamespace(settings=settings))
    return cast(Map, SimpleNamespace(cameras=cameras, images=images, manifest=manifest))


def test_given_camera_comes_first() -> None:
    given = replace(LENS, params=(300.0, 200.0, 150.0, 0.0))
    assert resolve_camera(SHOT, given, [NAMED]) == (given, CameraSource.GIVEN)


def test_photo_reduced_while_decoded_gets_the_reduced_camera() -> None:
    half = replace(
        SHOT,
        rgb=np.zeros((150, 200, 3), np.uint8),
        focal_length_px=160.5,
        reduced=2,
        file_size=(400, 300),
    )
    assert resolve_camera(half, None, [NAMED]) == (LENS.reduced(2), CameraSource.MAP)
