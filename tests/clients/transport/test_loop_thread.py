"""The client that waits: its event loop runs in a thread that callers do not see."""

from __future__ import annotations

import asyncio
import gc
import inspect
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from clients import AsyncClient, Client, Instant, RigImage
from clients.transport.loop_thread import LoopThread


def client_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "visloc-client"]


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    yield
    gc.collect()
    for thread in client_threads():
        thread.join(5)
    assert not client_threads()


def instants(count: int) -> Iterator[Instant]:
    for timestamp in range(count):
        yield Instant(timestamp, (RigImage("camera", b"photo"),))


def test_both_clients_have_the_same_methods() -> None:
    def methods(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert methods(Client) == methods(AsyncClient)
    for name in methods(Client) - {"close"}:
        waiting, asynchronous = getattr(Client, name), getattr(AsyncClient, name)
        assert inspect.signature(waiting) == inspect.signature(asynchronous)
        assert waiting.__doc__ == asynchronous.__doc__


def test_it_works_where_an_event_loop_runs(url: str) -> None:
    async def cell_of_a_notebook() -> tuple[bool, int]:
        with Client(url) as client:
            answers = client.localize_sequence(instants(2), "room", time_unit="ms")
            return client.localize(b"photo", "room").localized, len(list(answers))

    assert asyncio.run(cell_of_a_notebook()) == (True, 2)


def test_threads_share_a_client_and_wait_at_the_same_time(url: str, service: Any) -> None:
    together = threading.Barrier(4)
    localize = service.localize

    def meet(*given: Any) -> Any:
        together.wait(5)  # breaks when the requests come one after the other
        return localize(*given)

    service.localize = meet
    with Client(url) as client, ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: client.localize(b"photo", "room"), range(4)))
    del service.localize

    assert all(answer.localized for answer in answers)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_ends_a_waiting_call_and_the_client_goes_on(url: str, service: Any) -> None:
    has_arrived, may_answer = threading.Event(), threading.Event()
    localize = service.localize

    def wait(*given: Any) -> Any:
        has_arrived.set()
        may_answer.wait(10)
        return localize(*given)

    def interrupt() -> None:
        has_arrived.wait(10)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    service.localize = wait
    thread = threading.Thread(target=interrupt)
    thread.start()
    with Client(url) as client:
        with pytest.raises(KeyboardInterrupt):
            client.localize(b"photo", "room")
        assert not may_answer.is_set()
        del service.localize
        assert client.localize(b"photo", "room").localized
    may_answer.set()
    thread.join()


def test_a_closed_client_refuses_calls(url: str) -> None:
    client = Client(url)
    client.ready()
    client.close()
    client.close()
    for _ in range(2):
        with pytest.raises(RuntimeError, match="the client is closed"):
            client.ready()


def test_closing_ends_calls_that_wait(url: str, service: Any) -> None:
    has_arrived, may_answer = threading.Event(), threading.Event()
    localize = service.localize

    def wait(*given: Any) -> Any:
        has_arrived.set()
        may_answer.wait(10)
        return localize(*given)

    service.localize = wait
    client = Client(url)
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(client.localize, b"photo", "room")
        assert has_arrived.wait(10)
        client.close()
        with pytest.raises(Exception, match=r"closed|server\.unreachable|reached"):
            call.result(10)
    may_answer.set()
    del service.localize


def test_a_client_that_nobody_closes_leaves_no_thread(url: str) -> None:
    client = Client(url)
    client.ready()
    assert client_threads()
    del client  # the fixture waits for the thread


def test_a_sequence_that_is_left_ends_also_without_being_closed(url: str) -> None:
    with Client(url) as client:
        answers = client.localize_sequence(instants(50), "room", time_unit="ms")
        assert next(answers).timestamp == 0
        del answers
        assert client.ready()
        kept = client.localize_sequence(instants(50), "room", time_unit="ms")
        next(kept)
    with pytest.raises(RuntimeError, match="closed"):
        next(kept)


def test_a_callback_in_the_loop_is_told_that_it_would_wait_for_itself() -> None:
    class Calling:
        async def close(self) -> None:
            pass

        async def call_back(self) -> None:
            thread.run(Calling.call_back)

    thread = LoopThread(Calling)
    with pytest.raises(RuntimeError, match="its own callback"):
        thread.run(Calling.call_back)
    thread.close()


def is_ready(client: Client, answers: Any) -> None:
    try:
        answers.put(client.ready())
    except RuntimeError as error:
        answers.put(str(error))


@pytest.mark.parametrize("is_used_before", [False, True])
def test_a_forked_process_has_a_thread_of_its_own(http_url: str, is_used_before: bool) -> None:
    context = multiprocessing.get_context("fork")
    with Client(http_url) as client:
        if is_used_before:
            client.ready()
        answers: Any = context.SimpleQueue()
        process = context.Process(target=is_ready, args=(client, answers))
        process.start()
        process.join(20)
        assert process.exitcode == 0
        assert answers.get() is True
        assert client.ready()


def test_grpc_refuses_to_be_used_in_a_forked_process(grpc_url: str) -> None:
    context = multiprocessing.get_context("fork")
    with Client(grpc_url) as client:
        client.ready()
        answers: Any = context.SimpleQueue()
        process = context.Process(target=is_ready, args=(client, answers))
        process.start()
        process.join(20)
        assert process.exitcode == 0
        assert "forked" in answers.get()
        assert client.ready()


def test_a_process_ends_with_an_open_client(url: str) -> None:
    code = (
        "import sys\nfrom clients import Client\n"
        f"client = Client({url!r})\nprint(client.ready())\n"
        "kept = client  # known to the module until the interpreter is gone\n"
    )
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "True\n", "")


def test_a_process_ends_although_the_next_instant_never_comes(grpc_url: str) -> None:
    code = (
        "import threading\nfrom clients import Client, Instant, RigImage\n"
        "def instants():\n"
        "    yield Instant(1, (RigImage('camera', b'photo'),))\n"
        "    threading.Event().wait()\n"
        f"with Client({grpc_url!r}) as client:\n"
        "    for answer in client.localize_sequence(instants(), 'room', time_unit='ms'):\n"
        "        print(answer.timestamp)\n"
        "        break\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "1\n", "")


def test_iterables_of_callers_are_read_in_their_thread(http_url: str, grpc_url: str) -> None:
    readers: list[threading.Thread] = []

    def noted(items: Iterator[Any]) -> Iterator[Any]:
        for item in items:
            readers.append(threading.current_thread())
            yield item

    with Client(http_url) as client:
        assert len(list(client.localize_sequence(noted(instants(3)), "room", time_unit="ms"))) == 3
    for url in (http_url, grpc_url):
        with Client(url) as client:
            images = (RigImage(name, b"photo") for name in ("left", "right"))
            assert client.localize_rig(noted(images), "room", "stereo").localized
    assert readers == [threading.main_thread()] * 7


def test_an_iterable_that_exits_leaves_the_client_usable(url: str) -> None:
    def images() -> Iterator[RigImage]:
        yield RigImage("left", b"photo")
        raise SystemExit(7)

    def walk() -> Iterator[Instant]:
        yield from instants(1)
        raise SystemExit(7)

    with Client(url) as client:
        with pytest.raises(SystemExit, match="7"):
            client.localize_rig(images(), "room", "stereo")
        with pytest.raises((SystemExit, RuntimeError), match=r"7|SystemExit"):
            list(client.localize_sequence(walk(), "room", time_unit="ms"))
        assert client.localize(b"photo", "room").localized


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_an_interrupt_ends_the_reading_of_a_file_that_never_comes(url: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "photo.jpg")
    code = (
        "import os, signal, sys, threading\n"
        "from clients import Client\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "with Client(sys.argv[1]) as client:\n"
        "    client.localize(sys.argv[2], 'room')\n"
    )
    command = [sys.executable, "-c", code, url, str(tmp_path / "photo.jpg")]
    done = subprocess.run(command, timeout=20, capture_output=True, check=False)
    assert b"KeyboardInterrupt" in done.stderr
