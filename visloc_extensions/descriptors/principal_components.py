"""A principal component analysis of scikit-learn, as a weights file holds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.features.weights.pickled_pca import Array, Dtype, PickledPca

_DTYPES: Mapping[str, np.dtype[Any]] = {"f4": np.dtype("<f4"), "f8": np.dtype("<f8")}
_MAX_DIMENSIONS = 2


@dataclass(frozen=True, slots=True, eq=False)
class PrincipalComponents:
    """Directions in which vectors vary most.

    Attributes:
        mean: (D,) float64, of the vectors it was learned from.
        components: (K, D) float64, a direction per row, that of the greatest variance first.
        variances: (K,) float64, positive.
        whiten: whether the components are meant to be scaled by their variances.
    """

    mean: NDArray[np.float64]
    components: NDArray[np.float64]
    variances: NDArray[np.float64]
    whiten: bool


def principal_components(pickled: PickledPca) -> PrincipalComponents:
    """Return what a pickled PCA holds.

    Raises:
        ValueError: with the reason, when it is not whole or holds numbers that no PCA has.
    """
    attributes = pickled.state if isinstance(pickled.state, dict) else {}
    mean, components, variances = (
        _array(name, attributes.get(name))
        for name in ("mean_", "components_", "explained_variance_")
    )
    whiten = attributes.get("whiten")
    if whiten not in (True, False):
        raise ValueError("a PCA that does not say whether it whitens")
    if not (
        mean.ndim == 1
        and mean.size > 0
        and components.shape == (len(variances), len(mean))
        and variances.ndim == 1
        and 0 < len(variances) <= len(mean)
    ):
        raise ValueError(
            f"a PCA of mean {mean.shape}, components {components.shape} "
            f"and variances {variances.shape}, which do not fit together"
        )
    if not (variances > 0).all():
        raise ValueError("a PCA with variances that are not positive")
    return PrincipalComponents(mean, components, variances, bool(whiten))


def _array(name: str, pickled: object) -> NDArray[np.float64]:
    """Return an array that numpy pickled as (version, shape, dtype, is Fortran order, bytes)."""
    state = pickled.state if isinstance(pickled, Array) else None
    match state:
        case (_, tuple(shape), dtype, bool(by_columns), bytes(data)) if len(
            shape
        ) <= _MAX_DIMENSIONS and all(type(side) is int and 0 <= side < 2**20 for side in shape):
            numbers = np.frombuffer(data, _dtype(name, dtype))
        case _:
            raise ValueError(f"the PCA's {name} is no array, or has an odd description")
    if numbers.size != prod(shape):
        raise ValueError(f"the PCA's {name} holds {numbers.size} numbers, not {shape}")
    array = numbers.reshape(shape, order="F" if by_columns else "C").astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"the PCA's {name} holds numbers that are not finite")
    return array


def _dtype(name: str, pickled: object) -> np.dtype[Any]:
    """Return the type of numbers that numpy pickled with the state (version, byte order, ...)."""
    if isinstance(pickled, Dtype):
        match pickled.arguments, pickled.state:
            case (("f4" | "f8") as code, *_), (_, "<", *_):
                return _DTYPES[code]
    raise ValueError(f"the PCA's {name} is not of little-endian floats")
