"""The example of a Ray cluster is one that Ray takes, with the versions that the tests run with."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    """Ray's own."""
    text = (files("ray") / "autoscaler" / "ray-schema.json").read_text(encoding="utf-8")
    return json.loads(text)  # type: ignore[no-any-return]


@pytest.fixture
def example() -> dict[str, Any]:
    text = (ROOT / "visloc_extensions" / "ray" / "cluster.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)  # type: ignore[no-any-return]


def test_the_example_follows_rays_schema(schema: dict[str, Any], example: dict[str, Any]) -> None:
    jsonschema.validate(example, schema)
    wrong = copy.deepcopy(example)
    wrong["docker"]["imag"] = wrong["docker"].pop("image")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, schema)


def test_its_machines_are_named_and_within_its_limit(example: dict[str, Any]) -> None:
    types = example["available_node_types"]
    assert example["head_node_type"] in types
    assert types["worker"]["max_workers"] == example["max_workers"]


def test_its_image_has_our_ray_and_our_python(example: dict[str, Any]) -> None:
    found = re.fullmatch(r"rayproject/ray:([\d.]+)-py(\d)(\d+)-cpu", example["docker"]["image"])
    assert found is not None
    assert found[1] == version("ray")
    assert f"ray=={found[1]}" in (ROOT / "constraints.txt").read_text().splitlines()
    needs = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert (int(found[2]), int(found[3])) >= tuple(int(n) for n in needs.strip(">=").split("."))


def test_it_installs_the_extras_that_a_build_needs(example: dict[str, Any]) -> None:
    [install] = example["setup_commands"]
    [(target, source)] = example["file_mounts"].items()
    assert source == "."
    assert f"'{target}[mapping,cluster]'" in install
    assert f"--constraint {target}/constraints.txt" in install
