"""A principal component analysis of scikit-learn, as a weights file holds it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The modules of ``PCA`` before and after scikit-learn 0.22.
_MODULES = ("sklearn.decomposition.pca", "sklearn.decomposition._pca")


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


class PickledPca:
    """Stands in for a ``sklearn.decomposition.PCA``: keeps its attributes, and does nothing."""


# For ``torch.serialization.safe_globals``.
STAND_INS: list[Callable[..., object] | tuple[Callable[..., object], str]] = [
    (PickledPca, f"{module}.PCA") for module in _MODULES
]


def principal_components(pickled: object) -> PrincipalComponents:
    """Return what a pickled PCA holds."""
    attributes = vars(pickled) if isinstance(pickled, PickledPca) else {}
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


def _array(name: str, held: object) -> NDArray[np.float64]:
    if not (isinstance(held, np.ndarray) and held.dtype.kind == "f"):
        raise ValueError(f"the PCA's {name} is no array of floats")
    array: NDArray[np.float64] = held.astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"the PCA's {name} holds numbers that are not finite")
    return array
