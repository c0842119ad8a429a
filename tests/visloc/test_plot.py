from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest

import visloc
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.in_process import FolderResult, LocalMap
from visloc.types import Localized

NEEDED = "figures need the extra notebook"


class Query(Protocol):
    path: Path
    camera: Camera


@pytest.fixture(scope="module")
def room(built_maps: Path) -> LocalMap:
    pytest.importorskip("matplotlib", reason=NEEDED)
    return visloc.open_map("room", built_maps)


@pytest.fixture(scope="module")
def results(room: LocalMap, sample: Path) -> FolderResult:
    return room.localize_folder(sample / "query")


def test_matches_are_the_picture_of_the_service(results: FolderResult) -> None:
    assert visloc.plot.matches(results[0]).size[0] == 1600


def test_reprojection_errors_are_those_of_the_pose(results: FolderResult) -> None:
    result = results[0]
    assert isinstance(result.answer, Localized)
    f = result.answer.evidence.camera
    assert f.model == "PINHOLE"
    seen = result.answer.cam_from_world.apply(result.answer.inlier_points)
    projected = seen[:, :2] / seen[:, 2:] * f.params[:2] + f.params[2:]

    errors = visloc.plot.reprojection_errors(result.answer)

    np.testing.assert_allclose(errors, projected - result.answer.inlier_keypoints, atol=1e-9)
    assert 0 < np.median(np.hypot(*errors.T)) < 1
    drawn = visloc.plot.reprojections(result)
    np.testing.assert_allclose(drawn.axes[1].collections[0].get_offsets(), errors)
    assert drawn.png().startswith(b"\x89PNG")


def test_a_photo_without_a_pose_has_no_reprojections(
    room: LocalMap, query: Query, photos_of_another_room: list[Path]
) -> None:
    refused = room.localize(photos_of_another_room[0], query.camera)
    with pytest.raises(InvalidInput, match="without a pose"):
        visloc.plot.reprojections(refused)
    assert visloc.plot.matches(refused).size[0] == 1600
    assert len(visloc.plot.map_3d(room, [refused]).data) == 2  # landmarks and mapping photos


def test_the_strip_shows_the_retrieved_photos_in_their_order(results: FolderResult) -> None:
    result = results[0]
    assert result.answer is not None
    names = [photo.name for photo in result.answer.evidence.retrieved[:3]]

    titles = [axes.get_title() for axes in visloc.plot.retrieval(result, most=3).axes]

    assert titles[0] == f"query: {result.name}"
    assert [title.split("\n")[0] for title in titles[1:4]] == [
        f"{rank}: {name}" for rank, name in enumerate(names, start=1)
    ]


def test_the_view_in_3d_puts_cameras_where_they_are(room: LocalMap, results: FolderResult) -> None:
    pytest.importorskip("plotly", reason=NEEDED)
    landmarks, mapping, localized, true = visloc.plot.map_3d(room, results, 100).data

    assert len(landmarks.x) == 100
    for drawn, poses in (
        (mapping, [Pose.from_quaternion(p[:4], p[4:]) for p in room.archive.image_poses]),
        (localized, [result.pose for result in results]),
        (true, [result.truth for result in results]),
    ):
        line = np.column_stack([drawn.x, drawn.y, drawn.z]).reshape(len(poses), 12, 3)
        centres = np.array([pose.center for pose in poses if pose is not None])
        np.testing.assert_allclose(line[:, 5], centres, atol=1e-9)
        np.testing.assert_allclose(line[:, [7, 9]], centres[:, None].repeat(2, 1), atol=1e-9)
        assert np.isnan(line[:, 11]).all()
    # The corners of a picture, projected with its own pose and camera.
    pose, camera = results[0].pose, results[0].camera
    assert pose is not None
    assert camera is not None
    corners = pose.apply(np.column_stack([localized.x, localized.y, localized.z])[:4])
    at = corners[:, :2] / corners[:, 2:] * camera.params[:2] + camera.params[2:]
    w, h = camera.width, camera.height
    np.testing.assert_allclose(at, [[0, 0], [w, 0], [w, h], [0, h]], atol=0.03 * w)


def test_curves_end_at_the_share_that_was_localized(results: FolderResult) -> None:
    half = FolderResult([results[0], replace(results[1], answer=None)])

    figure = visloc.plot.errors({"all": results, "half": half})

    for axes, column in zip(figure.axes, (0, 1), strict=True):
        whole, part = axes.lines
        errors = sorted(r.pose_error[column] for r in results if r.pose_error is not None)
        np.testing.assert_allclose(whole.get_xdata(), errors)
        np.testing.assert_allclose(whole.get_ydata(), [100 / 3, 200 / 3, 100])
        np.testing.assert_allclose(part.get_ydata(), [50])
    with pytest.raises(InvalidInput, match="no true pose"):
        visloc.plot.errors([replace(results[0], truth=None)])


def test_names_are_not_formulas(results: FolderResult) -> None:
    drawn = visloc.plot.reprojections(replace(results[0], name="$x$"))
    assert drawn.axes[0].get_title().startswith(r"\$x\$: ")
    assert drawn.png()
