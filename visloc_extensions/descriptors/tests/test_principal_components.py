"""Whitening of scikit-learn in a weights file: read without running it, refused when odd."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.visloc.features.weights.pickles import MODULES, PCA, pca_of, read_pickle, saved, string
from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import read_checkpoint
from visloc_extensions.descriptors.principal_components import principal_components

_ENCODE = b"c_codecs\nencode\n"


@pytest.fixture(params=MODULES)
def pca(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> PCA:
    return pca_of(request.param, monkeypatch)


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
    found = read_pickle(tmp_path / "w.pt", string(b"pca") + body + b"s").pca["clean"]
    np.testing.assert_array_equal(principal_components(found).components, pca.components_)


@pytest.mark.usefixtures("pca")
def test_double_precision_is_kept(tmp_path: Path) -> None:
    doubles = PCA(dtype=np.float64)
    found = read_checkpoint(saved(tmp_path / "w.pt", doubles)).pca["Landmarks_clean"]
    np.testing.assert_array_equal(principal_components(found).components, doubles.components_)


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
    found = read_checkpoint(saved(tmp_path / "w.pt", pca)).pca["Landmarks_clean"]
    with pytest.raises(ValueError, match=reason):
        principal_components(found)


PCA_OBJECT = b"csklearn.decomposition._pca\nPCA\n)\x81"
ARRAY = b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85" + string(b"b") + b"tR"
FLOATS = b"cnumpy\ndtype\n(" + string(b"f4") + b"K\x00K\x01tR(K\x03" + string(b"<") + b"tb"


def _array(shape: bytes, data: bytes) -> bytes:
    return ARRAY + b"(K\x01" + shape + FLOATS + b"\x89" + data + b"tb"


def _encoded(text: bytes) -> bytes:
    return _ENCODE + string(text) + string(b"latin1") + b"\x86R"


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
    state = b"}" + string(b"mean_") + mean + b"s"
    pca = b"}" + string(b"clean") + PCA_OBJECT + state + b"bs"
    checkpoint = read_pickle(tmp_path / "w.pt", string(b"pca") + pca + b"s")
    with pytest.raises(ValueError, match=reason):
        principal_components(checkpoint.pca["clean"])


def test_deeply_nested_objects_end_in_an_answer(tmp_path: Path) -> None:
    depth = 240_000
    nested = b"csklearn.decomposition.pca\nPCA\nq\x01)\x81" + b"h\x01)\x81" * depth + b"b" * depth
    checkpoint = read_pickle(
        tmp_path / "w.pt", string(b"pca") + b"}" + string(b"a") + nested + b"ss"
    )
    with pytest.raises(ValueError, match="no array"):
        principal_components(checkpoint.pca["a"])


def test_random_damage_never_raises_anything_else(pca: PCA, tmp_path: Path) -> None:
    whole = saved(tmp_path / "whole.pt", pca).read_bytes()
    random = np.random.default_rng(0)
    start, end = whole.index(b"csklearn"), whole.index(b"noise_variance_")
    for _ in range(300):
        damaged = bytearray(whole)
        for position in random.integers(start, end, size=3):
            damaged[position] = random.integers(256)
        # zip checks its members' sums: give the damaged pickle to an unzipped reader
        body = bytes(damaged[damaged.index(b"\x80\x02") : end])
        try:
            content = string(b"pca") + b"}" + string(b"a") + body[2:] + b"Nsbss"
            checkpoint = read_pickle(tmp_path / "damaged.pt", content)
        except WeightsError:
            continue
        for each in checkpoint.pca.values():
            try:
                principal_components(each)
            except ValueError:
                continue
