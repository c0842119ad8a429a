"""Requests whose end is missing: refused, or they mean the same."""

from __future__ import annotations

import io
import json
import socket
import struct
from collections.abc import Callable
from typing import Any

import pytest
from PIL import Image

from service.http.openapi import example
from tests.service.conftest import Doors
from visloc.errors import InvalidInput
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.maps import UseVersionRequest
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import LocalizeRigRequest
from visloc_api.words.sequences import LocalizeSequenceRequest

BOUNDARY = "----cut"


def shortened(value: Any) -> Any:
    """Return JSON with texts of at most some characters, such as the base64 of photos."""
    if isinstance(value, dict):
        return {name: shortened(each) for name, each in value.items()}
    if isinstance(value, list):
        return [shortened(each) for each in value]
    return value[:200] if isinstance(value, str) else value


@pytest.mark.parametrize(
    ("read", "request_"),
    [
        (LocalizeRequest.read_json, example("localize_request")),
        (LocalizeRequest.read_json, example("features_request")),
        (LocalizeRigRequest.read_json, example("rig_request")),
        (LocalizeSequenceRequest.read_json, example("sequence_request")),
        (UseVersionRequest.read_json, {"version": "1"}),
    ],
)
def test_json_cut_at_any_byte_is_refused(read: Callable[[bytes], Any], request_: Any) -> None:
    text = json.dumps(shortened(request_)).encode()
    read(text + b"\r\n")
    for length in range(len(text)):
        with pytest.raises(InvalidInput) as caught:
            read(text[:length])
        assert caught.value.code == "request.malformed"


# Over sockets


def photo() -> bytes:
    buffer = io.BytesIO()
    Image.new("L", (40, 30)).save(buffer, "PNG")
    return buffer.getvalue()


def form() -> bytes:
    """Write a photo whose last part makes another request of it."""
    head = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="%s"\r\n\r\n'
    parts = [
        (head % "map").encode() + b"room",
        (head % 'image"; filename="a.png').encode() + photo(),
        (head % "camera").encode() + b"PINHOLE,40,30,40,40,20,15",
    ]
    return b"\r\n".join((*parts, f"--{BOUNDARY}--\r\n".encode()))


def posted(doors: Doors, body: bytes, framing: str, *, ends: bool = False) -> bytes:
    """Send a form, close our half of the connection if it ends there, and return the answer."""
    head = (
        f"POST /localize HTTP/1.1\r\nHost: localhost\r\n{framing}\r\nConnection: close\r\n"
        f"Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", doors.server.http_port), timeout=30) as connection:
        connection.sendall(head.encode() + body)
        if ends:
            connection.shutdown(socket.SHUT_WR)
        answer = b""
        while part := connection.recv(65536):
            answer += part
    return answer


@pytest.mark.parametrize("cut", [1, 2, 3, 4, 5, 12, 30, 60, 120, 200])
def test_form_cut_on_the_way_is_answered_as_the_whole_or_refused(cut: int, doors: Doors) -> None:
    body = form()
    left = body[:-cut]
    chunk = b"%x\r\n%b\r\n" % (len(left), left)

    whole = posted(doors, body, f"Content-Length: {len(body)}")
    declared_shorter = posted(doors, left, f"Content-Length: {len(left)}")
    chunked = posted(doors, chunk + b"0\r\n\r\n", "Transfer-Encoding: chunked")

    assert whole.startswith(b"HTTP/1.1 200 ")
    assert b'"source":"given"' in whole
    status = b"HTTP/1.1 200 " if cut <= len("\r\n") else b"HTTP/1.1 422 "
    for answer in (declared_shorter, chunked):
        assert answer.startswith(status)
        assert (b'"source":"given"' if cut <= len("\r\n") else b"request.malformed") in answer


@pytest.mark.parametrize("cut", [1, 30])
def test_body_that_ends_before_its_framing_says_has_no_answer(cut: int, doors: Doors) -> None:
    left = form()[:-cut]
    chunk = b"%x\r\n%b\r\n" % (len(left), left)

    assert posted(doors, left, f"Content-Length: {len(left) + cut}", ends=True) == b""
    assert posted(doors, chunk, "Transfer-Encoding: chunked", ends=True) == b""


def frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    """Return a frame of HTTP/2 (RFC 9113, 4.1)."""
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def literal(text: str) -> bytes:
    """Return a text of at most 126 bytes as HPACK has it (RFC 7541, 5.2)."""
    return bytes([len(text)]) + text.encode()


def called(doors: Doors, method: str, data: bytes) -> tuple[int, bytes]:
    """Send bytes as the messages of a call, end the stream, and return answers and trailers."""
    fields = {
        ":method": "POST",
        ":scheme": "http",
        ":path": f"/visloc.v1.Localization/{method}",
        ":authority": "localhost",
        "content-type": "application/grpc",
        "te": "trailers",
    }
    head = b"".join(b"\0" + literal(name) + literal(value) for name, value in fields.items())
    with socket.create_connection(("127.0.0.1", doors.server.grpc_port), timeout=30) as connection:
        connection.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame(4, 0, 0))
        connection.sendall(frame(1, 4, 1, head) + frame(0, 1, 1, data))
        stream = connection.makefile("rb")
        received = b""
        while True:
            size, kind, flags, _ = struct.unpack(">IBBI", b"\0" + stream.read(9))
            payload = stream.read(size)
            received += payload if kind == 0 else b""
            if kind == 1 and flags & 1:  # headers that end the stream
                break
    answers = 0
    while received:
        received = received[5 + int.from_bytes(received[1:5]) :]
        answers += 1
    return answers, payload


def framed(message: Any) -> bytes:
    data: bytes = message.SerializeToString()
    return struct.pack(">BI", 0, len(data)) + data


CAMERA = pb2.Camera(model="PINHOLE", width=40, height=30, params=[40, 40, 20, 15])
OK = b"\x0bgrpc-status\x010"


def test_message_cut_on_the_way_is_no_call(doors: Doors) -> None:
    data = framed(pb2.LocalizeRequest(map="room", image=photo(), camera=CAMERA))

    answers, trailers = called(doors, "Localize", data)
    assert (answers, OK in trailers) == (1, True)
    for length in range(0, len(data), 16):
        answers, trailers = called(doors, "Localize", data[:length])
        assert (answers, OK in trailers) == (0, False), length


@pytest.mark.parametrize("cut", [0, 1, 20, 50, 100])
def test_instant_cut_on_the_way_has_no_answer(cut: int, doors: Doors) -> None:
    """So a client counts: a stream that ends between two messages is whole."""
    image = pb2.RigImage(image=photo(), camera=CAMERA)
    message = pb2.LocalizeSequenceRequest
    data = framed(message(start=pb2.SequenceStart(map="room", time_unit="s")))
    for second in range(3):
        data += framed(message(instant=pb2.Instant(timestamp=second, images=[image])))

    answers, trailers = called(doors, "LocalizeSequence", data[: len(data) - cut])

    assert (answers, OK in trailers) == (2 if cut else 3, True)
