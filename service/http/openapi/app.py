"""The parts of /openapi.json that FastAPI cannot derive: request bodies, examples, problems."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from service.api import (
    Camera,
    LocalizeRequest,
    LocalizeRigRequest,
    LocalizeSequenceRequest,
    Problem,
    RigCalibration,
    UseVersionRequest,
)
from service.http.openapi import batch_examples, examples
from service.http.responses import NDJSON

_REF = "#/components/schemas/{model}"

_ANSWERS: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {
    ("/localize", "post", "200"): {
        "localized": examples.LOCALIZED,
        "not_localized": examples.NOT_LOCALIZED,
    },
    ("/localize/rig", "post", "200"): {"localized": batch_examples.RIG},
    ("/localize/sequence", "post", "200"): {"sequence": batch_examples.SEQUENCE},
    ("/maps", "get", "200"): {"maps": {"maps": [examples.MAP]}},
    ("/maps/{ref}", "get", "200"): {"map": examples.MAP, "set": examples.SET},
    ("/maps/{ref}/images", "get", "200"): {"images": examples.MAP_IMAGES},
    ("/maps/{map_id}/current", "post", "200"): {"map": examples.MAP},
    ("/maps/{map_id}/versions/{version}", "get", "200"): {"map": examples.NEW_MAP},
    ("/maps/{map_id}/versions/{version}", "put", "201"): {"map": examples.NEW_MAP},
    ("/readyz", "get", "200"): {"ready": examples.READY},
    ("/readyz", "get", "503"): {"loading": examples.LOADING},
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

_EXAMPLE_PROBLEM = {
    "type": "about:blank",
    "title": "Unprocessable Entity",
    "status": 422,
    "detail": "wrong number of parameters for PINHOLE",
    "code": "camera.param_count",
    "field": "camera.params",
    "expected": "4: fx, fy, cx, cy",
    "got": "3",
    "kind": "InvalidInput",
    "request_id": "3f1d5c0b8a7e4e1f9d2c6b5a49382716",
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
    """FastAPI with the schemas of bodies that it does not parse itself."""

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
            schema["components"]["schemas"]["Problem"]["example"] = _EXAMPLE_PROBLEM
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
                    "answer": {"value": batch_examples.RIG},
                    "error": {"value": {"problem": _EXAMPLE_PROBLEM}},
                },
            }
        return super().openapi()
