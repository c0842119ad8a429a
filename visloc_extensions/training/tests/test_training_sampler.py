from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from visloc_extensions.training.interpolation import neighbours, weighted_squares
from visloc_extensions.training.losses import quantized_average_precision
from visloc_extensions.training.network import Maps
from visloc_extensions.training.sampler import offsets, random_pixels, sample

STRIDES = pytest.mark.parametrize("stride", [1, 2])


def _enlarged(features: Tensor, stride: int) -> Tensor:
    """(B, h, w, C) to (B, H, W, C), as the published network does."""
    planes = features.permute(0, 3, 1, 2)
    if stride > 1:
        planes = F.interpolate(planes, scale_factor=stride, mode="bilinear", align_corners=False)
    return planes.permute(0, 2, 3, 1)


def _features(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


@STRIDES
def test_weighted_squares_are_those_of_the_enlarged_features(stride: int) -> None:
    features, weight = _features(2, 5, 4, 6), _features(3, 6, seed=1)
    plain = torch.einsum("byxc,kc->bkyx", _enlarged(features, stride).square(), weight)
    torch.testing.assert_close(weighted_squares(features, weight, stride), plain)


@STRIDES
def test_their_gradients_are_those_of_finite_differences(stride: int) -> None:
    features = _features(2, 3, 4, 5).requires_grad_()
    weight = _features(2, 5, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: weighted_squares(f, w, stride), (features, weight))


@STRIDES
def test_neighbours_are_those_of_the_enlarged_features(stride: int) -> None:
    features = _features(1, 4, 5, 3)
    enlarged = _enlarged(features, stride)[0]
    y, x = torch.meshgrid(*(torch.arange(n) for n in enlarged.shape[:2]), indexing="ij")
    places, weights = neighbours(x, y, (4, 5), stride)
    taken = (features.reshape(-1, 3)[places] * weights[..., None]).sum(dim=-2)
    torch.testing.assert_close(taken, enlarged)


def test_candidates_are_as_many_as_published() -> None:
    assert len(offsets(0, 3)) == 29
    assert len(offsets(5, 7)) == 80


def test_random_pixels_keep_off_the_border() -> None:
    pixels = random_pixels(np.random.default_rng(0), 2, 5000, 32, 10)
    assert pixels.shape == (2, 5000, 2)
    assert (pixels.min(), pixels.max()) == (10, 21)


def _maps(stride: int, seed: int) -> tuple[Maps, Tensor]:
    """Maps of two images of 32 x 32 pixels, and their enlarged unit descriptors."""
    features = _features(2, 32 // stride, 32 // stride, 8, seed=seed)
    enlarged = _enlarged(features, stride)
    generator = torch.Generator().manual_seed(seed)
    reliability = torch.rand((2, 32, 32), generator=generator, dtype=torch.float64)
    maps = Maps(features, enlarged.square().sum(dim=-1), reliability, reliability)
    return maps, F.normalize(enlarged, dim=-1)


@STRIDES
def test_queries_see_what_plain_loops_see(stride: int) -> None:
    (first, first_vectors), (second, second_vectors) = _maps(stride, 1), _maps(stride, 2)
    generator = torch.Generator().manual_seed(3)
    flow = torch.rand((2, 32, 32, 2), generator=generator, dtype=torch.float64) * 40 - 4
    flow[:, ::5] = torch.nan
    queries = torch.randint(0, 32, (2, 9, 2), generator=generator)
    distractors = torch.randint(0, 32, (2, 6, 2), generator=generator)
    sampled = sample(first, second, flow, queries, distractors)
    seen = 0
    for image in range(2):
        for number, (x, y) in enumerate(queries[image].tolist()):
            u, v = flow[image, y, x].tolist()
            inside = 0 <= u < 32 and 0 <= v < 32
            assert bool(sampled.asked[image, number]) == inside
            if not inside:
                continue
            seen += 1
            wanted = first_vectors[image, y, x]

            match = (int(u), int(v))
            right = [
                (float(wanted @ second_vectors[image, row, column]), row, column)
                for column, row in (_beside(match, step) for step in offsets(0, 3))
            ]
            wrong = [
                float(wanted @ second_vectors[image, row, column])
                for column, row in (_beside(match, step) for step in offsets(5, 7))
            ]
            for other in range(2):
                for column, row in distractors[other].tolist():
                    is_right = other == image and (
                        (column - int(u)) ** 2 + (row - int(v)) ** 2 < 25
                    )
                    product = float(wanted @ second_vectors[other, row, column])
                    wrong.append(0.0 if is_right else product)
            best, row, column = max(right)
            expected = quantized_average_precision(torch.tensor([best]), torch.tensor([wrong]))
            assert sampled.precision[image, number].item() == pytest.approx(
                expected.item(), rel=1e-4
            )
            said = first.reliability[image, y, x] + second.reliability[image, row, column]
            assert sampled.reliability[image, number].item() == pytest.approx(said.item() / 2)
    assert seen >= 5


def test_identical_images_are_matched_perfectly() -> None:
    maps, _ = _maps(1, 0)
    places = torch.arange(32, dtype=torch.float64) + 0.5
    y, x = torch.meshgrid(places, places, indexing="ij")
    flow = torch.stack([x, y], dim=-1).expand(2, -1, -1, -1)
    # Nearer to the border, wrong answers beyond it would be moved onto the right one.
    queries = torch.randint(8, 24, (2, 9, 2), generator=torch.Generator().manual_seed(1))
    sampled = sample(maps, maps, flow, queries, queries)
    assert sampled.asked.all()
    assert (sampled.precision > 0.9).all()


def _beside(pixel: tuple[int, int], step: tuple[int, int]) -> tuple[int, int]:
    """Another pixel of an image of 32 x 32, the nearest inside it."""
    x, y = (min(max(at + by, 0), 31) for at, by in zip(pixel, step, strict=True))
    return x, y
