from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncGenerator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from service.http.forms import Form, FormLimits, parse_form
from visloc.errors import InvalidInput

BOUNDARY = b"--x7Y"
LIMITS = FormLimits(max_files=2, max_texts=2, max_text_bytes=2048)


def part(name: bytes, content: bytes, filename: bytes | None = None) -> bytes:
    headers = b'Content-Disposition: form-data; name="' + name + b'"'
    if filename is not None:
        headers += b'; filename="' + filename + b'"\r\nContent-Type: image/png'
    return b"--" + BOUNDARY + b"\r\n" + headers + b"\r\n\r\n" + content + b"\r\n"


def form(*parts: bytes) -> bytes:
    return b"".join(parts) + b"--" + BOUNDARY + b"--\r\n"


def parsed(body: bytes, more: str = "") -> Form:
    content_type = f"multipart/form-data; boundary={BOUNDARY.decode()}{more}"
    return parse_form(content_type, body, LIMITS, "a form of a test")


def test_texts_and_files_are_told_apart_by_the_file_name() -> None:
    # What looks like a boundary is content.
    photo = b"\r\n--" + BOUNDARY[:-1] + bytes(range(256)) * 1000 + b"\r\r\n"
    body = form(part(b"map", "Büro".encode()), part(b"image", photo, b""))

    found = parsed(body)

    assert found.texts == {"map": "Büro"}
    assert found.files == {"image": photo}


def test_a_text_of_another_charset_is_read_as_such() -> None:
    body = form(part(b"map", "Büro".encode("utf-16")))

    assert parsed(body, "; charset=utf-16").texts == {"map": "Büro"}
    assert parsed(form(part(b"map", b"B\xfcro")), "; charset=nonsense").texts == {"map": "Büro"}


def test_a_charset_that_fails_in_its_own_way_is_no_mistake_of_ours() -> None:
    assert parsed(form(part(b"map", b"\xff\xfe")), "; charset=idna").texts == {"map": "ÿþ"}


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (form(part(b"a", b"1"), part(b"a", b"2")), "request.duplicate_field"),
        (form(part(b"a", b"1"), part(b"a", b"2", b"f")), "request.duplicate_field"),
        (form(*(part(b"%d" % i, b"") for i in range(3))), "request.malformed"),
        (form(*(part(b"%d" % i, b"", b"f") for i in range(3))), "request.malformed"),
        (form(part(b"a", 2049 * b"1")), "request.malformed"),
        (b"nonsense", "request.malformed"),
        (form(part(b"a", b"1").replace(b"name", b"nome")), "request.malformed"),
        (form(part(b"a", b"1").replace(b"Content", b"C" * 10_000)), "request.malformed"),
    ],
)
def test_a_form_that_is_wrong_or_too_much_is_refused(body: bytes, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parsed(body)
    assert caught.value.code == code


def test_files_may_be_larger_than_texts() -> None:
    assert len(parsed(form(part(b"a", bytes(100_000), b"f"))).files["a"]) == 100_000


def reference(body: bytes) -> list[tuple[str, str | bytes]] | None:
    """What Starlette's asynchronous parser finds; None when it refuses."""

    async def stream() -> AsyncGenerator[bytes, None]:
        for start in range(0, len(body), 50):
            yield body[start : start + 50]

    async def parse() -> list[tuple[str, str | bytes]]:
        content_type = f"multipart/form-data; boundary={BOUNDARY.decode()}"
        parser = MultiPartParser(
            Headers({"content-type": content_type}),
            stream(),
            max_files=LIMITS.max_files,
            max_fields=LIMITS.max_texts,
            max_part_size=LIMITS.max_text_bytes,
        )
        try:
            found = await parser.parse()
            return [
                (name, await value.read() if isinstance(value, UploadFile) else value)
                for name, value in found.multi_items()
            ]
        finally:  # Starlette closes the files of some refused forms only
            for file in parser._files_to_close_on_error:
                file.close()

    try:
        return asyncio.run(parse())
    except MultiPartException:
        return None


@settings(deadline=None)
@given(st.randoms(use_true_random=False))
def test_damaged_forms_are_read_as_starlette_reads_them(source: random.Random) -> None:
    contents = [
        b"",
        b"\r\n--" + BOUNDARY[:-1],
        source.randbytes(source.choice((1, 60, 2048, 2049))),
    ]
    names, files = (b"a", b"b", b"\xe9"), (None, b"", b"f")
    parts = [
        part(source.choice(names), source.choice(contents), source.choice(files))
        for _ in range(source.randrange(4))
    ]
    body = bytearray(form(*parts))
    for _ in range(source.randrange(3)):
        place = source.randrange(len(body))
        body[place : place + source.randrange(3)] = source.choice((b"", b"\r\n", b"-", b":", b"\0"))

    expected = reference(bytes(body))

    if expected is None or len(dict(expected)) < len(expected):
        with pytest.raises(InvalidInput):
            parsed(bytes(body))
    else:
        found = parsed(bytes(body))
        assert {**found.texts, **found.files} == dict(expected)
