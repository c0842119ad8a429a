"""The file of API keys, which ``python -m service.keys`` writes.

A key is ``visloc_ID_SECRET``. The file has the SHA-256 of a salt and the secret, never the
secret. A slow hash, as for passwords, would add nothing: a secret is 256 random bits, which nobody
finds by trying, and every request would pay for it.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from fcntl import LOCK_EX, flock
from pathlib import Path
from typing import Any

from visloc.errors import VislocError, refuse

FORMAT = 1
MAX_FILE_BYTES = 8 * 2**20
_SECRET_BYTES = 32
_SALT_BYTES = 16

_TOKEN = re.compile(r"visloc_(?P<id>[0-9a-f]{12})_(?P<secret>[A-Za-z0-9_-]{43})")
_ID = re.compile(r"[0-9a-f]{12}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
NAME_RULE = "1 to 64 letters, digits, '.', '_', '@' and '-', beginning with letter or digit"


class Scope(StrEnum):
    """What a key is good for. None contains another."""

    LOCALIZE = "localize"
    READ = "read"
    MANAGE = "manage"


@dataclass(frozen=True, slots=True)
class Key:
    """What the file says of a key.

    Attributes:
        id: the part of the key that names it, 12 hexadecimal digits.
        name: whose key it is, for people and logs.
        scopes: what it is good for.
        salt: hashed before the secret.
        digest: SHA-256 of salt and secret.
        created: when, ISO 8601.
        rate: requests per second in the long run; None: any number.
        burst: requests at once after a rest; only with a rate.
        concurrency: requests that are served at once; None: any number.
    """

    id: str
    name: str
    scopes: frozenset[Scope]
    salt: bytes
    digest: bytes
    created: str
    rate: float | None = None
    burst: int | None = None
    concurrency: int | None = None

    def fits(self, secret: str) -> bool:
        """Tell whether this is the key's secret, in a time that says nothing of it."""
        return hmac.compare_digest(_digest(self.salt, secret), self.digest)


def new_key(
    name: str,
    scopes: frozenset[Scope],
    *,
    rate: float | None = None,
    burst: int | None = None,
    concurrency: int | None = None,
) -> tuple[Key, str]:
    """Make a key, and return it with the text that its owner sends and nobody else knows.

    Raises:
        InvalidInput: ``keys.name``, ``keys.scopes``, ``keys.limit``.
    """
    id_, secret = secrets.token_hex(6), secrets.token_urlsafe(_SECRET_BYTES)
    salt = secrets.token_bytes(_SALT_BYTES)
    burst = usual_burst(rate) if burst is None else burst
    key = Key(
        *(id_, name, scopes, salt, _digest(salt, secret)),
        datetime.now(UTC).isoformat(timespec="seconds"),
        *(rate, burst, concurrency),
    )
    check_key(key, "keys")
    return key, f"visloc_{id_}_{secret}"


def usual_burst(rate: float | None) -> int | None:
    """Return the requests that may come at once where nobody said: those of a second."""
    return None if rate is None or not math.isfinite(rate) else max(1, math.ceil(rate))


def split_token(token: str) -> tuple[str, str] | None:
    """Return id and secret of what was sent as a key, None where it has not the form of one."""
    match = _TOKEN.fullmatch(token)
    return None if match is None else (match["id"], match["secret"])


def read_keys(path: Path) -> tuple[Key, ...]:
    """Read the keys of a file.

    Raises:
        InvalidInput: ``keys.file``, ``keys.permissions``, ``keys.name``, ``keys.scopes``,
            ``keys.limit``; the field is the file, and the entry within.
    """
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
        raise _malformed(path, f"at most {MAX_FILE_BYTES} bytes", "more")
    try:
        entries = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise _malformed(path, "JSON", str(error)) from None
    match entries:
        case {"format": int(version), "keys": list(keys)} if version == FORMAT:
            read = tuple(_key_of(entry, f"{path}: keys[{i}]") for i, entry in enumerate(keys))
        case _:
            raise _malformed(path, f'an object with "format": {FORMAT} and a list "keys"', "else")
    for part in ("id", "name"):
        if len({getattr(key, part) for key in read}) < len(read):
            raise _malformed(path, f"each {part} once", "one twice")
    return read


@contextmanager
def edited_keys(path: Path) -> Iterator[list[Key]]:
    """Give the keys of a file, none where there is no file, and write what is made of them.

    Nobody else edits them meanwhile, and whoever reads sees the old file or the new one.

    Raises:
        InvalidInput: as ``read_keys``.
        OSError: when the folder cannot be written.
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
    text = json.dumps({"format": FORMAT, "keys": [_entry_of(key) for key in keys]}, indent=2)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 600
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _digest(salt: bytes, secret: str) -> bytes:
    return hashlib.sha256(salt + secret.encode()).digest()


def _entry_of(key: Key) -> Mapping[str, object]:
    return {
        "id": key.id,
        "name": key.name,
        "scopes": sorted(key.scopes),
        "created": key.created,
        "salt": key.salt.hex(),
        "sha256": key.digest.hex(),
        "rate": key.rate,
        "burst": key.burst,
        "concurrency": key.concurrency,
    }


def _key_of(entry: Any, field: str) -> Key:
    names = {"id", "name", "scopes", "created", "salt", "sha256", "rate", "burst", "concurrency"}
    if not isinstance(entry, dict) or entry.keys() != names:
        raise _malformed(field, f"an object with {', '.join(sorted(names))}", type(entry).__name__)
    texts = [entry[name] for name in ("id", "name", "created", "salt", "sha256")]
    if not all(isinstance(text, str) for text in texts) or not isinstance(entry["scopes"], list):
        raise _malformed(field, "texts, and a list of scopes", "another type")
    id_, name, created, salt, digest = texts
    try:
        key = Key(
            id=id_,
            name=name,
            scopes=frozenset(map(Scope, entry["scopes"])),
            salt=bytes.fromhex(salt),
            digest=bytes.fromhex(digest),
            created=created,
            rate=entry["rate"],
            burst=entry["burst"],
            concurrency=entry["concurrency"],
        )
    except (ValueError, TypeError) as error:  # an unknown scope, no hexadecimal digits
        raise _malformed(field, f"scopes of {', '.join(Scope)}; hexadecimal", str(error)) from None
    sizes = (len(key.salt), len(key.digest))
    if not _ID.fullmatch(id_) or sizes != (_SALT_BYTES, hashlib.sha256().digest_size):
        raise _malformed(field, "the id, the salt and the sha256 that this program wrote", "else")
    check_key(key, field)
    return key


def check_key(key: Key, field: str) -> None:
    """Refuse a name, scopes or limits that cannot be used.

    Raises:
        InvalidInput: ``keys.name``, ``keys.scopes``, ``keys.limit``.
    """
    if not _NAME.fullmatch(key.name):
        raise refuse("keys.name", field=field, expected=NAME_RULE, got=key.name)
    if not key.scopes:
        raise refuse("keys.scopes", field=field, expected=f"some of {', '.join(Scope)}")
    is_rate = key.rate is None or (_is_number(key.rate) and 0 < key.rate <= 1e6)
    counts = (key.burst, key.concurrency)
    are_counts = all(n is None or (type(n) is int and 1 <= n <= 10**6) for n in counts)
    if not is_rate or not are_counts or (key.rate is None) != (key.burst is None):
        raise refuse(
            "keys.limit",
            field=field,
            got=f"rate {key.rate}, burst {key.burst}, concurrency {key.concurrency}",
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _malformed(field: object, expected: str, got: str) -> VislocError:
    return refuse("keys.file", field=str(field), expected=expected, got=got)
