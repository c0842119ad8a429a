"""Our own description of the API against the service; ``make fuzz-api`` sends far more."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from conftest import Query
from tests.fuzz.api import check_api
from tests.service.conftest import Doors

pytestmark = pytest.mark.filterwarnings("ignore")  # of libraries, about each other


def test_answers_are_those_that_the_description_tells(doors: Doors, query: Query) -> None:
    report = check_api(doors.url, 60, query.image)
    assert report.cases >= 60
    assert report.failures == []
    assert report.statuses["GET /maps/{ref} 200"] > 0


class Liar(BaseHTTPRequestHandler):
    """Describes one operation, and answers it otherwise."""

    def do_GET(self) -> None:
        described = self.path == "/openapi.json"
        body = json.dumps(_DESCRIPTION if described else {"ready": "perhaps"}).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


_DESCRIPTION = {
    "openapi": "3.1.0",
    "info": {"title": "liar", "version": "1"},
    "paths": {
        "/ready": {
            "get": {
                "responses": {
                    "200": {
                        "description": "ready",
                        "content": {
                            "application/json": {
                                "schema": {
                                    "type": "object",
                                    "properties": {"ready": {"type": "boolean"}},
                                }
                            }
                        },
                    }
                }
            }
        }
    },
}


@pytest.fixture
def liar() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Liar) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_an_answer_of_another_form_is_noticed(liar: str) -> None:
    report = check_api(liar, 1, b"")
    assert report.failures
    assert "GET /ready" in report.failures[0]
