"""What FastAPI cannot derive for /openapi.json: two kinds of bodies, examples, problems."""

from __future__ import annotations

import base64
import json
from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from service import examples
from service.schemas import Camera, LocalizeRequest, Problem

# A grey photo of 64 x 48 pixels: small enough to read, real enough to be posted as it is.
EXAMPLE_IMAGE = (
    "iVBORw0KGgoAAAANSUhEUgAAAEAAAAAwCAAAAACEICPDAAAAJ0lEQVR42u3MMREAAAgEoNfkRjeEmwcB"
    "qMlNRyAQCAQCgUAgEDwNFm0oAOBnO1pYAAAAAElFTkSuQmCC"
)
EXAMPLE_REQUEST = {
    "map": "office",
    "image": EXAMPLE_IMAGE,
    "camera": {"model": "PINHOLE", "width": 64, "height": 48, "params": [52.5, 52.5, 32, 24]},
    "options": {"top_k": 10, "seed": 1},
}
# Two keypoints of a map of XFeat features (64 numbers each) and localvlad, which is not sent.
EXAMPLE_FEATURES_REQUEST = {
    "map": "office",
    "features": {
        "kind": "xfeat",
        "keypoints": {"dtype": "float32", "shape": [2, 2], "data": "AABIQQAAyEEAAABCAACQQQ=="},
        "descriptors": {
            "dtype": "int8",
            "shape": [2, 64],
            "data": base64.b64encode(bytes(range(128))).decode(),
        },
        "global_descriptors": {},
    },
    "camera": {"model": "PINHOLE", "width": 64, "height": 48, "params": [52.5, 52.5, 32, 24]},
}
_REF = "#/components/schemas/{model}"

LOCALIZE_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["map"],
                "oneOf": [{"required": ["image"]}, {"required": ["features", "camera"]}],
                "additionalProperties": False,
                "properties": {
                    "map": {"type": "string", "description": "id, or id@version"},
                    "image": {
                        "type": "string",
                        "contentMediaType": "application/octet-stream",
                        "description": "the file: JPEG, PNG, WebP, TIFF or BMP",
                    },
                    "features": {
                        "type": "string",
                        "contentMediaType": "application/json",
                        "description": "instead of the image, a file: Features as JSON",
                    },
                    "camera": {
                        "type": "string",
                        "description": "MODEL,width,height,params... or a Camera as JSON",
                    },
                    "options": {"type": "string", "description": "LocalizeOptions as JSON"},
                },
            },
            "examples": {
                "photo": {
                    "value": {
                        "map": "office",
                        "image": "(the bytes of the file)",
                        "camera": "PINHOLE,640,480,525,525,320,240",
                        "options": '{"top_k": 10, "seed": 1}',
                    }
                },
                "features": {
                    "value": {
                        "map": "office",
                        "features": json.dumps(EXAMPLE_FEATURES_REQUEST["features"]),
                        "camera": "PINHOLE,64,48,52.5,52.5,32,24",
                    }
                },
            },
        },
        "application/json": {
            "schema": {"$ref": _REF.format(model="LocalizeRequest")},
            "examples": {
                "photo": {"value": EXAMPLE_REQUEST},
                "features": {"value": EXAMPLE_FEATURES_REQUEST},
            },
        },
    },
}

_ANSWERS: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {
    ("/localize", "post", "200"): {
        "localized": examples.LOCALIZED,
        "not_localized": examples.NOT_LOCALIZED,
    },
    ("/maps", "get", "200"): {"maps": {"maps": [examples.MAP]}},
    ("/maps/{ref}", "get", "200"): {"map": examples.MAP},
    ("/readyz", "get", "200"): {"ready": examples.READY},
    ("/readyz", "get", "503"): {"loading": examples.LOADING},
}

_PROBLEMS = {
    404: "no such map or version",
    409: "the features or weights that the map was built with are not here",
    413: "over a limit on bytes or pixels",
    422: "the request cannot be used as it is",
    429: "too many photos are waiting; try again",
    500: "a map on disk is damaged, or the server made a mistake",
    503: "the maps are being loaded; try again",
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
                    (Camera, "validation"),  # named by LocalizeRequest's own schema of camera
                    (Problem, "serialization"),
                ],
                ref_template=_REF,
            )
            schema["components"]["schemas"].update(ours["$defs"])
            schema["components"]["schemas"]["Problem"]["example"] = {
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
            # Not given to the routes: FastAPI would drop their nulls.
            for (path, method, status), shown in _ANSWERS.items():
                response = schema["paths"][path][method]["responses"][status]
                response["content"]["application/json"]["examples"] = {
                    name: {"value": answer} for name, answer in shown.items()
                }
        return super().openapi()
