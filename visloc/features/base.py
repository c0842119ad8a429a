"""Protocols of local features and global descriptors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from visloc.options import Extraction
from visloc.types import Fingerprint, LocalFeatures

__all__ = ["Fingerprint", "GlobalDescriptor", "LocalFeatureExtractor"]


class LocalFeatureExtractor(Protocol):
    """Finds keypoints in one image and describes them. Safe to call from several threads."""

    @property
    def fingerprint(self) -> Fingerprint:
        """Name, parameters and weights; kept in the manifest of every map."""

    @property
    def computed_with(self) -> str:
        """Library and device, such as ``torch 2.13.0 on cpu``; features differ in last bits."""

    @property
    def descriptor_dim(self) -> int:
        """Length D of one descriptor."""

    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,
    ) -> LocalFeatures:
        """Return at most ``max_keypoints`` features, strongest first.

        rgb: (H, W, 3). Keypoints are in its pixels, whatever size the network worked at.
        A blank image gives none. It is not an error; nor is an image of one pixel.
        """


class GlobalDescriptor(Protocol):
    """Turns one photo into one vector, with a model learned on the map's own photos.

    The model is a mapping of plain arrays: what ``learn_vocabulary`` and ``learn_projection``
    returned, together. Safe to call from several threads.
    """

    @property
    def fingerprint(self) -> Fingerprint:
        """Name and parameters; kept in the manifest of every map."""

    @property
    def computed_with(self) -> str | None:
        """Library and device, such as ``torch 2.13.0 on cpu``; None for plain code."""

    @property
    def needs_image(self) -> bool:
        """Whether it looks at the pixels; if not, ``rgb`` may be an image without any."""

    @property
    def needs_local_features(self) -> bool:
        """Whether it is made of local features; if not, ``local`` may be empty."""

    @property
    def needs_vocabulary(self) -> bool:
        """Whether it learns from words of the map's photos.

        If not, ``training_words`` and ``learn_vocabulary`` are never called, and the vocabulary is
        empty.
        """

    def training_words(
        self, rgb: NDArray[np.uint8], local: LocalFeatures, seed: int
    ) -> NDArray[np.float32]:
        """Return a seeded sample (n, d) of what the vocabulary is learned from."""

    def learn_vocabulary(
        self, words: NDArray[np.float32], seed: int
    ) -> dict[str, NDArray[np.float32]]:
        """Learn from the training words (n, d) of many photos."""

    def pool(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        vocabulary: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Aggregate one photo to a raw vector (R,)."""

    def learn_projection(self, pooled: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Learn whitening from the raw vectors (n, R) of the map's photos, n >= 1."""

    def project(
        self, pooled: NDArray[np.float32], model: Mapping[str, NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Whiten raw vectors (..., R) to rows (..., D) of unit length; zero rows stay zero."""

    def describe(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        model: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Return ``project(pool(...))``: (D,), unit length, or zero where nothing was seen."""
