"""Multipart forms, parsed in memory within limits."""

from __future__ import annotations

import codecs
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from visloc.errors import refuse

# RFC 7578, 4.2 forbids it in forms, but clients send it, and some without ``filename``.
_ENCODED_FILE_NAME = re.compile(rb";\s*filename\*\s*=", re.IGNORECASE)
# Longer than the longest boundary and the line ends that some clients send before it.
_BEGINNING = 1024


@dataclass(frozen=True, slots=True)
class FormLimits:
    """The largest form that is accepted.

    Attributes:
        max_text_bytes: of each part that must be a text.
    """

    max_parts: int
    max_text_bytes: int


@dataclass(frozen=True, slots=True)
class Form:
    """The parts of a form by name.

    A part with a file name is a file. One without is a text if its name says so or its bytes are
    text, and a file otherwise: some clients send bytes without a file name.
    """

    texts: Mapping[str, str]
    files: Mapping[str, bytes]


def parse_form(
    content_type: str,
    body: bytes,
    limits: FormLimits,
    expected: str,
    text_names: Collection[str] = (),
) -> Form:
    """Parse a whole form. This blocks: 20 MB take 0.05 s.

    Args:
        content_type: the header, with the boundary.
        expected: which parts the form should have, for errors.
        text_names: the parts that are texts unless they have a file name.

    Raises:
        InvalidInput: ``request.malformed`` or ``request.duplicate_field``.
    """
    _, options = parse_options_header(content_type)
    collector = _Collector(limits, _charset_of(options), text_names)
    try:
        _collect(collector, options.get(b"boundary", b""), body)
    except FormParserError as error:
        message = str(error) if isinstance(error, _Malformed) else f"no multipart data: {error}"
        field = collector.name and collector.name[:100]
        raise refuse("request.malformed", message, field=field, expected=expected) from None
    texts: dict[str, str] = {}
    files: dict[str, bytes] = {}
    for name, value in collector.parts:
        if name in texts or name in files:
            raise refuse("request.duplicate_field", field=name[:100])
        if isinstance(value, str):
            texts[name] = value
        else:
            files[name] = value
    return Form(texts, files)


class _Malformed(FormParserError):
    """A form that cannot be read or is over a limit."""


def _collect(collector: _Collector, boundary: bytes, body: bytes) -> None:
    if not boundary:
        raise _Malformed("Content-Type names no boundary of multipart data")
    parser = MultipartParser(
        boundary,
        {
            "on_part_begin": collector.begin_part,
            "on_header_field": collector.add_header_name,
            "on_header_value": collector.add_header_value,
            "on_header_end": collector.end_header,
            "on_headers_finished": collector.end_headers,
            "on_part_data": collector.add_data,
            "on_part_end": collector.end_part,
            "on_end": collector.end,
        },
    )
    # The parser would skip what stands between a line end and the first hyphen.
    if not body[:_BEGINNING].lstrip(b"\r\n").startswith(b"--" + boundary):
        raise _Malformed("the body does not begin with the boundary that Content-Type names")
    parser.write(body)
    delimiter = b"\r\n--" + boundary
    # What has been read of a form that was cut may be a whole form of fewer parts.
    if not collector.is_whole:
        raise _Malformed("the form is cut: its closing boundary is missing")
    closing = body.find(delimiter + b"--")
    if closing >= 0 and body.find(delimiter, closing + 1) >= 0:
        raise _Malformed("the form has parts after its closing boundary")


def _charset_of(options: Mapping[bytes, bytes]) -> str:
    try:
        return codecs.lookup(options.get(b"charset", b"utf-8").decode("latin-1")).name
    except LookupError:
        return "latin-1"


class _Collector:
    """Gathers the parts of a form from the events of the parser."""

    def __init__(self, limits: FormLimits, charset: str, text_names: Collection[str]) -> None:
        self.parts: list[tuple[str, str | bytes]] = []
        self.name: str | None = None
        self.is_whole = False
        self._limits = limits
        self._charset = charset
        self._text_names = text_names
        self._header_name = self._header_value = b""
        self._is_file = self._is_text = False
        self._headers: dict[bytes, bytes] = {}
        self._data = bytearray()

    def begin_part(self) -> None:
        self.name = None
        self._headers = {}
        self._data = bytearray()

    def add_header_name(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def add_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def end_header(self) -> None:
        self._headers[self._header_name.lower()] = self._header_value
        self._header_name = self._header_value = b""

    def end_headers(self) -> None:
        disposition = self._headers.get(b"content-disposition", b"")
        _, options = parse_options_header(disposition)
        if b"name" not in options:
            raise _Malformed("a part of the form has no name in its Content-Disposition")
        self.name = self._decoded(options[b"name"])
        encoding = self._headers.get(b"content-transfer-encoding", b"binary").strip().lower()
        if encoding not in (b"7bit", b"8bit", b"binary"):  # bytes as they are (RFC 2045, 6.2)
            raise _Malformed("Content-Transfer-Encoding is not read; send bytes")
        self._is_file = b"filename" in options or bool(_ENCODED_FILE_NAME.search(disposition))
        self._is_text = not self._is_file and self.name in self._text_names
        if len(self.parts) >= self._limits.max_parts:
            raise _Malformed(f"the form has more than {self._limits.max_parts} parts")

    def add_data(self, data: bytes, start: int, end: int) -> None:
        most = self._limits.max_text_bytes
        if self._is_text and len(self._data) + end - start > most:
            raise _Malformed(f"the text has more than {most} bytes")
        self._data += data[start:end]

    def end_part(self) -> None:
        assert self.name is not None  # headers end before their part
        is_file = self._is_file or not (self._is_text or _is_utf8(self._data))
        value = bytes(self._data) if is_file else self._decoded(self._data)
        self.parts.append((self.name, value))

    def end(self) -> None:
        self.is_whole = True

    def _decoded(self, data: bytes | bytearray) -> str:
        try:
            return data.decode(self._charset)
        except (UnicodeError, LookupError):
            return data.decode("latin-1")


def _is_utf8(data: bytearray) -> bool:
    """Tell whether bytes are text in UTF-8, which has no zeros."""
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return b"\0" not in data
