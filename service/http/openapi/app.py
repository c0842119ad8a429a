"""The parts of /openapi.json that FastAPI cannot derive: request bodies, examples, problems."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from pydantic.json_schema import models_json_schema

from service.http.openapi import example
from visloc_api.words.maps import UseVersionRequest
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.poses import Camera
from visloc_api.words.rigs import LocalizeRigRequest, RigCalibration
from visloc_api.words.sequences import LocalizeSequenceRequest
from visloc_api.words.status import Problem
from visloc_api.words.wire import NDJSON

_REF = "#/components/schemas/{model}"

_ANSWERS: dict[tuple[str, str, str], dict[str, Any]] = {
    ("/localize", "post", "200"): {
        "localized": example("localized"),
        "not_localized": example("not_localized"),
    },
    ("/localize/rig", "post", "200"): {"localized": example("rig")},
    ("/localize/sequence", "post", "200"): {"sequence": example("sequence")},
    ("/maps", "get", "200"): {"maps": {"maps": [example("map")]}},
    ("/maps/{ref}", "get", "200"): {"map": example("map"), "set": example("set")},
    ("/maps/{ref}/images", "get", "200"): {"images": example("map_images")},
    ("/maps/{map_id}/current", "post", "200"): {"map": example("map")},
    ("/maps/{map_id}/versions/{version}", "get", "200"): {"map": example("new_map")},
    ("/maps/{map_id}/versions/{version}", "put", "201"): {"map": example("new_map")},
    ("/readyz", "get", "200"): {"ready": example("ready")},
    ("/readyz", "get", "503"): {"loading": example("loading")},
}

_PROBLEMS = {
    404: "unknown map, version or rig",
    409: "the server lacks the features or weights that the map was built with; for versions of "
    "maps: the version already exists, or is current",
    413: "over a limit on bytes, pixels, photos or instants",
    422: "the request is invalid",
    429: "too many photos are waiting, or too many rigs and sequences are being served; try again",
    500: "a map on disk is damaged, or the server failed",
    503: "the maps are being loaded; try again",
    504: "the request took too long",
    507: "the server's disk is full",
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Describe the errors of a route."""
    return {
        status: {
            "description": _PROBLEMS[status],
            "content": {
                "application/problem+json": {"schema": {"$ref": _REF.format(model="Problem")}}
            },
        }
        for status in statuses
    }


class App(FastAPI):
    """FastAPI with the schemas of bodies that it does not parse itself.

    /openapi.json needs no key and is written once. FastAPI writes it for each request, which blocks
    the event loop for milliseconds.
    """

    def setup(self) -> None:
        """Add the route of the schema, which is written when it is first requested."""

        async def answer(_: Request) -> Response:
            return Response(self._written, media_type="application/json")

        self.add_api_route("/openapi.json", answer, include_in_schema=False)

    @cached_property
    def _written(self) -> bytes:
        return bytes(JSONResponse(self.openapi()).body)

    def openapi(self) -> dict[str, Any]:
        """Return /openapi.json."""
        if self.openapi_schema is None:
            schema = super().openapi()
            _, ours = models_json_schema(
                [
                    (LocalizeRequest, "validation"),
                    (LocalizeRigRequest, "validation"),
                    (LocalizeSequenceRequest, "validation"),
                    (RigCalibration, "validation"),
                    (UseVersionRequest, "validation"),
                    (Camera, "validation"),  # named by the requests' own schema of camera
                    (Problem, "serialization"),
                ],
                ref_template=_REF,
            )
            schema["components"]["schemas"].update(ours["$defs"])
            schema["components"]["schemas"]["Problem"]["example"] = example("problem")
            key = {"type": "http", "scheme": "bearer", "description": "an API key"}
            schema["components"]["securitySchemes"] = {"key": key}
            schema["security"] = [{}, {"key": []}]  # a server may need no key
            # Added here, because FastAPI drops nulls from the examples of routes.
            for (path, method, status), shown in _ANSWERS.items():
                response = schema["paths"][path][method]["responses"][status]
                response["content"]["application/json"]["examples"] = {
                    name: {"value": answer} for name, answer in shown.items()
                }
            lines = schema["paths"]["/localize/sequence"]["post"]["responses"]["200"]["content"]
            lines[NDJSON] = {
                "schema": {
                    "description": "with Accept: application/x-ndjson, one line of this JSON per "
                    "instant, in order, each sent as soon as it is final; after an error, the last "
                    "line holds the problem",
                    "oneOf": [
                        {"$ref": _REF.format(model="InstantAnswer")},
                        {
                            "type": "object",
                            "required": ["problem"],
                            "properties": {"problem": {"$ref": _REF.format(model="Problem")}},
                            "additionalProperties": False,
                        },
                    ],
                },
                "examples": {
                    "answer": {"value": example("rig")},
                    "error": {"value": {"problem": example("problem")}},
                },
            }
        return super().openapi()
