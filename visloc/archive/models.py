"""Whether the arrays of a global descriptor's model fit together, and cannot overflow."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

# Words and raw vectors are of about unit length, and whitening multiplies them by less than 100
# (``visloc.features.descriptors.whitening``). Squares of larger numbers may leave float32.
_MAX_NUMBER = 1e6
_OURS = ("vocabulary", "mean", "axes")


def fits(model: Mapping[str, NDArray[np.float32]], dim: int) -> bool:
    """Tell whether a model can turn raw vectors into rows of a map.

    A plug-in's model may have any other arrays: only trying it shows whether they are right.

    Args:
        model: ``mean`` (R,) and ``axes`` (R, ``dim``) whiten a raw vector. With a ``vocabulary``
            (K, d), R is K * d.
    """
    if any(np.abs(model[name]).max(initial=0) > _MAX_NUMBER for name in _OURS if name in model):
        return False
    mean, axes, words = (model.get(name) for name in ("mean", "axes", "vocabulary"))
    if words is not None and (words.ndim != 2 or words.size == 0):
        return False
    if mean is None or axes is None:
        return True
    if axes.shape != (mean.size, dim) or mean.ndim != 1:
        return False
    return words is None or words.size == mean.size
