from __future__ import annotations

import base64
import json
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from visloc.errors import InvalidInput, TooLarge
from visloc_api.words import json_text
from visloc_api.words.json_text import bytes_of_base64, check_json_values, check_names, utf8_json

LONG = "A" * 5000
texts = st.text() | st.text(alphabet='ab",:\\{}', min_size=1000, max_size=1100)
values = st.recursive(
    st.none() | st.integers() | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)


@given(values)
def test_json_without_double_names_is_accepted(value: object) -> None:
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False)):
        check_names(text)
        check_names(text.encode("utf-8", "surrogatepass"))


@pytest.mark.parametrize("as_text", [str, str.encode])
@pytest.mark.parametrize(
    "text",
    [
        f'{{"{LONG}": 1, "b": {{"a": "{LONG}"}}, "{LONG}": 2}}',
        f'{{"a": "{LONG}", "b": "\\"", "a": "{LONG}"}}',
        f'[{{"a": ["{LONG}\\"{LONG}"], "a": 1}}]',
    ],
)
def test_a_name_twice_is_found_beside_long_texts(text: str, as_text: type) -> None:
    with pytest.raises(InvalidInput) as caught:
        check_names(as_text(text))
    assert caught.value.code == "request.duplicate_field"


@pytest.mark.parametrize("text", ['{"a": "b"}', '["a"]'])
def test_json_may_have_many_spaces_around_it(text: str) -> None:
    spaces = " " * 2000
    for padded in (spaces + text, text + spaces, text[:-1] + spaces + text[-1:]):
        check_names(padded)
        check_names(padded.encode())


def test_long_names_that_differ_at_their_end_are_two() -> None:
    check_names(f'{{"{LONG}a": 1, "{LONG}b": 2}}')


def test_quotes_within_texts_are_counted_too() -> None:
    """They are looked at one by one."""
    check_json_values(json.dumps({"a": "b" * 1000}), 1)
    with pytest.raises(TooLarge):
        check_json_values(json.dumps({"a": '"' * 1000}).encode(), 100)


@given(st.binary(max_size=60))
def test_base64_is_decoded_in_pieces_as_if_at_once(data: bytes) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_text, "_PIECE", 8)
        assert bytes_of_base64(base64.b64encode(data).decode()) == data


@pytest.mark.parametrize(
    "spell",
    [
        lambda text: "\n".join(text[i : i + 76] for i in range(0, len(text), 76)) + "\n",
        lambda text: "\r\n".join(text[i : i + 64] for i in range(0, len(text), 64)),
        lambda text: "\r\n".join(text) + "\r\n" * 9,
        lambda text: text.replace("+", "-").replace("/", "_").rstrip("="),
        lambda text: f"data:image/jpeg;base64,{text}",
        lambda text: f"DATA:;charset=utf-8;BASE64,{text}\n",
        lambda text: f" \t{text} ",
    ],
)
@given(data=st.binary(max_size=200))
def test_base64_is_read_in_every_spelling(spell: Callable[[str], str], data: bytes) -> None:
    for piece in (8, 2**20):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(json_text, "_PIECE", piece)
            assert bytes_of_base64(spell(base64.b64encode(data).decode())) == data


@pytest.mark.parametrize(
    "text",
    [
        *(
            "AAAAAAA=AAAA",
            "AAAAAA==AAAAAAAA",
            "AAAAAAAAA",
            "AAAA AAAAAAA",
            "\u00e4AAAAAAAAAAA",
            "=",
        ),
        *("data:image/svg+xml,<svg/>", "data:AAAA", "data:text/plain,a;base64,AAAA", "%2BAAA"),
    ],
)
def test_what_is_no_base64_is_none_in_pieces_either(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  binascii.Error, and that of letters
        base64.b64decode(text, validate=True)
    monkeypatch.setattr(json_text, "_PIECE", 8)
    with pytest.raises(ValueError):  # noqa: PT011
        bytes_of_base64(text)


@pytest.mark.parametrize("text", ["{}", '{"a": "\u00e4"}', ""])
def test_byte_order_mark_is_passed_over(text: str) -> None:
    assert utf8_json(text.encode("utf-8-sig")) == utf8_json(text.encode()) == text.encode()
    assert utf8_json("\ufeff" + text) == text


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be"])
def test_json_of_another_encoding_is_refused_by_name(encoding: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        utf8_json('{"map": "room"}'.encode(encoding))
    assert (caught.value.code, caught.value.expected) == ("request.malformed", "JSON in UTF-8")
