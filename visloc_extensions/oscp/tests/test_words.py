from __future__ import annotations

import base64
import copy
import io
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from service.http.openapi import example
from visloc.errors import InvalidInput, TooLarge, VislocError
from visloc.types import Near
from visloc_extensions.oscp.images import image_bytes
from visloc_extensions.oscp.routes import answer_kind
from visloc_extensions.oscp.words import GeoPoseRequest

EXAMPLE_GEOPOSE_REQUEST_V1 = example("request_v1", "visloc_extensions.oscp")
EXAMPLE_GEOPOSE_REQUEST_V2 = example("request_v2", "visloc_extensions.oscp")
PHOTO = base64.b64decode(EXAMPLE_GEOPOSE_REQUEST_V1["sensorReadings"][0]["reading"]["imageBytes"])
CAMERA: dict[str, Any] = {
    "timestamp": 1750939398316,
    "sensorId": "cam0",
    "imageFormat": "JPG",
    "size": [64, 48],
    "imageBytes": base64.b64encode(PHOTO).decode(),
}
EVERYWHERE = Near(0.0, 0.0, 20_050_000.0)
_OSCP, _OGC = "application/vnd.oscp+json", "application/geopose+json"


def job_of(request: object, *, max_image_bytes: int = 100_000, max_images: int = 4) -> Any:
    read = GeoPoseRequest.read_json(json.dumps(request).encode())
    return read.to_job(max_image_bytes=max_image_bytes, max_images=max_images)


def version_2(
    *cameras: dict[str, Any], sensors: list[dict[str, Any]] | None = None, **others: Any
) -> dict[str, Any]:
    return {
        "id": "7d7b6c1e",
        "timestamp": 1750939398316.5,
        "type": "geopose",
        "sensors": [{"id": "cam0", "type": "camera"}] if sensors is None else sensors,
        "sensorReadings": {"cameraReadings": list(cameras), **others},
    }


@pytest.mark.parametrize("request_", [EXAMPLE_GEOPOSE_REQUEST_V1, EXAMPLE_GEOPOSE_REQUEST_V2])
def test_both_versions_ask_the_same(request_: dict[str, Any]) -> None:
    job = job_of(request_)
    (image,) = job.images
    assert (job.rig, image.query) == (None, PHOTO)
    assert image.camera is not None
    assert (image.camera.model, image.camera.width, image.camera.height) == ("PINHOLE", 64, 48)
    assert image.camera.params == (52.5, 52.5, 32.0, 24.0)
    assert job.maps == Near(48.2743, 2.6974, 100.0)


def test_what_clients_add_leave_out_or_spell_in_their_way_is_read() -> None:
    """Names in lists, upper case, nulls, extras, no privacy."""
    request = copy.deepcopy(EXAMPLE_GEOPOSE_REQUEST_V1)
    camera = request["sensors"][0]
    camera |= {"type": "CAMERA", "name": ["x"], "model": None, "rigIdentifier": None}
    camera["params"]["model"] = "pinhole"
    for reading in request["sensorReadings"]:
        del reading["privacy"]
        reading["extra"] = {"a": [1]}
    request["sensorReadings"].append({"timestamp": 1, "sensorId": "imu", "reading": {"x": 1}})
    request["sensorReadings"].append({"timestamp": 1, "sensorId": "wifi", "reading": None})
    job = job_of(request)
    assert job.images[0].query == PHOTO
    assert job.images[0].camera.model == "PINHOLE"

    wifi = version_2(
        CAMERA, wiFiReadings=[{"BSSID": "a"}], wifiReadings=None, accelerometerReadings=[{}]
    )
    assert job_of(wifi).images[0].query == PHOTO
    assert job_of(wifi).maps == EVERYWHERE
    assert job_of({"sensorReadings": {"cameraReadings": [CAMERA]}}).images[0].query == PHOTO


@pytest.mark.parametrize("model", ["UNKNOWN", "unknown_camera", "", None])
def test_an_unknown_camera_is_unknown(model: str | None) -> None:
    params = {"model": model, "modelParams": [1.0]}
    assert job_of(version_2(CAMERA | {"params": params})).images[0].camera is None
    assert job_of(version_2(CAMERA | {"params": {"model": "PINHOLE"}})).images[0].camera is None


def test_intrinsics_of_the_reading_come_before_those_of_the_sensor() -> None:
    own = {"model": "SIMPLE_PINHOLE", "modelParams": [60, 32, 24]}
    sensor = {"id": "cam0", "params": {"model": "PINHOLE", "modelParams": [52, 52, 32, 24]}}
    assert (
        job_of(version_2(CAMERA | {"params": own}, sensors=[sensor])).images[0].camera.params[0]
        == 60
    )
    assert job_of(version_2(CAMERA, sensors=[sensor])).images[0].camera.params[0] == 52


@pytest.mark.parametrize(
    "spell",
    [
        lambda text: f"data:image/jpeg;base64,{text}",
        lambda text: "\r\n".join(text[i : i + 76] for i in range(0, len(text), 76)),
        lambda text: text.rstrip("="),
        lambda text: text.replace("+", "-").replace("/", "_"),
        lambda text: f"  {text}\n",
    ],
)
@pytest.mark.parametrize("length", [3, 4, 5, 200])
def test_base64_is_read_in_every_spelling(spell: Callable[[str], str], length: int) -> None:
    data = b"\xff\xd8\xff" + bytes(range(256))[-length:]
    text = spell(base64.b64encode(data).decode())
    assert image_bytes(text, "RGBA32", None, 1000) == data


@pytest.mark.parametrize(
    ("text", "code"), [("", "image.empty"), ("a", "image.base64"), ("ä" * 8, "image.base64")]
)
def test_what_is_no_base64_is_refused(text: str, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        image_bytes(text, None, None, 1000)
    assert caught.value.code == code


def test_a_photo_that_is_too_large_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(TooLarge) as caught:
        image_bytes("!" * 2000, None, None, 1000)
    assert caught.value.code == "image.too_large"


def test_bare_pixels_become_a_photo_of_the_same_pixels() -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (7, 5, 4), np.uint8)
    for pixels, expected in ((rgba, rgba[..., :3]), (rgba[..., 0], rgba[..., 0])):
        text = base64.b64encode(np.ascontiguousarray(pixels).tobytes()).decode()
        found = Image.open(io.BytesIO(image_bytes(text, "RGBA32", (5, 7), 1000)))
        np.testing.assert_array_equal(np.asarray(found), expected)


def test_bytes_that_are_neither_a_file_nor_so_many_pixels_are_refused() -> None:
    text = base64.b64encode(bytes(139)).decode()
    for size in ((5, 7), None):
        with pytest.raises(InvalidInput) as caught:
            image_bytes(text, "RGBA32", size, 1000)
        assert caught.value.code == "image.format"


def test_the_latest_position_says_where_to_search_and_its_accuracy_how_far() -> None:
    def near(*positions: dict[str, Any]) -> Near:
        found = job_of(version_2(CAMERA, geolocationReadings=list(positions))).maps
        assert isinstance(found, Near)
        return found

    old = {"timestamp": 1, "latitude": 10.0, "longitude": 20.0, "accuracy": 5.0}
    new = {"timestamp": 2, "latitude": 11, "longitude": 21, "accuracy": 300}
    assert near(old) == Near(10.0, 20.0, 100.0)
    assert near(old, new) == near(new, old) == Near(11.0, 21.0, 600.0)
    # What is not on Earth, or null, is no position; what is not an accuracy, none.
    lost = {"timestamp": 9, "latitude": None, "longitude": 3.0}
    assert near(lost, old, old | {"timestamp": 9, "latitude": 99.0}) == Near(10.0, 20.0, 100.0)
    for unknown in (-1, 1e308, None):
        assert near(old | {"accuracy": unknown}).radius == 100.0
    assert near() == EVERYWHERE


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_prior_pose_says_it_where_no_reading_does(wrapped: bool) -> None:
    position = {"lat": 5, "lon": 6, "h": 7}
    pose = {"position": position, "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1}}
    accuracy = {"position": 80, "orientation": 1.8e308}
    prior = {"id": "a", "accuracy": accuracy, "geopose": pose} if wrapped else pose
    text = json.dumps(version_2(CAMERA) | {"priorPoses": [prior]}).replace("Infinity", "1.8e308")
    found = GeoPoseRequest.read_json(text.encode())
    job = found.to_job(max_image_bytes=1000, max_images=1)
    assert job.maps == Near(5.0, 6.0, 160.0 if wrapped else 100.0)


def mounted(name: str, x: float, rig: str | None = "phone") -> dict[str, Any]:
    return {
        "id": name,
        "type": "camera",
        "rigIdentifier": rig,
        "rigRotation": {"x": 0, "y": 0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)},
        "rigTranslation": {"x": x, "y": 0, "z": 0},
    }


def test_photos_of_one_rig_and_instant_are_localized_together() -> None:
    sensors = [mounted("cam0", 0.0), mounted("cam1", 0.5), mounted("other", 0.0, "tripod")]
    job = job_of(
        version_2(
            CAMERA,
            CAMERA | {"sensorId": "cam1"},
            CAMERA | {"sensorId": "cam1", "timestamp": 1},
            CAMERA | {"sensorId": "other"},
            CAMERA | {"sensorId": "nobody"},
            sensors=sensors,
        )
    )
    assert [image.sensor for image in job.images] == ["cam0", "cam1"]
    assert isinstance(job.rig, dict)
    sits = job.rig["cam1"].cam_from_rig
    np.testing.assert_allclose(sits.translation, [0.5, 0, 0])
    np.testing.assert_allclose(sits.apply(np.array([1.0, 0, 0])), [0.5, 1, 0], atol=1e-12)


def test_photos_of_a_burst_are_answered_by_the_first_and_depth_is_passed_over() -> None:
    second = CAMERA | {"imageBytes": base64.b64encode(b"\xff\xd8\xff2").decode()}
    job = job_of(version_2(CAMERA | {"imageFormat": "depth"}, second, CAMERA))
    assert job.rig is None
    assert [image.query for image in job.images] == [b"\xff\xd8\xff2"]


_FIRST = "sensorReadings.cameraReadings[0]"
_FLAT = mounted("cam0", 0) | {"rigRotation": {"x": 0, "y": 0, "z": 0, "w": 0}}


@pytest.mark.parametrize(
    ("request_", "code", "field"),
    [
        ([], "request.invalid", None),
        ({}, "geopose.no_camera", "sensorReadings"),
        ({"sensorReadings": 3}, "request.invalid", "sensorReadings"),
        ({"sensorReadings": [3]}, "request.invalid", "sensorReadings[0]"),
        ({"sensorReadings": [], "sensors": {}}, "request.invalid", "sensors"),
        (version_2(CAMERA | {"imageFormat": "DEPTH"}), "geopose.no_camera", "sensorReadings"),
        (version_2({"sensorId": "cam0"}), "request.missing_field", f"{_FIRST}.imageBytes"),
        (version_2(CAMERA | {"size": [64]}), "request.invalid", f"{_FIRST}.size"),
        (
            version_2(
                CAMERA | {"size": None, "params": {"model": "FOV", "modelParams": [1, 2, 3, 4, 5]}}
            ),
            "request.missing_field",
            f"{_FIRST}.size",
        ),
        (
            version_2(CAMERA | {"params": {"model": "PINHOLE", "modelParams": [1.0]}}),
            "camera.param_count",
            f"{_FIRST}.camera.params",
        ),
        (
            version_2(
                *[CAMERA | {"sensorId": f"cam{i}"} for i in range(5)],
                sensors=[mounted(f"cam{i}", i) for i in range(5)],
            ),
            "rig.too_many_images",
            "sensorReadings",
        ),
        (
            version_2(CAMERA, CAMERA | {"sensorId": "cam1"}, sensors=[_FLAT, mounted("cam1", 0)]),
            "pose.rotation",
            "sensors.cam0.rotation",
        ),
    ],
)
def test_what_cannot_be_answered_is_refused_by_name(
    request_: object, code: str, field: str | None
) -> None:
    with pytest.raises(VislocError) as caught:
        job_of(request_)
    assert (caught.value.code, caught.value.field) == (code, field)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (b"", "request.malformed"),
        (b"{", "request.malformed"),
        (b"\xff", "request.malformed"),
        (b'{"timestamp": NaN}', "request.malformed"),
        (b"[" * 100_000, "request.malformed"),
        (b'{"a": [' + b"1," * 100_000 + b"1]}", "request.too_large"),
    ],
)
def test_what_is_no_json_or_too_much_of_it_is_refused(text: bytes, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        GeoPoseRequest.read_json(text)
    assert caught.value.code == code


def test_a_request_may_begin_with_a_byte_order_mark() -> None:
    assert GeoPoseRequest.read_json(b'\xef\xbb\xbf{"timestamp": 1}').timestamp == 1


def test_ids_and_times_that_are_none_are_left_out() -> None:
    def read(**given: Any) -> GeoPoseRequest:
        return GeoPoseRequest.read_json(json.dumps(given).encode())

    assert read(id="a", timestamp=1750939398316).timestamp == 1750939398316
    assert read(timestamp=1.5).timestamp == 1.5
    for id_, timestamp in ((7, "now"), (None, 10**400), ([], True)):
        found = read(id=id_, timestamp=timestamp)
        assert (found.id, found.timestamp) == (None, None)


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ([], "application/json"),
        (["*/*"], "application/json"),
        (["application/json"], "application/json"),
        ([f"{_OSCP}; version=2.0;"], f"{_OSCP}; version=2.0"),
        ([f"{_OSCP};version=1.0"], f"{_OSCP}; version=1.0"),
        (['Application/VND.oscp+JSON; Version="2.0"'], f"{_OSCP}; version=2.0"),
        ([_OSCP], _OSCP),
        ([_OGC], _OGC),
        (["text/html", f"{_OGC};version=1.0, */*;q=0.1"], f"{_OGC}; version=1.0"),
        ([f"application/json;q=0.5, {_OGC}"], _OGC),
        ([f"{_OSCP}; version=3.0, application/json;q=0.2"], "application/json"),
    ],
)
def test_the_kind_of_answer_is_the_one_that_is_liked_best(accept: list[str], kind: str) -> None:
    assert answer_kind(accept) == kind


@pytest.mark.parametrize(
    "accept",
    [
        f"{_OSCP}; version=3.0",
        f"{_OSCP}; version=2x0",
        f"{_OGC}; version=2.0",
        "text/html",
        "*/*;q=0",
        "*/*;q=nan",
        ";",
    ],
)
def test_an_answer_that_is_not_given_here_is_not_acceptable(accept: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        answer_kind([accept])
    assert caught.value.code == "geopose.accept"
