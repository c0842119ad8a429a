from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
import pytest
from numpy.typing import NDArray

from mapping.maps.export import export_map
from mapping.stages.imported_points import read_imported_points
from visloc.archive import Map
from visloc.errors import DatasetError, MapCorrupt
from visloc.kapture import read_reconstruction

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


def test_other_features_are_matched_anew_and_the_points_come_back_out(
    walk: Path,
    with_points: Path,
    tmp_path: Path,
    build_walk: Build,
    localization_errors: Errors,
) -> None:
    known = read_reconstruction(with_points)
    assert known is not None
    built = build_walk(with_points, tmp_path / "maps", **MODEL)
    assert localization_errors(built, walk / "query")[:, 0].max() < 0.03
    anchor = built.manifest.world.anchor
    assert anchor is not None
    assert (anchor.kind, anchor.images) == ("model", 16)

    for format_name in ("kapture", "colmap", "ply"):
        export_map(built, tmp_path / format_name, format_name)
    back = read_reconstruction(tmp_path / "kapture")
    assert back is not None
    np.testing.assert_array_equal(back.points, known.points)
    assert {
        (point, back.images[image], keypoint)
        for point, image, keypoint in back.observations.tolist()
    } == {
        (point, known.images[image], keypoint)
        for point, image, keypoint in known.observations.tolist()
    }
    model = pycolmap.Reconstruction(tmp_path / "colmap")
    assert model.num_points3D() == len(known.points)
    assert model.compute_num_observations() == len(known.observations)
    np.testing.assert_array_equal(
        [point.xyz for _, point in sorted(model.points3D.items())], known.points
    )


def test_sightings_by_photos_without_keypoints_are_left_out_with_a_note(
    with_points: Path, tmp_path: Path, build_walk: Build
) -> None:
    known = read_reconstruction(with_points)
    assert known is not None
    next(with_points.rglob("left/0001.jpg.kpt")).unlink()
    built = build_walk(with_points, tmp_path / "maps", **MODEL)
    lost = known.observations[:, 1] == known.images.index("mapping/left/0001.jpg")
    assert any(
        f"{lost.sum()} observations by 1 photos without a file of keypoints" in note
        and "left/0001.jpg.kpt" in note
        for note in built.manifest.notes
    )
    imported = read_imported_points(built)
    assert imported is not None
    assert len(imported.observations) == (~lost).sum()
    export_map(built, tmp_path / "out", "kapture")


def test_a_sighting_by_a_keypoint_beyond_the_last_is_refused_by_name(
    exported: Path, tmp_path: Path, build_walk: Build
) -> None:
    dataset, features = tmp_path / "dataset", tmp_path / "features"
    shutil.copytree(exported, dataset, ignore=shutil.ignore_patterns("keypoints", "descriptors"))
    for kind in ("keypoints", "descriptors"):
        shutil.copytree(exported / "reconstruction" / kind, features / kind)
        next((features / kind).rglob("left/0001.jpg.*")).write_bytes(b"")
    with pytest.raises(DatasetError, match=r"mapping/left/0001\.jpg") as caught:
        build_walk(
            dataset,
            tmp_path / "maps",
            **MODEL,
            local_features="kapture:sift",
            features_dir=features,
        )
    assert caught.value.code == "kapture.index"
    assert caught.value.field is not None
    assert caught.value.field.endswith("left/0001.jpg.kpt")
    assert not (tmp_path / "maps" / "walk").exists()


def test_damaged_imported_points_are_refused(
    with_points: Path, tmp_path: Path, build_walk: Build
) -> None:
    built = build_walk(with_points, tmp_path / "maps", **MODEL)
    path = built.path / "imported_points.npz"
    whole = path.read_bytes()
    with np.load(path) as arrays:
        good = dict(arrays)
    for damage, named in (
        ({"points": good["points"] * np.nan}, "do not fit"),
        ({"points": good["points"][:1]}, "do not fit"),
        ({"keypoints": good["keypoints"][:-1]}, "do not fit"),
        ({"keypoint_offsets": good["keypoint_offsets"][:0]}, "do not fit"),
        ({"colors": np.float64(0)}, "colors float64"),
        ({"observations": good["observations"].ravel()}, "observations int64"),
        ({"further": np.zeros(3)}, "further"),
    ):
        np.savez(path, **(good | damage))
        with pytest.raises(MapCorrupt, match=rf"imported_points\.npz.*{named}"):
            read_imported_points(built)
    np.savez_compressed(path, **good)
    with pytest.raises(MapCorrupt, match=r"imported_points\.npz.*compressed"):
        read_imported_points(built)
    path.write_bytes(whole[: len(whole) // 2] + b"\0" * (len(whole) - len(whole) // 2))
    with pytest.raises(MapCorrupt, match=r"imported_points\.npz"):
        export_map(built, tmp_path / "out", "ply")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("remove", "code", "named"),
    [
        ("points3d.txt", "model.no_points", "points3d.txt.*--method sfm"),
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
