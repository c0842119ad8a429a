from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

from service.api import jobs
from service.api.answers import localize_response
from service.grpc.envelope import message_of
from service.values import Localization, MatchPicture
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.options import ReadAs
from visloc.types import CameraSource, Evidence, ImageAnswer, InstantAnswer, Reason, Refusal
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.answers import LocalizeResponse
from visloc_api.words.photo import LocalizeRequest

PHOTO = base64.b64encode(b"photo").decode()
ARRAY = {"dtype": "int8", "shape": [0, 2], "data": ""}
FEATURES = {"kind": "sift", "keypoints": ARRAY, "descriptors": ARRAY, "global_descriptors": {}}


def job(**fields: Any) -> Any:
    return jobs.photo_job_of(LocalizeRequest.read_json(json.dumps({"map": "room"} | fields)))


def answer(debug: MatchPicture | None) -> LocalizeResponse:
    camera = Camera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0))
    evidence = Evidence(camera, CameraSource.GIVEN, 1, ReadAs.STORED)
    image = ImageAnswer("camera", Pose.identity(), evidence, None)
    refusal = Refusal("gate", Reason.TOO_FEW_INLIERS, "no")
    refused = InstantAnswer(None, (image,), None, refusal, {})
    return localize_response(Localization(refused, "room", "v1", debug=debug), "id")


PICTURE = MatchPicture(
    keypoints=np.array([[1.5, 2.0], [3.0, 4.25]]),
    points=np.array([[1.0, 2.0, 3.0], [1e6, -5e6, 0.1]]),
    inliers=np.array([True, False]),
    overlay=bytes(range(256)),
)


@pytest.mark.parametrize(
    ("given", "debug"),
    [(True, True), ("true", True), (False, False), ("false", False), (None, False)],
)
def test_debug_is_asked_for_in_json_and_in_forms(given: object, debug: bool) -> None:
    assert job(image=PHOTO, debug=given).debug is debug


def test_debug_is_off_unless_asked_for() -> None:
    assert job(image=PHOTO).debug is False


@pytest.mark.parametrize("given", ["yes", "True", 1, [], ""])
def test_debug_is_true_or_false(given: object) -> None:
    with pytest.raises(InvalidInput) as caught:
        job(image=PHOTO, debug=given)

    assert (caught.value.code, caught.value.field) == ("request.invalid", "debug")


def test_features_cannot_be_drawn() -> None:
    with pytest.raises(InvalidInput) as caught:
        job(features=FEATURES, debug=True)

    assert (caught.value.code, caught.value.field) == ("debug.needs_photo", "debug")
    assert job(features=FEATURES, debug=False).debug is False


def test_both_doors_say_the_same_matches() -> None:
    response = answer(PICTURE)

    plain = json.loads(response.model_dump_json())["debug"]
    message = message_of(response, pb2.LocalizeResponse()).debug

    assert plain == {
        "keypoints": [1.5, 2.0, 3.0, 4.25],
        "points": [1.0, 2.0, 3.0, 1e6, -5e6, 0.1],
        "inliers": [True, False],
        "overlay": base64.b64encode(PICTURE.overlay).decode(),
    }
    assert list(message.keypoints) == plain["keypoints"]
    assert list(message.points) == plain["points"]
    assert list(message.inliers) == plain["inliers"]
    assert message.overlay == PICTURE.overlay


def test_an_answer_without_debug_has_none() -> None:
    response = answer(None)

    assert json.loads(response.model_dump_json())["debug"] is None
    assert not message_of(response, pb2.LocalizeResponse()).HasField("debug")
