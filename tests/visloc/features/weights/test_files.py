from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import (
    MAX_FILE_BYTES,
    Checkpoint,
    read_checkpoint,
    sha256_of,
)
from visloc.features.weights.files import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    check_shapes,
    read_weights,
)

LAYOUTS = pytest.mark.parametrize("zipped", [True, False])


class _Call:
    """Pickles as a call of ``function(*arguments)``."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


def _saved(path: Path, content: object, *, zipped: bool = True) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    return path


@LAYOUTS
def test_what_torch_saves_is_read_exactly(zipped: bool, tmp_path: Path) -> None:
    base = torch.arange(24.0)
    state = {
        "plain": torch.randn(3, 2, generator=torch.Generator().manual_seed(0)),
        "transposed": torch.arange(6.0).reshape(2, 3).T,
        "part_of_a_shared_storage": base[4:12].reshape(2, 4),
        "another_part": base[1::2],
        "counter": torch.tensor(12345),
        "learned": torch.nn.Parameter(torch.ones(2)),
    }
    log = [defaultdict(list, loss=[0.5, 0.25])]
    content = {"net": "Net()", "state_dict": OrderedDict(state), "log": log}
    checkpoint = read_checkpoint(_saved(tmp_path / "w.pt", content, zipped=zipped))
    assert list(checkpoint.tensors) == list(state)
    for name, tensor in state.items():
        np.testing.assert_array_equal(checkpoint.tensors[name], tensor.detach().numpy())
    assert checkpoint.beside == {"net": "Net()", "log": [{"loss": [0.5, 0.25]}]}
    assert checkpoint.sha256 == hashlib.sha256((tmp_path / "w.pt").read_bytes()).hexdigest()
    assert checkpoint.sha256 == sha256_of(tmp_path / "w.pt")


@LAYOUTS
def test_what_a_training_keeps_beside_the_state_does_not_hinder(
    zipped: bool, tmp_path: Path
) -> None:
    weight = torch.nn.Parameter(torch.arange(3.0))
    optimizer = torch.optim.SGD([weight], lr=0.1, momentum=0.9)
    weight.sum().backward()
    optimizer.step()
    content = {
        "recalls": {1: np.float64(0.8), 5: np.float32(0.9), 10: np.int64(3)},
        "mean": np.arange(3.0),
        "optimizer": optimizer.state_dict(),
        "model_state": {"weight": weight.detach()},
    }
    checkpoint = read_checkpoint(_saved(tmp_path / "w.pt", content, zipped=zipped))
    assert list(checkpoint.tensors) == ["weight"]
    assert checkpoint.beside["recalls"][1] == 0.8


def test_numpy_before_2_named_its_functions_elsewhere(tmp_path: Path) -> None:
    content = {"state_dict": {"weight": torch.ones(1)}, "mean": np.arange(3.0)}
    path = _saved(tmp_path / "w.pt", content, zipped=False)
    path.write_bytes(path.read_bytes().replace(b"numpy._core.", b"numpy.core."))
    np.testing.assert_array_equal(read_checkpoint(path).beside["mean"], np.arange(3.0))


def test_published_fast_file_is_read_and_agrees_with_published_facts(shared_weights: Path) -> None:
    checkpoint = read_weights(shared_weights, FASTER2D2_WASF_N16)
    assert checkpoint.sha256 == FASTER2D2_WASF_N16.sha256
    assert sum(array.size for array in checkpoint.tensors.values()) == 485_803
    np.testing.assert_allclose(checkpoint.tensors["clf.bias"], [0.0919, -0.1127], atol=1e-4)
    np.testing.assert_allclose(checkpoint.tensors["sal.bias"], [-0.4595], atol=1e-4)


@LAYOUTS
@pytest.mark.parametrize(
    "function", [os.system, subprocess.check_call, eval, exec, torch.load, torch.hub.load, getattr]
)
def test_code_in_a_file_is_refused_and_not_run(
    function: Callable[..., Any], zipped: bool, tmp_path: Path
) -> None:
    witness = tmp_path / "ran"
    argument = f"open({str(witness)!r}, 'w')" if function in (eval, exec) else f"touch {witness}"
    path = _saved(tmp_path / "w.pt", {"weight": _Call(function, argument)}, zipped=zipped)
    with pytest.raises(WeightsError, match="does not hold complete, plain tensors") as caught:
        read_checkpoint(path)
    assert caught.value.code == "weights.format"
    assert "can still be loaded" not in str(caught.value)
    assert "Unsupported" in str(caught.value) or "unsupported" in str(caught.value)
    assert not witness.exists()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"state_dict": {}}, "no state dict"),
        (5, "no state dict"),
        ({"weight": 1}, "holds int under 'weight'"),
        ({1: torch.ones(1)}, "holds Tensor under 1"),
        ({"weight": torch.ones(2, dtype=torch.int16)}, "of type int16"),
        ({"weight": torch.ones(2, dtype=torch.bfloat16)}, "BFloat16"),
    ],
)
def test_content_that_is_no_state_dict_is_refused_with_the_reason(
    content: object, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=reason) as caught:
        read_checkpoint(_saved(tmp_path / "w.pt", content))
    assert caught.value.code == "weights.format"
    assert str(tmp_path / "w.pt") in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [b"", b"PK", b"<html>404</html>", b"PK\x03\x04" + bytes(99), pickle.dumps({"a": 1}, 2)],
)
def test_what_is_no_weights_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "w.pt").write_bytes(content)
    with pytest.raises(WeightsError, match="a state dict saved by"):
        read_checkpoint(tmp_path / "w.pt")


@LAYOUTS
def test_truncated_and_damaged_files_raise_nothing_else(zipped: bool, tmp_path: Path) -> None:
    whole = _saved(tmp_path / "whole.pt", {"weight": torch.ones(2)}, zipped=zipped).read_bytes()
    generator = np.random.default_rng(0)
    path = tmp_path / "damaged.pt"
    for length in range(0, len(whole) - 1, max(1, len(whole) // 100)):
        path.write_bytes(whole[:length])
        with pytest.raises(WeightsError):
            read_checkpoint(path)
    for _ in range(100):
        damaged = bytearray(whole)
        for position in generator.integers(len(whole), size=3):
            damaged[position] = generator.integers(256)
        path.write_bytes(damaged)
        try:
            read_checkpoint(path)
        except WeightsError:
            continue


def test_file_beyond_the_size_limit_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "w.pt").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)  # sparse
    with pytest.raises(WeightsError, match="too large"):
        read_checkpoint(tmp_path / "w.pt")


def test_missing_weights_say_what_to_download_and_where_to_put_it(tmp_path: Path) -> None:
    for weights_dir in (None, tmp_path, tmp_path / "absent"):
        with pytest.raises(WeightsError) as caught:
            read_weights(weights_dir, FASTER2D2_WASF_N16)
        assert caught.value.code == "weights.missing"
        for part in (
            "faster2d2_WASF_N16.pt",
            "https://github.com/naver/r2d2",
            "CC BY-NC-SA 3.0",
            "non-commercial",
            "--weights-dir",
            "VISLOC_WEIGHTS_DIR",
        ):
            assert part in str(caught.value)


def test_folder_in_place_of_the_file_counts_as_missing(tmp_path: Path) -> None:
    (tmp_path / R2D2_WASF_N16.file_name).mkdir()
    with pytest.raises(WeightsError, match="download"):
        read_weights(tmp_path, R2D2_WASF_N16)


def _checkpoint(**tensors: np.ndarray[Any, Any]) -> Checkpoint:
    return Checkpoint(Path("w.pt"), "0" * 64, tensors)


@pytest.mark.parametrize(
    ("tensors", "difference"),
    [
        ({"a": np.ones(2)}, "b"),
        ({"a": np.ones(2), "b": np.ones(3), "c": np.ones(1)}, "c"),
        ({"a": np.ones((2, 1)), "b": np.ones(3)}, "a"),
    ],
)
def test_other_tensors_than_the_networks_are_named(
    tensors: dict[str, np.ndarray[Any, Any]], difference: str
) -> None:
    with pytest.raises(WeightsError, match=f"first difference is {difference}") as caught:
        check_shapes(
            _checkpoint(**tensors), {"a": (2,), "b": (3,)}, network="Net", held="another network"
        )
    assert caught.value.code == "weights.network"


def test_file_of_another_sha256_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "w.pt").write_bytes(b"not weights")
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(tmp_path / "w.pt", sha256="0" * 64)
    assert caught.value.code == "weights.altered"


@pytest.mark.parametrize(
    "tensors",
    [{"a": np.array([1, np.nan])}, {"a": np.array([np.inf, 0])}, {"bn.running_var": -np.ones(2)}],
)
def test_numbers_that_no_network_has_are_refused(tensors: dict[str, Any]) -> None:
    shapes = {name: array.shape for name, array in tensors.items()}
    with pytest.raises(WeightsError) as caught:
        check_shapes(_checkpoint(**tensors), shapes, network="Net", held="another network")
    assert caught.value.code == "weights.values"
