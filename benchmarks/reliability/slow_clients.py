"""Clients that send one byte per second, beside one that does not."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from benchmarks.reliability.asking import Doors, good_cases
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import Asked, ask_in_turn, percentile
from benchmarks.reliability.maps import SampleMaps
from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.reliability.soak import unloaded_answers

KINDS = ("quiet", "heads", "bodies", "gRPC")
# Of gRPC's connections: the preface of HTTP/2.
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_PATHS = {"heads": "a head", "bodies": "a body", "gRPC": "the preface of HTTP/2, to gRPC"}


async def slow_clients(
    maps: SampleMaps, work: Path, connections: int, seconds: float, rounds: int
) -> list[Check]:
    """Measure one client in turns of so many seconds: alone, and beside slow ones of every kind.

    Turns, so that whatever else the machine does meets all of them alike.
    """
    cases = [case for case in good_cases(maps) if " photo " in case.name and "two" not in case.name]
    found: dict[str, list[Asked]] = {kind: [] for kind in KINDS}
    closings = {kind: Counter[str]() for kind in KINDS}
    with ServiceProcess(maps.folder, work / "service.log") as service:
        async with Doors(service) as doors:
            expected = await unloaded_answers(doors, maps, cases)
            await ask_in_turn(doors, cases, 1, 3)
            for number in range(rounds):
                for kind in KINDS:
                    slow = [
                        asyncio.create_task(_slow_client(service, kind, closings[kind]))
                        for _ in range(connections if kind != "quiet" else 0)
                    ]
                    await asyncio.sleep(1)
                    # The same requests in every turn of a round.
                    found[kind] += await ask_in_turn(doors, cases, 1, seconds, seed=number)
                    for task in slow:
                        task.cancel()
                    await asyncio.gather(*slow, return_exceptions=True)
    quiet = _p90(found["quiet"])
    every = [one for asked in found.values() for one in asked]
    wrong = [o for o in every if (o.outcome.status, o.outcome.body) not in expected[o.case.name]]
    return [
        *(
            Check(
                f"{connections} connections that send {what}: others' p90 less than doubles",
                f"p90 {_p90(found[kind]) * 1e3:.0f} ms, alone {quiet * 1e3:.0f} ms: "
                f"{_p90(found[kind]) / quiet:.2f} times, {len(found[kind])} and "
                f"{len(found['quiet'])} answers; slow ones: {counts_text(closings[kind])}",
                _p90(found[kind]) < 2 * quiet,
            )
            for kind, what in _PATHS.items()
        ),
        Check(
            "the other client is answered as ever",
            f"{len(every) - len(wrong)} of {len(every)} equal",
            not wrong,
        ),
    ]


def _p90(asked: Sequence[Asked]) -> float:
    return percentile([one.outcome.seconds for one in asked], 0.9)


async def _slow_client(service: ServiceProcess, kind: str, closings: Counter[str]) -> None:
    """Connect, send a byte every second, and connect again when the server has had enough."""
    host = f"Host: 127.0.0.1:{service.http_port}\r\n"
    port = service.grpc_port if kind == "gRPC" else service.http_port
    head = f"POST /localize HTTP/1.1\r\n{host}Content-Type: application/json\r\n"
    body = f"{head}Content-Length: 100000\r\n\r\n".encode()
    at_once, slowly = {
        "heads": (b"", f"{head}X-Slow: {'a' * 100_000}".encode()),
        "bodies": (body, b" " * 100_000),
        "gRPC": (b"", _PREFACE),
    }[kind]
    while True:
        with suppress(OSError):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            closings["connected"] += 1
            try:
                said = await _send_slowly(reader, writer, at_once, slowly)
                closings[said] += 1
            finally:
                writer.close()
        await asyncio.sleep(1)


async def _send_slowly(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, at_once: bytes, slowly: bytes
) -> str:
    writer.write(at_once)
    # gRPC says hello at once; HTTP answers when it has had enough.
    answer = asyncio.ensure_future(reader.read(-1 if slowly == _PREFACE else 65536))
    for byte in slowly:
        writer.write(bytes([byte]))
        with suppress(ConnectionError):
            await writer.drain()
        done, _ = await asyncio.wait({answer}, timeout=1)
        if done:
            break
    try:
        said = await answer
    except ConnectionError:
        return "closed"
    finally:
        answer.cancel()
    return f"told {said.split(b' ', 2)[1].decode()}" if said.startswith(b"HTTP/") else "closed"
