from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from visloc.features.networks.interpolated import squared_heads, squared_heads_at_double_resolution


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (7, 1), (2, 2), (8, 3), (9, 20), (33, 17)])
def test_heads_equal_those_on_the_enlarged_features(size: tuple[int, int]) -> None:
    generator = np.random.default_rng(0)
    features = generator.normal(size=(128, *size)).astype(np.float32)
    weight = generator.normal(size=(2, 128)).astype(np.float32)
    bias = generator.normal(size=2).astype(np.float32)
    exact = torch.tensor(features, dtype=torch.float64)[None]
    enlarged = F.interpolate(exact, scale_factor=2, mode="bilinear", align_corners=False)[0]
    for heads, seen in (
        (squared_heads, exact[0]),
        (squared_heads_at_double_resolution, enlarged),
    ):
        expected = np.einsum("kc,chw->khw", weight, seen.numpy() ** 2) + bias[:, None, None]
        np.testing.assert_allclose(heads(features, weight, bias), expected, atol=3e-5)


def test_view_of_features_is_enough() -> None:
    features = np.random.default_rng(0).normal(size=(16, 20, 12)).astype(np.float32)
    weight, bias = np.ones((1, 16), np.float32), np.zeros(1, np.float32)
    view = np.ascontiguousarray(features.transpose(1, 2, 0)).transpose(2, 0, 1)
    np.testing.assert_allclose(
        squared_heads_at_double_resolution(view, weight, bias),
        squared_heads_at_double_resolution(features, weight, bias),
        rtol=1e-5,
    )
