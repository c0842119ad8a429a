"""Keeps a principal component analysis of scikit-learn in a pickle, without running it.

Published AP-GeM weights hold, beside the network, the whitening learned by
``sklearn.decomposition.PCA``: an object whose attributes are numpy arrays. The classes below stand
in for the names in such a pickle; they only keep what the file says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self


class Pickled:
    """Stands in for an object in a pickle."""

    __slots__ = ("arguments", "state")
    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> Self:
        made = super().__new__(cls)
        made.arguments, made.state = arguments, None
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class Array(Pickled):
    """Stands in for an array of numpy."""

    __slots__ = ()


class Dtype(Pickled):
    """Stands in for a type of numbers of numpy."""

    __slots__ = ()


class PickledPca(Pickled):
    """Stands in for a ``sklearn.decomposition.PCA``."""

    __slots__ = ()


# Under the module names before and after scikit-learn 0.22 and numpy 2.
STAND_INS: Mapping[str, type[Pickled]] = {
    "numpy.ndarray": Pickled,  # only ever an argument of _reconstruct
    "numpy.dtype": Dtype,
    "numpy.core.multiarray._reconstruct": Array,
    "numpy._core.multiarray._reconstruct": Array,
    "numpy.core.multiarray.scalar": Pickled,
    "numpy._core.multiarray.scalar": Pickled,
    "sklearn.decomposition.pca.PCA": PickledPca,
    "sklearn.decomposition._pca.PCA": PickledPca,
}
