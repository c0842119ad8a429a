"""Requests with several photos: what they say, and what is refused before anything is decoded."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor

from service.api import jobs
from service.api.answers import instant_answer
from service.grpc.messages import (
    instant_of,
    localize_job_of,
    near_of,
    rig_job_of,
    sequence_start_of,
)
from service.grpc.reading import reader_of
from service.http.bodies import max_sequence_values
from service.settings import ServiceSettings
from service.values import ONLY_SENSOR, Localization, RigJob
from visloc.errors import InvalidInput, TooLarge
from visloc.geometry import Camera, Pose
from visloc.options import Fusion, ReadAs
from visloc.options import LocalizeOptions as CoreOptions
from visloc.sequences.filling import TimeUnit
from visloc.types import (
    CameraSource,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    Reason,
    Refusal,
    RetrievedImage,
)
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.message import MAX_INSTANT_VALUES, IncomingMessage
from visloc_api.words.rigs import MAX_SENSORS, BatchLimits, LocalizeRigRequest
from visloc_api.words.sequences import LocalizeSequenceRequest

NAN = float("nan")
LONG = "x" * 101
IDENTITY = {"rotation_wxyz": [1, 0, 0, 0], "translation": [0, 0, 0]}
TURNED = {"rotation_wxyz": [0, 0, 1, 0], "translation": [0.5, 0, 0]}
CAMERA = {"model": "PINHOLE", "width": 64, "height": 48, "params": [50, 50, 32, 24]}
LIMITS = BatchLimits(max_images=2, max_instants=3)
PHOTO = base64.b64encode(b"photo").decode()


def rig(**changes: object) -> dict[str, Any]:
    sensors = {
        "left": {"cam_from_rig": IDENTITY, "camera": CAMERA},
        "right": {"cam_from_rig": TURNED},
    }
    return {"sensors": sensors | changes}


def image(sensor: str | None = "left", **changes: object) -> dict[str, Any]:
    return {"sensor": sensor, "image": PHOTO, **changes}


def rig_request(**changes: object) -> dict[str, Any]:
    return {"map": "room", "rig": rig(), "images": [image(), image("right")], **changes}


def sequence_request(**changes: object) -> dict[str, Any]:
    instants = [{"timestamp": 10 * i, "images": [image(None)]} for i in range(2)]
    return {"map": "room", "instants": instants, **changes}


def read_rig(message: object, files: dict[str, bytes] | None = None) -> RigJob:
    return jobs.rig_job_of(LocalizeRigRequest.read_json(json.dumps(message), LIMITS), files or {})


def read_sequence(message: object, files: dict[str, bytes] | None = None) -> Any:
    return jobs.sequence_jobs_of(
        LocalizeSequenceRequest.read_json(json.dumps(message), LIMITS), files or {}
    )


def refused(read: Any, message: object, files: dict[str, bytes] | None = None) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        read(message, files)
    return caught.value


# How much may be said

FULL_CAMERA = CAMERA | {"model": "FULL_OPENCV", "params": [1.5] * 12}
MATRIX = [0.0] * 36


def num_values(message: object) -> int:
    text = json.dumps(message)
    return sum(map(text.count, ",[{"))


def test_a_rig_of_as_many_cameras_and_images_as_there_may_be_is_read() -> None:
    array = {"dtype": "int8", "shape": [0, 64], "data": ""}
    features = {"kind": "sift", "keypoints": array, "descriptors": array}
    features |= {"global_descriptors": {f"kind{i}": array for i in range(4)}}
    sensor = {"cam_from_rig": IDENTITY, "camera": FULL_CAMERA}
    message = rig_request(
        rig={"sensors": {str(i): sensor for i in range(MAX_SENSORS)}},
        images=[
            {"sensor": str(i), "features": features, "camera": FULL_CAMERA, "timestamp": 1}
            for i in range(MAX_SENSORS)
        ],
        priors={"pose": {"device_from_world": IDENTITY, "covariance": MATRIX}},
    )
    limits = BatchLimits(max_images=MAX_SENSORS, max_instants=1)

    assert num_values(message) < MAX_INSTANT_VALUES
    LocalizeRigRequest.read_json(json.dumps(message), limits, MAX_INSTANT_VALUES)


@pytest.mark.parametrize(("cameras", "camera"), [(16, None), (8, CAMERA), (1, FULL_CAMERA)])
def test_a_sequence_of_as_many_instants_as_there_may_be_has_room(
    cameras: int, camera: object
) -> None:
    settings = ServiceSettings(maps_dir="maps")
    given = {} if camera is None else {"camera": camera}
    instant = {
        "timestamp": 1,
        "images": [image(str(i), **given) for i in range(cameras)],
        "odometry": {"rig_from_odometry": IDENTITY, "covariance": MATRIX},
        "priors": {"pose": {"device_from_world": IDENTITY, "covariance": MATRIX}},
    }

    assert num_values(instant) * settings.max_instants < max_sequence_values(settings)


@pytest.mark.parametrize(
    ("model", "max_values"),
    [(LocalizeRigRequest, MAX_INSTANT_VALUES), (LocalizeSequenceRequest, 600_000)],
)
def test_json_of_more_values_is_refused_before_it_is_parsed(
    model: type[IncomingMessage], max_values: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model, "model_validate_json", lambda *_, **__: pytest.fail("parsed"))
    text = '{"rig": {"sensors": {' + '"a": {}, ' * max_values + "}}}"

    with pytest.raises(TooLarge) as caught:
        model.read_json(text, LIMITS, max_values)

    assert caught.value.code == "request.too_large"


def many_sensors() -> pb2.LocalizeRigRequest:
    message = pb2.LocalizeRigRequest(map="room")
    for number in range(100_001):
        message.calibration.sensors[str(number)].SetInParent()
    return message


@pytest.mark.parametrize(
    "message",
    [
        many_sensors(),
        pb2.LocalizeRigRequest(map="room", rig_id="a", images=[pb2.RigImage()] * 100_001),
        pb2.LocalizeRigRequest(maps=[""] * 100_001),
        pb2.LocalizeRigRequest(images=[pb2.RigImage(camera={"params": [1.0] * 1000})] * 101),
        pb2.LocalizeRigRequest(priors={"gravity": {"direction": [1.0] * 100_001}}),
    ],
    ids=["sensors", "images", "maps", "numbers of many images", "numbers"],
)
def test_a_message_of_more_values_is_refused_before_it_is_parsed(
    message: pb2.LocalizeRigRequest,
) -> None:
    unread = reader_of(pb2.LocalizeRigRequest.FromString)(message.SerializeToString())

    with pytest.raises(TooLarge) as refused:
        asyncio.run(unread.read())
    assert (refused.value.code, refused.value.expected) == ("request.too_large", "at most 100000")


# What is said


def test_a_rig_request_becomes_the_job_that_it_says() -> None:
    images = [image(timestamp=7, camera="PINHOLE,64,48,50,50,32,24"), image("right")]
    message = rig_request(
        images=images, options={"seed": 3}, priors={"height": {"min": 0, "max": 1}}
    )

    job = read_rig(message)

    assert (job.maps, job.timestamp, job.options.seed) == (("room",), 7, 3)
    assert job.priors.height is not None
    assert not isinstance(job.rig, str)
    left, right = job.rig["left"], job.rig["right"]
    np.testing.assert_array_equal(right.cam_from_rig.rotation, np.diag([-1, 1, -1]))
    np.testing.assert_array_equal(right.cam_from_rig.translation, [0.5, 0, 0])
    assert left.camera == job.images[0].camera is not None
    assert right.camera is None
    assert [(i.sensor, i.query) for i in job.images] == [("left", b"photo"), ("right", b"photo")]


def test_a_rig_may_be_named() -> None:
    assert read_rig(rig_request(rig="front", maps=["a", "b"], map=None)).rig == "front"


def test_files_of_a_form_become_the_images_that_name_them() -> None:
    images = [
        {"sensor": "left", "part": "two"},
        {"sensor": "right", "part": "one"},
    ]

    job = read_rig(rig_request(images=images), {"one": b"1", "two": b"2"})

    assert [i.query for i in job.images] == [b"2", b"1"]


def test_a_sequence_becomes_the_jobs_that_it_says() -> None:
    odometry = {"rig_from_odometry": TURNED}
    covariance = np.diag([1e-4] * 6).ravel().tolist()
    instants = [
        {"timestamp": -5, "images": [image()], "odometry": odometry},
        {
            "timestamp": 2**63 - 1,
            "images": [],
            "odometry": odometry | {"covariance": covariance},
            "priors": {"position": {"position": [0, 0, 0], "radius": 1}},
        },
    ]
    message = sequence_request(rig=rig(), instants=instants, time_unit="ns", max_gap_s=0, priors={})

    start, (first, second) = read_sequence(message)

    assert (start.maps, start.time_unit, start.max_gap_s) == (("room",), TimeUnit.NS, 0.0)
    assert set(start.rig) == {"left", "right"}
    assert (first.timestamp, first.images[0].sensor, first.priors) == (-5, "left", None)
    assert first.odometry.covariance is None
    np.testing.assert_array_equal(first.odometry.rig_from_odometry.translation, [0.5, 0, 0])
    np.testing.assert_array_equal(second.odometry.covariance, np.diag([1e-4] * 6))
    assert second.images == ()
    assert second.priors.position.radius == 1


def test_without_a_rig_there_is_one_camera_with_no_need_of_a_name() -> None:
    start, instants = read_sequence(sequence_request())

    assert (start.rig, start.time_unit, start.max_gap_s) == (None, None, 1.0)
    assert [instant.images[0].sensor for instant in instants] == [ONLY_SENSOR] * 2


# What is refused


def quaternion(*numbers: float) -> dict[str, Any]:
    return rig(right={"cam_from_rig": TURNED | {"rotation_wxyz": numbers}})


AT_RIGHT = "rig.sensors.right.cam_from_rig"


@pytest.mark.parametrize(
    ("changes", "code", "field"),
    [
        ({"map": None}, "request.map", "map"),
        ({"rig": None}, "request.missing_field", "rig"),
        ({"rig": 3}, "request.invalid", "rig"),
        ({"rig": []}, "request.invalid", "rig"),
        ({"rig": {"sensors": []}}, "request.invalid", "rig.sensors"),
        ({"rig": {"sensors": {}}}, "rig.empty", "rig.sensors"),
        ({"rig": {}}, "request.missing_field", "rig.sensors"),
        ({"rig": rig(right={})}, "request.missing_field", AT_RIGHT),
        ({"rig": quaternion(1.01, 0, 0, 0)}, "rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        ({"rig": quaternion(0, 0, 0, 0)}, "rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        ({"rig": quaternion(1, 0, 0)}, "rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        ({"rig": quaternion(NAN, 0, 0, 0)}, "rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        ({"rig": quaternion(1e300, 0, 0, 0)}, "rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        (  # a matrix
            {"rig": quaternion(1, 0, 0, 0, 1, 0, 0, 0, 1)},
            *("rig.rotation", f"{AT_RIGHT}.rotation_wxyz"),
        ),
        (
            {"rig": rig(right={"cam_from_rig": TURNED | {"translation": [0, NAN, 0]}})},
            *("pose.translation", f"{AT_RIGHT}.translation"),
        ),
        (
            {"rig": rig(right={"cam_from_rig": TURNED | {"translation": [0, 1e300, 0]}})},
            *("pose.translation", f"{AT_RIGHT}.translation"),
        ),
        (
            {"rig": rig(right={"cam_from_rig": TURNED, "camera": CAMERA | {"model": "FISHY"}})},
            *("camera.model", "rig.sensors.right.camera.model"),
        ),
        (
            {"rig": rig(right={"cam_from_rig": TURNED, "camera": "PINHOLE,1"})},
            *("camera.syntax", "rig.sensors.right.camera"),
        ),
        (
            {"rig": {"sensors": dict.fromkeys(map(str, range(MAX_SENSORS + 1)), 0)}},
            *("rig.too_many_sensors", "rig.sensors"),
        ),
        (
            {"rig": {"sensors": {LONG: {"cam_from_rig": IDENTITY}}}},
            *("rig.id", "rig.sensors"),
        ),
        ({"rig": LONG}, "rig.id", "rig"),
        ({"images": [image(), image(LONG)]}, "rig.id", "images[1].sensor"),
        ({"images": {}}, "request.invalid", "images"),
        ({"maps": []}, "request.map", "map"),
        ({"images": [image()] * 3}, "rig.too_many_images", "images"),
        ({"images": [image(), 3]}, "request.invalid", "images[1]"),
        ({"images": [image(None)]}, "request.missing_field", "images[0].sensor"),
        ({"images": [image("")]}, "request.missing_field", "images[0].sensor"),
        ({"images": [image(), image("right", image="?")]}, "image.base64", "images[1].image"),
        ({"images": [{"sensor": "left"}]}, "request.query", "images[0].image"),
        ({"images": [image(part="x")]}, "request.query", "images[0].image"),
        ({"images": [{"sensor": "left", "part": "x"}]}, "request.part", "images[0].part"),
        ({"images": [image(mask_part="x")]}, "request.part", "images[0].mask_part"),
        ({"images": [image(mask="AAAA", mask_part="x")]}, "request.query", "images[0].mask"),
        ({"images": [image(camera={})]}, "request.missing_field", "images[0].camera.model"),
        (
            {"images": [image(camera=CAMERA | {"params": [NAN, 1, 1, 1]})]},
            *("camera.param_value", "images[0].camera.params"),
        ),
        (
            {"images": [image(timestamp=1), image("right", timestamp=2)]},
            *("rig.timestamps", "images[1].timestamp"),
        ),
        ({"images": [image(timestamp=1.5)]}, "request.invalid", "images[0].timestamp"),
        ({"images": [image(timestamp=2**63)]}, "request.invalid", "images[0].timestamp"),
        (
            {
                "images": [
                    {
                        "sensor": "left",
                        "features": {
                            "kind": "sift",
                            "keypoints": {"dtype": "float64", "shape": [0, 2], "data": ""},
                            "descriptors": {"dtype": "int8", "shape": [0, 2], "data": ""},
                        },
                    }
                ]
            },
            *("features.dtype", "images[0].features.keypoints.dtype"),
        ),
        ({"options": {"top_k": 0}}, "options.top_k", "options.top_k"),
        ({"priors": {"height": {"min": 1, "max": 0}}}, "priors.height", "priors.height"),
        ({"timestamp": 3}, "request.unknown_field", "timestamp"),
    ],
)
def test_a_wrong_rig_request_is_refused_at_the_field(
    changes: dict[str, Any], code: str, field: str
) -> None:
    error = refused(read_rig, rig_request(**changes))

    assert (error.code, error.field) == (code, field)
    assert isinstance(error, TooLarge) == ("too_many" in code)
    assert len(str(error)) < 1000


def test_a_quaternion_of_few_digits_is_a_rotation() -> None:
    job = read_rig(rig_request(rig=quaternion(0.7071, 0.7074, 0, 0)))

    assert not isinstance(job.rig, str)
    rotation = job.rig["right"].cam_from_rig.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("parts", "files", "field", "got"),
    [
        (["a", "b"], {"a": b""}, "images[1].part", "b"),
        (["a", "a"], {"a": b""}, "images[1].part", "a"),
        (["a"], {"a": b"", "b": b""}, "b", "b"),
        ([""], {}, "images[0].part", ""),
    ],
)
def test_every_file_is_one_image(
    parts: list[str], files: dict[str, bytes], field: str, got: str
) -> None:
    images = [{"sensor": str(number), "part": part} for number, part in enumerate(parts)]

    error = refused(read_rig, rig_request(images=images), files)

    assert (error.code, error.field, error.got) == ("request.part", field, got)


def test_ids_of_a_hundred_characters_are_fine() -> None:
    sensors = {LONG[1:]: {"cam_from_rig": IDENTITY}}

    job = read_rig(rig_request(rig={"sensors": sensors}, images=[image(LONG[1:])]))

    assert job.images[0].sensor == LONG[1:]
    assert read_rig(rig_request(rig=LONG[1:])).rig == LONG[1:]


def instant(**changes: object) -> dict[str, Any]:
    return {"timestamp": 5, "images": [image(None)], **changes}


@pytest.mark.parametrize(
    ("changes", "code", "field"),
    [
        ({"instants": None}, "request.invalid", "instants"),
        ({"instants": [instant()] * 4}, "sequence.too_many_instants", "instants"),
        ({"instants": [0] * 9_000}, "sequence.too_many_instants", "instants"),
        ({"instants": [instant(), {}]}, "request.missing_field", "instants[1].timestamp"),
        ({"instants": [instant(timestamp=NAN)]}, "request.invalid", "instants[0].timestamp"),
        (
            {"instants": [instant(images=[image()] * 3)]},
            *("rig.too_many_images", "instants[0].images"),
        ),
        (
            {"rig": "r", "instants": [instant(), instant()]},
            *("request.missing_field", "instants[0].images[0].sensor"),
        ),
        (
            {"instants": [instant(), instant(images=[image(timestamp=6)])]},
            *("rig.timestamps", "instants[1].images[0].timestamp"),
        ),
        (
            {"instants": [instant(odometry={"rig_from_odometry": {**IDENTITY, "scale": 2}})]},
            *("request.unknown_field", "instants[0].odometry.rig_from_odometry.scale"),
        ),
        (
            {
                "instants": [
                    instant(
                        odometry={"rig_from_odometry": IDENTITY | {"rotation_wxyz": [0, 0, 0, 2]}}
                    )
                ]
            },
            *("pose.rotation", "instants[0].odometry.rig_from_odometry.rotation_wxyz"),
        ),
        (
            {
                "instants": [
                    instant(odometry={"rig_from_odometry": IDENTITY, "covariance": [-1] * 36})
                ]
            },
            *("pose.covariance", "instants[0].odometry.covariance"),
        ),
        (  # not the same as left out
            {"instants": [instant(odometry={"rig_from_odometry": IDENTITY, "covariance": []})]},
            *("pose.covariance", "instants[0].odometry.covariance"),
        ),
        (
            {"instants": [instant(priors={"gravity": {"direction": [0, 1, 0], "world": []}})]},
            *("priors.gravity", "instants[0].priors.gravity.world"),
        ),
        ({"instants": [instant(images=[image(LONG)])]}, "rig.id", "instants[0].images[0].sensor"),
        (
            {"instants": [instant(), instant(priors={"position": {"position": [], "radius": 1}})]},
            *("priors.position", "instants[1].priors.position.position"),
        ),
        ({"time_unit": "h"}, "sequence.time_unit", "time_unit"),
        ({"rig": {"sensors": {}}}, "rig.empty", "rig.sensors"),
        ({"maps": ["a"]}, "request.map", "map"),
        ({"max_gap_s": "1"}, "request.invalid", "max_gap_s"),
    ],
)
def test_a_wrong_sequence_is_refused_at_the_field(
    changes: dict[str, Any], code: str, field: str
) -> None:
    error = refused(read_sequence, sequence_request(**changes))

    assert (error.code, error.field) == (code, field)
    assert isinstance(error, TooLarge) == ("too_many" in code)


def test_a_million_wrong_values_are_one_complaint() -> None:
    text = json.dumps(sequence_request(instants=[instant(images=[0] * 3), *[0] * 2]))
    many = text.replace("[0, 0, 0]", "[" + "0," * 1_000_000 + "0]")

    for message in (text, many):
        with pytest.raises(TooLarge) as caught:
            LocalizeSequenceRequest.read_json(message, LIMITS, 2_000_000)
        assert caught.value.code == "rig.too_many_images"


# What is answered


def test_an_image_of_an_instant_lists_the_best_twenty_photos() -> None:
    camera = Camera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0))
    retrieved = tuple(RetrievedImage(f"{i}.jpg", 1.0 - i / 100, {}) for i in range(30))
    evidence = Evidence(camera, CameraSource.GIVEN, 1, ReadAs.STORED, retrieved=retrieved)
    seen = ImageAnswer("camera", Pose.identity(), evidence, None)
    refusal = Refusal("pose", Reason.NO_POSE, "no pose")
    answer = InstantAnswer(None, (seen,), None, refusal, {})

    message = instant_answer(Localization(answer, "room", "1"), "id")

    names = [photo.image for photo in message.images[0].retrieved]
    assert names == [f"{i}.jpg" for i in range(20)]


# Over gRPC the same


def test_messages_say_the_same_as_json() -> None:
    def transform(given: dict[str, Any]) -> pb2.Transform:
        return pb2.Transform(**given)

    request = pb2.LocalizeRigRequest(
        maps=["a", "b"],
        calibration=pb2.RigCalibration(
            sensors={
                "left": pb2.RigSensor(
                    cam_from_rig=transform(IDENTITY), camera=pb2.Camera(**CAMERA)
                ),
                "right": pb2.RigSensor(cam_from_rig=transform(TURNED)),
            }
        ),
        images=[pb2.RigImage(sensor="left", image=b"photo", timestamp=0)],
        options=pb2.LocalizeOptions(photos=["b"], fusion="mean", fusion_weights={"a": 2}),
        priors=pb2.Priors(height=pb2.HeightBand(min=0, max=1)),
    )

    job = rig_job_of(request, LIMITS)

    assert (job.maps, job.timestamp) == (("a", "b"), 0)
    assert job.options == CoreOptions(photos=("b",), fusion=Fusion.MEAN, fusion_weights={"a": 2})
    assert (job.images[0].query, job.images[0].camera) == (b"photo", None)
    assert job.priors.height is not None
    assert (job.priors.height.min, job.priors.pose) == (0, None)
    assert not isinstance(job.rig, str)
    assert list(job.rig) == ["left", "right"]
    assert job.rig["left"].camera is not None
    assert job.rig["right"].camera is None


def test_instants_of_a_stream_say_the_same_as_json() -> None:
    start = pb2.SequenceStart(map="room", request_id="x")
    odometry = pb2.Odometry(rig_from_odometry=pb2.Transform(**IDENTITY))
    priors = pb2.Priors(gravity=pb2.GravityPrior(direction=[0, 1, 0]))
    instant = pb2.Instant(
        timestamp=0, images=[pb2.RigImage(image=b"")], odometry=odometry, priors=priors
    )

    begun = sequence_start_of(pb2.LocalizeSequenceRequest(start=start))
    job = instant_of(pb2.LocalizeSequenceRequest(instant=instant), LIMITS, 0, has_rig=False)

    assert (begun.maps, begun.rig, begun.time_unit, begun.max_gap_s) == (("room",), None, None, 1)
    assert (job.timestamp, job.images[0].sensor, job.images[0].query) == (0, ONLY_SENSOR, b"")
    assert job.odometry is not None
    assert job.odometry.covariance is None
    assert job.priors is not None
    assert job.priors.gravity is not None
    assert job.priors.gravity.world is None


FLOATS = b"".join(struct.pack("<Bf", 4 << 3 | 5, value) for value in CAMERA["params"])


def read_photo_message(data: bytes) -> object:
    return localize_job_of(pb2.LocalizeRequest.FromString(data), 10**6)


@pytest.mark.parametrize(
    ("read", "data", "field"),
    [
        (read_photo_message, b"\x9a\x06\x03abc", "99"),
        (read_photo_message, b"\x08\x05", "map"),  # a number
        (
            read_photo_message,
            pb2.LocalizeRequest(options={}).SerializeToString()[:1] + b"\3\xf8\1\1",
            "31",
        ),
        (
            lambda data: rig_job_of(pb2.LocalizeRigRequest.FromString(data), LIMITS),
            b"\xf8\1\1",
            "31",
        ),
        (lambda data: near_of(pb2.ListMapsRequest.FromString(data)), b"\xf8\1\1", "31"),
        # An app that was made for float sends four bytes of a number, where eight are read.
        (
            read_photo_message,
            pb2.LocalizeRequest(camera=pb2.Camera.FromString(FLOATS)).SerializeToString(),
            "params",
        ),
    ],
)
def test_field_of_a_message_that_would_be_passed_over_is_refused(
    read: Callable[[bytes], object], data: bytes, field: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        read(data)
    assert (caught.value.code, caught.value.field) == ("request.unknown_field", field)


@pytest.mark.parametrize(
    ("message", "got"),
    [
        (None, "nothing"),
        (pb2.LocalizeSequenceRequest(), "nothing"),
        (pb2.LocalizeSequenceRequest(instant=pb2.Instant()), "instant"),
    ],
)
def test_a_stream_begins_with_a_start(message: Any, got: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        sequence_start_of(message)
    assert (caught.value.code, caught.value.got) == ("sequence.message", got)


@pytest.mark.parametrize(
    ("message", "code", "field"),
    [
        (pb2.LocalizeSequenceRequest(start=pb2.SequenceStart()), "sequence.message", None),
        (pb2.LocalizeSequenceRequest(), "sequence.message", None),
        (
            pb2.LocalizeSequenceRequest(
                instant=pb2.Instant(
                    timestamp=1, images=[pb2.RigImage(sensor=str(i)) for i in range(3)]
                )
            ),
            *("rig.too_many_images", "instants[4].images"),
        ),
        (
            pb2.LocalizeSequenceRequest(
                instant=pb2.Instant(timestamp=1, images=[pb2.RigImage(sensor="l")])
            ),
            *("request.query", "instants[4].images[0].image"),
        ),
        (
            pb2.LocalizeSequenceRequest(
                instant=pb2.Instant(
                    timestamp=1, priors=pb2.Priors(height=pb2.HeightBand(min=2, max=1))
                )
            ),
            *("priors.height", "instants[4].priors.height"),
        ),
        (
            pb2.LocalizeSequenceRequest(instant=pb2.Instant(images=[pb2.RigImage(image=b"")])),
            *("request.missing_field", "instants[4].timestamp"),
        ),
    ],
)
def test_a_wrong_message_of_a_stream_is_refused(message: Any, code: str, field: str | None) -> None:
    with pytest.raises(InvalidInput) as caught:
        instant_of(message, LIMITS, 4, has_rig=True)
    assert caught.value.code == code
    assert field is None or caught.value.field == field


# Numbers in messages of gRPC: 0 is a place, a height and a time. A number that is left out is none.

FIX = {"latitude": 0.0, "longitude": 0.0, "accuracy": 4.0}


def test_a_fix_at_zero_degrees_that_is_sent_is_read() -> None:
    priors = pb2.Priors(gnss=pb2.GnssPrior(**FIX))
    job = localize_job_of(pb2.LocalizeRequest(map="a", image=b"photo", priors=priors), 1000)
    assert job.priors.gnss is not None
    assert (job.priors.gnss.latitude, job.priors.gnss.longitude) == (0.0, 0.0)
    request = pb2.ListMapsRequest(near=pb2.Near(latitude=0.0, longitude=0.0, radius=5.0))
    near = near_of(pb2.ListMapsRequest.FromString(request.SerializeToString()))
    assert near is not None
    assert (near.latitude, near.longitude, near.radius) == (0.0, 0.0, 5.0)


@pytest.mark.parametrize("left_out", sorted(FIX))
def test_a_part_of_a_fix_that_is_left_out_is_named(left_out: str) -> None:
    parts = {name: value for name, value in FIX.items() if name != left_out}
    priors = pb2.Priors(gnss=pb2.GnssPrior(**parts))
    with pytest.raises(InvalidInput) as caught:
        localize_job_of(pb2.LocalizeRequest(map="a", image=b"photo", priors=priors), 1000)
    assert caught.value.code == "request.missing_field"
    assert caught.value.field == f"priors.gnss.{left_out}"


@pytest.mark.parametrize("left_out", ["latitude", "longitude", "radius"])
def test_a_part_of_a_circle_that_is_left_out_is_named(left_out: str) -> None:
    parts = {"latitude": 1.0, "longitude": 1.0, "radius": 5.0}
    del parts[left_out]
    with pytest.raises(InvalidInput) as caught:
        near_of(pb2.ListMapsRequest(near=pb2.Near(**parts)))
    assert (caught.value.code, caught.value.field) == ("request.missing_field", f"near.{left_out}")


@pytest.mark.parametrize("left_out", ["min", "max"])
def test_an_end_of_a_height_band_that_is_left_out_is_named(left_out: str) -> None:
    band = {"min": -1.0, "max": 1.0}
    del band[left_out]
    priors = pb2.Priors(height=pb2.HeightBand(**band))
    with pytest.raises(InvalidInput) as caught:
        localize_job_of(pb2.LocalizeRequest(map="a", image=b"photo", priors=priors), 1000)
    assert caught.value.code == "request.missing_field"
    assert caught.value.field == f"priors.height.{left_out}"


# Numbers of requests without presence, by what refuses their 0.
REFUSED_AT_ZERO = {
    "visloc.v1.Camera.width": ("camera.size", pb2.Camera(model="PINHOLE", height=48)),
    "visloc.v1.Camera.height": ("camera.size", pb2.Camera(model="PINHOLE", width=64)),
    "visloc.v1.PositionPrior.radius": (
        "priors.position",
        pb2.Priors(position=pb2.PositionPrior(position=[1, 2, 3])),
    ),
    "visloc.v1.LocalizeOptions.FusionWeightsEntry.value": (
        "options.fusion_weights",
        pb2.LocalizeOptions(fusion_weights={"densevlad": 0.0}),
    ),
}


@pytest.mark.parametrize(("code", "part"), REFUSED_AT_ZERO.values(), ids=REFUSED_AT_ZERO)
def test_a_number_without_presence_is_refused_at_zero(code: str, part: Any) -> None:
    field = {pb2.Camera: "camera", pb2.Priors: "priors", pb2.LocalizeOptions: "options"}[type(part)]
    if isinstance(part, pb2.Camera):
        part.params.extend(CAMERA["params"])
    request = pb2.LocalizeRequest(map="a", image=b"photo", **{field: part})
    with pytest.raises(InvalidInput) as caught:
        localize_job_of(request, 1000)
    assert caught.value.code == code


def test_all_other_numbers_of_requests_have_presence() -> None:
    methods = [
        method for service in pb2.DESCRIPTOR.services_by_name.values() for method in service.methods
    ]
    waiting = [method.input_type for method in methods]
    messages = {}
    while waiting:
        message = waiting.pop()
        if message.full_name not in messages:
            messages[message.full_name] = message
            waiting += [field.message_type for field in message.fields if field.message_type]
    texts = {FieldDescriptor.CPPTYPE_STRING}  # an empty one names nothing
    without = {
        field.full_name
        for message in messages.values()
        for field in message.fields
        if not (field.is_repeated or field.has_presence or field.cpp_type in texts)
    }
    assert without == set(REFUSED_AT_ZERO)


def test_bytes_of_a_fix_are_what_they_were_before_its_parts_had_presence() -> None:
    # Fields 1 to 3, each eight bytes.
    old = b"".join(
        bytes([number << 3 | 1]) + struct.pack("<d", value)
        for number, value in enumerate((48.1, -8.2, 4.5), 1)
    )
    assert pb2.GnssPrior(latitude=48.1, longitude=-8.2, accuracy=4.5).SerializeToString() == old
    assert pb2.Near(latitude=48.1, longitude=-8.2, radius=4.5).SerializeToString() == old
