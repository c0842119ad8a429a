"""``python -m service.keys``: create, list, limit and remove API keys."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from service.security.key_file import (
    NAME_RULE,
    Key,
    Scope,
    check_key,
    edited_keys,
    new_key,
    read_keys,
    usual_burst,
)
from visloc.errors import VislocError, refuse


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``python -m service.keys``; errors are one line."""
    given = _parser().parse_args(arguments)
    try:
        given.run(given)
    except (VislocError, OSError) as error:
        sys.exit(f"visloc-keys: {error}")


def _init(given: argparse.Namespace) -> None:
    with edited_keys(given.file) as keys:
        if keys:
            _say(f"{given.file} has keys already: nothing was changed")
            return
        key, token = new_key(given.name, frozenset(Scope))
        keys.append(key)
    _tell(key, token)


def _add(given: argparse.Namespace) -> None:
    scopes = frozenset(given.scope)
    limits = {"rate": given.rate, "burst": given.burst, "concurrency": given.concurrency}
    key, token = new_key(given.name, scopes, **limits)
    with edited_keys(given.file) as keys:
        if any(key.name in (other.name, other.id) or key.id == other.id for other in keys):
            raise refuse("keys.exists", field="name", got=key.name)
        keys.append(key)
    _tell(key, token)


def _limit(given: argparse.Namespace) -> None:
    burst = usual_burst(given.rate) if given.burst is None else given.burst
    with edited_keys(given.file) as keys:
        place = _place(keys, given.key)
        changed = replace(keys[place], rate=given.rate, burst=burst, concurrency=given.concurrency)
        check_key(changed, "keys")
        keys[place] = changed
    _say(_line(changed))


def _remove(given: argparse.Namespace) -> None:
    with edited_keys(given.file) as keys:
        removed = keys.pop(_place(keys, given.key))
    _say(f"removed {removed.name} ({removed.id})")


def _list(given: argparse.Namespace) -> None:
    for key in read_keys(given.file):
        _say(_line(key))


def _place(keys: Sequence[Key], key: str) -> int:
    for place, candidate in enumerate(keys):
        if key in (candidate.id, candidate.name):
            return place
    raise refuse("keys.unknown", field="key", got=key)


def _tell(key: Key, token: str) -> None:
    # The token alone goes to stdout, so that scripts can read it.
    _say(token)
    sys.stderr.write(
        f"{_line(key)}\nStore the key above: it is not shown again, the file has only its hash.\n"
    )


def _line(key: Key) -> str:
    rate = "any rate" if key.rate is None else f"{key.rate:g}/s, burst {key.burst}"
    concurrency = "any number" if key.concurrency is None else key.concurrency
    scopes = ",".join(sorted(key.scopes))
    return f"{key.id}  {key.name}  {scopes}  {rate}  {concurrency} at once  {key.created}"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m service.keys",
        description="Manage the API keys of the service. A running service notices changes.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--file", type=Path, default=Path("keys.json"), help="the key file (default: %(default)s)"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    init = commands.add_parser("init", help="create a key with all scopes, if the file has none")
    init.add_argument("--name", default="admin", help="(default: %(default)s)")
    init.set_defaults(run=_init)

    add = commands.add_parser("add", help="create a key and print it once")
    add.add_argument("name", help=f"its owner: {NAME_RULE}")
    add.add_argument(
        "--scope",
        action="append",
        required=True,
        type=Scope,
        choices=tuple(Scope),
        help="repeatable; localize: photos; read: maps and metrics; manage: change maps",
    )
    _add_limits(add)
    add.set_defaults(run=_add)

    limit = commands.add_parser(
        "limit", help="replace the limits of a key; a limit left out is removed"
    )
    limit.add_argument("key", help="id or name")
    _add_limits(limit)
    limit.set_defaults(run=_limit)

    remove = commands.add_parser("remove", help="revoke a key")
    remove.add_argument("key", help="id or name")
    remove.set_defaults(run=_remove)

    commands.add_parser("list", help="list the keys").set_defaults(run=_list)
    return parser


def _add_limits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rate", type=float, metavar="N", help="requests per second")
    parser.add_argument(
        "--burst", type=int, metavar="N", help="requests at once after a pause (default: the rate)"
    )
    parser.add_argument("--concurrency", type=int, metavar="N", help="requests served at once")


if __name__ == "__main__":
    main()
