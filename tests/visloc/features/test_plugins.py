from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from visloc.errors import InvalidInput, WeightsError
from visloc.features import (
    global_feature_names,
    local_feature_names,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.sift import SiftExtractor
from visloc.options import Inference

Install = Callable[..., None]
SOURCE = """
from types import SimpleNamespace
from visloc.errors import WeightsError
from visloc.types import Fingerprint

def load(weights_dir, inference, threads):
    made = Fingerprint("grid", 1, {"asked": f"{weights_dir} {inference} {threads}"})
    members = "computed_with descriptor_dim extract needs_image needs_local_features"
    members += " needs_vocabulary training_words learn_vocabulary pool learn_projection project"
    return SimpleNamespace(fingerprint=made, **dict.fromkeys([*members.split(), "describe"]))

def refuse(weights_dir, inference, threads):
    raise WeightsError("weights.missing", "no weights of grid")

def unfinished(weights_dir, inference, threads):
    return SimpleNamespace(fingerprint=Fingerprint("grid", 1, {}), computed_with="nothing")

def leave(weights_dir, inference, threads):
    raise SystemExit("gone")

def break_down(weights_dir, inference, threads):
    return 1 // 0
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Install a package as pip does: the module ``grid_features`` and metadata."""
    monkeypatch.syspath_prepend(tmp_path)

    def _install(
        name: str, value: str, package: str = "grid-features", group: str = "local"
    ) -> None:
        (tmp_path / "grid_features.py").write_text(SOURCE)
        monkeypatch.delitem(sys.modules, "grid_features", raising=False)
        info = tmp_path / f"{package.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        entry = f"[visloc.{group}_features]\n{name} = {value}\n"
        (info / "entry_points.txt").write_text(entry)

    return _install


def test_a_plugin_is_made_with_the_settings_and_loaded_only_then(install: Install) -> None:
    install("grid", "grid_features:load")
    assert "grid" in local_feature_names()
    assert "grid" not in global_feature_names()
    assert "grid_features" not in sys.modules
    made = make_local_features("grid", Path("w"), Inference.FP32, 3)
    assert made.fingerprint.parameters == {"asked": "w fp32 3"}


def test_a_global_descriptor_may_come_from_a_plugin(install: Install) -> None:
    install("grid", "grid_features:load", group="global")
    assert "grid" in global_feature_names()
    assert make_global_descriptor("grid").fingerprint.name == "grid"


def test_our_own_features_cannot_be_replaced(install: Install) -> None:
    install("sift", "grid_features:break_down")
    assert isinstance(make_local_features("sift"), SiftExtractor)
    assert local_feature_names().count("sift") == 1


@pytest.mark.parametrize("name", ["Grid", "kapture:grid", "../grid", "g" * 65])
def test_names_that_no_map_can_have_are_no_features(install: Install, name: str) -> None:
    install(name, "grid_features:load")
    assert name not in local_feature_names()
    with pytest.raises(InvalidInput, match="the features are unknown") as caught:
        make_local_features(name)
    assert caught.value.code == "features.unknown"
    assert caught.value.expected == f"one of {', '.join(local_feature_names())}"
    assert f"{name!r} of the package grid-features" in str(caught.value)


def test_two_packages_that_offer_the_same_name_are_named(install: Install) -> None:
    install("grid", "grid_features:load")
    install("grid", "grid_features:load", package="grid-again")
    with pytest.raises(InvalidInput, match="uninstall all but one") as caught:
        make_local_features("grid")
    assert caught.value.code == "features.plugin"
    assert caught.value.got == "grid-again, grid-features"


@pytest.mark.parametrize(
    ("value", "got"),
    [
        ("grid_features.nothing:load", "ModuleNotFoundError"),
        ("grid_features:nothing", "AttributeError"),
        ("grid_features:break_down", "ZeroDivisionError"),
        ("grid_features:SOURCE.x", "AttributeError"),
        ("grid_features:SimpleNamespace", "TypeError"),
        ("grid_features:leave", "SystemExit: gone"),
    ],
)
def test_a_plugin_that_fails_is_named(install: Install, value: str, got: str) -> None:
    install("grid", value)
    with pytest.raises(InvalidInput, match="the package grid-features cannot") as caught:
        make_local_features("grid")
    assert (caught.value.code, caught.value.field) == ("features.plugin", "grid")
    assert str(caught.value.got).startswith(got)


def test_a_plugin_that_makes_something_else_is_told_what_is_lacking(install: Install) -> None:
    install("grid", "grid_features:unfinished")
    with pytest.raises(InvalidInput, match="repair or uninstall") as caught:
        make_local_features("grid")
    assert caught.value.code == "features.plugin"
    assert caught.value.got == "SimpleNamespace without descriptor_dim, extract"


def test_a_plugin_speaks_for_itself_about_its_weights(install: Install) -> None:
    install("grid", "grid_features:refuse")
    with pytest.raises(WeightsError, match="no weights of grid"):
        make_local_features("grid")


def test_a_plugin_whose_features_have_another_name_is_refused(install: Install) -> None:
    install("mesh", "grid_features:load")
    with pytest.raises(InvalidInput, match="makes features of another name") as caught:
        make_local_features("mesh")
    assert (caught.value.code, caught.value.got) == ("features.plugin", "grid")
