from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.maps.editing import content_of, joined, moved, selected
from mapping.own_test.publishing import publish_edited, publish_tested, write_content
from mapping.stages.publishing import link_photos, photo_files
from visloc.archive import Geodetic, Map, MapContent, MapStore
from visloc.archive.places import enu_of
from visloc.errors import Conflict
from visloc.geometry import Camera, Pose, Similarity
from visloc.pose.reprojection import MatchedView, reprojection_errors

TURN = Pose.from_quaternion([0.8, 0.1, -0.5, 0.3], [0, 0, 0]).rotation
ELSEWHERE = Similarity(2.5, TURN, np.array([3.0, -40.0, 7.0]))


@pytest.fixture(scope="module")
def built(build_sample: Callable[..., Map]) -> Map:
    """With all that a map can keep, and a camera on a rig whose pose has no round numbers."""
    return build_sample(keep_photos=True, keep_colours=True, gravity=(0.0, 0.1, 1.0))


@pytest.fixture
def store(built: Map, tmp_path: Path) -> MapStore:
    """A store of its own with that map."""
    shutil.copytree(built.path.parent, tmp_path / "room")
    return MapStore(tmp_path)


def published(content: MapContent, root: Path, photos: Sequence[Path] = ()) -> Map:
    store = MapStore(root)
    publish_edited(store, content, "edited", photos=photos)
    return store.open("edited")


def published_again(opened: Map, root: Path) -> Map:
    """The content of a map, with the small pictures and the pairs that lie beside it."""
    store = MapStore(root)
    with store.incoming() as incoming:
        link_photos(incoming, photo_files(opened))
        if "pairs.txt" in opened.manifest.files:
            shutil.copy(opened.path / "pairs.txt", incoming)
        version = write_content(incoming, content_of(opened), "edited")
        publish_tested(store, incoming, "edited", version)
    return store.open("edited")


def reprojection_of(opened: Map, image: int) -> NDArray[np.float64]:
    rows = opened.observations(image)[0]
    origin = np.array(opened.manifest.world.origin)
    view = MatchedView(
        opened.cameras[opened.images[image].camera],
        Pose.identity(),
        opened.keypoints(image).astype(np.float64),
        opened.landmarks[rows].astype(np.float64) + origin,
    )
    row = opened.image_poses[image]
    return reprojection_errors(view, Pose.from_quaternion(row[:4], row[4:]))


def test_content_written_again_is_the_same_map(built: Map, tmp_path: Path) -> None:
    again = published_again(built, tmp_path)

    assert again.manifest.content_hash == built.manifest.content_hash
    assert again.manifest.files == built.manifest.files


def test_rigs_and_models_in_8_bits_come_back_as_they_were(
    rgbd_walk: Map, sfm_walk: Map, tmp_path: Path
) -> None:
    for opened in (rgbd_walk, sfm_walk):
        content = content_of(opened)
        rig = {"camera": (0.8, 0.36, 0.48, 0.0, 0.1, 0.2, 1 / 3)}
        first = published(replace(content, rigs={"rig": rig}), tmp_path)
        second = published_again(first, tmp_path)
        assert second.manifest.content_hash == first.manifest.content_hash
    assert "pairs.txt" in sfm_walk.manifest.files


def test_a_selection_keeps_rows_as_they_are_and_counts_again(built: Map, tmp_path: Path) -> None:
    content = content_of(built)
    images = np.arange(8) % 2 == 0
    landmarks = np.arange(len(built.landmarks)) % 3 > 0
    part = published(selected(content, images, landmarks), tmp_path)

    assert [i.name for i in part.images] == [i.name for i in built.images[::2]]
    np.testing.assert_array_equal(part.image_poses, built.image_poses[::2])
    counts = np.zeros(len(part.landmarks), int)
    for row, image in enumerate(range(0, 8, 2)):
        seen, descriptors = built.observations(image)
        kept = landmarks[seen]
        rows, stored = part.observations(row)
        counts[rows] += 1
        np.testing.assert_array_equal(part.landmarks[rows], built.landmarks[seen[kept]])
        np.testing.assert_array_equal(stored, descriptors[kept])
        np.testing.assert_array_equal(part.keypoints(row), built.keypoints(image)[kept])
        name = built.fusion.counted(built.global_descriptors)[0]
        np.testing.assert_array_equal(
            part.global_descriptors[name][row], built.global_descriptors[name][image]
        )
    np.testing.assert_array_equal(part.track_lengths, counts)
    assert counts.min() == 1


def test_a_selection_of_observations(built: Map) -> None:
    content = content_of(built)
    kept = np.arange(len(content.landmarks.observed)) % 5 == 0
    part = selected(content, observations=kept)

    np.testing.assert_array_equal(part.landmarks.keypoints, content.landmarks.keypoints[kept])
    np.testing.assert_array_equal(
        part.landmarks.points[part.landmarks.observed],
        content.landmarks.points[content.landmarks.observed[kept]],
    )
    assert sum(len(block) for block in part.descriptors()) == kept.sum()


def test_a_moved_map_sees_the_same_from_elsewhere(built: Map, tmp_path: Path) -> None:
    geodetic = Geodetic(latitude_deg=48.0, longitude_deg=9.0, altitude_m=300.0, scale=1.5)
    assert built.manifest.world.anchor is not None
    anchor = built.manifest.world.anchor.model_copy(update={"geodetic": geodetic, "rms": 0.5})
    rig = {"camera": (1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)}
    content = replace(content_of(built), anchor=anchor, rigs={"rig": rig})
    there = published(moved(content, ELSEWHERE, metric=False), tmp_path)

    for image in (0, 5):
        np.testing.assert_allclose(
            reprojection_of(there, image), reprojection_of(built, image), atol=0.01
        )
    np.testing.assert_allclose(
        there.landmarks + np.array(there.manifest.world.origin),
        ELSEWHERE.apply(built.landmarks.astype(np.float64)),
        atol=1e-4,
    )
    assert not there.manifest.world.metric
    assert there.manifest.method.settings["voxel_size"] == pytest.approx(
        ELSEWHERE.scale * built.manifest.method.settings["voxel_size"]
    )
    assert built.gravity is not None
    assert there.gravity is not None
    np.testing.assert_allclose(there.gravity, TURN @ built.gravity, atol=1e-9)
    np.testing.assert_allclose(there.rigs["rig"]["camera"].translation, [0.25, 0.5, 0.75])
    assert there.geodetic is not None
    assert there.manifest.world.anchor is not None
    assert there.manifest.world.anchor.rms == pytest.approx(1.25)
    point = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(
        enu_of(ELSEWHERE.apply(point), there.geodetic), enu_of(point, geodetic), atol=1e-9
    )


def test_moved_there_and_back_joins_with_the_rest(built: Map, tmp_path: Path) -> None:
    content = content_of(built)
    first = np.arange(8) < 5
    a, b = selected(content, first), selected(content, ~first)
    back = moved(moved(b, ELSEWHERE, metric=False), ELSEWHERE.inverse(), metric=True)
    whole = published(joined(a, back), tmp_path)

    assert [i.name for i in whole.images] == [i.name for i in built.images]
    np.testing.assert_allclose(whole.image_poses, built.image_poses, atol=1e-9)
    np.testing.assert_array_equal(whole.observation_descriptors, built.observation_descriptors)
    np.testing.assert_array_equal(whole.landmarks[: len(a.landmarks.points)], a.landmarks.points)
    for image in range(8):
        np.testing.assert_allclose(
            whole.landmarks[whole.observations(image)[0]],
            built.landmarks[built.observations(image)[0]],
            atol=1e-4,
        )
    assert whole.colors is not None


def test_landmarks_that_both_have_can_be_one(built: Map, tmp_path: Path) -> None:
    content = content_of(built)
    first = np.arange(8) < 5
    a, b = selected(content, first), selected(content, ~first)
    row_in_a = {tuple(point): row for row, point in enumerate(a.landmarks.points.tolist())}
    same = np.array([row_in_a.get(tuple(point), -1) for point in b.landmarks.points.tolist()])
    assert 0 < (same >= 0).sum() < len(same)
    whole = published(joined(a, b, same), tmp_path)

    assert len(whole.landmarks) == len(built.landmarks)
    for image in range(8):
        rows, old = whole.observations(image)[0], built.observations(image)[0]
        np.testing.assert_array_equal(whole.landmarks[rows], built.landmarks[old])
        np.testing.assert_array_equal(whole.track_lengths[rows], built.track_lengths[old])


def test_cameras_of_one_name_that_differ_are_two(built: Map) -> None:
    content = content_of(built)
    first = np.arange(8) < 5
    name, *_ = content.cameras
    rig = dict.fromkeys((*content.cameras, "lidar"), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    a = replace(selected(content, first), rigs={"rig": rig})
    other = Camera("SIMPLE_PINHOLE", 256, 192, (200.0, 128.0, 96.0))
    b = replace(selected(content, ~first), cameras={**a.cameras, name: other}, rigs={"rig": rig})
    whole = joined(a, b)

    assert whole.cameras == {**a.cameras, f"{name}-2": other}
    there = [f"{name}-2" if i.camera == name else i.camera for i in b.images]
    assert [i.camera for i in whole.images] == [*(i.camera for i in a.images), *there]
    assert whole.rigs["rig"] == rig
    assert set(whole.rigs["rig-2"]) == {f"{name}-2", *rig} - {name}
    again = replace(a, images=tuple(replace(i, name=f"b/{i.name}") for i in a.images))
    assert (joined(a, again).cameras, joined(a, again).rigs) == (a.cameras, a.rigs)


def test_maps_that_cannot_be_joined(built: Map) -> None:
    content = content_of(built)
    with pytest.raises(Conflict) as error:
        joined(content, content)
    assert error.value.code == "merge.photos"
    assert built.images[0].name in str(error.value.got)
    other = content.local_fingerprint.model_copy(update={"name": "xfeat"})
    with pytest.raises(Conflict) as error:
        joined(content, replace(content, local_fingerprint=other))
    assert error.value.code == "merge.features"
    none = selected(content, landmarks=np.zeros(len(built.landmarks), np.bool_))
    with pytest.raises(Conflict) as error:
        joined(content, replace(none, images=()))
    assert error.value.code == "merge.landmarks"


def test_photos_go_with_their_rows(built: Map, tmp_path: Path) -> None:
    images = np.arange(8) > 5
    files = [path for path, use in zip(photo_files(built), images, strict=True) if use]
    part = published(selected(content_of(built), images), tmp_path, photos=files)

    assert [part.photo(row) for row in (0, 1)] == [built.photo(row) for row in (6, 7)]


def test_an_edit_of_a_version_that_is_no_longer_in_use_is_refused(store: MapStore) -> None:
    before = store.current_version("room")
    content = content_of(store.open("room"))
    publish_edited(store, content, "room", based_on=before)
    versions = store.versions("room")

    with pytest.raises(Conflict) as error:
        publish_edited(store, content, "room", based_on=before)

    assert error.value.code == "map.outdated"
    assert store.versions("room") == versions
    assert not any((store.root / ".incoming").iterdir())
    manifests = [
        json.loads((store.root / "room" / version / "manifest.json").read_text())
        for version in versions
    ]
    assert len({manifest["local_features"]["descriptor_scale"] for manifest in manifests}) == 1
