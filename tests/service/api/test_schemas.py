from __future__ import annotations

import base64
import importlib
import json
import math
import pkgutil
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from pydantic import BaseModel

import visloc_api.words
from service.api import jobs
from visloc.errors import InvalidInput, TooLarge
from visloc.options import Extraction, Fusion, Matcher, ReadAs, Solver
from visloc.options import LocalizeOptions as CoreOptions
from visloc.priors import NO_PRIORS, HeightBand
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.photo import LocalizeRequest

CAMERA = {"model": "PINHOLE", "width": 640, "height": 480, "params": [525, 525.5, 320, 240]}


FIELDS = "map, image, features, camera, options, maps, priors, near, ypr, debug, mask"


def request(**fields: object) -> dict[str, Any]:
    return {"map": "room", "image": base64.b64encode(b"photo").decode(), **fields}


def refusal(message: object) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        jobs.photo_job_of(LocalizeRequest.read_json(json.dumps(message)))
    return caught.value


def test_a_full_request_becomes_the_job_that_it_says() -> None:
    options = {
        "preset": "config1",
        "top_k": 5,
        "photos": ["b.jpg", "a.jpg"],
        "max_error_px": 8,
        "min_inliers": 12,
        "min_inlier_ratio": 0.5,
        "min_probability": 0.8,
        "read_as": "upright",
        "extraction": "fast",
        "fusion": "mean",
        "fusion_weights": {"densevlad": 1, "kapture:AP-GeM": 0.5},
        "matcher": "ratio",
        "solver": "poselib",
        "seed": 9,
    }

    job = jobs.photo_job_of(
        LocalizeRequest.read_json(json.dumps(request(camera=CAMERA, options=options)))
    )

    assert (job.maps, job.images[0].query) == (("room",), b"photo")
    assert job.images[0].camera is not None
    assert job.images[0].camera.params == (525.0, 525.5, 320.0, 240.0)
    assert job.options == CoreOptions(
        *(
            "config1",
            5,
            ("b.jpg", "a.jpg"),
            8.0,
            12,
            0.5,
            0.8,
            ReadAs.UPRIGHT,
            Extraction.FAST,
            Fusion.MEAN,
        ),
        fusion_weights={"densevlad": 1.0, "kapture:AP-GeM": 0.5},
        matcher=Matcher.RATIO,
        solver=Solver.POSELIB,
        seed=9,
    )


def test_what_is_left_out_or_null_takes_the_default() -> None:
    nulls = {name: None for name in LocalizeRequest.model_fields if name not in request()}
    for more in ({}, nulls, {"options": {"top_k": None}}):
        job = jobs.photo_job_of(LocalizeRequest.read_json(json.dumps({**request(), **more})))
        assert job.images[0].camera is None
        assert job.options == CoreOptions()


@pytest.mark.parametrize("text", ["PINHOLE,640,480,525,525.5,320,240", json.dumps(CAMERA)])
def test_a_camera_may_be_text(text: str) -> None:
    assert (
        jobs.photo_job_of(LocalizeRequest.read(request(camera=text))).images[0].camera
        == jobs.photo_job_of(LocalizeRequest.read(request(camera=CAMERA))).images[0].camera
    )


def test_options_may_be_text() -> None:
    assert LocalizeRequest.read(request(options='{"seed": 3}')).options.seed == 3


@pytest.mark.parametrize(
    ("message", "code", "field", "expected"),
    [
        ({}, "request.map", "map", "one of map, maps, near"),
        ({"map": "room"}, "request.query", "image", "one of image, features"),
        ([], "request.invalid", None, f"an object with {FIELDS}"),
        (
            request(extra=1),
            "request.unknown_field",
            "extra",
            f"one of {FIELDS}",
        ),
        (
            request(options={"topk": 1}),
            "request.unknown_field",
            "options.topk",
            "one of preset, top_k, photos, max_error_px, min_inliers, min_inlier_ratio, "
            "min_probability, read_as, extraction, fusion, fusion_weights, fusion_parameter, "
            "matcher, solver, seed, fallback",
        ),
        (
            request(camera=CAMERA | {"fov": 60}),
            "request.unknown_field",
            "camera.fov",
            "one of model, width, height, params",
        ),
        (request(map=1), "request.invalid", "map", "Input should be a valid string"),
        (request(image="?"), "image.base64", "image", "the encoded photo in base64"),
        (request(image="é"), "image.base64", "image", "the encoded photo in base64"),
        (request(image=5), "request.invalid", "image", "Input should be a valid bytes"),
        (request(options=3), "request.invalid", "options", None),
        (request(options={"top_k": "5"}), "request.invalid", "options.top_k", None),
        (request(options={"top_k": 2.5}), "request.invalid", "options.top_k", None),
        (request(options={"top_k": True}), "request.invalid", "options.top_k", None),
        (request(options={"top_k": 0}), "options.top_k", "options.top_k", "1 to 1000"),
        (request(options={"seed": 10**300}), "options.seed", "options.seed", None),
        (request(options={"preset": "fast"}), "options.preset", "options.preset", None),
        (
            request(options={"max_error_px": float("nan")}),
            "options.max_error_px",
            "options.max_error_px",
            "0.1 to 1000.0",
        ),
        (
            request(options={"read_as": "sideways"}),
            "options.read_as",
            "options.read_as",
            "one of stored, upright, any",
        ),
        (
            request(options={"fusion": "vote"}),
            "options.fusion",
            "options.fusion",
            f"one of {', '.join(Fusion)}",
        ),
        (
            request(options={"matcher": "guess"}),
            "options.matcher",
            "options.matcher",
            "one of mutual, ratio, lightglue",
        ),
        (
            request(options={"solver": "p3p"}),
            "options.solver",
            "options.solver",
            "one of pycolmap, poselib, registration",
        ),
        *(
            (
                request(options={"fusion_weights": given}),
                *(code, f"options.fusion_weights{below}", expected),
            )
            for given, code, below, expected in [
                ([1], "request.invalid", "", None),
                ({}, "options.fusion_weights", "", "a weight for one global descriptor or more"),
                ({"a": True}, "request.invalid", ".a", None),
                ({"a": "1"}, "request.invalid", ".a", None),
                ({"a": None}, "request.invalid", ".a", None),
                ({"a": 0}, "options.fusion_weights", ".a", "0.000001 to 1000000"),
                ({"a": -1.5}, "options.fusion_weights", ".a", "0.000001 to 1000000"),
                ({"a": float("nan")}, "options.fusion_weights", ".a", "0.000001 to 1000000"),
                ({"a": float("inf")}, "options.fusion_weights", ".a", "0.000001 to 1000000"),
                ({"a": 10**400}, "request.invalid", ".a", None),
                (dict.fromkeys(map(str, range(17)), 1), "options.fusion_weights", "", "at most 16"),
                ({"": 1}, "options.fusion_weights", "", "a text of 1 to 100 characters"),
                ({"a" * 101: 1}, "options.fusion_weights", "", "a text of 1 to 100 characters"),
            ]
        ),
        *(
            (request(options={"photos": given}), code, f"options.photos{below}", expected)
            for given, code, below, expected in [
                ("a.jpg", "request.invalid", "", None),
                ([1], "request.invalid", "[0]", None),
                ([], "options.photos", "", "1 to 1000 names, each once"),
                (["a", "a"], "options.photos", "", "1 to 1000 names, each once"),
                (["a"] * 1001, "options.photos", "", "at most 1000 names"),
                (["a" * 4097], "options.photos", "", "names of at most 4096 characters"),
            ]
        ),
        (
            request(camera=CAMERA | {"params": [525, float("nan"), 320, 240]}),
            "camera.param_value",
            "camera.params",
            "fy to be a positive finite number",
        ),
        (
            request(camera=CAMERA | {"params": [-525, 525, 320, 240]}),
            "camera.param_value",
            "camera.params",
            "fx to be a positive finite number",
        ),
        (request(camera=CAMERA | {"width": 10**400}), "camera.size", "camera.width", None),
        (request(camera=CAMERA | {"width": "640"}), "request.invalid", "camera.width", None),
        (request(camera={"model": "PINHOLE"}), "request.missing_field", "camera.width", None),
        (request(camera="PINHOLE"), "camera.syntax", "camera", None),
        (request(camera="{"), "request.malformed", "camera", "JSON"),
        (request(camera=7), "request.invalid", "camera", None),
    ],
)
def test_a_wrong_request_is_refused_by_code_field_and_expectation(
    message: object, code: str, field: str | None, expected: str | None
) -> None:
    error = refusal(message)

    assert (error.code, error.field) == (code, field)
    assert expected is None or error.expected == expected


@pytest.mark.parametrize(
    "text",
    ["", "{", '{"map": }', "\ufeff\ufeff{}", '{"a": ' * 10_000, '{"map": "\\ud800"}', "NaN,"],
)
def test_malformed_json_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        LocalizeRequest.read_json(text)
    assert caught.value.code == "request.malformed"


def test_integers_with_thousands_of_digits_are_refused() -> None:
    text = '{"map": "room", "image": "", "options": {"seed": ' + "9" * 20_000 + "}}"

    with pytest.raises(InvalidInput):
        jobs.photo_job_of(LocalizeRequest.read_json(text))


def test_a_refusal_never_echoes_a_large_value() -> None:
    long = "x" * 1_000_000

    for message in (
        request(options={"top_k": long}),
        request(options={"top_k": [1] * 100_000}),
        request(**{long: 1}),
        request(camera=long),
        request(map=["a"] * 100_000),
    ):
        assert len(str(refusal(message))) < 2000


# Maps and priors

GRAVITY = {"direction": [0, 9.81, 0], "std_deg": 2, "world": [0, 0, -2]}
IDENTITY = {"rotation_wxyz": [1, 0, 0, 0], "translation": [0, 0, 0]}
COVARIANCE = np.diag([1e-4] * 3 + [1e-2] * 3).ravel().tolist()
PRIORS = {
    "position": {"position": [1, 2, 3], "radius": 5},
    "height": {"min": -1, "max": 1.5},
    "pose": {"device_from_world": IDENTITY, "covariance": COVARIANCE},
    "gravity": GRAVITY,
}


def test_priors_become_those_of_the_core() -> None:
    priors = jobs.photo_job_of(LocalizeRequest.read_json(json.dumps(request(priors=PRIORS)))).priors

    assert priors.position is not None
    assert priors.position.position.tolist() == [1, 2, 3]
    assert priors.position.radius == 5
    assert priors.height == HeightBand(-1, 1.5)
    assert priors.pose is not None
    np.testing.assert_array_equal(priors.pose.device_from_world.rotation, np.eye(3))
    np.testing.assert_array_equal(np.diag(priors.pose.covariance), [1e-4] * 3 + [1e-2] * 3)
    assert priors.gravity is not None
    assert priors.gravity.direction.tolist() == [0, 1, 0]
    assert priors.gravity.std == math.radians(2)
    assert priors.gravity.world is not None
    assert priors.gravity.world.tolist() == [0, 0, -1]


def test_priors_may_be_text_and_parts_of_them_left_out() -> None:
    text = json.dumps({"gravity": {"direction": [0, 1, 0]}})
    priors = jobs.photo_job_of(LocalizeRequest.read(request(priors=text))).priors

    assert priors.position is priors.height is priors.pose is None
    assert priors.gravity is not None
    assert (priors.gravity.std, priors.gravity.world) == (math.radians(1), None)
    assert jobs.photo_job_of(LocalizeRequest.read(request(priors=None))).priors is NO_PRIORS


@pytest.mark.parametrize("given", [["a", "b@1"], "a,b@1", " a , b@1", '["a", "b@1"]'])
def test_several_maps_may_be_a_list_or_text(given: object) -> None:
    message = {"maps": given, "image": request()["image"]}

    assert jobs.photo_job_of(LocalizeRequest.read(message)).maps == ("a", "b@1")


NAN = float("nan")


@pytest.mark.parametrize(
    ("fields", "code", "field"),
    [
        ({"maps": ["a"]}, "request.map", "map"),
        ({"map": None}, "request.map", "map"),
        ({"map": None, "maps": []}, "request.map", "map"),
        ({"map": None, "maps": [f"m{i}" for i in range(17)]}, "request.map", "maps"),
        ({"map": None, "maps": ["a", "a"]}, "request.map", "maps"),
        ({"map": None, "maps": ["a", 3]}, "request.invalid", "maps[1]"),
        ({"map": None, "maps": "[1"}, "request.malformed", "maps"),
        ({"map": None, "maps": 3}, "request.invalid", "maps"),
        ({"priors": 3}, "request.invalid", "priors"),
        ({"priors": "{"}, "request.malformed", "priors"),
        ({"priors": {"floor": 2}}, "request.unknown_field", "priors.floor"),
        *(
            ({"priors": {name: PRIORS[name] | change}}, code, f"priors.{field}")
            for name, change, code, field in [
                ("position", {"radius": 0}, "priors.position", "position.radius"),
                ("position", {"radius": NAN}, "priors.position", "position.radius"),
                ("position", {"position": [1, 2]}, "priors.position", "position.position"),
                ("position", {"position": [1, 2, NAN]}, "priors.position", "position.position"),
                ("position", {"position": ["1"]}, "request.invalid", "position.position[0]"),
                ("height", {"min": 2}, "priors.height", "height"),
                ("height", {"max": NAN}, "priors.height", "height"),
                ("gravity", {"direction": [0, 0, 0]}, "priors.gravity", "gravity.direction"),
                ("gravity", {"direction": [0, NAN, 0]}, "priors.gravity", "gravity.direction"),
                ("gravity", {"direction": [1]}, "priors.gravity", "gravity.direction"),
                ("gravity", {"std_deg": 16}, "priors.gravity", "gravity.std_deg"),
                ("gravity", {"std_deg": 0}, "priors.gravity", "gravity.std_deg"),
                ("gravity", {"world": [0, 0, 0]}, "priors.gravity", "gravity.world"),
                ("pose", {"covariance": [1]}, "pose.covariance", "pose.covariance"),
                ("pose", {"covariance": []}, "pose.covariance", "pose.covariance"),
                ("pose", {"covariance": [0.0] * 36}, "pose.covariance", "pose.covariance"),
                ("pose", {"covariance": [NAN] * 36}, "pose.covariance", "pose.covariance"),
                (
                    "pose",
                    {"device_from_world": IDENTITY | {"rotation_wxyz": [2, 0, 0, 0]}},
                    *("pose.rotation", "pose.device_from_world.rotation_wxyz"),
                ),
                (
                    "pose",
                    {"device_from_world": IDENTITY | {"translation": [0, NAN, 0]}},
                    *("pose.translation", "pose.device_from_world.translation"),
                ),
            ]
        ),
    ],
)
def test_wrong_maps_and_priors_are_refused(fields: dict[str, Any], code: str, field: str) -> None:
    error = refusal(request(**fields))

    assert (error.code, error.field) == (code, field)


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"map": "room", "camera": {"params": ["x"] * 200_000}}),
        json.dumps(
            {
                "map": "room",
                "features": {"global_descriptors": dict.fromkeys(map(str, range(99_999)), 0)},
            }
        ),
        '{"map": "room", "image": [' + "{}," * 3_000_000 + "{}]}",
    ],
)
def test_json_of_very_many_values_is_refused_before_it_is_parsed(text: str) -> None:
    with pytest.raises(TooLarge) as caught:
        LocalizeRequest.read_json(text)

    assert (caught.value.code, caught.value.expected) == ("request.too_large", "at most 11000")


@pytest.mark.parametrize("as_text", [str, str.encode])
@pytest.mark.parametrize("inside", ["1,", "[],", '{"a":0},', "[" * 100 + "]" * 100 + ","])
def test_values_are_counted_by_commas_and_brackets(as_text: Any, inside: str) -> None:
    text = '{"map": "room", "maps": [' + inside * 11_000 + "1]}"

    with pytest.raises(TooLarge) as caught:
        LocalizeRequest.read_json(as_text(text))

    counted = 3 + 11_000 * sum(map(inside.count, ",[{"))
    assert (caught.value.code, caught.value.got) == ("request.too_large", str(counted))


def test_too_many_global_descriptors_are_refused() -> None:
    array = {"dtype": "int8", "shape": [0], "data": ""}
    features = {"kind": "sift", "keypoints": array, "descriptors": array}
    many = features | {"global_descriptors": dict.fromkeys(map(str, range(33)), array)}

    error = refusal({"map": "room", "features": many})

    assert (error.code, error.got) == ("features.global_descriptors", "33")
    assert error.field == "features.global_descriptors"


# The proto's messages and ours are the same


# Of the stream there is no counterpart: over HTTP a sequence is one request.
STREAM = "LocalizeSequenceRequest"


def fields_of(message: Descriptor) -> list[str]:
    """The fields of a message as JSON has them."""
    fields = [field.name for field in message.fields]
    if message.name in ("LocalizeRequest", "LocalizeRigRequest", "SequenceStart"):
        fields.remove("request_id")  # over HTTP it is a header
    if "calibration" in fields:
        fields.remove("calibration")
        fields[fields.index("rig_id")] = "rig"
    if message.name == "RigImage":
        fields.extend(("part", "mask_part"))  # of a form
    return fields


def models() -> dict[str, type[BaseModel]]:
    """The models of the words, by name."""
    modules = [
        importlib.import_module(f"visloc_api.words.{module.name}")
        for module in pkgutil.iter_modules(visloc_api.words.__path__)
    ]
    return {
        name: value
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, BaseModel)
    }


def pairs() -> list[tuple[type[BaseModel], Descriptor]]:
    found = models()
    return [
        (found[name], message)
        for name, message in pb2.DESCRIPTOR.message_types_by_name.items()
        if name in found and name != STREAM
    ]


@pytest.mark.parametrize(
    ("model", "message"), pairs(), ids=lambda value: getattr(value, "__name__", "")
)
def test_json_has_the_fields_of_the_proto_in_the_same_order(
    model: type[BaseModel], message: Descriptor
) -> None:
    assert list(model.model_fields) == fields_of(message)


def test_all_messages_of_the_proto_have_a_model() -> None:
    without = {
        "ListMapsRequest",
        "GetMapRequest",
        "VersionRef",
        "PutVersionRequest",
        "DeleteVersionResponse",
        STREAM,
    }

    assert {message.name for _, message in pairs()} == (
        set(pb2.DESCRIPTOR.message_types_by_name) - without
    )


def test_every_number_of_an_answer_is_a_double_on_the_wire() -> None:
    for message in pb2.DESCRIPTOR.message_types_by_name.values():
        for field in message.fields:
            assert field.type != FieldDescriptor.TYPE_FLOAT, f"{message.name}.{field.name}"
