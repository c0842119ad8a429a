"""Learning R2D2 or Fast-R2D2 from nothing: the losses of one step."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from visloc.features.networks.r2d2.architecture import ARCHITECTURES
from visloc_extensions.training.losses import peakiness_loss, reliability_loss, similarity_loss
from visloc_extensions.training.network import Maps, TrainableR2D2
from visloc_extensions.training.pairs import Pairs, Sources, as_numbers, draw, from_numbers, make
from visloc_extensions.training.sampler import sample
from visloc_extensions.training.settings import Settings


class FromScratch:
    """A ``Task`` of the training loop: the published losses, on pairs of crops."""

    names = ("reliability", "similarity", "peakiness")

    def __init__(self, settings: Settings, sources: Sources) -> None:
        self._settings, self._sources = settings, sources
        self.network = TrainableR2D2(ARCHITECTURES[settings.architecture]).to(sources.device)
        self._compiled: Callable[..., Maps] = self.network
        if settings.compiled:
            self._compiled = torch.compile(self.network)
        self._like = draw(sources, settings, 0)

    def numbers(self, step: int) -> Tensor:
        """See ``Task``."""
        return as_numbers(*draw(self._sources, self._settings, step))

    def losses(self, numbers: Tensor) -> Tensor:
        """See ``Task``."""
        drawn = from_numbers(numbers, self._like)
        pairs = make(self._sources, self._settings, *drawn)
        maps = self._compiled(pairs.images, bf16=self._settings.bf16)
        return losses_of(maps, pairs, self._settings)


def losses_of(maps: Maps, pairs: Pairs, settings: Settings) -> Tensor:
    """Compare what the network says about the images of pairs: (3,), as ``FromScratch.names``."""
    first, second = maps.halves()
    sampled = sample(first, second, pairs.flow, pairs.queries, pairs.distractors)
    valid = ~pairs.flow[..., 0].isnan()
    # Beyond the border, and not NaN, which would spread.
    grid = torch.where(valid[..., None], pairs.flow / settings.crop_px * 2 - 1, 2.0)
    seen = F.grid_sample(
        second.repeatability[:, None], grid, padding_mode="border", align_corners=False
    )
    peakiness = [peakiness_loss(each.repeatability, settings.patch_px) for each in (first, second)]
    return torch.stack(
        [
            reliability_loss(*sampled, settings.good_precision),
            similarity_loss(first.repeatability, seen[:, 0], valid, settings.patch_px),
            (peakiness[0] + peakiness[1]) / 2,
        ]
    )
