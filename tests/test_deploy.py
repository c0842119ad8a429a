"""Wheel, images, compose file, alerts and docs/operations.md agree with the code and each other."""

from __future__ import annotations

import os
import re
import ssl
import subprocess
import sys
import threading
import time
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from service.settings import ServiceSettings, read_settings
from tests.serving import ENVIRONMENT, READY

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
OPERATIONS = ROOT / "docs" / "operations.md"
ALERTS = ROOT / "deploy" / "prometheus" / "alerts.yml"
HEALTHCHECK = ROOT / "docker" / "healthcheck.py"
OURS = {"service", "service-cuda", "mapping", "clients"}  # images

# Compose


@pytest.fixture(scope="module")
def compose(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """docker-compose.yml as podman-compose understands it, those not started by ``up`` too."""
    # It asks whether podman is there, and needs no more of it to read a file.
    stand_in = tmp_path_factory.mktemp("bin") / "podman"
    stand_in.write_text("#!/bin/sh\necho podman version 5.0.0\n")
    stand_in.chmod(0o755)
    done = subprocess.run(
        [
            *(sys.executable, "-m", "podman_compose"),
            *("--profile", "tools", "--profile", "replicas"),
            *("-f", str(ROOT / "docker-compose.yml"), "config"),
        ],
        env={"PATH": f"{stand_in.parent}:{os.environ['PATH']}"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(yaml.safe_load(done.stdout))


def test_compose_has_the_service_and_what_watches_it(compose: dict[str, Any]) -> None:
    profiles = {
        name: service["profiles"]
        for name, service in compose["services"].items()
        if service.get("profiles")
    }

    assert profiles == {
        "mapping": ["tools"],
        "localize": ["tools"],
        "replica": ["replicas"],
    }
    assert compose["services"].keys() - profiles.keys() == {
        "keys",
        "service",
        "balancer",
        "prometheus",
        "grafana",
    }


def test_nothing_is_published_beyond_this_machine(compose: dict[str, Any]) -> None:
    ports = [port for service in compose["services"].values() for port in service.get("ports", ())]

    assert len(ports) > 3
    assert all(str(port).startswith("127.0.0.1:") for port in ports)


def test_every_container_has_a_read_only_file_system_and_no_rights(
    compose: dict[str, Any],
) -> None:
    for name, service in compose["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert "privileged" not in service, name
        assert not any("docker.sock" in volume for volume in service.get("volumes", ())), name


def test_images_of_others_have_a_version(compose: dict[str, Any]) -> None:
    others = [s["image"] for s in compose["services"].values() if "build" not in s]

    assert len(others) == 3
    assert all(re.fullmatch(r"docker\.io/[a-z/]+:v?\d+\.\d+\.\d+", image) for image in others)


def test_the_service_takes_the_settings_that_compose_gives(compose: dict[str, Any]) -> None:
    service = compose["services"]["service"]
    of_image = dockerfile()["serving"].environment
    settings = read_settings([], {**of_image, **service["environment"]})

    assert settings.host == "0.0.0.0"
    assert settings.keys_file is not None
    volumes = dict(volume.split(":")[:2] for volume in service["volumes"])
    mounted = set(volumes.values())
    for path in (settings.maps_dir, settings.cache_dir, settings.keys_file.parent):
        assert str(path) in mounted
    grace_s = int(service["stop_grace_period"].removesuffix("s"))
    assert grace_s > settings.drain_delay_s + settings.drain_timeout_s


def test_only_the_balancer_is_published_and_reaches_the_service(compose: dict[str, Any]) -> None:
    service, balancer = compose["services"]["service"], compose["services"]["balancer"]
    environment = balancer["environment"]
    settings = read_settings([], dockerfile()["serving"].environment)

    assert not service.get("ports")
    published = {port.rsplit(":", 1)[1] for port in balancer["ports"]}
    assert published == {environment[f"{door}_BIND"].strip(":") for door in ("HTTP", "GRPC")}
    assert environment["REPLICAS"] in service["networks"]["default"]["aliases"]
    assert environment["REPLICA_HTTP_PORT"] == str(settings.http_port)
    assert environment["REPLICA_GRPC_PORT"] == str(settings.grpc_port)
    assert compose["services"]["localize"]["network_mode"] == "service:balancer"


def test_the_second_replica_is_as_the_first_with_a_cache_of_its_own(
    compose: dict[str, Any],
) -> None:
    service, replica = dict(compose["services"]["service"]), compose["services"]["replica"]
    assert service["networks"] == replica["networks"]
    assert service["environment"] == replica["environment"]
    assert service["image"] == replica["image"]
    of_both = set(service["volumes"]) & set(replica["volumes"])
    assert of_both == {"maps:/maps", "keys:/keys:ro"}
    assert not replica.get("ports")


def test_the_balancers_ports_are_free(compose: dict[str, Any]) -> None:
    published = [
        str(port).split(":")[1]
        for service in compose["services"].values()
        for port in service.get("ports", ())
    ]
    assert len(published) == len(set(published))


def test_the_keys_are_made_first_and_only_read_by_the_service(compose: dict[str, Any]) -> None:
    service, keys = compose["services"]["service"], compose["services"]["keys"]
    (file,) = (Path(word) for word in keys["entrypoint"] if word.endswith(".json"))

    assert service["depends_on"]["keys"]["condition"] == "service_completed_successfully"
    assert service["environment"]["VISLOC_KEYS_FILE"] == str(file)
    assert f"keys:{file.parent}" in keys["volumes"]
    assert f"keys:{file.parent}:ro" in service["volumes"]
    assert keys["restart"] == "no"
    assert keys["network_mode"] == "none"


def test_prometheus_asks_the_port_for_metrics(compose: dict[str, Any]) -> None:
    port = compose["services"]["service"]["environment"]["VISLOC_METRICS_PORT"]
    scraping = yaml.safe_load((ROOT / "deploy" / "prometheus" / "prometheus.yml").read_text())
    (job,) = scraping["scrape_configs"]

    assert job["static_configs"] == [{"targets": [f"service:{port}"]}]


def test_what_compose_mounts_and_builds_is_there(compose: dict[str, Any]) -> None:
    for service in compose["services"].values():
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            if source.startswith("."):
                assert (ROOT / source).is_dir(), source
            else:
                assert source in compose["volumes"], source
        if build := service.get("build"):
            assert (ROOT / build["dockerfile"]).is_file()
            assert build["target"] in OURS
            assert service["image"].startswith(f"visloc-{build['target']}:")


def test_the_healthcheck_of_compose_is_that_of_the_image(compose: dict[str, Any]) -> None:
    check = compose["services"]["service"]["healthcheck"]
    (line,) = dockerfile()["serving"].of("HEALTHCHECK")
    options = dict(re.findall(r"--([a-z-]+)=(\w+)", line))
    words = yaml.safe_load(line.partition("CMD ")[2])

    assert check["test"] == ["CMD", *words]
    assert options == {
        name.replace("_", "-"): str(value) for name, value in check.items() if name != "test"
    }


# Dockerfile


class Stage(NamedTuple):
    base: str
    steps: tuple[tuple[str, str], ...]  # instruction and the rest; inherited ones first
    own: tuple[tuple[str, str], ...]

    def of(self, instruction: str) -> list[str]:
        return [rest for name, rest in self.steps if name == instruction]

    @property
    def environment(self) -> dict[str, str]:
        return dict(pair.split("=", 1) for line in self.of("ENV") for pair in line.split())


def dockerfile() -> dict[str, Stage]:
    """The stages, each with what it inherits."""
    text = (ROOT / "docker" / "Dockerfile").read_text()
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    stages: dict[str, Stage] = {}
    name, base, steps = "", "", []
    for line in filter(None, text.splitlines()):
        instruction, _, rest = line.partition(" ")
        if instruction == "FROM":
            found = re.fullmatch(r"(\S+) AS ([a-z-]+)", rest)
            assert found is not None, line
            base, name = found.groups()
            steps = []
        elif name:
            steps.append((instruction, " ".join(rest.split())))
        if name:
            inherited = stages[base].steps if base in stages else ()
            stages[name] = Stage(base, (*inherited, *steps), tuple(steps))
    return stages


@pytest.mark.parametrize("image", sorted(OURS))
def test_an_image_runs_without_rights_and_says_how_it_is(image: str) -> None:
    stage = dockerfile()[image]
    user = stage.of("USER")[-1]
    script = yaml.safe_load(stage.of("ENTRYPOINT")[-1])[0]

    # By number, so that a cluster that refuses root can tell.
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)
    assert stage.of("HEALTHCHECK")
    assert script in PROJECT["project"]["scripts"]
    assert not stage.of("VOLUME")
    assert not stage.of("ADD")


@pytest.mark.parametrize("image", sorted(OURS))
def test_an_image_holds_what_was_made_elsewhere_and_makes_nothing_itself(image: str) -> None:
    stages = dockerfile()
    sources = [
        found[1]
        for line in stages[image].of("COPY")
        if (found := re.match(r"--from=(\S+) /\S+ /opt/visloc$", line))
    ]

    assert sources == [f"{image}-packages", "code"]  # packages change less often than code
    assert not any("pip" in step for step in stages[image].of("RUN"))


def test_what_is_installed_is_locked_with_hashes() -> None:
    steps = {
        name: step
        for name, stage in dockerfile().items()
        for instruction, step in stage.own
        if instruction == "RUN" and "docker/locks" in step
    }
    locks = {name: re.findall(r"docker/locks/(\S+)\.txt", step) for name, step in steps.items()}

    assert locks == {
        "builder": ["build"],
        "vision-packages": ["vision"],
        "service-packages": ["service"],
        "mapping-packages": ["mapping"],
        "clients-packages": ["clients"],
        "service-cuda-packages": ["service"],
    }
    assert all("install --require-hashes --no-deps --requirement" in s for s in steps.values())
    assert all((ROOT / f"docker/locks/{lock}.txt").exists() for (lock,) in locks.values())


def test_the_wheel_is_made_by_a_locked_tool() -> None:
    wheels = [
        step
        for stage in dockerfile().values()
        for instruction, step in stage.own
        if instruction == "RUN" and "pip wheel" in step
    ]

    assert len(wheels) == 2
    assert all("pip wheel --no-deps --no-build-isolation" in step for step in wheels)
    assert "hatchling==" in (ROOT / "docker" / "locks" / "build.txt").read_text()


def test_the_dependencies_are_made_before_the_code_is_copied() -> None:
    copied = [line.split()[:-1] for line in dockerfile()["service-packages"].of("COPY")]

    assert copied == [
        ["docker/locks"],
        ["pyproject.toml", "hatch_build.py", "constraints.txt", "README.md", "LICENSE"],
        ["visloc/__init__.py"],  # the version
    ]


def test_the_code_is_all_of_the_wheel() -> None:
    wheel = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    copied = {
        words[0]
        for instruction, rest in dockerfile()["code"].own
        if instruction == "COPY" and len(words := rest.split()) == 2
    }

    assert copied == set(wheel)


def test_the_page_is_made_in_a_stage_of_its_own_from_its_sources() -> None:
    stages = dockerfile()
    steps = [rest for _, rest in stages["page"].own]
    packages = steps.index("web/package.json web/package-lock.json ./")
    sources = steps.index("web .")
    ignored = (ROOT / ".dockerignore").read_text().splitlines()

    assert steps[packages + 1].startswith("npm ci ")
    assert sources > packages + 1  # packages change less often than code
    assert steps[sources + 1] == "npm run build"
    assert "--from=page /src/service/page/built service/page/built" in stages["code"].of("COPY")
    assert {"service/page/built", "web/node_modules"} <= set(ignored)
    # Who runs an image has no Node.js in it.
    assert [name for name, stage in stages.items() if stage.base in ("page", "${NODE}")] == ["page"]


def test_only_what_is_copied_is_sent_to_the_builder() -> None:
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    sent = {line[1:] for line in lines if line.startswith("!")}
    copied = {
        word
        for stage in dockerfile().values()
        for instruction, rest in stage.own
        if instruction == "COPY" and not rest.startswith("--from")
        for word in rest.split()[:-1]
    }

    assert "*" in lines
    assert all((ROOT / name).exists() for name in copied)
    assert {name if name in sent else name.split("/")[0] for name in copied} == sent


# Wheel


def test_a_wheel_carries_the_built_page_and_the_report_and_nothing_else_of_web(
    tmp_path: Path,
) -> None:
    built = ROOT / "service" / "page" / "built"
    if not (built / "page" / "redoc.html").is_file():
        pytest.skip("the page is not built: `make page`, where Node.js is")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=100,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        carried = set(archive.namelist())

    files = {path.relative_to(ROOT).as_posix() for path in built.rglob("*") if path.is_file()}
    assert {"index.html", "report.js"} <= {Path(name).name for name in files}
    assert any(name.startswith("service/page/built/page/assets/") for name in files)
    assert {name for name in carried if name.startswith("service/page/built/")} == files
    assert not any("node_modules" in name or name.startswith("web/") for name in carried)


@pytest.mark.slow
def test_a_wheel_makes_a_map_and_serves_it_without_the_sources(tmp_path: Path) -> None:
    built, there, work = tmp_path / "dist", tmp_path / "there", tmp_path / "work"
    work.mkdir()
    offline = ("--no-deps", "--no-index", "--disable-pip-version-check", "--quiet")
    pip = (sys.executable, "-m", "pip")

    def run(*command: str) -> str:
        done = subprocess.run(
            command,
            cwd=work,
            env=ENVIRONMENT | {"PYTHONPATH": str(there), "COLUMNS": "200"},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", str(built), str(ROOT))
    (wheel,) = built.glob("visloc-*.whl")
    run(*pip, "install", *offline, "--target", str(there), str(wheel))
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    files = f"import {', '.join(packages)}; print(*({'.__file__, '.join(packages)}.__file__,))"
    found = run(sys.executable, "-c", files).split()
    assert len(found) == len(packages)
    assert all(Path(file).is_relative_to(there) for file in found)

    script = {name: str(there / "bin" / name) for name in PROJECT["project"]["scripts"]}
    for command in script.values():
        assert "Usage" in run(command, "--help").title()
    run(script["mapping"], "sample", "room", "--images", "10", "--size", "320x240")
    features = ("--local-features", "sift", "--workers", "2")
    run(script["mapping"], "build", "room/mapping", "--map", "room", *features)
    photo = next((work / "room" / "query").rglob("*.jpg"))
    log = tmp_path / "log"
    ports = ("--http-port=0", "--grpc-port=0", "--workers=1", "--maps-dir=maps")
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            [script["visloc-service"], *ports],
            cwd=work,
            env=ENVIRONMENT | {"PYTHONPATH": str(there)},
            stderr=stderr,
        ) as process,
    ):
        try:
            deadline = time.monotonic() + 120
            while (ready := READY.search(log.read_text())) is None:
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.1)
            answer = run(
                *(script["localize"], "image", str(photo), "--map", "room", "--server", ready[1])
            )
        finally:
            process.kill()
    assert "localized" in answer
    assert "position" in answer


# Healthcheck


@contextmanager
def served(status: int, context: ssl.SSLContext | None = None) -> Iterator[int]:
    """Answer everything with a status; the port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/readyz" else 500)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def healthcheck(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(HEALTHCHECK)],
        env={"PYTHONPATH": str(ROOT), "VISLOC_HOST": "0.0.0.0", **environment},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


@pytest.mark.parametrize(("status", "healthy"), [(200, True), (503, False), (302, False)])
def test_healthy_is_what_is_ready(status: int, healthy: bool) -> None:
    with served(status) as port:
        done = healthcheck(VISLOC_HTTP_PORT=str(port))

    assert (done.returncode == 0) is healthy, done.stderr
    assert healthy or f"/readyz answered {status}" in done.stderr


def test_a_service_that_does_not_answer_is_not_healthy() -> None:
    with served(200) as port:
        pass
    done = healthcheck(VISLOC_HTTP_PORT=str(port))

    assert done.returncode == 1
    assert f"no answer from 127.0.0.1:{port}" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_setting_that_cannot_be_used_is_not_healthy() -> None:
    done = healthcheck(VISLOC_HTTP_PORT="many")

    assert done.returncode == 1
    assert "VISLOC_HTTP_PORT" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_service_with_tls_is_asked_over_tls(tmp_path: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "maps.example.org")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now)
        .not_valid_after(now + timedelta(hours=1))
        .sign(key, hashes.SHA256())
    )
    pem = tmp_path / "cert.pem"
    pem.write_bytes(
        certificate.public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(pem)

    with served(200, context) as port:
        done = healthcheck(VISLOC_HTTP_PORT=str(port), VISLOC_TLS_CERT=str(pem))

    assert done.returncode == 0, done.stderr


# docs/operations.md


def test_every_setting_is_listed_with_its_default() -> None:
    table = OPERATIONS.read_text().partition("| setting |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*) \|$", table, re.MULTILINE)
    shown = {"None": "none", "()": "none", "True": "true"}

    assert [name for name, *_ in rows] == list(ServiceSettings.model_fields)
    for name, default, meaning in rows:
        field = ServiceSettings.model_fields[name]
        if field.default_factory is None:
            value = str(field.default)
            assert default == shown.get(value, value), name
        assert meaning


def test_every_alert_is_explained_where_its_runbook_points() -> None:
    (group,) = yaml.safe_load(ALERTS.read_text())["groups"]
    explained = OPERATIONS.read_text().partition("\n## Alerts\n")[2]
    headings = re.findall(r"^### (\w+)$", explained, re.MULTILINE)

    assert [rule["alert"] for rule in group["rules"]] == headings
    for rule in group["rules"]:
        assert rule["annotations"]["runbook"] == f"docs/operations.md#{rule['alert'].lower()}"
        text = explained.partition(f"### {rule['alert']}\n\n")[2]
        assert text.lower().startswith(f"{rule['labels']['severity']}: "), rule["alert"]


def test_the_overrides_shown_fit_the_compose_file(compose: dict[str, Any]) -> None:
    shown = re.findall(r"^```yaml\n(.*?)^```$", OPERATIONS.read_text(), re.MULTILINE | re.DOTALL)

    assert len(shown) > 1
    for text in shown:
        for name, service in yaml.safe_load(text)["services"].items():
            assert name in compose["services"]
            read_settings([], service.get("environment", {}))
