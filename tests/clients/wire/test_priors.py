from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.cli.main import main
from clients.cli.options import priors_from_text
from visloc.errors import InvalidInput
from visloc.priors import NO_PRIORS, HeightBand, Priors
from visloc_api.words import priors as words


def priors_from_json(raw: object) -> Priors:
    return words.Priors.read(raw).to_core()


def priors_as_json(priors: Priors) -> dict[str, Any]:
    return words.Priors.from_core(priors).as_json()


COVARIANCE = np.diag([1e-4] * 3 + [1e-2] * 3).ravel().tolist()
ALL: dict[str, Any] = {
    "position": {"position": [1.0, -2.0, 3.5], "radius": 10.0},
    "height": {"min": -1.0, "max": 2.5},
    "pose": {
        "device_from_world": {
            "rotation_wxyz": [0.5, 0.5, -0.5, 0.5],
            "translation": [1.0, 2.0, 3.0],
        },
        "covariance": COVARIANCE,
    },
    "gravity": {"direction": [0.0, 1.0, 0.0], "std_deg": 2.0, "world": [0.0, 0.0, -1.0]},
    "gnss": {
        "latitude": 48.1,
        "longitude": -8.2,
        "accuracy": 4.5,
        "altitude": 412.0,
        "vertical_accuracy": 9.0,
    },
}


def test_priors_come_back_as_they_were_given() -> None:
    again = priors_as_json(priors_from_json(ALL))
    assert list(again) == list(ALL)
    assert again["position"] == ALL["position"]
    assert again["height"] == ALL["height"]
    pose, expected = again["pose"], ALL["pose"]
    assert pose["covariance"] == COVARIANCE
    for name, numbers in expected["device_from_world"].items():
        np.testing.assert_allclose(pose["device_from_world"][name], numbers, atol=1e-15)
    assert again["gravity"]["std_deg"] == pytest.approx(2.0)
    assert again["gravity"]["world"] == [0.0, 0.0, -1.0]
    assert again["gnss"] == ALL["gnss"]


def test_nothing_known_is_nothing_sent() -> None:
    assert priors_as_json(NO_PRIORS) == {}
    assert priors_as_json(priors_from_json(dict.fromkeys(ALL))) == {}


def test_the_spread_of_gravity_and_its_world_may_be_left_out() -> None:
    known = priors_as_json(priors_from_json({"gravity": {"direction": [0, 0, 3]}}))
    assert known["gravity"] == {"direction": [0.0, 0.0, 1.0], "std_deg": pytest.approx(1.0)}


def test_priors_are_json_or_a_file(tmp_path: Path) -> None:
    path = tmp_path / "floor.json"
    path.write_text(json.dumps({"height": ALL["height"]}))
    for text in (str(path), path.read_text()):
        assert priors_as_json(priors_from_text(text)) == {"height": ALL["height"]}


@pytest.mark.parametrize(
    ("raw", "code", "field"),
    [
        ([], "request.invalid", "priors"),
        ({"floor": 2}, "request.unknown_field", "priors.floor"),
        ({"height": 2}, "request.invalid", "priors.height"),
        ({"height": {"min": 0}}, "request.missing_field", "priors.height.max"),
        ({"height": {"min": 3, "max": 1}}, "priors.height", "priors.height"),
        ({"maps": []}, "priors.maps", "priors.maps"),
        ({"height": {"min": 0, "max": True}}, "request.invalid", "priors.height.max"),
        ({"height": {"min": 0, "max": 10**400}}, "request.invalid", "priors.height.max"),
        (
            {"gnss": {"latitude": 91, "longitude": 0, "accuracy": 1}},
            "priors.gnss",
            "priors.gnss.latitude",
        ),
        (
            {"gnss": {"latitude": 1, "longitude": 0, "accuracy": 0}},
            "priors.gnss",
            "priors.gnss.accuracy",
        ),
        (
            {"gnss": {"latitude": 1, "longitude": 0, "accuracy": 1, "altitude": 400}},
            "priors.gnss",
            "priors.gnss.vertical_accuracy",
        ),
        ({"height": {"min": 0, "maximum": 1}}, "request.unknown_field", "priors.height.maximum"),
        (
            {"position": {"position": [1, 2], "radius": 1}},
            "priors.position",
            "priors.position.position",
        ),
        (
            {"position": {"position": [1, 2, "3"], "radius": 1}},
            "request.invalid",
            "priors.position.position[2]",
        ),
        (
            {"position": {"position": [1, 2, 3], "radius": float("inf")}},
            "priors.position",
            "priors.position.radius",
        ),
        ({"gravity": {"direction": [0, 0, 0]}}, "priors.gravity", "priors.gravity.direction"),
        (
            {"gravity": {"direction": [0, 0, 1], "std_deg": 0}},
            "priors.gravity",
            "priors.gravity.std_deg",
        ),
        (
            {"pose": {"covariance": COVARIANCE}},
            "request.missing_field",
            "priors.pose.device_from_world",
        ),
        (
            {"pose": ALL["pose"] | {"covariance": [0.0] * 36}},
            "pose.covariance",
            "priors.pose.covariance",
        ),
        (
            {"pose": ALL["pose"] | {"covariance": [1.0] * 35}},
            "pose.covariance",
            "priors.pose.covariance",
        ),
        (
            {
                "pose": ALL["pose"]
                | {"device_from_world": {"rotation_wxyz": [2, 0, 0, 0], "translation": [0, 0, 0]}}
            },
            "pose.rotation",
            "priors.pose.device_from_world.rotation_wxyz",
        ),
    ],
)
def test_what_cannot_be_a_prior_is_named(raw: object, code: str, field: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        priors_from_json(raw)
    assert caught.value.code == code
    assert caught.value.field == field


def test_heights_along_another_down_are_not_sent_as_if_they_were_not() -> None:
    with pytest.raises(InvalidInput) as caught:
        priors_as_json(Priors(height=HeightBand(0.0, 3.0, (0.0, 1.0, 0.0))))
    assert caught.value.code == "priors.height"


@pytest.mark.parametrize("text", ["{", "none.json", "", "\x00"])
def test_text_that_is_neither_json_nor_a_file_is_told(text: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        priors_from_text(text)
    assert caught.value.code == "priors.unreadable"


def test_localize_image_sends_priors(
    url: str, tmp_path: Path, service: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(b"photo")
    command = ["image", str(photo), "--map", "room", "--server", url, "--priors"]
    with pytest.raises(SystemExit) as caught:
        main([*command, json.dumps({"height": ALL["height"]})])
    assert caught.value.code == 0
    assert service.seen[0]["priors"] == {"height": ALL["height"]}
    with pytest.raises(SystemExit) as caught:
        main([*command, "{}}"])
    assert caught.value.code == 1
    assert "error [priors.unreadable]" in capsys.readouterr().err
