"""Features sent instead of a photo, over both doors."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict, ParseDict
from google.rpc.error_details_pb2 import ErrorInfo
from grpc_status import rpc_status
from numpy.typing import NDArray

from service.api import jobs
from service.http.openapi import example
from visloc.archive import Map, MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.features.local.readymade import MAX_READY_MADE_KEYPOINTS
from visloc.geometry import Camera, Pose, rotation_angle
from visloc.photos.reading import read_photo
from visloc.types import QueryFeatures
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.features import Array
from visloc_api.words.photo import LocalizeRequest

# Times of each stage and the request's own id differ from answer to answer.
NOT_COMPARED = ("seconds", "request_id")


def array(values: NDArray[Any], dtype: str = "float32") -> dict[str, Any]:
    data = np.asarray(values, np.dtype(dtype).newbyteorder("<")).tobytes()
    return {"dtype": dtype, "shape": list(values.shape), "data": base64.b64encode(data).decode()}


@pytest.fixture(scope="module")
def opened(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


@pytest.fixture(scope="module")
def features(query: Any, opened: Map) -> dict[str, Any]:
    """What a robot with our extractors sends, as JSON."""
    rgb = read_photo(query.image).rgb
    local = make_local_features("sift").extract(rgb, max_keypoints=300)  # within the limit of doors
    densevlad = make_global_descriptor("densevlad")
    vector = densevlad.describe(rgb, local, opened.global_models["densevlad"])
    return {
        "kind": "sift",
        "keypoints": array(local.keypoints),
        "descriptors": array(local.descriptors),
        "global_descriptors": {"densevlad": array(vector)},
    }


def camera_of(query: Any) -> dict[str, Any]:
    camera: Camera = query.camera
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def body(query: Any, features: object, **fields: object) -> dict[str, Any]:
    return {"map": "room", "features": features, "camera": camera_of(query), **fields}


def as_form(doors: Any, message: dict[str, Any]) -> httpx.Response:
    """Send a request as curl -F features=@features.json does."""
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in message.items()
        if name != "features"
    }
    file = ("features.json", json.dumps(message["features"]), "application/json")
    response: httpx.Response = doors.http.post("/localize", data=texts, files={"features": file})
    return response


def wire_array(given: dict[str, Any]) -> pb2.Array:
    return pb2.Array(
        dtype=given["dtype"], shape=given["shape"], data=base64.b64decode(given["data"])
    )


def as_message(message: dict[str, Any]) -> pb2.LocalizeRequest:
    given = message["features"]
    return pb2.LocalizeRequest(
        map=message["map"],
        features=pb2.Features(
            kind=given["kind"],
            keypoints=wire_array(given["keypoints"]),
            descriptors=wire_array(given["descriptors"]),
            global_descriptors={n: wire_array(a) for n, a in given["global_descriptors"].items()},
        ),
        camera=message.get("camera"),
        options=message.get("options"),
    )


def answer_of(response: httpx.Response) -> dict[str, Any]:
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return {name: value for name, value in answer.items() if name not in NOT_COMPARED}


def bits(value: object) -> object:
    """Floats by their bits, so that equal means equal; what gRPC leaves out is left out."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        return {name: bits(inner) for name, inner in value.items() if inner is not None}
    return [bits(inner) for inner in value] if isinstance(value, list) else value


def test_features_are_localized_where_the_photo_was_taken(
    doors: Any, query: Any, features: dict[str, Any]
) -> None:
    answer = answer_of(doors.http.post("/localize", json=body(query, features)))

    assert (answer["status"], answer["refusal"]) == ("localized", None)
    found = Pose.from_quaternion(*answer["pose"]["cam_from_world"].values())
    truth = query.cam_from_world
    assert np.linalg.norm(found.center - truth.center) < 0.005
    assert rotation_angle(found.rotation @ truth.rotation.T) < np.radians(0.2)
    assert answer["camera"] == camera_of(query) | {"source": "given"}
    assert answer["orientation"] == {"exif": 1, "read_as": "stored", "turned": 0}
    assert answer["retrieved"][0]["similarities"].keys() == {"densevlad", "localvlad"}


def test_form_json_and_grpc_give_the_same_answer_bit_for_bit(
    doors: Any, query: Any, features: dict[str, Any]
) -> None:
    message = body(query, features, options={"top_k": 4, "seed": 5})
    over_json = answer_of(doors.http.post("/localize", json=message))
    over_form = answer_of(as_form(doors, message))
    over_grpc = MessageToDict(
        doors.stub.Localize(as_message(message)),
        preserving_proto_field_name=True,
        always_print_fields_with_no_presence=True,
    )

    assert over_json["status"] == "localized"
    assert bits(over_form) == bits(over_json)
    del over_grpc["seconds"], over_grpc["request_id"]
    assert bits(over_grpc) == bits(over_json)


@pytest.mark.parametrize("dtype", ["float16", "uint8"])
def test_arrays_of_fewer_bits_are_localized(
    dtype: str, doors: Any, query: Any, features: dict[str, Any]
) -> None:
    given = features["descriptors"]
    rows = np.frombuffer(base64.b64decode(given["data"]), "<f4").reshape(given["shape"])
    small = features | {"descriptors": array(rows * (200 / rows.max()), dtype)}

    answer = answer_of(doors.http.post("/localize", json=body(query, small)))

    assert answer["status"] == "localized"


def test_no_keypoints_are_an_answer(doors: Any, query: Any, features: dict[str, Any]) -> None:
    none = features | {
        "keypoints": array(np.zeros((0, 2))),
        "descriptors": array(np.zeros((0, 128))),
    }

    answer = answer_of(doors.http.post("/localize", json=body(query, none)))

    assert answer["refusal"]["reason"] == "no_keypoints"


# Bad input

HUGE = 10**9


def with_array(part: str, **changes: object) -> Any:
    return lambda f: f | {part: f[part] | changes}


def with_global(**changes: object) -> Any:
    return lambda f: (
        f | {"global_descriptors": {"densevlad": f["global_descriptors"]["densevlad"] | changes}}
    )


HOSTILE = [
    (with_array("keypoints", dtype="float64"), "features.dtype", "features.keypoints.dtype"),
    (with_array("keypoints", dtype="<f4"), "features.dtype", "features.keypoints.dtype"),
    (with_array("descriptors", dtype="object"), "features.dtype", "features.descriptors.dtype"),
    (with_array("descriptors", dtype=""), "features.dtype", "features.descriptors.dtype"),
    (with_array("keypoints", shape=[]), "features.shape", "features.keypoints.shape"),
    (with_array("keypoints", shape=[4]), "features.shape", "features.keypoints.shape"),
    (with_array("keypoints", shape=[2**31, 2]), "features.shape", "features.keypoints.shape"),
    (with_array("keypoints", shape=[0, 2**32 - 1]), "features.shape", "features.keypoints.shape"),
    (with_array("keypoints", shape=[1] * 99), "features.shape", "features.keypoints.shape"),
    (with_array("keypoints", shape=[HUGE, 2]), "features.data", "features.keypoints.data"),
    (with_array("descriptors", shape=[HUGE, HUGE]), "features.data", "features.descriptors.data"),
    # 2**31 x 2**31 x 4 bytes are 0 in 64 bits.
    (with_array("keypoints", shape=[2**31 - 1] * 2), "features.data", "features.keypoints.data"),
    (with_array("keypoints", data=""), "features.data", "features.keypoints.data"),
    (with_array("descriptors", data="AAAA"), "features.data", "features.descriptors.data"),
    (
        with_global(shape=[HUGE]),
        *("features.data", "features.global_descriptors.densevlad.data"),
    ),
    (
        with_global(shape=[1, 2]),
        *("features.shape", "features.global_descriptors.densevlad.shape"),
    ),
    (lambda f: f | {"kind": "xfeat"}, "features.kind", "features.kind"),
    (lambda f: f | {"kind": ""}, "features.kind", "features.kind"),
    (
        lambda f: f | {"global_descriptors": {}},
        *("features.global_descriptors", "features.global_descriptors"),
    ),
    (
        lambda f: f | {"keypoints": array(np.full((3, 2), np.nan))},
        *("features.descriptors", "features.descriptors"),  # there are more of them
    ),
    (
        lambda f: (
            f
            | {
                "keypoints": array(np.zeros((5001, 2)), "uint8"),
                "descriptors": array(np.zeros((0, 128))),
            }
        ),
        *("features.too_many", "features.keypoints"),
    ),
]


def refusal_over_grpc(doors: Any, message: dict[str, Any]) -> ErrorInfo:
    return reason_of(lambda: doors.stub.Localize(as_message(message)))


def reason_of(ask: Callable[[], object]) -> ErrorInfo:
    with pytest.raises(grpc.RpcError) as caught:
        ask()
    call: Any = caught.value
    details = rpc_status.from_call(call)
    info = ErrorInfo()
    assert details is not None
    assert details.details[0].Unpack(info)
    return info


@pytest.mark.parametrize(("change", "code", "field"), HOSTILE)
def test_hostile_arrays_are_refused_alike_at_both_doors(
    change: Any, code: str, field: str, doors: Any, query: Any, features: dict[str, Any]
) -> None:
    message = body(query, change(features))
    over_http = doors.http.post("/localize", json=message).json()
    info = refusal_over_grpc(doors, message)

    assert (over_http["code"], over_http["field"]) == (code, field), over_http
    assert (info.reason, info.metadata["field"]) == (code, field)
    assert info.metadata["expected"] == over_http["expected"]
    assert over_http["status"] == (413 if code == "features.too_many" else 422)


def zeros(num: int, kind: str) -> dict[str, Any]:
    """Keypoints without descriptors: their number is looked at first."""
    return {
        "kind": kind,
        "keypoints": array(np.zeros((num, 2)), "uint8"),
        "descriptors": array(np.zeros((0, 128))),
        "global_descriptors": {},
    }


def test_as_many_keypoints_may_be_sent_as_the_map_keeps(
    doors: Any, query: Any, opened: Map
) -> None:
    most = opened.manifest.local_features.max_keypoints
    at_most = doors.http.post("/localize", json=body(query, zeros(most, "sift"))).json()
    more = body(query, zeros(most + 1, "sift"))
    over_http = doors.http.post("/localize", json=more).json()
    info = refusal_over_grpc(doors, more)

    assert at_most["code"] == "features.descriptors"  # the next thing that is wrong
    expected = ("features.too_many", f"at most {most}", str(most + 1))
    assert (over_http["code"], over_http["expected"], over_http["got"]) == expected
    assert (info.reason, info.metadata["expected"], info.metadata["got"]) == expected


@pytest.mark.parametrize(
    ("change", "code", "field"),
    [
        (with_array("keypoints", shape=[-1, 2]), "features.shape", "features.keypoints.shape"),
        (with_array("keypoints", shape=[-1, -2]), "features.shape", "features.keypoints.shape"),
        (
            with_array("keypoints", shape=[10**300, 2]),
            *("features.shape", "features.keypoints.shape"),
        ),
        (with_array("keypoints", shape=[1.5, 2]), "request.invalid", "features.keypoints.shape[0]"),
        (with_array("keypoints", shape="1,2"), "request.invalid", "features.keypoints.shape"),
        (with_array("keypoints", data="*"), "request.invalid", "features.keypoints.data"),
        (with_array("keypoints", data=None), "request.invalid", "features.keypoints.data"),
        (with_array("keypoints", order="F"), "request.unknown_field", "features.keypoints.order"),
        (lambda f: f | {"scores": []}, "request.unknown_field", "features.scores"),
        (
            with_global(order="F"),
            *("request.unknown_field", "features.global_descriptors.densevlad.order"),
        ),
        (
            lambda f: f | {"global_descriptors": {"g" * 5000: {"o" * 5000: 1}}},
            *("request.unknown_field", f"features.global_descriptors.{'g' * 100}.{'o' * 100}"),
        ),
        (lambda f: f | {"keypoints": [[1, 2]]}, "request.invalid", "features.keypoints"),
        (
            lambda f: {n: f[n] for n in f if n != "descriptors"},
            *("request.missing_field", "features.descriptors"),
        ),
        (lambda f: f | {"global_descriptors": []}, "request.invalid", None),
        (lambda _: [], "request.invalid", "features"),
    ],
)
def test_json_that_no_array_can_be_made_of_is_refused(
    change: Any, code: str, field: str | None, doors: Any, query: Any, features: dict[str, Any]
) -> None:
    message = body(query, change(features))
    for response in (doors.http.post("/localize", json=message), as_form(doors, message)):
        problem = response.json()
        assert (response.status_code, problem["code"]) == (422, code), problem
        assert field is None or problem["field"] == field
        assert len(response.content) < 2000


def test_what_is_not_json_is_refused(doors: Any) -> None:
    files = {"features": ("f.json", b"\x93NUMPY\x01\x00")}
    problem = doors.http.post("/localize", data={"map": "room"}, files=files).json()
    assert (problem["code"], problem["field"]) == ("request.malformed", "features")


def test_features_in_a_form_need_no_file_name(doors: Any) -> None:
    parts = {"map": (None, "room"), "features": (None, "{}")}
    problem = doors.http.post("/localize", files=parts).json()
    assert (problem["code"], problem["field"]) == ("request.missing_field", "features.kind")


def test_a_request_has_a_photo_or_features(
    doors: Any, query: Any, features: dict[str, Any]
) -> None:
    image = base64.b64encode(query.image).decode()
    both = doors.http.post("/localize", json=body(query, features, image=image)).json()
    neither = doors.http.post("/localize", json=body(query, None)).json()
    with pytest.raises(grpc.RpcError) as caught:
        doors.stub.Localize(pb2.LocalizeRequest(map="room"))

    assert (both["code"], both["got"]) == ("request.query", "both")
    assert (neither["code"], neither["got"]) == ("request.query", "neither")
    call: Any = caught.value
    assert "one of image, features" in call.details()


def test_features_need_a_camera(doors: Any, query: Any, features: dict[str, Any]) -> None:
    problem = doors.http.post("/localize", json=body(query, features, camera=None)).json()
    assert (problem["code"], problem["field"]) == ("camera.required", "camera")


def test_an_array_is_read_without_a_copy_of_its_bytes() -> None:
    data = np.arange(6, dtype="<f2").tobytes()
    core = Array(dtype="float16", shape=[3, 2], data=data).to_core("x", 2)
    np.testing.assert_array_equal(core, [[0, 1], [2, 3], [4, 5]])
    assert core.base is not None


def test_features_become_the_job_that_they_say() -> None:
    job = jobs.photo_job_of(LocalizeRequest.read_json(json.dumps(example("features_request"))))
    query = job.images[0].query
    assert isinstance(query, QueryFeatures)
    assert query.kind == "xfeat"
    np.testing.assert_array_equal(query.keypoints, [[12.5, 25.0], [32.0, 18.0]])
    assert query.descriptors.shape == (2, 64)
    assert query.descriptors.dtype == np.int8


# Maps of ready-made features


@pytest.fixture
def ready_made_maps(maps_dir: Path) -> Path:
    """The map ``room``, as if its SIFT and DenseVLAD had come from elsewhere."""
    folder = MapStore(maps_dir).folder("room")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["local_features"]["fingerprint"]["name"] = "kapture:SIFT"
    manifest["global_features"][0]["fingerprint"]["name"] = "kapture:Dense"
    with (folder / "global" / "densevlad.model.npz").open("wb") as file:
        np.savez(file)
    for end in (".npy", ".scales.npy", ".model.npz"):
        path = folder / "global" / f"kapture-Dense{end}"
        (folder / "global" / f"densevlad{end}").rename(path)
        entry = manifest["files"].pop(f"global/densevlad{end}")
        manifest["files"][f"global/{path.name}"] = entry | {"size": path.stat().st_size}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return maps_dir


def test_a_map_of_ready_made_features_is_served_without_an_extractor(
    serve: Any, ready_made_maps: Path, query: Any, features: dict[str, Any]
) -> None:
    brought = features | {
        "kind": "kapture:SIFT",
        "global_descriptors": {"kapture:Dense": features["global_descriptors"]["densevlad"]},
    }
    with serve(ready_made_maps) as doors:
        ready = doors.http.get("/readyz").json()
        described = doors.http.get("/maps/room").json()
        answer = answer_of(doors.http.post("/localize", json=body(query, brought)))
        photo = doors.http.post("/localize", data={"map": "room"}, files={"image": query.image})
        other = doors.http.post("/localize", json=body(query, features)).json()
        at_most, more = (
            doors.http.post("/localize", json=body(query, zeros(num, "kapture:SIFT"))).json()
            for num in (MAX_READY_MADE_KEYPOINTS, MAX_READY_MADE_KEYPOINTS + 1)
        )

    assert ready["ready"]
    assert ready["not_loaded"] == []
    assert described["local_features"] == "kapture:SIFT"
    assert described["global_features"] == ["kapture:Dense", "localvlad"]
    assert answer["status"] == "localized"
    assert photo.status_code == 422
    assert photo.json()["code"] == "features.required"
    assert photo.json()["expected"] == (
        "features of kind kapture:SIFT, with kapture:Dense, localvlad"
    )
    assert (other["code"], other["expected"]) == ("features.kind", "kapture:SIFT")
    assert at_most["code"] == "features.descriptors"
    assert (more["code"], more["expected"]) == ("features.too_many", "at most 20000")


def test_instants_before_one_that_is_refused_are_answered_first(
    serve: Any, ready_made_maps: Path, query: Any, features: dict[str, Any]
) -> None:
    brought = features | {
        "kind": "kapture:SIFT",
        "global_descriptors": {"kapture:Dense": features["global_descriptors"]["densevlad"]},
    }
    image = {"sensor": "left", "camera": camera_of(query)}
    photo = base64.b64encode(query.image).decode()
    # The third is what the map does not take at all: it is found when the image's turn comes, and
    # concerns all images.
    images = [
        image | {"features": brought},
        image | {"features": brought | {"kind": "other"}},
        image | {"image": photo},
    ]
    instants = [
        {"timestamp": 1_700_000_000_000 + 100 * n, "images": [given]}
        for n, given in enumerate(images)
    ]
    message = {"map": "room", "instants": instants}

    def stream() -> Iterator[pb2.LocalizeSequenceRequest]:
        yield pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(map="room"))
        for instant in instants:
            parsed = ParseDict(instant, pb2.Instant())
            yield pb2.LocalizeSequenceRequest(instant=parsed)

    with serve(ready_made_maps) as doors:
        lines = doors.http.post(
            "/localize/sequence", json=message, headers={"Accept": "application/x-ndjson"}
        )
        whole = doors.http.post("/localize/sequence", json=message)
        call = doors.stub.LocalizeSequence(stream())
        over_grpc = [next(call) for _ in range(2)]
        info = reason_of(lambda: list(call))
    *answers, last = [json.loads(line) for line in lines.text.splitlines()]

    assert lines.status_code == 200
    # The second no longer waits for a third beside it.
    assert [answer["source"] for answer in answers] == ["estimated", "nearest"]
    assert [answer.source for answer in over_grpc] == ["estimated", "nearest"]
    problem = last["problem"]
    assert (problem["status"], problem["code"]) == (422, "features.required")
    assert (info.reason, info.metadata["message"]) == (problem["code"], problem["detail"])
    assert (whole.status_code, whole.json()["code"]) == (422, "features.required")
