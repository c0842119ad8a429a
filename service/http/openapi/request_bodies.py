"""The bodies of requests in /openapi.json, with examples that can be sent as they are."""

from __future__ import annotations

import json
from typing import Any

from service.http.openapi import example

_REF = "#/components/schemas/{model}"

LOCALIZE_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": example("localize_body"),
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
                        "features": json.dumps(example("features_request")["features"]),
                        "camera": "PINHOLE,64,48,52.5,52.5,32,24",
                    }
                },
            },
        },
        "application/json": {
            "schema": {"$ref": _REF.format(model="LocalizeRequest")},
            "examples": {
                "photo": {"value": example("localize_request")},
                "features": {"value": example("features_request")},
            },
        },
    },
}


def _batch_body(model: str, photos: dict[str, Any]) -> dict[str, Any]:
    """Describe the two kinds of bodies of a request with several photos."""
    by_part = json.loads(json.dumps(photos))
    images = [i for instant in by_part.get("instants", [by_part]) for i in instant["images"]]
    for number, image in enumerate(images):
        del image["image"]
        image["part"] = f"photo{number}"
    file = {"type": "string", "contentMediaType": "application/octet-stream"}
    return {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["request"],
                    "properties": {
                        "request": {
                            "type": "string",
                            "contentMediaType": "application/json",
                            "description": f"{model} as JSON, a text; an image names its file "
                            "in part (its mask in mask_part) instead of bringing it in image",
                        }
                    },
                    "additionalProperties": {
                        **file,
                        "description": "the file of the image whose part has this name",
                    },
                },
                "examples": {
                    "files": {
                        "value": {
                            "request": json.dumps(by_part),
                            **{image["part"]: "(the bytes of the file)" for image in images},
                        }
                    }
                },
            },
            "application/json": {
                "schema": {"$ref": _REF.format(model=model)},
                "examples": {"photos": {"value": photos}},
            },
        },
    }


RIG_BODY = _batch_body("LocalizeRigRequest", example("rig_request"))
SEQUENCE_BODY = _batch_body("LocalizeSequenceRequest", example("sequence_request"))
