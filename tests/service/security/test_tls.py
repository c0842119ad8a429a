from __future__ import annotations

import asyncio
import io
import logging
import shutil
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    KeySerializationEncryption,
    NoEncryption,
    PrivateFormat,
)

from clients import AsyncClient, Client
from service.security.access import ANY_KEY, needed_over_http
from service.security.key_file import Scope, edited_keys, new_key
from service.security.tls import Certificate, open_certificate
from service.server import Server
from service.settings import ServiceSettings, SettingsError
from service.telemetry.logs import TextFormatter
from visloc.errors import Forbidden, NotFound, Unauthenticated, Unavailable


def make_certificate(
    folder: Path,
    name: str = "server",
    encryption: KeySerializationEncryption | None = None,
    *,
    host: str = "localhost",
    days: tuple[float, float] = (-1, 1),
) -> tuple[Path, Path]:
    """Write a certificate of a host, for localhost of 127.0.0.1 too, and its key.

    Args:
        days: from now, between which it is valid.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, host)])
    names: list[x509.GeneralName] = [x509.DNSName(host)]
    if host == "localhost":
        names.append(x509.IPAddress(ip_address("127.0.0.1")))
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + timedelta(days=days[0]))
        .not_valid_after(now + timedelta(days=days[1]))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / f"{name}.pem", folder / f"{name}.key"
    paths[0].write_bytes(certificate.public_bytes(Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption or NoEncryption())
    )
    return paths


def settings(certificate: Path | None, key: Path | None) -> ServiceSettings:
    return ServiceSettings(tls_cert=certificate, tls_key=key)


def test_without_a_certificate_nothing_is_encrypted() -> None:
    assert open_certificate(settings(None, None)) is None


def test_a_certificate_with_its_key_is_used(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)

    opened = open_certificate(settings(certificate, key))

    assert opened is not None
    parsed = x509.load_pem_x509_certificate(certificate.read_bytes())
    assert opened.ends == parsed.not_valid_after_utc.timestamp()
    assert opened.context.minimum_version >= ssl.TLSVersion.TLSv1_2


def test_one_without_the_other_is_refused_by_name(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    with pytest.raises(SettingsError, match=r"^tls_key: tls_cert was given without it"):
        open_certificate(settings(certificate, None))
    with pytest.raises(SettingsError, match=r"^tls_cert: tls_key was given without it"):
        open_certificate(settings(None, key))


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    key.unlink()
    with pytest.raises(SettingsError, match=r"^tls_key: .*server\.key cannot be read: No such"):
        open_certificate(settings(certificate, key))


def test_files_that_are_no_pair_are_refused(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    _, other_key = make_certificate(tmp_path, "other")
    garbage = tmp_path / "garbage"
    garbage.write_bytes(b"\x00garbage")
    for pair in ((certificate, other_key), (certificate, garbage), (key, certificate)):
        with pytest.raises(SettingsError, match=r"^tls_cert, tls_key: .* are not a certificate"):
            open_certificate(settings(*pair))


def test_a_key_with_a_password_is_refused_and_asks_nobody(tmp_path: Path) -> None:
    encryption = BestAvailableEncryption(b"secret")
    with pytest.raises(SettingsError, match="not encrypted"):
        open_certificate(settings(*make_certificate(tmp_path, encryption=encryption)))


@pytest.mark.parametrize("years", [10, 40])
def test_the_end_of_a_chain_is_that_of_its_first_certificate_to_end(
    tmp_path: Path, years: int
) -> None:
    """After 2049, certificates write times in another way."""
    certificate, key = make_certificate(tmp_path, days=(-1, 365 * years))
    assert Certificate(certificate, key).ends > time.time() + 86_400 * 364 * years

    above, _ = make_certificate(tmp_path, "above", days=(-1, 5))
    certificate.write_bytes(certificate.read_bytes() + above.read_bytes())
    assert Certificate(certificate, key).ends < time.time() + 86_400 * 6


def replace(certificate: tuple[Path, Path], by: tuple[Path, Path]) -> None:
    for old, new in zip(certificate, by, strict=True):
        new.replace(old)


def test_half_a_renewal_keeps_the_old_pair_and_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = make_certificate(tmp_path)
    opened = Certificate(*files)
    old = opened.context
    certificate, key = make_certificate(tmp_path, "new", days=(-1, 90))

    certificate.replace(files[0])
    assert opened.context is opened.context is old
    assert caplog.text.count("the certificate was not reloaded") == 1
    files[1].unlink()
    assert opened.context is old
    key.replace(files[1])
    assert opened.context is not old
    assert opened.ends > time.time() + 86_400 * 80


def test_an_expired_certificate_is_logged_at_the_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Certificate(*make_certificate(tmp_path, days=(-3, -1)))
    assert "has expired" in caplog.text


# The service itself, with a certificate and keys, asked by its own clients


class Guarded(NamedTuple):
    http: str
    grpc: str
    ca: Path
    keys: dict[Scope, str]

    def client(self, door: str, scope: Scope) -> Client:
        return Client(getattr(self, door), api_key=self.keys[scope], ca=self.ca)


@pytest.fixture(scope="module")
def guarded(
    tmp_path_factory: pytest.TempPathFactory, serve: Callable[..., Any]
) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("guarded")
    certificate, private_key = make_certificate(folder)
    tokens = {}
    with edited_keys(folder / "keys.json") as keys:
        for scope in Scope:
            key, tokens[scope] = new_key(scope.value, frozenset({scope}))
            keys.append(key)
    files = {"keys_file": folder / "keys.json", "tls_cert": certificate, "tls_key": private_key}
    (folder / "maps").mkdir()
    # What is asked here needs no worker.
    with serve(folder / "maps", load=False, host="127.0.0.1", **files) as doors:
        http_port, grpc_port = doors.server.http_port, doors.server.grpc_port
        yield Guarded(
            f"https://127.0.0.1:{http_port}", f"grpcs://localhost:{grpc_port}", certificate, tokens
        )


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_a_key_and_the_right_authority_open_the_door(guarded: Guarded, door: str) -> None:
    with guarded.client(door, Scope.READ) as client:
        assert client.maps() == []
        assert client.server_info().version

    async def ask() -> None:
        url, key = getattr(guarded, door), guarded.keys[Scope.READ]
        async with AsyncClient(url, api_key=key, ca=guarded.ca) as client:
            assert await client.maps() == []

    asyncio.run(ask())


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_the_server_says_over_both_doors_why_it_refuses(guarded: Guarded, door: str) -> None:
    url = getattr(guarded, door)
    with Client(url, ca=guarded.ca) as client, pytest.raises(Unauthenticated) as missing:
        client.maps()
    assert missing.value.code == "access.key_missing"
    with guarded.client(door, Scope.READ) as client:
        for ask in (
            lambda client=client: client.localize(b"photo", "room"),
            lambda client=client: client.use_version("room", "1"),
            lambda client=client: client.delete_version("room", "1"),
        ):
            with pytest.raises(Forbidden) as caught:
                ask()
            assert caught.value.code == "access.scope"
    with guarded.client(door, Scope.LOCALIZE) as client, pytest.raises(Forbidden):
        client.maps()
    with guarded.client(door, Scope.MANAGE) as client:
        with pytest.raises(NotFound):
            client.delete_version("room", "1")
        with pytest.raises(Forbidden):
            client.map_version("room", "1")


@contextmanager
def access_log() -> Iterator[Callable[..., str]]:
    """The access log; the function waits for a line with these facts, and returns it."""
    log, written = logging.getLogger("service.access"), io.StringIO()
    handler = logging.StreamHandler(written)
    handler.setFormatter(TextFormatter())
    log.addHandler(handler)
    level = log.level
    log.setLevel(logging.INFO)

    def line_with(*facts: str) -> str:
        deadline = time.monotonic() + 20
        while True:
            for line in written.getvalue().splitlines():
                if all(fact in line for fact in facts):
                    return line
            assert time.monotonic() < deadline, written.getvalue()
            time.sleep(0.01)  # the caller is answered first

    try:
        yield line_with
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


# Routes over HTTP, calls over gRPC, of what the client asks for.
ROUTES = {"http": '"GET /maps/{ref}"', "grpc": "GetMap"}


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_the_log_names_key_route_and_caller_of_a_refusal(guarded: Guarded, door: str) -> None:
    with access_log() as line_with:
        with guarded.client(door, Scope.LOCALIZE) as client, pytest.raises(Forbidden):
            client.map("hall")
        line = line_with(f"route={ROUTES[door]}", "key=localize")
    assert "code=access.scope" in line
    assert "peer=127.0.0.1" in line


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_the_log_names_the_route_of_a_caller_without_a_key(guarded: Guarded, door: str) -> None:
    url = getattr(guarded, door)
    with access_log() as line_with:
        with Client(url, ca=guarded.ca) as client, pytest.raises(Unauthenticated):
            client.map("hall")
        line = line_with(f"route={ROUTES[door]}", "code=access.key_missing")
    assert "key=" not in line


def test_what_is_no_route_has_no_name_in_the_log(guarded: Guarded) -> None:
    context = ssl.create_default_context(cafile=guarded.ca)
    for path, method in (("/admin/x", "GET"), ("/localize", "DELETE")):
        with access_log() as line_with:
            refused = httpx.request(method, guarded.http + path, verify=context)
            assert line_with("route=unmatched", "status=401")
        assert refused.status_code == 401


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_a_server_that_the_client_does_not_trust_gets_no_key(
    guarded: Guarded, door: str, tmp_path: Path
) -> None:
    other_ca, _ = make_certificate(tmp_path)
    url, key = getattr(guarded, door), guarded.keys[Scope.READ]
    with (
        Client(url, api_key=key, ca=other_ca, timeout_s=5) as client,
        pytest.raises(Unavailable) as caught,
    ):
        client.maps()
    assert caught.value.code == "server.unreachable"


@pytest.mark.parametrize("door", ["http", "grpc"])
@pytest.mark.parametrize(
    "made", [{"days": (-3, -1)}, {"days": (1, 3)}, {"host": "maps.example.org"}], ids=str
)
def test_clients_send_no_key_to_a_certificate_that_is_not_valid_for_it(
    made: dict[str, Any], door: str, tmp_path: Path, serve: Callable[..., Any]
) -> None:
    """Expired, not yet valid, or of another host; signed by an authority that the client trusts."""
    certificate, private_key = make_certificate(tmp_path, **made)
    (tmp_path / "maps").mkdir()
    files = {"tls_cert": certificate, "tls_key": private_key}
    with serve(tmp_path / "maps", load=False, **files) as doors:
        urls = {
            "http": f"https://127.0.0.1:{doors.server.http_port}",
            "grpc": f"grpcs://localhost:{doors.server.grpc_port}",
        }
        with (
            Client(urls[door], api_key="k", ca=certificate, timeout_s=5) as client,
            pytest.raises(Unavailable) as caught,
        ):
            client.maps()
    assert caught.value.code == "server.unreachable"


@pytest.mark.parametrize("door", ["http", "grpc"])
def test_a_renewed_certificate_is_taken_over_and_open_connections_go_on(
    door: str, tmp_path: Path, serve: Callable[..., Any]
) -> None:
    files = make_certificate(tmp_path)
    old_ca, new_ca = tmp_path / "old-ca.pem", tmp_path / "new-ca.pem"
    old_ca.write_bytes(files[0].read_bytes())
    (tmp_path / "maps").mkdir()
    with serve(tmp_path / "maps", load=False, tls_cert=files[0], tls_key=files[1]) as doors:
        url = {
            "http": f"https://127.0.0.1:{doors.server.http_port}",
            "grpc": f"grpcs://localhost:{doors.server.grpc_port}",
        }[door]
        with Client(url, ca=old_ca, timeout_s=20) as connected:
            assert connected.maps() == []
            renewed = make_certificate(tmp_path, "new", days=(-1, 90))
            new_ca.write_bytes(renewed[0].read_bytes())
            replace(files, renewed)
            with Client(url, ca=new_ca, timeout_s=20) as client:
                assert client.maps() == []
            with Client(url, ca=old_ca, timeout_s=5) as late, pytest.raises(Unavailable):
                late.maps()
            assert connected.maps() == []
        ends = doors.server.state().certificate_ends
    assert ends is not None
    assert ends > time.time() + 86_400 * 80


def test_without_tls_nothing_is_answered(guarded: Guarded) -> None:
    for url in (
        guarded.http.replace("https", "http"),
        guarded.grpc.replace("grpcs", "grpc"),
    ):
        with Client(url, timeout_s=5) as client, pytest.raises(Unavailable):
            client.maps()


def test_every_route_of_the_service_has_a_scope_of_its_own_or_is_open(guarded: Guarded) -> None:
    with httpx.Client(
        base_url=guarded.http, verify=ssl.create_default_context(cafile=guarded.ca)
    ) as http:
        paths = http.get("/openapi.json").json()["paths"]
        assert http.get("/readyz").status_code == 503
        assert http.get("/metrics").status_code == 401
    routes = [(method.upper(), path) for path, methods in paths.items() for method in methods]
    assert len(routes) > 10
    assert [route for route in routes if needed_over_http(*route) == ANY_KEY] == []


def test_readiness_names_maps_only_to_a_key_that_may_read(
    built_maps: Path, tmp_path: Path, serve: Callable[..., Any]
) -> None:
    tokens = {}
    with edited_keys(tmp_path / "keys.json") as keys:
        for scope in (Scope.READ, Scope.LOCALIZE):
            key, tokens[scope] = new_key(scope.value, frozenset({scope}))
            keys.append(key)
    maps = Path(shutil.copytree(built_maps, tmp_path / "maps"))
    shutil.copytree(maps / "room", maps / "hall")  # a manifest of another name
    with serve(maps, keys_file=tmp_path / "keys.json") as doors:
        for sent in (None, "visloc_wrong", tokens[Scope.LOCALIZE]):
            headers = {} if sent is None else {"X-API-Key": sent}
            answer = doors.http.get("/readyz", headers=headers)
            assert answer.status_code == 200
            assert answer.json() == {"ready": True, "maps": [], "not_loaded": []}
        told = doors.http.get("/readyz", headers={"X-API-Key": tokens[Scope.READ]}).json()
    assert told["maps"][0].startswith("room@")
    assert told["not_loaded"][0]["id"] == "hall"


def test_a_service_that_would_be_open_to_others_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"^keys_file: needed"):
        Server(ServiceSettings(maps_dir=str(tmp_path), host="0.0.0.0", http_port=0, grpc_port=0))


def test_a_file_that_vanishes_while_it_is_read_leaves_the_certificate_in_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain, key = make_certificate(tmp_path)
    certificate = Certificate(chain, key)
    before = certificate.context
    make_certificate(tmp_path)
    read = Path.read_bytes

    def read_then_removed(path: Path) -> bytes:
        content = read(path)
        if path == key:
            path.unlink()
        return content

    monkeypatch.setattr(Path, "read_bytes", read_then_removed)
    assert certificate.context is before
