"""Every format that a phone or an editor makes: imported, and localized as a query."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image

from conftest import Query
from mapping.importers import import_dataset
from tests.heic import heic
from tests.turning import turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo, upright
from visloc.types import CameraSource, Localized

Pixels = NDArray[np.uint8]
ORIENTATIONS = range(1, 9)
MEGAPIXELS_108 = (12000, 9000)


def exif(orientation: int = 1) -> Image.Exif:
    made = Image.Exif()
    made[ExifTags.Base.Orientation] = orientation
    made[ExifTags.Base.Make] = "Maker"
    made.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 27
    return made


def saved(file_format: str, mode: str = "RGB", **options: object) -> Callable[[Pixels, int], bytes]:
    def encode(rgb: Pixels, orientation: int) -> bytes:
        image = Image.fromarray(rgb).convert(mode)
        if mode.endswith("A"):
            image.putalpha(128)
        file = io.BytesIO()
        image.save(file, file_format, exif=exif(orientation), **options)
        return file.getvalue()

    return encode


def deep(suffix: str) -> Callable[[Pixels, int], bytes]:
    """16 bits per channel, which Pillow does not write; without EXIF."""
    return lambda rgb, _: cv2.imencode(suffix, rgb[..., ::-1].astype(np.uint16) * 257)[1].tobytes()


def of_108_megapixels(rgb: Pixels, orientation: int) -> bytes:
    size = MEGAPIXELS_108 if rgb.shape[1] > rgb.shape[0] else MEGAPIXELS_108[::-1]
    large = cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC)
    return saved("JPEG", quality=80)(np.asarray(large, np.uint8), orientation)


def of_phone(**options: bool) -> Callable[[Pixels, int], bytes]:
    # EXIF says otherwise than the container, as iPhones' does after an edit: the container counts.
    return lambda rgb, orientation: heic(rgb, orientation, exif=exif(6).tobytes(), **options)


FORMATS: Mapping[str, Callable[[Pixels, int], bytes]] = {
    "a.jpg": saved("JPEG", quality=95),
    "cmyk.jpg": saved("JPEG", "CMYK", quality=95),
    "grey.jpg": saved("JPEG", "L", quality=95),
    "a.png": saved("PNG"),
    "alpha.png": saved("PNG", "RGBA"),
    "deep.png": deep(".png"),
    "a.webp": saved("WEBP", quality=90),
    "a.tif": saved("TIFF"),
    "alpha.tiff": saved("TIFF", "RGBA"),
    "cmyk.tif": saved("TIFF", "CMYK"),
    "deep.tif": deep(".tiff"),
    "a.bmp": saved("BMP"),
    "a.avif": saved("AVIF", quality=90),
    "alpha.avif": saved("AVIF", "RGBA", quality=90),
    "a.heic": of_phone(),
    "hdr.HEIC": of_phone(ten_bits=True),
    "108.jpg": of_108_megapixels,
}
TURNING = ("a.jpg", "a.png", "a.webp", "a.tif", "alpha.tiff", "a.avif", "a.heic", "hdr.HEIC")


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def localized(localizer: Localizer, data: bytes, camera: Camera | None) -> Localized:
    answer = localizer.localize(read_photo(data), camera, LocalizeOptions())
    assert isinstance(answer, Localized), answer
    return answer


@pytest.mark.parametrize("name", FORMATS)
def test_a_query_of_every_format_is_localized(
    name: str, localizer: Localizer, query: Query
) -> None:
    data = FORMATS[name](read_photo(query.image).rgb, 1)

    answer = localized(localizer, data, query.camera)

    metres, degrees = pose_error(answer.cam_from_world, query.cam_from_world)
    assert metres < 0.05
    assert degrees < 1


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("name", TURNING)
def test_a_query_that_was_held_turned_is_localized(
    name: str, orientation: int, localizer: Localizer, query: Query
) -> None:
    stored = turned_pixels(read_photo(query.image).rgb, orientation)
    data = FORMATS[name](np.asarray(stored, np.uint8), orientation)
    assert read_photo(data).exif_orientation == orientation

    answer = localized(localizer, data, turned_camera(query.camera, orientation))

    true = turned_pose(query.cam_from_world, orientation)
    metres, degrees = pose_error(answer.cam_from_world, true)
    assert metres < 0.05
    assert degrees < 1


def test_every_format_is_imported_with_its_size_and_focal_length(
    query: Query, tmp_path: Path
) -> None:
    rgb = read_photo(query.image).rgb
    (tmp_path / "in").mkdir()
    for name, encode in FORMATS.items():
        (tmp_path / "in" / name).write_bytes(encode(rgb, 1))

    imported = import_dataset("images", tmp_path / "in", tmp_path / "out")

    assert not [note for note in imported.notes if "left out" in note]
    dataset = read_dataset(tmp_path / "out")
    assert {record.path for record in dataset.images} == set(FORMATS)
    for record in dataset.images:
        sensor = dataset.sensors[record.sensor_id]
        # OpenCV writes no EXIF, and Pillow none into BMP and little into TIFF.
        if record.path.startswith("deep") or record.path.endswith((".bmp", ".tif", ".tiff")):
            assert sensor.image_size == (256, 192)
            continue
        assert sensor.camera is not None
        width, height = (3000, 2250) if record.path == "108.jpg" else (256, 192)
        assert (sensor.camera.width, sensor.camera.height) == (width, height)
        focal = 27 / math.hypot(36, 24) * math.hypot(width, height)
        assert sensor.camera.params == pytest.approx((focal, width / 2, height / 2, 0))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("name", TURNING)
def test_a_photo_is_turned_once(name: str, orientation: int, query: Query) -> None:
    rgb = read_photo(query.image).rgb
    seen = upright(rgb, orientation)

    photo = read_photo(FORMATS[name](rgb, orientation))

    assert photo.exif_orientation == orientation
    apart = np.abs(upright(photo.rgb, photo.exif_orientation).astype(int) - seen).mean()
    assert apart < np.abs(seen[::-1].astype(int) - seen).mean() / 4


def test_the_camera_of_a_photo_of_108_megapixels_is_reduced_with_it(
    localizer: Localizer, query: Query
) -> None:
    data = of_108_megapixels(read_photo(query.image).rgb, 1)
    fx, fy, cx, cy = query.camera.params
    by = MEGAPIXELS_108[0] / query.camera.width
    camera = Camera("PINHOLE", *MEGAPIXELS_108, (fx * by, fy * by, cx * by, cy * by))

    answer = localized(localizer, data, camera)

    assert answer.evidence.camera_source is CameraSource.GIVEN_SCALED
    assert answer.evidence.camera == camera.reduced(4)
    assert pose_error(answer.cam_from_world, query.cam_from_world)[0] < 0.05
