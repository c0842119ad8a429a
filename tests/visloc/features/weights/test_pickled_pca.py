"""Whitening of scikit-learn in a weights file: read without running it, refused when odd."""

from __future__ import annotations

import os
import pickle
import struct
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.pickled_pca import STAND_INS, principal_components

_ENCODE = b"c_codecs\nencode\n"
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
    module = types.ModuleType(request.param)
    module.PCA = PCA  # type: ignore[attr-defined]
    for name in ("sklearn", "sklearn.decomposition"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, request.param, module)
    monkeypatch.setattr(PCA, "__module__", request.param)
    return PCA()


def _saved(path: Path, pca: Any, **beside: Any) -> Path:
    content = {"state_dict": {"weight": torch.arange(3.0)}, "pca": {"Landmarks_clean": pca}}
    torch.save(content | beside, path)
    return path


def _read_pickle(path: Path, content: bytes) -> Checkpoint:
    """Read a file whose pickle is {"state_dict": {"weight": (2,)}, **content}, as opcodes."""
    tensor = (
        b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
        b"X\x01\x00\x00\x007X\x03\x00\x00\x00cpuK\x02tQK\x00(K\x02t(K\x01t\x89"
        b"ccollections\nOrderedDict\n)RtR"
    )
    with zipfile.ZipFile(path, "w") as archive:
        state_dict = _string(b"state_dict") + b"}" + _string(b"weight") + tensor + b"s"
        archive.writestr("archive/data.pkl", b"\x80\x02}" + state_dict + b"s" + content + b".")
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/data/7", bytes(8))
    return read_checkpoint(path)


def _string(text: bytes) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pca_is_read_exactly_in_both_layouts(pca: PCA, zipped: bool, tmp_path: Path) -> None:
    content = {"state_dict": {"weight": torch.arange(3.0)}, "pca": {"Landmarks_clean": pca}}
    path = tmp_path / "w.pt"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    checkpoint = read_checkpoint(path)
    found = principal_components(checkpoint.pca["Landmarks_clean"])
    np.testing.assert_array_equal(found.mean, pca.mean_)
    np.testing.assert_array_equal(found.components, pca.components_)
    np.testing.assert_array_equal(found.variances, pca.explained_variance_)
    assert found.whiten is True
    assert list(checkpoint.tensors) == ["weight"]


def test_numpy_before_2_named_its_functions_elsewhere(pca: PCA, tmp_path: Path) -> None:
    pickled = pickle.dumps({"clean": pca}, 2).replace(b"numpy._core.", b"numpy.core.")
    body = pickled[2:-1]  # without the protocol and the stop
    found = _read_pickle(tmp_path / "w.pt", _string(b"pca") + body + b"s").pca["clean"]
    np.testing.assert_array_equal(principal_components(found).components, pca.components_)


@pytest.mark.usefixtures("pca")
def test_double_precision_is_kept(tmp_path: Path) -> None:
    doubles = PCA(dtype=np.float64)
    found = read_checkpoint(_saved(tmp_path / "w.pt", doubles)).pca["Landmarks_clean"]
    np.testing.assert_array_equal(principal_components(found).components, doubles.components_)


@pytest.mark.parametrize("zipped", [True, False])
def test_what_else_a_training_keeps_is_not_looked_at(zipped: bool, tmp_path: Path) -> None:
    weight = torch.nn.Parameter(torch.arange(3.0))
    optimizer = torch.optim.SGD([weight], lr=0.1, momentum=0.9)
    weight.sum().backward()
    optimizer.step()
    content = {
        "epoch": 3,
        "current_iter": 296,
        "model_options": {"arch": "resnet101_rmac", "out_dim": 2048, "pooling": "gem", "p": None},
        "preprocess": {"mean": [0.485, 0.456, 0.406], "input_size": 224},
        "recalls": {1: np.float64(0.8), 5: np.float64(0.9)},
        "parallel": False,
        "optimizer": optimizer.state_dict(),
        "cfg": "MODEL: resnet\n",
        "pca": None,
        "state_dict": {"weight": weight.detach()},
    }
    path = tmp_path / "w.pt"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    checkpoint = read_checkpoint(path)
    np.testing.assert_array_equal(checkpoint.tensors["weight"], weight.detach().numpy())
    assert checkpoint.pca == {}


def test_the_state_may_be_called_model_state(tmp_path: Path) -> None:
    torch.save({"epoch": 1, "model_state": {"weight": torch.ones(2)}}, tmp_path / "w.pt")
    assert list(read_checkpoint(tmp_path / "w.pt").tensors) == ["weight"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"mean_": None}, "mean_ is no array"),
        ({"components_": [1.0]}, "components_ is no array"),
        ({"components_": np.ones((3, 4), np.float32)}, "do not fit together"),
        ({"components_": np.ones(5, np.float32)}, "do not fit together"),
        ({"components_": np.ones((1, 3, 5), np.float32)}, "odd description"),
        ({"explained_variance_": np.ones(6, np.float32)}, "do not fit together"),
        ({"explained_variance_": np.zeros(3, np.float32)}, "not positive"),
        ({"mean_": np.full(5, np.nan, np.float32)}, "not finite"),
        ({"mean_": np.arange(5)}, "not of little-endian floats"),
        ({"mean_": np.ones(5, ">f4")}, "not of little-endian floats"),
        ({"mean_": np.array(["a"] * 5)}, "not of little-endian floats"),
        ({"whiten": None}, "does not say whether"),
    ],
)
def test_a_pca_that_is_not_whole_is_refused_with_the_reason(
    change: dict[str, Any], reason: str, pca: PCA, tmp_path: Path
) -> None:
    vars(pca).update(change)
    found = read_checkpoint(_saved(tmp_path / "w.pt", pca)).pca["Landmarks_clean"]
    with pytest.raises(ValueError, match=reason):
        principal_components(found)


PCA_OBJECT = b"csklearn.decomposition._pca\nPCA\n)\x81"
ARRAY = (
    b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85" + _string(b"b") + b"tR"
)
FLOATS = b"cnumpy\ndtype\n(" + _string(b"f4") + b"K\x00K\x01tR(K\x03" + _string(b"<") + b"tb"


def _array(shape: bytes, data: bytes) -> bytes:
    return ARRAY + b"(K\x01" + shape + FLOATS + b"\x89" + data + b"tb"


def _encoded(text: bytes) -> bytes:
    return _ENCODE + _string(text) + _string(b"latin1") + b"\x86R"


@pytest.mark.parametrize(
    ("mean", "reason"),
    [
        (_array(b"K\x02\x85", _encoded(b"abcd")), "holds 1 numbers"),
        (_array(b"J\xff\xff\xff\x7f\x85", _encoded(b"abcd")), "odd description"),
        (_array(b"J\xff\xff\xff\xff\x85", _encoded(b"abcd")), "odd description"),
        (_array(b"X\x01\x00\x00\x00a\x85", _encoded(b"abcd")), "odd description"),
        (_array(b"K\x01\x85", _encoded(b"abc")), "buffer size"),
        (_array(b"K\x01\x85", b"N"), "odd description"),
        (ARRAY, "odd description"),
        (ARRAY + b"Nb", "odd description"),
        (b"cnumpy\nndarray\n)R", "no array"),
        (PCA_OBJECT, "no array"),
    ],
)
def test_odd_arrays_are_refused_when_they_are_asked_for(
    mean: bytes, reason: str, tmp_path: Path
) -> None:
    state = b"}" + _string(b"mean_") + mean + b"s"
    pca = b"}" + _string(b"clean") + PCA_OBJECT + state + b"bs"
    checkpoint = _read_pickle(tmp_path / "w.pt", _string(b"pca") + pca + b"s")
    with pytest.raises(ValueError, match=reason):
        principal_components(checkpoint.pca["clean"])


@pytest.mark.parametrize(
    "name",
    [
        b"sklearn.decomposition.pca\nnp",
        b"sklearn.decomposition.pca\nPCA.fit",
        b"sklearn.decomposition\nPCA",
        b"sklearn.utils\n_joblib",
        b"numpy\nload",
        b"numpy\nndarray.tofile",
        b"numpy.core.multiarray\nfromfile",
        b"numpy.core.multiarray\n_reconstruct.__globals__",
        b"_codecs\ndecode",
        b"codecs\nencode",
        b"codecs\nopen",
    ],
)
def test_no_other_name_of_these_packages_is_known(name: bytes, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="is no name that a state dict needs"):
        _read_pickle(tmp_path / "w.pt", _string(b"pca") + b"c" + name + b"\ns")


def test_stand_ins_import_and_call_nothing(pca: PCA, tmp_path: Path) -> None:
    witness = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, (f"touch {witness}",)

    pca.mean_ = Evil()  # type: ignore[assignment]
    with pytest.raises(WeightsError, match="is no name that a state dict needs"):
        read_checkpoint(_saved(tmp_path / "w.pt", pca))
    assert not witness.exists()


@pytest.mark.parametrize(
    "content",
    [
        # the class itself given attributes, as a dict and as slots
        b"csklearn.decomposition.pca\nPCA\n}" + _string(b"__setstate__") + b"Nsb",
        b"csklearn.decomposition.pca\nPCA\nN}" + _string(b"mean_") + b"Ns\x86b",
        b"c_codecs\nencode\nN}" + _string(b"state") + b"Ns\x86b",
    ],
)
def test_a_file_cannot_change_the_stand_ins(content: bytes, tmp_path: Path) -> None:
    before = {name: dict(vars(found)) for name, found in STAND_INS.items()}
    with pytest.raises(WeightsError) as caught:
        _read_pickle(tmp_path / "w.pt", _string(b"pca") + content + b"s")
    assert caught.value.code == "weights.format"
    assert before == {name: dict(vars(found)) for name, found in STAND_INS.items()}


def test_bytes_asked_for_again_and_again_take_no_memory(tmp_path: Path) -> None:
    """A text of a megabyte, encoded 9000 times by 8 bytes each, would be 9 gigabytes."""
    text = b"c_codecs\nencode\nq\x01" + _string(b"a" * 2**20) + b"q\x02" + _string(b"latin1")
    once = text + b"q\x03\x86R"
    again = b"h\x01h\x02h\x03\x86R" * 9_000
    with pytest.raises(WeightsError, match="again and again"):
        _read_pickle(tmp_path / "w.pt", _string(b"other") + b"(" + once + again + b"ts")


@pytest.mark.parametrize(
    "content",
    [
        _ENCODE * 31 + _string(b"a" * 1000) + (_string(b"hex") + b"\x86R") * 31,
        _ENCODE + _string(b"abcd") + _string(b"rot13") + b"\x86R",
        _ENCODE + _string(b"a" * 1000) + _string(b"utf-32") + b"\x86R",
        _ENCODE + b"q\x01q\x02" + _string(b"a") + _string(b"latin1") + b"\x86R"
        b"h\x02" + _string(b"a") + _string(b"hex") + b"\x86R\x86",
        _ENCODE + _string(b"a") + _string(b"latin1") + _string(b"hex") + b"\x86\x86R",
    ],
)
def test_bytes_are_encoded_in_one_way_only(content: bytes, tmp_path: Path) -> None:
    """Hexadecimal digits of hexadecimal digits, thirty times, would be a terabyte."""
    with pytest.raises(WeightsError, match="not for bytes as pickle writes them"):
        _read_pickle(tmp_path / "w.pt", _string(b"other") + content + b"s")


def test_deeply_nested_objects_end_in_an_answer(tmp_path: Path) -> None:
    depth = 240_000
    nested = b"csklearn.decomposition.pca\nPCA\nq\x01)\x81" + b"h\x01)\x81" * depth + b"b" * depth
    checkpoint = _read_pickle(
        tmp_path / "w.pt", _string(b"pca") + b"}" + _string(b"a") + nested + b"ss"
    )
    with pytest.raises(ValueError, match="no array"):
        principal_components(checkpoint.pca["a"])


def test_random_damage_never_raises_anything_else(pca: PCA, tmp_path: Path) -> None:
    whole = _saved(tmp_path / "whole.pt", pca).read_bytes()
    random = np.random.default_rng(0)
    start, end = whole.index(b"csklearn"), whole.index(b"noise_variance_")
    for _ in range(300):
        damaged = bytearray(whole)
        for position in random.integers(start, end, size=3):
            damaged[position] = random.integers(256)
        # zip checks its members' sums: give the damaged pickle to an unzipped reader
        body = bytes(damaged[damaged.index(b"\x80\x02") : end])
        try:
            content = _string(b"pca") + b"}" + _string(b"a") + body[2:] + b"Nsbss"
            checkpoint = _read_pickle(tmp_path / "damaged.pt", content)
        except WeightsError:
            continue
        for each in checkpoint.pca.values():
            try:
                principal_components(each)
            except ValueError:
                continue
