from __future__ import annotations

import asyncio
import base64
import gzip
import io
import json
import logging
import re
import socket
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NoReturn

import cv2
import httpx
import numpy as np
import pytest
from PIL import Image
from pydantic import BaseModel
from starlette.responses import PlainTextResponse

import visloc
from service.http.app import create_app
from service.http.envelope import RequestEnvelope
from service.http.openapi import example
from service.values import RigJob
from tests.heic import heic
from tests.turning import png, turned_camera, turned_pixels, turned_pose
from visloc.geometry import Pose, rotation_angle
from visloc.photos.reading import read_photo
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words import answers, maps, scenes, status


def encoded(image: Image.Image, file_format: str = "PNG", **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, file_format, **options)
    return buffer.getvalue()


def camera_text(camera: visloc.Camera) -> str:
    return ",".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))


def post(
    doors: Any, image: bytes, *, headers: dict[str, str] | None = None, **fields: str
) -> httpx.Response:
    files = {"image": ("photo.jpg", image)}
    response: httpx.Response = doors.http.post(
        "/localize", data={"map": "room"} | fields, files=files, headers=headers
    )
    return response


def problem(response: httpx.Response, status: int, code: str) -> dict[str, Any]:
    body: dict[str, Any] = response.json()
    assert (response.status_code, body["code"]) == (status, code), body
    assert response.headers["content-type"] == "application/problem+json"
    assert body["status"] == status
    assert body["request_id"] == response.headers["x-request-id"]
    return body


# Answers


def test_a_query_is_localized_where_it_was_taken(doors: Any, query: Any) -> None:
    response = post(doors, query.image, camera=camera_text(query.camera))

    answer = response.json()
    assert response.status_code == 200
    assert (answer["status"], answer["refusal"]) == ("localized", None)
    found = answer["pose"]["cam_from_world"]
    cam_from_world = Pose.from_quaternion(found["rotation_wxyz"], found["translation"])
    truth = query.cam_from_world
    assert np.linalg.norm(cam_from_world.center - truth.center) < 0.05
    assert rotation_angle(cam_from_world.rotation @ truth.rotation.T) < np.radians(1)
    np.testing.assert_allclose(answer["pose"]["position"], cam_from_world.center)
    np.testing.assert_allclose(
        answer["pose"]["orientation"], cam_from_world.inverse().rotation_wxyz
    )
    assert np.array(answer["pose"]["covariance"]).reshape(6, 6).trace() > 0
    assert answer["camera"]["source"] == "given"
    assert answer["orientation"] == {"exif": 1, "read_as": "upright", "turned": 0}
    assert answer["map"]["id"] == "room"
    assert answer["retrieved"][0]["similarities"].keys() == {"densevlad", "localvlad"}
    assert {"queued", "decode", "local_features", "pose"} <= answer["seconds"].keys()
    assert answer["inlier_ratio"] == answer["inliers"] / answer["correspondences"]


def comparable(response: httpx.Response) -> dict[str, Any]:
    answer: dict[str, Any] = response.json()
    assert response.status_code == 200, answer
    return {name: answer[name] for name in answer if name not in ("seconds", "request_id")}


def test_form_and_json_give_the_same_answer(doors: Any, query: Any) -> None:
    camera, options = query.camera, {"top_k": 3, "seed": 7}
    as_object = {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": camera.params,
    }
    form = post(doors, query.image, camera=json.dumps(as_object), options=json.dumps(options))
    image = base64.b64encode(query.image).decode()
    for given in (as_object, camera_text(camera)):
        body = {"map": "room", "image": image, "camera": given, "options": options}
        assert comparable(doors.http.post("/localize", json=body)) == comparable(form)


def test_a_blank_photo_is_an_answer_without_a_pose(doors: Any) -> None:
    answer = comparable(post(doors, encoded(Image.new("RGB", (320, 240)))))

    assert (answer["status"], answer["pose"]) == ("not_localized", None)
    assert answer["refusal"]["reason"] == "no_keypoints"
    assert answer["camera"]["source"] == "guess"


def test_a_camera_that_the_photo_contradicts_is_refused_with_both_numbers(
    doors: Any, query: Any
) -> None:
    wrong = query.camera.focal_length * 1.3
    camera = f"SIMPLE_PINHOLE,{query.camera.width},{query.camera.height},{wrong},"
    camera += f"{query.camera.width / 2},{query.camera.height / 2}"
    answer = comparable(post(doors, query.image, camera=camera))

    assert (answer["status"], answer["pose"]) == ("not_localized", None)
    assert answer["refusal"]["stage"] == "gate"
    assert answer["refusal"]["reason"] == "camera_contradicted"
    assert f"a focal length of {wrong:.0f} px, but the photo says" in answer["refusal"]["message"]


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "I;16"])
def test_grey_transparent_palette_and_16_bit_photos_are_localized(
    mode: str, doors: Any, query: Any
) -> None:
    photo = Image.open(io.BytesIO(query.image))
    if mode == "I;16":
        photo = Image.fromarray(np.asarray(photo.convert("L")).astype(np.uint16) * 257)
    else:
        photo = photo.convert(mode)

    answer = comparable(post(doors, encoded(photo), camera=camera_text(query.camera)))

    assert answer["status"] == "localized"


@pytest.mark.parametrize("kind", ["HEIC", "AVIF"])
def test_photos_of_phones_are_localized(kind: str, doors: Any, query: Any) -> None:
    rgb = read_photo(query.image).rgb
    data = heic(rgb)
    if kind == "AVIF":
        file = io.BytesIO()
        Image.fromarray(rgb).save(file, "AVIF", quality=90)
        data = file.getvalue()

    over_http = comparable(post(doors, data, camera=camera_text(query.camera)))
    camera = pb2.Camera(model="PINHOLE", width=256, height=192, params=query.camera.params)
    over_grpc = doors.stub.Localize(pb2.LocalizeRequest(map="room", image=data, camera=camera))

    assert over_http["status"] == "localized"
    for position in (over_grpc.pose.position, over_http["pose"]["position"]):
        assert np.linalg.norm(np.array(position) - query.cam_from_world.center) < 0.05


def test_a_photo_of_more_pixels_than_the_limit_is_reduced(doors: Any, query: Any) -> None:
    large = cv2.resize(read_photo(query.image).rgb, (1536, 1152), interpolation=cv2.INTER_CUBIC)
    data = cv2.imencode(".jpg", large[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    camera = query.camera.scaled(1536, 1152)

    answer = comparable(post(doors, data, camera=camera_text(camera)))

    assert answer["status"] == "localized"
    assert (answer["camera"]["width"], answer["camera"]["height"]) == (768, 576)
    assert answer["camera"]["source"] == "given_scaled"
    found = np.array(answer["pose"]["position"])
    assert np.linalg.norm(found - query.cam_from_world.center) < 0.05


def test_a_photo_stored_turned_is_read_upright(doors: Any, query: Any) -> None:
    stored = png(turned_pixels(read_photo(query.image).rgb, 6), 6)
    camera = camera_text(turned_camera(query.camera, 6))
    answer = comparable(post(doors, stored, camera=camera))

    assert answer["orientation"] == {"exif": 6, "read_as": "upright", "turned": 0}
    assert answer["status"] == "localized"
    found = answer["pose"]["cam_from_world"]
    cam_from_world = Pose.from_quaternion(found["rotation_wxyz"], found["translation"])
    truth = turned_pose(query.cam_from_world, 6)  # of the stored pixels
    assert np.linalg.norm(cam_from_world.center - truth.center) < 0.05
    assert rotation_angle(cam_from_world.rotation @ truth.rotation.T) < np.radians(1)


def test_a_photo_with_exif_orientation_may_be_read_as_stored(doors: Any, query: Any) -> None:
    pixels, camera = read_photo(query.image).rgb, camera_text(query.camera)
    options = json.dumps({"read_as": "stored"})
    plain = comparable(post(doors, png(pixels), camera=camera))
    turned = comparable(post(doors, png(pixels, 6), camera=camera, options=options))

    assert turned.pop("orientation") == {"exif": 6, "read_as": "stored", "turned": 0}
    assert plain.pop("orientation") == {"exif": 1, "read_as": "upright", "turned": 0}
    assert turned == plain


def test_a_tiny_photo_is_an_answer(doors: Any) -> None:
    assert comparable(post(doors, encoded(Image.new("L", (1, 1)))))["status"] == "not_localized"


# Bad input


def test_what_is_not_an_image_is_refused(doors: Any) -> None:
    body = problem(post(doors, b"hello"), 422, "image.format")

    assert (body["field"], body["kind"]) == ("image", "InvalidInput")
    assert body["expected"] == "JPEG, HEIC, PNG, WebP, AVIF, TIFF or BMP"


def test_a_truncated_jpeg_is_refused(doors: Any, query: Any) -> None:
    body = problem(post(doors, query.image[: len(query.image) // 2]), 422, "image.undecodable")

    assert body["field"] == "image"


def test_zero_bytes_are_refused(doors: Any) -> None:
    assert problem(post(doors, b""), 422, "image.empty")["field"] == "image"


def test_a_photo_over_the_byte_limit_is_refused(doors: Any) -> None:
    body = problem(post(doors, b"\xff\xd8\xff" + bytes(200_000)), 413, "image.too_large")

    assert (body["kind"], body["expected"]) == ("TooLarge", "at most 200000 bytes")


@pytest.mark.parametrize("content_type", ["application/json", "multipart/form-data; boundary=x"])
def test_a_body_over_the_limit_is_refused_while_it_is_read(content_type: str, doors: Any) -> None:
    sent = 0

    def endless() -> Iterator[bytes]:
        nonlocal sent
        yield b'--x\r\nContent-Disposition: form-data; name="image"; filename="x"\r\n\r\n'
        while sent < 100_000_000:
            sent += 65536
            yield bytes(65536)

    response = doors.http.post(
        "/localize", content=endless(), headers={"Content-Type": content_type}
    )

    body = problem(response, 413, "request.too_large")
    assert (body["field"], body["kind"]) == (None, "TooLarge")
    assert body["expected"].startswith("at most ")


def test_a_body_that_declares_too_much_is_refused_before_it_comes(doors: Any) -> None:
    headers = {"Content-Type": "application/json", "Content-Length": "10000000000"}

    with socket.create_connection(("127.0.0.1", doors.server.http_port)) as connection:
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        connection.sendall(f"POST /localize HTTP/1.1\r\nHost: localhost\r\n{head}\r\n".encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 413 ")


def test_a_photo_over_the_pixel_limit_is_refused_from_its_header(doors: Any) -> None:
    photo = bytearray(encoded(Image.new("L", (10, 10))))
    header = b"IHDR" + struct.pack(">II", 30_000, 30_000) + photo[24:29]
    photo[12:33] = header + struct.pack(">I", zlib.crc32(header))

    body = problem(post(doors, bytes(photo)), 413, "image.too_many_pixels")

    assert (body["expected"], body["got"]) == ("at most 1000000 pixels", "30000 x 30000")


@pytest.mark.parametrize(
    ("camera", "code", "field", "expected"),
    [
        ("FISHY,640,480,1,2,3", "camera.model", "camera.model", "one of SIMPLE_PINHOLE, PINHOLE"),
        ("PINHOLE,256,192,230,128,96", "camera.param_count", "camera.params", "4: fx, fy, cx, cy"),
        ("PINHOLE,256,192,nan,230,128,96", "camera.param_value", "camera.params", "fx to be"),
        ("PINHOLE,256,192,-230,230,128,96", "camera.param_value", "camera.params", "fx to be"),
        ("PINHOLE,256,192,inf,230,128,96", "camera.param_value", "camera.params", "fx to be"),
        ("PINHOLE,0,192,230,230,128,96", "camera.size", "camera.width", "1 to"),
        ("PINHOLE,192,256,230,230,96,128", "camera.size_mismatch", "camera", "256 x 192"),
        ("my phone", "camera.syntax", "camera", "MODEL,width,height,params..."),
        ('{"model": "PINHOLE"}', "request.missing_field", "camera.width", None),
    ],
)
def test_a_wrong_camera_is_refused(
    camera: str, code: str, field: str, expected: str | None, doors: Any, query: Any
) -> None:
    body = problem(post(doors, query.image, camera=camera), 422, code)

    assert body["field"] == field
    assert expected is None or body["expected"].startswith(expected)


def test_an_unknown_map_is_not_found(doors: Any, query: Any) -> None:
    body = problem(post(doors, query.image, map="hall"), 404, "map.unknown")

    assert (body["field"], body["expected"], body["got"]) == ("map", "one of room", "hall")
    problem(doors.http.get("/maps/hall"), 404, "map.unknown")


@pytest.mark.parametrize("ref", ["..%2f..%2fetc", "room@", "-", "a" * 65, "%00"])
def test_a_map_name_that_is_a_path_or_worse_is_refused(ref: str, doors: Any) -> None:
    response = doors.http.get(f"/maps/{ref}")

    assert response.json()["code"] in ("map.id", "http.not_found")
    assert response.status_code in (404, 422)


@pytest.mark.parametrize(
    ("fields", "code", "field"),
    [
        ({"options": '{"topk": 3}'}, "request.unknown_field", "options.topk"),
        ({"options": '{"top_k": -3}'}, "options.top_k", "options.top_k"),
        ({"options": '{"min_inlier_ratio": NaN}'}, *["options.min_inlier_ratio"] * 2),
        ({"options": "top_k=3"}, "request.malformed", "options"),
        ({"top_k": "3"}, "request.unknown_field", "top_k"),
    ],
)
def test_a_wrong_option_is_refused(
    fields: dict[str, str], code: str, field: str, doors: Any, query: Any
) -> None:
    assert problem(post(doors, query.image, **fields), 422, code)["field"] == field


def test_a_form_that_is_not_one_is_refused(doors: Any) -> None:
    url, photo = "/localize", ("a.jpg", b"photo")
    multipart = {"Content-Type": "multipart/form-data; boundary=x"}

    def refused(code: str, **parts: Any) -> dict[str, Any]:
        return problem(doors.http.post(url, **parts), 422, code)

    refused("request.malformed", content=b"", headers={"Content-Type": "multipart/form-data"})
    refused("request.malformed", content=b"nonsense", headers=multipart)
    refused("request.content_type", content=b"")
    refused("request.content_type", data={"map": "room"})
    refused("request.malformed", content=b"{", headers={"Content-Type": "application/json"})
    refused("request.map", files={"image": photo})
    refused("request.duplicate_field", files=[("image", photo), ("image", photo)])
    refused("request.malformed", files=[(f"image{number}", photo) for number in range(20)])
    long = refused("request.malformed", data={"map": "x" * 100_000}, files={"image": photo})
    assert long["field"] == "map"
    twice = refused("request.duplicate_field", data={"map": ["a", "b"]}, files={"image": photo})
    assert twice["field"] == "map"
    text = refused("request.invalid", data={"map": "room", "image": "x"}, files={"a": ("", b"")})
    assert (text["field"], text["expected"]) == (
        "image",
        "a file, as of curl -F image=@photo.jpg",
    )


@pytest.mark.parametrize(
    ("method", "path", "code", "field"),
    [
        ("POST", "/localize?camera=PINHOLE,1,1,1,1,1,1", "request.unknown_field", "camera"),
        ("POST", "/localize?debug=true&top_k=2", "request.unknown_field", "debug"),
        ("POST", "/localize/rig?ypr", "request.unknown_field", "ypr"),
        ("PUT", "/maps/room/versions/2?current=true", "request.unknown_field", "current"),
        ("GET", "/maps?nera=1,2,3", "request.unknown_field", "nera"),
        ("GET", "/maps?near=1,2,3&near=4,5,6", "request.duplicate_field", "near"),
        ("GET", "/maps/room/images?first=0&last=9", "request.unknown_field", "last"),
    ],
)
def test_query_parameter_that_would_be_ignored_is_refused(
    method: str, path: str, code: str, field: str, doors: Any, query: Any
) -> None:
    files = {"image": query.image} if method == "POST" else None
    response = doors.http.request(method, path, data={"map": "room"}, files=files)
    assert problem(response, 422, code)["field"] == field


@pytest.mark.parametrize("path", ["/healthz?t=123", "/readyz?verbose", "/metrics?a=1"])
def test_probes_may_have_any_query(path: str, doors: Any) -> None:
    assert doors.http.get(path).status_code == 200


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/maps", "/maps/room", "/openapi.json"])
def test_head_has_the_headers_of_get_and_no_body(path: str, doors: Any) -> None:
    head, get = doors.http.head(path), doors.http.get(path)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("content-type", "content-length"):
        assert head.headers[name] == get.headers[name]
    assert doors.http.head("/localize").status_code == 405


@pytest.mark.parametrize(
    ("headers", "code", "field"),
    [
        ({"Content-Encoding": "gzip"}, "request.content_encoding", "Content-Encoding"),
        ({"Content-Encoding": "identity, br"}, "request.content_encoding", "Content-Encoding"),
        ({"Content-Type": "application/json; charset=utf-16"}, "request.content_type", None),
        ({"Content-Type": "application/json; charset=latin1"}, "request.content_type", None),
    ],
)
@pytest.mark.parametrize("path", ["/localize", "/localize/rig", "/maps/room/current"])
def test_encodings_that_are_not_read_are_named(
    path: str, headers: dict[str, str], code: str, field: str | None, doors: Any
) -> None:
    headers = {"Content-Type": "application/json"} | headers
    response = doors.http.post(path, content=gzip.compress(b"{}"), headers=headers)
    assert problem(response, 422, code)["field"] == (field or "Content-Type")


@pytest.mark.parametrize("text", ["{}", "\ufeff{}"])
@pytest.mark.parametrize(
    "kind", ["application/json; charset=UTF-8", 'application/json;charset="utf8"']
)
def test_json_in_utf_8_is_read_however_it_is_marked(kind: str, text: str, doors: Any) -> None:
    headers = {"Content-Type": kind, "Content-Encoding": "identity"}
    response = doors.http.post("/localize", content=text.encode(), headers=headers)
    problem(response, 422, "request.map")


def test_an_unknown_path_or_method_is_a_problem_too(doors: Any) -> None:
    problem(doors.http.get("/nothing"), 404, "http.not_found")
    response = doors.http.get("/localize")
    problem(response, 405, "http.method_not_allowed")
    assert response.headers["allow"] == "POST"


def test_a_full_queue_is_429_with_retry_after(
    doors: Any, query: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doors.server.engine, "_max_photos", 0)
    response = post(doors, query.image)

    assert problem(response, 429, "server.busy")["kind"] == "Overloaded"
    assert response.headers["retry-after"] == "1"


def test_a_server_that_stops_closes_each_connection_with_its_answer(doors: Any) -> None:
    async def ask(is_stopping: bool) -> httpx.Response:
        engine: Any = SimpleNamespace(draining=is_stopping)
        backend = replace(doors.server.backend, engine=engine)
        app = RequestEnvelope(PlainTextResponse("ok"), backend)
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
            return await http.get("/")

    assert asyncio.run(ask(True)).headers["connection"] == "close"
    assert "connection" not in asyncio.run(ask(False)).headers


@pytest.fixture
def given_up(doors: Any, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Photos are never done; set when the work for one was dropped."""
    dropped = threading.Event()

    async def for_ever(_: RigJob) -> NoReturn:
        try:
            await asyncio.Event().wait()
        finally:
            dropped.set()

    monkeypatch.setattr(doors.server.engine, "localize", for_ever)
    return dropped


def test_the_work_for_a_client_that_hung_up_is_given_up(
    doors: Any, query: Any, given_up: threading.Event, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with pytest.raises(httpx.ReadTimeout):
        httpx.post(
            f"{doors.url}/localize",
            data={"map": "room"},
            files={"image": query.image},
            timeout=httpx.Timeout(10, read=0.3),
        )

    assert given_up.wait(10)
    deadline = time.monotonic() + 10
    while not any(
        getattr(record, "facts", {}).get("status") == "CANCELLED" for record in caplog.records
    ):
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("/localize", '{"map": "room", "map": "hall", "image": "AAAA"}'),
        ("/localize", '{"map": "room", "image": "AAAA", "options": {"top_k": 1, "top_k": 2}}'),
        ("/maps/room/current", '{"version": "1", "version": "1"}'),
    ],
)
def test_a_field_twice_in_json_is_refused(path: str, text: str, doors: Any) -> None:
    headers = {"Content-Type": "application/json"}
    response = doors.http.post(path, content=text, headers=headers)

    assert problem(response, 422, "request.duplicate_field")["field"] in text


@pytest.mark.parametrize("size", [2**63, 2**64 - 1, 2**64, 10**19])
def test_a_length_beyond_all_numbers_is_refused_at_once(size: int, doors: Any) -> None:
    head = f"Host: localhost\r\nContent-Type: application/json\r\nContent-Length: {size}\r\n\r\n"
    for path in ("/localize", "/localize/rig", "/maps/room/current"):
        with socket.create_connection(("127.0.0.1", doors.server.http_port), timeout=5) as sent:
            sent.sendall(f"POST {path} HTTP/1.1\r\n{head}".encode())
            assert sent.recv(12) == b"HTTP/1.1 413"


def test_a_caller_says_how_long_it_waits(doors: Any, query: Any, given_up: threading.Event) -> None:
    response = post(doors, query.image, headers={"X-Request-Timeout": "0.2"})

    body = problem(response, 504, "request.deadline")
    assert (body["kind"], body["expected"]) == ("TimedOut", "an answer within 0.2 s")
    assert given_up.wait(10)


@pytest.mark.parametrize("seconds", ["", "soon", "0", "-1", "nan", "1" * 1000 + "s"])
def test_a_time_that_is_none_is_refused(seconds: str, doors: Any, query: Any) -> None:
    response = post(doors, query.image, headers={"X-Request-Timeout": seconds})

    assert problem(response, 422, "request.timeout")["field"] == "X-Request-Timeout"


def test_what_breaks_inside_is_a_500_without_its_insides(
    doors: Any, query: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken(*_: Any) -> NoReturn:
        raise ZeroDivisionError("division")

    monkeypatch.setattr(doors.server.engine.workers, "run", broken)
    response = post(doors, query.image, headers={"X-Request-Id": "job-7"})

    body = problem(response, 500, "server.internal")
    assert "division" not in response.text
    assert body["request_id"] == "job-7"
    assert "request job-7 failed unexpectedly" in caplog.text
    assert "ZeroDivisionError" in caplog.text


# Everything else


def test_a_request_id_is_taken_over_when_it_is_short_and_visible(doors: Any, query: Any) -> None:
    kept = post(doors, query.image, headers={"X-Request-Id": "drone-4/17"})
    replaced = post(doors, query.image, headers={"X-Request-Id": "x" * 500})

    assert kept.headers["x-request-id"] == kept.json()["request_id"] == "drone-4/17"
    assert len(replaced.headers["x-request-id"]) == 32
    assert replaced.json()["request_id"] == replaced.headers["x-request-id"]


def test_the_maps_are_listed_and_described(doors: Any) -> None:
    (listed,) = doors.http.get("/maps").json()["maps"]
    version = listed["version"]

    assert doors.http.get("/maps/room").json() == listed
    assert doors.http.get(f"/maps/room@{version}").json() == listed
    assert listed["id"] == "room"
    assert listed["local_features"] == "sift"
    assert listed["global_features"] == ["densevlad", "localvlad"]
    assert listed["images"] == 8
    assert listed["landmarks"] > 100
    assert listed["metric"] is True
    assert listed["size_bytes"] > 1000
    assert (np.array(listed["extent"]["min"]) < listed["extent"]["max"]).all()


def test_health_and_readiness(doors: Any) -> None:
    assert doors.http.get("/healthz").json() == {"status": "ok", "version": visloc.__version__}
    ready = doors.http.get("/readyz")
    version = doors.http.get("/maps/room").json()["version"]

    assert ready.status_code == 200
    assert ready.json() == {"ready": True, "maps": [f"room@{version}"], "not_loaded": []}


def test_before_the_maps_are_loaded_the_service_is_alive_and_not_ready(
    serve: Any, built_maps: Any, query: Any
) -> None:
    with serve(built_maps, load=False) as doors:
        assert doors.http.get("/healthz").status_code == 200
        ready = doors.http.get("/readyz")
        assert (ready.status_code, ready.json()["ready"]) == (503, False)
        response = post(doors, query.image)
        problem(response, 503, "server.starting")
        assert response.headers["retry-after"] == "1"


def test_a_map_that_is_not_loaded_is_named_with_the_reason(serve: Any, maps_dir: Any) -> None:
    (next((maps_dir / "room").glob("*/manifest.json"))).write_text("{}")

    with serve(maps_dir) as doors:
        ready = doors.http.get("/readyz")

    assert ready.status_code == 200
    (broken,) = ready.json()["not_loaded"]
    assert broken["id"] == "room"
    assert broken["code"].startswith("map.")


def test_openapi_describes_both_kinds_of_bodies_and_every_reference_resolves(doors: Any) -> None:
    schema = doors.http.get("/openapi.json").json()
    for path in ("/localize", "/localize/rig", "/localize/sequence"):
        body = schema["paths"][path]["post"]["requestBody"]["content"]
        assert set(body) == {"multipart/form-data", "application/json"}
        assert all(content["examples"] for content in body.values())
    described = schema["paths"]["/localize/sequence"]["post"]["responses"]["200"]["content"]
    assert set(described) == {"application/json", "application/x-ndjson"}
    line = described["application/x-ndjson"]
    answer, problem = line["schema"]["oneOf"]
    assert answer == {"$ref": "#/components/schemas/InstantAnswer"}
    assert problem["properties"] == {"problem": {"$ref": "#/components/schemas/Problem"}}
    answers.InstantAnswer.model_validate(line["examples"]["answer"]["value"])
    status.Problem.model_validate(line["examples"]["error"]["value"]["problem"])

    def references(part: Any) -> Iterator[str]:
        if isinstance(part, dict):
            yield from [part["$ref"]] if isinstance(part.get("$ref"), str) else []
            part = list(part.values())
        if isinstance(part, list):
            for inner in part:
                yield from references(inner)

    found = set(references(schema))
    assert "#/components/schemas/Problem" in found
    for reference in found:
        assert reference.removeprefix("#/components/schemas/") in schema["components"]["schemas"]


@pytest.mark.parametrize(
    ("path", "method", "status", "model", "names"),
    [
        ("/localize", "post", "200", answers.LocalizeResponse, {"localized", "not_localized"}),
        ("/localize/rig", "post", "200", answers.InstantAnswer, {"localized"}),
        ("/localize/sequence", "post", "200", answers.LocalizeSequenceResponse, {"sequence"}),
        ("/maps", "get", "200", maps.ListMapsResponse, {"maps"}),
        ("/maps/{ref}", "get", "200", maps.MapInfo, {"map", "set"}),
        ("/maps/{ref}/images", "get", "200", scenes.MapImages, {"images"}),
        ("/maps/{map_id}/current", "post", "200", maps.MapInfo, {"map"}),
        ("/maps/{map_id}/versions/{version}", "get", "200", maps.MapInfo, {"map"}),
        ("/maps/{map_id}/versions/{version}", "put", "201", maps.MapInfo, {"map"}),
        ("/readyz", "get", "200", status.Readiness, {"ready"}),
        ("/readyz", "get", "503", status.Readiness, {"loading"}),
    ],
)
def test_openapi_shows_answers_that_are_whole(
    path: str, method: str, status: str, model: type[BaseModel], names: set[str], doors: Any
) -> None:
    schema = doors.http.get("/openapi.json").json()
    content = schema["paths"][path][method]["responses"][status]["content"]["application/json"]
    assert content["schema"]["$ref"].endswith(f"/{model.__name__}")
    assert content["examples"].keys() == names
    for shown in content["examples"].values():
        read = model.model_validate(shown["value"])
        assert read.model_dump(mode="json") == shown["value"]


def test_the_example_of_the_documentation_is_answered(doors: Any) -> None:
    response = doors.http.post("/localize", json=example("localize_request") | {"map": "room"})

    assert response.json()["status"] == "not_localized"
    assert response.json()["camera"]["source"] == "given"


def test_nothing_of_the_service_loads_from_other_hosts(doors: Any) -> None:
    for path in ("/", "/docs", "/redoc"):
        answer = doors.http.get(path)
        if answer.status_code == 404:  # the page was not built
            problem(answer, 404, "page.not_built")
        else:
            assert re.findall(r"(?:src|href)=\"(\w+:|//)", answer.text) == []


def test_what_fastapi_refuses_is_a_problem_too(doors: Any) -> None:
    app = create_app(doors.server.backend)
    app.get("/cube")(_cube)
    transport = httpx.ASGITransport(app)

    async def ask(path: str) -> httpx.Response:
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
            return await http.get(path)

    missing = problem(asyncio.run(ask("/cube")), 422, "request.missing_field")
    wrong = problem(asyncio.run(ask("/cube?side=wide")), 422, "request.invalid")
    assert missing["field"] == wrong["field"] == "query.side"
    assert wrong["got"] == "wide"


def _cube(side: int) -> int:
    return side**3


def test_a_request_with_two_ends_is_refused_and_the_connection_closed(doors: Any) -> None:
    with socket.create_connection(("127.0.0.1", doors.server.http_port), timeout=10) as connection:
        connection.sendall(
            b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n"
            b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET /healthz HTTP/1.1\r\n"
            b"Host: localhost\r\n\r\n"
        )
        answer = b""
        while part := connection.recv(65536):
            answer += part
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert b"request.framing" in answer
    assert answer.count(b"HTTP/1.1") == 1
