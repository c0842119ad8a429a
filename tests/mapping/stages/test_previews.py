from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.context import BuildContext
from mapping.stages.local_features import ExtractedFeatures
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from mapping.stages.previews import keep_photos
from mapping.stages.work_folder import WorkFolder
from visloc.archive import Map, MapStore, open_map, verify_map
from visloc.errors import MapCorrupt
from visloc.geometry import Camera
from visloc.kapture import FileRecord
from visloc.options import Inference
from visloc.photos.reading import read_photo, read_photo_file

NO_NETWORKS = Networks(None, Inference.AUTO)
NO_FEATURES = cast("ExtractedFeatures", None)  # pictures need none


def quiet(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def built(build_sample: Callable[..., Map]) -> Map:
    return build_sample(keep_photos=True)


def test_a_map_keeps_small_pictures_of_its_photos_when_asked(built: Map, sample: Path) -> None:
    assert built.manifest.counts.images == len(built.images) == 8
    for row, record in enumerate(built.images):
        data = built.photo(row)
        assert data is not None
        kept = read_photo(data).rgb
        photo = read_photo_file(sample / "mapping/sensors/records_data" / record.name).rgb
        assert kept.shape == photo.shape  # small enough already
        assert np.abs(kept.astype(int) - photo).mean() < 8
        assert f"photos/{row:06d}.jpg" in built.manifest.files
    verify_map(built.path)


def test_a_map_keeps_no_photos_unless_asked(built_maps: Path) -> None:
    opened = MapStore(built_maps).open("room")

    assert opened.photo(0) is None
    assert not (opened.path / "photos").exists()


def test_photos_become_at_most_640_pixels_and_lose_their_exif(tmp_path: Path) -> None:
    large = np.zeros((300, 1280, 3), np.uint8)
    large[:, 640:] = 255
    noise = np.random.default_rng(0).integers(0, 255, (640, 640, 3), np.uint8)
    photos = []
    for name, pixels in (("large", large), ("noise", noise)):
        path = tmp_path / f"{name}.png"
        cv2.imwrite(str(path), pixels)
        height, width = pixels.shape[:2]
        camera = Camera("SIMPLE_PINHOLE", width, height, (500.0, width / 2, height / 2))
        record = FileRecord(0, "camera", path.name)
        photos.append(MappingPhoto(record, path, name, camera, True, None, None, None))
    folder = tmp_path / "map"

    with Workers(1) as workers:
        context = BuildContext(
            WorkFolder(tmp_path / "work"), NO_FEATURES, NO_NETWORKS, workers, quiet
        )
        keep_photos(context, folder, photos)

    kept = [path.read_bytes() for path in sorted((folder / "photos").iterdir())]
    first = read_photo(kept[0]).rgb
    assert first.shape == (150, 640, 3)
    assert (first[:, :310].max(), first[:, 330:].min()) == (0, 255)
    assert b"Exif" not in kept[0]
    assert max(map(len, kept)) <= 2**20  # what a reader accepts, even of noise


def test_equal_builds_keep_equal_pictures(built: Map, sample: Path, tmp_path: Path) -> None:
    settings = BuildSettings(
        sample / "mapping", "room", tmp_path, local_features="sift", keep_photos=True, workers=2
    )
    again = open_map(build_map(settings, quiet))

    assert again.manifest.content_hash == built.manifest.content_hash


def test_an_altered_picture_is_found_by_verify(built: Map, tmp_path: Path) -> None:
    copy = shutil.copytree(built.path, tmp_path / "copy")
    path = copy / "photos" / "000003.jpg"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)

    with pytest.raises(MapCorrupt) as caught:
        verify_map(copy)

    assert (caught.value.code, caught.value.field) == ("map.checksum", str(path))


def test_a_missing_picture_is_found_at_opening(built: Map, tmp_path: Path) -> None:
    copy = shutil.copytree(built.path, tmp_path / "copy")
    (copy / "photos" / "000003.jpg").unlink()

    with pytest.raises(MapCorrupt) as caught:
        open_map(copy)

    assert caught.value.code == "map.file_missing"


@pytest.mark.parametrize("change", ["some", "large"])
def test_a_map_of_some_or_large_pictures_is_refused(
    built: Map, tmp_path: Path, change: str
) -> None:
    copy = shutil.copytree(built.path, tmp_path / "copy")
    manifest = json.loads((copy / "manifest.json").read_text())
    if change == "some":
        del manifest["files"]["photos/000003.jpg"]
    else:
        with (copy / "photos" / "000003.jpg").open("ab") as file:
            file.truncate(2**20 + 1)
        manifest["files"]["photos/000003.jpg"]["size"] = 2**20 + 1
    (copy / "manifest.json").write_text(json.dumps(manifest))

    with pytest.raises(MapCorrupt) as caught:
        open_map(copy)

    assert caught.value.code == "map.photos"
