"""Sets of maps through both doors, with real worker processes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from clients import Client, LocalizeResult, Near, RigImage, RigSensor
from clients import Features as SentFeatures
from clients.cli.main import main
from mapping.frames.georeference import given_place, publish_anchored
from tests.service.rooms import START, instants, quiet
from tests.service.test_coarse_answers import REFUSED
from visloc.archive import MapStore
from visloc.archive.packed import pack_map
from visloc.errors import Conflict, InvalidInput, NotFound, Unavailable
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Pose, Similarity, rotation_angle
from visloc.kapture import read_dataset
from visloc.photos.reading import read_photo
from visloc.priors import PosePrior, PositionPrior, Priors
from visloc_extensions.sets.publishing import publish_set
from visloc_extensions.sets.tests.map_sets import MODEL_FROM_ROOM, SITE_FROM_ROOM, SITE_FROM_STUDY

Serve = Callable[..., AbstractContextManager[Any]]
NOT_COMPARED = ("seconds", "request_id")


@pytest.fixture(scope="module")
def served(site: Path, serve: Serve) -> Iterator[Any]:
    with serve(site, workers=2) as doors:
        yield doors


@pytest.fixture(scope="module", params=["http", "grpc"])
def client(served: Any, request: pytest.FixtureRequest) -> Iterator[Client]:
    """Over each door."""
    urls = {"http": served.url, "grpc": f"grpc://127.0.0.1:{served.server.grpc_port}"}
    with Client(urls[request.param]) as client:
        yield client


def assert_moved(found: LocalizeResult, own: LocalizeResult, moved: Similarity) -> None:
    """The answer of a set is that of the tile, moved to the set's frame."""
    assert found.pose is not None
    assert own.pose is not None
    expected = moved.move(own.pose.cam_from_world)
    assert found.pose.position == pytest.approx(expected.center, abs=1e-9)
    turn = rotation_angle(found.pose.cam_from_world.rotation @ expected.rotation.T)
    assert turn < 1e-7
    assert found.pose.orientation_std_deg == pytest.approx(own.pose.orientation_std_deg)
    # Lengths have the set's unit, and directions the set's axes.
    spread = np.linalg.norm(own.pose.position_std) * moved.scale
    assert np.linalg.norm(found.pose.position_std) == pytest.approx(spread)
    assert (found.inliers, found.keypoints) == (own.inliers, own.keypoints)
    assert found.raw["retrieved"] == own.raw["retrieved"]


@pytest.mark.parametrize(("asked", "moved"), [("site", SITE_FROM_ROOM), ("model", MODEL_FROM_ROOM)])
def test_a_set_answers_as_its_tile_does_in_its_own_frame(
    asked: str, moved: Similarity, client: Client, site: Path, queries: list[Any]
) -> None:
    store = MapStore(site)
    for query in queries:
        own = client.localize(query.image, "room", query.camera)
        found = client.localize(query.image, asked, query.camera)
        assert_moved(found, own, moved)
        assert (found.map.id, found.map.version) == (asked, store.current_version(asked))
        assert found.tile == f"room@{store.current_version('room')}"
        assert own.tile is None
        assert found.seconds["local_features"] > 0
        assert ("choose_tiles" in found.seconds) == (asked == "site")


def test_both_doors_say_the_same(served: Any, query: Any) -> None:
    answers = []
    for url in (served.url, f"grpc://127.0.0.1:{served.server.grpc_port}"):
        with Client(url) as client:
            raw = client.localize(query.image, "site", query.camera, debug=True).raw
            answers.append({name: v for name, v in raw.items() if name not in NOT_COMPARED})
            infos = [client.map("site"), *client.maps()]
            answers[-1]["maps"] = infos
    assert answers[0] == answers[1]


def test_each_photo_is_found_in_its_own_tile(client: Client, in_study: list[Any]) -> None:
    for image, camera, cam_from_world in in_study:
        found = client.localize(image, "site", camera)
        assert found.pose is not None
        assert found.tile is not None
        assert found.tile.startswith("study@")
        away = found.pose.position - SITE_FROM_STUDY.apply(cam_from_world.center)
        assert np.linalg.norm(away) < 0.05


def test_debug_shows_points_in_the_frame_of_the_set(served: Any, query: Any) -> None:
    with Client(served.url) as client:
        own = client.localize(query.image, "room", query.camera, debug=True)
        found = client.localize(query.image, "site", query.camera, debug=True)
    assert own.debug is not None
    assert found.debug is not None
    assert found.debug.points == pytest.approx(SITE_FROM_ROOM.apply(own.debug.points))
    assert found.debug.overlay == own.debug.overlay


def test_the_picture_of_a_raised_gate_says_that_the_pose_was_refused(
    client: Client, query: Any
) -> None:
    more = {"min_probability": 1.0}
    believed = client.localize(query.image, "site", query.camera, debug=True)
    alone, refused = (
        client.localize(query.image, each, query.camera, options=more, debug=True)
        for each in ("room", "site")
    )

    assert believed.localized
    assert not alone.localized
    assert not refused.localized
    for found in (believed, alone, refused):
        assert found.debug is not None
    assert refused.debug.overlay == alone.debug.overlay
    assert refused.debug.overlay != believed.debug.overlay


def test_features_are_searched_in_a_set_as_photos_are(
    client: Client, site: Path, query: Any
) -> None:
    rgb = read_photo(query.image).rgb
    local = make_local_features("sift").extract(rgb, max_keypoints=2500)
    model = MapStore(site).open("room").global_models["densevlad"]
    vector = make_global_descriptor("densevlad").describe(rgb, local, model)
    sent = SentFeatures("sift", local.keypoints, local.descriptors, {"densevlad": vector})
    own = client.localize(sent, "room", query.camera)
    assert_moved(client.localize(sent, "site", query.camera), own, SITE_FROM_ROOM)
    for wrong in (
        SentFeatures("xfeat", local.keypoints, local.descriptors, {}),
        SentFeatures("sift", local.keypoints, local.descriptors[:, :64], {}),
    ):
        with pytest.raises(InvalidInput) as caught:
            client.localize(wrong, "site", query.camera)
        assert caught.value.code.startswith("features.")


def test_priors_choose_tiles_and_are_obeyed_in_the_frame_of_the_set(
    client: Client, query: Any
) -> None:
    true_place = SITE_FROM_ROOM.apply(query.cam_from_world.center)
    own = client.localize(query.image, "site", query.camera)
    assert own.pose is not None
    for priors in (
        Priors(maps=("room",)),
        Priors(position=PositionPrior(true_place, 0.5)),
        Priors(pose=PosePrior(own.pose.cam_from_world, own.pose.covariance)),
    ):
        found = client.localize(query.image, "site", query.camera, priors=priors)
        assert found.pose is not None
        assert found.pose.position == pytest.approx(own.pose.position, abs=0.01)

    wrong_tile = client.localize(query.image, "site", query.camera, priors=Priors(maps=("study",)))
    assert wrong_tile.pose is None
    assert wrong_tile.tile is not None
    assert wrong_tile.tile.startswith("study@")
    nowhere = Priors(position=PositionPrior(np.array([900.0, 0, 0]), 1.0))
    with pytest.raises(NotFound) as away:
        client.localize(query.image, "site", query.camera, priors=nowhere)
    assert away.value.code == "set.no_tile"
    # "twice" has no study, and a map has no tiles.
    for ref in ("twice", "room", ("room", "site")):
        with pytest.raises(InvalidInput) as caught:
            client.localize(query.image, ref, query.camera, priors=Priors(maps=("study",)))
        assert caught.value.code == "priors.maps"


def test_a_raised_gate_counts_in_a_set(client: Client, query: Any) -> None:
    own = client.localize(query.image, "site", query.camera)
    assert own.pose is not None
    assert own.pose.probability is not None
    more = {"min_probability": min(1.0, own.pose.probability + 1e-6)}
    for maps in ("site", ["site", "room"]):
        found = client.localize(query.image, maps, query.camera, options=more)
        assert found.refusal is not None
        assert found.refusal.reason == "unlikely_pose"
    less = {"min_probability": own.pose.probability}
    assert client.localize(query.image, "site", query.camera, options=less).localized
    sent = instants([query.image] * 2, query.camera)
    for each in client.localize_sequence(sent, "site", options=more):
        assert each.refusal is not None
        assert each.refusal.reason == "unlikely_pose"


def test_two_places_that_look_alike_are_no_answer(client: Client, site: Path, query: Any) -> None:
    found = client.localize(query.image, "twice", query.camera)
    assert found.pose is None
    assert found.refusal is not None
    assert (found.refusal.stage, found.refusal.reason) == ("gate", "ambiguous")
    assert f"room@{MapStore(site).current_version('room')}" in found.refusal.message
    assert "copy@v1" in found.refusal.message
    assert found.inliers > 0
    places = {place.tile: place for place in found.refusal.candidates}
    assert set(places) == {f"room@{MapStore(site).current_version('room')}", "copy@v1"}
    assert {place.map.id for place in places.values()} == {"twice"}
    for tile, place in places.items():  # in the set's frame, where each tile says that it is
        alone = client.localize(query.image, "twice", query.camera, priors=Priors(maps=(tile,)))
        assert place.position == pytest.approx(alone.pose.position, abs=1e-6)
        assert place.orientation == pytest.approx(alone.pose.orientation, abs=1e-6)
    one = client.localize(query.image, "twice", query.camera, priors=Priors(maps=("copy@v1",)))
    assert one.pose is not None
    assert one.tile == "copy@v1"


def test_of_maps_and_sets_the_best_answer_counts(client: Client, query: Any) -> None:
    found = client.localize(query.image, ["study", "site"], query.camera)
    assert found.map.id == "site"
    assert found.pose is not None


def test_what_shows_nothing_is_an_answer_and_what_is_no_photo_an_error(client: Client) -> None:
    _, blank = cv2.imencode(".png", np.zeros((64, 64), np.uint8))
    found = client.localize(blank.tobytes(), "site")
    assert found.refusal is not None
    assert found.refusal.reason == "no_keypoints"
    with pytest.raises(InvalidInput) as caught:
        client.localize(b"not a photo", "site")
    assert caught.value.code.startswith("image.")


def test_a_set_without_an_allowed_tile_leaves_the_answer_to_other_maps(
    client: Client, query: Any
) -> None:
    here = Priors(position=PositionPrior(query.cam_from_world.center, 0.5))
    found = client.localize(query.image, ["site", "room"], query.camera, priors=here)
    assert (found.map.id, found.pose is None) == ("room", False)
    with pytest.raises(NotFound) as caught:
        client.localize(query.image, ["site", "twice"], query.camera, priors=here)
    assert caught.value.code == "set.no_tile"


@pytest.mark.parametrize(("asked", "moved"), [("site", SITE_FROM_ROOM), ("model", MODEL_FROM_ROOM)])
def test_a_rig_is_localized_in_a_set(
    asked: str, moved: Similarity, client: Client, sample: Path
) -> None:
    dataset = read_dataset(sample / "query")
    first = [r for r in dataset.images if r.timestamp == dataset.images[0].timestamp]
    images = [RigImage(r.sensor_id, dataset.path_of(r).read_bytes()) for r in first]

    def rig(scale: float) -> dict[str, RigSensor]:
        """Lengths in the unit of the world that is asked."""
        return {
            r.sensor_id: RigSensor(
                Pose(
                    dataset.rigs["rig"][r.sensor_id].rotation,
                    scale * dataset.rigs["rig"][r.sensor_id].translation,
                ),
                dataset.sensors[r.sensor_id].camera,
            )
            for r in first
        }

    own = client.localize_rig(images, "room", rig(1.0))
    found = client.localize_rig([*images], asked, rig(moved.scale))
    assert own.pose is not None
    assert found.pose is not None
    expected = moved.move(own.pose.rig_from_world)
    assert found.pose.position == pytest.approx(expected.center, abs=1e-6)
    assert found.inliers == own.inliers
    assert found.tile is not None
    assert found.tile.startswith("room@")
    for image, mine in zip(found.images, own.images, strict=True):
        assert image.cam_from_world is not None
        assert mine.cam_from_world is not None
        center = moved.move(mine.cam_from_world).center
        assert image.cam_from_world.center == pytest.approx(center, abs=1e-6)
    # One that cannot be read fails alone.
    broken = [RigImage(images[0].sensor, b"not a photo"), *images[1:]]
    alone = client.localize_rig(broken, asked, rig(moved.scale))
    assert alone.pose is not None
    assert alone.images[0].error is not None


def test_a_rig_in_one_of_two_tiles_that_look_alike_is_refused_with_both(
    client: Client, sample: Path
) -> None:
    dataset = read_dataset(sample / "query")
    first = [r for r in dataset.images if r.timestamp == dataset.images[0].timestamp]
    images = [RigImage(r.sensor_id, dataset.path_of(r).read_bytes()) for r in first]

    found = client.localize_rig(images, "twice", "rig")

    assert found.pose is None
    assert found.refusal is not None
    assert found.refusal.reason == "ambiguous"
    assert len(found.refusal.candidates) == 2
    for place in found.refusal.candidates:
        assert place.tile is not None
        tile = Priors(maps=(place.tile,))
        alone = client.localize_rig(images, "twice", "rig", priors=tile)
        assert alone.pose is not None
        assert place.position == pytest.approx(alone.pose.position, abs=1e-6)
        assert place.orientation == pytest.approx(alone.pose.orientation, abs=1e-6)


def test_a_sequence_goes_from_tile_to_tile(
    client: Client, queries: list[Any], in_study: list[Any]
) -> None:
    here, there = [q.image for q in queries], [image for image, _, _ in in_study]
    camera = queries[0].camera
    photos = [here[0], here[1], there[0], b"no photo", there[1], here[0]]
    found = list(client.localize_sequence(instants(photos, camera), "site"))
    assert [each.timestamp for each in found] == [START + 100 * i for i in range(len(photos))]
    tiles = [(each.tile or "").partition("@")[0] for each in found]
    assert tiles == ["room", "room", "study", "study", "study", "room"]
    assert [each.status for each in found[:3]] == ["localized"] * 3
    assert [each.pose.metric for each in found[:3]] == [True] * 3
    assert found[3].status == "filled"
    for each, (image, moved) in zip(
        found[:2], [(q, SITE_FROM_ROOM) for q in queries[:2]], strict=True
    ):
        assert each.pose is not None
        truth = moved.apply(image.cam_from_world.center)
        assert np.linalg.norm(each.pose.position - truth) < 0.05


def test_a_sequence_is_refused_as_in_a_map(
    client: Client, query: Any, request: pytest.FixtureRequest
) -> None:
    two = instants([query.image] * 2, query.camera)
    with pytest.raises(InvalidInput) as caught:
        list(client.localize_sequence(two, ["site", "room"]))
    assert caught.value.code == "sequence.set"
    found = client.localize_sequence([two[1], two[0]], "site")
    if request.node.callspec.params["client"] == "grpc":  # there instants come one by one
        assert next(found).status == "localized"
    with pytest.raises(InvalidInput) as caught:
        next(found)
    assert (caught.value.code, caught.value.field) == (
        "sequence.timestamps",
        "instants[1].timestamp",
    )
    with pytest.raises(InvalidInput) as caught:
        list(client.localize_sequence([], "site"))
    assert caught.value.code == "sequence.empty"


def test_a_sequence_at_places_that_look_alike_has_no_pose(client: Client, query: Any) -> None:
    sent = instants([query.image] * 2, query.camera)
    for each in client.localize_sequence(sent, "twice"):
        assert each.refusal is not None
        assert each.refusal.reason == "ambiguous"
        assert each.pose is None


def test_sets_are_listed_and_described(client: Client) -> None:
    listed = {info.id: info for info in client.maps()}
    assert {info.id: info.kind for info in listed.values()} == {
        **dict.fromkeys(("copy", "room", "study"), "map"),
        **dict.fromkeys(("site", "twice", "model"), "set"),
    }
    assert (listed["site"].num_tiles, listed["site"].tiles) == (2, ())
    assert (listed["room"].num_tiles, listed["room"].method) == (None, "rgbd")
    described = client.map("site")
    assert [tile.map for tile in described.tiles] == ["room", "study"]
    moved = described.tiles[0].set_from_tile
    assert moved.rotation == pytest.approx(SITE_FROM_ROOM.rotation)
    assert moved.translation == pytest.approx(SITE_FROM_ROOM.translation)
    assert described.images == listed["room"].images + listed["study"].images
    assert (described.method, described.observations, described.fusion) == (None, None, None)
    assert client.map(described.ref).ref == described.ref


def test_points_and_photos_are_those_of_the_tiles(served: Any) -> None:
    for what in ("points", "images"):
        response: httpx.Response = served.http.get(f"/maps/site/{what}")
        assert (response.status_code, response.json()["code"]) == (422, "map.is_set")
        assert "room@" in response.json()["expected"]


def test_the_tiles_that_were_searched_are_counted(served: Any, query: Any) -> None:
    def count() -> float:
        lines = served.http.get("/metrics").text.splitlines()
        return float(
            next(x for x in lines if x.startswith("visloc_tiles_searched_count")).split()[1]
        )

    before = count()
    with Client(served.url) as client:
        client.localize(query.image, "site", query.camera)
        client.localize(query.image, "room", query.camera)
    assert count() == before + 1


def test_a_tile_in_use_stays_and_one_that_is_gone_is_an_error(
    site_copy: Path, serve: Serve, queries: list[Any], in_study: list[Any]
) -> None:
    store = MapStore(site_copy)
    version = store.current_version("study")
    with serve(site_copy) as doors, Client(doors.url) as client:
        with pytest.raises(Conflict) as kept:
            client.delete_version("study", version)
        assert kept.value.code == "map.in_set"
        image, camera, _ = in_study[0]
        assert client.localize(image, "site", camera).tile == f"study@{version}"

        (site_copy / "study").rename(site_copy / "away")
        with pytest.raises(Unavailable) as gone:
            client.localize(image, "site", camera)
        assert gone.value.code == "set.tile_unavailable"
        assert gone.value.expected == f"study@{version}"
        # A clear answer of another tile is one.
        assert client.localize(queries[0].image, "site", queries[0].camera).pose is not None
        (site_copy / "away").rename(site_copy / "study")
        assert client.localize(image, "site", camera).pose is not None

        site_version = store.current_version("site")
        client.delete_version("site", site_version)
        client.delete_version("study", version)
        assert "site" not in {info.id for info in client.maps()}


def test_a_packed_set_is_uploaded_and_put_into_use(
    site_copy: Path, serve: Serve, query: Any, tmp_path: Path
) -> None:
    store = MapStore(site_copy)
    version = store.current_version("site")
    packed = tmp_path / "site.zip"
    pack_map(store.folder("site"), packed)
    store.remove("site", version)
    with serve(site_copy) as doors, Client(doors.url) as client:
        assert client.upload_map(packed).kind == "set"
        used = client.use_version("site", version)
        assert (used.kind, used.current, used.num_tiles) == ("set", True, 2)
        assert client.localize(query.image, "site", query.camera).pose is not None


def test_a_set_on_earth_is_searched_instead_of_its_tiles(
    built_maps: Path, serve: Serve, query: Any, tmp_path: Path
) -> None:
    maps = Path(shutil.copytree(built_maps, tmp_path / "maps"))
    store = MapStore(maps)
    place = (45.2178, 5.8083, 310.0)
    anchored = given_place(store.open("room"), place, 90.0, gravity=(0.0, 0.0, -1.0))
    publish_anchored(store.open("room"), anchored, maps, force=False)
    publish_set(store, "site", [("room", SITE_FROM_ROOM)], quiet)
    near = Near(45.2178, 5.8083, 50.0)
    with serve(maps) as doors, Client(doors.url) as client:
        assert {info.id for info in client.maps(near)} == {"room", "site"}
        own = client.localize(query.image, "room", query.camera)
        found = client.localize(query.image, near, query.camera)
        assert found.map.id == "site"
        assert found.tile == f"room@{store.current_version('room')}"
        # Wherever the frame of the set lies, the photo was taken at one place on Earth.
        assert own.geopose is not None
        assert found.geopose is not None
        assert found.geopose.latitude == pytest.approx(own.geopose.latitude, abs=1e-9)
        assert found.geopose.longitude == pytest.approx(own.geopose.longitude, abs=1e-9)
        assert found.geopose.height == pytest.approx(own.geopose.height, abs=1e-4)
        turn = np.abs(np.dot(found.geopose.quaternion_xyzw, own.geopose.quaternion_xyzw))
        assert turn == pytest.approx(1.0)
        sequence = client.localize_sequence(instants([query.image], query.camera), near)
        assert [each.map.id for each in sequence] == ["site"]


def test_the_command_asks_a_set_and_names_the_tile(
    served: Any, site: Path, sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = next((sample / "query").rglob("*.jpg"))
    server = ["--server", served.url]
    tile = f"room@{MapStore(site).current_version('room')}"

    assert run(["image", str(photo), "--map", "site", *server]) == 0
    assert f"tile           {tile}" in capsys.readouterr().out
    batch = tmp_path / "batch"
    queries = str(sample / "query")
    assert run(["batch", queries, "--map", "site", "--output", str(batch), *server]) == 0
    lines = (batch / "results.jsonl").read_text().splitlines()
    assert {json.loads(line)["tile"] for line in lines} == {tile}
    report = tmp_path / "report.json"
    assert run(["benchmark", queries, "--map", "site", "--report", str(report), *server]) == 0
    assert json.loads(report.read_text())["localized"] == len(lines)
    asked = ["--map", "site", "--axis", "top-k", "--values", "2,4", "--output", str(tmp_path)]
    assert run(["compare", queries, *asked, *server]) == 0
    assert run(["maps", "list", *server]) == 0
    assert "a set of 2 maps" in capsys.readouterr().out
    assert run(["maps", "show", "site", *server]) == 0
    assert tile in capsys.readouterr().out


def run(arguments: list[str]) -> int:
    """Run ``localize`` and return what it exits with."""
    try:
        main(arguments)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_a_coarse_pose_is_stated_only_for_a_single_tile(client: Client, query: Any) -> None:
    one_tile = Priors(maps=("room",))
    result = client.localize(query.image, "site", query.camera, REFUSED)
    assert (result.status, result.coarse) == ("not_localized", None)
    alone = client.localize(query.image, "room", query.camera, REFUSED)
    tile = client.localize(query.image, "model", query.camera, REFUSED, priors=one_tile)
    assert alone.coarse is not None
    assert tile.status == "coarse"
    assert tile.coarse is not None
    # The set "model" has another unit than its tile.
    scale = np.linalg.norm(tile.coarse.position_std) / np.linalg.norm(alone.coarse.position_std)
    assert scale != pytest.approx(1.0, abs=0.01)
