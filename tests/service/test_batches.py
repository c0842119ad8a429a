"""Rigs and sequences over both doors, answered by the engine."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict, ParseDict
from google.rpc.error_details_pb2 import ErrorInfo
from grpc_status import rpc_status

from service.http.openapi import example
from visloc.geometry import Camera, Pose, rotation_angle
from visloc.kapture import Dataset, read_dataset
from visloc_api.v1 import localization_pb2 as pb2

IDENTITY = {"rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
FAST = {"top_k": 4}
# Options that do not fit the map, or not a rig, by the field and code of the error.
NOT_OF_THE_MAP: dict[str, dict[str, Any]] = {
    "options.fusion_weights": {"fusion_weights": {"gem": 1}},
    "options.matcher": {"matcher": "lightglue"},
    "options.solver": {"solver": "registration"},
}


@pytest.fixture(scope="module")
def taken(sample: Path) -> Dataset:
    """The query run of the sample: two photos of the rig, and one of its left camera after it."""
    return read_dataset(sample / "query")


def transform(pose: Pose) -> dict[str, Any]:
    return {
        "rotation_wxyz": pose.rotation_wxyz.tolist(),
        "translation": pose.translation.tolist(),
    }


def words(camera: Camera | None) -> dict[str, Any]:
    assert camera is not None
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


@pytest.fixture(scope="module")
def rig(taken: Dataset) -> dict[str, Any]:
    """How the cameras of the sample sit, as JSON."""
    return {
        "sensors": {
            sensor: {
                "cam_from_rig": transform(pose),
                "camera": words(taken.sensors[sensor].camera),
            }
            for sensor, pose in taken.rigs["rig"].items()
            if taken.sensors[sensor].camera is not None
        }
    }


@pytest.fixture(scope="module")
def photos(taken: Dataset) -> dict[str, bytes]:
    """Of the first instant, by sensor."""
    first = taken.images[0].timestamp
    return {
        record.sensor_id: taken.path_of(record).read_bytes()
        for record in taken.images
        if record.timestamp == first
    }


@pytest.fixture(scope="module")
def rig_from_world(taken: Dataset) -> Pose:
    """Where the rig was at the first instant."""
    record = taken.images[0]
    pose = taken.pose(record)
    assert pose is not None
    return taken.rigs["rig"][record.sensor_id].inverse() @ pose


def encoded(photo: bytes) -> str:
    return base64.b64encode(photo).decode()


def rig_request(rig: object, photos: dict[str, bytes], **fields: object) -> dict[str, Any]:
    images = [{"sensor": sensor, "image": encoded(photo)} for sensor, photo in photos.items()]
    return {"map": "room", "rig": rig, "images": images, "options": FAST, **fields}


def post(doors: Any, path: str, message: object, **options: Any) -> httpx.Response:
    response: httpx.Response = doors.http.post(f"/localize/{path}", json=message, **options)
    return response


def answer_of(response: httpx.Response) -> dict[str, Any]:
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return answer


def refused(response: httpx.Response, status: int, code: str) -> dict[str, Any]:
    problem: dict[str, Any] = response.json()
    assert (response.status_code, problem["code"]) == (status, code), problem
    return problem


def assert_at(found: dict[str, Any], truth: Pose, meters: float = 0.03) -> None:
    pose = Pose.from_quaternion(found["rotation_wxyz"], found["translation"])
    assert np.linalg.norm(pose.center - truth.center) < meters
    assert rotation_angle(pose.rotation @ truth.rotation.T) < np.radians(1)


# The same messages over gRPC


def as_image(given: dict[str, Any]) -> pb2.RigImage:
    return ParseDict(given, pb2.RigImage())


def as_rig(given: Any) -> dict[str, Any]:
    return {"rig_id": given} if isinstance(given, str) else {"calibration": given}


def as_rig_request(message: dict[str, Any]) -> pb2.LocalizeRigRequest:
    plain = {n: v for n, v in message.items() if n not in ("rig", "images")}
    images = [as_image(image) for image in message["images"]]
    return pb2.LocalizeRigRequest(**plain, **as_rig(message["rig"]), images=images)


def as_stream(message: dict[str, Any]) -> Iterator[pb2.LocalizeSequenceRequest]:
    plain = {n: v for n, v in message.items() if n not in ("rig", "instants")}
    rig = as_rig(message["rig"]) if "rig" in message else {}
    yield pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(**plain, **rig))
    for given in message["instants"]:
        instant = {**given, "images": [as_image(image) for image in given["images"]]}
        yield pb2.LocalizeSequenceRequest(instant=pb2.Instant(**instant))


def as_json(message: Any) -> dict[str, Any]:
    answer = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    if "timestamp" in answer:  # protobuf writes 64-bit integers as strings
        answer["timestamp"] = message.timestamp
    return answer


def bits(value: object) -> object:
    """Floats by their bits, so that equal means equal; what gRPC leaves out is left out."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        left_out = ("seconds", "request_id")
        return {n: bits(v) for n, v in value.items() if n not in left_out and v is not None}
    return [bits(inner) for inner in value] if isinstance(value, list) else value


def reason_of(call: Any, *arguments: Any) -> ErrorInfo:
    with pytest.raises(grpc.RpcError) as caught:
        list(call(*arguments))
    details, info = rpc_status.from_call(caught.value), ErrorInfo()
    assert details is not None
    assert details.details[0].Unpack(info)
    return info


# Rigs


def test_a_rig_is_localized_where_it_was(
    doors: Any, rig: Any, photos: dict[str, bytes], rig_from_world: Pose, taken: Dataset
) -> None:
    answer = answer_of(post(doors, "rig", rig_request(rig, photos)))

    assert (answer["status"], answer["source"]) == ("localized", "estimated")
    assert (answer["refusal"], answer["timestamp"]) == (None, None)
    assert_at(answer["pose"]["rig_from_world"], rig_from_world)
    np.testing.assert_allclose(answer["pose"]["position"], rig_from_world.center, atol=0.03)
    assert np.array(answer["pose"]["covariance"]).reshape(6, 6).trace() > 0
    assert [image["sensor"] for image in answer["images"]] == list(photos)
    for image in answer["images"]:
        assert_at(image["cam_from_world"], taken.rigs["rig"][image["sensor"]] @ rig_from_world)
        assert image["error"] is None
        assert image["camera"]["source"] == "given"
        assert 0 < image["inliers"] <= image["correspondences"] <= image["keypoints"] * 10
    assert answer["inliers"] == sum(image["inliers"] for image in answer["images"])
    assert answer["inlier_ratio"] == answer["inliers"] / answer["correspondences"]
    assert answer["map"]["id"] == "room"


def test_json_form_named_rig_and_grpc_give_the_same_answer_bit_for_bit(
    doors: Any, rig: Any, photos: dict[str, bytes]
) -> None:
    message = rig_request(rig, photos)
    over_json = bits(answer_of(post(doors, "rig", message)))
    images = [{"sensor": sensor, "part": f"{sensor}.jpg"} for sensor in photos]
    form = doors.http.post(
        "/localize/rig",
        data={"request": json.dumps(message | {"images": images})},
        files={f"{sensor}.jpg": photo for sensor, photo in photos.items()},
    )
    named = post(doors, "rig", message | {"rig": "rig"})
    over_grpc = as_json(doors.stub.LocalizeRig(as_rig_request(message)))

    assert bits(answer_of(form)) == over_json
    assert bits(answer_of(named)) == over_json
    assert bits(over_grpc) == over_json


def test_a_bad_photo_fails_alone(doors: Any, rig: Any, photos: dict[str, bytes]) -> None:
    broken = photos | {"right": photos["right"][:5000]}
    answer = answer_of(post(doors, "rig", rig_request(rig, broken)))

    assert answer["status"] == "localized"
    left, right = answer["images"]
    assert left["error"] is None
    assert (right["error"]["kind"], right["error"]["code"]) == ("InvalidInput", "image.undecodable")
    assert right["error"]["message"]
    assert right["cam_from_world"] is not None
    assert (right["keypoints"], right["retrieved"], right["camera"]) == (0, [], None)


def test_no_usable_photo_is_an_answer(doors: Any, rig: Any) -> None:
    message = rig_request(rig, {"left": b"", "right": b"hello"})
    answer = answer_of(post(doors, "rig", message))

    assert (answer["status"], answer["pose"], answer["source"]) == ("not_localized", None, None)
    assert answer["refusal"]["reason"] == "no_usable_image"
    assert [i["error"]["code"] for i in answer["images"]] == ["image.empty", "image.format"]
    assert bits(as_json(doors.stub.LocalizeRig(as_rig_request(message)))) == bits(answer)


def test_one_camera_of_the_rig_is_enough(
    doors: Any, rig: Any, photos: dict[str, bytes], rig_from_world: Pose
) -> None:
    message = rig_request(rig, {"right": photos["right"]}, timestamp=None)
    del message["timestamp"]
    message["images"][0]["timestamp"] = 12

    answer = answer_of(post(doors, "rig", message))

    assert (answer["status"], answer["timestamp"]) == ("localized", 12)
    assert_at(answer["pose"]["rig_from_world"], rig_from_world)


@pytest.mark.parametrize(
    ("changes", "status", "code", "field"),
    [
        ({"rig": "front"}, 404, "rig.unknown", "rig"),
        ({"map": "hall"}, 404, "map.unknown", "map"),
        ({"images": []}, 422, "rig.empty", "images"),
        (
            {"images": [{"sensor": "top", "image": ""}]},
            *(422, "rig.sensor", "images[0].sensor"),
        ),
        ({"images": [{"sensor": "left", "image": ""}] * 2}, 422, "rig.duplicate", "images"),
        ({"images": [{"sensor": "left", "image": ""}] * 4}, 413, "rig.too_many_images", "images"),
        (
            {
                "images": [
                    {"sensor": sensor, "image": "", "timestamp": stamp}
                    for stamp, sensor in enumerate(("left", "right"))
                ]
            },
            *(422, "rig.timestamps", "images[1].timestamp"),
        ),
        (
            {
                "rig": {
                    "sensors": {
                        "left": {"cam_from_rig": IDENTITY | {"rotation_wxyz": [0.9, 0, 0, 0]}}
                    }
                }
            },
            *(422, "rig.rotation", "rig.sensors.left.cam_from_rig.rotation_wxyz"),
        ),
        ({"options": {"top_k": 0}}, 422, "options.top_k", "options.top_k"),
        *(({"options": options}, 422, field, field) for field, options in NOT_OF_THE_MAP.items()),
    ],
)
def test_a_wrong_rig_is_refused_alike_at_both_doors(
    changes: dict[str, Any], status: int, code: str, field: str, doors: Any, rig: Any
) -> None:
    message = rig_request(rig, {"left": b""}) | changes
    over_http = refused(post(doors, "rig", message), status, code)
    info = reason_of(doors.stub.LocalizeRig, as_rig_request(message))

    assert (over_http["field"], info.reason, info.metadata["field"]) == (field, code, field)
    for name in ("expected", "got"):
        assert info.metadata.get(name) == over_http[name]


def test_a_form_that_does_not_fit_the_request_is_refused(
    doors: Any, rig: Any, photos: dict[str, bytes]
) -> None:
    text = json.dumps(rig_request(rig, {}, images=[{"sensor": "left", "part": "left"}]))
    left = {"left": photos["left"]}

    def send(data: dict[str, Any], files: dict[str, bytes]) -> httpx.Response:
        response: httpx.Response = doors.http.post("/localize/rig", data=data, files=files)
        return response

    not_sent = refused(send({"request": text}, {"right": b""}), 422, "request.part")
    assert (not_sent["field"], not_sent["got"]) == ("images[0].part", "left")
    not_named = refused(send({"request": text}, left | {"top": b""}), 422, "request.part")
    assert not_named["field"] == "top"
    missing = refused(send({}, left), 422, "request.missing_field")
    assert missing["field"] == "request"
    a_file = refused(send({}, {"request": text.encode()}), 422, "request.missing_field")
    assert (a_file["field"], a_file["got"]) == ("request", "a file")
    assert refused(send({"map": "room"}, left), 422, "request.unknown_field")["field"] == "map"
    twice = {"request": [text, text]}
    assert refused(send(twice, left), 422, "request.duplicate_field")["field"] == "request"
    too_many = dict.fromkeys("abcdefg", b"")
    assert (
        "6 files"
        in refused(send({"request": text}, too_many), 422, "request.malformed")["expected"]
    )
    assert refused(send({"request": "{"}, left), 422, "request.malformed")
    refused(post(doors, "rig", []), 422, "request.invalid")


@pytest.mark.parametrize("path", ["rig", "sequence"])
@pytest.mark.parametrize("content_type", ["application/json", "multipart/form-data; boundary=x"])
def test_a_batch_over_the_limit_is_refused_while_it_is_read(
    path: str, content_type: str, doors: Any
) -> None:
    sent = 0

    def endless() -> Iterator[bytes]:
        nonlocal sent
        yield b'--x\r\nContent-Disposition: form-data; name="image"; filename="x"\r\n\r\n'
        while sent < 5_000_000:
            sent += 65536
            yield bytes(65536)

    response = doors.http.post(
        f"/localize/{path}", content=endless(), headers={"Content-Type": content_type}
    )

    assert refused(response, 413, "request.too_large")["expected"] == "at most 600000 bytes"


# Sequences


@pytest.fixture(scope="module")
def sequence(rig: Any, photos: dict[str, bytes], taken: Dataset) -> dict[str, Any]:
    """The instant of the sample three times, the second time with photos that are destroyed."""
    instants = []
    for number in range(3):
        instants.append(
            {
                "timestamp": taken.images[0].timestamp + 100 * number,
                "images": [
                    {"sensor": sensor, "image": encoded(photo if number != 1 else b"?")}
                    for sensor, photo in photos.items()
                ],
            }
        )
    return {"map": "room", "rig": rig, "instants": instants, "options": FAST}


def test_a_sequence_is_answered_in_order_and_gaps_are_filled(
    doors: Any, sequence: dict[str, Any], rig_from_world: Pose
) -> None:
    whole = answer_of(post(doors, "sequence", sequence))
    answers = whole["answers"]

    assert [a["timestamp"] for a in answers] == [i["timestamp"] for i in sequence["instants"]]
    assert [(a["status"], a["source"]) for a in answers] == [
        ("localized", "estimated"),
        ("filled", "interpolated"),
        ("localized", "estimated"),
    ]
    filled = answers[1]
    assert filled["refusal"]["reason"] == "no_usable_image"
    assert [image["error"]["code"] for image in filled["images"]] == ["image.format"] * 2
    for answer in answers:
        assert_at(answer["pose"]["rig_from_world"], rig_from_world)
    assert max(filled["pose"]["position_std"]) > max(answers[0]["pose"]["position_std"])


def test_json_form_lines_and_grpc_give_the_same_answers_bit_for_bit(
    doors: Any, sequence: dict[str, Any]
) -> None:
    odometry = {"rig_from_odometry": IDENTITY}
    instants = [{**instant, "odometry": odometry} for instant in sequence["instants"]]
    message = {**sequence, "instants": instants, "time_unit": "ms", "max_gap_s": 0.5}
    whole = answer_of(post(doors, "sequence", message))
    lines = post(doors, "sequence", message, headers={"Accept": "application/x-ndjson"})
    files = {}
    for number, instant in enumerate(instants):
        images = []
        for image in instant["images"]:
            name = f"{image['sensor']}-{number}"
            files[name] = base64.b64decode(image["image"])
            images.append({"sensor": image["sensor"], "part": name})
        instant["images"] = images
    data = {"request": json.dumps({**message, "instants": instants})}
    form = answer_of(doors.http.post("/localize/sequence", data=data, files=files))
    for instant, original in zip(instants, sequence["instants"], strict=True):
        instant["images"] = original["images"]
    over_grpc = [as_json(a) for a in doors.stub.LocalizeSequence(as_stream(message))]

    answers = bits(whole["answers"])
    assert whole["answers"][1]["source"] == "motion"
    assert bits([json.loads(line) for line in lines.text.splitlines()]) == answers
    assert bits(form["answers"]) == answers
    assert bits(over_grpc) == answers


def test_an_instant_without_images_says_so(doors: Any) -> None:
    message = {"map": "room", "instants": [{"timestamp": 1_700_000_000, "images": []}]}
    (answer,) = answer_of(post(doors, "sequence", message))["answers"]

    assert answer["refusal"]["message"] == "there is no image"
    assert (answer["refusal"]["reason"], answer["images"]) == ("no_usable_image", [])


def instant(timestamp: int = 5, *sensors: str) -> dict[str, Any]:
    images = [{"sensor": sensor, "image": ""} for sensor in sensors] or [{"image": ""}]
    return {"timestamp": timestamp, "images": images}


@pytest.mark.parametrize(
    ("changes", "status", "code", "field"),
    [
        ({"instants": []}, 422, "sequence.empty", "instants"),
        (
            {"instants": [instant(5), instant(5)]},
            *(422, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            {"instants": [instant(5), instant(4)]},
            *(422, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            {"instants": [instant(5, "a", "b")]},
            *(422, "sequence.rig", "instants[0].images"),
        ),
        ({"max_gap_s": 61}, 422, "sequence.max_gap", "max_gap_s"),
        ({"max_gap_s": float("nan")}, 422, "sequence.max_gap", "max_gap_s"),
        ({"time_unit": "h"}, 422, "sequence.time_unit", "time_unit"),
        ({"time_unit": None, "instants": [instant(-3)]}, 422, "sequence.time_unit", None),
        (
            {"rig": "rig", "instants": [instant(1, "top")]},
            *(422, "rig.sensor", "instants[0].images[0].sensor"),
        ),
        ({"rig": "front", "instants": [instant(1, "left")]}, 404, "rig.unknown", "rig"),
        *(
            (
                {"rig": "rig", "instants": [instant(1, "left")], "options": options},
                *(422, field, field),
            )
            for field, options in NOT_OF_THE_MAP.items()
        ),
    ],
)
def test_a_wrong_sequence_is_refused_alike_at_both_doors(
    changes: dict[str, Any], status: int, code: str, field: str | None, doors: Any
) -> None:
    message = {"map": "room", "instants": [instant()], "time_unit": "ms"} | changes
    content = json.dumps(message)
    headers = {"Content-Type": "application/json"}
    over_http = refused(
        doors.http.post("/localize/sequence", content=content, headers=headers), status, code
    )
    info = reason_of(doors.stub.LocalizeSequence, as_stream(message))

    assert (info.reason, info.metadata.get("field")) == (code, over_http["field"])
    assert field is None or over_http["field"] == field


def test_ten_thousand_instants_are_refused_at_both_doors(doors: Any) -> None:
    message = {"map": "room", "instants": [instant(i) for i in range(10_000)], "time_unit": "ms"}
    over_http = refused(post(doors, "sequence", message), 413, "sequence.too_many_instants")
    info = reason_of(doors.stub.LocalizeSequence, as_stream(message))

    assert over_http["expected"] == "at most 20"
    assert (info.reason, info.metadata["kind"]) == ("sequence.too_many_instants", "TooLarge")


# Priors and several maps


@pytest.mark.parametrize("path", ["", "/rig", "/sequence"])
def test_a_prior_that_lies_is_contradicted_and_one_that_is_right_changes_nothing(
    path: str, doors: Any, query: Any
) -> None:
    center = query.cam_from_world.center.tolist()
    photo = {"image": encoded(query.image), "camera": words(query.camera)}
    shared = {"maps": ["room"], "options": FAST}
    messages = {
        "": {**shared, **photo},
        "/rig": {
            **shared,
            "rig": {"sensors": {"a": {"cam_from_rig": IDENTITY}}},
            "images": [{"sensor": "a", **photo}],
        },
        "/sequence": {**shared, "instants": [{"timestamp": 1_700_000_000, "images": [photo]}]},
    }

    def ask(position: list[float]) -> dict[str, Any]:
        priors = {"position": {"position": position, "radius": 1.0}}
        response = doors.http.post(f"/localize{path}", json=messages[path] | {"priors": priors})
        answer = answer_of(response)
        return answer["answers"][0] if path == "/sequence" else answer

    assert ask(center)["status"] == "localized"
    wrong = ask([center[0] + 100, *center[1:]])
    assert wrong["status"] == "not_localized"
    assert wrong["refusal"]["reason"] in ("no_photo_near", "contradicts_prior")


def test_priors_and_maps_are_fields_of_a_form_too(doors: Any, query: Any) -> None:
    camera = ",".join(map(str, (*words(query.camera).values(),))).replace("[", "").replace("]", "")
    priors = {"position": {"position": query.cam_from_world.center.tolist(), "radius": 1.0}}
    form = doors.http.post(
        "/localize",
        data={"maps": "room", "priors": json.dumps(priors), "camera": camera},
        files={"image": query.image},
    )
    message = pb2.LocalizeRequest(
        maps=["room"],
        image=query.image,
        camera=pb2.Camera(**words(query.camera)),
        priors=pb2.Priors(position=pb2.PositionPrior(**priors["position"])),
    )

    assert bits(as_json(doors.stub.Localize(message))) == bits(answer_of(form))
    wrong = doors.http.post(
        "/localize", data={"maps": "room", "priors": "near"}, files={"image": query.image}
    )
    assert refused(wrong, 422, "request.malformed")["field"] == "priors"


# What describes them


def test_the_examples_of_the_documentation_are_answered(doors: Any) -> None:
    for path, body in (("rig", example("rig_request")), ("sequence", example("sequence_request"))):
        answer = answer_of(post(doors, path, body | {"map": "room"}))
        answers = answer.get("answers", [answer])
        assert {each["status"] for each in answers} == {"not_localized"}


def test_a_map_names_its_rigs(doors: Any) -> None:
    described = doors.http.get("/maps/room").json()

    assert described["rigs"] == [{"id": "rig", "sensors": ["left", "right"]}]
    assert described["down"] in ([], [0.0, 0.0, -1.0])
