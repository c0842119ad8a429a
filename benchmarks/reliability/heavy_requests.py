"""Small requests that ask for much: photos that take long to decode, messages of many values."""

from __future__ import annotations

import http.client
import io
import json
import multiprocessing
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Event

import grpc
import httpx
import numpy as np
from PIL import Image

from benchmarks.reliability.asking import camera_text
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import percentile
from benchmarks.reliability.maps import Photo, SampleMaps
from benchmarks.reliability.service_process import Addresses, ServiceProcess, resident_bytes
from visloc_api.v1 import localization_pb2 as pb2

SIDE = 7000  # 49 megapixels, a little below the limit
NEXT_WITHIN_S = 3.0
HEALTHY_WITHIN_S = 0.5
MEMORY_MAY_GROW = 1.2
P90_MAY_GROW = 2.0
_ROUNDS = 3
_HEALTH_PAUSE_S = 0.05
_MEMORY_AFTER_S = 12.0

_Send = Callable[[Addresses], str]


def heavy_photos(maps: SampleMaps, work: Path, deadline_s: float) -> list[Check]:
    """Send photos that take long, give up, and ask for another at once."""
    photo = maps.photos["room"][0]
    checks = []
    with (
        ServiceProcess(maps.folder, work / "service.log") as service,
        httpx.Client(base_url=service.url, timeout=90) as http,
    ):
        alone_s = min(_localized(http, photo, photo.image)[0] for _ in range(5))
        for name, image in _heavy_photos():
            heavy_s, heavy = _localized(http, photo, image, deadline_s)
            next_s, good = _localized(http, photo, photo.image)
            checks.append(
                Check(
                    f"{name}: the next photo within {NEXT_WITHIN_S:g} s and its own time",
                    f"{len(image) / 1000:.0f} kB: {heavy} after {heavy_s:.2f} s; the next: {good} "
                    f"after {next_s:.2f} s (alone {alone_s:.2f} s)",
                    good == "200" and next_s <= NEXT_WITHIN_S + alone_s,
                )
            )
    return checks


def many_values(maps: SampleMaps, work: Path, clients: int) -> list[Check]:
    """Send messages that cost much to parse from several clients at once.

    Meanwhile /healthz is asked, and photos are localized one after the other.
    """
    attackers = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=attackers) as attacking:
        names = attacking.submit(_names).result()
        return [_with_many_values(name, attacking, maps, work, clients) for name in names]


def _with_many_values(
    name: str, attacking: ProcessPoolExecutor, maps: SampleMaps, work: Path, clients: int
) -> Check:
    with (
        ServiceProcess(maps.folder, work / "service.log") as service,
        ThreadPoolExecutor(2) as pool,
    ):
        done, sent = Event(), Event()
        _photo_seconds(service, maps, done, 8)  # memory of a service in use
        alone = _photo_seconds(service, maps, done, 24)
        before = resident_bytes(service.pid)
        health = pool.submit(_longest_health_s, service, done)
        photos = pool.submit(_photo_seconds, service, maps, sent, 10**6)
        answers = attacking.submit(_sent, name, service.addresses, clients).result()
        sent.set()
        beside = photos.result()
        time.sleep(_MEMORY_AFTER_S)
        done.set()
        after, longest_s = resident_bytes(service.pid), health.result()
    p90, quiet = percentile(beside, 0.9), percentile(alone, 0.9)
    return Check(
        f"{clients} clients with {name}: /healthz within {HEALTHY_WITHIN_S:g} s; others' p90 at "
        f"most {P90_MAY_GROW:g} times; memory at most {MEMORY_MAY_GROW - 1:.0%} more",
        f"{counts_text(answers)}; /healthz within {longest_s:.2f} s; p90 {p90:.2f} s, alone "
        f"{quiet:.2f} s: {p90 / quiet:.1f} times ({len(beside)} photos); "
        f"{before / 2**20:.0f} MiB, then {after / 2**20:.0f} MiB",
        longest_s <= HEALTHY_WITHIN_S
        and after <= MEMORY_MAY_GROW * before
        and p90 <= P90_MAY_GROW * quiet,
    )


def _names() -> list[str]:
    return list(many_value_messages())


def _sent(name: str, service: Addresses, clients: int) -> Counter[str]:
    """Send a message from several clients at once; what they were answered."""
    send = many_value_messages()[name]
    with ThreadPoolExecutor(clients) as pool:
        return Counter(pool.map(send, [service] * clients * _ROUNDS))


def heavy_photo_requests(maps: SampleMaps) -> list[_Send]:
    """The heavy photos as requests whose callers wait for half a second."""
    photo = maps.photos["room"][0]

    def sending(image: bytes) -> _Send:
        def send(service: Addresses) -> str:
            with httpx.Client(base_url=service.url, timeout=90) as http:
                return _localized(http, photo, image, 0.5)[1]

        return send

    return [sending(image) for _, image in _heavy_photos()]


def _photo_seconds(
    service: ServiceProcess, maps: SampleMaps, done: Event, most: int
) -> list[float]:
    """Localize photos one after the other, and return the seconds of each."""
    photos, found = maps.photos["room"], list[float]()
    with httpx.Client(base_url=service.url, timeout=90) as http:
        while len(found) < most and not done.is_set():
            photo = photos[len(found) % len(photos)]
            found.append(_localized(http, photo, photo.image)[0])
    return found


def _localized(
    http: httpx.Client, photo: Photo, image: bytes, deadline_s: float = 60.0
) -> tuple[float, str]:
    camera = {"camera": camera_text(photo.camera)} if image is photo.image else {}
    started = time.monotonic()
    response = http.post(
        "/localize",
        data={"map": "room", **camera},
        files={"image": image},
        headers={"X-Request-Timeout": f"{deadline_s:g}"},
    )
    code = "" if response.is_success else f" {response.json()['code']}"
    return time.monotonic() - started, f"{response.status_code}{code}"


def _heavy_photos() -> Iterator[tuple[str, bytes]]:
    for scans in (1500, 200, 20):
        yield f"a progressive JPEG of {scans} scans", progressive_jpeg(SIDE, SIDE, scans)
    blocks = np.random.default_rng(0).integers(0, 256, (SIDE // 10, SIDE // 10, 3), np.uint8)
    noise = Image.fromarray(np.kron(blocks, np.ones((10, 10, 1), np.uint8)))
    for kind, options in (("JPEG", {"quality": 50}), ("WEBP", {"quality": 80, "method": 0})):
        file = io.BytesIO()
        noise.save(file, kind, **options)
        yield f"a {kind} of blocks of noise", file.getvalue()
    file = io.BytesIO()
    Image.new("RGB", (SIDE, SIDE)).save(file, "JPEG")
    head = file.getvalue()
    yield "a JPEG without its pixels", head[: head.index(b"\xff\xda") + 14] + b"\xff\xd9"
    yield "an interlaced PNG of 16 bits", _interlaced_png()
    yield (
        "a JPEG of 5 million segments",
        head[:2] + b"\xff\xfe\0\2" * (5 * 2**20 - 1000) + head[2:300],
    )


def progressive_jpeg(width: int, height: int, scans: int) -> bytes:
    """Return a grey JPEG whose last scan is repeated until there are so many."""
    file = io.BytesIO()
    Image.new("RGB", (width, height), (120, 130, 140)).save(file, "JPEG", progressive=True)
    jpeg = file.getvalue()
    last, end = jpeg.rindex(b"\xff\xda"), jpeg.rindex(b"\xff\xd9")
    more = scans - jpeg.count(b"\xff\xda")
    return jpeg[:end] + jpeg[last:end] * more + jpeg[end:]


def _interlaced_png() -> bytes:
    """A black picture in seven passes, each row of it to be predicted in the slowest way."""
    size = 3 * 2
    rows = []
    for x, y, dx, dy in (
        *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4)),
        *((0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)),
    ):
        width, height = -(-(SIDE - x) // dx), -(-(SIDE - y) // dy)
        rows.append((b"\4" + bytes(width * size)) * height)

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", SIDE, SIDE, 16, 2, 0, 0, 1)
    pixels = zlib.compress(b"".join(rows), 1)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


@cache
def many_value_messages() -> Mapping[str, _Send]:
    """Messages that cost much to parse, by name; all are refused, or name what is no photo."""
    sensor = {"rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [0.1, 0.0, 0.0]}
    transform = pb2.Transform(**sensor)
    sensors = {f"camera{number}": {"cam_from_rig": sensor} for number in range(150_000)}
    rig = json.dumps({"map": "room", "rig": {"sensors": sensors}, "images": []}).encode()
    empty = json.dumps(
        {"map": "room", "rig": {"sensors": {f"{n:x}": {} for n in range(600_000)}}, "images": []}
    ).encode()
    nested = b'{"map":"room","instants":[' + b"[" * 190 + b"]" * 190
    nested += (b"," + b"[" * 190 + b"]" * 190) * 100_000 + b"]}"
    instants = json.dumps(
        {"map": "room", "instants": [{"timestamp": n, "images": []} for n in range(100_000)]}
    ).encode()
    names = b"{" + b",".join(b'"%x":1' % n for n in range(270_000)) + b"}"
    tiles = {"maps": [f"tile{n}" for n in range(10**6)]}
    priors = json.dumps({"map": "room", "image": "", "priors": tiles}).encode()
    readings: dict[str, object] = {"sensorReadings": {"cameraReadings": [{} for _ in range(10**6)]}}
    text = b"A" * (26 * 2**20)
    long = b'{"map":"room","image":"' + text + b'"}'
    instant = b'{"timestamp":0,"images":[{"image":"' + text + b'"},{"image":"' + text + b'"}]}'
    quotes = b'{"map":"' + b'\\"' * (13 * 2**20) + b'"}'
    empty_images = pb2.LocalizeRigRequest()
    empty_images.images.add()
    return {
        "a photo of 27 MB of base64": _by_http("/localize", long),
        "a sequence of 55 MB of base64": _by_http(
            "/localize/sequence", b'{"map":"room","instants":[' + instant + b"]}"
        ),
        "a text of 14 million quotes": _by_http("/localize", quotes),
        "30 million empty photos of a rig over gRPC": _by_grpc(
            empty_images.SerializeToString() * 30_000_000
        ),
        "a rig of 150 000 sensors": _by_http("/localize/rig", rig),
        "a rig of 600 000 empty sensors": _by_http("/localize/rig", empty),
        "lists within lists": _by_http("/localize/sequence", nested),
        "a sequence of 100 000 instants": _by_http("/localize/sequence", instants),
        "the most names that a sequence may have": _by_http("/localize/sequence", names),
        "priors of a million tiles": _by_http("/localize", priors),
        "a million camera readings": _by_http("/geopose", json.dumps(readings).encode()),
        "a rig of 150 000 sensors over gRPC": _by_grpc(
            pb2.LocalizeRigRequest(
                map="room",
                calibration=pb2.RigCalibration(
                    sensors={name: pb2.RigSensor(cam_from_rig=transform) for name in sensors}
                ),
            ).SerializeToString()
        ),
    }


def _by_http(path: str, body: bytes) -> _Send:
    def send(service: Addresses) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", service.http_port, timeout=90)
        try:
            connection.request("POST", path, body, {"Content-Type": "application/json"})
            response = connection.getresponse()
            return f"{response.status} {json.loads(response.read()).get('code', '')}".strip()
        finally:
            connection.close()

    return send


def _by_grpc(message: bytes) -> _Send:
    def send(service: Addresses) -> str:
        with grpc.insecure_channel(service.grpc) as channel:
            # The message as it is: made from an object, each would take its time here.
            call = channel.unary_unary("/visloc.v1.Localization/LocalizeRig", None, None)
            try:
                call(message, timeout=90)
            except grpc.RpcError as error:
                return str(error.code().name)
        return "OK"

    return send


def _longest_health_s(service: ServiceProcess, done: Event) -> float:
    longest_s = 0.0
    while not done.wait(_HEALTH_PAUSE_S):
        started = time.monotonic()
        httpx.get(f"{service.url}/healthz", timeout=90).raise_for_status()
        longest_s = max(longest_s, time.monotonic() - started)
    return longest_s
