"""XFeat learns to see altered photos as its published weights see unaltered ones.

The teacher has the published weights and looks at clean crops. The student begins with the same
weights and looks at the crops after night, weather, lenses and cameras changed them; some it sees
unaltered. Its descriptors have to find the teacher's at the right places, so that a query of
the student can be matched with a map of the teacher.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from visloc.features.networks.xfeat.load import published_path
from visloc.features.networks.xfeat.model import read_network
from visloc_extensions.training.augmentation import augment
from visloc_extensions.training.conditions import Conditions
from visloc_extensions.training.pairs import (
    Pairs,
    Sources,
    as_numbers,
    draw,
    from_numbers,
    photograph,
)
from visloc_extensions.training.settings import Settings

_TEMPERATURE = 0.1  # of the softmax over cosines
_SAME_PLACE_PX = 8.0  # closer places are no wrong answers: they share a cell
_ALTERED_SEED = 1  # apart from the pairs' own random numbers
# Beside the weight of 1 that matching the teacher has.
_OWN, _FEATURES, _KEYPOINTS, _RELIABILITY = 0.5, 4.0, 2.0, 1.0

Maps = tuple[Tensor, Tensor, Tensor]
"""Unit features (n, 64, h, w), logits of keypoints (n, 65, h, w), reliability (n, 1, h, w)."""


class Distillation:
    """A ``Task`` of the training loop."""

    names = ("cross", "own", "features", "keypoints", "reliability")

    def __init__(self, settings: Settings, sources: Sources) -> None:
        self._settings, self._sources = settings, sources
        teacher, _ = read_network(published_path(None))
        self._teacher = teacher.to(sources.device)
        # The batch norms stay inside the convolutions: a night's statistics are not a day's.
        self.network = deepcopy(self._teacher).requires_grad_(True)
        self._like = draw(sources, settings, 0)

    def numbers(self, step: int) -> Tensor:
        """See ``Task``: the numbers of the pairs, then which photos are altered, always as many."""
        settings = self._settings
        photos = 2 * settings.batch
        rng = np.random.default_rng([settings.seed, step, _ALTERED_SEED])
        altered = rng.permutation(photos)[round(settings.unaltered_share * photos) :]
        pairs = as_numbers(*draw(self._sources, settings, step))
        return torch.cat([pairs, torch.from_numpy(altered.astype(np.float64))])

    def losses(self, numbers: Tensor) -> Tensor:
        """See ``Task``."""
        photos = 2 * self._settings.batch
        count = photos - round(self._settings.unaltered_share * photos)
        drawn, conditions = from_numbers(numbers[:-count], self._like)
        altered = numbers[-count:].long()
        pairs = photograph(self._sources, self._settings, drawn)
        clean = pairs.images
        changed = augment(
            clean.index_select(0, altered),
            Conditions(*(each.index_select(0, altered) for each in conditions)),
        )
        with torch.no_grad():
            taught = _looked(self._teacher, clean)
        said = _looked(self.network, clean.index_copy(0, altered, changed))
        closeness = clean.new_full((photos, 1, 1, 1), self._settings.closeness)
        closeness = closeness.index_fill(0, altered, 1.0)
        return losses_of(said, taught, pairs, closeness)


def _looked(network: torch.nn.Module, images: Tensor) -> Maps:
    features, logits, reliability = network(images.mean(dim=1, keepdim=True))
    return F.normalize(features, dim=1), logits, reliability


def losses_of(said: Maps, taught: Maps, pairs: Pairs, closeness: Tensor) -> Tensor:
    """Compare what student and teacher say about pairs: (5,), as ``Distillation.names``.

    Args:
        closeness: (2 B, 1, 1, 1), how much each photo counts where both see the same place.
    """
    features, logits, reliability = said
    right_features, right_logits, right_reliability = taught
    cosine = (features * right_features).sum(dim=1, keepdim=True)
    share = closeness / closeness.mean()
    closer = share * right_reliability
    alike = (closer * (1 - cosine)).sum() / closer.sum()
    divergence = F.kl_div(
        logits.log_softmax(dim=1),
        right_logits.log_softmax(dim=1),
        log_target=True,
        reduction="none",
    )
    # Where nothing is left of a place, its descriptor is not to be relied on.
    relied = right_reliability * cosine.detach().clamp(0, 1)
    entropy = F.binary_cross_entropy(reliability.clamp(1e-6, 1 - 1e-6), relied, reduction="none")
    cross, own = _matching(features, right_features, right_reliability, pairs)
    return torch.stack(
        [
            cross,
            _OWN * own,
            _FEATURES * alike,
            _KEYPOINTS * (share * divergence.sum(dim=1, keepdim=True)).mean(),
            _RELIABILITY * (share * entropy).mean(),
        ]
    )


def _matching(
    features: Tensor, right_features: Tensor, right_reliability: Tensor, pairs: Pairs
) -> tuple[Tensor, Tensor]:
    """Return how badly the student's places find the teacher's, and the student's own."""
    size_px = pairs.flow.shape[1]
    pair = torch.arange(len(pairs.flow), device=pairs.flow.device)[:, None]
    second = pairs.flow[pair, pairs.queries[..., 1], pairs.queries[..., 0]]  # (B, N, 2)
    asked = ~second.isnan().any(dim=-1)
    second = second.nan_to_num()
    first = pairs.queries + 0.5
    ours_1, ours_2 = _both(features, first, second, size_px)
    theirs_1, theirs_2 = _both(right_features, first, second, size_px)
    relied_1, relied_2 = _both(right_reliability, first, second, size_px, normalized=False)
    weight = asked * (relied_1 * relied_2)[..., 0].clamp_min(0)
    gaps = (second[:, :, None] - second[:, None]).square().sum(dim=-1)
    same = torch.eye(gaps.shape[1], dtype=torch.bool, device=gaps.device)
    # The place itself is in every row, so that no row is empty.
    excluded = ((gaps < _SAME_PLACE_PX**2) | ~asked[:, None] | ~asked[:, :, None]) & ~same

    def misses(one: Tensor, other: Tensor) -> Tensor:
        logits = (one @ other.transpose(1, 2) / _TEMPERATURE).masked_fill(excluded, -1e4)
        right = logits.diagonal(dim1=1, dim2=2)
        each = (logits.logsumexp(dim=2) + logits.logsumexp(dim=1)) / 2 - right
        return (weight * each).sum() / weight.sum().clamp_min(1e-3)

    cross = (misses(ours_1, theirs_2) + misses(theirs_1, ours_2)) / 2
    return cross, misses(ours_1, ours_2)


def _both(
    cells: Tensor, first: Tensor, second: Tensor, size_px: int, *, normalized: bool = True
) -> tuple[Tensor, Tensor]:
    """Return (B, N, C) of the first images at places of theirs, and the same of the second ones.

    As the extractor does: cubic convolution for descriptors, which are then of unit length.
    """
    found = []
    for half, places in zip(cells.chunk(2), (first, second), strict=True):
        grid = (places / size_px * 2 - 1)[:, None].float()
        mode = "bicubic" if normalized else "bilinear"
        sampled = F.grid_sample(half, grid, mode=mode, padding_mode="border", align_corners=False)
        values = sampled[:, :, 0].transpose(1, 2)
        found.append(F.normalize(values, dim=2) if normalized else values)
    return found[0], found[1]
