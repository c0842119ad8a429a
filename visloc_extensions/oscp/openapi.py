"""The entry of ``POST /geopose`` in /openapi.json, with examples that can be sent as they are."""

from __future__ import annotations

from typing import Any

from service.http.openapi import example

_HERE = "visloc_extensions.oscp"
_REF = "#/components/schemas/{model}"
_GEOPOSE_RESPONSE = example("response", _HERE)
_CONTENT: dict[str, Any] = {
    "schema": example("body", _HERE),
    "examples": {
        "version2": {"value": example("request_v2", _HERE)},
        "version1": {"value": example("request_v1", _HERE)},
    },
}
GEOPOSE_BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": _CONTENT, "application/vnd.oscp+json": _CONTENT},
}

_PROBLEM = {"application/problem+json": {"schema": {"$ref": _REF.format(model="Problem")}}}
_RESPONSE = {
    "schema": {"$ref": _REF.format(model="GeoPoseResponse")},
    "examples": {"geopose": {"value": _GEOPOSE_RESPONSE}},
}
GEOPOSE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the GeoPose, in the media type that Accept asks for",
        "content": {
            "application/json": {"examples": _RESPONSE["examples"]},
            "application/vnd.oscp+json": _RESPONSE,
            "application/geopose+json": {
                "schema": {"$ref": _REF.format(model="GeoPose")},
                "examples": {"geopose": {"value": _GEOPOSE_RESPONSE["geopose"]}},
            },
        },
    },
    404: {
        "description": "the photo was not localized (geopose.not_localized), or no map is "
        "anchored around the position (map.none_near)",
        "content": _PROBLEM,
    },
    406: {"description": "Accept allows none of the supported media types", "content": _PROBLEM},
}
