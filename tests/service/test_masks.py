"""A mask beside a photo: over HTTP, gRPC, in rigs and with the clients."""

from __future__ import annotations

import base64
import io
import json
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clients import Client, MaskedImage, RigImage
from visloc.errors import InvalidInput
from visloc.geometry import Pose
from visloc.photos.reading import read_photo
from visloc.types import RigSensor
from visloc_api.v1 import localization_pb2 as pb2


def png(mask: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray((mask * 255).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


@pytest.fixture
def right_half(query: Any) -> bytes:
    """A mask, half as large as the photo, in which only the right half counts."""
    photo = read_photo(query.image)
    mask = np.zeros((photo.height // 2, photo.width // 2), dtype=bool)
    mask[:, mask.shape[1] // 2 :] = True
    return png(mask)


def keypoints_of(client: Client, query: Any, mask: bytes | None) -> tuple[int, Any]:
    sent = query.image if mask is None else MaskedImage(query.image, mask)
    result = client.localize(sent, "room", query.camera, debug=True)
    assert result.localized
    assert result.debug is not None
    return result.keypoints, np.asarray(result.debug.keypoints)


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_keypoints_where_the_mask_is_black_do_not_count(
    doors: Any, query: Any, right_half: bytes, door: str
) -> None:
    address = doors.url if door == "http" else f"grpc://127.0.0.1:{doors.server.grpc_port}"
    with Client(address) as client:
        all_of_it, _ = keypoints_of(client, query, None)
        some, matched = keypoints_of(client, query, right_half)

    assert 0 < some < 0.8 * all_of_it
    assert matched[:, 0].min() >= query.camera.width / 2


def test_a_mask_in_json_is_that_of_a_form(doors: Any, query: Any, right_half: bytes) -> None:
    form = doors.http.post(
        "/localize",
        data={"map": "room"},
        files={"image": ("a.jpg", query.image), "mask": ("a.png", right_half)},
    ).json()
    encoded = {
        name: base64.b64encode(data).decode()
        for name, data in (("image", query.image), ("mask", right_half))
    }
    as_json = doors.http.post("/localize", json={"map": "room", **encoded}).json()

    assert form["status"] == "localized", form
    assert as_json["pose"] == form["pose"]
    assert as_json["keypoints"] == form["keypoints"]


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_each_image_of_a_rig_has_its_mask(
    doors: Any, query: Any, right_half: bytes, door: str
) -> None:
    address = doors.url if door == "http" else f"grpc://127.0.0.1:{doors.server.grpc_port}"
    rig = {"one": RigSensor(Pose.identity(), query.camera)}
    with Client(address) as client:
        whole, masked = (
            client.localize_rig([RigImage("one", sent)], "room", rig).images[0]
            for sent in (query.image, MaskedImage(query.image, right_half))
        )

    assert 0 < masked.keypoints < 0.8 * whole.keypoints


def test_a_black_mask_leaves_nothing(doors: Any, query: Any) -> None:
    black = png(np.zeros((query.camera.height, query.camera.width), dtype=bool))
    with Client(doors.url) as client:
        result = client.localize(MaskedImage(query.image, black), "room", query.camera)

    assert not result.localized
    assert result.refusal.reason == "no_keypoints"


@pytest.mark.parametrize(
    ("mask", "code", "field"),
    [
        (png(np.ones((50, 50), dtype=bool)), "mask.size", "mask"),
        (b"no picture", "image.format", "mask"),
        (png(np.ones((1000, 2000), dtype=bool)), "image.too_many_pixels", "mask"),
    ],
)
def test_a_mask_that_cannot_be_one_is_refused_by_name(
    doors: Any, query: Any, mask: bytes, code: str, field: str
) -> None:
    with Client(doors.url) as client, pytest.raises(InvalidInput) as caught:
        client.localize(MaskedImage(query.image, mask), "room", query.camera)

    assert (caught.value.code, caught.value.field) == (code, field)


def test_features_take_no_mask(doors: Any, right_half: bytes) -> None:
    request = pb2.LocalizeRequest(map="room", mask=right_half)
    with pytest.raises(Exception, match=r"mask\.needs_photo|belongs to a photo"):
        doors.stub.Localize(request)


def test_bad_base64_of_a_mask_names_the_mask(doors: Any, query: Any) -> None:
    image = base64.b64encode(query.image).decode()
    body = json.dumps({"map": "room", "image": image, "mask": "?"})
    answer = doors.http.post(
        "/localize", content=body, headers={"content-type": "application/json"}
    ).json()

    assert answer["code"] == "image.base64", answer
    assert answer["field"] == "mask"
