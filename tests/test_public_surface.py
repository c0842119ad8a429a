"""A public name that goes, or comes, is a decision: it shows in tests/api_surface.json."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

SURFACE: dict[str, list[str]] = json.loads(
    Path(__file__).with_name("api_surface.json").read_text(encoding="utf-8")
)


def place(name: str) -> tuple[int, str]:
    """Constants, classes, functions; by the alphabet within each."""
    return (0 if name.isupper() else 1 if name[0].isupper() else 2, name)


@pytest.mark.parametrize("package", SURFACE)
def test_the_public_names_are_those_that_are_listed(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__all__ == SURFACE[package] == sorted(SURFACE[package], key=place)
    assert len(set(module.__all__)) == len(module.__all__)
    assert all(hasattr(module, name) for name in module.__all__)


def modules_after(statement: str) -> set[str]:
    """What a fresh interpreter has loaded."""
    code = f"import sys; {statement}; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize("package", ["visloc", "visloc.kapture", "visloc.evaluation", "clients"])
def test_the_light_packages_load_nothing_heavy(package: str) -> None:
    loaded = modules_after(f"import {package}")
    assert package in loaded
    assert not loaded & {"torch", "cv2", "pycolmap", "PIL", "scipy", "safetensors"}
    assert ("pydantic" in loaded) == (package == "clients")  # the words of the API


def test_the_registry_of_features_loads_no_feature() -> None:
    assert not modules_after("import visloc.features") & {"torch", "cv2", "pycolmap"}
