"""JSON from outside as text: what is checked of it beside what a model says.

Parsing holds Python's lock, and so stops every other thread. A text may have 64 MB, nearly all of
it base64. What is done here takes milliseconds at a time.
"""

from __future__ import annotations

import base64
import json
from codecs import BOM_UTF8
from collections.abc import Iterable, Sequence
from typing import AnyStr

from visloc.errors import refuse

MAX_NAME = 100  # characters of a name from outside that a refusal repeats
# Characters that are looked at while Python's lock is held: about a millisecond.
_PIECE = 2**20
# Texts of at least so many characters are replaced before names are compared.
_LONG = 1000
# Characters before the data of a data URL.
_LONGEST_MEDIA_TYPE = 200
_FROM_URL_SAFE = bytes.maketrans(b"-_", b"+/")


def check_json_values(text: str | bytes, max_values: int, field: str = "") -> None:
    """Refuse JSON with too many values before parsing it, which would block all other threads."""
    check_num_values(num_json_values(text), max_values, field)


def num_json_values(text: str | bytes) -> int:
    """Return how many values JSON may have at the most, without parsing it."""
    # Brackets as well: a list within a list within a list has no comma. And quotes, of which a
    # value and its name have four.
    values = sum(_count(text, mark) for mark in ",[{")
    return max(values, _count(text, '"') // 4)


def check_num_values(values: int, max_values: int, field: str = "") -> None:
    """Refuse a message of too many values."""
    if values > max_values:
        raise refuse(
            "request.too_large",
            "the request has too many values; send numbers of features in base64",
            field=field or None,
            expected=f"at most {max_values}",
            got=values,
        )


def check_names(text: str | bytes) -> None:
    """Refuse JSON with an object that has a field twice, of which readers take one or the other.

    Args:
        text: JSON that another reader accepted.
    """
    try:
        json.loads(_shortened(text), object_pairs_hook=check_names_once)
    except (ValueError, RecursionError):
        raise refuse("request.malformed", expected="JSON") from None


def check_names_once(fields: list[tuple[str, object]]) -> None:
    """Refuse an object of JSON that has a field twice.

    Args:
        fields: names and values, as ``json`` gives them to its ``object_pairs_hook``.
    """
    seen: set[str] = set()
    for name, _ in fields:
        if name in seen:
            raise refuse("request.duplicate_field", field=name[:MAX_NAME])
        seen.add(name)


def utf8_json(text: str | bytes) -> str | bytes:
    """Return JSON without the byte order mark with which some writers begin (RFC 8259, 8.1)."""
    if isinstance(text, str):
        return text.removeprefix("\ufeff")
    if b"\0" in text[:4]:
        raise refuse("request.malformed", expected="JSON in UTF-8", got="UTF-16 or UTF-32")
    return text.removeprefix(BOM_UTF8)


def bytes_of_base64(text: str) -> bytes:
    """Decode base64 as clients write it.

    It may have line ends or no padding, be of the alphabet for URLs, or be a data URL. A blank is
    an error: decoders of forms put it in the place of a plus sign.
    """
    text, start = text.strip(), 0
    if text[:5].lower() == "data:":
        start = text.find(",", 0, _LONGEST_MEDIA_TYPE) + 1
        if not text[:start].lower().endswith(";base64,"):
            raise ValueError("a data URL that is not in base64")
    parts, rest = [], b""
    for place in range(start, len(text), _PIECE):
        piece = text[place : place + _PIECE].encode("ascii")
        if b" " in piece:
            raise ValueError("a blank, perhaps in the place of a plus sign")
        piece = rest + piece.translate(_FROM_URL_SAFE, b"\r\n")
        # The last letters wait: the next piece may hold their padding, or no more than line ends.
        end = max(0, len(piece) - 1) // 4 * 4
        if piece[end - 1 : end] == b"=":
            raise ValueError("data after the padding")
        parts.append(base64.b64decode(piece[:end], validate=True))
        rest = piece[end:]
    parts.append(base64.b64decode(rest + b"=" * (-len(rest) % 4), validate=True))
    return b"".join(parts)


def _count(text: str | bytes, mark: str) -> int:
    starts = range(0, len(text), _PIECE)
    if isinstance(text, str):
        return sum(text.count(mark, start, start + _PIECE) for start in starts)
    return sum(text.count(mark.encode(), start, start + _PIECE) for start in starts)


def _shortened(text: str | bytes) -> str | bytes:
    """Return JSON with numbers in the place of long texts: equal ones for equal texts.

    Between two quotes without a backslash, a comma, and a colon lies the inside of a text, for
    what separates two texts has one of the latter. So nothing but texts is replaced. What comes
    before the first quote and after the last is no text, though it may be long: spaces.
    """
    if isinstance(text, str):
        parts = text.split('"')
        for place, part in _long_texts(parts, "\\,:"):
            parts[place] = str(hash(part))
        return '"'.join(parts)
    pieces = text.split(b'"')
    for place, piece in _long_texts(pieces, (b"\\", b",", b":")):
        pieces[place] = b"%d" % hash(piece)
    return b'"'.join(pieces)


def _long_texts(parts: Sequence[AnyStr], marks: Iterable[AnyStr]) -> list[tuple[int, AnyStr]]:
    """Return places and parts that are long and have none of the marks, between two others."""
    return [
        (place, part)
        for place, part in enumerate(parts[1:-1], 1)
        if len(part) >= _LONG and not any(mark in part for mark in marks)
    ]
