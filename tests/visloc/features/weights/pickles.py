"""Weights files that hold a PCA of scikit-learn, and pickles that are made by hand."""

from __future__ import annotations

import struct
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint

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


def pca_of(module_name: str, monkeypatch: pytest.MonkeyPatch) -> PCA:
    """Return one that pickle finds in a module."""
    module = types.ModuleType(module_name)
    module.PCA = PCA  # type: ignore[attr-defined]
    for name in ("sklearn", "sklearn.decomposition"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, module_name, module)
    monkeypatch.setattr(PCA, "__module__", module_name)
    return PCA()


def saved(path: Path, pca: Any, **beside: Any) -> Path:
    content = {"state_dict": {"weight": torch.arange(3.0)}, "pca": {"Landmarks_clean": pca}}
    torch.save(content | beside, path)
    return path


def read_pickle(path: Path, content: bytes) -> Checkpoint:
    """Read a file whose pickle is {"state_dict": {"weight": (2,)}, **content}, as opcodes."""
    tensor = (
        b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
        b"X\x01\x00\x00\x007X\x03\x00\x00\x00cpuK\x02tQK\x00(K\x02t(K\x01t\x89"
        b"ccollections\nOrderedDict\n)RtR"
    )
    with zipfile.ZipFile(path, "w") as archive:
        state_dict = string(b"state_dict") + b"}" + string(b"weight") + tensor + b"s"
        archive.writestr("archive/data.pkl", b"\x80\x02}" + state_dict + b"s" + content + b".")
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/data/7", bytes(8))
    return read_checkpoint(path)


def string(text: bytes) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text
