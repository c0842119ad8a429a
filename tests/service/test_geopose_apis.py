"""GeoPoses of a map that is tied to the Earth, over both doors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import grpc
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict

from clients import Client, Near, RigImage, RigSensor
from tests.service.anchored import LATITUDE, LONGITUDE, is_near, true_geopose
from visloc.geometry import Pose
from visloc_api.v1 import localization_pb2 as pb2

if TYPE_CHECKING:
    from conftest import Query
    from tests.service.conftest import Doors

PLACE = Near(LATITUDE, LONGITUDE, 50.0)


@pytest.fixture(scope="module")
def doors(
    anchored_maps: Path, serve: Callable[..., AbstractContextManager[Doors]]
) -> Iterator[Doors]:
    with serve(anchored_maps, max_batch_bytes=600_000, max_rig_images=3) as doors:
        yield doors


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
