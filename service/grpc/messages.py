"""Messages of gRPC checked by the models of the API's words, as JSON is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from service.api import jobs
from service.values import InstantJob, RigJob, SequenceJob
from visloc.errors import VislocError, inside, refuse
from visloc.types import Near
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words import near, sequences
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import BatchLimits, LocalizeRigRequest

# A rig has one name in JSON.
_RIG_NAMES = {"rig_id": "rig", "calibration": "rig"}
# Lists and maps that may be left out: protobuf cannot tell that from an empty one.
_OPTIONAL_LISTS = {
    "visloc.v1.LocalizeRequest.maps",
    "visloc.v1.LocalizeRigRequest.maps",
    "visloc.v1.SequenceStart.maps",
    "visloc.v1.LocalizeOptions.fusion_weights",
    "visloc.v1.LocalizeOptions.photos",
    "visloc.v1.Features.matches",
    "visloc.v1.Priors.maps",
    "visloc.v1.GravityPrior.world",
    "visloc.v1.Odometry.covariance",
}


def near_of(request: pb2.ListMapsRequest) -> Near | None:
    """Return the circle into which the maps must reach, if any."""
    given = _plain(request).get("near")
    if given is None:
        return None
    with inside("near"):
        words = near.Near.read(given)
    return words.to_core()


def localize_job_of(request: pb2.LocalizeRequest, max_bytes: int) -> RigJob:
    """Return the work of ``Localize``."""
    size = request.ByteSize()
    if size > max_bytes:
        raise refuse(
            "request.too_large", expected=f"at most {max_bytes} bytes", got=f"{size} bytes"
        )
    return jobs.photo_job_of(LocalizeRequest.read(_plain(request)))


def rig_job_of(request: pb2.LocalizeRigRequest, limits: BatchLimits) -> RigJob:
    """Return the work of ``LocalizeRig``."""
    return jobs.rig_job_of(LocalizeRigRequest.read(_plain(request), limits))


def sequence_start_of(message: pb2.LocalizeSequenceRequest | None) -> SequenceJob:
    """Return the start of a sequence.

    Args:
        message: the first of the stream; None when there was none.
    """
    kind = None if message is None else message.WhichOneof("message")
    if message is None or kind != "start":
        raise _wrong_message("the first message", "start", kind)
    return jobs.sequence_job_of(sequences.SequenceStart.read(_plain(message.start)))


def instant_of(
    message: pb2.LocalizeSequenceRequest, limits: BatchLimits, number: int, *, has_rig: bool
) -> InstantJob:
    """Return an instant of a sequence."""
    kind = message.WhichOneof("message")
    if kind != "instant":
        raise _wrong_message(f"message {number + 2}", "instant", kind)
    with inside(f"instants[{number}]"):
        words = sequences.Instant.read(_plain(message.instant), limits)
        return jobs.instant_job_of(words, jobs.Parts({}), has_rig=has_rig)


def _wrong_message(name: str, expected: str, got: str | None) -> VislocError:
    return refuse(
        "sequence.message", field="message", expected=expected, got=got or "nothing", name=name
    )


def _plain(message: Message) -> dict[str, Any]:
    """Return a message's fields as JSON would have them; fields that are not there are left out.

    Numbers, texts and lists without presence are there when they are zero or empty.
    """
    unknown = UnknownFieldSet(message)
    if len(unknown) > 0:
        number, kind = unknown[0].field_number, message.DESCRIPTOR
        known = kind.fields_by_number.get(number)
        raise refuse(
            "request.unknown_field",
            "the message does not have this field, or not of this type",
            field=known.name if known else str(number),
            expected=f"a field of {kind.full_name} as in the server's localization.proto",
            got=f"field {number} with wire type {unknown[0].wire_type}",
        )
    plain = {
        _RIG_NAMES.get(field.name, field.name): _plain_value(getattr(message, field.name))
        for field in message.DESCRIPTOR.fields
        if _is_there(message, field.name)
    }
    plain.pop("request_id", None)  # of the envelope
    if ("maps" in plain or "near" in plain) and plain.get("map") == "":
        del plain["map"]
    return plain


def _is_there(message: Message, name: str) -> bool:
    field = message.DESCRIPTOR.fields_by_name[name]
    if field.full_name in _OPTIONAL_LISTS:
        return len(getattr(message, name)) > 0
    return not field.has_presence or message.HasField(name)


def _plain_value(value: Any) -> object:
    if isinstance(value, Message):
        return _plain(value)
    if isinstance(value, Mapping):
        return {name: _plain_value(value[name]) for name in sorted(value)}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain_value(each) for each in value]
    return value
