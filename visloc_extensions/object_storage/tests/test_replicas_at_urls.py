"""Two replicas that share maps in an S3 server."""

from __future__ import annotations

from pathlib import Path

import httpx
from moto.server import ThreadedMotoServer

from benchmarks.reliability.replicas import balanced
from conftest import Query
from tests.service import test_replicas

pytestmark = test_replicas.pytestmark  # needs HAProxy


def test_a_map_in_an_object_store_is_served_by_all(
    hall: Path, query: Query, tmp_path: Path
) -> None:
    storage = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    storage.start()
    host, port = storage.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    environment = {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "AKIDEXAMPLE",
        "AWS_SECRET_ACCESS_KEY": "of-no-account",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    try:
        httpx.put(f"{endpoint}/replicas").raise_for_status()
        urls = ["s3://replicas/maps"] * 2
        with balanced(urls, tmp_path, environment) as pair:
            test_replicas.served_by_all(pair, hall, query)
    finally:
        storage.stop()
