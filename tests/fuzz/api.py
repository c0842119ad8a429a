"""Requests made from our own OpenAPI, good and bad: ``python -m tests.fuzz.api --cases 5000``.

Starts the service on the synthetic sample and sends it what schemathesis makes of its description.
No answer may be a failure of the server, or another than the description says.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import APIOperation, Case, GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

MAP_ID = "room"
_CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]


@dataclass
class Report:
    """What was sent and how it was answered."""

    cases: int = 0
    seconds: float = 0.0
    statuses: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


def check_api(url: str, cases: int, photo: bytes, random_seed: int = 0) -> Report:
    """Send about as many requests, the same number to every operation, and check all answers.

    Args:
        url: of a service with the map ``room``.
        cases: how many requests in all.
        photo: of that map; it goes into some of the requests, so that they are answered.
        random_seed: of what is sent.
    """
    report = Report()
    start = time.monotonic()
    schema = schemathesis.openapi.from_url(f"{url}/openapi.json")
    operations = [each.ok() for each in schema.get_all_operations() if isinstance(each, Ok)]
    pairs: list[tuple[APIOperation[Any, Any, Any, Any], GenerationMode]] = []
    for operation in operations:
        if operation.body or list(operation.iter_parameters()):
            pairs.append((operation, GenerationMode.POSITIVE))
            if operation.body or operation.query:  # in a path there is nothing but text
                pairs.append((operation, GenerationMode.NEGATIVE))
        else:  # there is only one request
            _check_operation(operation, GenerationMode.POSITIVE, 1, 0, url, photo, report)
    while pairs and report.cases < cases:
        # Some operations have few cases: the others get theirs.
        share = max(1, (cases - report.cases) // len(pairs))
        for pair in tuple(pairs):
            random_seed += 1
            before = report.cases
            _check_operation(*pair, share, random_seed, url, photo, report)
            if report.cases - before < share:
                pairs.remove(pair)
    report.seconds = time.monotonic() - start
    return report


def _check_operation(
    operation: APIOperation[Any, Any, Any, Any],
    mode: GenerationMode,
    cases: int,
    random_seed: int,
    url: str,
    photo: bytes,
    report: Report,
) -> None:
    name = f"{operation.method.upper()} {operation.path}"

    @seed(random_seed)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(mode))
    def send(case: Case[Any]) -> None:
        _fill_in(case, photo, report.cases)
        response = case.call(base_url=url, timeout=60)
        report.cases += 1
        report.statuses[f"{name} {response.status_code}"] += 1
        try:
            case.validate_response(response, checks=_CHECKS)
        except (Exception, BaseExceptionGroup) as failure:  # noqa: BLE001 - all are told
            report.failures.append(f"{name}: {failure}\n{case.as_curl_command()[:2000]}")

    # Hypothesis tells when nothing of an operation can be wrong.
    with warnings.catch_warnings(), suppress(Unsatisfiable):
        warnings.simplefilter("ignore")
        send()


def _fill_in(case: Case[Any], photo: bytes, number: int) -> None:
    """Put names that exist into every second request, and a photo into every fourth."""
    if number % 2:
        return
    for name in ("ref", "map_id"):
        # Nothing is deleted, nor written over, but what schemathesis invents.
        if name in (case.path_parameters or {}) and case.method in ("GET", "POST"):
            case.path_parameters[name] = MAP_ID
    body: Any = case.body
    if case.path.startswith("/localize") and isinstance(body, dict):
        for name in ("maps", "near"):
            body.pop(name, None)
        body["map"] = MAP_ID
        as_text = case.media_type == "application/json"
        if number % 4 == 0:
            _fill_in_photo(body, base64.b64encode(photo).decode() if as_text else photo)


def _fill_in_photo(body: dict[str, Any], photo: str | bytes) -> None:
    if "images" not in body and "instants" not in body:
        for name in body.keys() - {"map", "ypr"}:
            del body[name]
        body["image"] = photo
    images = body.get("images")
    for image in images if isinstance(images, list) else ():
        if isinstance(image, dict):
            image.pop("features", None)
            image["image"] = photo


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Build a map of the synthetic sample and serve it in a process of its own."""
    from mapping.pipeline.build import build_map
    from mapping.pipeline.settings import BuildSettings
    from mapping.sample import write_sample

    write_sample(folder / "sample", images=8, size=(256, 192))
    build_map(
        BuildSettings(
            folder / "sample" / "mapping", MAP_ID, folder / "maps", local_features="sift"
        ),
        lambda *_: None,
    )
    photo = next((folder / "sample" / "query").rglob("*.jpg")).read_bytes()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    names = {"VISLOC_MAPS_DIR": str(folder / "maps"), "VISLOC_HTTP_PORT": str(port)}
    with (
        (folder / "service.log").open("w") as log,
        subprocess.Popen(
            [sys.executable, "-m", "service"],
            env=os.environ | names | {"VISLOC_GRPC_PORT": "0"},
            stdout=log,
            stderr=log,
        ) as process,
    ):
        try:
            url = f"http://127.0.0.1:{port}"
            _wait_until_ready(url, process)
            yield url, photo
        finally:
            process.terminate()


def _wait_until_ready(url: str, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(httpx.TransportError):
            if httpx.get(f"{url}/readyz").is_success:
                return
        time.sleep(0.2)
    raise RuntimeError("the service did not become ready")


def main() -> int:
    """Check the service and say what came of it."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.api", description=__doc__)
    parser.add_argument("--cases", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    given_options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as (url, photo):
        report = check_api(url, given_options.cases, photo, given_options.seed)
    for failure in report.failures[:20]:
        sys.stdout.write(failure + "\n")
    figures = {
        "cases": report.cases,
        "seconds": round(report.seconds),
        "failures": len(report.failures),
        "statuses": dict(sorted(report.statuses.items())),
    }
    sys.stdout.write(json.dumps(figures, indent=1) + "\n")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
