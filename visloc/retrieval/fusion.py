"""Late fusion: one score per mapping photo from its cosine similarities to the query.

Section 4.3 and appendix B of Humenberger et al. 2020. An operator takes similarities (m, n), one
row per global descriptor, and positive weights (m,) whose sum is 1, and gives fused scores (n,).
Scores order the photos of one query. They are not cosines, except with a single descriptor.

Every operator is defined and finite for all cosines from -1 to 1, and no score falls when a
similarity rises. Formulas that divide by similarities or take powers of them are undefined from 0
on (generalized harmonic mean: from a negative value on). There the smallest similarity is the
score, which is continuous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import wraps

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.options import Fusion, LocalizeOptions

FusionOperator = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

GHARM_GAMMA = 0.5


def equal_weights(count: int) -> NDArray[np.float64]:
    """Return equal weights (count,) with sum 1."""
    return np.full(count, 1.0 / count)


def _of_several(operator: FusionOperator) -> FusionOperator:
    """Return a single descriptor's cosines unchanged, which formulas would round or rank."""

    @wraps(operator)
    def fused(
        similarities: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        if len(similarities) == 1:
            return np.asarray(similarities[0])
        return operator(similarities, weights)

    return fused


@_of_several
def gharm(similarities: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Generalized harmonic mean, ``1 / mean(1 / (gamma + a_i s_i)) - gamma`` with gamma 0.5.

    A low similarity under one descriptor pulls the score down more than in the arithmetic mean.
    With equal weights the result lies within [-1/m, 1/m].
    """
    # Divided by 1 / a: with equal weights that is by m, exactly.
    shifted = GHARM_GAMMA + similarities / (1.0 / weights)[:, None]
    lowest = shifted.min(axis=0)
    # Beside 0.5 nothing positive is below 2**-54: one over it is finite.
    positive = np.where(lowest > 0, shifted, 1.0)
    fused = len(shifted) / np.sum(1.0 / positive, axis=0)
    return np.asarray(np.where(lowest > 0, fused, lowest) - GHARM_GAMMA)


def mean(similarities: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """``sum(a_i s_i)``."""
    # Not a matrix product: in some of them equal columns can differ in the last bit.
    return np.asarray(np.sum(weights[:, None] * similarities, axis=0))


@_of_several
def power(similarities: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted geometric mean, ``prod(s_i ** a_i)``."""
    lowest = similarities.min(axis=0)
    positive = np.where(lowest > 0, similarities, 1.0)
    fused = np.exp(np.sum(weights[:, None] * np.log(positive), axis=0))
    return np.asarray(np.where(lowest > 0, fused, lowest))


def smallest(
    similarities: NDArray[np.float64],
    weights: NDArray[np.float64],  # noqa: ARG001 (of every operator)
) -> NDArray[np.float64]:
    """``min(s_i)``; weights do not matter."""
    return np.asarray(similarities.min(axis=0))


def largest(
    similarities: NDArray[np.float64],
    weights: NDArray[np.float64],  # noqa: ARG001 (of every operator)
) -> NDArray[np.float64]:
    """``max(s_i)``; weights do not matter."""
    return np.asarray(similarities.max(axis=0))


@_of_several
def harmonic(
    similarities: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weighted harmonic mean divided by m, ``1 / (m sum(a_i / s_i))``.

    With equal weights that is kapture's ``1 / mean(1 / (a_i s_i))``, under which a descriptor of
    more weight would count less.
    """
    lowest = similarities.min(axis=0)
    positive = np.where(lowest > 0, similarities, 1.0)
    with np.errstate(over="ignore"):  # one over infinity is what it tends to
        fused = 1.0 / np.sum(weights[:, None] / positive, axis=0)
    return np.asarray(np.where(lowest > 0, fused, lowest) / len(similarities))


@_of_several
def round_robin(
    similarities: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Take the first photo of every descriptor's ranking, then the second of each, and so on.

    A photo that was taken is skipped. Photos of one round are ordered by their weighted mean, so
    that the order of the descriptors does not matter. Weights have no other effect.

    Returns:
        (n,) 1 / position. Photos with equal similarities share the first of their positions.
    """
    rising = np.sort(similarities, axis=1)
    num = similarities.shape[1]
    # By descriptor, how many photos are more similar.
    before = np.stack(
        [num - np.searchsorted(r, s, "right") for r, s in zip(rising, similarities, strict=True)]
    )
    rounds = before.min(axis=0)
    # Sorted, so that the last bit of the sum does not depend on the order of descriptors either.
    means = np.sort(weights[:, None] * similarities, axis=0).sum(axis=0)
    order = np.lexsort((-means, rounds))
    follows = np.ones(num, dtype=np.bool_)
    follows[1:] = (np.diff(rounds[order]) != 0) | (np.diff(means[order]) != 0)
    scores = np.empty(num)
    scores[order] = 1.0 / np.maximum.accumulate(np.where(follows, np.arange(1, num + 1), 1))
    return scores


def _half_and_half(one: FusionOperator, other: FusionOperator) -> FusionOperator:
    def fused(
        similarities: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return 0.5 * (one(similarities, weights) + other(similarities, weights))

    return fused


FUSION_OPERATORS: Mapping[Fusion, FusionOperator] = {
    Fusion.GHARM: gharm,
    Fusion.MEAN: mean,
    Fusion.POWER: power,
    Fusion.MIN: smallest,
    Fusion.MAX: largest,
    Fusion.MEAN_AND_POWER: _half_and_half(mean, power),
    Fusion.MIN_AND_MAX: _half_and_half(smallest, largest),
    Fusion.MEAN_AND_MIN: _half_and_half(mean, smallest),
    Fusion.HARMONIC: harmonic,
    Fusion.ROUND_ROBIN: round_robin,
}


@dataclass(frozen=True, slots=True)
class LateFusion:
    """How similarities under several global descriptors become one ranking.

    Attributes:
        operator: a key of ``FUSION_OPERATORS``.
        weights: positive weight by global descriptor, of any sum; descriptors without a weight are
            ignored. None weighs all equally.
    """

    operator: Fusion = Fusion.GHARM
    weights: Mapping[str, float] | None = None

    def counted(self, names: Iterable[str]) -> tuple[str, ...]:
        """The global descriptors that are not ignored."""
        return tuple(name for name in names if self.weights is None or name in self.weights)

    def scores(self, similarities: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Fuse cosine similarities (n,) by global descriptor into scores (n,)."""
        names = self.counted(similarities)
        weights = equal_weights(len(names))
        if self.weights is not None:
            weights = np.array([self.weights[name] for name in names], dtype=np.float64)
            weights /= weights.sum()
        stacked = np.stack([similarities[name] for name in names])
        return FUSION_OPERATORS[self.operator](stacked, weights)


EQUAL_GHARM = LateFusion()


def chosen_fusion(
    options: LocalizeOptions, default: LateFusion, names: Iterable[str]
) -> LateFusion:
    """Return the fusion that a query's options ask for, or the map's default.

    Raises:
        InvalidInput: ``options.fusion_weights`` for a name that is not in the map's ``names``.
    """
    known = tuple(names)
    for name in options.fusion_weights or ():
        if name not in known:
            raise refuse(
                "options.fusion_weights",
                "the map does not have this global descriptor",
                field="options.fusion_weights",
                expected=f"weights of {', '.join(known)}",
                got=name,
            )
    return LateFusion(
        default.operator if options.fusion is None else options.fusion,
        default.weights if options.fusion_weights is None else options.fusion_weights,
    )
