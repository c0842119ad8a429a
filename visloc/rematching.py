"""Matching a photo once more with those that it has most in common with, by a network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.features.lightglue import SeenKeypoints
from visloc.images import stored_from_upright
from visloc.matching.correspondences import Pairs
from visloc.types import Evidence, LocalFeatures, ReadAs

if TYPE_CHECKING:
    from visloc.features.lightglue_torch import LightGlue

# EXIF orientations and those that undo them; the others undo themselves.
_UNDONE_BY = {6: 8, 8: 6}


@dataclass(frozen=True, slots=True, eq=False)
class Rematching:
    """A photo and the network that compares it with photos of a map.

    Attributes:
        network: of the map's local features.
        opened: the map.
        seen: keypoints of the photo, as ``seen_as_found`` gives them.
    """

    network: LightGlue
    opened: Map
    seen: SeenKeypoints

    def match(self, image: int) -> Pairs:
        """Match with the landmarks that a photo of the map sees.

        Returns:
            Keypoints, landmarks, and the cosine similarities of their descriptors.
        """
        landmarks, rows = self.opened.observations(image)
        camera = self.opened.cameras[self.opened.images[image].camera]
        scale = np.float32(self.opened.manifest.local_features.descriptor_scale)
        theirs = SeenKeypoints(
            self.opened.keypoints(image),
            rows.astype(np.float32) * scale,
            camera.width,
            camera.height,
        )
        i, j, _ = self.network.match(self.seen, theirs)
        similarities = np.einsum("nd,nd->n", self.seen.descriptors[i], theirs.descriptors[j])
        return i, landmarks[j].astype(np.int64), similarities


def seen_as_found(local: LocalFeatures, evidence: Evidence) -> SeenKeypoints:
    """Return keypoints in the photo as their descriptors saw it: upright, where it was turned."""
    width, height = evidence.camera.width, evidence.camera.height
    keypoints: NDArray[np.floating] = local.keypoints
    orientation = evidence.exif_orientation
    if evidence.read_as is ReadAs.UPRIGHT and orientation != 1:
        if orientation >= 5:
            width, height = height, width
        undone_by = _UNDONE_BY.get(orientation, orientation)
        keypoints = stored_from_upright(keypoints, undone_by, width, height)
    return SeenKeypoints(keypoints.astype(np.float32), local.descriptors, width, height)
