"""Maps in S3, and S3 away: killed, so that it refuses connections, or silent, so that they hang."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import boto3  # type: ignore[import-untyped]
import httpx

from benchmarks.reliability.asking import Case, Doors, good_cases
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import Asked, ask_in_turn, percentile
from benchmarks.reliability.maps import SampleMaps, verify_store
from benchmarks.reliability.s3_server import ACCOUNT, BUCKET
from benchmarks.reliability.service_process import ServiceProcess, free_port
from benchmarks.reliability.soak import Expected, differing, unloaded_answers
from visloc.archive import MapStore

STORAGE_AWAY = "503 maps.storage_away"
BACK_WITHIN_S = 15.0
# A request that needs the storage may wait for its timeouts, which are tried several times.
TOLD_WITHIN_S = 30.0
QUIET_S = 15.0


class S3Process:
    """The server in a process of its own, on a port that stays the same."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._port = free_port()
        self.url = f"http://127.0.0.1:{self._port}"

    def start(self) -> None:
        """Begin, and wait until it answers.

        Raises:
            RuntimeError: when it does not.
        """
        words = ("-m", "benchmarks.reliability.s3_server", str(self._folder), str(self._port))
        self._process = subprocess.Popen(
            [sys.executable, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        end = time.monotonic() + 60
        while time.monotonic() < end:
            with suppress(httpx.TransportError):
                httpx.get(self.url, timeout=5)
                return
            time.sleep(0.1)
        raise RuntimeError("the S3 server does not come up")

    def kill(self) -> None:
        """End it at once."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def freeze(self) -> None:
        """Let it accept connections and say nothing."""
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGCONT)

    def fetch(self, folder: Path) -> None:
        """Write all that it has into an empty folder, without the help of the service."""
        bucket = boto3.resource(
            "s3",
            endpoint_url=self.url,
            aws_access_key_id=ACCOUNT["AWS_ACCESS_KEY_ID"],
            aws_secret_access_key=ACCOUNT["AWS_SECRET_ACCESS_KEY"],
            region_name=ACCOUNT["AWS_DEFAULT_REGION"],
        ).Bucket(BUCKET)
        for entry in bucket.objects.all():
            path = folder / entry.key
            path.parent.mkdir(parents=True, exist_ok=True)
            bucket.download_file(entry.key, str(path))


@dataclass(frozen=True)
class _World:
    """What a test has.

    Attributes:
        maps: of which ``room`` lacks its last version, in the storage too.
        coming: that version.
        cases: that are asked.
        expected: their unloaded answers.
        quiet: answers while the storage was there.
    """

    maps: SampleMaps
    coming: str
    cases: Sequence[Case]
    expected: Expected
    quiet: Sequence[Asked]


async def s3_away(every: SampleMaps, work: Path, seconds: float) -> list[Check]:
    """Take the storage away twice, for so many seconds each, while clients ask."""
    first, coming = every.versions["room"]
    store = MapStore(every.folder)
    store.set_current("room", first)
    store.remove("room", coming)
    maps = replace(every, versions={**every.versions, "room": [first]})
    s3 = S3Process(maps.folder)
    s3.start()
    service = ServiceProcess(
        f"s3://{BUCKET}",
        work / "service.log",
        environment={**ACCOUNT, "AWS_ENDPOINT_URL": s3.url},
        cache_dir=work / "cache",
    )
    cases = good_cases(maps)
    try:
        with service:
            async with Doors(service.addresses) as doors:
                expected = await unloaded_answers(doors, maps, cases)
                quiet = await ask_in_turn(doors, cases, 2, QUIET_S)
                world = _World(maps, coming, cases, expected, quiet)
                return [
                    *await _killed(world, s3, service, doors, seconds),
                    *await _silent(world, s3, service, doors, seconds),
                ]
    finally:
        s3.thaw()
        s3.kill()


async def _killed(
    world: _World, s3: S3Process, service: ServiceProcess, doors: Doors, seconds: float
) -> list[Check]:
    name = f"S3 killed for {seconds:g} s"
    s3.kill()
    checks = await _while_away(name, world, service, doors, seconds / 2)
    # Also a service that has only its copies comes up.
    service.kill()
    started = time.monotonic()
    service.start()
    await asyncio.to_thread(service.wait_until_ready)
    while (await world.cases[0].ask(doors)).status != "200":
        await asyncio.sleep(0.1)
    restarted_s = time.monotonic() - started
    again = await _while_away(f"{name}, service started anew", world, service, doors, seconds / 2)
    await asyncio.to_thread(s3.start)
    return [
        *checks,
        Check(
            f"{name}: a service that is started meanwhile serves the copies that it has",
            f"a pose after {restarted_s:.1f} s",
            restarted_s < BACK_WITHIN_S,
        ),
        *again,
        *await _when_back(name, world, s3, doors),
    ]


async def _silent(
    world: _World, s3: S3Process, service: ServiceProcess, doors: Doors, seconds: float
) -> list[Check]:
    name = f"S3 silent for {seconds:g} s"
    s3.freeze()
    checks = await _while_away(name, world, service, doors, seconds)
    s3.thaw()
    return [*checks, *await _when_back(name, world, s3, doors)]


async def _while_away(
    name: str, world: _World, service: ServiceProcess, doors: Doors, seconds: float
) -> list[Check]:
    asking = asyncio.create_task(ask_in_turn(doors, world.cases, 2, seconds))
    told = await _ask_for_changes(doors, world)
    asked = await asking
    ready = service.is_ready()
    wrong = differing(asked, world.expected)
    before = percentile([one.outcome.seconds for one in world.quiet], 0.9)
    during = percentile([one.outcome.seconds for one in asked], 0.9)
    statuses = Counter(status for status, _ in told)
    longest = max(took for _, took in told)
    return [
        Check(
            f"{name}: loaded maps go on, answers as unloaded, /readyz good",
            f"{len(asked) - len(wrong)} of {len(asked)} equal, p90 {during:.2f} s "
            f"(before {before:.2f} s), {'ready' if ready else 'not ready'}"
            + "".join(f"; {one.case.name}: {one.outcome.status}" for one in wrong[:3]),
            bool(asked) and not wrong and ready,
        ),
        Check(
            f"{name}: what needs it is refused clearly, within {TOLD_WITHIN_S:g} s",
            f"{counts_text(statuses)}, within {longest:.1f} s",
            set(statuses) == {STORAGE_AWAY} and longest < TOLD_WITHIN_S,
        ),
    ]


async def _when_back(name: str, world: _World, s3: S3Process, doors: Doors) -> list[Check]:
    started = time.monotonic()
    while (put := await _put(doors, world))[0] == STORAGE_AWAY:
        await asyncio.sleep(0.2)
    back_s = time.monotonic() - started
    folder = world.maps.folder.with_name("fetched")
    await asyncio.to_thread(s3.fetch, folder)
    versions = await asyncio.to_thread(verify_store, folder)
    shutil.rmtree(folder)
    gone = await doors.http.delete(f"/maps/room/versions/{world.coming}")
    expected = sum(map(len, world.maps.versions.values())) + 1
    return [
        Check(
            f"{name}: back, an upload succeeds within {BACK_WITHIN_S:g} s, and can be deleted",
            f"{put[0]} after {back_s:.1f} s, {gone.status_code}",
            put[0] == "201" and back_s < BACK_WITHIN_S and gone.status_code == 204,
        ),
        Check(
            f"{name}: nothing in the storage is lost or torn",
            f"{versions} of {expected} versions fetched and read byte by byte",
            versions == expected,
        ),
    ]


async def _ask_for_changes(doors: Doors, world: _World) -> list[tuple[str, float]]:
    """Ask for what needs the storage; status and seconds of each."""
    older, _ = world.maps.versions["hall"]
    return [
        await _put(doors, world),
        await _told(doors, "POST", "/maps/hall/current", json={"version": older}),
        await _told(doors, "DELETE", f"/maps/hall/versions/{older}"),
    ]


async def _put(doors: Doors, world: _World) -> tuple[str, float]:
    return await _told(
        doors,
        "PUT",
        f"/maps/room/versions/{world.coming}",
        content=world.maps.packed.read_bytes(),
        headers={"Content-Type": "application/zip"},
    )


async def _told(doors: Doors, method: str, path: str, **given: object) -> tuple[str, float]:
    started = time.monotonic()
    response = await doors.http.request(method, path, **given)  # type: ignore[arg-type]
    code = response.json().get("code", "") if response.is_error else ""
    return f"{response.status_code} {code}".strip(), time.monotonic() - started
