"""GeoPoses of a map that is tied to the Earth, over both doors and in the OSCP protocol."""

from __future__ import annotations

import base64
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict

from clients import Client, Near, RigImage, RigSensor
from mapping.frames.georeference import given_place, publish_anchored
from visloc.archive import MapStore
from visloc.geometry import Pose
from visloc.geopose import geopose_of
from visloc_api.v1 import localization_pb2 as pb2

if TYPE_CHECKING:
    from conftest import Query
    from tests.service.conftest import Doors

LATITUDE, LONGITUDE, ALTITUDE = 45.2178, 5.8083, 310.0
PLACE = Near(LATITUDE, LONGITUDE, 50.0)


@pytest.fixture(scope="module")
def anchored_maps(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map ``room``, its x axis pointing north, and ``hall``, the same without a place."""
    maps = tmp_path_factory.mktemp("anchored") / "maps"
    shutil.copytree(built_maps, maps)
    room = MapStore(maps).open("room")
    place = (LATITUDE, LONGITUDE, ALTITUDE)
    found = given_place(room, place, 90.0, accuracy=0.1, gravity=(0.0, 0.0, -1.0))
    publish_anchored(room, found, maps, force=False)
    return maps


@pytest.fixture(scope="module")
def doors(
    anchored_maps: Path, serve: Callable[..., AbstractContextManager[Doors]]
) -> Iterator[Doors]:
    with serve(anchored_maps, max_batch_bytes=600_000, max_rig_images=3) as doors:
        yield doors


def camera_reading(query: Query, sensor: str = "cam0") -> dict[str, Any]:
    camera = query.camera
    return {
        "timestamp": 1750939398300,
        "sensorId": sensor,
        "sequenceNumber": 0,
        "imageFormat": "RGBA32",  # as a published client says of its JPEG
        "size": [camera.width, camera.height],
        "imageBytes": base64.b64encode(query.image).decode(),
        "params": {"model": camera.model, "modelParams": list(camera.params)},
    }


def oscp_request(*readings: dict[str, Any], at: tuple[float, float] | None) -> dict[str, Any]:
    positions = (
        []
        if at is None
        else [{"sensorId": "gps0", "latitude": at[0], "longitude": at[1], "accuracy": 8.0}]
    )
    return {
        "id": "7d7b6c1e-5f0f-4a52-9f5a-1c1a3c9b2d10",
        "timestamp": 1750939398316,
        "type": "geopose",
        "sensors": [{"id": "cam0", "type": "camera"}, {"id": "gps0", "type": "geolocation"}],
        "sensorReadings": {"cameraReadings": list(readings), "geolocationReadings": positions},
    }


def true_geopose(anchored_maps: Path, cam_from_world: Pose) -> dict[str, Any]:
    geodetic = MapStore(anchored_maps).open("room").geodetic
    assert geodetic is not None
    found = geopose_of(cam_from_world, geodetic)
    w, x, y, z = found.quaternion_wxyz.tolist()
    return {
        "position": {"lat": found.latitude, "lon": found.longitude, "h": found.height},
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
    }


def is_near(found: dict[str, Any], true: dict[str, Any]) -> bool:
    """Within half a metre and three degrees."""
    f, t = found["position"], true["position"]
    metres = math.hypot(
        (f["lat"] - t["lat"]) * 111_000,
        (f["lon"] - t["lon"]) * 111_000 * math.cos(math.radians(LATITUDE)),
        f["h"] - t["h"],
    )
    dot = sum(found["quaternion"][name] * true["quaternion"][name] for name in "xyzw")
    return metres < 0.5 and 2 * math.acos(min(abs(dot), 1.0)) < math.radians(3)


def test_answers_carry_geoposes_and_are_the_same_over_both_doors(
    doors: Doors, anchored_maps: Path, query: Query
) -> None:
    answers = []
    for url in (doors.url, f"grpc://127.0.0.1:{doors.server.grpc_port}"):
        with Client(url) as client:
            found = client.localize(query.image, PLACE, query.camera, ypr=True)
            assert found.localized
            assert found.geopose is not None
            assert found.geopose_ypr is not None
            assert client.localize(query.image, "room", query.camera).geopose_ypr is None
            answers.append({name: found.raw[name] for name in ("pose", "geopose", "geopose_ypr")})
            (info,) = client.maps(near=PLACE)
            assert info.place is not None
            assert info.anchor is not None
            assert info.anchor.geodetic is not None
            assert client.maps(near=Near(LATITUDE + 1, LONGITUDE, 50.0)) == []
    assert answers[0] == answers[1]
    cam_from_world = Pose.from_quaternion(
        answers[0]["pose"]["cam_from_world"]["rotation_wxyz"],
        answers[0]["pose"]["cam_from_world"]["translation"],
    )
    expected = true_geopose(anchored_maps, cam_from_world)
    for part in ("position", "quaternion"):
        assert answers[0]["geopose"][part] == pytest.approx(expected[part], abs=1e-12)
    assert is_near(answers[0]["geopose"], true_geopose(anchored_maps, query.cam_from_world))


def test_a_rig_has_a_geopose_too(doors: Doors, query: Query) -> None:
    with Client(doors.url) as client:
        photo = client.localize(query.image, "room", query.camera)
        rig = {"camera": RigSensor(Pose.identity(), query.camera)}
        image = RigImage("camera", query.image)
        instant = client.localize_rig([image], PLACE, rig, ypr=True)
    assert instant.localized
    assert instant.geopose is not None
    assert photo.geopose is not None
    assert instant.geopose_ypr is not None
    assert instant.geopose.latitude == pytest.approx(photo.geopose.latitude, abs=1e-6)
    np.testing.assert_allclose(
        instant.geopose.quaternion_xyzw, photo.geopose.quaternion_xyzw, atol=0.02
    )


@pytest.mark.parametrize("at", [(LATITUDE, LONGITUDE), None])
def test_the_protocol_answers_where_the_photo_was_taken(
    doors: Doors, anchored_maps: Path, query: Query, at: tuple[float, float] | None
) -> None:
    assert doors.http.get("/geopose").json() == {"status": "running"}
    accept = "application/vnd.oscp+json; version=2.0;"
    asked = oscp_request(camera_reading(query), at=at)
    answer = doors.http.post("/geopose", json=asked, headers={"Accept": accept})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/vnd.oscp+json; version=2.0"
    found = answer.json()
    assert list(found) == ["id", "timestamp", "accuracy", "type", "geopose"]
    assert (found["id"], found["timestamp"]) == (asked["id"], asked["timestamp"])
    assert found["type"] == "geopose"
    assert is_near(found["geopose"], true_geopose(anchored_maps, query.cam_from_world))
    assert 0 < found["accuracy"]["position"] < 0.5
    assert 0 < found["accuracy"]["orientation"] < 3
    bare = doors.http.post("/geopose", json=asked, headers={"Accept": "application/geopose+json"})
    assert bare.headers["content-type"] == "application/geopose+json"
    assert bare.json() == found["geopose"]


def test_version_1_and_photos_of_a_rig_are_answered_the_same(
    doors: Doors, anchored_maps: Path, query: Query
) -> None:
    reading = camera_reading(query)
    params = reading.pop("params")
    wrapped = {"timestamp": 1, "sensorId": "cam0", "reading": reading}
    first: dict[str, Any] = {
        "id": "version 1",
        "sensors": [{"id": "cam0", "type": "camera", "params": params}],
        "sensorReadings": [wrapped],
    }
    answer = doors.http.post("/geopose", json=first)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/json"
    true = true_geopose(anchored_maps, query.cam_from_world)
    assert is_near(answer.json()["geopose"], true)

    # A rig that lies on its side, so that its frame is not that of its cameras.
    turned = {"x": 0, "y": 0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)}
    mount = {"type": "camera", "rigIdentifier": "phone", "rigRotation": turned}
    mount["rigTranslation"] = {"x": 0.1, "y": 0.2, "z": 0.3}
    rig = oscp_request(camera_reading(query), camera_reading(query, "cam1"), at=None)
    rig["sensors"] = [{"id": "cam0", **mount}, {"id": "cam1", **mount}]
    answer = doors.http.post("/geopose", json=rig)
    assert answer.status_code == 200, answer.text
    assert is_near(answer.json()["geopose"], true)
    assert 0 < answer.json()["accuracy"]["position"] < 0.5


def test_no_pose_no_map_and_no_such_answer_are_told_apart(
    doors: Doors, query: Query, photos_of_another_room: list[Path]
) -> None:
    elsewhere = camera_reading(query) | {
        "imageBytes": base64.b64encode(photos_of_another_room[0].read_bytes()).decode()
    }
    asked = oscp_request(camera_reading(query), at=(LATITUDE, LONGITUDE))
    for body, headers, status, code in (
        (oscp_request(elsewhere, at=None), {}, 404, "geopose.not_localized"),
        (oscp_request(camera_reading(query), at=(-12.0, 30.0)), {}, 404, "map.none_near"),
        (oscp_request(at=None), {}, 422, "geopose.no_camera"),
        (asked, {"Accept": "application/vnd.oscp+json; version=3.0"}, 406, "geopose.accept"),
        (asked, {"Content-Type": "text/plain"}, 422, "request.content_type"),
    ):
        answer = doors.http.post("/geopose", json=body, headers=headers)
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["code"] == code


def test_places_that_are_none_are_refused_alike(doors: Doors, query: Query) -> None:
    near = {"latitude": 91.0, "longitude": 0.0, "radius": 10.0}
    form = {"near": "91,0,10"}
    files = {"image": ("photo.jpg", query.image)}
    problem = doors.http.post("/localize", data=form, files=files).json()
    assert (problem["code"], problem["field"]) == ("near.latitude", "near.latitude")
    message = pb2.LocalizeRequest(image=query.image, near=pb2.Near(**near))
    with pytest.raises(grpc.RpcError) as caught:
        doors.stub.Localize(message)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "near.latitude" in str(caught.value.details())
    problem = doors.http.post("/localize", data={"near": "45,5"}, files=files).json()
    assert problem["code"] == "near.syntax"
    problem = doors.http.post(
        "/localize", data={"near": "45,5,10", "map": "room"}, files=files
    ).json()
    assert (problem["code"], problem["got"]) == ("request.map", "map and near")


def test_a_map_tells_where_it_lies_over_both_doors(doors: Doors) -> None:
    over_http = doors.http.get("/maps/room").json()
    message = doors.stub.GetMap(pb2.GetMapRequest(map="room"))
    over_grpc = MessageToDict(message, preserving_proto_field_name=True)
    assert over_http["anchor"]["kind"] == "correspondences"
    assert over_http["anchor"]["geodetic"] == over_grpc["anchor"]["geodetic"]
    assert over_http["place"] == over_grpc["place"]
    assert over_http["place"]["radius"] < 10
