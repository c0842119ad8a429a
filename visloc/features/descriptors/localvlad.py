"""VLAD of the local features already extracted: a global descriptor for next to nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.base import Fingerprint, GlobalDescriptor
from visloc.features.descriptors.vlad import VLAD_PARAMETERS, VladDescriptor
from visloc.options import Inference
from visloc.types import LocalFeatures


def load_localvlad(
    _weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make the descriptor, which needs no weights."""
    return LocalVlad()


class LocalVlad(VladDescriptor):
    """A photo's words are the descriptors of its local features, whatever their length."""

    # The local features have a fingerprint of their own.
    fingerprint = Fingerprint("localvlad", revision=1, parameters=dict(VLAD_PARAMETERS))
    needs_image = False
    needs_local_features = True

    def words(
        self,
        rgb: NDArray[np.uint8],  # noqa: ARG002 - not needed
        local: LocalFeatures,
    ) -> NDArray[np.float32]:
        """Return the local features' descriptors (N, D)."""
        return local.descriptors
