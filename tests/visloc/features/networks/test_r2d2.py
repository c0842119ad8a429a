from __future__ import annotations

import json
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save
from torch import Tensor

from visloc.errors import WeightsError
from visloc.features.networks.r2d2.architecture import ARCHITECTURES
from visloc.features.networks.r2d2.extractor import (
    PATCH_PX,
    R2D2Extractor,
    Seen,
    _log_odds_of_repeatability,
    pyramid,
    pyramid_sizes,
)
from visloc.features.networks.r2d2.load import load_faster2d2, load_r2d2, weights_path
from visloc.features.networks.r2d2.model import R2D2Network, pack, read_network
from visloc.features.weights import files as weights
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.options import Extraction, Inference
from visloc.types import LocalFeatures

# The published networks, written down a second time: number of the convolution in the state
# dict, kernel, dilation, outputs as a multiple of the first layer's, batch norm, ReLU.
TABLES = {
    "r2d2": (
        (0, 3, 1, 1, True, True),
        (3, 3, 1, 1, True, True),
        (6, 3, 1, 2, True, True),
        (9, 3, 2, 2, True, True),
        (12, 3, 2, 4, True, True),
        (15, 3, 4, 4, True, True),
        (18, 2, 4, 4, True, False),
        (20, 2, 8, 4, True, False),
        (22, 2, 16, None, False, False),
    ),
    "faster2d2": (
        (0, 3, 1, 1, True, True),
        (3, 3, 1, 1, True, True),
        (6, 3, 1, 2, True, True),
        (10, 3, 1, 2, True, True),
        (13, 3, 1, 4, True, True),
        (16, 3, 2, 4, True, True),
        (19, 2, 2, 4, True, False),
        (21, 2, 4, 4, True, False),
        (23, 2, 8, None, False, False),
    ),
}
LOADERS = {"r2d2": load_r2d2, "faster2d2": load_faster2d2}
FILE_NAMES = {"r2d2": "r2d2_WASF_N16.pt", "faster2d2": "faster2d2_WASF_N16.pt"}
BOTH = pytest.mark.parametrize("name", ["r2d2", "faster2d2"])


def _random_state(name: str, *, base_width: int = 8, prefix: str = "") -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    state: dict[str, Tensor] = {}
    inputs = 3
    for number, kernel, _, width, normalized, _ in TABLES[name]:
        outputs = width * base_width if width else 128
        shape = (outputs, inputs, kernel, kernel)
        spread = (2 / (inputs * kernel**2)) ** 0.5
        state[f"ops.{number}.weight"] = torch.randn(shape, generator=generator) * spread
        state[f"ops.{number}.bias"] = torch.randn(outputs, generator=generator)
        if normalized:
            norm = f"ops.{number + 1}"
            state[f"{norm}.running_mean"] = torch.randn(outputs, generator=generator)
            state[f"{norm}.running_var"] = torch.rand(outputs, generator=generator) + 0.5
            state[f"{norm}.num_batches_tracked"] = torch.tensor(7)
        inputs = outputs
    for head, num_logits in (("clf", 2), ("sal", 1)):
        state[f"{head}.weight"] = torch.randn((num_logits, 128, 1, 1), generator=generator) / 100
        state[f"{head}.bias"] = torch.randn(num_logits, generator=generator)
    return {prefix + key: value for key, value in state.items()}


def _save(folder: Path, name: str, state: dict[str, Tensor]) -> Path:
    path = folder / FILE_NAMES[name]
    torch.save({"net": "untold", "state_dict": state}, path)
    return path


def _network(folder: Path, name: str) -> R2D2Network:
    """Read the network with random weights."""
    _save(folder, name, _random_state(name))
    return read_network(ARCHITECTURES[name], folder / FILE_NAMES[name])[0]


def _reference(name: str, state: dict[str, Tensor], image: Tensor) -> tuple[Tensor, ...]:
    """Evaluate the network layer by layer, nothing folded: x, clf and sal logits, descriptors."""
    x = image
    for number, kernel, dilation, _, normalized, relu in TABLES[name]:
        x = F.conv2d(
            x,
            state[f"ops.{number}.weight"],
            state[f"ops.{number}.bias"],
            dilation=dilation,
            padding=dilation if kernel == 3 else dilation // 2,
        )
        if normalized:
            norm = f"ops.{number + 1}"
            x = F.batch_norm(x, state[f"{norm}.running_mean"], state[f"{norm}.running_var"])
        if relu:
            x = x.relu()
        if name == "faster2d2" and number == 6:
            x = F.max_pool2d(x, 2, 2)
    if name == "faster2d2":
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
    clf = F.conv2d(x**2, state["clf.weight"], state["clf.bias"])
    sal = F.conv2d(x**2, state["sal.weight"], state["sal.bias"])
    return x, clf, sal, F.normalize(x, dim=1)


@BOTH
def test_folded_strip_wise_network_equals_the_plain_one(name: str, tmp_path: Path) -> None:
    state = _random_state(name)
    network = _network(tmp_path, name)
    image = torch.randn((1, 3, 151, 90), generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        _, clf, sal, descriptors = _reference(name, state, image)
        features = network.features(image)
        logits = network.logits(features)
        height, width = (151, 90) if name == "r2d2" else (150, 90)
        assert logits.shape == (2, height, width)
        torch.testing.assert_close(logits[0], clf[0, 1] - clf[0, 0], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(logits[1], sal[0, 0], rtol=1e-4, atol=1e-4)
        reliability = torch.sigmoid(logits[0])
        torch.testing.assert_close(reliability, clf[0].softmax(dim=0)[1], rtol=1e-4, atol=1e-4)
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        rows = network.descriptors(features, x.flatten(), y.flatten())
        expected = descriptors[0].flatten(1).T
        torch.testing.assert_close(rows, expected, rtol=1e-4, atol=1e-4)


@BOTH
@pytest.mark.parametrize("base_width", [8, 48])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_own_trained_weights_of_another_width_load(
    name: str, base_width: int, prefix: str, tmp_path: Path
) -> None:
    path = _save(tmp_path, name, _random_state(name, base_width=base_width, prefix=prefix))
    extractor = LOADERS[name](tmp_path)
    assert extractor.fingerprint.name == name
    assert extractor.fingerprint.weights_sha256 == read_checkpoint(path).sha256
    assert extractor.descriptor_dim == 128


@BOTH
def test_weights_of_the_other_network_are_refused_by_name(name: str, tmp_path: Path) -> None:
    other = "faster2d2" if name == "r2d2" else "r2d2"
    _save(tmp_path, name, _random_state(other))
    wanted, held = ("R2D2", "Fast-R2D2") if name == "r2d2" else ("Fast-R2D2", "R2D2")
    with pytest.raises(WeightsError, match=f"weights of {held}, not of {wanted};") as caught:
        LOADERS[name](tmp_path)
    assert caught.value.code == "weights.network"
    assert FILE_NAMES[name] in str(caught.value)


@BOTH
def test_published_weights_of_the_other_network_are_refused_by_name(
    name: str, shared_weights: Path, tmp_path: Path
) -> None:
    other = "faster2d2" if name == "r2d2" else "r2d2"
    (tmp_path / FILE_NAMES[name]).symlink_to(shared_weights / FILE_NAMES[other])
    with pytest.raises(WeightsError, match="these are weights of"):
        LOADERS[name](tmp_path)


def test_weights_of_another_kind_of_network_are_refused(
    shared_weights: Path, tmp_path: Path
) -> None:
    (tmp_path / FILE_NAMES["r2d2"]).symlink_to(shared_weights / "aliked-n16.pth")
    with pytest.raises(WeightsError, match="weights of another network"):
        load_r2d2(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.pop("ops.12.bias"),
        lambda state: state.update({"ops.12.weight": torch.ones(32, 16, 5, 5)}),
        lambda state: state.update({"extra": torch.ones(1)}),
        lambda state: state.update({"ops.0.weight": torch.tensor(1.0)}),
        lambda state: state.update({"clf.bias": torch.tensor([0.0, float("nan")])}),
    ],
)
def test_weights_that_do_not_fit_exactly_are_refused(change: object, tmp_path: Path) -> None:
    state = _random_state("r2d2")
    assert callable(change)
    change(state)
    _save(tmp_path, "r2d2", state)
    with pytest.raises(WeightsError):
        load_r2d2(tmp_path)


def test_missing_weights_are_asked_for(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="CC BY-NC-SA"):
        load_r2d2(tmp_path)


def test_pyramid_of_a_vga_photo_is_the_published_one() -> None:
    sizes = [size for _, size, is_used in pyramid_sizes(480, 640) if is_used]
    assert sizes == [(480, 640), (404, 538), (339, 453), (285, 381), (240, 320), (202, 269)]


def test_large_photos_are_looked_at_from_1024_px_downwards() -> None:
    levels = list(pyramid_sizes(820, 1280))
    assert [is_used for _, _, is_used in levels[:3]] == [False, False, True]
    assert levels[2][1][1] == 905
    assert levels[-1][1][1] >= 256


@pytest.mark.parametrize("long_side", [1, 100, 255])
def test_photos_below_256_px_are_looked_at_once_at_their_own_size(long_side: int) -> None:
    assert list(pyramid_sizes(1, long_side)) == [(1.0, (1, long_side), True)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("r2d2", [1701, 1223, 888, 667, 482, 368]),
        ("faster2d2", [1727, 1254, 883, 632, 456, 322]),
    ],
)
def test_published_weights_find_the_published_number_of_keypoints(
    name: str, published: list[int], shared_weights: Path, shared_data: Path
) -> None:
    path = next((shared_data / "redkitchen" / "query").rglob("frame-000110.color.jpg"))
    rgb = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert rgb is not None
    extractor = LOADERS[name](shared_weights)
    features = extractor.extract(rgb.astype(np.uint8), max_keypoints=20_000)
    patch_sizes, counts = np.unique(features.scales, return_counts=True)
    np.testing.assert_allclose(patch_sizes, 32 * 2 ** (np.arange(6) / 4), rtol=1e-5)
    np.testing.assert_allclose(counts, published, rtol=0.01)
    assert len(features) == pytest.approx(sum(published), rel=0.01)
    assert features.scores.min() >= 0.49
    assert features.scores.max() < 1.0


class _BrightnessNetwork:
    """Finds keypoints at the brightest pixels, in place of a trained network."""

    computed_with = "brightness"

    def look(self, image: NDArray[np.float32]) -> AbstractContextManager[Seen]:
        brightness = (image / 255).mean(axis=2)
        logits = np.stack([np.full_like(brightness, 5.0), 9 * brightness - 4])
        unit = np.float32(128**-0.5)
        return nullcontext(Seen(logits, lambda x, _: np.full((len(x), 128), unit)))


def test_keypoints_of_all_scales_lie_where_the_photo_has_them(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    height, width = 479, 641
    grid = np.stack(np.meshgrid(np.arange(30, 620, 40), np.arange(30, 460, 40)), axis=-1)
    centers = grid.reshape(-1, 2) + generator.uniform(-4, 4, (grid.size // 2, 2))
    rows, columns = np.mgrid[:height, :width] + 0.5  # the centre of the first pixel is (.5, .5)
    squared = np.full((height, width), np.inf)
    for x, y in centers:
        squared = np.minimum(squared, (columns - x) ** 2 + (rows - y) ** 2)
    rgb = np.repeat((255 * np.exp(-squared / 50)).astype(np.uint8)[:, :, None], 3, axis=2)

    _save(tmp_path, "r2d2", _random_state("r2d2"))
    extractor = load_r2d2(tmp_path)
    assert isinstance(extractor, R2D2Extractor)
    extractor.network = _BrightnessNetwork()
    features = extractor.extract(rgb, max_keypoints=100_000)

    offsets = features.keypoints[:, None] - centers[None]
    nearest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
    errors = offsets[np.arange(len(offsets)), nearest]
    for level in range(6):
        patch_px = 32 * 2 ** (level / 4)
        of_level = np.isclose(features.scales, patch_px)
        assert len(set(nearest[of_level])) == len(centers)
        pixel = patch_px / 32
        assert np.abs(errors[of_level]).max() < 0.15 * pixel
        # Whole pixels would be 0.41 px off.
        assert np.sqrt((errors[of_level] ** 2).sum(axis=1).mean()) < 0.04 * pixel
        # The reference's mapping x * W / w would be (pixel - 1) / 2 px off: 0.69 at the last.
        assert np.abs(errors[of_level].mean(axis=0)).max() < 0.01 * pixel


def test_log_odds_are_those_of_the_published_repeatability() -> None:
    logits = np.array([-30.0, -2.0, 0.0, 3.0, 646.0])
    softplus = np.log1p(np.exp(-np.abs(logits))) + np.maximum(logits, 0)
    p = softplus / (1 + softplus)
    found = _log_odds_of_repeatability(logits.astype(np.float32))
    np.testing.assert_allclose(found, np.log(p / (1 - p)), rtol=1e-5)
    assert np.isfinite(_log_odds_of_repeatability(np.float32([-1e30, 1e30]))).all()


def _picture(height: int, width: int) -> NDArray[np.uint8]:
    generator = np.random.default_rng(0)
    coarse = generator.uniform(0, 255, (height // 4 + 2, width // 4 + 2, 3)).astype(np.float32)
    large = cv2.resize(coarse, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    return np.clip(large[:height, :width], 0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(8, 8), (9, 8), (63, 101)])
def test_shipped_graph_computes_what_torch_does(size: tuple[int, int]) -> None:
    image = _picture(*size).astype(np.float32)
    by_torch, by_openvino = (
        load_faster2d2(None, way, 1) for way in (Inference.TORCH, Inference.FP32)
    )
    assert by_torch.fingerprint == by_openvino.fingerprint
    assert isinstance(by_torch, R2D2Extractor)
    assert isinstance(by_openvino, R2D2Extractor)
    looks = by_torch.network.look(image), by_openvino.network.look(image)
    with looks[0] as expected, looks[1] as ours:
        assert ours.logits.shape == expected.logits.shape
        np.testing.assert_allclose(ours.logits, expected.logits, rtol=1e-3, atol=2e-3)
        y, x = np.indices(ours.logits.shape[1:]).reshape(2, -1)
        difference = ours.descriptors(x, y) - expected.descriptors(x, y)
    assert np.abs(difference).max() < 1e-4


@pytest.mark.usefixtures("eight_bits")
def test_8_bits_find_nearly_the_same_features_and_twice_the_same(shared_data: Path) -> None:
    path = next((shared_data / "redkitchen" / "query").rglob("frame-000110.color.jpg"))
    rgb = np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB), np.uint8)

    def found(inference: Inference, threads: int) -> LocalFeatures:
        extractor = load_faster2d2(None, inference, threads)
        assert (", int8, graph " in extractor.computed_with) == (inference is Inference.INT8)
        return extractor.extract(rgb, max_keypoints=5000, extraction=Extraction.FAST)

    exact, rounded = found(Inference.FP32, 1), found(Inference.INT8, 1)
    np.testing.assert_array_equal(found(Inference.INT8, 2).descriptors, rounded.descriptors)
    assert len(rounded) == pytest.approx(len(exact), rel=0.03)
    offsets = np.linalg.norm(rounded.keypoints[:, None] - exact.keypoints[None], axis=2)
    nearest = offsets.argmin(axis=0)
    same = offsets.min(axis=0) < 0.1
    assert same.mean() > 0.65
    assert (offsets.min(axis=0) < 0.5).mean() > 0.9
    assert (offsets.min(axis=0) < 2).mean() > 0.95
    cosines = (rounded.descriptors[nearest][same] * exact.descriptors[same]).sum(axis=1)
    assert np.median(cosines) > 0.998
    assert np.percentile(cosines, 1) > 0.97


@pytest.mark.parametrize("size", [(480, 640), (479, 641), (301, 1500)])
def test_pyramid_is_the_one_of_the_published_extraction(size: tuple[int, int]) -> None:
    rgb = _picture(*size)
    image = torch.tensor(rgb).permute(2, 0, 1)[None].float()
    expected = {}
    for scale, level_size, _ in pyramid_sizes(*size):
        image = F.interpolate(image, level_size, mode="bilinear", align_corners=False)
        expected[scale] = image[0].permute(1, 2, 0).numpy()
    levels = list(pyramid(rgb, Extraction.ACCURATE))
    assert len(levels) >= 6
    for scale, level in levels:
        np.testing.assert_allclose(level, expected[scale], atol=0.03)  # of 255


@pytest.mark.parametrize("extraction", Extraction)
@pytest.mark.parametrize("size", [(200, 256), (100, 120), (8, 8)])
def test_photos_of_one_scale_are_looked_at_with_any_effort(
    extraction: Extraction, size: tuple[int, int]
) -> None:
    assert [level.shape[:2] for _, level in pyramid(_picture(*size), extraction)] == [size]


def test_less_effort_looks_at_some_of_the_scales(tmp_path: Path) -> None:
    _save(tmp_path, "r2d2", _random_state("r2d2"))
    extractor = load_r2d2(tmp_path)
    assert isinstance(extractor, R2D2Extractor)
    extractor.network = _BrightnessNetwork()
    rgb = _picture(480, 640)
    scales = {
        effort: set(
            extractor.extract(rgb, max_keypoints=100_000, extraction=effort).scales.tolist()
        )
        for effort in Extraction
    }
    assert scales[Extraction.FAST] < scales[Extraction.DEFAULT] < scales[Extraction.ACCURATE]
    assert len(scales[Extraction.FAST]) == 1
    assert min(scales[Extraction.ACCURATE]) == PATCH_PX


def _save_own(folder: Path, name: str) -> Path:
    network = _network(folder, name)
    (folder / FILE_NAMES[name]).unlink()
    path = folder / f"{name}.safetensors"
    path.write_bytes(save(pack(network)))
    return path


@BOTH
def test_weights_of_our_own_are_the_network_in_16_bits(name: str, tmp_path: Path) -> None:
    expected = _network(tmp_path, name).state_dict()
    own = read_checkpoint(_save_own(tmp_path, name))
    assert own.tensors[f"{name}.heads.weight"].shape == (2, 128)
    read, sha256 = read_network(ARCHITECTURES[name], own.path)
    assert list(read.state_dict()) == list(expected)
    for part, tensor in read.state_dict().items():
        exact = part.endswith(".bias")
        tolerance = 0.0 if exact else 1e-3
        torch.testing.assert_close(
            tensor, expected[part], rtol=tolerance, atol=0.0 if exact else 1e-6
        )
    extractor = LOADERS[name](tmp_path)
    assert extractor.fingerprint.weights_sha256 == sha256 == own.sha256


@BOTH
def test_published_weights_come_before_our_own(name: str, tmp_path: Path) -> None:
    _save_own(tmp_path, name)
    published = _save(tmp_path, name, _random_state(name))
    extractor = LOADERS[name](tmp_path)
    assert extractor.fingerprint.weights_sha256 == read_checkpoint(published).sha256


def test_our_own_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    path = _save_own(tmp_path, "faster2d2")
    path.rename(tmp_path / "r2d2.safetensors")
    with pytest.raises(WeightsError, match="not of R2D2"):
        load_r2d2(tmp_path)


def test_fast_r2d2_needs_no_weights_from_anyone(tmp_path: Path) -> None:
    for weights_dir in (None, tmp_path):
        extractor = load_faster2d2(weights_dir, Inference.FP32)
        assert weights_path(ARCHITECTURES["faster2d2"], weights_dir).is_file()
        assert extractor.fingerprint.weights_sha256 == weights.SHIPPED["faster2d2"]


def test_a_weights_folder_that_is_not_there_is_not_passed_over(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"no such file in .*absent") as caught:
        load_faster2d2(tmp_path / "absent")
    assert caught.value.code == "weights.missing"


def test_shipped_weights_that_were_changed_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _save_own(tmp_path, "faster2d2")
    monkeypatch.setattr(weights, "_SHIPPED_FOLDER", tmp_path)
    with pytest.raises(WeightsError) as caught:
        load_faster2d2(None, Inference.TORCH)
    assert caught.value.code == "weights.altered"
    assert weights.SHIPPED["faster2d2"] in str(caught.value)


def test_shipped_weights_say_what_they_were_made_of() -> None:
    """Of photos that anyone may use, under the licence of this software."""
    path = weights._SHIPPED_FOLDER / "faster2d2.safetensors"
    with safe_open(path, framework="numpy") as file:
        about = json.loads(file.metadata()["about"])
    assert about["licence"] == "BSD-3-Clause"
    assert path.stat().st_size < 2_000_000
    licences = about["licences"]
    assert licences
    assert not [name for name in licences if "NC" in name or "ND" in name or "research" in name]
