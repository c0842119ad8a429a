"""Match a photo again, by a network, with the mapping photos that share most matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.features.framing import turned_points, turned_size
from visloc.features.networks.lightglue.model import SeenKeypoints
from visloc.geometry import Camera
from visloc.localization.map_view.constraints import MapGeometry
from visloc.matching.correspondences import Pairs
from visloc.options import ReadAs
from visloc.photos.reading import turn_of, upright_from_stored
from visloc.types import Evidence, LocalFeatures

if TYPE_CHECKING:
    from visloc.features.networks.lightglue.torch import LightGlue


@dataclass(frozen=True, slots=True, eq=False)
class Rematching:
    """A photo and the network that compares it with photos of a map.

    Attributes:
        network: of the map's local features.
        seen: keypoints of the photo, as ``seen_as_found`` gives them.
    """

    network: LightGlue
    geometry: MapGeometry
    seen: SeenKeypoints

    def match(self, image: int) -> Pairs:
        """Match with the landmarks that a photo of the map sees.

        Returns:
            Keypoints, landmarks, and the cosine similarities of their descriptors.
        """
        opened = self.geometry.opened
        landmarks, rows = opened.observations(image)
        record = opened.images[image]
        scale = np.float32(opened.manifest.local_features.descriptor_scale)
        theirs = _seen_upright(
            opened.keypoints(image),
            rows.astype(np.float32) * scale,
            opened.cameras[record.camera],
            record.turn,
        )
        i, j, _ = self.network.match(self.seen, theirs)
        placed = np.isfinite(self.geometry.points(landmarks[j])[:, 0])
        i, j = i[placed], j[placed]
        similarities = np.einsum("nd,nd->n", self.seen.descriptors[i], theirs.descriptors[j])
        return i, landmarks[j].astype(np.int64), similarities


def seen_as_found(local: LocalFeatures, evidence: Evidence, reduced: float) -> SeenKeypoints:
    """Return a query's keypoints in the frame of its descriptors: the photo as it was read.

    Args:
        local: in the pixels of the photo reduced by ``reduced``.
    """
    turn = turn_of(evidence.exif_orientation) if evidence.read_as is ReadAs.UPRIGHT else 1
    camera = evidence.camera.reduced(reduced)
    seen = _seen_upright(local.keypoints, local.descriptors, camera, turn)
    return seen if evidence.turned == 0 else _turned(seen, evidence.turned)


def _turned(seen: SeenKeypoints, degrees: int) -> SeenKeypoints:
    """Turn keypoints clockwise, as the picture was in which they were found."""
    keypoints = turned_points(seen.keypoints, degrees, seen.width, seen.height)
    size = turned_size(seen.width, seen.height, degrees)
    return SeenKeypoints(keypoints.astype(np.float32), seen.descriptors, *size)


def _seen_upright(
    keypoints: NDArray[np.floating],
    descriptors: NDArray[np.float32],
    camera: Camera,
    turn: int,
) -> SeenKeypoints:
    """Turn keypoints (N, 2) in stored pixels by an EXIF orientation."""
    width, height = camera.width, camera.height
    turned = upright_from_stored(keypoints, turn, width, height)
    size = (height, width) if turn >= 5 else (width, height)
    return SeenKeypoints(turned.astype(np.float32), descriptors, *size)
