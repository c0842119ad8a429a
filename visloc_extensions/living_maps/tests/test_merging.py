from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.editing import content_of, moved, selected
from mapping.own_test.publishing import publish_edited
from mapping.own_test.trials import own_test
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from mapping.stages.work_folder import exclusive
from tests.mapping.own_test.test_verdict import build as build_room
from visloc.archive import Anchor, Geodetic, Map, MapStore, SetOutline
from visloc.errors import Conflict, InvalidInput
from visloc.geometry import Pose, Similarity, rotation_angle
from visloc.kapture import read_dataset
from visloc_extensions.living_maps.merging import join_as_set, merge_maps

ELSEWHERE = Similarity(
    1.0,
    Rotation.from_euler("xyz", [30.0, -50.0, 100.0], degrees=True).as_matrix(),
    np.array([12.0, -3.0, 5.0]),
)
SCALED = replace(ELSEWHERE, scale=0.4)


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def build(dataset: Path, map_id: str, maps: Path) -> None:
    settings = BuildSettings(
        dataset, map_id, maps, local_features="sift", global_features=("localvlad",)
    )
    build_map(settings, quiet)


@pytest.fixture(scope="module")
def halves(
    walk: Path, tmp_path_factory: pytest.TempPathFactory, rewrite: Callable[..., None]
) -> MapStore:
    """Maps ``a`` and ``b`` of every second photo of the walk, built apart.

    ``b`` has a frame of its own, and ``scaled`` is it in yet another, of no known unit.
    """
    maps = tmp_path_factory.mktemp("halves")
    for name, first in (("a", 0), ("b", 1)):
        dataset = tmp_path_factory.mktemp(f"half {name}")
        (dataset / "sensors").mkdir(exist_ok=True)
        for path in (walk / "mapping/sensors").glob("*"):
            target = dataset / "sensors" / path.name
            if path.is_dir():
                target.symlink_to(path)
            else:
                target.write_bytes(path.read_bytes())
        whole = read_dataset(dataset)
        times = sorted({record.timestamp for record in whole.images})[first::2]
        frame = Similarity.identity() if name == "a" else ELSEWHERE
        rewrite(
            dataset,
            images=tuple(r for r in whole.images if r.timestamp in times),
            depth_maps=tuple(r for r in whole.depth_maps if r.timestamp in times),
            trajectories={
                key: frame.move(pose) for key, pose in whole.trajectories.items() if key[0] in times
            },
        )
        build(dataset, name, maps)
    store = MapStore(maps)
    scaled_from_b = SCALED @ ELSEWHERE.inverse()
    content = moved(content_of(store.open("b")), scaled_from_b, metric=False)
    publish_edited(store, content, "scaled")
    return store


@pytest.fixture(scope="module")
def merged(halves: MapStore) -> Map:
    merge_maps(halves, "a", "b", "both", quiet)
    return halves.open("both")


def centers(opened: Map) -> NDArray[np.float64]:
    return np.array([Pose.from_quaternion(row[:4], row[4:]).center for row in opened.image_poses])


@pytest.mark.parametrize(("other", "truth"), [("b", ELSEWHERE), ("scaled", SCALED)])
def test_halves_of_a_walk_find_each_other(halves: MapStore, other: str, truth: Similarity) -> None:
    found = merge_maps(halves, "a", other, f"a-{other}", quiet).registration
    similarity, b = found.tie.there_from_here, halves.open(other)

    off = similarity.apply(centers(b)) - truth.inverse().apply(centers(b))
    assert np.linalg.norm(off, axis=1).max() < 0.02
    assert np.degrees(rotation_angle(similarity.rotation @ truth.rotation)) < 0.5
    assert similarity.scale == pytest.approx(1 / truth.scale, rel=0 if other == "b" else 0.01)
    assert found.tie.tied.sum() >= 0.8 * found.tried
    assert found.tie.num_back > 0


def test_the_merged_map_localizes_as_a_whole(
    merged: Map,
    halves: MapStore,
    walk: Path,
    localization_errors: Callable[[Map, Path], NDArray[np.float64]],
) -> None:
    errors = localization_errors(merged, walk / "query")

    assert errors[:, 0].max() < 0.05
    assert errors[:, 1].max() < 1.0
    a, b = halves.open("a"), halves.open("b")
    assert [i.name for i in merged.images] == [i.name for i in (*a.images, *b.images)]
    count = len(a.landmarks)
    np.testing.assert_array_equal(merged.landmarks[:count], a.landmarks)
    num = len(a.observation_landmarks)
    np.testing.assert_array_equal(merged.observation_descriptors[:num], a.observation_descriptors)
    assert merged.manifest.world.metric
    assert f"{b.ref} was registered by" in merged.manifest.notes[-1]


def test_a_merged_map_is_tested_anew(merged: Map) -> None:
    learned = merged.manifest.parts.own_test
    assert learned == own_test(merged)
    assert learned.localized > 0


def test_another_building_is_refused(halves: MapStore, tmp_path: Path) -> None:
    write_sample(tmp_path, images=6, size=(256, 192), seed=7)
    build(tmp_path / "mapping", "elsewhere", halves.root)
    content = content_of(halves.open("elsewhere"))
    names = tuple(replace(image, name=f"other/{image.name}") for image in content.images)
    publish_edited(halves, replace(content, images=names), "elsewhere")

    with pytest.raises(Conflict) as error:
        merge_maps(halves, "a", "elsewhere", "wrong", quiet)

    assert error.value.code == "merge.overlap"
    assert "wrong" not in halves.ids()


@pytest.mark.parametrize(
    ("method", "factor", "why"),
    [
        ("rgbd", 1.2, "is 1.2 times as far"),
        ("sfm", 1.2, "a metre of theirs is 0.83"),
        ("rgbd", 3.2808, "a metre of theirs is 0.30"),
        ("sfm", 3.2808, "a metre of theirs is 0.30"),
    ],
)
def test_maps_of_different_metres_are_refused(
    halves: MapStore, method: str, factor: float, why: str
) -> None:
    longer = Similarity(factor, np.eye(3), np.zeros(3))
    content = moved(content_of(halves.open("b")), longer, metric=True)
    # Depth tells of landmarks that depth made.
    settings = {**content.settings, "updates": [{"method": method}]}
    publish_edited(halves, replace(content, settings=settings), "longer")

    with pytest.raises(Conflict) as error:
        merge_maps(halves, "a", "longer", "wrong", quiet)

    assert error.value.code == "merge.unit"
    assert why in error.value.message
    assert "not show the same place" not in error.value.message
    assert "wrong" not in halves.ids()


def test_the_down_of_the_first_and_the_updates_of_both_stay(halves: MapStore) -> None:
    here = Geodetic(latitude_deg=45.0, longitude_deg=5.8, altitude_m=300.0)
    anchor = Anchor(kind="correspondences", images=4, geodetic=here)
    a, b = content_of(halves.open("a")), content_of(halves.open("b"))
    updates = [{"capture": "one", "method": "rgbd"}, {"capture": "two", "method": "sfm"}]
    of_a = {**a.settings, "updates": updates[:1]}
    of_b = {**b.settings, "updates": updates[1:]}
    publish_edited(halves, replace(a, anchor=anchor, settings=of_a), "on-earth")
    publish_edited(halves, replace(b, gravity=(1.0, 0.0, 0.0), settings=of_b), "tilted")

    merge_maps(halves, "on-earth", "tilted", "upright", quiet)

    merged = halves.open("upright")
    assert merged.manifest.method.name == "rgbd"
    assert merged.manifest.method.settings["updates"] == updates
    down = merged.gravity
    assert down is not None
    np.testing.assert_allclose(down, [0, 0, -1], atol=1e-12)


def test_too_little_overlap_is_refused(halves: MapStore) -> None:
    a = content_of(halves.open("a"))
    blind = np.arange(len(a.images)) < 3  # of the others, nothing but their names is left
    offsets, seen = a.landmarks.offsets, np.arange(len(a.landmarks.observed))
    kept = np.repeat(blind, np.diff(offsets)) | (seen % 50 == 0)
    content = selected(content_of(halves.open("b")))
    publish_edited(halves, selected(a, observations=kept), "blind")
    publish_edited(halves, content, "sighted")

    with pytest.raises(Conflict) as error:
        merge_maps(halves, "sighted", "blind", "too-little", quiet, min_overlap=0.95)

    assert error.value.code == "merge.overlap"


def test_a_version_in_doubt_is_not_merged(broken: Path, maps_dir: Path) -> None:
    store = MapStore(maps_dir)
    good = store.current_version("room")
    ref = f"room@{build_room(broken, maps_dir).manifest.version}"

    with pytest.raises(Conflict) as caught:
        merge_maps(store, f"room@{good}", ref, "both", quiet)
    assert caught.value.code == "map.doubtful"
    assert store.ids() == ["room"]


def test_what_cannot_be_merged(halves: MapStore) -> None:
    content = content_of(halves.open("a"))
    other = content.local_fingerprint.model_copy(update={"revision": 99})
    publish_edited(halves, replace(content, local_fingerprint=other), "newer")
    publish_edited(halves, content, "twin")
    for second, new, code in (
        ("newer", "new", "merge.features"),
        ("twin", "new", "merge.photos"),
        ("b", "twin", "map.exists"),
    ):
        with pytest.raises(Conflict) as error:
            merge_maps(halves, "a", second, new, quiet)
        assert error.value.code == code
    for second, overlap, code in (("a", 0.1, "merge.same"), ("b", 0.0, "merge.min_overlap")):
        with pytest.raises(InvalidInput) as wrong:
            merge_maps(halves, "a", second, "new", quiet, min_overlap=overlap)
        assert wrong.value.code == code


def test_descriptors_with_models_of_their_own_are_learned_anew_or_left_out(
    halves: MapStore, merged: Map
) -> None:
    a = content_of(halves.open("a"))
    (localvlad,) = a.global_features
    of_photos = replace(
        localvlad,
        fingerprint=localvlad.fingerprint.model_copy(update={"name": "densevlad"}),
    )
    for name in ("a", "b"):
        content = content_of(halves.open(name))
        mine = replace(of_photos, descriptors=content.global_features[0].descriptors)
        if name == "b":  # learned of other photos
            vocabulary = localvlad.model["vocabulary"]
            mine = replace(mine, model={**mine.model, "vocabulary": vocabulary + np.float32(1)})
        both = (*content.global_features, mine)
        publish_edited(halves, replace(content, global_features=both), f"{name}-dense")
    found = merge_maps(halves, "a-dense", "b-dense", "dense", quiet)
    result = halves.open("dense")

    assert list(result.global_descriptors) == ["localvlad"]
    assert "densevlad left out" in found.notes[0]
    assert found.notes[0] in result.manifest.notes
    lengths = np.linalg.norm(result.global_descriptors["localvlad"][:], axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-3)
    assert list(merged.global_descriptors) == ["localvlad"]


@pytest.mark.parametrize("join", [merge_maps, join_as_set])
def test_the_name_is_checked_before_anything_is_done(
    join: Callable[..., object], halves: MapStore
) -> None:
    victim = halves.root.parent / "victim.lock"
    victim.write_text("precious")
    told: list[str] = []
    for name in ("../../victim", "bad name!"):
        with pytest.raises(InvalidInput) as error:
            join(halves, "a", "b", name, lambda stage, _done, _total: told.append(stage))
        assert (error.value.code, error.value.field) == ("map.id", "--map")
    assert told == []
    assert victim.read_text() == "precious"
    assert not (halves.root / ".work" / "bad name!.lock").exists()


@pytest.mark.parametrize("join", [merge_maps, join_as_set])
def test_a_name_that_was_taken_meanwhile_is_not_replaced(
    join: Callable[..., object], halves: MapStore
) -> None:
    name = f"taken-{join.__name__}"

    def take(_stage: str, _done: int, _total: int) -> None:
        with pytest.raises(Conflict) as running, exclusive(halves.root / ".work" / f"{name}.lock"):
            pass
        assert running.value.code == "build.running"
        if name not in halves.ids():
            publish_edited(halves, content_of(halves.open("a")), name)

    with pytest.raises(Conflict) as error:
        join(halves, "a", "b", name, take)
    assert error.value.code == "map.exists"
    assert len(halves.versions(name)) == 1


def test_a_set_of_both_leaves_them_as_they_are(halves: MapStore) -> None:
    versions = halves.versions("a"), halves.versions("b")
    join_as_set(halves, "a", "b", "pair", quiet)
    outline = halves.outline("pair")

    assert isinstance(outline, SetOutline)
    assert [tile.map for tile in outline.manifest.tiles] == ["a", "b"]
    found = outline.manifest.tiles[1].set_from_tile.similarity
    middle = centers(halves.open("b")).mean(axis=0)
    np.testing.assert_allclose(found.apply(middle), ELSEWHERE.inverse().apply(middle), atol=0.02)
    assert (halves.versions("a"), halves.versions("b")) == versions


def test_the_command_says_how_well_they_fit(halves: MapStore) -> None:
    result = CliRunner().invoke(
        app,
        ["merge", "a", "b", "--map", "printed", "--maps-dir", str(halves.root)],
        catch_exceptions=False,
    )

    assert "8 of 8 photos localized" in result.output
    assert "medians of the tied" in result.output
    assert "A from B: scale 1, rotation" in result.output
    assert f"published: printed@{halves.current_version('printed')}" in result.output
