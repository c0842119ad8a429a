"""The most work and memory that a byte can cost: ``python -m tests.fuzz.costs --seconds 20``.

For everything that reads strangers' bytes, a search by chance for what takes the longest and what
takes the most memory. Most inputs are a head, a part that is repeated, and a tail; the search
changes these. Photos are small files that say that they are large, and large ones of one colour.
Prints a table in Markdown of the worst inputs that were found, as large as they may be sent.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import multiprocessing
import resource
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

import h11
import numpy as np
from google.protobuf.message import DecodeError
from PIL import Image

from service.api import jobs
from service.grpc.messages import rig_job_of
from service.grpc.reading import reader_of
from service.http.bodies import max_sequence_values, parse_form
from service.settings import ServiceSettings
from tests.fuzz.images import Images
from visloc.archive.packed import unpack_map
from visloc.errors import InvalidInput, MapCorrupt
from visloc.photos.reading import read_photo
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.message import MAX_INSTANT_VALUES
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import BatchLimits, LocalizeRigRequest
from visloc_api.words.sequences import LocalizeSequenceRequest

_TRIED_BYTES = 2**18
_MOST_BYTES = 64 * 2**20
_MAX_ADDRESS_SPACE = 4 * 2**30
_MAX_CPU_S = 300
_SIDE = 7000
SETTINGS = ServiceSettings()
_LIMITS = BatchLimits(SETTINGS.max_rig_images, SETTINGS.max_instants)


@dataclass(frozen=True)
class Input:
    """How an input is made: ``repeated`` as often as there is room for."""

    head: bytes
    repeated: bytes
    tail: bytes

    def of(self, size: int) -> bytes:
        """Return the input with about so many bytes."""
        times = (size - len(self.head) - len(self.tail)) // max(1, len(self.repeated))
        return self.head + self.repeated * max(0, times) + self.tail


@dataclass(frozen=True)
class Parser:
    """Something that reads strangers' bytes.

    Attributes:
        where: it runs: on the event loop, in a thread, or in a worker.
        max_bytes: that it gets at most.
        read: reads them; may refuse them.
        starts: inputs to begin with.
        words: what to put into inputs.
    """

    where: str
    max_bytes: int
    read: Callable[[bytes], object]
    starts: tuple[Input, ...]
    words: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class Cost:
    """What an input costs: seconds of a processor, and bytes of memory at the most."""

    seconds: float
    memory: int


# What an input costs, and its bytes.
Found = tuple[Cost, int]


def cost_of(read: Callable[[bytes], object], data: bytes) -> Cost:
    """Read an input and measure it; what is refused costs as well."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forget the peak so far
    before, started = _memory("VmRSS"), time.process_time()
    with suppress(InvalidInput, MapCorrupt, DecodeError, h11.RemoteProtocolError, MemoryError):
        read(data)
    return Cost(time.process_time() - started, _memory("VmHWM") - before)


def search(parser: Parser, seconds: float, seed: int) -> tuple[Found, Found]:
    """Return the slowest input that was found, and the one of most memory.

    Inputs are tried small; the worst of them in all sizes, as limits refuse some that are large.
    """
    rng, end = Random(seed), time.monotonic() + seconds
    size = min(parser.max_bytes, _TRIED_BYTES)
    kept = [(cost_of(parser.read, each.of(size)), each) for each in parser.starts]
    while time.monotonic() < end:
        changed = _changed(rng.choice(kept)[1], parser.words, rng)
        kept.append((cost_of(parser.read, changed.of(size)), changed))
        slowest = sorted(kept, key=lambda one: -one[0].seconds)[:4]
        kept = slowest + sorted(kept, key=lambda one: -one[0].memory)[:4]
    most, found = min(parser.max_bytes, _MOST_BYTES), list[Found]()
    worst = {one for _, one in kept} | {one for one in parser.starts if one.repeated}
    for one in sorted(worst, key=lambda one: one.repeated):
        sizes = (size, 4 * size, 16 * size, 64 * size, most) if one.repeated else (0,)
        for data in (one.of(min(most, each)) for each in sizes):
            found.append((cost_of(parser.read, data), len(data)))
    return (
        max(found, key=lambda one: one[0].seconds),
        max(found, key=lambda one: one[0].memory),
    )


def _changed(given: Input, words: tuple[bytes, ...], rng: Random) -> Input:
    parts = [given.head, given.repeated, given.tail]
    for _ in range(rng.randint(1, 3)):
        which = rng.randrange(3) if given.repeated else 0
        part = bytearray(parts[which])
        at = rng.randrange(len(part) + 1)
        until = min(len(part), at + rng.choice((0, 0, 1, 4, 16)))
        part[at:until] = rng.choice(words) if words and rng.random() < 0.8 else rng.randbytes(1)
        parts[which] = bytes(part)
    return Input(*parts)


def _memory(name: str) -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise AssertionError(name)


def _photos(kind: str) -> Parser:
    """Photos of one format: those of the fuzzer, and one of one colour of 49 megapixels."""
    file = io.BytesIO()
    options = {"compression": "tiff_lzw"} if kind == "TIFF" else {}
    Image.new("RGB", (_SIDE, _SIDE), (90, 120, 200)).save(file, kind, **options)
    starts = [file.getvalue()]
    signs = {"JPEG": b"\xff\xd8", "PNG": b"\x89PNG", "WEBP": b"RIFF", "TIFF": b"II*\0"}
    for data in Images(Path()).seeds():
        if data.startswith(signs.get(kind, b"none")) or (kind == "AVIF" and b"avif" in data[:32]):
            starts += [data, _said_to_be_large(data)]
    if kind == "JPEG":
        last, end = starts[0].rindex(b"\xff\xda"), starts[0].rindex(b"\xff\xd9")
        starts.append(starts[0][:end] + starts[0][last:end] + starts[0][end:])
    words = tuple(
        struct.pack(code, value)
        for value in (_SIDE, _SIDE // 2, 1)
        for code in (">H", "<H", ">I", "<I")
    )
    made = tuple(Input(data, b"", b"") for data in starts)
    return Parser("in a worker", SETTINGS.max_image_bytes, read_photo, made, words)


def _said_to_be_large(data: bytes) -> bytes:
    """Write 7000 wherever the width and height of the fuzzer's photos stand."""
    for number in (32, 24):
        for code in (">I", "<I", ">H", "<H"):
            data = data.replace(struct.pack(code, number), struct.pack(code, _SIDE))
    return data


def json_parser(read: Callable[[bytes], object], path: bytes, max_bytes: int) -> Parser:
    words = (
        *(b'"', b"\\", b'\\"', b"\\u00e4", b",", b":", b"[", b"]", b"{", b"}", b"{}", b"[]", b"0"),
        *(b"-1e308", b"0.1", b"true", b" ", b"A", b"A" * 500, "ä".encode(), b'"a":0', b'"image":'),
        *(b'"sensor":""', b'"rig":', b'"timestamp":0', b'"options":', b'"priors":', b'"data":""'),
    )
    starts = (
        Input(b'{"map":"room",' + path + b'"', b"A", b'"}'),
        Input(b'{"map":"room",' + path + b'"', b'\\"', b'"}'),
        Input(b'{"map":"room",' + path + b"[", b"{},", b"0]}"),
        Input(b'{"map":"room",' + path + b"[", b"9", b"]}"),
        Input(b"{", b'"a":0,', b'"b":0}'),
    )
    return Parser("in a thread", max_bytes, read, starts, words)


def _unpacked(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.zip"
        file.write_bytes(data)
        unpack_map(file, Path(folder) / "map", 2**28)


def _head_and_body(data: bytes) -> None:
    connection = h11.Connection(h11.SERVER, 16 * 1024)
    for start in range(0, len(data), 2**18):
        connection.receive_data(data[start : start + 2**18])
        while connection.next_event() not in (h11.NEED_DATA, h11.PAUSED):
            pass


def _parsed_form(max_text_bytes: int, data: bytes) -> None:
    parse_form(
        "multipart/form-data; boundary=b",
        data,
        max_parts=32_001,
        max_text_bytes=max_text_bytes,
        text_names=(),
        expected="a form",
    )


def parsers() -> dict[str, Callable[[], Parser]]:
    """Return what reads strangers' bytes, by name."""
    batch, crlf = SETTINGS.max_batch_bytes, b"\r\n"
    most = max_sequence_values(SETTINGS)
    form = b'--b\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n'
    chunked = b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n"
    return {
        **{f"photo: {kind}": lambda kind=kind: _photos(kind) for kind in _KINDS},
        "JSON of a photo, its priors and options": lambda: json_parser(
            lambda data: jobs.photo_job_of(LocalizeRequest.read_json(data)),
            b'"image":',
            SETTINGS.max_json_bytes,
        ),
        "JSON of features": lambda: json_parser(
            lambda data: jobs.photo_job_of(LocalizeRequest.read_json(data)),
            b'"features":{"kind":"sift","keypoints":{"dtype":"float32","shape":[1,2],"data":',
            SETTINGS.max_json_bytes,
        ),
        "JSON of a rig": lambda: json_parser(
            lambda data: jobs.rig_job_of(
                LocalizeRigRequest.read_json(data, _LIMITS, MAX_INSTANT_VALUES), {}
            ),
            b'"images":',
            batch,
        ),
        "JSON of a sequence": lambda: json_parser(
            lambda data: jobs.sequence_jobs_of(
                LocalizeSequenceRequest.read_json(data, _LIMITS, most), {}
            ),
            b'"instants":',
            batch,
        ),
        "multipart": lambda: Parser(
            "in a thread",
            batch,
            partial(_parsed_form, batch),
            (Input(form, b"\r\n-", b"\r\n--b--\r\n"), Input(b"", form + crlf, b"--b--\r\n")),
            (crlf, b"--b", b"-", b"\r", form, b'name="', b";", b"\0", b": "),
        ),
        "protobuf of a rig": lambda: Parser(
            "in a thread",
            batch,
            _read_protobuf,
            (
                Input(b"", b"\x2a\0", b""),
                Input(b"", b"\x12\0", b""),
                Input(b"", b"\x22\2\x0a\0", b""),
            ),
            (*(bytes([each]) for each in range(0, 128, 2)), b"\xff\xff\x03", b"\x22\2\x0a\0"),
        ),
        "HTTP head and chunks": lambda: Parser(
            "on the event loop",
            2**20,
            _head_and_body,
            (Input(chunked, b"1\r\nx\r\n", b""), Input(b"GET / HTTP/1.1\r\n", b"a:b\r\n", crlf)),
            (b"1\r\nx\r\n", b";", b"0", crlf, b"a:", b" ", b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"),
        ),
        "packed map": lambda: Parser(
            "in a thread, key with manage",
            2**22,
            _unpacked,
            (
                Input(b"PK\5\6", b"\0", b""),
                Input(b"", b"PK\1\2" + bytes(42), b"PK\5\6" + bytes(18)),
            ),
            (b"PK\1\2", b"PK\3\4", b"PK\5\6", b"PK\6\6", b"PK\6\7", bytes(8), b"\xff" * 8),
        ),
    }


_KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF")


def _read_protobuf(data: bytes) -> None:
    reader = reader_of(pb2.LocalizeRigRequest.FromString)
    assert reader is not None
    rig_job_of(asyncio.run(reader(data).read()), _LIMITS)


def _in_child(make: Callable[[], Parser], seconds: float, seed: int, answer: Connection) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_ADDRESS_SPACE, _MAX_ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CPU, (_MAX_CPU_S, _MAX_CPU_S))
    np.seterr(all="ignore")
    parser = make()
    answer.send((parser.where, search(parser, seconds, seed)))


def main(parsers: Mapping[str, Callable[[], Parser]]) -> int:
    """Search in a process for each parser, and print a row for it."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--seconds", type=float, default=20.0, help="of search for each parser")
    given.add_argument("--seed", type=int, default=1)
    options = given.parse_args()
    sys.stdout.write(
        "| parser | runs | slowest input: bytes, seconds | most memory: bytes, MiB, times |\n"
        "|---|---|---|---|\n"
    )
    context = multiprocessing.get_context("fork")
    for name, make in parsers.items():
        ours, theirs = context.Pipe(duplex=False)
        child = context.Process(
            target=_in_child, args=(make, options.seconds, options.seed, theirs)
        )
        child.start()
        theirs.close()
        try:
            where, ((slow, slow_bytes), (large, large_bytes)) = ours.recv()
        except EOFError:
            sys.stdout.write(f"| {name} | | its process ended | |\n")
            continue
        finally:
            child.join()
        sys.stdout.write(
            f"| {name} | {where} | {_size(slow_bytes)}, {slow.seconds:.2f} s | "
            f"{_size(large_bytes)}, {large.memory / 2**20:.0f} MiB, "
            f"{large.memory / max(1, large_bytes):.1f} |\n"
        )
        sys.stdout.flush()
    return 0


def _size(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 10**5 else f"{size} bytes"


if __name__ == "__main__":
    sys.exit(main(parsers()))
