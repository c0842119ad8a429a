"""A query to several maps at once: which of their answers counts, through both APIs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from clients import Client, Near, RigImage
from mapping.frames.georeference import given_place, publish_anchored
from tests.service.rooms import copy_map, instants
from visloc.archive import MapStore
from visloc.kapture import read_dataset
from visloc.priors import PositionPrior, Priors

LATITUDE, LONGITUDE = 48.0, 8.0
HERE = Near(LATITUDE, LONGITUDE, 50.0)
FLOOR_M = 4.0


def anchor(maps: Path, map_id: str, altitude_m: float, yaw_deg: float = 90.0) -> None:
    opened = MapStore(maps).open(map_id)
    place = given_place(
        opened, (LATITUDE, LONGITUDE, altitude_m), yaw_deg, gravity=(0.0, 0.0, -1.0)
    )
    publish_anchored(opened, place, maps, force=True)


@pytest.fixture(scope="module")
def maps(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``room``, and ``twin``, a room that looks the same; neither is anchored."""
    maps = Path(shutil.copytree(built_maps, tmp_path_factory.mktemp("twins") / "maps"))
    copy_map(maps, "room", "twin", "v1")
    (maps / "twin" / "current").write_text("v1")
    return maps


@pytest.fixture(scope="module")
def anchored(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``room`` and ``again``, the same room, on the ground, and ``upstairs``, its twin."""
    maps = Path(shutil.copytree(built_maps, tmp_path_factory.mktemp("floors") / "maps"))
    for map_id, altitude_m in (("again", 400.0), ("upstairs", 400.0 + FLOOR_M)):
        copy_map(maps, "room", map_id, "v1")
        (maps / map_id / "current").write_text("v1")
        anchor(maps, map_id, altitude_m)
    anchor(maps, "room", 400.0)
    return maps


Serve = Callable[..., AbstractContextManager[Any]]


@pytest.fixture(scope="module")
def served(maps: Path, serve: Serve) -> Iterator[Any]:
    with serve(maps) as doors:
        yield doors


@pytest.fixture(scope="module", params=["http", "grpc"])
def client(served: Any, request: pytest.FixtureRequest) -> Iterator[Client]:
    urls = {"http": served.url, "grpc": f"grpc://127.0.0.1:{served.server.grpc_port}"}
    with Client(urls[request.param]) as client:
        yield client


@pytest.fixture(scope="module")
def on_earth(anchored: Path, serve: Serve) -> Iterator[Client]:
    with serve(anchored) as doors, Client(doors.url) as client:
        yield client


def test_a_photo_that_two_maps_explain_is_refused(client: Client, query: Any) -> None:
    assert client.localize(query.image, "twin", query.camera).localized

    for maps in (["room", "twin"], ["twin", "room"]):
        found = client.localize(query.image, maps, query.camera)
        assert found.refusal is not None
        assert (found.refusal.stage, found.refusal.reason) == ("gate", "ambiguous")
        assert "room@" in found.refusal.message
        assert "twin@v1" in found.refusal.message
        assert found.inliers > 0
        room, twin = sorted(found.refusal.candidates, key=lambda each: each.map.id)
        assert (room.map.id, twin.map.id, twin.map.version) == ("room", "twin", "v1")
        # Each is in the frame of its own map; the twin is a copy.
        for each in (room, twin):
            assert each.tile is None
            assert each.position == pytest.approx(query.cam_from_world.center, abs=0.05)
            turned = query.cam_from_world.inverse().rotation_wxyz
            assert each.orientation == pytest.approx(turned, abs=0.01)
            assert each.inliers > 30
            assert each.image in {image.image for image in found.retrieved}
        assert room.preference == pytest.approx(-twin.preference)


def test_a_rig_that_two_maps_explain_is_refused(client: Client, sample: Path) -> None:
    dataset = read_dataset(sample / "query")
    first = [r for r in dataset.images if r.timestamp == dataset.images[0].timestamp]
    images = [RigImage(r.sensor_id, dataset.path_of(r).read_bytes()) for r in first]
    assert client.localize_rig(images, "room", "rig").pose is not None

    found = client.localize_rig(images, ["room", "twin"], "rig")
    assert found.pose is None
    assert found.refusal is not None
    assert found.refusal.reason == "ambiguous"
    alone = client.localize_rig(images, "room", "rig").pose
    for each in found.refusal.candidates:
        assert each.position == pytest.approx(alone.position, abs=1e-6)
        assert each.orientation == pytest.approx(alone.orientation, abs=1e-6)
    assert {each.map.id for each in found.refusal.candidates} == {"room", "twin"}


def test_a_sequence_that_two_maps_explain_is_refused(client: Client, query: Any) -> None:
    sent = instants([query.image] * 2, query.camera)
    found = list(client.localize_sequence(sent, ["room", "twin"]))

    assert [each.timestamp for each in found] == [each.timestamp for each in sent]
    for each in found:
        assert each.pose is None
        assert each.refusal is not None
        assert each.refusal.reason == "ambiguous"
        assert {place.map.id for place in each.refusal.candidates} == {"room", "twin"}


def test_maps_of_one_frame_agree(client: Client, query: Any) -> None:
    # Whoever says in one frame where the device is says that the maps share it.
    near = Priors(position=PositionPrior(query.cam_from_world.center, 0.5))

    found = client.localize(query.image, ["room", "twin"], query.camera, priors=near)
    assert found.localized
    sent = instants([query.image], query.camera)
    (instant,) = client.localize_sequence(sent, ["room", "twin"], priors=near)
    assert instant.pose is not None


def test_anchored_maps_are_compared_on_earth(on_earth: Client, anchored: Path, query: Any) -> None:
    same = on_earth.localize(query.image, ["room", "again"], query.camera)
    assert same.localized
    first, second = MapStore(anchored).versions("room")
    versions = on_earth.localize(query.image, [f"room@{first}", f"room@{second}"], query.camera)
    assert versions.localized

    # Where maps lie on Earth says more than a prior in the frame of one of them.
    inside = Priors(position=PositionPrior(query.cam_from_world.center, 0.5))
    for where, priors in (
        (["room", "upstairs"], Priors()),
        (["room", "upstairs"], inside),
        (HERE, Priors()),
    ):
        floors = on_earth.localize(query.image, where, query.camera, priors=priors)
        assert floors.refusal is not None
        assert floors.refusal.reason == "ambiguous"
        assert "at different places" in floors.refusal.message
