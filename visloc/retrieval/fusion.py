"""Late fusion: one score per mapping photo from its cosine similarities to the query.

Section 4.3 and appendix B of Humenberger et al. 2020. An operator takes similarities (m, n), one
row per global descriptor, positive weights (m,) whose sum is 1, and the operator's parameter, and
gives fused scores (n,). The parameter is the paper's gamma (generalized harmonic mean) or beta
(mixtures of two operators, the share of the first); other operators have none. Scores order the
photos of one query. They are not cosines, except with a single descriptor.

Every operator is defined and finite for all cosines from -1 to 1. With the default parameter, no
score falls when a similarity rises. Formulas that divide by similarities or take powers of them are
undefined from 0 on (generalized harmonic mean: from a negative value on). There the smallest
similarity stands for the formula, which is continuous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import wraps

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.options import DEFAULT_FUSION_PARAMETER, Fusion, LocalizeOptions

_Scores = NDArray[np.float64]
FusionOperator = Callable[[_Scores, _Scores, float], _Scores]
# The parameter of an operator that has none.
_Plain = Callable[[_Scores, _Scores], _Scores]


def equal_weights(count: int) -> NDArray[np.float64]:
    """Return equal weights (count,) with sum 1."""
    return np.full(count, 1.0 / count)


def _of_several(operator: FusionOperator) -> FusionOperator:
    """Return a single descriptor's cosines unchanged, which formulas would round or rank."""

    @wraps(operator)
    def fused(similarities: _Scores, weights: _Scores, parameter: float) -> _Scores:
        if len(similarities) == 1:
            return np.asarray(similarities[0])
        return operator(similarities, weights, parameter)

    return fused


def _without_parameter(operator: _Plain) -> FusionOperator:
    @_of_several
    def fused(similarities: _Scores, weights: _Scores, parameter: float) -> _Scores:
        del parameter
        return operator(similarities, weights)

    return fused


@_of_several
def gharm(similarities: _Scores, weights: _Scores, gamma: float) -> _Scores:
    """Generalized harmonic mean, ``1 / mean(1 / (gamma + a_i s_i)) - gamma``.

    A low similarity under one descriptor pulls the score down more than in the arithmetic mean,
    which the result tends to with a growing gamma. With equal weights and a gamma of 0.5 it lies
    within [-1/m, 1/m].
    """
    # Divided by 1 / a: with equal weights that is by m, exactly.
    shifted = gamma + similarities / (1.0 / weights)[:, None]
    lowest = shifted.min(axis=0)
    positive = np.where(lowest > 0, shifted, 1.0)
    with np.errstate(over="ignore"):  # one over infinity is what it tends to
        fused = len(shifted) / np.sum(1.0 / positive, axis=0)
    return np.asarray(np.where(lowest > 0, fused, lowest) - gamma)


def mean(similarities: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """``sum(a_i s_i)``."""
    # Not a matrix product: in some of them equal columns can differ in the last bit.
    return np.asarray(np.sum(weights[:, None] * similarities, axis=0))


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


def round_robin(
    similarities: NDArray[np.float64],
    weights: NDArray[np.float64],  # noqa: ARG001 (of every operator)
) -> NDArray[np.float64]:
    """Take the first photo of every descriptor's ranking, then the second of each, and so on.

    The descriptors take turns in their order, and a photo that was taken is skipped. Weights do
    not matter.

    Returns:
        (n,) 1 / position. Photos with equal similarities share the first of their positions.
    """
    rising = np.sort(similarities, axis=1)
    num = similarities.shape[1]
    # By descriptor, how many photos are more similar.
    before = np.stack(
        [num - np.searchsorted(r, s, "right") for r, s in zip(rising, similarities, strict=True)]
    )
    turns = before.min(axis=0) * len(similarities) + before.argmin(axis=0)
    order = np.argsort(turns, kind="stable")
    follows = np.ones(num, dtype=np.bool_)
    follows[1:] = np.diff(turns[order]) != 0
    scores = np.empty(num)
    scores[order] = 1.0 / np.maximum.accumulate(np.where(follows, np.arange(1, num + 1), 1))
    return scores


@_of_several
def villena_roman(similarities: _Scores, weights: _Scores, beta: float) -> _Scores:
    """``(1 - beta) max(s_i) + beta min(s_i)^2 / (max(s_i) + min(s_i))``; weights do not matter.

    At 0 and below, ``min(s_i)`` replaces the quotient, which has a pole there.
    """
    del weights
    low, high = similarities.min(axis=0), similarities.max(axis=0)
    a, b = (np.where(low > 0, each, 1.0) for each in (low, high))
    # Not squared: what is tiny would become 0.
    quotient = np.where(low > 0, a * (a / (b + a)), low)
    return np.asarray((1.0 - beta) * high + beta * quotient)


def _mixed(one: _Plain, other: _Plain) -> FusionOperator:
    """``beta one + (1 - beta) other``."""

    @_of_several
    def fused(similarities: _Scores, weights: _Scores, beta: float) -> _Scores:
        first, second = one(similarities, weights), other(similarities, weights)
        return np.asarray(beta * first + (1.0 - beta) * second)

    return fused


FUSION_OPERATORS: Mapping[Fusion, FusionOperator] = {
    Fusion.GHARM: gharm,
    Fusion.MEAN: _without_parameter(mean),
    Fusion.POWER: _without_parameter(power),
    Fusion.MIN: _without_parameter(smallest),
    Fusion.MAX: _without_parameter(largest),
    Fusion.MEAN_AND_POWER: _mixed(mean, power),
    Fusion.MIN_AND_MAX: _mixed(smallest, largest),
    Fusion.MEAN_AND_MIN: _mixed(mean, smallest),
    Fusion.VILLENA_ROMAN: villena_roman,
    Fusion.HARMONIC: _without_parameter(harmonic),
    Fusion.ROUND_ROBIN: _without_parameter(round_robin),
}


# Their parameter is a share.
_MIXTURES = (
    *(Fusion.MEAN_AND_POWER, Fusion.MIN_AND_MAX, Fusion.MEAN_AND_MIN, Fusion.VILLENA_ROMAN),
)


@dataclass(frozen=True, slots=True)
class LateFusion:
    """How similarities under several global descriptors become one ranking.

    Attributes:
        weights: positive weight by global descriptor, of any sum; descriptors without a weight are
            ignored. None weighs all equally.
        parameter: gamma or beta of the operator, where it has one.
    """

    operator: Fusion = Fusion.GHARM
    weights: Mapping[str, float] | None = None
    parameter: float = DEFAULT_FUSION_PARAMETER

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
        return FUSION_OPERATORS[self.operator](stacked, weights, self.parameter)


EQUAL_GHARM = LateFusion()


def chosen_fusion(
    options: LocalizeOptions, default: LateFusion, names: Iterable[str]
) -> LateFusion:
    """Return the fusion that a query's options ask for, or the map's default."""
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
    operator = default.operator if options.fusion is None else options.fusion
    if operator in _MIXTURES and options.fusion_parameter > 1.0:
        raise refuse(
            "options.fusion_parameter",
            field="options.fusion_parameter",
            expected=f"0 to 1 for the fusion {operator}",
            got=options.fusion_parameter,
        )
    return LateFusion(
        operator,
        default.weights if options.fusion_weights is None else options.fusion_weights,
        options.fusion_parameter,
    )
