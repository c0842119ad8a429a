"""The same calls over HTTP and gRPC, synchronous and asynchronous, give the same."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients import AsyncClient, Client, Features, LocalizeOptions
from visloc.errors import InvalidInput, NotFound, Overloaded, TooLarge, Unavailable, VislocError
from visloc.geometry import Camera
from visloc_api.words.wire import ARRAY_DTYPES

CAMERA = Camera("PINHOLE", 640, 480, (525.5, 525.0, 320.0, 240.0))
Call = Callable[[Any], Any]  # of a client; what an AsyncClient returns is awaited


def ask_all(http_url: str, grpc_url: str, call: Call) -> list[Any]:
    """Return what each of the four clients answers, an exception included."""

    def ask(url: str) -> Any:
        with Client(url) as client:
            try:
                return call(client)
            except VislocError as error:
                return error

    async def ask_async(url: str) -> Any:
        async with AsyncClient(url) as client:
            try:
                return await call(client)
            except VislocError as error:
                return error

    return [
        answer for url in (http_url, grpc_url) for answer in (ask(url), asyncio.run(ask_async(url)))
    ]


@pytest.mark.parametrize("image", [b"photo", b"refuse"])
def test_all_clients_receive_the_same_answer(image: bytes, http_url: str, grpc_url: str) -> None:
    answers = ask_all(
        http_url, grpc_url, lambda c: c.localize(image, "room", CAMERA, {"seed": 7}, "my-id")
    )

    assert {answer.localized for answer in answers} == {image == b"photo"}
    # As text, so that 0 is not 0.0; sorted, because protobuf does not keep the order of maps.
    assert len({json.dumps(answer.raw, sort_keys=True) for answer in answers}) == 1
    assert len({tuple(answer.raw) for answer in answers}) == 1


def test_poses_keep_every_bit(http_url: str, grpc_url: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        quaternion = rng.normal(size=4)
        sent = {
            "rotation_wxyz": (quaternion / np.linalg.norm(quaternion)).tolist(),
            "translation": (rng.normal(size=3) * 10.0 ** rng.integers(-20, 20, 3)).tolist(),
        }
        image = json.dumps(sent).encode()
        for answer in ask_all(http_url, grpc_url, lambda c, i=image: c.localize(i, "room")):
            assert list(answer.pose.rotation_wxyz) == sent["rotation_wxyz"]
            assert list(answer.pose.translation) == sent["translation"]


def test_negative_zero_keeps_its_sign(http_url: str, grpc_url: str) -> None:
    for answer in ask_all(http_url, grpc_url, lambda c: c.localize(b"photo", "room")):
        assert repr(answer.pose.translation[1]) == "-0.0"


def test_all_clients_send_the_same_request(
    http_url: str, grpc_url: str, service: Any, tmp_path: Path
) -> None:
    photo = tmp_path / "a photo.jpg"
    photo.write_bytes(bytes(range(256)) * 300)
    options = LocalizeOptions(
        preset="config1",
        top_k=5,
        max_error_px=2.5,
        min_inliers=10,
        min_inlier_ratio=0.0,
        read_as="upright",
        extraction="accurate",
        fusion="mean",
        fusion_weights={"densevlad": 2, "kapture:AP-GeM": 0.1},
        matcher="ratio",
        solver="poselib",
        seed=0,
    )
    ask_all(http_url, grpc_url, lambda c: c.localize(photo, "room@v1", CAMERA, options, "id-1"))

    assert (
        service.seen
        == [
            {
                "image": photo.read_bytes(),
                "map": "room@v1",
                "camera": {
                    "model": "PINHOLE",
                    "width": 640,
                    "height": 480,
                    "params": [525.5, 525.0, 320.0, 240.0],
                },
                "options": options.given(),
                "request_id": "id-1",
            }
        ]
        * 4
    )


def test_all_clients_send_the_same_features(http_url: str, grpc_url: str, service: Any) -> None:
    rng = np.random.default_rng(0)
    features = Features(
        "kapture:r2d2",
        rng.uniform(0, 480, (3, 2)),
        rng.integers(0, 255, (3, 8), dtype=np.uint8),
        {"kapture:AP-GeM": rng.normal(size=5).astype(np.float16)},
    )
    answers = ask_all(http_url, grpc_url, lambda c: c.localize(features, "room", CAMERA))

    assert all(answer.localized for answer in answers)
    assert [seen["features"] for seen in service.seen] == [features.as_json()] * 4
    assert service.seen[0]["features"]["keypoints"]["shape"] == [3, 2]


def test_clients_send_the_arrays_that_the_service_reads() -> None:
    assert {dtype.str[0] for dtype in ARRAY_DTYPES.values()} == {"<", "|"}


def test_what_is_not_given_is_not_sent(http_url: str, grpc_url: str, service: Any) -> None:
    ask_all(http_url, grpc_url, lambda c: c.localize(b"photo", "room"))
    asked = {"map": "room", "camera": None, "options": {}, "request_id": None}
    assert service.seen == [{"image": b"photo", **asked}] * 4


def test_maps_are_the_same_with_all_digits_of_their_size(http_url: str, grpc_url: str) -> None:
    lists = ask_all(http_url, grpc_url, lambda c: c.maps())
    singles = ask_all(http_url, grpc_url, lambda c: c.map("room@v1"))
    assert all(maps == [singles[0]] for maps in lists)
    assert all(single == singles[0] for single in singles)
    assert singles[0].size_bytes == 2**53 + 1
    assert singles[0].landmarks == 0
    assert singles[0].ref == "room@v1"


def test_the_server_tells_its_version(http_url: str, grpc_url: str) -> None:
    answers = ask_all(http_url, grpc_url, lambda c: c.server_info())
    assert [answer.version for answer in answers] == ["1.2.3"] * 4


@pytest.mark.parametrize("is_ready", [True, False])
def test_readiness(is_ready: bool, http_url: str, grpc_url: str, service: Any) -> None:
    service.is_ready = is_ready
    assert ask_all(http_url, grpc_url, lambda c: c.ready()) == [is_ready] * 4


@pytest.mark.parametrize(
    ("call", "kind", "code"),
    [
        (lambda c: c.localize(b"broken", "room"), InvalidInput, "image.undecodable"),
        (lambda c: c.localize(b"huge", "room"), TooLarge, "image.too_large"),
        (lambda c: c.localize(b"busy forever", "room"), Overloaded, "server.busy"),
        (lambda c: c.localize(b"crash", "room"), VislocError, "server.internal"),
        (lambda c: c.localize(b"photo", "hall"), NotFound, "map.unknown"),
        (lambda c: c.map("hall"), NotFound, "map.unknown"),
        (lambda c: c.map("../etc"), InvalidInput, "map.id"),
        (lambda c: c.map(""), InvalidInput, "map.id"),
        (lambda c: c.localize(b"photo", "a/b"), InvalidInput, "map.id"),
        (
            lambda c: c.localize(b"", "room", None, {"sed": 1}),
            InvalidInput,
            "request.unknown_field",
        ),
        (lambda c: c.localize(b"", "room", None, {"seed": -1}), InvalidInput, "options.seed"),
        (lambda c: c.localize(b"", "room", None, {"seed": 2**32}), InvalidInput, "options.seed"),
        (lambda c: c.localize(b"", "room", None, {"top_k": True}), InvalidInput, "request.invalid"),
        (
            lambda c: c.localize(b"", "room", None, LocalizeOptions(fusion_weights={})),
            InvalidInput,
            "options.fusion_weights",
        ),
        (
            lambda c: c.localize(b"", "room", None, {"max_error_px": float("nan")}),
            InvalidInput,
            "options.max_error_px",
        ),
        (lambda c: c.localize(b"", "room", request_id="a\nb"), InvalidInput, "request.id"),
        (lambda c: c.localize(Path("/none.jpg"), "room"), InvalidInput, "image.unreadable"),
    ],
)
def test_all_clients_raise_the_same_error(
    call: Call, kind: type[VislocError], code: str, http_url: str, grpc_url: str, service: Any
) -> None:
    errors = []
    for url in (http_url, grpc_url):
        service.busy.clear()
        errors += ask_all(url, url, call)[:2]
    assert [type(error) for error in errors] == [kind] * 4
    assert errors[0].code == code
    names = ("code", "message", "field", "expected", "got")
    assert len({tuple(getattr(error, name) for name in names) for error in errors}) == 1


def test_a_slow_answer_is_a_timeout_that_says_how_long_it_was_waited_for(
    http_url: str, grpc_url: str
) -> None:
    for url in (http_url, grpc_url):
        with Client(url, timeout_s=0.1) as client, pytest.raises(Unavailable) as caught:
            client.localize(b"slow", "room")
        assert caught.value.code == "server.timeout"
        assert caught.value.field == url
        assert "0.1 s" in str(caught.value)
