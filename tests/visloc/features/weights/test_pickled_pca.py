"""Whitening of scikit-learn in a weights file: read without running it, refused when odd."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.visloc.features.weights.pickles import MODULES, PCA, pca_of, read_pickle, saved, string
from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.features.weights.pickled_pca import STAND_INS

_ENCODE = b"c_codecs\nencode\n"


@pytest.fixture(params=MODULES)
def pca(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> PCA:
    return pca_of(request.param, monkeypatch)


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
        read_pickle(tmp_path / "w.pt", string(b"pca") + b"c" + name + b"\ns")


def test_stand_ins_import_and_call_nothing(pca: PCA, tmp_path: Path) -> None:
    witness = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, (f"touch {witness}",)

    pca.mean_ = Evil()  # type: ignore[assignment]
    with pytest.raises(WeightsError, match="is no name that a state dict needs"):
        read_checkpoint(saved(tmp_path / "w.pt", pca))
    assert not witness.exists()


@pytest.mark.parametrize(
    "content",
    [
        # the class itself given attributes, as a dict and as slots
        b"csklearn.decomposition.pca\nPCA\n}" + string(b"__setstate__") + b"Nsb",
        b"csklearn.decomposition.pca\nPCA\nN}" + string(b"mean_") + b"Ns\x86b",
        b"c_codecs\nencode\nN}" + string(b"state") + b"Ns\x86b",
    ],
)
def test_a_file_cannot_change_the_stand_ins(content: bytes, tmp_path: Path) -> None:
    before = {name: dict(vars(found)) for name, found in STAND_INS.items()}
    with pytest.raises(WeightsError) as caught:
        read_pickle(tmp_path / "w.pt", string(b"pca") + content + b"s")
    assert caught.value.code == "weights.format"
    assert before == {name: dict(vars(found)) for name, found in STAND_INS.items()}


def test_bytes_asked_for_again_and_again_take_no_memory(tmp_path: Path) -> None:
    """A text of a megabyte, encoded 9000 times by 8 bytes each, would be 9 gigabytes."""
    text = b"c_codecs\nencode\nq\x01" + string(b"a" * 2**20) + b"q\x02" + string(b"latin1")
    once = text + b"q\x03\x86R"
    again = b"h\x01h\x02h\x03\x86R" * 9_000
    with pytest.raises(WeightsError, match="again and again"):
        read_pickle(tmp_path / "w.pt", string(b"other") + b"(" + once + again + b"ts")


@pytest.mark.parametrize(
    "content",
    [
        _ENCODE * 31 + string(b"a" * 1000) + (string(b"hex") + b"\x86R") * 31,
        _ENCODE + string(b"abcd") + string(b"rot13") + b"\x86R",
        _ENCODE + string(b"a" * 1000) + string(b"utf-32") + b"\x86R",
        _ENCODE + b"q\x01q\x02" + string(b"a") + string(b"latin1") + b"\x86R"
        b"h\x02" + string(b"a") + string(b"hex") + b"\x86R\x86",
        _ENCODE + string(b"a") + string(b"latin1") + string(b"hex") + b"\x86\x86R",
    ],
)
def test_bytes_are_encoded_in_one_way_only(content: bytes, tmp_path: Path) -> None:
    """Hexadecimal digits of hexadecimal digits, thirty times, would be a terabyte."""
    with pytest.raises(WeightsError, match="not for bytes as pickle writes them"):
        read_pickle(tmp_path / "w.pt", string(b"other") + content + b"s")
