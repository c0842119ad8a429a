"""Rigs and sequences: the same over HTTP and gRPC, synchronous and asynchronous."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients import (
    AsyncClient,
    Client,
    Features,
    HeightBand,
    Instant,
    InstantResult,
    Odometry,
    PoseSource,
    Priors,
    RigImage,
    RigSensor,
)
from clients.transport.http import HttpTransport
from visloc.errors import InvalidInput, NotFound, Unavailable, VislocError
from visloc.geometry import Camera, Pose, rotation_angle

CAMERA = Camera("PINHOLE", 640, 480, (525.5, 525.0, 320.0, 240.0))
CAM_FROM_RIG = {
    "left": Pose.from_quaternion([0.9, 0.1, -0.2, 0.3], [0.1, 0.0, -0.2]),
    "right": Pose.from_quaternion([0.5, 0.5, 0.5, 0.5], [-0.5, 0.25, 1.0]),
}
RIG = {name: RigSensor(pose, CAMERA) for name, pose in CAM_FROM_RIG.items()}
RIG_FROM_WORLD = Pose.from_quaternion([0.8, -0.4, 0.2, 0.4], [3.0, -2.0, 0.5])
Call = Callable[[Any], Any]


def photo_of(sensor: str, rig_from_world: Pose = RIG_FROM_WORLD) -> bytes:
    """A photo that the canned service localizes where this camera of the rig is."""
    pose = CAM_FROM_RIG[sensor] @ rig_from_world
    numbers = {"rotation_wxyz": pose.rotation_wxyz.tolist(), "translation": [*pose.translation]}
    return json.dumps(numbers).encode()


def instant(timestamp: int, *contents: bytes, **more: Any) -> Instant:
    images = (RigImage(s, content) for s, content in zip(("left", "right"), contents, strict=False))
    return Instant(timestamp, tuple(images), **more)


def ask_all(http_url: str, grpc_url: str, call: Call) -> list[Any]:
    """Return what each of the four clients answers, lists of instants and exceptions included."""

    def ask(url: str) -> Any:
        with Client(url) as client:
            try:
                answer = call(client)
                return list(answer) if isinstance(answer, Iterator) else answer
            except VislocError as error:
                return error

    async def ask_async(url: str) -> Any:
        async with AsyncClient(url) as client:
            try:
                answer = call(client)
                if isinstance(answer, AsyncIterator):
                    return [one async for one in answer]
                return await answer
            except VislocError as error:
                return error

    return [
        answer for url in (http_url, grpc_url) for answer in (ask(url), asyncio.run(ask_async(url)))
    ]


def same_pose(a: Pose, b: Pose) -> bool:
    return (
        float(np.linalg.norm(a.center - b.center)) < 1e-9
        and rotation_angle(a.rotation @ b.rotation.T) < 1e-9
    )


# Rigs


def test_a_rig_has_one_pose_and_its_cameras_theirs(http_url: str, grpc_url: str) -> None:
    images = [RigImage("right", photo_of("right"), CAMERA, 7), RigImage("left", b"dark", None, 7)]
    answers = ask_all(
        http_url, grpc_url, lambda c: c.localize_rig(images, "room", RIG, {"seed": 7}, "my-id")
    )

    for answer in answers:
        assert isinstance(answer, InstantResult)
        assert answer.localized
        assert (answer.status, answer.source) == ("localized", PoseSource.ESTIMATED)
        assert answer.timestamp == 7
        assert answer.request_id == "my-id"
        assert same_pose(answer.pose.rig_from_world, RIG_FROM_WORLD)
        np.testing.assert_allclose(answer.pose.position, RIG_FROM_WORLD.center)
        assert [image.sensor for image in answer.images] == ["right", "left"]
        for image in answer.images:
            assert same_pose(image.cam_from_world, CAM_FROM_RIG[image.sensor] @ RIG_FROM_WORLD)
            assert image.error is None
        assert (answer.correspondences, answer.inliers) == (1400, 622)
    # As text, so that 0 is not 0.0; sorted, because protobuf does not keep the order of maps.
    assert len({json.dumps(answer.raw, sort_keys=True) for answer in answers}) == 1
    assert len({tuple(answer.raw) for answer in answers}) == 1


def test_all_clients_send_the_same_rig(
    http_url: str, grpc_url: str, service: Any, tmp_path: Path
) -> None:
    photo = tmp_path / "a photo.jpg"
    photo.write_bytes(bytes(range(256)) * 300)
    features = Features("xfeat", np.zeros((1, 2)), np.zeros((1, 4)))
    images = [RigImage("left", photo, CAMERA, 2**53 + 1), RigImage("right", features)]
    priors = {"height": {"min": -1.0, "max": 2.5}, "position": None}
    ask_all(
        http_url, grpc_url, lambda c: c.localize_rig(images, "room@v1", RIG, None, priors=priors)
    )

    first = service.seen[0]
    assert service.seen == [first] * 4
    camera = {"model": "PINHOLE", "width": 640, "height": 480, "params": [*CAMERA.params]}
    assert first["images"] == [
        {
            "sensor": "left",
            "image": photo.read_bytes(),
            "camera": camera,
            "timestamp": 2**53 + 1,
        },
        {"sensor": "right", "features": features.as_json(), "image": b"photo"},
    ]
    assert first["priors"] == {"height": {"min": -1.0, "max": 2.5}}
    left = first["rig"]["sensors"]["left"]
    assert left["camera"] == camera
    assert left["cam_from_rig"]["translation"] == [0.1, 0.0, -0.2]
    assert first["options"] == {}
    assert first["request_id"] is None


def test_a_rig_that_the_map_knows_is_named(http_url: str, grpc_url: str, service: Any) -> None:
    images = [RigImage("left", b"photo"), RigImage("right", b"dark")]
    for answer in ask_all(http_url, grpc_url, lambda c: c.localize_rig(images, "room", "stereo")):
        left, right = (image.cam_from_world for image in answer.images)
        np.testing.assert_allclose(
            (right @ left.inverse()).translation, [-0.5, 0.0, 0.0], atol=1e-12
        )
    assert {request["rig"] for request in service.seen} == {"stereo"}


def test_a_bad_photo_of_a_rig_fails_alone(http_url: str, grpc_url: str) -> None:
    images = [RigImage("left", b"broken"), RigImage("right", photo_of("right"))]
    for answer in ask_all(http_url, grpc_url, lambda c: c.localize_rig(images, "room", RIG)):
        assert answer.localized
        left, right = answer.images
        assert isinstance(left.error, InvalidInput)
        assert left.error.code == "image.undecodable"
        assert left.camera is None
        assert right.error is None
        assert right.camera.source == "given"


def test_a_rig_without_a_pose_says_why(http_url: str, grpc_url: str) -> None:
    images = [RigImage("left", b"dark")]
    for answer in ask_all(http_url, grpc_url, lambda c: c.localize_rig(images, "room", RIG)):
        assert not answer.localized
        assert (answer.status, answer.source, answer.pose) == ("not_localized", None, None)
        assert answer.refusal.reason == "too_few_matches"
        assert answer.timestamp is None
        assert answer.images[0].cam_from_world is None


def test_the_rigs_of_a_map_and_its_down_are_listed(http_url: str, grpc_url: str) -> None:
    for info in ask_all(http_url, grpc_url, lambda c: c.map("room")):
        assert [(rig.id, rig.sensors) for rig in info.rigs] == [("stereo", ("left", "right"))]
        assert info.down == (0.0, 1.0, 0.0)


SCALED = {"left": RigSensor(Pose(1.01 * np.eye(3), np.zeros(3)))}
MIRRORED = {"left": RigSensor(Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3)))}
NOWHERE = {"left": RigSensor(Pose(np.eye(3), np.array([0.0, np.nan, 0.0])))}


@pytest.mark.parametrize(
    ("call", "kind", "code"),
    [
        (
            lambda c: c.localize_rig([RigImage("up", b"")], "room", RIG),
            InvalidInput,
            "rig.sensor",
        ),
        (lambda c: c.localize_rig([], "room", "mono"), NotFound, "rig.unknown"),
        (lambda c: c.localize_rig([], "hall", "stereo"), NotFound, "map.unknown"),
        (lambda c: c.localize_rig([], "room", SCALED), InvalidInput, "rig.rotation"),
        (lambda c: c.localize_rig([], "room", MIRRORED), InvalidInput, "rig.rotation"),
        (lambda c: c.localize_rig([], "room", NOWHERE), InvalidInput, "pose.translation"),
        (lambda c: c.localize_rig([], "room", None), InvalidInput, "request.missing_field"),
        (lambda c: c.localize_rig([], "room", ["left"]), InvalidInput, "request.invalid"),
        (
            lambda c: c.localize_rig([], "room", {"left": Pose.identity()}),
            InvalidInput,
            "request.invalid",
        ),
        (lambda c: c.localize_rig({"left": b""}, "room", RIG), InvalidInput, "request.invalid"),
        (lambda c: c.localize_rig(["a.jpg"], "room", RIG), InvalidInput, "request.invalid"),
        (
            lambda c: c.localize_rig(RigImage("left", b""), "room", RIG),
            InvalidInput,
            "request.invalid",
        ),
        (
            lambda c: c.localize_sequence([Instant(1, {"left": b""})], "room", RIG, "ms"),
            InvalidInput,
            "request.invalid",
        ),
        (lambda c: c.localize_rig([], [], "stereo"), InvalidInput, "request.map"),
        (lambda c: c.localize_rig([], ["room", "a/b"], "stereo"), InvalidInput, "map.id"),
        (
            lambda c: c.localize_rig([RigImage("left", Path("/none"))], "room", RIG),
            InvalidInput,
            "image.unreadable",
        ),
        (
            lambda c: c.localize_rig([RigImage("left", b"", None, 2**63)], "room", RIG),
            InvalidInput,
            "request.invalid",
        ),
        (
            lambda c: c.localize_rig([RigImage("left", b"crash")], "room", RIG),
            VislocError,
            "server.internal",
        ),
        (
            lambda c: c.localize_sequence([instant(1, b"crash")], "room", RIG, "ms"),
            VislocError,
            "server.internal",
        ),
        (
            lambda c: c.localize_sequence([instant(1, b"")], "hall", None, "ms"),
            NotFound,
            "map.unknown",
        ),
        (
            lambda c: c.localize_sequence([instant(1.5, b"")], "room"),
            InvalidInput,
            "request.invalid",
        ),
        (
            lambda c: c.localize_sequence(
                [instant(1, b"", odometry=Odometry(Pose.identity(), np.eye(5)))], "room"
            ),
            InvalidInput,
            "pose.covariance",
        ),
        (
            lambda c: c.localize_sequence(
                [instant(1, odometry=Odometry(SCALED["left"].cam_from_rig))], "room"
            ),
            InvalidInput,
            "pose.rotation",
        ),
    ],
)
def test_all_clients_raise_the_same_error(
    call: Call, kind: type[VislocError], code: str, http_url: str, grpc_url: str
) -> None:
    errors = ask_all(http_url, grpc_url, call)
    assert [type(error) for error in errors] == [kind] * 4
    assert errors[0].code == code
    names = ("code", "message", "field", "expected", "got")
    assert len({tuple(getattr(error, name) for name in names) for error in errors}) == 1


@pytest.mark.parametrize(
    ("more", "code"),
    [
        ({"time_unit": "min"}, "sequence.time_unit"),
        ({"max_gap_s": -1.0}, "sequence.max_gap"),
        ({"max_gap_s": float("nan")}, "sequence.max_gap"),
        ({"rig": SCALED}, "rig.rotation"),
        ({"priors": {"height": {"min": 1, "max": 0}}}, "priors.height"),
    ],
)
def test_what_a_sequence_shares_is_checked_when_it_is_asked_for(
    more: dict[str, Any], code: str, url: str
) -> None:
    with Client(url) as client, pytest.raises(InvalidInput) as caught:
        client.localize_sequence([], "room", **more)
    assert caught.value.code == code


# Sequences


def test_a_sequence_is_answered_in_order_with_a_status_per_instant(
    http_url: str, grpc_url: str
) -> None:
    instants = [
        instant(100, photo_of("left"), b"dark"),
        instant(2**53 + 1, b"filled", b"dark"),
        instant(2**53 + 2, b"dark", b"broken"),
    ]
    lists = ask_all(http_url, grpc_url, lambda c: c.localize_sequence(instants, "room", RIG, "ms"))

    for answers in lists:
        assert [answer.timestamp for answer in answers] == [100, 2**53 + 1, 2**53 + 2]
        measured, filled, lost = answers
        assert measured.localized
        assert same_pose(measured.pose.rig_from_world, RIG_FROM_WORLD)
        assert (filled.status, filled.source) == ("filled", PoseSource.INTERPOLATED)
        assert not filled.localized
        assert filled.pose is not None
        assert filled.refusal.reason == "too_few_matches"
        assert (filled.pose.covariance >= measured.pose.covariance).all()
        assert lost.pose is None
        assert lost.images[1].error.code == "image.undecodable"
    texts = [json.dumps([a.raw for a in answers], sort_keys=True) for answers in lists]
    assert len(set(texts)) == 1


def test_all_clients_send_the_same_sequence(http_url: str, grpc_url: str, service: Any) -> None:
    odometry = Odometry(Pose.from_quaternion([1, 0, 0, 0], [1.0, 2.0, 3.0]), 1e-4 * np.eye(6))
    instants = [
        Instant(5, (RigImage("camera", b"photo", CAMERA),), odometry),
        Instant(6, (RigImage("camera", b"photo"),), None, Priors(height=HeightBand(-0.5, 1.0))),
        Instant(7, (), Odometry(Pose.identity())),
    ]
    options = {"top_k": 5, "fusion_weights": {"densevlad": 0.5}, "solver": "poselib"}
    answers = ask_all(
        *(http_url, grpc_url),
        lambda c: c.localize_sequence(
            *(instants, "room@v1", None, "ms", 0.0, options, "id-1"), priors={"gravity": None}
        ),
    )
    assert [len(answer) for answer in answers] == [3] * 4
    firsts = service.seen[:3]
    assert service.seen == firsts * 4
    assert firsts[0]["odometry"]["rig_from_odometry"]["translation"] == [1.0, 2.0, 3.0]
    assert firsts[0]["odometry"]["covariance"][7] == 1e-4
    assert "covariance" not in firsts[2]["odometry"]
    assert firsts[1]["priors"] == {"height": {"min": -0.5, "max": 1.0}}
    for request in firsts:
        assert (request["time_unit"], request["max_gap_s"]) == ("ms", 0.0)
        assert request["rig"] is None
        assert request["options"] == options
        assert request["request_id"] == "id-1"


def test_an_empty_sequence_is_refused_by_the_server(http_url: str, grpc_url: str) -> None:
    errors = ask_all(http_url, grpc_url, lambda c: c.localize_sequence([], "room"))
    assert [error.code for error in errors] == ["sequence.empty"] * 4


def test_an_unknown_unit_of_time_is_refused_before_anything_is_sent(
    http_url: str, grpc_url: str, service: Any
) -> None:
    def instants() -> Iterator[Instant]:
        yield instant(5, b"photo")
        pytest.fail("the first timestamp is enough")

    errors = ask_all(
        http_url, grpc_url, lambda c: c.localize_sequence([instant(5, b"photo")], "room")
    )
    assert [error.code for error in errors] == ["sequence.time_unit"] * 4
    assert "one of s, ms, us, ns" in str(errors[0])
    errors = ask_all(grpc_url, grpc_url, lambda c: c.localize_sequence(instants(), "hall"))
    assert [error.code for error in errors] == ["sequence.time_unit"] * 4
    assert service.seen == []
    for unix in (1_700_000_000, 1_700_000_000_000_000_000):
        lists = ask_all(
            *(http_url, grpc_url),
            lambda c, t=unix: c.localize_sequence([instant(t, b"photo")], "room", RIG),
        )
        assert [len(answers) for answers in lists] == [1] * 4


def test_an_error_within_a_sequence_comes_after_the_answers_before_it(
    http_url: str, grpc_url: str
) -> None:
    instants = [instant(1, b"photo"), instant(2, b"photo"), instant(3, b"crash")]
    for url in (http_url, grpc_url):
        with Client(url) as client:
            answers = client.localize_sequence(instants, "room", RIG, "ms")
            assert [next(answers).timestamp, next(answers).timestamp] == [1, 2]
            with pytest.raises(VislocError) as caught:
                next(answers)
            assert caught.value.code == "server.internal"


def test_over_grpc_an_answer_comes_before_the_next_instant_is_known(grpc_url: str) -> None:
    is_answered = threading.Event()

    def instants() -> Iterator[Instant]:
        for timestamp in range(3):
            yield instant(timestamp, b"photo")
            assert is_answered.wait(5)
            is_answered.clear()

    with Client(grpc_url) as client:
        for answer in client.localize_sequence(instants(), "room", RIG, "ms"):
            assert answer.localized
            is_answered.set()

    async def ask() -> int:
        is_known = asyncio.Event()

        async def instants() -> AsyncIterator[Instant]:
            for timestamp in range(3):
                yield instant(timestamp, b"photo")
                await asyncio.wait_for(is_known.wait(), 5)
                is_known.clear()

        count = 0
        async with AsyncClient(grpc_url) as client:
            async for _ in client.localize_sequence(instants(), "room", RIG, "ms"):
                count += 1
                is_known.set()
        return count

    assert asyncio.run(ask()) == 3


class CameraLostError(Exception):
    pass


@pytest.mark.parametrize("num_before", [0, 1])
def test_what_the_callers_iterable_raises_reaches_the_caller(
    num_before: int, http_url: str, grpc_url: str
) -> None:
    def instants() -> Iterator[Instant]:
        for timestamp in range(num_before):
            yield instant(timestamp, b"photo")
        raise CameraLostError

    async def ask(url: str) -> None:
        async with AsyncClient(url) as client:
            async for _ in client.localize_sequence(instants(), "room", RIG, "ms"):
                pass

    for url in (http_url, grpc_url):
        with Client(url) as client, pytest.raises(CameraLostError):
            list(client.localize_sequence(instants(), "room", RIG, "ms"))
        with pytest.raises(CameraLostError):
            asyncio.run(ask(url))


def failing(num_before: int) -> Iterator[Instant]:
    for timestamp in range(num_before):
        yield instant(timestamp, b"photo")
    raise CameraLostError


def ending_in(num_before: int, last: Instant) -> Iterator[Instant]:
    for timestamp in range(num_before):
        yield instant(timestamp, b"photo")
    yield last


UNREADABLE = Instant(9, (RigImage("left", "/none.png"),))


@pytest.mark.parametrize("num_before", [0, 2])
@pytest.mark.parametrize("is_sound_to_the_end", [True, False])
@pytest.mark.parametrize(
    ("instants", "code"),
    [
        (failing, None),
        (lambda n: ending_in(n, UNREADABLE), "image.unreadable"),
        (
            lambda n: ending_in(
                n, instant(9, odometry=Odometry(Pose.identity(), np.zeros((6, 6))))
            ),
            "pose.covariance",
        ),
        (
            lambda n: ending_in(n, Instant(9, (RigImage(7, b""),))),  # type: ignore[arg-type]
            "request.invalid",
        ),
    ],
)
def test_over_grpc_a_bad_instant_wins_over_the_server_after_the_answers_before_it(
    instants: Callable[[int], Iterator[Instant]],
    code: str | None,
    num_before: int,
    is_sound_to_the_end: bool,
    grpc_url: str,
    service: Any,
) -> None:
    service.fails_at_the_end = not is_sound_to_the_end
    answers: list[int | None] = []

    def ask() -> None:
        with Client(grpc_url, timeout_s=5) as client:
            for answer in client.localize_sequence(instants(num_before), "room", RIG, "ms"):
                answers.append(answer.timestamp)

    async def ask_async() -> None:
        async with AsyncClient(grpc_url, timeout_s=5) as client:
            async for answer in client.localize_sequence(instants(num_before), "room", RIG, "ms"):
                answers.append(answer.timestamp)

    for call in (ask, lambda: asyncio.run(ask_async())):
        answers.clear()
        with pytest.raises((VislocError, CameraLostError)) as caught:
            call()
        assert getattr(caught.value, "code", None) == code
        assert answers == list(range(num_before))


@pytest.mark.parametrize(
    ("covariance", "got"),
    [
        (np.zeros((6, 6)), "[[0.0,"),
        (-np.eye(6), "[[-1.0,"),
        (np.ones(35), "35 numbers, of shape (35,)"),
        (np.eye(5), "25 numbers, of shape (5, 5)"),
        ([[1.0], [1.0, 2.0]], "[[1.0], [1.0, 2.0]]"),
        ("wide", "wide"),
    ],
)
def test_a_bad_covariance_is_told_with_its_instant_and_what_came(
    covariance: Any, got: str, http_url: str, grpc_url: str
) -> None:
    def instants() -> Iterator[Instant]:
        return ending_in(3, instant(9, odometry=Odometry(Pose.identity(), covariance)))

    errors = ask_all(
        http_url, grpc_url, lambda c: c.localize_sequence(instants(), "room", RIG, "ms")
    )
    for error in errors:
        assert error.code == "pose.covariance"
        assert error.field == "instants[3].odometry.covariance"
        assert error.got.startswith(got)


def test_a_sequence_can_be_left_early(http_url: str, grpc_url: str) -> None:
    def instants() -> Iterable[Instant]:
        return [instant(timestamp, b"photo") for timestamp in range(50)]

    async def first(url: str) -> int | None:
        async with AsyncClient(url) as client:
            async for answer in client.localize_sequence(instants(), "room", RIG, "ms"):
                return answer.timestamp
        return None

    for url in (http_url, grpc_url):
        with Client(url) as client:
            for answer in client.localize_sequence(instants(), "room", RIG, "ms"):
                assert answer.timestamp == 0
                break
            assert client.localize(b"photo", "room").localized
        assert asyncio.run(first(url)) == 0


def test_a_slow_instant_is_a_timeout_but_a_slow_sender_is_none(
    http_url: str, grpc_url: str, service: Any
) -> None:
    service.slow_s = 1.5

    def unhurried() -> Iterator[Instant]:
        for timestamp in range(2):
            time.sleep(0.7)
            yield instant(timestamp, b"photo")

    async def ask(url: str, instants: Iterable[Instant]) -> int:
        async with AsyncClient(url, timeout_s=0.5) as client:
            return len([a async for a in client.localize_sequence(instants, "room", RIG, "ms")])

    for url in (http_url, grpc_url):
        slow = [instant(1, b"photo"), instant(2, b"slow")]
        with Client(url, timeout_s=0.5) as client:
            with pytest.raises(Unavailable) as caught:
                list(client.localize_sequence(slow, "room", RIG, "ms"))
            assert caught.value.code == "server.timeout"
            assert len(list(client.localize_sequence(unhurried(), "room", RIG, "ms"))) == 2
        with pytest.raises(Unavailable) as caught:
            asyncio.run(ask(url, slow))
        assert caught.value.code == "server.timeout"
        assert asyncio.run(ask(url, unhurried())) == 2


@pytest.mark.parametrize("url", ["http://127.0.0.1:1", "grpc://127.0.0.1:1"])
def test_a_sequence_to_nobody_is_unreachable(url: str) -> None:
    async def ask() -> None:
        async with AsyncClient(url) as client:
            async for _ in client.localize_sequence([instant(1, b"photo")], "room", RIG, "ms"):
                pass

    with Client(url) as client, pytest.raises(Unavailable) as caught:
        list(client.localize_sequence([instant(1, b"photo")], "room", RIG, "ms"))
    assert caught.value.code == "server.unreachable"
    with pytest.raises(Unavailable) as caught:
        asyncio.run(ask())
    assert caught.value.code == "server.unreachable"


def answering(lines: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the HTTP transport receive these chunks."""
    import httpx

    async def chunks() -> AsyncIterator[bytes]:
        for line in lines:
            yield line

    def stream(*_: Any, **__: Any) -> Any:
        handler = httpx.MockTransport(
            lambda _: httpx.Response(
                200, headers={"content-type": "application/x-ndjson"}, content=chunks()
            )
        )
        return httpx.AsyncClient(transport=handler, base_url="http://server").stream("POST", "/")

    original = HttpTransport.__init__

    def init(self: Any, connection: Any) -> None:
        original(self, connection)
        self._http.stream = stream

    monkeypatch.setattr(HttpTransport, "__init__", init)


def test_lines_are_cut_at_line_feeds_only(
    http_url: str, service: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.map_info("room")
    with Client(http_url) as client:
        (answer,) = client.localize_sequence([instant(1, b"dark")], "room", RIG, "ms")
    refusal = {**answer.raw["refusal"], "message": "a\u2028b\x85c"}
    line = json.dumps(dict(answer.raw) | {"refusal": refusal}, ensure_ascii=False).encode() + b"\n"
    answering([line[:7], line[7:-1], line[-1:] + b"\r\n"], monkeypatch)
    with Client("http://server") as client:
        (again,) = client.localize_sequence([instant(1, b"dark")], "room", RIG, "ms")
    assert again.refusal is not None
    assert again.refusal.message == "a\u2028b\x85c"


@pytest.mark.parametrize(
    ("lines", "code"),
    [
        ([b"nonsense\n"], "server.answer"),
        ([b"[]\n"], "server.answer"),
        ([b"{}\n"], "server.answer"),
        ([b'{"half": '], "server.answer"),
        ([], "server.answer"),
        ([b'{"problem": {"code": "server.busy", "kind": "Overloaded"}}\n'], "server.busy"),
        ([b'{"problem": {"status": 404}}\n'], "request.not_found"),
        ([b'{"problem": {"status": "x"}}\n'], "server.internal"),
    ],
)
def test_lines_that_are_no_answers_are_told(
    lines: list[bytes], code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(lines, monkeypatch)
    with Client("http://server") as client, pytest.raises(VislocError) as caught:
        list(client.localize_sequence([instant(1, b"dark")], "room", RIG, "ms"))
    assert caught.value.code == code


# What every request may say


def test_several_maps_and_priors_are_sent_alike(http_url: str, grpc_url: str, service: Any) -> None:
    priors = {
        "position": {"position": [1.0, 2.0, 3.0], "radius": 4.0},
        "gravity": {"direction": [0.0, 2.0, 0.0], "world": [0.0, 0.0, -1.0]},
    }
    ask_all(http_url, grpc_url, lambda c: c.localize(b"photo", ("room", "room@v1"), priors=priors))
    first = service.seen[0]
    assert service.seen == [first] * 4
    assert first["map"] is None
    assert first["maps"] == ["room", "room@v1"]
    assert first["priors"]["position"] == priors["position"]
    assert first["priors"]["gravity"]["direction"] == [0.0, 1.0, 0.0]
    assert first["priors"]["gravity"]["std_deg"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("status", "filled"),
        ("status", "perhaps"),
        ("source", None),
        ("source", "interpolated"),
        ("source", "magic"),
        ("pose", None),
        ("refusal", {"stage": "pose", "reason": "no_pose", "message": "none"}),
    ],
)
def test_an_answer_that_contradicts_itself_is_the_servers_fault(
    part: str, value: object, url: str, service: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = service.localize_instant
    monkeypatch.setattr(service, "localize_instant", lambda *a: answer(*a) | {part: value})
    with Client(url) as client, pytest.raises(Unavailable) as caught:
        client.localize_rig([RigImage("left", b"photo")], "room", RIG)
    assert caught.value.code == "server.answer"
