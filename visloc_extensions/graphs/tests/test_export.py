from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from visloc.errors import InvalidInput
from visloc.features.backends import graphs
from visloc.features.backends.openvino import ROUNDING
from visloc.features.networks.r2d2.architecture import R2D2
from visloc.features.networks.r2d2.extractor import R2D2Extractor
from visloc.features.networks.r2d2.load import load_r2d2
from visloc.features.networks.r2d2.model import R2D2Network, pack
from visloc.options import Inference
from visloc_extensions.graphs.export import export_graph, pictures


@pytest.fixture(scope="module")
def weights_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small R2D2 of random weights, and its graph."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(5)
    arrays = pack(R2D2Network(R2D2, base_width=4).fuse())
    (folder / "r2d2.safetensors").write_bytes(save(dict(arrays)))
    export_graph("r2d2", folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("size", [(8, 8), (9, 12), (63, 101)])
def test_exported_graph_computes_what_torch_does(size: tuple[int, int], weights_dir: Path) -> None:
    image = np.random.default_rng(0).uniform(0, 255, (*size, 3)).astype(np.float32)
    ways = [load_r2d2(weights_dir, way, 1) for way in (Inference.TORCH, Inference.FP32)]
    assert ways[0].fingerprint == ways[1].fingerprint
    assert [way.computed_with.split()[0] for way in ways] == ["torch", "openvino"]
    seen = []
    for way in ways:
        assert isinstance(way, R2D2Extractor)
        with way.network.look(image) as look:
            y, x = np.indices(size).reshape(2, -1)
            seen.append((look.logits.copy(), look.descriptors(x, y)))
    for expected, ours in zip(*seen, strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=2e-3)


@pytest.mark.slow
def test_all_convolutions_but_the_first_round_input_and_weights(weights_dir: Path) -> None:
    (path,) = weights_dir.glob("r2d2-*.xml")
    model, _ = graphs._read(path, None)
    kinds = [each.get_type_name() for each in model.get_ops()]
    assert kinds.count("Convolution") == 9
    assert kinds.count(ROUNDING) == 2 * 8
    assert sorted(each.name for each in weights_dir.iterdir()) == [
        f"{path.stem}.bin",
        path.name,
        "r2d2.safetensors",
    ]


@pytest.mark.slow
def test_converter_reports_to_nobody() -> None:
    code = (
        "import sys; from visloc_extensions.graphs.export import _converter; _converter(); "
        "sys.exit('openvino_telemetry' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_features_without_a_network_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="sift") as caught:
        export_graph("sift", tmp_path)
    assert caught.value.code == "features.unknown"


def test_pictures_have_one_size_and_something_to_see() -> None:
    for picture in pictures():
        assert picture.shape == (240, 320, 3)
        assert picture.std() > 10
