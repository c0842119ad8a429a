from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.export import export_map
from visloc.archive import Map
from visloc.errors import DatasetError
from visloc.kapture import read_reconstruction, write_keypoints, write_reconstruction
from visloc.kapture.reconstruction import Reconstruction

Build = Callable[..., Map]
Errors = Callable[[Map, Path], NDArray[np.float64]]
MODEL = {"method": "model", "metric": True}


@pytest.fixture(scope="module")
def exported(sfm_walk: Map, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map by matches as a dataset with points, keypoints and descriptors; only to be read."""
    output = tmp_path_factory.mktemp("exported") / "dataset"
    export_map(sfm_walk, output, "kapture")
    return output


@pytest.fixture
def with_points(exported: Path, walk_copy: Path) -> Path:
    """The walk with photos, the points and the keypoints that see them; without descriptors."""
    shutil.copytree(
        exported / "reconstruction",
        walk_copy / "reconstruction",
        ignore=shutil.ignore_patterns("descriptors", "global_features"),
    )
    return walk_copy


def sightings(opened: Map) -> dict[tuple[int, int], int]:
    """The first observation of every point by every photo, in the order of the photos."""
    photos = np.repeat(np.arange(len(opened.images)), np.diff(opened.observation_offsets))
    landmarks = opened.observation_landmarks.tolist()
    found: dict[tuple[int, int], int] = {}
    for row, key in enumerate(zip(photos.tolist(), landmarks, strict=True)):
        found.setdefault(key, row)
    return dict(sorted(found.items()))


def test_ready_made_rows_are_the_descriptors_of_their_points(
    exported: Path, tmp_path: Path, sfm_walk: Map, build_walk: Build
) -> None:
    built = build_walk(exported, tmp_path, **MODEL, local_features="kapture:sift")
    np.testing.assert_array_equal(built.landmarks, sfm_walk.landmarks)
    # A photo that sees a point twice does so once afterwards.
    before, after = sightings(sfm_walk), sightings(built)
    assert after.keys() == before.keys()
    rows = [np.array(list(found.values())) for found in (after, before)]
    assert len(rows[0]) == len(built.observation_landmarks)
    for name in ("observation_keypoints", "observation_descriptors"):
        theirs, ours = getattr(built, name)[rows[0]], getattr(sfm_walk, name)[rows[1]]
        np.testing.assert_allclose(theirs, ours, atol=1 if name.endswith("descriptors") else 0)
    np.testing.assert_allclose(built.angles_deg, sfm_walk.angles_deg, atol=0.1)
    anchor = built.manifest.world.anchor
    assert anchor is not None
    assert (anchor.kind, anchor.images) == ("model", 16)


def test_other_features_take_the_points_that_they_see_and_all_points_stay_in_order(
    walk: Path,
    with_points: Path,
    tmp_path: Path,
    build_walk: Build,
    localization_errors: Errors,
) -> None:
    known = read_reconstruction(with_points)
    assert known is not None
    built = build_walk(with_points, tmp_path / "maps", **MODEL, max_keypoints=150)
    np.testing.assert_allclose(built.landmarks, known.points, atol=1e-6)
    seen = np.zeros(len(known.points), dtype=bool)
    seen[built.observation_landmarks] = True
    assert 0.1 < seen.mean() < 0.9
    assert np.isnan(built.errors_px[~seen]).all()
    assert (built.errors_px[seen] < 6).all()
    notes = "\n".join(built.manifest.notes)
    assert f"{(~seen).sum()} of {len(seen)} points are kept, but no feature sees them" in notes
    num = len(built.observation_landmarks)
    num_known = len(np.unique(known.observations[:, :2], axis=0))
    assert f"{num} of {num_known} sightings have a descriptor" in notes
    assert (
        localization_errors(build_walk(with_points, tmp_path / "maps", **MODEL), walk / "query")[
            :, 0
        ].max()
        < 0.03
    )


@pytest.mark.parametrize(("offset", "found"), [(1.9, True), (2.1, False)])
def test_the_nearest_keypoint_within_two_pixels_is_taken(
    with_points: Path, tmp_path: Path, build_walk: Build, offset: float, found: bool
) -> None:
    known = read_reconstruction(with_points)
    assert known is not None
    # One point, seen a little off the strongest keypoint of one photo, far from all others.
    name = known.images[0]
    folder = with_points / "reconstruction"
    xy = np.fromfile(folder / "keypoints" / "sift" / f"{name}.kpt", "<f4").reshape(-1, 2)
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2)
    np.fill_diagonal(gaps, np.inf)
    lonely = int(gaps.min(axis=1).argmax())
    shutil.rmtree(folder)
    write_keypoints(
        with_points, "mine", name, xy[[lonely]] + np.array([offset, 0], np.float32), name="mine"
    )
    observations = np.zeros((1, 3), dtype=np.int64)
    write_reconstruction(
        with_points, Reconstruction(known.points[:1], None, "mine", (name,), observations)
    )
    if not found:
        with pytest.raises(DatasetError, match=r"within 2\.0 px") as caught:
            build_walk(with_points, tmp_path / "maps", **MODEL)
        assert caught.value.code == "model.no_sightings"
        assert not (tmp_path / "maps" / "walk").exists()
        return
    built = build_walk(with_points, tmp_path / "maps", **MODEL)
    (seen_at,) = built.observation_keypoints
    assert np.linalg.norm(seen_at - xy[lonely]) < 2.0


@pytest.mark.parametrize(
    ("remove", "code", "named"),
    [
        ("points3d.txt", "kapture.unreadable", "observations of points that are missing"),
        ("observations.txt", "model.no_points", "points3d.txt.*--method sfm"),
        ("", "model.no_points", "points3d.txt.*--method sfm"),
    ],
)
def test_a_dataset_without_points_is_refused(
    with_points: Path, tmp_path: Path, build_walk: Build, remove: str, code: str, named: str
) -> None:
    folder = with_points / "reconstruction"
    if remove:
        (folder / remove).unlink()
    else:
        shutil.rmtree(folder)
    with pytest.raises(DatasetError, match=named) as caught:
        build_walk(with_points, tmp_path / "maps", **MODEL)
    assert caught.value.code == code
    assert not (tmp_path / "maps" / "walk").exists()


def test_a_model_whose_photos_are_missing_is_refused_by_name(
    with_points: Path, tmp_path: Path, build_walk: Build
) -> None:
    (with_points / "sensors" / "records_data").unlink()
    with pytest.raises(DatasetError, match=r"16 of 16 .* absent: mapping/left/0001.jpg"):
        build_walk(with_points, tmp_path / "maps", **MODEL)
    assert not (tmp_path / "maps" / "walk").exists()
