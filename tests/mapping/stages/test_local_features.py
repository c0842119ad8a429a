"""Features of a photo most of whose keypoints lie on a logo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapping.stages.camera_mask import CameraMask, are_masked, cells_of, shape_of
from mapping.stages.local_features import ExtractedFeatures, local_features_source
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import WorkFolder
from visloc.archive import sha256_of
from visloc.geometry import Camera, PixelOrigin
from visloc.kapture import FileRecord
from visloc.options import Inference

CAMERA = Camera("PINHOLE", 480, 360, (400.0, 400.0, 240.0, 180.0))
MAX_KEYPOINTS = 400
# Left, top, right and bottom of the logo.
LOGO = (320, 220, 460, 340)


@pytest.fixture
def photo(tmp_path: Path) -> MappingPhoto:
    random = np.random.default_rng(0)
    picture = cv2.GaussianBlur(random.uniform(0, 255, (360, 480)), None, 3.0)
    picture = 128 + 3.0 * (picture - picture.mean())
    left, top, right, bottom = LOGO
    logo = random.choice([0.0, 255.0], ((bottom - top) // 5, (right - left) // 5))
    picture[top:bottom, left:right] = np.kron(logo, np.ones((5, 5)))
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.clip(picture, 0, 255).astype(np.uint8))
    record = FileRecord(0, "cam", path.name)
    return MappingPhoto(record, path, sha256_of(path), CAMERA, True, None, None, None)


@pytest.fixture
def source(tmp_path: Path) -> ExtractedFeatures:
    found = local_features_source(
        WorkFolder(tmp_path / "work"),
        tmp_path,
        "sift",
        networks=Networks(None, Inference.TORCH),
        max_keypoints=MAX_KEYPOINTS,
        features_dir=None,
        pixel_origin=PixelOrigin.CORNER,
    )
    assert isinstance(found, ExtractedFeatures)
    return found


def mask_of_logo() -> CameraMask:
    mask = np.zeros(shape_of(CAMERA), dtype=bool)
    left, top, right, bottom = LOGO
    inside = np.mgrid[left:right, top:bottom].reshape(2, -1).T
    mask[cells_of(CAMERA, inside)] = True
    return mask


def test_keypoints_that_a_logo_had_are_found_elsewhere(
    photo: MappingPhoto, source: ExtractedFeatures
) -> None:
    mask = mask_of_logo()
    before = are_masked(CAMERA, mask, source.read(photo).keypoints)
    assert before.mean() > 0.3
    found = source.outside({"cam": mask}).read(photo)
    assert not are_masked(CAMERA, mask, found.keypoints).any()
    assert (~before).sum() < len(found) <= MAX_KEYPOINTS


def test_a_mask_is_part_of_the_key_of_its_own_cameras_photos(
    photo: MappingPhoto, source: ExtractedFeatures
) -> None:
    mask = mask_of_logo()
    assert source.outside({"cam": mask}).key(photo) != source.key(photo)
    assert source.outside({"cam": ~mask}).key(photo) != source.outside({"cam": mask}).key(photo)
    assert source.outside({"other": mask}).key(photo) == source.key(photo)


def test_a_process_keeps_features_unless_there_may_be_very_many(
    photo: MappingPhoto, source: ExtractedFeatures
) -> None:
    many = replace(source, max_keypoints=100_000)
    for each, is_kept in ((source, True), (many, False)):
        first, again, third = (each.read(photo).keypoints for _ in range(3))
        assert np.array_equal(first, again)
        assert np.shares_memory(again, third) == is_kept
