from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest

from service.server import Server, _listen
from service.settings import ServiceSettings, SettingsError
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1.localization_pb2_grpc import LocalizationStub

READY = re.compile(r"ready: http://127\.0\.0\.1:(\d+) grpc://127\.0\.0\.1:(\d+), maps: (.*)")


def test_main_sets_thread_counts_before_the_libraries_that_read_them_are_loaded() -> None:
    program = "import service.__main__, sys; print({'numpy', 'cv2', 'torch'} & sys.modules.keys())"

    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )

    assert done.stdout == "set()\n"


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    environment = {name: value for name, value in os.environ.items() if "VISLOC" not in name}
    process = subprocess.Popen(
        [sys.executable, "-m", "service", "--workers=1", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def test_who_comes_just_after_sigterm_is_told_that_the_server_stops(built_maps: Path) -> None:
    """Until nobody listens any more, there is an answer to every request."""
    arguments = ["--maps-dir", str(built_maps), "--http-port=0", "--grpc-port=0"]
    with started(*arguments) as process:
        assert process.stderr is not None
        ready = next(found for line in process.stderr if (found := READY.search(line)))
        url = f"http://127.0.0.1:{ready[1]}/localize"
        told: list[str] = []

        def ask_for_ever(client: httpx.Client) -> None:
            while True:
                answer = client.post(url, files={"image": b"x"}, data={"map": "room"})
                told.append(answer.json()["code"])

        # A minute, so that a busy machine may be slow; a request that nobody answers still fails.
        none_kept = httpx.Limits(max_keepalive_connections=0)
        with httpx.Client(limits=none_kept, timeout=60) as client:
            process.send_signal(signal.SIGTERM)
            with pytest.raises(httpx.ConnectError):  # refused, not reset
                ask_for_ever(client)
        assert process.wait(30) == 0
    # The others came before the signal arrived.
    assert (
        {"server.stopping"} <= set(told) <= {"server.stopping", "image.undecodable", "image.format"}
    )


def test_the_command_says_when_it_is_ready_answers_on_both_doors_and_ends_on_sigterm(
    built_maps: Path,
) -> None:
    arguments = ["--maps-dir", str(built_maps), "--http-port=0", "--grpc-port=0"]
    with started(*arguments) as process:
        assert process.stderr is not None
        ready = next(found for line in process.stderr if (found := READY.search(line)))
        http_port, grpc_port, maps = ready.groups()
        assert maps.startswith("room@")
        assert httpx.get(f"http://127.0.0.1:{http_port}/readyz").status_code == 200
        with grpc.insecure_channel(f"127.0.0.1:{grpc_port}") as channel:
            listed = LocalizationStub(channel).ListMaps(pb2.ListMapsRequest())
        assert [info.id for info in listed.maps] == ["room"]

        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
        assert "Traceback" not in process.stderr.read()


def test_the_main_process_loads_none_of_what_only_workers_need() -> None:
    code = "import sys, service.server; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    of_workers = {
        *("torch", "openvino", "pycolmap", "poselib", "cv2", "PIL", "scipy", "faiss"),
        "safetensors",
    }
    assert of_workers.isdisjoint(loaded.stdout.split())


def test_a_wrong_setting_ends_the_command_with_one_line() -> None:
    with started("--http-port", "many") as process:
        assert process.stderr is not None
        assert process.stderr.read().startswith("visloc-service: --http-port: http_port cannot be")
        assert process.wait(10) == 1


@pytest.mark.parametrize("name", ["maps_dir", "weights_dir"])
def test_what_is_no_folder_is_refused_by_name(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "nowhere"):
        given: dict[str, Any] = {"maps_dir": tmp_path, name: path}
        with pytest.raises(SettingsError, match=f"{name}: .* is no folder"):
            Server(ServiceSettings(**given, http_port=0, grpc_port=0))


def test_maps_at_a_url_are_refused_without_the_extension(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("visloc.archive.store.extensions", lambda _group: {})
    with pytest.raises(SettingsError, match=r"^maps_dir: .* need the extension object_storage$"):
        Server(ServiceSettings(maps_dir="s3://bucket/maps", http_port=0, grpc_port=0))


def test_answers_on_a_connection_that_is_kept_do_not_wait_for_acknowledgements(
    tmp_path: Path,
) -> None:
    with (
        _listen(ServiceSettings(maps_dir=tmp_path), 0) as listener,
        socket.create_connection(listener.getsockname()),
        listener.accept()[0] as accepted,
    ):
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@pytest.mark.parametrize("taken", ["http_port", "grpc_port"])
def test_a_port_that_is_taken_is_an_error_that_names_it(taken: str, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        settings = ServiceSettings(
            **{"maps_dir": tmp_path, "http_port": 0, "grpc_port": 0} | {taken: port}
        )
        with pytest.raises(OSError, match=f"cannot listen on 127.0.0.1:{port}"):
            Server(settings)
