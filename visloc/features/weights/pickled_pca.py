"""Reads a principal component analysis of scikit-learn out of a pickle without running it.

Published AP-GeM weights hold, beside the network, the whitening learned by
``sklearn.decomposition.PCA``: an object whose attributes are numpy arrays. The classes below stand
in for the names that such a pickle needs; all they can do is keep what the file says about them.
Nothing is computed of it, and no bytes are copied, before ``principal_components`` is called.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DTYPES: dict[str, np.dtype[Any]] = {"f4": np.dtype("<f4"), "f8": np.dtype("<f8")}
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


class Pickled:
    """Stands in for something in a pickle. Compared by identity, so that no hash recurses."""

    __slots__ = ("arguments", "state")

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    # Instances and, as it then fails, the class itself: a file can change no attribute otherwise.
    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Bytes(Pickled):
    """``_codecs.encode(text, "latin1")``: how the pickle protocol 2 writes bytes."""

    __slots__ = ()


class _Array(Pickled):
    __slots__ = ()


class _Dtype(Pickled):
    __slots__ = ()


class PickledPca(Pickled):
    """Stands in for a ``sklearn.decomposition.PCA``."""

    __slots__ = ()


class _Number(Pickled):
    """A number of numpy's, which nobody asks for."""

    __slots__ = ()


# Under the module names before and after scikit-learn 0.22 and numpy 2.
_STAND_INS: dict[tuple[str, str], type[Pickled] | str] = {
    ("_codecs", "encode"): _Bytes,
    ("numpy", "ndarray"): "ndarray",  # only ever an argument of _reconstruct
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy._core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.multiarray", "scalar"): _Number,
    ("numpy._core.multiarray", "scalar"): _Number,
    ("sklearn.decomposition.pca", "PCA"): PickledPca,
    ("sklearn.decomposition._pca", "PCA"): PickledPca,
}


def stand_in(module: str, name: str) -> type[Pickled] | str | None:
    """Return what takes the place of a name in a pickle; None if the name is not known here."""
    return _STAND_INS.get((module, name))


def principal_components(pickled: PickledPca) -> PrincipalComponents:
    """Return what a pickled PCA holds.

    Raises:
        ValueError: with the reason, when it is not whole or holds numbers that no PCA has.
    """
    attributes = getattr(pickled, "state", None)
    attributes = attributes if isinstance(attributes, dict) else {}
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
    """Return an array that numpy pickled, as float64.

    Its state is (version, shape, dtype, whether columns come first in memory, its bytes).
    """
    state = getattr(pickled, "state", None)
    if not (isinstance(pickled, _Array) and isinstance(state, tuple) and len(state) == 5):
        raise ValueError(f"the PCA's {name} is no array")
    _version, shape, dtype, by_columns, data = state
    if not (
        isinstance(shape, tuple)
        and len(shape) <= _MAX_DIMENSIONS
        and all(type(side) is int and 0 <= side < 2**20 for side in shape)
        and isinstance(by_columns, bool)
    ):
        raise ValueError(f"the PCA's {name} has an odd description")
    numbers = np.frombuffer(_encoded(name, data), _dtype(name, dtype))
    if numbers.size != prod(shape):
        raise ValueError(f"the PCA's {name} holds {numbers.size} numbers, not {shape}")
    array = numbers.reshape(shape, order="F" if by_columns else "C").astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"the PCA's {name} holds numbers that are not finite")
    return array


def _dtype(name: str, pickled: object) -> np.dtype[Any]:
    """Return the type of numbers; the state of a pickled one is (version, byte order, ...)."""
    arguments: tuple[Any, ...] = getattr(pickled, "arguments", ())
    state: Any = getattr(pickled, "state", None)
    code = arguments[0] if isinstance(pickled, _Dtype) and arguments else None
    if not (
        isinstance(code, str)
        and code in _DTYPES
        and isinstance(state, tuple)
        and len(state) >= 2
        and state[1] == "<"
    ):
        raise ValueError(f"the PCA's {name} is not of little-endian floats")
    return _DTYPES[code]


def _encoded(name: str, pickled: object) -> bytes:
    arguments: tuple[Any, ...] = getattr(pickled, "arguments", ())
    if not (
        isinstance(pickled, _Bytes)
        and len(arguments) == 2
        and isinstance(arguments[0], str)
        and arguments[1] == "latin1"
    ):
        raise ValueError(f"the PCA's {name} has no bytes")
    encoded: bytes = arguments[0].encode("latin1")
    return encoded
