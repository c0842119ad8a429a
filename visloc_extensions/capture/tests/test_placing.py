from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapping.stages.landmarks import MadeLandmarks, Observations, View, assemble_landmarks
from mapping.stages.photos import MappingPhoto
from visloc.archive import Anchor
from visloc.geometry import Camera, Pose, Similarity
from visloc.kapture import FileRecord
from visloc.pose.reprojection import project
from visloc_extensions.capture.placing import Yardstick, place

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def level_camera(i: int) -> Pose:
    """Cameras that look all around, in a world with z up."""
    rotation = LEVEL @ Rotation.from_euler("z", 40 * i, degrees=True).as_matrix()
    return Pose(rotation, -rotation @ np.array([i * 0.5, 0.1 * i * i, 1.6]))


TRUE = [level_camera(i) for i in range(8)]
# The reconstruction lies anywhere and has any size.
SOMEWHERE = Similarity(0.37, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.ones(3))


def made(kind: Any = "none", *, metric: bool = False) -> tuple[list[MappingPhoto], MadeLandmarks]:
    points = SOMEWHERE.apply(np.random.default_rng(0).uniform(-9, 9, (200, 3)))
    views = [View(CAMERA, SOMEWHERE.move(pose)) for pose in TRUE]
    rows = []
    for number, view in enumerate(views):
        pixels = project(view.camera, view.cam_from_world.apply(points))
        seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        rows.append((seen, np.full(len(seen), number), pixels[seen]))
    observed, by, pixels = (np.concatenate(part) for part in zip(*rows, strict=True))
    observations = Observations(observed, by, np.arange(len(by)), pixels.astype(np.float32))
    landmarks, features = assemble_landmarks(views, points, observations)
    photos = [
        MappingPhoto(FileRecord(i, "camera", f"{i}.jpg"), Path(f"{i}.jpg"), None, CAMERA, True,
                     None, None, None)
        for i in range(len(TRUE))
    ]  # fmt: skip
    return photos, MadeLandmarks(
        np.arange(len(views)), tuple(views), landmarks, tuple(features), {}, metric,
        Anchor(kind=kind, images=0 if kind == "none" else 8),
    )  # fmt: skip


def apart(result: MadeLandmarks, a: int, b: int) -> float:
    centers = [result.views[i].cam_from_world.center for i in (a, b)]
    return float(np.linalg.norm(centers[0] - centers[1]))


def true_length(a: int, b: int) -> float:
    return float(np.linalg.norm(TRUE[a].center - TRUE[b].center))


def test_a_known_length_gives_the_size_and_up_points_up() -> None:
    length = true_length(0, 7)
    result = place(Yardstick(("0.jpg", "7.jpg", length)), *made())
    assert result.metric
    assert apart(result, 2, 5) == pytest.approx(
        float(np.linalg.norm(TRUE[2].center - TRUE[5].center))
    )
    for view, true in zip(result.views, TRUE, strict=True):
        # The image of z up is that of the true world.
        assert np.allclose(view.cam_from_world.rotation[:, 2], true.rotation[:, 2], atol=1e-6)
    assert result.settings["scale"] == {
        "by": "length",
        "photos": ["0.jpg", "7.jpg"],
        "metres": length,
    }


def test_landmarks_move_with_the_cameras() -> None:
    photos, before = made()
    result = place(Yardstick(("0.jpg", "7.jpg", 3.0)), photos, before)
    factor = 3.0 / apart(before, 0, 7)
    for view_before, view in zip(before.views, result.views, strict=True):
        old = view_before.cam_from_world.apply(before.landmarks.points.astype(float))
        new = view.cam_from_world.apply(result.landmarks.points.astype(float))
        assert np.allclose(factor * old, new, atol=1e-4)


def test_without_a_length_only_up_is_known() -> None:
    result = place(Yardstick(), *made())
    assert not result.metric
    assert apart(result, 0, 7) == pytest.approx(
        0.37 * float(np.linalg.norm(TRUE[0].center - TRUE[7].center))
    )


def test_a_photo_that_found_no_place_gives_no_scale() -> None:
    result = place(Yardstick(("0.jpg", "gone.jpg", 3.0)), *made())
    assert not result.metric
    assert any("gone.jpg" in note for note in result.notes)


def test_two_photos_of_one_place_give_no_scale() -> None:
    result = place(Yardstick(("0.jpg", "0.jpg", 3.0)), *made())
    assert not result.metric
    assert any("one place" in note for note in result.notes)


def test_a_world_that_gps_fixed_is_kept_and_a_contradiction_told() -> None:
    photos, before = made("gnss", metric=True)
    units = apart(before, 0, 7)
    agreeing = place(Yardstick(("0.jpg", "7.jpg", 1.02 * units)), photos, before)
    assert agreeing.notes == ()
    contradicting = place(Yardstick(("0.jpg", "7.jpg", 2.0 * units)), photos, before)
    assert contradicting.views == before.views
    assert "2.00 m" in contradicting.notes[0]


def test_a_scan_without_metres_gets_its_size_and_keeps_its_axes() -> None:
    photos, before = made("dataset")
    result = place(Yardstick(("0.jpg", "7.jpg", 2 * apart(before, 0, 7))), photos, before)
    assert result.metric
    assert apart(result, 2, 5) == pytest.approx(2 * apart(before, 2, 5))
    for old, new in zip(before.views, result.views, strict=True):
        assert np.allclose(old.cam_from_world.rotation, new.cam_from_world.rotation)
