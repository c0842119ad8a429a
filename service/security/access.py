"""Access rules of both transports: scopes, rates and web origins."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from time import monotonic
from urllib.parse import unquote

from service.security.key_file import Key, Scope
from service.security.key_ring import KeyRing
from service.settings import ServiceSettings, SettingsError
from service.telemetry.logs import note_key
from visloc.errors import Forbidden, InvalidInput, Unauthenticated, refuse
from visloc_api.v1 import localization_pb2 as pb2

# The scopes that the key of a request must have; None when it needs no key. Unknown paths and
# methods need ANY_KEY, so that only callers with a key learn what exists.
Needed = frozenset[Scope] | None
NOTHING: Needed = None
ANY_KEY: Needed = frozenset()

READ: Needed = frozenset({Scope.READ})

# First parts of the paths of localization. Extensions add theirs before requests come.
LOCALIZING = {"localize"}
_PUBLIC_PATHS = frozenset({"/healthz", "/readyz", "/openapi.json"})
_READING_METHODS = frozenset({"GET", "HEAD"})

_LOCALIZATION, _MAPS = (
    pb2.DESCRIPTOR.services_by_name[name].full_name for name in ("Localization", "Maps")
)
_SCOPES_OF_CALLS = {
    **{
        f"/{_LOCALIZATION}/{name}": Scope.LOCALIZE
        for name in ("Localize", "LocalizeRig", "LocalizeSequence")
    },
    **{f"/{_LOCALIZATION}/{name}": Scope.READ for name in ("ListMaps", "GetMap")},
    f"/{_MAPS}/GetVersion": Scope.READ,
    **{f"/{_MAPS}/{name}": Scope.MANAGE for name in ("PutVersion", "DeleteVersion", "SetCurrent")},
}

_PAGES = frozenset({"/", "/docs", "/redoc"})
_ASSET = re.compile(r"/assets/[^/]+")
# Apps in a web view have schemes of their own, such as capacitor, ionic or tauri.
_ORIGIN = re.compile(r"([a-z][a-z0-9+.-]*)://([a-z0-9._-]+|\[[0-9a-f:]+\])(?::(\d{1,5}))?/?")
_DEFAULT_PORTS = {"http": "80", "https": "443"}
_LARGEST_PORT = 65_535
_NEVER_A_PAGE = ("file", "ftp", "ws", "wss")
# Browsers send null for files and for sandboxed frames, which every web page can contain.
_OF_EVERY_PAGE = ("*", "null")


def needed_over_http(method: str, path: str, *, page: bool = False) -> Needed:
    """Return what an HTTP request needs.

    Args:
        path: with %-escapes decoded.
        page: whether the server has the page, whose files need no key.
    """
    if path in _PUBLIC_PATHS or (page and _is_of_page(method, path)):
        return NOTHING
    match path.split("/")[1:2]:
        case [first] if first in LOCALIZING:
            return frozenset({Scope.LOCALIZE})
        case ["maps"]:
            return frozenset({Scope.READ if method in _READING_METHODS else Scope.MANAGE})
        case ["metrics"]:
            return frozenset({Scope.READ})
    return ANY_KEY


def _is_of_page(method: str, path: str) -> bool:
    if method not in _READING_METHODS:
        return False
    return path in _PAGES or _ASSET.fullmatch(path) is not None


def needed_over_grpc(method: str) -> Needed:
    """Return what a gRPC call needs, by the full name of its method."""
    if method.startswith("/grpc.health.v1.Health/"):
        return NOTHING
    scope = _SCOPES_OF_CALLS.get(method)
    return ANY_KEY if scope is None else frozenset({scope})


def is_method(name: str) -> bool:
    """Tell whether this is one of our own methods."""
    return name in _SCOPES_OF_CALLS


def tokens_of(authorizations: Iterable[str], api_keys: Iterable[str]) -> set[str]:
    """Return the API keys that a caller sent.

    Args:
        authorizations: ``Authorization`` headers; kinds other than Bearer are for a proxy.
    """
    tokens = set(api_keys)
    for authorization in authorizations:
        kind, _, token = authorization.partition(" ")
        if kind.lower() == "bearer":
            tokens.add(token.strip())
    return tokens


@dataclass(slots=True)
class _Use:
    """The current use of a key: a token bucket.

    Attributes:
        left: requests that may come at once; grows with time.
        at: the time of ``left``, seconds.
    """

    running: int
    left: float
    at: float


class Access:
    """Decides who may do what. For one event loop.

    Args:
        ring: the keys; without keys, everyone on this machine may do everything.
        origins: of the web pages that may call, as browsers send them; ``*`` for all. ``*`` and
            ``null`` only with keys.
        now: a clock, seconds.
    """

    def __init__(
        self,
        ring: KeyRing | None,
        origins: Collection[str] = (),
        *,
        proxies: Networks = (),
        now: Callable[[], float] = monotonic,
    ) -> None:
        self._ring = ring
        self.origins = frozenset(origins)
        self._proxies = proxies
        self._now = now
        self._uses: dict[str, _Use] = {}

    def caller(self, peer: str | None, forwarded: Iterable[str]) -> str | None:
        """Return the address of a caller for the log; see ``caller_of``."""
        return caller_of(peer, forwarded, self._proxies)

    def check_page(self, scheme: str, host: str, origins: Collection[str]) -> None:
        """Refuse requests that a foreign web page makes a browser on this machine send.

        Without keys, every request from this machine may do everything. A web page that is open in
        a browser here can send requests to this address, or to a name of its own that resolves
        to it (DNS rebinding).

        Args:
            origins: the ``Origin`` headers.
        """
        if self._ring is not None:
            return
        if not is_loopback(_without_port(host)):
            raise refuse("access.host", field="Host", got=host[:100])
        for origin in origins:
            if origin not in self.origins and origin != f"{scheme}://{host}":
                raise refuse("access.origin", field="Origin", got=origin[:100])

    def key_of(self, tokens: Collection[str], needed: Needed) -> Key | None:
        """Return the key of a request and note it for the log; None when no key is needed.

        Args:
            tokens: the keys that were sent.
        """
        if self._ring is None or needed is None:
            return None
        if not tokens:
            raise refuse("access.key_missing", field="Authorization")
        key = self._ring.find(next(iter(tokens))) if len(set(tokens)) == 1 else None
        if key is None:
            raise refuse("access.key_unknown", field="Authorization")
        note_key(key.name)
        if not needed <= key.scopes:
            raise refuse(
                "access.scope",
                field="Authorization",
                expected=f"a key with the scope {', '.join(sorted(needed))}",
                got=f"one with {', '.join(sorted(key.scopes))}",
            )
        return key

    def may(self, tokens: Collection[str], needed: Needed) -> bool:
        """Tell whether a caller with these keys may have what needs a scope."""
        try:
            self.key_of(tokens, needed)
        except (Unauthenticated, Forbidden):
            return False
        return True

    @contextmanager
    def place(self, key: Key | None) -> Iterator[None]:
        """Count a request of a key while it is served."""
        if key is None:
            yield
            return
        use = self._use_of(key)
        if key.concurrency is not None and use.running >= key.concurrency:
            raise refuse("access.concurrency", expected=f"at most {key.concurrency} at once")
        if use.left < 1:
            raise refuse(
                "access.rate", expected=f"at most {key.rate:g} per second", wait_s=self.wait_s(key)
            )
        use.left -= 1
        use.running += 1
        try:
            yield
        finally:
            use.running -= 1

    def wait_s(self, key: Key | None) -> int:
        """Return the whole seconds, at least one, after which a key may be used again."""
        if key is None or key.rate is None:
            return 1
        return max(1, math.ceil((1 - self._use_of(key).left) / key.rate))

    def _use_of(self, key: Key) -> _Use:
        """Return the use of a key, with ``left`` as it is now."""
        now = self._now()
        if key.rate is None or key.burst is None:
            burst, rate = math.inf, 0.0
        else:
            burst, rate = float(key.burst), key.rate
        use = self._uses.setdefault(key.id, _Use(0, burst, now))
        use.left = min(burst, use.left + rate * (now - use.at))
        use.at = now
        return use


def open_access(settings: ServiceSettings) -> Access:
    """Make the rules of a service; refuse settings that would leave it open."""
    for origin in settings.cors_origins:
        _check_origin(origin, has_keys=settings.keys_file is not None)
    proxies = networks_of(settings.trusted_proxies)
    if settings.keys_file is not None:
        try:
            ring = KeyRing(settings.keys_file)
            return Access(ring, settings.cors_origins, proxies=proxies)
        except InvalidInput as error:
            raise SettingsError(f"keys_file: {error}") from None
    if not is_loopback(settings.host):
        raise SettingsError(
            f"keys_file: needed, because others can reach host {settings.host!r}; make one with "
            "`python -m service.keys init`, or listen on 127.0.0.1 only"
        )
    return Access(None, settings.cors_origins, proxies=proxies)


def _check_origin(origin: str, *, has_keys: bool) -> None:
    """Refuse an origin that no browser sends, or that needs keys."""
    if origin in _OF_EVERY_PAGE:
        if not has_keys:
            raise SettingsError(
                f"cors_origins: {origin} lets every web page call the service, so that keys_file "
                "is needed"
            )
        return
    found = _ORIGIN.fullmatch(origin.lower())
    if found is None or found[1] in _NEVER_A_PAGE or int(found[3] or 0) > _LARGEST_PORT:
        raise SettingsError(
            f"cors_origins: {origin!r} is no origin such as https://maps.example.org, "
            "http://localhost:5173 or capacitor://localhost; name each one with its port, without "
            "a path and without * (null for pages that are files)"
        )
    scheme, host, port = found.groups()
    sent = f"{scheme}://{host}"
    if port is not None and port != _DEFAULT_PORTS.get(scheme):
        sent += f":{port}"
    if origin != sent:
        raise SettingsError(f"cors_origins: {origin!r} is sent by browsers as {sent}; write that")


def is_loopback(host: str) -> bool:
    """Tell whether a host name or an address means this machine only."""
    if host.lower() == "localhost":
        return True
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _without_port(host: str) -> str:
    name, separator, _ = host.partition("]")
    return name + separator if separator else host.partition(":")[0]


Networks = Collection[IPv4Network | IPv6Network]
# Each proxy appends the address that it was called from.
FORWARDED_HEADER = "x-forwarded-for"
_WITH_PORT = re.compile(r"(\[(?P<v6>[^][]*)\]|(?P<v4>[^][:]*))(:[0-9]{1,5})?", re.ASCII)


def networks_of(names: Iterable[str]) -> Networks:
    """Return the networks of proxies.

    Args:
        names: addresses, or networks such as ``10.1.0.0/16``.
    """
    networks = []
    for name in names:
        try:
            networks.append(ip_network(name))
        except ValueError as error:
            raise SettingsError(f"trusted_proxies: {error}") from None
    return tuple(networks)


def caller_of(peer: str | None, forwarded: Iterable[str], proxies: Networks) -> str | None:
    """Return the address of a caller for the log.

    Everybody can send the header, so its entries are read from the last one, and only as long as
    the address that appended the entry is a proxy's.

    Args:
        peer: the address at the other end of the connection; None if unknown.
        forwarded: the ``X-Forwarded-For`` headers, in order.
    """
    if peer is None:
        return None
    entries = [entry.strip() for header in forwarded for entry in header.split(",")]
    caller = peer
    while entries and _is_in(caller, proxies):
        address = _address_of(_address_without_port(entries.pop()))
        if address is None:
            break
        caller = str(address)
    return caller


def address_of_grpc(peer: str) -> str:
    """Return the address in gRPC's name of a peer, such as ``ipv6:%5B::1%5D:5000``."""
    return unquote(peer.partition(":")[2]).rpartition(":")[0].strip("[]")


def _address_without_port(entry: str) -> str:
    """Return the address of an entry such as ``1.2.3.4:5000`` or ``[2001:db8::1]:5000``.

    What has neither form is returned as it is: an IPv6 address without brackets has no port.
    """
    found = _WITH_PORT.fullmatch(entry)
    return entry if found is None else found["v6"] or found["v4"]


def _is_in(address: str, networks: Networks) -> bool:
    parsed = _address_of(address)
    return parsed is not None and any(parsed in network for network in networks)


def _address_of(text: str) -> IPv4Address | IPv6Address | None:
    try:
        address = ip_address(text)
    except ValueError:
        return None
    # A socket for both versions of IP sees 10.0.0.1 as ::ffff:10.0.0.1.
    return getattr(address, "ipv4_mapped", None) or address
