from __future__ import annotations

import pytest

from service.security.access import address_of_grpc, caller_of, networks_of
from service.settings import SettingsError

PROXY, CALLER, FORGED = "10.0.0.7", "203.0.113.9", "198.51.100.1"
TRUSTED = networks_of(["10.0.0.0/24", "fd00::1"])


def test_by_default_nobody_is_believed() -> None:
    assert caller_of(PROXY, [FORGED], ()) == PROXY
    assert caller_of(None, [FORGED], TRUSTED) is None


@pytest.mark.parametrize("forwarded", [[FORGED], [PROXY], [f"{FORGED}, {PROXY}"], ["", "x"]])
def test_a_caller_that_is_no_proxy_cannot_pretend_to_be_another(forwarded: list[str]) -> None:
    assert caller_of(CALLER, forwarded, TRUSTED) == CALLER


@pytest.mark.parametrize(
    "forwarded",
    [
        [CALLER],
        [f"{FORGED}, {CALLER}"],
        [FORGED, CALLER],
        [f"{FORGED},{CALLER} , 10.0.0.8"],
        [f"{FORGED}, {CALLER}", "10.0.0.8", "fd00::1"],
        [f"{PROXY}, {CALLER}"],  # forged: as if the caller were a proxy
    ],
)
def test_behind_proxies_the_last_address_that_is_none_of_them_is_the_callers(
    forwarded: list[str],
) -> None:
    assert caller_of(PROXY, forwarded, TRUSTED) == CALLER
    assert caller_of(f"::ffff:{PROXY}", forwarded, TRUSTED) == CALLER


@pytest.mark.parametrize(
    ("entry", "address"),
    [
        (f"{CALLER}:4711", CALLER),
        (f"[::ffff:{CALLER}]:4711", CALLER),
        ("[2001:db8::1]:4711", "2001:db8::1"),
        ("[2001:db8::1]", "2001:db8::1"),
        ("2001:db8::1:4711", "2001:db8::1:4711"),  # without brackets, all of it is the address
    ],
)
def test_an_entry_may_have_a_port(entry: str, address: str) -> None:
    assert caller_of(PROXY, [f"{FORGED}, {entry}"], TRUSTED) == address
    assert caller_of(PROXY, [f"{entry}, 10.0.0.8:80, [fd00::1]:80"], TRUSTED) == address


@pytest.mark.parametrize(
    "entry",
    [
        *("", "unknown", "a\nkey=admin", "300.1.1.1", "x" * 10_000, "[", "[]", "[]:80"),
        *(f"{CALLER}:", f"{CALLER}:http", f"{CALLER}:4711:4712", f"{CALLER}:123456"),
        *("[2001:db8::1]4711", "[2001:db8::1", "[[2001:db8::1]]:4711"),
    ],
)
def test_what_is_no_address_is_not_logged(entry: str) -> None:
    assert caller_of(PROXY, [entry], TRUSTED) == PROXY
    assert caller_of(PROXY, [f"{FORGED}, {entry}, 10.0.0.8"], TRUSTED) == "10.0.0.8"


def test_without_the_header_the_caller_is_the_proxy() -> None:
    assert caller_of(PROXY, [], TRUSTED) == PROXY


@pytest.mark.parametrize("name", ["10.0.0.300", "10.0.0.1/24", "localhost", "*"])
def test_a_setting_that_is_no_network_is_refused(name: str) -> None:
    with pytest.raises(SettingsError, match=r"^trusted_proxies: "):
        networks_of(["10.0.0.0/24", name])


def test_grpc_writes_addresses_in_its_own_way() -> None:
    assert address_of_grpc("ipv4:127.0.0.1:5000") == "127.0.0.1"
    assert address_of_grpc("ipv6:%5B::1%5D:5000") == "::1"
