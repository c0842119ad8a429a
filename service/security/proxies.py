"""The address of a caller, also behind proxies that the operator trusts."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from urllib.parse import unquote

from service.settings import SettingsError

Networks = Collection[IPv4Network | IPv6Network]
# Each proxy appends the address that it was called from.
FORWARDED_HEADER = "x-forwarded-for"
_WITH_PORT = re.compile(r"(\[(?P<v6>[^][]*)\]|(?P<v4>[^][:]*))(:[0-9]{1,5})?", re.ASCII)


def networks_of(names: Iterable[str]) -> Networks:
    """Return the networks of proxies.

    Args:
        names: addresses, or networks such as ``10.1.0.0/16``.

    Raises:
        SettingsError: for one that is neither.
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
        address = _address_of(_without_port(entries.pop()))
        if address is None:
            break
        caller = str(address)
    return caller


def address_of_grpc(peer: str) -> str:
    """Return the address in gRPC's name of a peer, such as ``ipv6:%5B::1%5D:5000``."""
    return unquote(peer.partition(":")[2]).rpartition(":")[0].strip("[]")


def _without_port(entry: str) -> str:
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
