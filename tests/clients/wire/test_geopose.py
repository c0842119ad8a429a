from __future__ import annotations

import base64
from typing import Any

import pytest

from clients import GeoPose, GeoPoseYpr, Near
from clients.transport.messages import localize_message, plain, start_message
from clients.wire.requests import checked_search, photo_request, rig_request, sequence_start
from visloc.errors import InvalidInput

POSITION = {"lat": 48.25, "lon": -122.1, "h": 90.5}
PLACE = Near(48.25, -122, 150)


def test_a_place_is_sent_instead_of_maps_and_angles_are_asked_for() -> None:
    search = checked_search(PLACE, None, None, None, ypr=True)
    said = {"near": {"latitude": 48.25, "longitude": -122.0, "radius": 150.0}, "ypr": True}
    photo = photo_request(search, b"photo", None)
    assert photo.words.as_json() == said | {"image": base64.b64encode(b"photo").decode()}
    messages: list[Any] = [
        localize_message(photo),
        localize_message(rig_request(search, "rig", ())),
        start_message(sequence_start(search, None, None, None)).start,
    ]
    for message in messages:
        sent = plain(message)
        assert {name: sent[name] for name in said} == said
        assert (sent["map"], sent["maps"]) == ("", [])


def test_without_them_nothing_is_said_of_either() -> None:
    search = checked_search("room", None, None, None)
    photo = photo_request(search, b"photo", None)
    assert photo.words.given() == {"map": "room", "image": b"photo"}
    sent = plain(localize_message(photo))
    assert (sent["near"], sent["ypr"]) == (None, None)


def test_a_place_is_made_of_numbers() -> None:
    with pytest.raises(InvalidInput) as caught:
        Near(48.0, float("nan"), 10.0)
    assert caught.value.code == "near.longitude"


def test_geoposes_keep_every_digit() -> None:
    quaternion = {"x": 0.1, "y": -1 / 3, "z": 0.2, "w": 0.9}
    found = GeoPose.model_validate({"position": POSITION, "quaternion": quaternion})
    assert (found.latitude, found.longitude, found.height) == (48.25, -122.1, 90.5)
    assert found.quaternion_xyzw == (0.1, -1 / 3, 0.2, 0.9)
    place = {"latitude": 48.25, "longitude": -122.1, "height": 90.5}
    assert found == GeoPose(**place, quaternion_xyzw=found.quaternion_xyzw)
    angles = {"yaw": 30.0, "pitch": -1.5, "roll": 180.0}
    turned = GeoPoseYpr.model_validate({"position": POSITION, "angles": angles})
    assert turned == GeoPoseYpr(**place, yaw_deg=30.0, pitch_deg=-1.5, roll_deg=180.0)
    assert (turned.yaw_deg, turned.pitch_deg, turned.roll_deg) == (30.0, -1.5, 180.0)
