"""Two replicas behind the balancer, as real processes: who serves, and what is then lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import grpc
import httpx
import pytest

from benchmarks.reliability.replicas import Balanced, balanced, wait_until
from benchmarks.reliability.service_process import READY_WITHIN_S, ServiceProcess
from clients import Client
from conftest import Query
from service.security.key_file import Scope, edited_keys, new_key
from visloc.archive import MapStore
from visloc.archive.checks import json_text, manifest_hash
from visloc.archive.packed import pack_map
from visloc.errors import Unavailable, VislocError
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1.localization_pb2_grpc import LocalizationStub

pytestmark = pytest.mark.skipif(
    shutil.which("haproxy") is None,
    reason="needs HAProxy; on Debian and Ubuntu `make balancer`, as root, installs it",
)

LOCALIZED = "localized"
EACH = 3  # requests over each door


@pytest.fixture(scope="module")
def pair(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Balanced]:
    """Two replicas that share a folder of maps with the map ``room``."""
    work = tmp_path_factory.mktemp("replicas")
    maps = Path(shutil.copytree(built_maps, work / "maps"))
    with balanced([maps, maps], work) as found:
        yield found


@pytest.fixture
def both(pair: Balanced) -> Balanced:
    """Both of them running, whatever the test before did."""
    for replica in pair.replicas:
        if not replica.is_ready():
            replica.start()
            replica.wait_until_ready()
    pair.wait_until_serving(2)
    return pair


@pytest.fixture
def hall(built_maps: Path, tmp_path: Path) -> Path:
    """Another map, packed."""
    folder = Path(shutil.copytree(MapStore(built_maps).folder("room"), tmp_path / "hall"))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest.update(id="hall", version="v1")
    manifest["manifest_hash"] = manifest_hash(manifest)
    (folder / "manifest.json").write_text(json_text(manifest))
    pack_map(folder, tmp_path / "hall.zip")
    return tmp_path / "hall.zip"


def by_client(pair: Balanced, door: str, query: Query) -> str:
    """What becomes of a photo that our client sends."""
    with Client(getattr(pair, door)) as client:
        try:
            found = client.localize(query.image, "room", query.camera)
        except VislocError as error:
            return error.code
    return LOCALIZED if found.localized else "not localized"


def by_other(pair: Balanced, door: str, query: Query) -> str:
    """What becomes of a photo that a program sends which sends nothing again."""
    headers = {"x-visloc-map": "room"}
    if door == "http":
        photo = {"files": {"image": query.image}, "data": {"map": "room"}, "timeout": 60}
        answer = httpx.post(f"{pair.http}/localize", headers=headers, **photo)  # type: ignore[arg-type]
        return str(answer.json()["status"] if answer.status_code == 200 else answer.status_code)
    target = pair.grpc.removeprefix("grpc://")
    with grpc.insecure_channel(target, (("grpc.enable_retries", 0),)) as channel:
        try:
            request = pb2.LocalizeRequest(map="room", image=query.image)
            call = LocalizationStub(channel).Localize
            return str(call(request, timeout=60, metadata=tuple(headers.items())).status)
        except grpc.RpcError as error:
            return str(error.code().name)


Ask = Callable[[Balanced, str, Query], str]


@contextmanager
def under_way(pair: Balanced, asks: list[Ask], query: Query) -> Iterator[list[list[Future[str]]]]:
    """Requests of callers over both doors that both replicas hold, until they are released."""
    pids = [pid for replica in pair.replicas for pid in replica.worker_pids]
    count = len(asks) * 2 * EACH
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        with ThreadPoolExecutor(count) as pool:
            doors = ["http", "grpc"] * EACH
            asked = [[pool.submit(ask, pair, door, query) for door in doors] for ask in asks]
            wait_until(lambda: sum(map(accepted, pair.replicas)) >= count)
            yield asked
            release(pids)
    finally:
        release(pids)


def release(pids: list[int]) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def accepted(replica: ServiceProcess) -> float:
    """How many requests a replica has accepted and not answered."""
    return measured(replica, "visloc_requests_in_progress") - 1  # the one for the metrics


def measured(replica: ServiceProcess, name: str) -> float:
    lines = httpx.get(f"{replica.url}/metrics").text.splitlines()
    return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(name))


@contextmanager
def load(pair: Balanced, ask: Ask, query: Query) -> Iterator[list[str]]:
    """A caller at each door who asks one after the other; what they were answered."""
    stop, outcomes = threading.Event(), list[str]()

    def run(door: str) -> None:
        while not stop.is_set():
            outcomes.append(ask(pair, door, query))

    threads = [threading.Thread(target=run, args=(door,)) for door in ("http", "grpc")]
    for thread in threads:
        thread.start()
    try:
        wait_until(lambda: len(outcomes) >= 4)
        yield outcomes
        more = len(outcomes) + 4
        wait_until(lambda: len(outcomes) >= more)
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def busiest(pair: Balanced) -> ServiceProcess:
    return max(pair.replicas, key=accepted)


def test_requests_of_a_map_go_to_one_replica(both: Balanced, query: Query) -> None:
    def answered() -> list[float]:
        return [measured(replica, "visloc_localizations_total") for replica in both.replicas]

    before = answered()
    with Client(both.http) as client:
        for _ in range(4):
            assert client.localize(query.image, "room", query.camera).localized
    after = answered()

    assert sorted(b - a for a, b in zip(before, after, strict=True)) == [0, 4]


def test_a_map_that_came_through_one_is_served_by_all(
    both: Balanced, hall: Path, query: Query
) -> None:
    served_by_all(both, hall, query)


def served_by_all(pair: Balanced, hall: Path, query: Query) -> None:
    """A map is asked for everywhere, published through one replica, and then served everywhere."""
    everywhere = [replica.url for replica in pair.replicas]
    everywhere += [f"grpc://{replica.grpc}" for replica in pair.replicas] + [pair.http, pair.grpc]
    first, *_ = everywhere
    for url in everywhere:  # so that each has looked, and found none
        with Client(url) as client, pytest.raises(VislocError) as caught:
            client.localize(query.image, "hall", query.camera)
        assert caught.value.code == "map.unknown"

    with Client(first) as client:
        client.upload_map(hall)
        client.use_version("hall", "v1")
    for url in everywhere:
        with Client(url) as client:
            wait_until(lambda client=client: "hall" in [found.id for found in client.maps()])
            assert client.localize(query.image, "hall", query.camera).localized


def test_a_replica_that_is_stopped_loses_nothing(both: Balanced, query: Query) -> None:
    with load(both, by_other, query) as outcomes:
        with under_way(both, [by_other], query) as (asked,):
            stopped = busiest(both)
            held = accepted(stopped)
            os.kill(stopped.pid, signal.SIGTERM)
        assert held > 0
        assert [each.result() for each in asked] == [LOCALIZED] * 2 * EACH
        stopped.stop()  # which waits for its end

    assert set(outcomes) == {LOCALIZED}


def test_a_replica_that_is_killed_is_not_missed(both: Balanced, query: Query) -> None:
    with load(both, by_client, query) as outcomes:
        with under_way(both, [by_client, by_other], query) as (ours, others):
            killed = busiest(both)
            assert accepted(killed) > 0
            killed.kill()
        assert [each.result() for each in ours] == [LOCALIZED] * 2 * EACH
        # They are told, and send it again themselves or not.
        assert {each.result() for each in others} <= {LOCALIZED, "502", "UNAVAILABLE"}

    assert set(outcomes) == {LOCALIZED}


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_a_photo_that_ends_a_worker_does_not_go_to_the_next(
    both: Balanced, door: str, query: Query
) -> None:
    # A worker that was idle may be asked just then whether it lives: that is not the photo's end.
    found = (ended(both, door, query) for _ in range(5))

    assert next(each for each in found if each != LOCALIZED) == "server.worker_died"


def ended(pair: Balanced, door: str, query: Query) -> str:
    """What becomes of a photo whose worker is killed while all others sleep."""
    assert by_client(pair, door, query) == LOCALIZED
    pids = [pid for replica in pair.replicas for pid in replica.worker_pids]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(by_client, pair, door, query)
            wait_until(lambda: sum(map(accepted, pair.replicas)) == 1)
            (its_worker,) = busiest(pair).worker_pids
            wait_until(lambda: measured(busiest(pair), "visloc_photos_running") == 1)
            os.kill(its_worker, signal.SIGKILL)
            # A second attempt elsewhere would wait for a worker that sleeps.
            return asked.result(READY_WITHIN_S)
    finally:
        release(pids)


def test_without_a_replica_callers_are_told(both: Balanced, query: Query) -> None:
    for replica in both.replicas:
        replica.kill()
    both.wait_until_serving(0)

    for url in (both.http, both.grpc):
        with Client(url) as client, pytest.raises(Unavailable):
            client.localize(query.image, "room", query.camera)


def test_the_log_of_a_replica_names_the_caller_of_the_balancer(tmp_path: Path) -> None:
    """The balancer, at 127.0.0.1, is trusted; what callers say of themselves is not."""
    (tmp_path / "maps").mkdir()
    with edited_keys(tmp_path / "keys.json") as keys:
        key, token = new_key("phones", frozenset({Scope.LOCALIZE}))
        keys.append(key)
    settings = {"keys_file": tmp_path / "keys.json", "trusted_proxies": "127.0.0.1"}
    sent = {"authorization": f"Bearer {token}", "x-forwarded-for": "198.51.100.1"}
    with balanced([tmp_path / "maps"], tmp_path, **settings) as one:
        http, target = (url.replace("127.0.0.1", "[::1]") for url in (one.http, one.grpc))
        assert httpx.get(f"{http}/maps", headers=sent).status_code == 403
        with grpc.insecure_channel(target.removeprefix("grpc://")) as channel:
            with pytest.raises(grpc.RpcError) as refused:
                LocalizationStub(channel).ListMaps(
                    pb2.ListMapsRequest(), metadata=tuple(sent.items())
                )
            assert refused.value.code() is grpc.StatusCode.PERMISSION_DENIED
        # Past the balancer, from an address that is no proxy's.
        with httpx.Client(transport=httpx.HTTPTransport(local_address="127.0.0.9")) as direct:
            assert direct.get(f"{one.replicas[0].url}/maps", headers=sent).status_code == 403
        log = one.replicas[0].log
        wait_until(lambda: log.read_text().count("access.scope") == 3)
        lines = [json.loads(line) for line in log.read_text().splitlines()]
    refusals = [line for line in lines if line.get("code") == "access.scope"]
    assert [line["peer"] for line in refusals] == ["::1", "::1", "127.0.0.9"]
    assert [line["route"] for line in refusals] == ["GET /maps", "ListMaps", "GET /maps"]
    assert {line["key"] for line in refusals} == {"phones"}
