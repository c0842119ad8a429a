"""Requests as protobuf messages, and messages of answers as the JSON of HTTP."""

from __future__ import annotations

import base64
from typing import Any

from google.protobuf.message import Message

from clients.wire.requests import ListMaps, Localize, StartSequence
from visloc_api.messages import filled
from visloc_api.v1 import localization_pb2 as wire
from visloc_api.words import near, photo, rigs, sequences

_MESSAGES: dict[type, type[Message]] = {
    photo.LocalizeRequest: wire.LocalizeRequest,
    rigs.LocalizeRigRequest: wire.LocalizeRigRequest,
    sequences.SequenceStart: wire.SequenceStart,
}


def localize_message(request: Localize | StartSequence) -> Any:
    """Return the message of the same name as the request's words."""
    values = request.words.given()
    if "rig" in values:
        # In JSON, one field; in the message, one for either kind.
        rig = values.pop("rig")
        values["rig_id" if isinstance(rig, str) else "calibration"] = rig
    return filled(_MESSAGES[type(request.words)](), values | {"request_id": request.request_id})


def start_message(start: StartSequence) -> wire.LocalizeSequenceRequest:
    """Return the first message of a sequence."""
    return wire.LocalizeSequenceRequest(start=localize_message(start))


def instant_message(instant: sequences.Instant) -> wire.LocalizeSequenceRequest:
    """Return any further message of a sequence."""
    return filled(wire.LocalizeSequenceRequest(), {"instant": instant.given()})


def list_maps_message(request: ListMaps) -> wire.ListMapsRequest:
    """Return the message of ``ListMaps``."""
    place = None if request.near is None else near.Near.from_core(request.near).given()
    return filled(wire.ListMapsRequest(), {"near": place})


def version_message(map_id: str, version: str) -> wire.VersionRef:
    """Return the message that names a version."""
    return wire.VersionRef(map=map_id, version=version)


def plain(message: Message) -> dict[str, Any]:
    """Return a message as the JSON of HTTP: every field is there, null when it is absent."""
    return {field.name: _plain_field(message, field) for field in message.DESCRIPTOR.fields}


def _plain_field(message: Message, field: Any) -> Any:  # a FieldDescriptor
    if field.has_presence and not message.HasField(field.name):
        return None
    value = getattr(message, field.name)
    if field.is_repeated:
        kind = field.message_type
        if kind is not None and kind.GetOptions().map_entry:
            return {
                key: plain(one) if isinstance(one, Message) else one for key, one in value.items()
            }
        return [plain(item) for item in value] if kind is not None else list(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return plain(value) if isinstance(value, Message) else value
