from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from clients.wire.answers import parse_answer, parse_instant, parse_map, parse_result
from service.http.openapi import example
from visloc.errors import Unavailable
from visloc_api.words.answers import InstantAnswer, LocalizeResponse
from visloc_api.words.maps import MapInfo
from visloc_api.words.poses import PoseEstimate

PARSERS = {
    "localized": parse_result,
    "not_localized": parse_result,
    "rig": parse_instant,
    "map": parse_map,
    "set": parse_map,
}
MODELS = {"localized": LocalizeResponse, "rig": InstantAnswer, "map": MapInfo, "set": MapInfo}
WRONG = (None, "x", math.nan, math.inf, -1, 10**400, [], {}, ["x"], [math.nan] * 36)


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The places of all values in an answer, of lists the first element."""
    if place:
        yield place
    if isinstance(value, dict):
        for name in value:
            yield from places(value[name], (*place, name))
    if isinstance(value, list) and value:
        yield from places(value[0], (*place, 0))


@pytest.mark.parametrize("name", PARSERS)
def test_no_answer_breaks_a_client(name: str) -> None:
    answer = example(name)
    for place in places(answer):
        for wrong in WRONG:
            broken = copy.deepcopy(answer)
            part = broken
            for step in place[:-1]:
                part = part[step]
            part[place[-1]] = wrong
            with suppress(Unavailable):
                parse_answer("server", PARSERS[name], broken)


@pytest.mark.parametrize("name", MODELS)
def test_what_is_received_is_what_would_be_sent(name: str) -> None:
    answer = example(name)
    received = MODELS[name].model_validate(answer)
    assert json.loads(received.model_dump_json()) == answer


@pytest.mark.parametrize("name", PARSERS)
def test_an_answer_of_a_newer_server_is_understood(name: str) -> None:
    answer = example(name) | {"news": 1}
    for part in (answer.get("pose"), answer.get("refusal"), answer.get("camera")):
        if part is not None:
            part["news"] = 1
    parse_answer("server", PARSERS[name], answer)


def test_words_of_a_newer_server_are_texts() -> None:
    answer = example("not_localized")
    answer["refusal"]["reason"], answer["camera"]["source"] = "too_dark", "guessed_better"
    result = parse_result(answer)
    assert result.refusal is not None
    assert (result.refusal.reason, result.camera.source) == ("too_dark", "guessed_better")


def test_a_pose_may_be_made_of_its_numbers() -> None:
    numbers = {"rotation_wxyz": (0.6, -0.8, 0.0, 0.0), "translation": (1.0, -0.0, 3.0)}
    pose = PoseEstimate(
        cam_from_world=None,  # type: ignore[arg-type]
        position=np.zeros(3),
        orientation=np.zeros(4),
        covariance=np.eye(6),
        position_std=np.ones(3),
        orientation_std_deg=np.ones(3),
        **numbers,  # type: ignore[arg-type]
    )
    assert (pose.rotation_wxyz, pose.translation) == tuple(numbers.values())
    assert repr(pose.translation[1]) == "-0.0"
    np.testing.assert_allclose(pose.cam_from_world.translation, numbers["translation"])
