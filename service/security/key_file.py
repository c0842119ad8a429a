"""The file of API keys, which ``python -m service.keys`` writes.

A key is ``visloc_ID_SECRET``. The file holds the SHA-256 of a salt and the secret, never the
secret. A slow hash, as for passwords, would add nothing: a secret is 256 random bits, which nobody
can guess, and every request would pay for the hash.
"""

from __future__ import annotations

import codecs
import hashlib
import hmac
import math
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from fcntl import LOCK_EX, flock
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, PlainSerializer, TypeAdapter, ValidationError

from visloc.errors import VislocError, refuse

FORMAT: Literal[1] = 1
MAX_FILE_BYTES = 8 * 2**20
_SECRET_BYTES = 32
_SALT_BYTES = 16

_TOKEN = re.compile(r"visloc_(?P<id>[0-9a-f]{12})_(?P<secret>[A-Za-z0-9_-]{43})")
NAME_RULE = "1 to 64 letters, digits, '.', '_', '@' and '-', beginning with letter or digit"


class Scope(StrEnum):
    """The rights that a key may have. No scope contains another."""

    LOCALIZE = "localize"
    READ = "read"
    MANAGE = "manage"


_CONFIG = ConfigDict(
    extra="forbid",
    strict=True,
    revalidate_instances="always",
    val_json_bytes="hex",
    ser_json_bytes="hex",
)
_Limit = Annotated[int, Field(ge=1, le=10**6)]


@dataclass(frozen=True, slots=True)
class Key:
    """An entry of the file.

    Attributes:
        id: names the key within its token.
        name: the owner, for people and logs.
        created: ISO 8601.
        sha256: of salt and secret.
        rate: requests per second in the long run; None: any number.
        burst: requests at once after a pause; only with a rate.
        concurrency: requests served at once; None: any number.
    """

    id: Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$")]
    scopes: Annotated[frozenset[Scope], Field(min_length=1), PlainSerializer(sorted)]
    created: str
    salt: Annotated[bytes, Field(min_length=_SALT_BYTES, max_length=_SALT_BYTES)]
    sha256: Annotated[bytes, Field(min_length=32, max_length=32)]
    rate: Annotated[float, Field(gt=0, le=1e6)] | None
    burst: _Limit | None
    concurrency: _Limit | None

    __pydantic_config__ = _CONFIG

    def fits(self, secret: str) -> bool:
        """Compare a secret with the key's in constant time."""
        return hmac.compare_digest(_sha256(self.salt, secret), self.sha256)


@dataclass(frozen=True, slots=True)
class _KeyFile:
    format: Literal[1]
    keys: tuple[Key, ...]


_KEY = TypeAdapter(Key)
_KEY_FILE = TypeAdapter(_KeyFile)


def new_key(
    name: str,
    scopes: frozenset[Scope],
    *,
    rate: float | None = None,
    burst: int | None = None,
    concurrency: int | None = None,
) -> tuple[Key, str]:
    """Make a key; return it with its token, which only its owner may know."""
    id_, secret = secrets.token_hex(6), secrets.token_urlsafe(_SECRET_BYTES)
    salt = secrets.token_bytes(_SALT_BYTES)
    burst = usual_burst(rate) if burst is None else burst
    created = datetime.now(UTC).isoformat(timespec="seconds")
    sha256 = _sha256(salt, secret)
    key = Key(id_, name, scopes, created, salt, sha256, rate, burst, concurrency)
    check_key(key, "keys")
    return key, f"visloc_{id_}_{secret}"


def usual_burst(rate: float | None) -> int | None:
    """Return the default burst of a rate: the requests of one second."""
    return None if rate is None or not math.isfinite(rate) else max(1, math.ceil(rate))


def split_token(token: str) -> tuple[str, str] | None:
    """Return the id and the secret of a token, None for text of another form."""
    match = _TOKEN.fullmatch(token)
    return None if match is None else (match["id"], match["secret"])


def read_keys(path: Path) -> tuple[Key, ...]:
    """Read the keys of a file."""
    content = _content_of(path)
    try:
        keys = _KEY_FILE.validate_json(content.removeprefix(codecs.BOM_UTF8)).keys
    except ValidationError as refused:
        raise _refusal(refused, str(path)) from None
    for number, key in enumerate(keys):
        _check_burst(key, f"{path}: keys[{number}]")
    for part in ("id", "name"):
        if len({getattr(key, part) for key in keys}) < len(keys):
            raise _malformed(str(path), f"each {part} once", "one twice")
    return keys


def _content_of(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise refuse(
            "keys.file",
            "the file of API keys cannot be read; `python -m service.keys init` makes one",
            field=str(path),
            got=error.strerror,
        ) from None
    if mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise refuse("keys.permissions", field=str(path), got=f"{stat.S_IMODE(mode):o}")
    if len(content) > MAX_FILE_BYTES:
        raise _malformed(str(path), f"at most {MAX_FILE_BYTES} bytes", "more")
    return content


def check_key(key: Key, field: str) -> None:
    """Refuse a key with a wrong name, wrong scopes or wrong limits."""
    try:
        _KEY.validate_python(key)
    except ValidationError as refused:
        raise _refusal(refused, field) from None
    _check_burst(key, field)


def _check_burst(key: Key, field: str) -> None:
    if (key.rate is None) != (key.burst is None):
        raise _bad_limit(field, f"rate {key.rate}, burst {key.burst}")


def _refusal(refused: ValidationError, field: str) -> VislocError:
    """Turn the first of pydantic's errors into ours."""
    error = refused.errors(include_url=False)[0]
    match error["loc"]:
        case ("keys", int(number), *place):
            field = f"{field}: keys[{number}]"
        case place:
            pass
    match error["type"], *place:
        case "string_pattern_mismatch", "name":
            got = error["input"]
            return refuse("keys.name", field=field, expected=NAME_RULE, got=got)
        case "too_short", "scopes":
            return refuse("keys.scopes", field=field, expected=f"some of {', '.join(Scope)}")
        case kind, ("rate" | "burst" | "concurrency") as name if kind != "missing":
            return _bad_limit(field, f"{name} {error['input']}")
    got = " ".join([*map(str, place), error["msg"]])
    return _malformed(field, f'"format": {FORMAT} and "keys", as this program writes them', got)


def _bad_limit(field: str, got: str) -> VislocError:
    return refuse("keys.limit", field=field, got=got)


def _malformed(field: str, expected: str, got: str) -> VislocError:
    return refuse("keys.file", field=field, expected=expected, got=got)


@contextmanager
def edited_keys(path: Path) -> Iterator[list[Key]]:
    """Give the keys of a file, none if it does not exist, and write the list back if it changed.

    A lock keeps other editors out. Readers see either the old file or the new one.
    """
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        flock(folder, LOCK_EX)
        before = read_keys(path) if path.exists() else ()
        keys = list(before)
        yield keys
        if tuple(keys) != before:
            _write(path, keys)
            os.fsync(folder)
    finally:
        os.close(folder)  # and with it the lock


def _write(path: Path, keys: Sequence[Key]) -> None:
    content = _KEY_FILE.dump_json(_KeyFile(FORMAT, tuple(keys)), indent=2)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 600
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content + b"\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _sha256(salt: bytes, secret: str) -> bytes:
    return hashlib.sha256(salt + secret.encode()).digest()
