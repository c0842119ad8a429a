"""Requests as protobuf messages, and messages of answers as the JSON of HTTP."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from google.protobuf.json_format import ParseDict
from google.protobuf.message import Message
from numpy.typing import NDArray

from clients.wire.features import Features
from clients.wire.priors import priors_as_json
from clients.wire.requests import ListMaps, Localize, Search
from clients.wire.rig_requests import (
    LocalizeRig,
    SentImage,
    SentInstant,
    SequenceStart,
    camera_as_json,
    odometry_as_json,
    rig_as_json,
    search_as_json,
)
from clients.wire.rigs import Rig
from visloc.geometry import Camera
from visloc_api.v1 import localization_pb2 as wire


def localize_message(request: Localize) -> wire.LocalizeRequest:
    """Return the message of ``Localize``."""
    message = wire.LocalizeRequest()
    _set_search(message, request.search)
    _set_query(message, request.query, request.camera)
    if request.debug:
        message.debug = True
    return message


def rig_message(request: LocalizeRig) -> wire.LocalizeRigRequest:
    """Return the message of ``LocalizeRig``."""
    message = wire.LocalizeRigRequest()
    _set_search(message, request.search)
    _set_rig(message, request.rig)
    message.images.extend(_image_messages(request.images))
    return message


def start_message(start: SequenceStart) -> wire.LocalizeSequenceRequest:
    """Return the first message of a sequence."""
    message = wire.LocalizeSequenceRequest()
    message.start.SetInParent()
    _set_search(message.start, start.search)
    if start.rig is not None:
        _set_rig(message.start, start.rig)
    if start.time_unit is not None:
        message.start.time_unit = start.time_unit
    if start.max_gap_s is not None:
        message.start.max_gap_s = start.max_gap_s
    return message


def instant_message(instant: SentInstant) -> wire.LocalizeSequenceRequest:
    """Return any further message of a sequence."""
    message = wire.LocalizeSequenceRequest()
    message.instant.timestamp = instant.timestamp
    message.instant.images.extend(_image_messages(instant.images))
    if instant.odometry is not None:
        ParseDict(odometry_as_json(instant.odometry), message.instant.odometry)
    if instant.priors is not None:
        # Also when empty: they replace the priors of the start.
        message.instant.priors.SetInParent()
        ParseDict(priors_as_json(instant.priors), message.instant.priors)
    return message


def list_maps_message(request: ListMaps) -> wire.ListMapsRequest:
    """Return the message of ``ListMaps``."""
    near = request.near
    return wire.ListMapsRequest(near=None if near is None else wire.Near(**asdict(near)))


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
            return dict(value)  # every map of an answer has numbers as values
        return [plain(item) for item in value] if kind is not None else list(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return plain(value) if isinstance(value, Message) else value


def _set_search(
    message: wire.LocalizeRequest | wire.LocalizeRigRequest | wire.SequenceStart, search: Search
) -> None:
    ParseDict(search_as_json(search), message)
    if search.request_id is not None:
        message.request_id = search.request_id


def _set_rig(message: wire.LocalizeRigRequest | wire.SequenceStart, rig: Rig) -> None:
    given = rig_as_json(rig)
    if isinstance(given, str):
        message.rig_id = given
    else:
        message.calibration.SetInParent()
        ParseDict(given, message.calibration)


def _set_query(
    message: wire.LocalizeRequest | wire.RigImage, query: bytes | Features, camera: Camera | None
) -> None:
    if isinstance(query, Features):
        message.features.CopyFrom(_features_message(query))
    else:
        message.image = query
    if camera is not None:
        ParseDict(camera_as_json(camera), message.camera)


def _image_messages(images: Sequence[SentImage]) -> list[wire.RigImage]:
    messages = []
    for image in images:
        message = wire.RigImage(sensor=image.sensor)
        _set_query(message, image.query, image.camera)
        if image.timestamp is not None:
            message.timestamp = image.timestamp
        messages.append(message)
    return messages


def _features_message(features: Features) -> wire.Features:
    return wire.Features(
        kind=features.kind,
        keypoints=_array_message(features.keypoints),
        descriptors=_array_message(features.descriptors),
        global_descriptors={
            name: _array_message(row) for name, row in features.global_descriptors.items()
        },
    )


def _array_message(array: NDArray[Any]) -> wire.Array:
    return wire.Array(dtype=array.dtype.name, shape=array.shape, data=array.tobytes())
