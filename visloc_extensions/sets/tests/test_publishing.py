"""Sets of maps: where their maps lie, maps cut into tiles, and photos localized in them."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.cli import main as cli
from mapping.maps.editing import content_of, moved
from mapping.own_test.publishing import publish_edited
from mapping.own_test.verdict import misses_own_photos
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import Anchor, Geodetic, Map, MapStore, SetOutline
from visloc.archive.places import enu_of
from visloc.errors import Conflict, InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geodesy import geodetic_from_enu
from visloc.geometry import Pose, Similarity
from visloc.kapture import read_dataset
from visloc.localization.acceptance.judge import TIE_REACH_SHARE, PlaceAnswer, Tie, judge
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.localization.solving import SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.priors import NO_PRIORS, HeightBand, PositionPrior, Priors
from visloc.types import Reason, Refusal
from visloc_extensions.sets.choosing import allowed_tiles, plan
from visloc_extensions.sets.coarse import rank_tiles
from visloc_extensions.sets.files import open_set
from visloc_extensions.sets.frame import answer_in_set, priors_in_tile
from visloc_extensions.sets.poses import poses_on_earth, read_poses
from visloc_extensions.sets.publishing import publish_set
from visloc_extensions.sets.splitting import cut, split_map

TURN = Pose.from_quaternion([0.8, 0.1, -0.5, 0.3], [0, 0, 0]).rotation
ELSEWHERE = Similarity(1.0, TURN, np.array([300.0, -40.0, 7.0]))
# As above, with the same down.
BESIDE = Similarity(
    1.0, Pose.from_quaternion([0.8, 0, 0, 0.6], [0, 0, 0]).rotation, ELSEWHERE.translation
)


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


@pytest.fixture(scope="module")
def hall_sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample of a hall")
    write_sample(folder, images=24, size=(256, 192))
    return folder


@pytest.fixture(scope="module")
def hall_maps(hall_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with the map ``hall`` of 24 photos, and its set ``halls``; only to be read."""
    maps = tmp_path_factory.mktemp("maps of a hall")
    settings = BuildSettings(
        hall_sample / "mapping",
        "hall",
        maps,
        local_features="sift",
        global_features=("localvlad",),
        gravity=(0.0, 0.0, -1.0),
        keep_photos=True,
    )
    build_map(settings, quiet)
    split_map(MapStore(maps), "hall", "halls", quiet, tile=2.0, overlap=0.4)
    return maps


@pytest.fixture
def store(hall_maps: Path, tmp_path: Path) -> MapStore:
    return MapStore(Path(shutil.copytree(hall_maps, tmp_path / "maps")))


@pytest.fixture(scope="module")
def hall(hall_maps: Path) -> Map:
    return MapStore(hall_maps).open("hall")


def moved_map(store: MapStore, ref: str, map_id: str, new_from_old: Similarity) -> str:
    """Publish a map in another frame; its reference."""
    content = moved(content_of(store.open(ref)), new_from_old, metric=new_from_old.scale == 1)
    folder = publish_edited(store, content, map_id)
    return f"{map_id}@{folder.name}"


def publish(store: MapStore, set_id: str, tiles: list[tuple[str, Similarity]]) -> Path:
    """Publish a set with a model that was learned before; most of the time goes into that."""
    model = open_set(store.folder("halls")).coarse.model
    return publish_set(store, set_id, tiles, quiet, model=model)


# Splitting


def test_every_photo_is_in_a_tile_and_its_landmarks_too(store: MapStore, hall: Map) -> None:
    outline = store.outline("halls")
    assert isinstance(outline, SetOutline)
    assert len(outline.tiles) > 1
    tiles = [store.open(tile.ref) for tile in outline.tiles]
    names = [{image.name for image in tile.images} for tile in tiles]
    assert set().union(*names) == {image.name for image in hall.images}
    assert sum(map(len, names)) > len(hall.images)  # the overlap
    by_name = {image.name: row for row, image in enumerate(hall.images)}
    origin = np.array(hall.manifest.world.origin)
    for tile in tiles:
        assert len(tile.images) >= 5
        for row, image in enumerate(tile.images):
            seen, descriptors = tile.observations(row)
            whole_seen, whole_descriptors = hall.observations(by_name[image.name])
            np.testing.assert_array_equal(descriptors, whole_descriptors)
            np.testing.assert_array_equal(
                tile.landmarks[seen] + np.array(tile.manifest.world.origin),
                hall.landmarks[whole_seen] + origin,
            )
            np.testing.assert_array_equal(
                tile.image_poses[row], hall.image_poses[by_name[image.name]]
            )
            assert tile.photo(row) == hall.photo(by_name[image.name])
        assert tile.manifest.global_features[0].fingerprint.name == "localvlad"
        assert tile.gravity is not None
        np.testing.assert_array_equal(tile.gravity, hall.gravity)


def test_tiles_follow_a_grid_across_gravity(hall: Map) -> None:
    geometry = MapGeometry(hall)
    flat = geometry.centers[:, :2] - geometry.centers[:, :2].min(axis=0)
    for one in cut(hall, 2.0, 0.0):
        low = 2.0 * np.array(one.cell)
        inside = ((flat >= low) & (flat < low + 2.0)).all(axis=1)
        assert (one.photos >= inside).all()
    with_margin = cut(hall, 2.0, 0.5)
    for one, wide in zip(cut(hall, 2.0, 0.0), with_margin, strict=True):
        assert one.cell == wide.cell
        assert (wide.photos >= one.photos).all()
    assert sum(int(one.photos.sum()) for one in cut(hall, 2.0, 0.0)) == len(flat)


def test_a_grid_turns_with_gravity(hall: Map, store: MapStore) -> None:
    turned = store.open(moved_map(store, "hall", "turned", ELSEWHERE))

    # Down is no axis of the world any more: the same floor is cut, along other lines.
    for one in cut(turned, 2.0, 0.0):
        spread = MapGeometry(turned).centers[one.photos]
        assert np.ptp(spread, axis=0).max() < 4.5
    assert sum(int(one.photos.sum()) for one in cut(turned, 2.0, 0.0)) == len(hall.images)


def test_lone_photos_join_the_nearest_tile(hall: Map) -> None:
    # So small that most cells have one photo or two.
    cuts = cut(hall, 0.8, 0.0)

    assert sum(int(one.photos.sum()) for one in cuts) == len(hall.images)
    assert all(one.photos.sum() >= 5 for one in cuts) or len(cuts) == 1


def test_a_map_of_one_cell_is_one_tile(hall: Map) -> None:
    (only,) = cut(hall, 1000.0, 0.0)

    assert only.cell == (0, 0)
    assert only.photos.all()


@pytest.mark.parametrize(
    ("tile", "overlap", "code"),
    [
        (0.0, 0.0, "split.tile"),
        (math.nan, 0.0, "split.tile"),
        (1e-9, 0.0, "split.tile"),
        (1e-300, 0.0, "split.tile"),
        (2.0, -1.0, "split.overlap"),
        (2.0, 3.0, "split.overlap"),
    ],
)
def test_tiles_of_no_size_are_refused(hall: Map, tile: float, overlap: float, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        cut(hall, tile, overlap)
    assert caught.value.code == code


def test_tiles_carry_the_test_of_their_map(store: MapStore, hall: Map) -> None:
    """They share its landmarks and frame, and it was tested with more photos than each has."""
    tiles = store.outline("halls")
    assert isinstance(tiles, SetOutline)
    assert hall.manifest.parts.own_test is not None
    for tile in tiles.tiles:
        assert store.open(tile.ref).manifest.parts.own_test == hall.manifest.parts.own_test
        assert tile.misses_own_photos == misses_own_photos(hall.manifest.parts.own_test)


def test_an_interrupted_split_goes_on(store: MapStore) -> None:
    before = store.outline("halls")
    assert isinstance(before, SetOutline)
    first, *others = before.tiles
    store.remove("halls", before.manifest.version)
    for tile in others:
        store.remove(tile.map, tile.version)

    split_map(store, "hall", "halls", quiet, tile=2.0, overlap=0.4)

    again = store.outline("halls")
    assert isinstance(again, SetOutline)
    assert again.tiles[0] == first
    hashes = [tile.content_hash for tile in before.tiles]
    assert [tile.content_hash for tile in again.tiles] == hashes
    assert again.manifest.content_hash != before.manifest.content_hash  # it names other versions
    folder = store.folder("halls")
    assert split_map(store, "hall", "halls", quiet, tile=2.0, overlap=0.4) == folder

    # A tile that was updated since stays so, whether what was cut is still there or not.
    updated = content_of(store.open(first.map))
    publish_edited(store, replace(updated, notes=(*updated.notes, "updated")), first.map)
    in_use = store.current_version(first.map)
    assert split_map(store, "hall", "halls", quiet, tile=2.0, overlap=0.4) == folder
    assert store.current_version(first.map) == in_use
    store.remove("halls", folder.name)
    store.remove(first.map, first.version)
    split_map(store, "hall", "halls", quiet, tile=2.0, overlap=0.4)
    assert store.current_version(first.map) == in_use
    assert len(store.versions(first.map)) == 2


def test_the_id_of_a_map_is_refused_before_the_long_part(store: MapStore) -> None:
    before = store.ids()
    with pytest.raises(Conflict) as caught:
        split_map(store, "hall", "hall", quiet, tile=2.0, overlap=0.4)
    assert caught.value.code == "set.id_is_map"
    assert caught.value.field == "--set"
    said: list[str] = []
    with pytest.raises(Conflict) as caught:
        publish_set(
            store,
            "hall",
            [("halls-0-0", Similarity.identity())],
            lambda stage, *_: said.append(stage),
        )
    assert caught.value.code == "set.id_is_map"
    assert caught.value.field == "ID"
    with pytest.raises(InvalidInput) as wrong:
        split_map(store, "hall", "h" * 62, quiet, tile=2.0, overlap=0.4)
    assert (wrong.value.code, wrong.value.field) == ("map.id", "--set")
    assert said == []
    assert store.ids() == before


def test_a_map_of_others_is_not_taken_over_as_a_tile(store: MapStore) -> None:
    version = moved_map(store, "hall", "depot-0-0", Similarity.identity())

    with pytest.raises(Conflict) as caught:
        split_map(store, "hall", "depot", quiet, tile=50.0, overlap=1.0)
    assert (caught.value.code, caught.value.got) == ("split.map_exists", "depot-0-0")
    assert store.open("depot-0-0").ref == version


# Localizing in a set


def queries_of(sample: Path) -> list[tuple[Any, Any, Pose]]:
    queries = read_dataset(sample / "query")
    found = []
    for record in queries.images:
        truth = queries.pose(record)
        assert truth is not None
        photo = read_photo_file(queries.path_of(record))
        found.append((photo, queries.sensors[record.sensor_id].camera, truth))
    return found


def localize_in(store: MapStore, set_id: str, photo: Any, camera: Any, priors: Priors) -> Any:
    """As the service does it, in this process: a tile after the other."""
    extractor = make_local_features("sift")
    opened = open_set(store.folder(set_id))
    allowed = allowed_tiles(opened, priors)
    scores = rank_tiles(opened, extractor.extract(photo.rgb, max_keypoints=2500), allowed)
    first, rest = plan(scores)
    found = []
    for row in (*first, *rest):
        tile = opened.tiles[row]
        set_from_tile = tile.set_from_tile.similarity
        localizer = Localizer(store.open(tile.ref), extractor)
        options, in_tile = LocalizeOptions(), priors_in_tile(priors, set_from_tile, opened.gravity)
        look = localizer.look(photo, camera, options, in_tile)
        seen = SeenImage("camera", Pose.identity(), look)
        answer = localizer.solve([seen], options, in_tile).answer
        in_set = answer_in_set(answer, set_from_tile, opened.ref)
        found.append(PlaceAnswer(opened.ref, in_set, tile.ref))
    tie = Tie(Similarity.identity(), TIE_REACH_SHARE * float(opened.reaches.max()))
    chosen = judge(found, lambda *_: tie)
    return chosen if isinstance(chosen, Refusal) else found[chosen]


def test_photos_are_localized_in_a_split_map(store: MapStore, hall_sample: Path) -> None:
    for photo, camera, truth in queries_of(hall_sample):
        found = localize_in(store, "halls", photo, camera, NO_PRIORS)
        assert found.answer.pose is not None
        metres, degrees = pose_error(found.answer.pose.rig_from_world, truth)
        assert metres < 0.1
        assert degrees < 2.0


def test_a_tile_moved_by_a_similarity_gives_the_same_answer(
    store: MapStore, hall_sample: Path
) -> None:
    moved_by = Similarity(2.5, TURN, np.array([30.0, -400.0, 7.0]))
    there = moved_map(store, "hall", "there", moved_by)
    publish(store, "one", [("hall", Similarity.identity())])
    publish(store, "other", [(there, moved_by.inverse())])
    a, b = (store.outline(set_id) for set_id in ("one", "other"))
    np.testing.assert_allclose(a.photo_boxes, b.photo_boxes, atol=1e-4)  # type: ignore[union-attr]
    np.testing.assert_allclose(a.reaches, b.reaches, rtol=1e-4)  # type: ignore[union-attr]
    for photo, camera, truth in queries_of(hall_sample)[:2]:
        near = Priors(position=PositionPrior(truth.center, 1.0))
        for priors in (NO_PRIORS, near):
            here, away = (
                localize_in(store, set_id, photo, camera, priors).answer.pose
                for set_id in ("one", "other")
            )
            assert here is not None
            assert away is not None
            metres, degrees = pose_error(here.rig_from_world, away.rig_from_world)
            assert metres < 1e-3
            assert degrees < 0.02
            np.testing.assert_allclose(here.position_std, away.position_std, rtol=0.02)


def test_priors_weigh_photos_alike_in_both_frames(store: MapStore, hall: Map) -> None:
    moved_by = Similarity(2.5, TURN, np.array([30.0, -400.0, 7.0]))
    there = store.open(moved_map(store, "hall", "there", moved_by))
    priors = Priors(position=PositionPrior(MapGeometry(hall).centers[3], 0.2))

    expected = Constraints(MapGeometry(hall), priors).photo_weights
    inside = priors_in_tile(priors, moved_by.inverse(), hall.gravity)

    found = Constraints(MapGeometry(there), inside).photo_weights
    assert expected is not None
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_one_place_in_two_tiles_apart_is_refused(store: MapStore, hall_sample: Path) -> None:
    twin = moved_map(store, "hall", "twin", Similarity.identity())
    tiles = [("hall", Similarity.identity()), (twin, BESIDE)]
    publish(store, "twins", tiles)
    photo, camera, truth = queries_of(hall_sample)[0]

    refusal = localize_in(store, "twins", photo, camera, NO_PRIORS)
    assert isinstance(refusal, Refusal)
    assert refusal.reason is Reason.AMBIGUOUS
    # A prior settles it.
    known = localize_in(store, "twins", photo, camera, Priors(maps=("twin",)))
    assert known.ref.startswith("twin@")
    assert pose_error(known.answer.pose.rig_from_world, BESIDE.move(truth))[0] < 0.1


# Where maps lie


def test_poses_are_read_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(
        "# floors\n\nfirst 1 0 0 0  0 0 3.5   2  # upstairs\nground@v1 0.6 0.8 0 0 1 2 3\n"
    )

    (ground, a), (first, b) = read_poses(tmp_path / "poses.txt", ["ground@v1", "first"])

    assert (ground, first) == ("ground@v1", "first")
    assert a.scale == 1.0
    np.testing.assert_allclose(a.rotation, Pose.from_quaternion([0.6, 0.8, 0, 0], [0] * 3).rotation)
    assert b.scale == 2.0
    np.testing.assert_allclose(b.translation, [0, 0, 3.5])


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("a 1 0 0 0 0 0 0", "set.poses"),  # b has none
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 0 0", "set.poses"),
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 0 0 0 0", "set.poses"),
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 0 0 0 1e-10", "set.poses"),
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 0 0 0 1e10", "set.poses"),
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 0 0 x", "set.poses"),
        ("a 1 0 0 0 0 0 0\na 1 0 0 0 0 0 0", "set.poses"),
        ("a 1 0 0 0 0 0 0\nc 1 0 0 0 0 0 0", "set.poses"),
        ("a 1 0 0 0 0 0 0\nb 0 0 0 0 0 0 0", "pose.rotation"),
        ("a 1 0 0 0 0 0 0\nb 1 0 0 0 nan 0 0", "pose.translation"),
    ],
)
def test_poses_that_do_not_fit_are_refused(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "poses.txt").write_text(text)

    with pytest.raises(InvalidInput) as caught:
        read_poses(tmp_path / "poses.txt", ["a", "b"])
    assert caught.value.code == code
    assert "poses.txt" in str(caught.value.field)


def anchored(store: MapStore, map_id: str, geodetic: Geodetic) -> None:
    anchor = Anchor(kind="correspondences", images=4, geodetic=geodetic)
    publish_edited(store, replace(content_of(store.open("hall")), anchor=anchor), map_id)


def on_earth(points: NDArray[np.float64], geodetic: Geodetic) -> NDArray[np.float64]:
    origin = np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])
    return geodetic_from_enu(enu_of(points, geodetic), origin)


def test_maps_on_earth_lie_where_their_anchors_say(store: MapStore) -> None:
    here = Geodetic(latitude_deg=45.0, longitude_deg=5.8, altitude_m=300.0)
    yaw = 0.3
    there = Geodetic(
        latitude_deg=45.01,
        longitude_deg=5.82,
        altitude_m=310.0,
        scale=1.0,
        rotation_wxyz=(math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)),
        translation=(1.0, 2.0, 3.0),
    )
    anchored(store, "here", here)
    anchored(store, "there", there)

    tiles = poses_on_earth(store, ["here", "there"])
    publish(store, "earth", tiles)

    outline = store.outline("earth")
    assert isinstance(outline, SetOutline)
    assert outline.manifest.world.metric
    assert outline.geodetic is not None
    points = np.random.default_rng(0).normal(size=(5, 3))
    for (_, set_from_tile), geodetic in zip(tiles, (here, there), strict=True):
        # Degrees: 1e-10 of them are a hundredth of a millimetre.
        np.testing.assert_allclose(
            on_earth(set_from_tile.apply(points), outline.geodetic),
            on_earth(points, geodetic),
            rtol=0,
            atol=1e-6,
        )
        np.testing.assert_allclose(
            on_earth(set_from_tile.apply(points), outline.geodetic)[:, :2],
            on_earth(points, geodetic)[:, :2],
            rtol=0,
            atol=1e-10,
        )
    assert outline.place is not None
    assert outline.place.distance_to(45.01, 5.82) == 0
    assert outline.gravity is not None
    np.testing.assert_allclose(outline.gravity, [0, 0, -1], atol=1e-3)  # the Earth is round


def test_anchors_that_contradict_where_maps_lie_are_refused(store: MapStore) -> None:
    here = Geodetic(latitude_deg=45.0, longitude_deg=5.8, altitude_m=300.0)
    anchored(store, "here", here)
    anchored(store, "near", here.model_copy(update={"longitude_deg": 5.8001}))  # 8 m
    anchored(store, "far", here.model_copy(update={"longitude_deg": 5.801}))  # 80 m
    same = Similarity.identity()

    publish(store, "earth", [("here", same), ("near", same)])
    with pytest.raises(Conflict, match="far@") as caught:
        publish(store, "earth", [("here", same), ("far", same)])
    assert caught.value.code == "set.anchor"
    assert caught.value.field == "MAP"


def test_a_set_knows_down_when_all_of_its_maps_do(store: MapStore) -> None:
    content = replace(content_of(store.open("hall")), gravity=None)
    here = Geodetic(latitude_deg=45.0, longitude_deg=5.8, altitude_m=300.0)
    anchor = Anchor(kind="correspondences", images=4, geodetic=here)
    publish_edited(store, replace(content, anchor=anchor), "anchored")
    publish_edited(store, content, "blind")
    same = Similarity.identity()
    publish(store, "half", [("anchored", same), ("blind", same)])
    publish(store, "both", [("anchored", same), ("hall", same)])

    half, both = store.outline("half"), store.outline("both")
    assert half.gravity is None
    assert isinstance(half, SetOutline)
    assert half.geodetic == here
    with pytest.raises(InvalidInput, match="this set does not know"):
        allowed_tiles(half, Priors(height=HeightBand(0.0, 3.0)))
    assert both.gravity is not None
    np.testing.assert_allclose(both.gravity, [0, 0, -1])


def test_a_map_without_a_place_needs_a_pose(store: MapStore) -> None:
    with pytest.raises(InvalidInput, match="not anchored to the Earth") as caught:
        poses_on_earth(store, ["hall"])
    assert caught.value.code == "set.poses"


def test_maps_that_contradict_each_other_are_refused(store: MapStore) -> None:
    flat, tilted = Similarity.identity(), ELSEWHERE
    copy = moved_map(store, "hall", "copy", Similarity.identity())
    larger = Similarity(1.5, np.eye(3), np.zeros(3))

    with pytest.raises(Conflict, match="the down direction of") as caught:
        publish(store, "pair", [("hall", flat), (copy, tilted)])
    assert caught.value.code == "set.gravity"
    assert caught.value.field == "MAP"
    with pytest.raises(Conflict, match="different lengths") as caught:
        publish(store, "pair", [("hall", flat), (copy, larger)])
    assert caught.value.code == "set.scale"
    assert caught.value.field == "MAP"
    for twice in (["hall", "hall"], ["hall", f"hall@{store.current_version('hall')}"]):
        with pytest.raises(InvalidInput, match="named twice") as wrong:
            publish(store, "pair", [(ref, flat) for ref in twice])
        assert wrong.value.code == "set.tiles"
    with pytest.raises(InvalidInput) as wrong:
        publish(store, "pair", [])
    assert wrong.value.code == "set.tiles"
    with pytest.raises(InvalidInput) as wrong:
        publish(store, "pair", [("halls", flat)])
    assert wrong.value.code == "map.is_set"


def test_a_set_in_other_units_is_not_metric(store: MapStore) -> None:
    publish(store, "feet", [("hall", Similarity(1 / 0.3048, TURN, np.zeros(3)))])
    small = moved_map(store, "hall", "small", Similarity(0.1, np.eye(3), np.zeros(3)))
    publish(store, "model", [(small, Similarity.identity())])
    publish(
        store,
        "mixed",
        [("hall", Similarity.identity()), (small, Similarity(10.0, np.eye(3), np.zeros(3)))],
    )

    metric = {name: store.outline(name).manifest.world.metric for name in ("feet", "model")}
    assert metric == {"feet": False, "model": False}
    assert store.outline("mixed").manifest.world.metric


# The commands


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["mapping", *arguments])
    try:
        cli.main()
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


@pytest.fixture
def command(
    store: MapStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    def call(*arguments: str) -> tuple[int, str]:
        status = run(monkeypatch, *arguments, "--maps-dir", str(store.root))
        said = capsys.readouterr()
        return status, said.out + said.err

    return call


def test_commands_make_show_and_check_sets(
    command: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    (tmp_path / "poses.txt").write_text("hall 1 0 0 0 0 0 0\n")

    for arguments in (
        ("split", "hall", "--tile", "2m", "--set", "cut"),
        ("split", "hall", "--tile", "2", "--overlap", "1m", "--set", "cut"),
        ("set", "one", "hall", "--poses", str(tmp_path / "poses.txt")),
        ("inspect", "one"),
        ("pack", "cut", "--output", str(tmp_path / "cut.zip")),
    ):
        status, said = command(*arguments)
        assert status == 0, said
    assert "set one@" in command("inspect", "one")[1]
    assert "tiles: as the set names them" in command("verify", "cut")[1]
    summary = json.loads(command("inspect", "one", "--json")[1])
    assert [tile["map"] for tile in summary["tiles"]] == ["hall"]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("split", "hall", "--tile", "wide", "--set", "cut"), "split.tile"),
        (("split", "hall", "--tile", "2m", "--overlap", "3m", "--set", "cut"), "split.overlap"),
        (("split", "halls", "--tile", "2m", "--set", "cut"), "map.is_set"),
        (("set", "one", "hall"), "set.poses"),
        (("set", "one", "hall", "--poses", "nowhere.txt"), "set.poses"),
        (("set", "hall", "nothing"), "map.unknown"),
    ],
)
def test_commands_say_what_is_wrong(
    command: Callable[..., tuple[int, str]], arguments: tuple[str, ...], code: str
) -> None:
    status, said = command(*arguments)

    assert (status, code in said) == (1, True), said


def test_metres_of_a_map_without_are_refused(
    store: MapStore, command: Callable[..., tuple[int, str]]
) -> None:
    moved_map(store, "hall", "small", Similarity(0.1, np.eye(3), np.zeros(3)))

    status, said = command("split", "small", "--tile", "2m", "--set", "cut")
    assert (status, "lengths in metres have no meaning" in said) == (1, True)
    assert command("split", "small", "--tile", "0.2", "--set", "cut")[0] == 0
