"""The OSCP GeoPose protocol over HTTP, in a map that is tied to the Earth."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fastapi import FastAPI

from service.http.openapi import example
from service.security.access import needed_over_http
from service.security.key_file import Scope
from tests.service.anchored import LATITUDE, LONGITUDE, is_near, true_geopose
from visloc.errors import InvalidInput
from visloc_extensions.oscp.routes import add_geopose_routes
from visloc_extensions.oscp.words import GeoPoseRequest

if TYPE_CHECKING:
    from conftest import Query
    from tests.service.conftest import Doors


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


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_it_needs_the_scope_of_localization(method: str) -> None:
    add_geopose_routes(FastAPI())
    assert needed_over_http(method, "/geopose") == frozenset({Scope.LOCALIZE})


@pytest.mark.parametrize(
    ("query_string", "headers", "content", "code", "field"),
    [
        ("?map=room", {}, "{}", "request.unknown_field", "map"),
        ("", {}, '{"id": "1", "id": "2"}', "request.duplicate_field", "id"),
        ("", {}, '{"sensors": [{"id": "a", "id": "b"}]}', "request.duplicate_field", "id"),
        ("", {"Content-Encoding": "br"}, "{}", "request.content_encoding", "Content-Encoding"),
    ],
)
def test_what_other_paths_refuse_is_refused(
    query_string: str, headers: dict[str, str], content: str, code: str, field: str, doors: Doors
) -> None:
    headers = {"Content-Type": "application/json"} | headers
    answer = doors.http.post(f"/geopose{query_string}", content=content, headers=headers)
    assert answer.status_code == 422
    assert (answer.json()["code"], answer.json()["field"].split(".")[-1]) == (code, field)


@pytest.mark.parametrize("version", ["v1", "v2"])
def test_json_cut_at_any_byte_is_refused(version: str) -> None:
    text = json.dumps(example(f"request_{version}", "visloc_extensions.oscp")).encode()
    GeoPoseRequest.read_json(text)
    for length in range(len(text)):
        with pytest.raises(InvalidInput) as caught:
            GeoPoseRequest.read_json(text[:length])
        assert caught.value.code == "request.malformed"
