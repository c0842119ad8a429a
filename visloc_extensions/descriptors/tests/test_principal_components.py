"""Whitening of scikit-learn in a weights file: read without scikit-learn, refused when odd."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import read_checkpoint
from visloc_extensions.descriptors.principal_components import STAND_INS, principal_components

MODULES = ("sklearn.decomposition.pca", "sklearn.decomposition._pca")


class PCA:
    """Has the attributes that scikit-learn's has after learning."""

    def __init__(self, dim: int = 5, kept: int = 3, dtype: type = np.float32) -> None:
        random = np.random.default_rng(7)
        self.copy, self.iterated_power, self.n_components = True, "auto", None
        self.random_state, self.svd_solver, self.tol, self.whiten = None, "full", 0.0, True
        self.mean_ = random.normal(size=dim).astype(dtype)
        # as LAPACK gives them: columns come first in memory
        self.components_ = np.asfortranarray(random.normal(size=(kept, dim)), dtype)
        self.explained_variance_ = np.linspace(3, 1, kept).astype(dtype)
        self.noise_variance_ = np.float32(0.25)
        self.n_samples_, self._sklearn_version = 2048, "0.20.2"


@pytest.fixture(params=MODULES)
def pca(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> PCA:
    """Return one that pickle finds in a module."""
    module = types.ModuleType(request.param)
    vars(module)["PCA"] = PCA
    for name in ("sklearn", "sklearn.decomposition"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, request.param, module)
    monkeypatch.setattr(PCA, "__module__", request.param)
    return PCA()


def _read(path: Path, pca: object, *, zipped: bool = True) -> object:
    content = {"state_dict": {"weight": torch.arange(3.0)}, "pca": {"Landmarks_clean": pca}}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    with torch.serialization.safe_globals(STAND_INS):
        return read_checkpoint(path).beside["pca"]["Landmarks_clean"]


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pca_is_read_exactly_in_both_layouts(pca: PCA, zipped: bool, tmp_path: Path) -> None:
    found = principal_components(_read(tmp_path / "w.pt", pca, zipped=zipped))
    np.testing.assert_array_equal(found.mean, pca.mean_)
    np.testing.assert_array_equal(found.components, pca.components_)
    np.testing.assert_array_equal(found.variances, pca.explained_variance_)
    assert found.whiten is True


@pytest.mark.usefixtures("pca")
def test_double_precision_is_kept(tmp_path: Path) -> None:
    doubles = PCA(dtype=np.float64)
    found = principal_components(_read(tmp_path / "w.pt", doubles))
    np.testing.assert_array_equal(found.components, doubles.components_)


def test_other_files_may_not_name_a_pca(pca: PCA, tmp_path: Path) -> None:
    torch.save({"state_dict": {"weight": torch.ones(1)}, "pca": pca}, tmp_path / "w.pt")
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(tmp_path / "w.pt")
    assert caught.value.code == "weights.format"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"mean_": None}, "mean_ is no array"),
        ({"components_": [1.0]}, "components_ is no array"),
        ({"components_": np.ones((3, 4), np.float32)}, "do not fit together"),
        ({"components_": np.ones(5, np.float32)}, "do not fit together"),
        ({"components_": np.ones((1, 3, 5), np.float32)}, "do not fit together"),
        ({"explained_variance_": np.ones(6, np.float32)}, "do not fit together"),
        ({"explained_variance_": np.zeros(3, np.float32)}, "not positive"),
        ({"mean_": np.full(5, np.nan, np.float32)}, "not finite"),
        ({"mean_": np.arange(5)}, "no array of floats"),
        ({"whiten": None}, "does not say whether"),
    ],
)
def test_a_pca_that_is_not_whole_is_refused_with_the_reason(
    change: dict[str, Any], reason: str, pca: PCA, tmp_path: Path
) -> None:
    vars(pca).update(change)
    found = _read(tmp_path / "w.pt", pca)
    with pytest.raises(ValueError, match=reason):
        principal_components(found)


def test_what_is_no_pca_is_refused() -> None:
    with pytest.raises(ValueError, match="no array"):
        principal_components({"mean_": np.ones(3)})
