"""The bodies of requests in /openapi.json, with examples that can be sent as they are."""

from __future__ import annotations

import base64
import json
from typing import Any

# A grey photo of 64 x 48 pixels: small enough to read, real enough to be posted as it is.
EXAMPLE_IMAGE = (
    "iVBORw0KGgoAAAANSUhEUgAAAEAAAAAwCAAAAACEICPDAAAAJ0lEQVR42u3MMREAAAgEoNfkRjeEmwcB"
    "qMlNRyAQCAQCgUAgEDwNFm0oAOBnO1pYAAAAAElFTkSuQmCC"
)
EXAMPLE_REQUEST: dict[str, Any] = {
    "map": "office",
    "image": EXAMPLE_IMAGE,
    "camera": {"model": "PINHOLE", "width": 64, "height": 48, "params": [52.5, 52.5, 32, 24]},
    "options": {"top_k": 10, "seed": 1},
    "priors": {
        "position": {"position": [0.5, 0.2, 1.5], "radius": 5.0},
        "gravity": {"direction": [0.0, 1.0, 0.0], "std_deg": 2.0, "world": [0.0, 0.0, -1.0]},
    },
}
# Two keypoints of a map of XFeat features (64 numbers each) and localvlad, which is not sent.
EXAMPLE_FEATURES_REQUEST: dict[str, Any] = {
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
_EXAMPLE_CAMERA = EXAMPLE_REQUEST["camera"]
EXAMPLE_RIG: dict[str, Any] = {
    "sensors": {
        "left": {
            "cam_from_rig": {"rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]},
            "camera": _EXAMPLE_CAMERA,
        },
        "right": {
            "cam_from_rig": {
                "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
                "translation": [-0.2, 0.0, 0.0],
            },
            "camera": _EXAMPLE_CAMERA,
        },
    }
}
EXAMPLE_RIG_REQUEST: dict[str, Any] = {
    "map": "office",
    "rig": EXAMPLE_RIG,
    "images": [
        {"sensor": "left", "image": EXAMPLE_IMAGE, "timestamp": 1700000000000},
        {"sensor": "right", "image": EXAMPLE_IMAGE, "timestamp": 1700000000000},
    ],
    "options": {"top_k": 10},
}
EXAMPLE_SEQUENCE_REQUEST: dict[str, Any] = {
    "map": "office",
    "instants": [
        {
            "timestamp": 1700000000000 + 100 * number,
            "images": [{"image": EXAMPLE_IMAGE, "camera": _EXAMPLE_CAMERA}],
            "odometry": {
                "rig_from_odometry": {
                    "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
                    "translation": [0.0, 0.0, -0.1 * number],
                }
            },
        }
        for number in range(2)
    ],
    "time_unit": "ms",
    "max_gap_s": 1.0,
}
_REF = "#/components/schemas/{model}"

LOCALIZE_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "allOf": [
                    {"oneOf": [{"required": [name]} for name in ("map", "maps", "near")]},
                    {"oneOf": [{"required": ["image"]}, {"required": ["features", "camera"]}]},
                ],
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
                    "maps": {"type": "string", "description": "instead of map: id,id,..."},
                    "priors": {"type": "string", "description": "Priors as JSON"},
                    "debug": {
                        "type": "string",
                        "enum": ["true", "false"],
                        "description": "also return the matches and a picture of them; needs "
                        "a photo",
                    },
                    "near": {
                        "type": "string",
                        "description": "instead of map: latitude,longitude,radius or Near as JSON",
                    },
                    "ypr": {
                        "enum": ["true", "false"],
                        "description": "also say the GeoPose in yaw, pitch and roll",
                    },
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


def _batch_body(model: str, example: dict[str, Any]) -> dict[str, Any]:
    """Describe the two kinds of bodies of a request with several photos."""
    by_part = json.loads(json.dumps(example))
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
                            "in part instead of bringing it in image",
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
                "examples": {"photos": {"value": example}},
            },
        },
    }


RIG_BODY = _batch_body("LocalizeRigRequest", EXAMPLE_RIG_REQUEST)
SEQUENCE_BODY = _batch_body("LocalizeSequenceRequest", EXAMPLE_SEQUENCE_REQUEST)
