"""DELG's global descriptor against its definition; no published weights needed."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from visloc.errors import WeightsError
from visloc.features import make_global_descriptor
from visloc.types import LocalFeatures
from visloc_extensions.descriptors.delg import LAYOUT, PUBLISHED, Delg, load_delg
from visloc_extensions.descriptors.resnet import expected_shapes

NOTHING = LocalFeatures(
    np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32),
    np.zeros((0, 1), np.float32),
)  # fmt: skip
DIM = 32


class Transform(nn.Module):
    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.a, self.a_bn = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.b = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.b_bn = nn.BatchNorm2d(width)
        self.c, self.c_bn = nn.Conv2d(width, 4 * width, 1, bias=False), nn.BatchNorm2d(4 * width)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.a_bn(self.a(x)))
        return self.c_bn(self.c(torch.relu(self.b_bn(self.b(x)))))


class Block(nn.Module):
    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.projects = inputs != 4 * width
        if self.projects:
            self.proj = nn.Conv2d(inputs, 4 * width, 1, stride=stride, bias=False)
            self.bn = nn.BatchNorm2d(4 * width)
        self.f = Transform(inputs, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu((self.bn(self.proj(x)) if self.projects else x) + self.f(x))


class Reference(nn.Module):
    """ResNet-50 and the head, nothing folded, with the names of the PyTorch implementation."""

    def __init__(self) -> None:
        super().__init__()
        model = self.globalmodel = nn.Module()
        model.stem = nn.Module()
        model.stem.conv = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        model.stem.bn = nn.BatchNorm2d(64)
        inputs = 64
        for stage, blocks in enumerate((3, 4, 6, 3)):
            layers = nn.Module()
            for number in range(blocks):
                stride = 2 if stage and not number else 1
                layers.add_module(f"b{number + 1}", Block(inputs, 64 * 2**stage, stride))
                inputs = 256 * 2**stage
            model.add_module(f"s{stage + 1}", layers)
        model.head = nn.Module()
        model.head.pool = nn.Module()
        model.head.pool.p = nn.Parameter(torch.empty(1))
        model.head.fc = nn.Linear(2048, DIM)

    def forward(self, image: Tensor) -> Tensor:
        model = self.globalmodel
        x = torch.relu(model.stem.bn(model.stem.conv(image)))
        x = nn.functional.max_pool2d(x, 3, stride=2, padding=1)
        for stage in (model.s1, model.s2, model.s3, model.s4):
            for block in stage.children():
                x = block(x)
        p = model.head.pool.p
        vector = model.head.fc((x.clamp(min=1e-6) ** p).mean(dim=(2, 3)) ** (1 / p))[0]
        return vector / vector.norm()


@pytest.fixture(scope="module")
def reference() -> Reference:
    with torch.device("meta"):  # without initial values, which would take seconds
        network = Reference()
    network = network.to_empty(device="cpu").eval()
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if name.endswith("c_bn.weight"):  # small, or 16 sums of blocks add up to anything
                tensor.uniform_(0.1, 0.3, generator=generator)
            elif name.endswith("running_var") or (tensor.ndim == 1 and name.endswith("weight")):
                tensor.uniform_(0.5, 1.5, generator=generator)
            elif name.endswith(("bias", "running_mean")):
                tensor.normal_(0, 0.1, generator=generator)
            elif tensor.ndim > 1:
                tensor.normal_(0, sqrt(2.0 / tensor[0].numel()), generator=generator)
        network.globalmodel.head.pool.p.fill_(3.0)
    return network


@pytest.fixture(scope="module")
def delg(reference: Reference, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Delg]:
    folder = tmp_path_factory.mktemp("delg")
    state = {
        **reference.state_dict(),
        "desc_cls.weight": torch.ones(7, DIM),
        "desc_cls.t": torch.zeros(1),
        "localmodel.conv1.weight": torch.ones(512, 1024, 1, 1),
        "att_cls.fc.bias": torch.zeros(7),
    }
    content = {"epoch": 99, "model_state": state, "optimizer_state": {}, "cfg": "DEPTH: 50\n"}
    torch.save(content, folder / PUBLISHED.file_name)
    descriptor = make_global_descriptor("delg", folder)
    assert isinstance(descriptor, Delg)
    yield descriptor
    (folder / PUBLISHED.file_name).unlink()


@pytest.fixture
def photo() -> np.ndarray[Any, Any]:
    noise = np.random.default_rng(0).integers(0, 256, (9, 13, 3), dtype=np.uint8)
    return cv2.resize(noise, (96, 64), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def test_published_layout_gives_what_the_definition_gives(
    delg: Delg, reference: Reference, photo: np.ndarray[Any, Any]
) -> None:
    total = np.zeros(DIM)
    for width, height, method in (
        (68, 45, cv2.INTER_AREA),
        (96, 64, cv2.INTER_LINEAR),
        (136, 91, cv2.INTER_LINEAR),
    ):
        blue_green_red = cv2.resize(photo, (width, height), interpolation=method)[:, :, ::-1]
        scaled = (blue_green_red / 255.0 - [0.406, 0.456, 0.485]) / [0.225, 0.224, 0.229]
        with torch.no_grad():
            image = torch.tensor(scaled, dtype=torch.float32).permute(2, 0, 1)[None]
            total += reference(image).numpy()
    found = delg.describe(photo, NOTHING, {})
    np.testing.assert_allclose(found, total / np.linalg.norm(total), atol=1e-4)
    np.testing.assert_array_equal(found, delg.describe(photo, NOTHING, {}))


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 3000, 3), (40, 40, 3)])
def test_tiny_and_blank_photos_are_described(delg: Delg, shape: tuple[int, ...]) -> None:
    found = delg.describe(np.zeros(shape, np.uint8), NOTHING, {})
    np.testing.assert_allclose(np.linalg.norm(found), 1, rtol=1e-5)


def test_it_learns_nothing_on_the_map(delg: Delg) -> None:
    assert delg.learn_projection(np.ones((2, DIM), np.float32)) == {}
    assert not delg.needs_vocabulary
    assert delg.fingerprint.parameters == {
        "depth": 50,
        "max_long_side_px": 1024,
        "scales": "0.7071,1.0000,1.4142",
    }


def _hollow(folder: Path, depth: int, **changes: Tensor | None) -> Path:
    """Write a file of the layout whose tensors are all the same one number: a few kilobytes."""
    head = {"pool.p": (1,), "fc.weight": (2048, 2048), "fc.bias": (2048,)}
    shapes = expected_shapes(depth, LAYOUT)
    shapes |= {f"globalmodel.head.{name}": shape for name, shape in head.items()}
    state = {name: torch.tensor(0.5).expand(shape) for name, shape in shapes.items()}
    for name, tensor in changes.items():
        full = "globalmodel." + name.replace("__", ".")
        state.pop(full, None)
        if tensor is not None:
            state[full] = tensor
    torch.save(state, folder / PUBLISHED.file_name)
    return folder


def test_101_layers_are_told_by_the_tensors(tmp_path: Path) -> None:
    delg = load_delg(_hollow(tmp_path, 101))
    assert delg.fingerprint.parameters["depth"] == 101


@pytest.mark.parametrize("depth", [50, 101])
@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"head__fc__bias": None}, "globalmodel.head.fc.bias"),
        ({"head__fc__weight": torch.ones(512)}, "globalmodel.head.fc"),
        ({"head__fc__weight": torch.tensor(1.0)}, "globalmodel.head.fc"),
        ({"s3__b6__f__b__weight": None}, "globalmodel.s3.b6.f.b.weight"),
        ({"s3__b24__f__a__weight": torch.ones(1)}, "globalmodel.s3.b"),
        ({"stem__bn__bias": torch.ones(3)}, "globalmodel.stem.bn.bias"),
    ],
)
def test_other_tensors_than_the_networks_are_refused_by_name(
    changes: dict[str, Tensor | None], named: str, depth: int, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=f"first difference is {named}") as caught:
        load_delg(_hollow(tmp_path, depth, **changes))
    assert caught.value.code == "weights.network"


def test_missing_weights_say_where_they_are_published(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="feymanpriv/DELG") as caught:
        load_delg(tmp_path)
    assert caught.value.code == "weights.missing"
