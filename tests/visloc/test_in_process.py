from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pytest

import visloc
from visloc.errors import InvalidInput, NotFound
from visloc.geometry import Camera, Pose
from visloc.in_process import FolderResult, LocalMap
from visloc.options import LocalizeOptions


class Query(Protocol):
    path: Path
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def room(built_maps: Path) -> LocalMap:
    return visloc.open_map("room", built_maps)


@pytest.fixture(scope="module")
def results(room: LocalMap, sample: Path) -> FolderResult:
    return room.localize_folder(sample / "query")


def test_a_photo_is_answered_as_by_the_localizer(room: LocalMap, query: Query) -> None:
    result = room.localize(str(query.path), query.camera)

    assert result.status == result.answer.status == "localized"  # type: ignore[union-attr]
    assert result.localized
    assert result.refusal is None
    assert result.pose is not None
    position_error = result.pose.center - query.cam_from_world.center
    assert abs(position_error).max() < 0.1
    assert result.pose_error is None  # the truth is not known


def test_a_dataset_brings_cameras_and_true_poses(
    results: FolderResult, queries: list[Query]
) -> None:
    assert [result.path for result in results] == [query.path for query in queries]
    assert [result.camera for result in results] == [query.camera for query in queries]
    assert all(result.status == "localized" for result in results)
    assert repr(results) == "<3 photos, 3 localized>"
    row = results[0].row()
    assert (row["position_error"], row["orientation_error_deg"]) == results[0].pose_error
    assert row["inliers"] <= row["matches"]
    assert len(results[:2]) == 2


def test_photos_without_a_dataset_are_found_in_subfolders(
    room: LocalMap, queries: list[Query], tmp_path: Path
) -> None:
    names = ["a.JPG", "deep/b.jpg"]
    (tmp_path / "deep").mkdir()
    for name in names:
        shutil.copy(queries[0].path, tmp_path / name)
    (tmp_path / "notes.txt").write_text("no photo")

    found = room.localize_folder(tmp_path, queries[0].camera)

    assert [result.name for result in found] == names
    assert {result.status for result in found} == {"localized"}
    assert found[0].truth is None


def test_a_photo_that_cannot_be_used_does_not_end_a_folder(
    room: LocalMap, query: Query, tmp_path: Path
) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    shutil.copy(query.path, tmp_path / "b.jpg")

    broken, fine = room.localize_folder(tmp_path, query.camera)

    assert broken.status == "error"
    assert broken.row()["reason"] == "image.format"
    assert broken.row()["inliers"] is None
    assert fine.status == "localized"
    with pytest.raises(InvalidInput, match=r"a\.png"):
        broken.look_again()


def test_a_refused_photo_has_its_reason(
    room: LocalMap, photos_of_another_room: list[Path], query: Query
) -> None:
    result = room.localize(photos_of_another_room[0], query.camera)

    assert result.status == "not_localized"
    assert not result.localized
    assert result.pose is None
    assert result.refusal is not None
    assert result.refusal.reason == result.row()["reason"]
    assert result.refusal.message
    row = result.row()
    assert row["reason"] in ("too_few_matches", "no_pose", "too_few_inliers", "low_inlier_ratio")
    assert row["x"] is row["position_std"] is None


def test_looking_again_sees_what_the_answer_saw(
    room: LocalMap, photos_of_another_room: list[Path], query: Query
) -> None:
    for path in (query.path, photos_of_another_room[0]):
        result = room.localize(path, query.camera)
        photo, look, inliers = result.look_again()
        assert result.answer is not None
        assert photo.width == query.camera.width
        assert look.evidence.retrieved == result.answer.evidence.retrieved
        assert inliers.sum() == result.answer.evidence.num_inliers
        assert len(look.matches.pixels) == result.answer.evidence.num_correspondences


def test_the_table_has_a_row_for_each_photo(results: FolderResult) -> None:
    pytest.importorskip("pandas", reason="tables need the extra notebook")
    table = results.table()

    assert list(table.index) == [result.name for result in results]
    assert table["inliers"].tolist() == [row["inliers"] for row in results.rows()]
    assert table["position_error"].max() < 0.1


def test_the_accuracy_counts_photos_with_a_true_pose(results: FolderResult) -> None:
    unknown, refused, localized = replace(results[0], truth=None), results[1], results[2]
    partly = FolderResult([unknown, replace(refused, answer=None), localized])

    accuracy = partly.accuracy()

    assert localized.pose_error is not None
    assert accuracy["median_position_error_m"] == localized.pose_error[0]
    assert accuracy["median_position_error_of_all_m"] is None
    assert accuracy["recall"][-1]["fraction"] == 0.5
    with pytest.raises(InvalidInput, match="no true pose"):
        partly[:1].accuracy()


def test_what_is_missing_is_named(room: LocalMap, built_maps: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="no photo"):
        room.localize_folder(tmp_path)
    with pytest.raises(NotFound, match=r"nowhere\.jpg"):
        room.localize(tmp_path / "nowhere.jpg")
    with pytest.raises(NotFound):
        visloc.open_map("nothing", built_maps)
    with pytest.raises(InvalidInput):
        room.localize_folder(tmp_path, options=LocalizeOptions(photos=("unknown.jpg",)))
