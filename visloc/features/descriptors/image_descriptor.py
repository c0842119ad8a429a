"""A global descriptor of the pixels alone, such as a network's."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.features.descriptors.whitening import WhitenedDescriptor
from visloc.types import Fingerprint, LocalFeatures


class ImageDescriptor(WhitenedDescriptor):
    """A ``GlobalDescriptor``; a subclass says what the raw vector of a photo is.

    It learns no vocabulary. Its whitening, learned on the map, holds ``mean`` (R,) and ``axes``
    (R, D), D at most 1024 and at most one less than the map has photos.
    """

    fingerprint: Fingerprint
    computed_with: str | None = None  # plain code
    needs_image = True
    needs_local_features = False
    needs_vocabulary = False

    @abstractmethod
    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the raw vector (R,), of unit length, of a photo (H, W, 3)."""

    def training_words(
        self,
        rgb: NDArray[np.uint8],  # noqa: ARG002
        local: LocalFeatures,  # noqa: ARG002
        seed: int,  # noqa: ARG002
    ) -> NDArray[np.float32]:
        return np.empty((0, 1), np.float32)

    def learn_vocabulary(
        self,
        words: NDArray[np.float32],  # noqa: ARG002
        seed: int,  # noqa: ARG002
    ) -> dict[str, NDArray[np.float32]]:
        return {}

    def pool(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,  # noqa: ARG002 - not needed
        vocabulary: Mapping[str, NDArray[np.float32]],  # noqa: ARG002 - there is none
    ) -> NDArray[np.float32]:
        return self.look(rgb)
