from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from visloc_extensions.training.losses import (
    AP_BINS,
    peakiness_loss,
    quantized_average_precision,
    reliability_loss,
    similarity_loss,
)


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _average_precision_by_bins(positive: Tensor, negatives: Tensor) -> list[float]:
    """Do as He et al. 2018 write it: similarities in bins, sums over bins, in plain loops."""
    width = 1 / (AP_BINS - 1)
    centres = [1 - k * width for k in range(AP_BINS)]

    def shares(similarity: float) -> list[float]:
        inside = min(max(similarity, 0.0), 1.0)
        return [max(0.0, 1 - abs(inside - centre) / width) for centre in centres]

    precisions = []
    for right, wrong in zip(positive.tolist(), negatives.tolist(), strict=True):
        found = np.cumsum(np.sum([shares(each) for each in (right, *wrong)], axis=0))
        gained = np.array(shares(right))
        precision = np.cumsum(gained) / (found + 1e-16)
        precisions.append(float((precision * gained).sum()))
    return precisions


def test_average_precision_is_that_of_the_formula_in_plain_loops() -> None:
    positive = torch.rand(7, generator=_generator(), dtype=torch.float64) * 2 - 1
    negatives = torch.rand((7, 30), generator=_generator(), dtype=torch.float64) * 2.1 - 1
    ours = quantized_average_precision(positive, negatives)
    assert ours.tolist() == pytest.approx(_average_precision_by_bins(positive, negatives))


@pytest.mark.parametrize("num_better", [0, 1, 3])
def test_of_separated_similarities_it_is_one_over_the_rank(num_better: int) -> None:
    # Centres of bins, each similarity in one of its own.
    negatives = torch.tensor([[17 / 19] * num_better + [3 / 19, 1 / 19, -0.5]])
    ours = quantized_average_precision(torch.tensor([10 / 19]), negatives)
    assert ours.item() == pytest.approx(1 / (1 + num_better), rel=1e-5)


def test_average_precision_pulls_the_right_answer_up_and_the_wrong_ones_down() -> None:
    positive = torch.tensor([0.5], requires_grad=True)
    negatives = torch.tensor([[0.52, 0.48, 0.1]], requires_grad=True)
    quantized_average_precision(positive, negatives).sum().backward()
    assert positive.grad is not None
    assert negatives.grad is not None
    assert positive.grad.item() > 0
    assert (negatives.grad[0, :2] < 0).all()


def test_reliability_learns_where_precision_is_good() -> None:
    precision = torch.tensor([[0.9, 0.2, 0.9]])
    asked = torch.tensor([[True, True, False]])
    reliability = torch.tensor([[0.8, 0.6, 0.1]], requires_grad=True)
    loss = reliability_loss(precision, reliability, asked, 0.5)
    # 1 - (0.9 * 0.8 + 0.2 * 0.5) and 1 - (0.2 * 0.6 + 0.4 * 0.5)
    assert loss.item() == pytest.approx((0.18 + 0.68) / 2)
    loss.backward()
    assert reliability.grad is not None
    assert reliability.grad[0].tolist() == pytest.approx([-0.2, 0.15, 0.0])


def test_without_queries_there_is_no_loss() -> None:
    none = torch.zeros((1, 3), dtype=torch.bool)
    assert reliability_loss(torch.rand(1, 3), torch.rand(1, 3), none, 0.5).item() == 0


def test_similarity_of_maps_is_the_mean_cosine_of_their_patches() -> None:
    first, second = torch.rand((2, 2, 12, 16), generator=_generator(), dtype=torch.float64)
    cosines = []
    for image in range(2):
        for top in range(0, 12 - 4 + 1, 2):
            for left in range(0, 16 - 4 + 1, 2):
                patch = (image, slice(top, top + 4), slice(left, left + 4))
                a, b = first[patch].flatten(), second[patch].flatten()
                cosines.append(float(a @ b / (a.norm() * b.norm())))
    valid = torch.ones_like(first, dtype=torch.bool)
    loss = similarity_loss(first, second, valid, 4)
    assert loss.item() == pytest.approx(1 - float(np.mean(cosines)))


def test_what_has_no_match_does_not_count_as_different() -> None:
    first = torch.rand((1, 16, 16), generator=_generator())
    second, valid = first.clone(), torch.ones((1, 16, 16), dtype=torch.bool)
    second[:, :, 9:], valid[:, :, 9:] = 0.3, False
    assert similarity_loss(first, second, valid, 8).item() == pytest.approx(0, abs=1e-6)
    assert similarity_loss(first, second, ~torch.isnan(first), 8).item() > 0.01


def test_peakiness_is_the_height_of_peaks_above_the_mean_about_them() -> None:
    maps = torch.rand((1, 10, 9), generator=_generator(), dtype=torch.float64)
    padded = torch.zeros((12, 11), dtype=torch.float64)
    padded[1:-1, 1:-1] = maps[0]
    smooth = torch.stack([padded[y : y + 10, x : x + 9] for y in range(3) for x in range(3)]).mean(
        dim=0
    )
    heights = []
    for y in range(10):
        for x in range(9):
            square = smooth[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            heights.append(float(square.max() - square.sum() / 25))
    assert peakiness_loss(maps, 4).item() == pytest.approx(1 - float(np.mean(heights)))


def test_a_flat_map_is_not_peaky_and_a_dotted_one_is() -> None:
    flat, dotted = torch.full((1, 64, 64), 0.5), torch.zeros((1, 64, 64))
    dotted[:, 4::8, 4::8] = 1.0
    inside = peakiness_loss(flat, 8)
    assert inside.item() > 0.9  # the border's zeros make it a little less than 1
    assert peakiness_loss(dotted, 8).item() < inside.item()
