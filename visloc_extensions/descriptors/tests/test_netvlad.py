"""NetVLAD against its definition; no published weights needed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from visloc.errors import WeightsError
from visloc.features import make_global_descriptor
from visloc.types import LocalFeatures
from visloc_extensions.descriptors.netvlad import PUBLISHED, NetVlad, load_netvlad, vlad

NOTHING = LocalFeatures(
    np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32),
    np.zeros((0, 1), np.float32),
)  # fmt: skip
DIM = 6


def _reference() -> nn.Module:
    """VGG-16's layers as torchvision numbers them, but for the last ReLU and pooling."""
    layers: list[nn.Module] = []
    inputs = 3
    for step in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if step == 0:
            layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
        else:
            layers += [nn.Conv2d(inputs, step, kernel_size=3, padding=1), nn.ReLU()]
            inputs = step
    network = nn.Module()
    network.encoder = nn.Sequential(*layers[:-1])
    network.pool = nn.Module()
    network.pool.conv = nn.Conv2d(512, 64, kernel_size=1, bias=False)
    network.pool.centroids = nn.Parameter(torch.empty(64, 512))
    network.WPCA = nn.Sequential(nn.Conv2d(32768, DIM, kernel_size=1))
    return network


@pytest.fixture(scope="module")
def state() -> dict[str, Tensor]:
    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in _reference().state_dict().items()}
    generator = torch.Generator().manual_seed(5)
    found = {}
    for name, shape in shapes.items():
        scale = 0.1 if len(shape) == 1 else (2.0 / np.prod(shape[1:])) ** 0.5
        scale = 3.0 if name == "pool.conv.weight" else scale
        found[name] = torch.randn(shape, generator=generator) * scale
    return found


@pytest.fixture(scope="module")
def netvlad(
    state: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[NetVlad]:
    folder = tmp_path_factory.mktemp("netvlad")
    torch.save({"num_pcs": DIM, "state_dict": state}, folder / PUBLISHED.file_name)
    descriptor = make_global_descriptor("netvlad", folder)
    assert isinstance(descriptor, NetVlad)
    yield descriptor
    (folder / PUBLISHED.file_name).unlink()


@pytest.fixture
def photo() -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)


def _vlad_by_loops(
    features: np.ndarray[Any, Any], weight: np.ndarray[Any, Any], centroids: np.ndarray[Any, Any]
) -> np.ndarray[Any, Any]:
    sums = np.zeros(centroids.shape)
    for row in range(features.shape[1]):
        for column in range(features.shape[2]):
            x = features[:, row, column] / np.linalg.norm(features[:, row, column])
            exponentials = [np.exp(w @ x) for w in weight]
            for k, each in enumerate(exponentials):
                sums[k] += each / sum(exponentials) * (x - centroids[k])
    rows = [each / np.linalg.norm(each) for each in sums]
    whole = np.concatenate(rows)
    return whole / np.linalg.norm(whole)


def test_vlad_is_the_sum_of_softly_assigned_differences() -> None:
    random = np.random.default_rng(2)
    features, weight, centroids = (
        random.normal(size=shape).astype(np.float32) for shape in ((8, 3, 4), (5, 8), (5, 8))
    )
    found = vlad(*map(torch.tensor, (features[np.newaxis], weight, centroids)))
    np.testing.assert_allclose(found, _vlad_by_loops(features, weight, centroids), atol=1e-6)


def test_published_layout_gives_what_the_definition_gives(
    netvlad: NetVlad, state: dict[str, Tensor], photo: np.ndarray[Any, Any]
) -> None:
    with torch.device("meta"):
        reference = _reference()
    reference.load_state_dict(state, strict=True, assign=True)
    scaled = (photo / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    image = torch.tensor(scaled, dtype=torch.float32).permute(2, 0, 1)[None]
    with torch.no_grad():
        features = reference.encoder(image)[0].numpy()
    assert features.shape == (512, 3, 4)
    assert (features < 0).any()  # before the last ReLU
    raw = _vlad_by_loops(
        features, state["pool.conv.weight"][:, :, 0, 0].numpy(), state["pool.centroids"].numpy()
    )
    expected = state["WPCA.0.weight"][:, :, 0, 0].numpy() @ raw + state["WPCA.0.bias"].numpy()
    found = netvlad.describe(photo, NOTHING, {})
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-4)
    np.testing.assert_array_equal(found, netvlad.describe(photo, NOTHING, {}))


def test_features_have_one_position_for_16_pixels(netvlad: NetVlad) -> None:
    for height, width in ((16, 32), (31, 47), (64, 65)):
        with torch.no_grad():
            features = netvlad.encoder(torch.zeros(1, 3, height, width))
        assert features.shape == (1, 512, height // 16, width // 16)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 3000, 3), (40, 40, 3)])
def test_tiny_and_blank_photos_are_described(netvlad: NetVlad, shape: tuple[int, ...]) -> None:
    found = netvlad.describe(np.zeros(shape, np.uint8), NOTHING, {})
    np.testing.assert_allclose(np.linalg.norm(found), 1, rtol=1e-5)


def test_weights_that_whiten_leave_nothing_to_learn(
    netvlad: NetVlad, photo: np.ndarray[Any, Any]
) -> None:
    assert not netvlad.needs_vocabulary
    assert netvlad.learn_projection(netvlad.pool(photo, NOTHING, {})[np.newaxis]) == {}
    assert netvlad.fingerprint.parameters == {"max_long_side_px": 640}
    assert netvlad.computed_with.startswith("torch ")


@pytest.mark.parametrize("several_gpus", [False, True])
def test_weights_without_whitening_leave_it_to_the_map(
    state: dict[str, Tensor], several_gpus: bool, photo: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    between = "module." if several_gpus else ""
    plain = {
        name.replace("encoder.", f"encoder.{between}").replace("pool.", f"pool.{between}"): tensor
        for name, tensor in state.items()
        if not name.startswith("WPCA")
    }
    content = {
        "epoch": 30,
        "state_dict": plain,
        "recalls": {1: np.float64(0.85)},
        "best_score": np.float64(0.95),
        "optimizer": {"state": {0: {"momentum_buffer": torch.ones(3)}}, "param_groups": []},
        "parallel": several_gpus,
    }
    path = tmp_path / PUBLISHED.file_name
    torch.save(content, path, _use_new_zipfile_serialization=False)
    netvlad = load_netvlad(tmp_path)
    pooled = np.stack([netvlad.pool(np.roll(photo, 17 * i, 1), NOTHING, {}) for i in range(3)])
    assert pooled.shape == (3, 32768)
    np.testing.assert_allclose(np.linalg.norm(pooled, axis=1), 1, rtol=1e-5)
    model = netvlad.learn_projection(pooled)
    found = netvlad.describe(photo, NOTHING, model)
    np.testing.assert_allclose(np.linalg.norm(found), 1, rtol=1e-5)
    assert "whitening_exponent" in netvlad.fingerprint.parameters


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"encoder.28.bias": None}, "encoder.28.bias"),
        ({"encoder.30.weight": torch.ones(1)}, "encoder.30.weight"),
        ({"pool.centroids": torch.ones(32, 512)}, "pool.centroids"),
        ({"pool.conv.bias": torch.ones(64)}, "pool.conv.bias"),
        ({"WPCA.0.weight": torch.ones(5, 4096, 1, 1)}, "WPCA.0"),
        ({"WPCA.0.weight": torch.tensor(1.0)}, "WPCA.0"),
        ({"WPCA.0.weight": None}, "WPCA.0.bias"),
    ],
)
def test_other_tensors_than_the_networks_are_refused_by_name(
    changes: dict[str, Tensor | None], named: str, state: dict[str, Tensor], tmp_path: Path
) -> None:
    hollow = {name: torch.tensor(0.5).expand(tensor.shape) for name, tensor in state.items()}
    for name, tensor in changes.items():
        hollow.pop(name, None)
        if tensor is not None:
            hollow[name] = tensor
    torch.save({"state_dict": hollow}, tmp_path / PUBLISHED.file_name)
    with pytest.raises(WeightsError, match=f"first difference is {named}") as caught:
        load_netvlad(tmp_path)
    assert caught.value.code == "weights.network"


def test_missing_weights_say_where_they_are_published(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="QVPR/Patch-NetVLAD") as caught:
        load_netvlad(tmp_path)
    assert caught.value.code == "weights.missing"
