"""What /openapi.json says of ``POST /geopose``, with examples that can be sent as they are."""

from __future__ import annotations

from typing import Any

from service.http.openapi.request_bodies import EXAMPLE_IMAGE

_REF = "#/components/schemas/{model}"
_ID, _TIME = "7d7b6c1e-5f0f-4a52-9f5a-1c1a3c9b2d10", 1750939398316
_PRIVACY: dict[str, Any] = {
    "dataRetention": [],
    "dataAcceptableUse": [],
    "dataSanitizationApplied": [],
    "dataSanitizationRequested": [],
}
_PARAMS = {"model": "PINHOLE", "modelParams": [52.5, 52.5, 32.0, 24.0]}
_PHOTO = {
    "sequenceNumber": 0,
    "imageFormat": "unknown",
    "size": [64, 48],
    "imageBytes": EXAMPLE_IMAGE,
}
_POSITION = {
    "latitude": 48.2743,
    "longitude": 2.6974,
    "altitude": 92.0,
    "accuracy": 8.0,
    "altitudeAccuracy": 15.0,
    "heading": 31.0,
    "speed": 0.0,
}
_GPS = {"id": "gps0", "type": "geolocation"}
EXAMPLE_GEOPOSE_REQUEST_V1: dict[str, Any] = {
    "id": _ID,
    "timestamp": _TIME,
    "type": "geopose",
    "sensors": [{"id": "cam0", "type": "camera", "params": _PARAMS}, _GPS],
    "sensorReadings": [
        {"timestamp": _TIME, "sensorId": "cam0", "privacy": _PRIVACY, "reading": _PHOTO},
        {"timestamp": _TIME, "sensorId": "gps0", "privacy": _PRIVACY, "reading": _POSITION},
    ],
}
EXAMPLE_GEOPOSE_REQUEST_V2: dict[str, Any] = {
    "id": _ID,
    "timestamp": _TIME,
    "type": "geopose",
    "sensors": [{"id": "cam0", "type": "camera"}, _GPS],
    "sensorReadings": {
        "cameraReadings": [
            {
                "timestamp": _TIME,
                "sensorId": "cam0",
                "privacy": _PRIVACY,
                **_PHOTO,
                "params": _PARAMS,
            }
        ],
        "geolocationReadings": [
            {"timestamp": _TIME, "sensorId": "gps0", "privacy": _PRIVACY, **_POSITION}
        ],
    },
}
EXAMPLE_GEOPOSE: dict[str, Any] = {
    "position": {"lat": 48.27427986, "lon": 2.697434716, "h": 91.600039},
    "quaternion": {"x": 0.000001, "y": -0.000001, "z": 0.499999, "w": 0.866026},
}
EXAMPLE_GEOPOSE_RESPONSE: dict[str, Any] = {
    "id": _ID,
    "timestamp": _TIME,
    "accuracy": {"position": 0.12, "orientation": 0.4},
    "type": "geopose",
    "geopose": EXAMPLE_GEOPOSE,
}

_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["sensorReadings"],
    "properties": {
        "id": {"type": "string"},
        "timestamp": {"type": "number", "description": "milliseconds since the Unix epoch"},
        "type": {"type": "string"},
        "sensors": {"type": "array", "items": {"type": "object", "required": ["id", "type"]}},
        "sensorReadings": {
            "description": "version 1: a list; version 2: an object of lists. At least one camera "
            "reading; geolocation readings tell where to search; others are passed over",
            "anyOf": [
                {"type": "array", "items": {"type": "object"}},
                {
                    "type": "object",
                    "properties": {
                        "cameraReadings": {
                            "type": "array",
                            "items": {"type": "object", "required": ["sensorId", "imageBytes"]},
                        },
                        "geolocationReadings": {
                            "type": "array",
                            "items": {"type": "object", "required": ["latitude", "longitude"]},
                        },
                    },
                },
            ],
        },
        "priorPoses": {"type": "array", "items": {"type": "object"}},
    },
}
_CONTENT: dict[str, Any] = {
    "schema": _SCHEMA,
    "examples": {
        "version2": {"value": EXAMPLE_GEOPOSE_REQUEST_V2},
        "version1": {"value": EXAMPLE_GEOPOSE_REQUEST_V1},
    },
}
GEOPOSE_BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": _CONTENT, "application/vnd.oscp+json": _CONTENT},
}

_PROBLEM = {"application/problem+json": {"schema": {"$ref": _REF.format(model="Problem")}}}
_RESPONSE = {
    "schema": {"$ref": _REF.format(model="GeoPoseResponse")},
    "examples": {"geopose": {"value": EXAMPLE_GEOPOSE_RESPONSE}},
}
GEOPOSE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the GeoPose, in the kind that Accept asks for",
        "content": {
            "application/json": {"examples": _RESPONSE["examples"]},
            "application/vnd.oscp+json": _RESPONSE,
            "application/geopose+json": {
                "schema": {"$ref": _REF.format(model="GeoPose")},
                "examples": {"geopose": {"value": EXAMPLE_GEOPOSE}},
            },
        },
    },
    404: {
        "description": "the photo was not localized (geopose.not_localized), or no map is "
        "anchored around the position (map.none_near)",
        "content": _PROBLEM,
    },
    406: {"description": "Accept allows no answer that is given here", "content": _PROBLEM},
}
