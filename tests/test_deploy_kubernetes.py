"""What is in deploy/kubernetes and deploy/haproxy is valid, and fits the service."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import kubernetes_validate
import pytest
import yaml

from benchmarks.reliability.service_process import free_port
from service.engine.uploads import MAX_UPLOADS
from service.settings import ServiceSettings, read_settings
from service.telemetry.metrics import Metrics, ServiceState

ROOT = Path(__file__).resolve().parents[1]
KUBERNETES = ROOT / "deploy" / "kubernetes"
CONFIG = ROOT / "deploy" / "haproxy" / "haproxy.cfg"
OVERLAYS = ("base", "example")
# Older ones have a kustomize that knows neither folders as resources nor lists of patches.
OLDEST_KUBECTL = (1, 22)

Objects = dict[tuple[str, str], dict[str, Any]]  # by kind and name


@pytest.fixture(scope="module", params=OVERLAYS)
def objects(request: pytest.FixtureRequest) -> Objects:
    """What an overlay renders to; generated names as they are referred to, without their hashes."""
    command = rendering()
    done = subprocess.run(
        [*command, str(KUBERNETES / request.param)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "deprecated" not in done.stderr
    text = re.sub(r"(visloc-(?:settings|balancer))-[0-9a-z]{10}\b", r"\1", done.stdout)
    found = list(yaml.safe_load_all(text))
    named = {(each["kind"], each["metadata"]["name"]): each for each in found}
    assert len(named) == len(found)
    return named


def rendering() -> list[str]:
    """The command that renders, where there is one."""
    if shutil.which("kustomize") is not None:
        return ["kustomize", "build"]
    if shutil.which("kubectl") is None:
        pytest.skip("needs kubectl; on Debian and Ubuntu `make balancer`, as root, installs it")
    said = subprocess.run(
        ["kubectl", "version", "--client", "-o", "json"], capture_output=True, check=True
    )
    version = json.loads(said.stdout)["clientVersion"]
    number = tuple(int(re.sub(r"\D.*", "", version[part])) for part in ("major", "minor"))
    if number < OLDEST_KUBECTL:
        pytest.skip(f"kubectl {version['gitVersion']} is too old: 1.22 or newer, or kustomize")
    return ["kubectl", "kustomize"]


def pod_of(objects: Objects, name: str) -> dict[str, Any]:
    template: dict[str, Any] = objects["Deployment", name]["spec"]["template"]
    return template


def container_of(objects: Objects, name: str) -> dict[str, Any]:
    (container,) = pod_of(objects, name)["spec"]["containers"]
    return dict(container)


def settings_of(objects: Objects) -> ServiceSettings:
    """As the service reads them in the image."""
    of_image = {"VISLOC_HOST": "0.0.0.0", "VISLOC_CACHE_DIR": "/cache"}
    return read_settings([], of_image | objects["ConfigMap", "visloc-settings"]["data"])


def bytes_of(quantity: str) -> float:
    number, unit = re.fullmatch(r"(\d+)(Mi|Gi)", quantity).groups()  # type: ignore[union-attr]
    return int(number) * 2.0 ** {"Mi": 20, "Gi": 30}[unit]


def test_the_schema_checker_finds_mistakes(objects: Objects) -> None:
    deployment = json.loads(json.dumps(objects["Deployment", "visloc"]))
    deployment["spec"]["template"]["spec"]["terminationGracePeriod"] = 60
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(deployment, kubernetes_validate.latest_version(), strict=True)


def test_what_is_rendered_is_what_kubernetes_takes(objects: Objects) -> None:
    for each in objects.values():
        kubernetes_validate.validate(each, kubernetes_validate.latest_version(), strict=True)

    assert {kind for kind, _ in objects} == {
        *("ConfigMap", "Deployment", "HorizontalPodAutoscaler", "NetworkPolicy"),
        *("PodDisruptionBudget", "Service"),
    }


def test_the_settings_are_the_services(objects: Objects) -> None:
    settings = settings_of(objects)
    container = container_of(objects, "visloc")
    mounted = {Path(mount["mountPath"]) for mount in container["volumeMounts"]}

    assert settings.maps_dir.startswith("s3://")
    assert settings.keys_file is not None
    assert {settings.cache_dir, settings.keys_file.parent, Path("/tmp")} == mounted
    assert "env" not in container
    # Names of services would be taken for settings.
    assert pod_of(objects, "visloc")["spec"]["enableServiceLinks"] is False


def test_ports_and_probes_are_the_services(objects: Objects) -> None:
    settings, container = settings_of(objects), container_of(objects, "visloc")
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}

    assert ports == {
        "http": settings.http_port,
        "grpc": settings.grpc_port,
        "metrics": settings.metrics_port,
    }
    probes = {
        name: container[f"{name}Probe"]["httpGet"] for name in ("startup", "readiness", "liveness")
    }
    assert {probe["port"] for probe in probes.values()} == {"http"}
    assert {name: probe["path"] for name, probe in probes.items()} == {
        "startup": "/readyz",
        "readiness": "/readyz",
        "liveness": "/healthz",
    }
    for name in ("visloc", "visloc-replicas"):
        found = {port["name"]: port["port"] for port in objects["Service", name]["spec"]["ports"]}
        assert found == {"http": settings.http_port, "grpc": settings.grpc_port}


def test_a_replica_has_the_time_to_end_what_runs(objects: Objects) -> None:
    settings, spec = settings_of(objects), pod_of(objects, "visloc")["spec"]

    grace_s = spec["terminationGracePeriodSeconds"]
    assert grace_s > settings.drain_delay_s + settings.drain_timeout_s
    # The balancer has turned away, and the cluster has taken the address back, before.
    assert settings.drain_delay_s >= 5


def test_the_cache_and_the_maps_fit(objects: Objects) -> None:
    settings, spec = settings_of(objects), pod_of(objects, "visloc")["spec"]
    container = container_of(objects, "visloc")
    (cache,) = (volume for volume in spec["volumes"] if volume["name"] == "cache")

    # An upload lies there packed and unpacked, before room is made for it.
    uploads = MAX_UPLOADS * 2 * settings.max_upload_bytes
    assert settings.max_cache_bytes + uploads < bytes_of(cache["emptyDir"]["sizeLimit"])
    asked = container["resources"]["requests"]
    assert bytes_of(cache["emptyDir"]["sizeLimit"]) < bytes_of(asked["ephemeral-storage"])
    assert settings.workers * settings.threads_per_worker <= int(asked["cpu"])
    assert settings.max_loaded_bytes < bytes_of(asked["memory"])


@pytest.mark.parametrize("name", ["visloc", "visloc-balancer"])
def test_no_container_has_rights(objects: Objects, name: str) -> None:
    spec, container = pod_of(objects, name)["spec"], container_of(objects, name)

    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert spec["automountServiceAccountToken"] is False
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert container["resources"].keys() == {"requests", "limits"}
    if name == "visloc":
        user = re.search(r"USER (\d+):", (ROOT / "docker" / "Dockerfile").read_text())
        assert user is not None
        assert spec["securityContext"]["runAsUser"] == int(user[1])


@pytest.mark.parametrize("name", ["visloc", "visloc-balancer"])
def test_what_names_pods_names_those_that_are_there(objects: Objects, name: str) -> None:
    labels = pod_of(objects, name)["metadata"]["labels"]
    service = "visloc-replicas" if name == "visloc" else "visloc"

    assert objects["Deployment", name]["spec"]["selector"]["matchLabels"] == labels
    assert objects["PodDisruptionBudget", name]["spec"]["selector"]["matchLabels"] == labels
    assert objects["Service", service]["spec"]["selector"] == labels
    (spread,) = pod_of(objects, name)["spec"]["topologySpreadConstraints"]
    assert spread["labelSelector"]["matchLabels"] == labels


def test_the_balancer_is_told_what_its_configuration_asks(objects: Objects) -> None:
    container = container_of(objects, "visloc-balancer")
    given = {each["name"]: each.get("value") for each in container["env"]}
    settings, spec = settings_of(objects), objects["HorizontalPodAutoscaler", "visloc"]["spec"]

    assert given.keys() - {"NAMESPACE"} == asked_by_the_balancer()
    assert given["REPLICAS"] == "visloc-replicas.$(NAMESPACE).svc.cluster.local"
    assert objects["Service", "visloc-replicas"]["spec"]["clusterIP"] == "None"
    assert int(given["REPLICA_HTTP_PORT"]) == settings.http_port
    assert int(given["REPLICA_GRPC_PORT"]) == settings.grpc_port
    assert int(given["MAX_REPLICAS"]) > spec["maxReplicas"]
    for port in container["ports"]:
        assert given[f"{port['name'].upper()}_BIND"].startswith(f":{port['containerPort']}")
    assert "monitor-uri /healthz" in CONFIG.read_text()
    assert {container[f"{name}Probe"]["httpGet"]["path"] for name in ("readiness", "liveness")} == {
        "/healthz"
    }
    assert objects["ConfigMap", "visloc-balancer"]["data"] == {"haproxy.cfg": CONFIG.read_text()}


def asked_by_the_balancer() -> set[str]:
    """Variables that its configuration cannot do without."""
    lines = [line for line in CONFIG.read_text().splitlines() if not line.startswith("#")]
    return set(re.findall(r"\$\{(\w+)[}\[]", "\n".join(lines))) - {"NAMESERVER"}


def test_compose_tells_the_balancer_the_same() -> None:
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    given = compose["balancer"]["environment"]

    assert given.keys() == asked_by_the_balancer()
    for replica in (compose["service"], compose["replica"]):
        assert replica["networks"]["default"]["aliases"] == [given["REPLICAS"]]
    assert compose["balancer"]["image"] == next(images_in(KUBERNETES / "base" / "balancer.yaml"))


def images_in(path: Path) -> Iterator[str]:
    yield from re.findall(r"^ *image: (\S+)$", path.read_text(), re.MULTILINE)


def test_the_autoscaler_asks_for_what_the_adapter_makes_of_real_metrics(objects: Objects) -> None:
    spec = objects["HorizontalPodAutoscaler", "visloc"]["spec"]
    (metric,) = spec["metrics"]
    adapter = yaml.safe_load((KUBERNETES / "monitoring" / "adapter.yaml").read_text())
    (rule,) = adapter["rules"]["custom"]
    asked = set(re.findall(r"visloc_\w+", rule["seriesQuery"] + rule["metricsQuery"]))
    rendered = Metrics().render(ServiceState(ready=True))[0].decode()

    assert metric["pods"]["metric"]["name"] == rule["name"]["as"]
    assert asked == {"visloc_photos_waiting", "visloc_photos_running"}
    assert asked <= set(re.findall(r"^(visloc_\w+)", rendered, re.MULTILINE))
    # More than is worked on, less than what makes callers wait for long.
    workers = settings_of(objects).workers
    assert workers < int(metric["pods"]["target"]["averageValue"]) <= 4 * workers
    assert spec["minReplicas"] >= 2
    assert "replicas" not in objects["Deployment", "visloc"]["spec"]


def may_come_from(objects: Objects, name: str) -> dict[str, list[dict[str, Any]] | None]:
    """By port, who may reach a pod; None for everybody."""
    policy = objects["NetworkPolicy", name]["spec"]
    assert policy["podSelector"] == objects["Deployment", name]["spec"]["selector"]
    assert policy["policyTypes"] == ["Ingress"]
    return {port["port"]: rule.get("from") for rule in policy["ingress"] for port in rule["ports"]}


def test_only_the_balancer_reaches_replicas_and_only_prometheus_the_metrics(
    objects: Objects,
) -> None:
    monitoring = {
        "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}
    }
    balancer = {"podSelector": objects["Deployment", "visloc-balancer"]["spec"]["selector"]}

    replicas, balancers = (may_come_from(objects, n) for n in ("visloc", "visloc-balancer"))
    assert replicas == {"http": [balancer], "grpc": [balancer], "metrics": [monitoring]}
    assert balancers == {"http": None, "grpc": None, "status": [monitoring]}
    for name, ports in (("visloc", replicas), ("visloc-balancer", balancers)):
        assert {port["name"] for port in container_of(objects, name)["ports"]} == ports.keys()
    values = (KUBERNETES / "monitoring" / "adapter.yaml").read_text()
    assert "prometheus-operated.monitoring.svc" in values  # the namespace of Prometheus


def test_prometheus_is_shown_ports_that_are_there(objects: Objects) -> None:
    monitors = yaml.safe_load_all((KUBERNETES / "monitoring" / "pod-monitors.yaml").read_text())
    for monitor in monitors:
        name = monitor["metadata"]["name"]
        labels = pod_of(objects, name)["metadata"]["labels"]
        ports = {port["name"] for port in container_of(objects, name)["ports"]}

        assert monitor["spec"]["selector"]["matchLabels"] == labels
        assert {endpoint["port"] for endpoint in monitor["spec"]["podMetricsEndpoints"]} <= ports


NEEDS_HAPROXY = pytest.mark.skipif(
    shutil.which("haproxy") is None,
    reason="needs HAProxy; on Debian and Ubuntu `make balancer`, as root, installs it",
)


def balancer_environment() -> dict[str, str]:
    """What compose tells HAProxy."""
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    return {"PATH": "/usr/sbin:/usr/bin", **compose["balancer"]["environment"]}


@pytest.fixture
def check_config(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Let HAProxy read its configuration."""

    def check(**changes: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["haproxy", "-c", "-f", str(CONFIG)],
            env=balancer_environment() | changes,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    return check


@NEEDS_HAPROXY
def test_haproxy_takes_its_configuration(
    check_config: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    for changes in ({}, {"NAMESERVER": "127.0.0.1:53"}, {"MAX_PER_ADDRESS": "50"}):
        done = check_config(**changes)
        assert done.returncode == 0, done.stderr
        assert "WARNING" not in done.stderr
    assert check_config(MAX_REPLICAS="many").returncode != 0


@NEEDS_HAPROXY
def test_one_address_does_not_take_the_places_of_others(tmp_path: Path) -> None:
    most = 5
    http, grpc, status = (free_port() for _ in range(3))
    environment = balancer_environment() | {
        "HTTP_BIND": f"127.0.0.1:{http}",
        "GRPC_BIND": f"127.0.0.1:{grpc}",
        "STATUS_BIND": f"127.0.0.1:{status}",
        "NAMESERVER": "127.0.0.1:9",  # nobody, so that there are no replicas
        "MAX_PER_ADDRESS": str(most),
        "MAX_REQUESTS_PER_ADDRESS": "3",
    }

    def answers(path: str, port: int, source: str) -> bool:
        transport = httpx.HTTPTransport(local_address=source)
        with httpx.Client(transport=transport) as client:
            try:
                return client.get(f"http://127.0.0.1:{port}{path}").status_code in (200, 503)
            except httpx.TransportError:
                return False

    with (tmp_path / "log").open("wb") as log, ExitStack() as stack:
        process = subprocess.Popen(
            ["haproxy", "-db", "-f", str(CONFIG)], env=environment, stdout=log, stderr=log
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        while not answers("/healthz", status, "127.0.0.1"):
            assert process.poll() is None
            time.sleep(0.05)
        for port in [grpc, http] * most:
            connection = stack.enter_context(socket.socket())
            connection.bind(("127.0.0.2", 0))
            with suppress(ConnectionError):
                connection.connect(("127.0.0.1", port))

        assert not answers("/", http, "127.0.0.2")
        assert answers("/", http, "127.0.0.3")
        url = f"http://127.0.0.1:{http}/maps"
        told = [httpx.get(url) for _ in range(4)]
    assert [answer.status_code for answer in told] == [503, 503, 503, 429]
    assert [answer.json()["code"] for answer in told[2:]] == ["server.unavailable", "server.busy"]
