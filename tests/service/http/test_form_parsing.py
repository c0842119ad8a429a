from __future__ import annotations

import pytest

from service.http.bodies import Form, parse_form
from visloc.errors import InvalidInput

BOUNDARY = b"--x7Y"
TEXTS = ("a", "b", "map", "0", "1", "2")


def part(name: bytes, content: bytes, filename: bytes | None = None, *, more: bytes = b"") -> bytes:
    headers = b'Content-Disposition: form-data; name="' + name + b'"' + more
    if filename is not None:
        headers += b'; filename="' + filename + b'"\r\nContent-Type: image/png'
    return b"--" + BOUNDARY + b"\r\n" + headers + b"\r\n\r\n" + content + b"\r\n"


def form(*parts: bytes) -> bytes:
    return b"".join(parts) + b"--" + BOUNDARY + b"--\r\n"


def parsed(body: bytes, more: str = "") -> Form:
    content_type = f"multipart/form-data; boundary={BOUNDARY.decode()}{more}"
    return parse_form(
        content_type,
        body,
        max_parts=4,
        max_text_bytes=2048,
        text_names=TEXTS,
        expected="a form of a test",
    )


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
        (form(*(part(b"%d" % i, b"") for i in range(5))), "request.malformed"),
        (form(*(part(b"%d" % i, b"", b"f") for i in range(5))), "request.malformed"),
        (b"nonsense", "request.malformed"),
        (form(part(b"a", b"1").replace(b"name", b"nome")), "request.malformed"),
        (form(part(b"a", b"1").replace(b"Content", b"C" * 10_000)), "request.malformed"),
    ],
)
def test_a_form_that_is_wrong_or_too_much_is_refused(body: bytes, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parsed(body)
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("body", "field", "message"),
    [
        (form(part(b"a", 2049 * b"1")), "a", "more than 2048 bytes"),
        (form(part(b"a", b"1", more=b"\r\nContent-Transfer-Encoding: zip")), None, "Transfer"),
        (form(part(b"a", b"1")) + b"\r\n" + form(part(b"b", b"2")), None, "after its closing"),
        (b"\r\nlost" + form(part(b"a", b"1")), None, "begin with the boundary"),
        (form(part(b"a", b"1")).replace(b"\r\n", b"\n"), None, "no multipart"),
    ],
)
def test_refusal_of_a_form_names_the_part_and_the_reason(
    body: bytes, field: str | None, message: str
) -> None:
    with pytest.raises(InvalidInput, match=message) as caught:
        parsed(body)
    assert (caught.value.code, caught.value.field) == ("request.malformed", field)


def test_files_may_be_larger_than_texts() -> None:
    assert len(parsed(form(part(b"a", bytes(100_000), b"f"))).files["a"]) == 100_000


PHOTO = b"\xff\xd8\xff" + bytes(range(256)) * 20


@pytest.mark.parametrize(
    ("body", "texts", "files"),
    [
        (part(b"image", PHOTO), {}, {"image": PHOTO}),
        (part(b"image", PHOTO, more=b"; filename*=UTF-8''ph%C3%B6to.jpg"), {}, {"image": PHOTO}),
        (part(b"features", b"{" + 3000 * b" " + b"}"), {"features": "{" + 3000 * " " + "}"}, {}),
        (part(b"image", b"photo.jpg"), {"image": "photo.jpg"}, {}),
        (part(b"mask", b"", b""), {}, {"mask": b""}),
        (part(b"map", b"B\xfcro"), {"map": "Büro"}, {}),
        (part(b"map", b"1", more=b"\r\nContent-Transfer-Encoding: 8bit"), {"map": "1"}, {}),
        (part(b"map", b"MQ==", more=b"\r\nContent-Transfer-Encoding: base64"), {"map": "1"}, {}),
    ],
)
def test_bytes_without_a_file_name_are_a_file(
    body: bytes, texts: dict[str, str], files: dict[str, bytes]
) -> None:
    assert parsed(form(body)) == Form(texts, files)


@pytest.mark.parametrize("before", [b"", b"\r\n"])  # Unity begins with a line end
@pytest.mark.parametrize(
    "last",
    [
        part(b"b", b"PINHOLE,1,1,1,1,1,1"),
        part(b"b", b'{"min_probability": 1}'),
        part(b"mask", PHOTO[:400], b"mask.png"),
        part(b"mask", b"\r\n--" + BOUNDARY[:-1] + b"--\r\n", b"mask.png"),
        part(b"b", b""),
    ],
)
def test_form_cut_at_any_byte_is_refused_or_means_the_same(last: bytes, before: bytes) -> None:
    body = before + form(part(b"map", b"room"), part(b"image", PHOTO[:300], b"a.jpg"), last)
    whole, enough = parsed(body), len(body) - len(b"\r\n")

    for length in range(enough):
        with pytest.raises(InvalidInput) as caught:
            parsed(body[:length])
        assert caught.value.code == "request.malformed"
    for length in range(enough, len(body)):
        assert parsed(body[:length]) == whole
