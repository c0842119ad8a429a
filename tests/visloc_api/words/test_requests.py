"""What the clients write is what the service reads."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients import Features, Instant, Near, Odometry, RigImage, RigSensor
from clients.transport.messages import instant_message, localize_message, start_message
from clients.wire.requests import (
    checked_search,
    instant_words,
    photo_request,
    rig_request,
    sequence_start,
)
from service.api import jobs
from service.grpc import messages
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.options import LocalizeOptions as CoreOptions
from visloc.priors import GnssPrior, GravityPrior, HeightBand, PosePrior, PositionPrior, Priors
from visloc.sequences.filling import TimeUnit
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.json_text import check_names_once
from visloc_api.words.message import IncomingMessage
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import BatchLimits, LocalizeRigRequest
from visloc_api.words.sequences import LocalizeSequenceRequest

ROOT = Path(__file__).parents[3]
CAMERA = Camera("PINHOLE", 640, 480, (525.5, 525.0, 320.0, 240.0))
POSE = Pose.from_quaternion([0.5, 0.5, -0.5, 0.5], [1.0, -2.0, 1 / 3])
COVARIANCE = np.diag([1e-4] * 3 + [0.1 + 0.2] * 3)
PRIORS = Priors(
    position=PositionPrior(np.array([1.0, 2.0, 0.1]), 5.0),
    height=HeightBand(-1.0, 2.5),
    pose=PosePrior(POSE, COVARIANCE),
    gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), math.radians(2.0), np.array([0.0, 0.0, -1.0])),
    gnss=GnssPrior(48.1, -8.2, 4.5, 412.0, 9.0),
    maps=("hall", "attic@2"),
)
RNG = np.random.default_rng(0)
FEATURES = Features(
    "xfeat",
    RNG.uniform(0, 480, (3, 2)).astype(np.float32),
    RNG.integers(0, 255, (3, 4), dtype=np.uint8),
    {"densevlad": RNG.normal(size=5).astype(np.float16)},
)
RIG = {"left": RigSensor(POSE, CAMERA), "right": RigSensor(Pose.identity())}
IMAGES = [RigImage("left", b"\xff\x00photo", None, 7), RigImage("right", FEATURES, CAMERA)]
LIMITS = BatchLimits(max_images=2, max_instants=2)
OPTIONS = {"top_k": 5, "max_error_px": 8, "fusion_weights": {"densevlad": 0.5}}


def plain(value: Any) -> Any:
    """Values of the core as what ``==`` compares; a quaternion rounds a rotation."""
    if isinstance(value, Pose):
        return plain(np.concatenate([value.rotation.ravel(), value.translation]).round(12))
    if isinstance(value, np.ndarray):
        return (value.dtype.name, value.shape, (value + 0).tolist())
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return [plain(each) for each in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


def over_json(words: IncomingMessage, model: type[Any]) -> Any:
    return model.read_json(json.dumps(words.as_json()), LIMITS)


def test_a_photo_arrives_as_it_was_sent() -> None:
    search = checked_search(["hall", "room@2"], OPTIONS, PRIORS, "my-id", ypr=True)
    sent = photo_request(search, b"\xff\x00photo", CAMERA, debug=True)
    job = jobs.photo_job_of(over_json(sent.words, LocalizeRequest))
    assert job.maps == ("hall", "room@2")
    assert (job.images[0].query, job.images[0].camera) == (b"\xff\x00photo", CAMERA)
    assert job.options == CoreOptions(top_k=5, max_error_px=8.0, fusion_weights={"densevlad": 0.5})
    assert plain(job.priors) == plain(PRIORS)
    assert (job.ypr, job.debug) == (True, True)
    assert plain(messages.localize_job_of(localize_message(sent), 10**6)) == plain(job)


def test_features_arrive_as_they_were_sent() -> None:
    sent = photo_request(
        checked_search(Near(48.25, -122.1, 10.0), None, None, None), FEATURES, CAMERA
    )
    job = jobs.photo_job_of(over_json(sent.words, LocalizeRequest))
    assert job.maps == Near(48.25, -122.1, 10.0)
    assert plain(job.images[0].query) == plain(FEATURES)
    assert plain(messages.localize_job_of(localize_message(sent), 10**6)) == plain(job)


@pytest.mark.parametrize("rig", [RIG, "stereo"])
def test_a_rig_arrives_as_it_was_sent(rig: Any) -> None:
    sent = rig_request(checked_search("room", None, PRIORS, None), rig, IMAGES)
    job = jobs.rig_job_of(over_json(sent.words, LocalizeRigRequest))
    assert plain(job.rig) == plain(rig)
    assert [image.sensor for image in job.images] == ["left", "right"]
    assert [image.camera for image in job.images] == [None, CAMERA]
    assert plain(job.images[1].query) == plain(FEATURES)
    assert job.timestamp == 7
    assert plain(messages.rig_job_of(localize_message(sent), LIMITS)) == plain(job)


def test_a_sequence_arrives_as_it_was_sent() -> None:
    start = sequence_start(checked_search("room", OPTIONS, PRIORS, None), RIG, "ms", 0)
    instants = [
        Instant(7, tuple(IMAGES), Odometry(POSE, COVARIANCE), Priors()),
        Instant(2**53 + 1, (), Odometry(Pose.identity())),
    ]
    words = [instant_words(instant, number) for number, instant in enumerate(instants)]
    body = start.words.as_json() | {"instants": [each.as_json() for each in words]}
    sequence, read = jobs.sequence_jobs_of(
        LocalizeSequenceRequest.read_json(json.dumps(body), LIMITS)
    )
    assert (sequence.time_unit, sequence.max_gap_s) == (TimeUnit.MS, 0.0)
    assert plain(sequence.rig) == plain(RIG)
    assert [instant.timestamp for instant in read] == [7, 2**53 + 1]
    assert plain([instant.odometry for instant in read]) == plain([i.odometry for i in instants])
    assert plain(read[0].priors) == plain(Priors())  # replaces that of the sequence
    assert read[1].priors is None
    assert plain(messages.sequence_start_of(start_message(start))) == plain(sequence)
    for number, (said, job) in enumerate(zip(words, read, strict=True)):
        message = instant_message(said)
        assert plain(messages.instant_of(message, LIMITS, number, has_rig=True)) == plain(job)


@pytest.mark.parametrize(
    ("given", "code", "field"),
    [
        ({"top_k": "5"}, "request.invalid", "options.top_k"),
        ({"topk": 5}, "request.unknown_field", "options.topk"),
        ({"fusion_weights": {"x" * 101: 1.0}}, "options.fusion_weights", "options.fusion_weights"),
    ],
)
def test_a_message_made_in_python_is_refused_as_if_it_were_read(
    given: dict[str, Any], code: str, field: str
) -> None:
    with pytest.raises(InvalidInput) as made:
        LocalizeOptions(**given)
    with pytest.raises(InvalidInput) as read:
        LocalizeOptions.read(given)
    for caught in (made, read):
        assert (caught.value.code, caught.value.field) == (code, field)


def test_a_part_made_in_python_is_refused_with_its_place_in_the_whole() -> None:
    raw = {"map": "room", "rig": "r", "images": [{"sensor": "a"}, {"camera": {"width": "x"}}]}
    with pytest.raises(InvalidInput) as caught:
        LocalizeRigRequest(**raw)  # type: ignore[arg-type]
    assert caught.value.field == "images[1].camera.model"


def test_a_name_is_found_twice_without_comparing_all_with_all() -> None:
    """A request may have 100 000 names."""
    compared = 0

    class Name(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return str.__eq__(self, other)

    fields: list[tuple[str, object]] = [(Name(f"n{i}"), i) for i in range(300)]
    check_names_once(fields)
    with pytest.raises(InvalidInput) as caught:
        check_names_once([*fields, (Name("n299"), 0)])
    assert (caught.value.code, caught.value.field) == ("request.duplicate_field", "n299")
    assert compared <= 2 * len(fields)


@pytest.mark.parametrize(
    ("package", "own"), [("clients", {"Features", "Instant", "RigImage"}), ("service", set())]
)
def test_what_a_message_holds_is_told_in_the_words_only(package: str, own: set[str]) -> None:
    classes = {
        node.name
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    }
    assert classes & set(pb2.DESCRIPTOR.message_types_by_name) == own
