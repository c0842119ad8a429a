"""Protobuf messages before they are parsed: how many values they have.

Two bytes make an empty message within a message, which takes 50 bytes and 0.2 microseconds to
parse, on the event loop: 64 MB would take gigabytes and seconds. One byte makes a number in a field
of many, which takes 16 nanoseconds.
"""

from __future__ import annotations

from google.protobuf.descriptor import Descriptor, FieldDescriptor

_VARINT, _FIXED64, _BYTES, _START_GROUP, _END_GROUP, _FIXED32 = range(6)
_FIXED_BYTES = {_FIXED64: 8, _FIXED32: 4, _START_GROUP: 0, _END_GROUP: 0}
# Of a number in a field of many; others take one byte or more.
_NUMBER_BYTES = {FieldDescriptor.TYPE_DOUBLE: 8, FieldDescriptor.TYPE_FLOAT: 4}


def num_values(data: bytes, kind: Descriptor, enough: int) -> int:
    """Count the fields of a message and of the messages in it, and the numbers in fields of many.

    What is no protobuf is counted up to there: the parser says what is wrong with it.

    Args:
        data: an encoded message.
        kind: its type.
        enough: the count at which to stop.
    """
    inner = _message_fields(kind)
    count, waiting = 0, [(0, len(data), inner)]
    try:
        while waiting:
            position, end, inner = waiting.pop()
            while position < end and count < enough:
                count += 1
                key, position = _varint(data, position)
                wire_type = key & 7
                if wire_type == _VARINT:
                    _, position = _varint(data, position)
                elif wire_type == _BYTES:
                    size, position = _varint(data, position)
                    part = inner.get(key >> 3)
                    if isinstance(part, int):
                        count += min(size, end - position) // part
                    elif size and part is not None:
                        waiting.append((position, min(end, position + size), part))
                    position += size
                else:
                    position += _FIXED_BYTES[wire_type]
    except (IndexError, KeyError):
        pass
    return count


# By field number: what the messages in a message have in them, or the bytes of a number.
_Inner = dict[int, "_Inner | int"]
_known: dict[str, _Inner] = {}


def _message_fields(kind: Descriptor) -> _Inner:
    """Return the fields of a type that are messages or many numbers; a type may be in itself."""
    if kind.full_name not in _known:
        found = _known[kind.full_name] = {}
        for field in kind.fields:
            if field.message_type is not None:
                found[field.number] = _message_fields(field.message_type)
            elif field.is_packed:
                found[field.number] = _NUMBER_BYTES.get(field.type, 1)
    return _known[kind.full_name]


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a number and the position after it (protobuf's encoding, "Base 128 Varints")."""
    byte = data[position]
    if byte < 0x80:
        return byte, position + 1
    value, shift = byte & 0x7F, 7
    while byte >= 0x80 and shift < 70:
        position += 1
        byte = data[position]
        value |= (byte & 0x7F) << shift
        shift += 7
    return value, position + 1
