"""What FastAPI cannot derive for /openapi.json: schemas of bodies, examples, problems."""

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
from service.http.openapi import example
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
    404: "no such map, version or rig",
    409: "the features or weights that the map was built with are not here; of maps: the version "
    "exists already, or is in use",
    413: "over a limit on bytes, pixels, photos or instants",
    422: "the request cannot be used as it is",
    429: "too many photos are waiting, or rigs and sequences being served; try again",
    500: "a map on disk is damaged, or the server made a mistake",
    503: "the maps are being loaded; try again",
    504: "the time for the request is over",
    507: "there is no room on the server's disk",
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
    """FastAPI with the schemas of what it does not parse itself."""

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
            # Not given to the routes: FastAPI would drop their nulls.
            for (path, method, status), shown in _ANSWERS.items():
                response = schema["paths"][path][method]["responses"][status]
                response["content"]["application/json"]["examples"] = {
                    name: {"value": answer} for name, answer in shown.items()
                }
            lines = schema["paths"]["/localize/sequence"]["post"]["responses"]["200"]["content"]
            lines[NDJSON] = {
                "schema": {
                    "description": "with Accept: application/x-ndjson, lines of this JSON: one per "
                    "instant, in order, each sent as soon as it is final; after an error, a last "
                    "one with the problem",
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
