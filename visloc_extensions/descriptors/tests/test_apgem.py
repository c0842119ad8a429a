"""AP-GeM and the residual network in it, against the definition; no published weights needed."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from visloc.errors import WeightsError
from visloc.features import make_global_descriptor
from visloc.features.weights.checkpoint import sha256_of
from visloc.types import LocalFeatures
from visloc_extensions.descriptors.apgem import PCA_NAME, PUBLISHED, ApGem, load_apgem, whitened
from visloc_extensions.descriptors.network_descriptor import NetworkDescriptor
from visloc_extensions.descriptors.principal_components import PrincipalComponents

NOTHING = LocalFeatures(
    np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32),
    np.zeros((0, 1), np.float32),
)  # fmt: skip


class Bottleneck(nn.Module):
    """The block of He et al., figure 5 right, with torchvision's names; stride in the 3 x 3."""

    def __init__(self, inputs: int, width: int, stride: int, projects: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = None
        if projects:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, 4 * width, 1, stride=stride, bias=False),
                nn.BatchNorm2d(4 * width),
            )

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return torch.relu(y + (x if self.downsample is None else self.downsample(x)))


class Reference(nn.Module):
    """ResNet-101, mean of powers, fully connected: as the paper has it, nothing folded."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        inputs = 64
        for stage, blocks in enumerate((3, 4, 23, 3)):
            width = 64 * 2**stage
            layers = []
            for number in range(blocks):
                stride = 2 if stage and not number else 1
                layers.append(Bottleneck(inputs, width, stride, projects=number == 0))
                inputs = 4 * width
            self.add_module(f"layer{stage + 1}", nn.Sequential(*layers))
        self.adpool = nn.ParameterDict({"p": nn.Parameter(torch.tensor([2.7]))})
        self.fc = nn.Linear(2048, 2048)

    def features(self, image: Tensor) -> Tensor:
        x = torch.relu(self.bn1(self.conv1(image)))
        x = nn.functional.max_pool2d(x, 3, stride=2, padding=1)
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
        return x

    def forward(self, image: Tensor) -> Tensor:
        p = self.adpool["p"]
        powers = self.features(image).clamp(min=1e-6) ** p
        vector = self.fc(powers.mean(dim=(2, 3)) ** (1 / p))[0]
        return vector / vector.norm()


class PCA:
    def __init__(self) -> None:
        random = np.random.default_rng(3)
        self.whiten = True
        self.mean_ = random.normal(scale=0.01, size=2048).astype(np.float32)
        self.components_ = random.normal(size=(2048, 2048)).astype(np.float32)
        self.explained_variance_ = np.geomspace(1, 1e-4, 2048).astype(np.float32)


def _seeded(network: Reference, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if name.endswith("bn3.weight"):  # small, or 33 sums of blocks add up to anything
                tensor.uniform_(0.1, 0.3, generator=generator)
            elif name.endswith(("running_var", "bn1.weight", "bn2.weight", "downsample.1.weight")):
                tensor.uniform_(0.5, 1.5, generator=generator)
            elif name.endswith(("bias", "running_mean")):
                tensor.normal_(0, 0.1, generator=generator)
            elif tensor.ndim > 1:
                scale = (2.0 / tensor[0].numel()) ** 0.5
                tensor.normal_(0, scale, generator=generator)
        network.adpool["p"].fill_(2.7)
    network.eval()


@pytest.fixture(scope="module")
def reference() -> Reference:
    with torch.device("meta"):  # without initial values, which would take seconds
        network = Reference()
    network = network.to_empty(device="cpu")
    _seeded(network, 11)
    return network


@pytest.fixture(scope="module")
def weights_dir(reference: Reference, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a folder with a file of the published layout: several GPUs, options, a PCA."""
    folder = tmp_path_factory.mktemp("apgem")
    module = "sklearn.decomposition.pca"
    with pytest.MonkeyPatch.context() as patch:
        for name in ("sklearn", "sklearn.decomposition", module):
            patch.setitem(sys.modules, name, types.ModuleType(name))
        vars(sys.modules[module])["PCA"] = PCA
        patch.setattr(PCA, "__module__", module)
        content = {
            "state_dict": {f"module.{k}": v for k, v in reference.state_dict().items()},
            "model_options": {"arch": "resnet101_rmac", "out_dim": 2048, "gemp": 3},
            "current_iter": 296,
            "pca": {PCA_NAME: PCA()},
        }
        torch.save(content, folder / PUBLISHED.file_name)
    yield folder
    (folder / PUBLISHED.file_name).unlink()


@pytest.fixture(scope="module")
def apgem(weights_dir: Path) -> ApGem:
    descriptor = make_global_descriptor("apgem", weights_dir)
    assert isinstance(descriptor, ApGem)
    return descriptor


@pytest.fixture
def photo() -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).integers(0, 256, (70, 101, 3), dtype=np.uint8)


def _as_input(photo: np.ndarray[Any, Any]) -> Tensor:
    scaled = (photo / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    return torch.tensor(scaled, dtype=torch.float32).permute(2, 0, 1)[None]


def test_published_layout_gives_what_the_definition_gives(
    apgem: ApGem, reference: Reference, photo: np.ndarray[Any, Any]
) -> None:
    with torch.no_grad():
        expected = reference(_as_input(photo)).numpy()
    pca = PCA()
    y = pca.components_.astype(np.float64) @ (expected.astype(np.float64) - pca.mean_)
    y /= pca.explained_variance_.astype(np.float64) ** 0.25
    found = apgem.describe(photo, NOTHING, {})
    np.testing.assert_allclose(found, y / np.linalg.norm(y), atol=2e-4)
    assert found.shape == (2048,)
    assert found.dtype == np.float32


def test_features_have_one_position_for_32_pixels(apgem: ApGem, reference: Reference) -> None:
    for height, width in ((64, 96), (65, 97), (1, 1), (31, 33)):
        image = torch.randn(1, 3, height, width, generator=torch.Generator().manual_seed(1))
        with torch.no_grad():
            found, expected = apgem.network(image), reference.features(image)
        assert found.shape == (1, 2048, -(-height // 32), -(-width // 32))
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-3)


def test_the_vector_is_of_unit_length_and_the_same_each_time(
    apgem: ApGem, photo: np.ndarray[Any, Any]
) -> None:
    first = apgem.describe(photo, NOTHING, {})
    np.testing.assert_allclose(np.linalg.norm(first), 1, rtol=1e-5)
    np.testing.assert_array_equal(first, apgem.describe(photo, NOTHING, {}))
    turned = apgem.describe(np.rot90(photo), NOTHING, {})
    np.testing.assert_allclose(np.linalg.norm(turned), 1, rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 3000, 3), (40, 40, 3)])
def test_tiny_and_blank_photos_are_described(apgem: ApGem, shape: tuple[int, ...]) -> None:
    found = apgem.describe(np.zeros(shape, np.uint8), NOTHING, {})
    assert found.shape == (2048,)
    assert np.isfinite(found).all()


def test_it_learns_nothing_on_the_map(apgem: ApGem, photo: np.ndarray[Any, Any]) -> None:
    assert apgem.needs_image
    assert not apgem.needs_vocabulary
    assert not apgem.needs_local_features
    pooled = apgem.pool(photo, NOTHING, {})
    assert apgem.learn_projection(pooled[np.newaxis]) == {}
    np.testing.assert_allclose(apgem.project(pooled, {}), pooled, atol=1e-6)
    np.testing.assert_array_equal(apgem.project(np.zeros(2048, np.float32), {}), 0)
    assert apgem.computed_with.startswith("torch ")


def test_fingerprint_holds_what_shapes_the_vector(apgem: ApGem, weights_dir: Path) -> None:
    fingerprint = apgem.fingerprint
    assert fingerprint.name == "apgem"
    assert fingerprint.parameters == {
        "max_long_side_px": 1024,
        "pca": "Landmarks_clean",
        "pca_whitening_power": 0.25,
    }
    assert fingerprint.weights_sha256 == sha256_of(weights_dir / PUBLISHED.file_name)


def _hollow(tmp_path: Path, **changes: Tensor | None) -> Path:
    """Write a file of the layout whose tensors are all the same one number: a few kilobytes."""
    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in Reference().state_dict().items()}
    state = {name: torch.tensor(0.5).expand(shape) for name, shape in shapes.items()}
    for name, tensor in changes.items():
        state.pop(name.replace("__", "."), None)
        if tensor is not None:
            state[name.replace("__", ".")] = tensor
    torch.save({"state_dict": state}, tmp_path / PUBLISHED.file_name)
    return tmp_path


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"fc__bias": None}, "fc.bias"),
        ({"adpool__p": None}, "adpool.p"),
        ({"layer3__22__conv2__weight": None}, "layer3.22.conv2.weight"),
        ({"layer3__23__conv1__weight": torch.ones(2)}, "layer3.23.conv1.weight"),
        ({"bn1__running_mean": torch.ones(3)}, "bn1.running_mean"),
        ({"fc__weight": torch.ones(2048)}, "fc.weight"),
    ],
)
def test_other_tensors_than_the_networks_are_refused_by_name(
    changes: dict[str, Tensor | None], named: str, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=f"first difference is {named}") as caught:
        load_apgem(_hollow(tmp_path, **changes))
    assert caught.value.code == "weights.network"


@pytest.mark.parametrize("exponent", [0.0, -3.0, 1e6])
def test_an_exponent_that_no_mean_has_is_refused(exponent: float, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"adpool\.p") as caught:
        load_apgem(_hollow(tmp_path, adpool__p=torch.tensor([exponent])))
    assert caught.value.code == "weights.values"


def test_missing_weights_say_where_they_are_published(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="naver/deep-image-retrieval") as caught:
        load_apgem(tmp_path)
    assert caught.value.code == "weights.missing"
    assert PUBLISHED.file_name in str(caught.value)


def test_without_a_pca_whitening_is_learned_on_the_map(tmp_path: Path) -> None:
    apgem = load_apgem(_hollow(tmp_path))
    assert isinstance(apgem, NetworkDescriptor)
    assert not apgem.whitened
    pooled = np.random.default_rng(0).normal(size=(4, 2048)).astype(np.float32)
    model = apgem.learn_projection(pooled)
    assert set(model) == {"mean", "axes"}
    assert apgem.project(pooled, model).shape == (4, 3)
    assert apgem.fingerprint.parameters["whitening_exponent"] == 0.25


@pytest.mark.parametrize("name", ["Landmarks_clean", "Another"])
def test_whitening_of_another_kind_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "sklearn.decomposition._pca"
    for each in ("sklearn", "sklearn.decomposition", module):
        monkeypatch.setitem(sys.modules, each, types.ModuleType(each))
    vars(sys.modules[module])["PCA"] = PCA
    monkeypatch.setattr(PCA, "__module__", module)
    pca = PCA()
    pca.mean_ = pca.mean_[:5]
    pca.components_ = pca.components_[:5, :5]
    pca.explained_variance_ = pca.explained_variance_[:5]
    path = _hollow(tmp_path) / PUBLISHED.file_name
    content = torch.load(path, weights_only=True) | {"pca": {name: pca}}
    torch.save(content, path)
    with pytest.raises(WeightsError, match="5" if name == PCA_NAME else "Another") as caught:
        load_apgem(tmp_path)
    assert caught.value.code == "weights.network"


def test_whitening_is_exact() -> None:
    mean, components = np.array([1.0, 0.0]), np.array([[0.6, 0.8], [-0.8, 0.6]])
    pca = PrincipalComponents(mean, components, np.array([16.0, 1.0]), whiten=True)
    # (2, 3) - mean = (1, 3): 0.6 + 2.4 = 3 over 16^0.25 = 2, and -0.8 + 1.8 = 1 over 1
    expected = np.array([1.5, 1.0]) / np.hypot(1.5, 1.0)
    vector = np.array([2.0, 3.0], np.float32)
    np.testing.assert_allclose(whitened(vector, pca), expected, rtol=1e-6)
    plain = PrincipalComponents(mean, components, np.array([16.0, 1.0]), whiten=False)
    np.testing.assert_allclose(
        whitened(vector, plain), np.array([3.0, 1.0]) / np.sqrt(10), rtol=1e-6
    )
    np.testing.assert_array_equal(whitened(mean.astype(np.float32), pca), 0)
