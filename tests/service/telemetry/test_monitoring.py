"""The alerts and the dashboard of deploy/ speak of metrics, labels and words that exist."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

import visloc.errors
from service.telemetry.metrics import LOCALIZED, Metrics, ServiceState
from visloc.errors import VislocError

ROOT = Path(__file__).resolve().parents[3]
PROMETHEUS = ROOT / "deploy" / "prometheus"
API = (ROOT / "docs" / "api.md").read_text()
DASHBOARD = ROOT / "deploy" / "grafana" / "dashboards" / "visloc.json"

# Prometheus's own.
FOREIGN = {
    "up": {"job", "instance"},
    "ALERTS": {"alertname", "alertstate", "instance", "severity"},
}
# What Prometheus adds to everything that it scrapes.
SCRAPED = {"job", "instance"}
KEYWORDS = {"group_left", "and", "or", "unless"}
# Requests in which the service has no part, as alerts and dashboard leave them out.
PROBES = "GET /(healthz|readyz|metrics)"


def known_series() -> dict[str, set[str]]:
    """Every metric with its labels, of a service to which everything has happened."""
    metrics = Metrics()
    metrics.request_started("http")
    metrics.observe_request("http", "POST /localize", "200", 0.1)
    metrics.observe_error("http", VislocError("server.internal", "a mistake"))
    metrics.observe_localization("hall", None, 50, {"pose": 0.1})
    metrics.observe_map_change("upload", done=True)
    metrics.observe_worker_ended("robot")
    state = ServiceState(
        ready=True,
        worker_pids=(os.getpid(),),
        loaded_maps={("hall", "1"): 1},
        unusable_maps={"yard": "map.array"},
        certificate_ends=2e9,
        folders={"maps": ROOT},
    )
    series: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(metrics.render(state)[0].decode()):
        for sample in family.samples:
            series.setdefault(sample.name, set()).update(sample.labels)
    return series


SERIES = {**{name: SCRAPED | labels for name, labels in known_series().items()}, **FOREIGN}


def alerts() -> list[dict[str, Any]]:
    groups = yaml.safe_load((PROMETHEUS / "alerts.yml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(DASHBOARD.read_text())["panels"]
    return found


def expressions() -> Iterator[tuple[str, str]]:
    for rule in alerts():
        yield rule["alert"], rule["expr"]
    for panel in panels():
        for target in panel.get("targets", ()):
            yield panel["title"], target["expr"]
    for annotation in json.loads(DASHBOARD.read_text())["annotations"]["list"]:
        yield annotation["name"], annotation["expr"]


def selectors(expression: str) -> Iterator[tuple[str, dict[str, str]]]:
    """The metrics of an expression, each with its label matchers."""
    bare = re.sub(r"\b(by|without|on|ignoring)\s*\([^)]*\)|\[[^\]]*\]|\boffset \w+", "", expression)
    for name, braces in re.findall(r"\b([A-Za-z_]\w*)\b(?!\s*\()(\{[^}]*\})?", bare):
        if name not in KEYWORDS:
            yield name, dict(re.findall(r'(\w+)(?:=~|!~|!=|=)"([^"]*)"', braces))


EXPRESSIONS = [pytest.param(text, id=f"{name}-{n}") for n, (name, text) in enumerate(expressions())]


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_name_metrics_and_labels_that_exist(expression: str) -> None:
    found = list(selectors(expression))

    assert found
    labels: set[str] = set()
    for name, matchers in found:
        assert name in SERIES, f"{name} is no metric"
        assert set(matchers) <= SERIES[name], f"{name} has no such label"
        labels |= SERIES[name]
    for grouping in re.findall(r"\b(?:by|without|on|ignoring)\s*\(([^)]*)\)", expression):
        assert {word.strip() for word in grouping.split(",")} <= labels


def test_expressions_name_kinds_codes_and_outcomes_that_exist() -> None:
    kinds = {
        name
        for name, kind in vars(visloc.errors).items()
        if isinstance(kind, type) and issubclass(kind, VislocError)
    }

    for name, matchers in (found for _, text in expressions() for found in selectors(text)):
        if name == "visloc_errors_total":
            assert set(matchers.get("kind", "VislocError").split("|")) <= kinds
        assert matchers.get("outcome", LOCALIZED) == LOCALIZED
        codes = set(matchers.get("code", "server.internal").split("|"))
        assert all(f"`{code}`" in API for code in codes)
        assert matchers.get("localized", "true") in ("true", "false")


def test_every_share_of_requests_leaves_out_probes() -> None:
    shares = [
        (name, matchers)
        for _, text in expressions()
        if "/" in re.sub(r'"[^"]*"', "", text)
        for name, matchers in selectors(text)
        if name == "visloc_requests_total"
    ]

    assert len(shares) >= 4
    for _, matchers in shares:
        assert matchers["route"] == PROBES


def test_the_check_notices_what_does_not_exist() -> None:
    (found,) = selectors('histogram_quantile(0.9, sum by (le) (rate(visloc_no{a="b"}[5m]))) > 5e9')

    assert found == ("visloc_no", {"a": "b"})


def test_every_metric_of_the_service_is_on_the_dashboard() -> None:
    used = {name for _, text in expressions() for name, _ in selectors(text)}
    bases = {re.sub(r"_(bucket|sum|count)$", "", name) for name in used}

    ours = {
        re.sub(r"_(bucket|sum|count)$", "", name) for name in SERIES if name.startswith("visloc_")
    }
    assert ours - bases == {"visloc_build_info"}  # of the variable


def test_every_alert_says_how_bad_it_is_what_is_wrong_and_where_to_read_on() -> None:
    names = [rule["alert"] for rule in alerts()]

    assert len(names) == len(set(names))
    for rule in alerts():
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert rule["annotations"]["summary"]
        assert rule["annotations"]["runbook"] == f"docs/operations.md#{rule['alert'].lower()}"


def test_the_manual_explains_every_alert_and_no_other() -> None:
    manual = (ROOT / "docs" / "operations.md").read_text()

    assert re.findall(r"^### (Visloc\w+)$", manual, re.M) == [rule["alert"] for rule in alerts()]


def test_panels_have_a_unit_a_description_and_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in panels():
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells
        if panel["type"] != "row":
            assert panel["description"].endswith(".")
        if panel["type"] in ("stat", "timeseries"):
            assert panel["fieldConfig"]["defaults"]["unit"]
    for name in ("id", "title"):
        assert len({panel[name] for panel in panels()}) == len(panels())


def test_the_dashboard_asks_the_data_source_that_is_provisioned() -> None:
    folder = ROOT / "deploy" / "grafana" / "provisioning" / "datasources"
    (source,) = yaml.safe_load((folder / "prometheus.yml").read_text())["datasources"]

    assert set(re.findall(r'"uid": "(\w+)"', DASHBOARD.read_text())) == {source["uid"], "visloc"}


needs_promtool = pytest.mark.skipif(
    shutil.which("promtool") is None, reason="needs promtool of Prometheus"
)


@needs_promtool
@pytest.mark.parametrize("command", [["config", "prometheus.yml"], ["rules", "alerts.yml"]])
def test_prometheus_takes_its_files(command: list[str]) -> None:
    done = subprocess.run(
        ["promtool", "check", *command], cwd=PROMETHEUS, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@needs_promtool
def test_prometheus_parses_every_expression(tmp_path: Path) -> None:
    rules = [
        {"record": f"a{n}", "expr": re.sub(r"\$__rate_interval", "1m", text)}
        for n, (_, text) in enumerate(expressions())
    ]
    (tmp_path / "all.yml").write_text(yaml.safe_dump({"groups": [{"name": "a", "rules": rules}]}))
    done = subprocess.run(
        ["promtool", "check", "rules", "all.yml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@needs_promtool
def test_alerts_fire_when_they_should_and_not_before() -> None:
    cases = Path(__file__).with_name("alerts_test.yml")
    done = subprocess.run(
        ["promtool", "test", "rules", str(cases)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
